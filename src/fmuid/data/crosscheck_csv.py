"""CSV files: written as in the FMI Cross-Check (comma, quoted header, `time` first), and read in logger formats.

A logger's file may separate cells by semicolons or tabs and then use decimal commas; it may state units in the
header or in a separate row, and time in a unit other than s. The table's notes list what was detected.
"""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from fmuid.core.errors import MeasurementsError, UnitError
from fmuid.core.files import write_atomically
from fmuid.core.immutable import FloatArray, frozen_mapping, read_only
from fmuid.core.units import check_unit, conversion

MAX_BYTES = 2_000_000_000
MAX_COLUMNS = 10_000
TIMES = ("time", "t", "timestamp", "timestamps", "datetime", "zeit")
"""Names of a time axis, in upper or lower case."""
_DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab"}
_PER_MINUTE = ("1/min", "min-1", "min^-1", "/min")
_PREAMBLE = 100  # lines searched for a header
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
# "tau [N.m]", "tau[N.m]", "tau (N.m)": a name and its unit; but lossTable[1,2] and der(v) are names.
_QUOTIENT = re.compile(r"(?P<name>.*\S)\s(?:/|in)\s(?P<unit>\S+)")  # "Drehmoment / N.m", as in ISO 80000
_CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f]")
_WITH_UNIT = re.compile(
    r"(?P<name>.*\S)(?:\s+\[(?P<square>[^\[\]]*)\]|\[(?P<tight>[^\[\]]*[^\W\d][^\[\]]*)\]|\s+\((?P<round>[^()]*)\))"
)


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Columns over time.

    Parameters
    ----------
    time
        (N,) in s; not decreasing (an event has two rows at one time).
    columns
        Name -> (N,) values, NaN where a cell is empty, in the file's order.
    units
        Name -> unit, for names whose header states a unit, as in ``"tau [N.m]"``.
    notes
        Observations of the reader, one line each.
    """

    time: FloatArray
    columns: Mapping[str, FloatArray]
    units: Mapping[str, str]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "time", read_only(self.time))
        columns = {name: read_only(values) for name, values in self.columns.items()}
        object.__setattr__(self, "columns", frozen_mapping(columns))
        object.__setattr__(self, "units", frozen_mapping(self.units))

    def only(self, names: Collection[str]) -> Table:
        """Return the table with only the columns in `names`."""
        units = {n: u for n, u in self.units.items() if n in names}
        return Table(self.time, {n: self.columns[n] for n in names}, units, self.notes)


def read_csv(path: str | Path, columns: Sequence[str] = ()) -> Table:
    """Read a CSV file with a header row whose first column is `time`.

    Lines before the header are skipped, and row numbers before the time. Text is UTF-8, UTF-16 or otherwise
    Windows-1252.

    Parameters
    ----------
    path
        The file.
    columns
        Column headers for a file without a header, with units as in ``tau [N.m]``.

    Raises
    ------
    MeasurementsError
        The file is missing or is not such a table; the message names row and column.
    """
    path = Path(path)
    text, encoding = _read_text(path)
    text, numbered = (text, False) if columns else _without_row_numbers(text)
    text, skipped = (text, 0) if columns else _without_preamble(text)
    delimiter = _delimiter_of(text, columns, path) if columns else _delimiter(text)
    rows = csv.reader(io.StringIO(text), delimiter=delimiter, strict=True, skipinitialspace=True)
    try:
        found = (row for row in rows if any(cell.strip() for cell in row))
        header = list(columns) if columns else next(found, None)
    except csv.Error as error:
        raise _malformed(path, 1, error) from None
    if header is None:
        raise MeasurementsError("is empty", where=path, fix='write a header "time","..." and the samples')
    names, units = _read_header(header, path)
    notes = [f"read as {encoding}"] if encoding else []
    notes += ["the first column has no name, so it is taken for row numbers and left out"] if numbered else []
    notes += [f"the header is on line {skipped + 1}"] if skipped else []
    notes += [] if delimiter == "," else [f"cells are separated by {_DELIMITERS[delimiter]}s"]
    skip = rows.line_num
    if not units and (below := _units_row(text, skip, names, delimiter)):
        units = {n: u for n, u in zip(names, below, strict=True) if u}
        notes.append(f"units are on line {skip + 1}")
        skip += 1
    for name, unit in units.items():
        if unit.replace(" ", "") in _PER_MINUTE:
            units[name] = "rpm"
            notes.append(f"'{name}' in {unit} is read as revolutions per minute (rpm)")
    text, dated = _dates_as_seconds(text, skip, delimiter)
    if dated:
        notes.append("time starts at the first date")
    values, decimal_comma = _read_numbers(text, skip, names, path, delimiter)
    if decimal_comma:
        notes.append("decimal commas")
    if len(values) < 2:
        raise MeasurementsError(
            f"has {len(values)} row(s) of values", where=path, fix="a run has at least 2 samples"
        )
    unit = units.pop(names[0], "s")
    unit = "s" if dated else unit
    time = _in_seconds(values[:, 0], unit, path)
    if unit != "s":
        notes.append(f"time converted from {unit} to s")
    return Table(time, {name: values[:, i] for i, name in enumerate(names) if i}, units, tuple(notes))


def name_and_unit(header: str) -> tuple[str, str | None]:
    """Return the name and the unit in ``tau [N.m]``, ``tau[N.m]`` or ``tau (N.m)``; None without a unit."""
    match = _WITH_UNIT.fullmatch(header.strip())
    if match is None:
        quotient = _QUOTIENT.fullmatch(header.strip())
        with suppress(UnitError):
            if quotient is not None:
                check_unit(quotient["unit"])
                return quotient["name"], quotient["unit"]
        return header.strip(), None
    return match["name"], (match["square"] or match["tight"] or match["round"] or "").strip()


def write_csv(table: Table, path: str | Path) -> None:
    """Write `table` atomically with 17 significant digits; a missing sample is an empty cell."""
    names = ["time", *table.columns]
    header = [f"{n} [{table.units[n]}]" if n in table.units else n for n in names]
    lines = [",".join('"' + h.replace('"', '""') + '"' for h in header)]
    for row in np.column_stack([table.time, *table.columns.values()]).tolist():
        lines.append(",".join("" if v != v else repr(v) for v in row))
    write_atomically(Path(path), "\n".join(lines) + "\n")


def _read_text(path: Path) -> tuple[str, str]:
    """Return the text of a file, and its encoding if that is not UTF-8."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise MeasurementsError("is larger than 2 GB", where=path, fix="split it")
        content = path.read_bytes()
    except FileNotFoundError:
        raise MeasurementsError("no such file", where=path, fix="check the path") from None
    except OSError as error:
        raise MeasurementsError(f"cannot be read ({error.strerror})", where=path, fix="check the path") from None
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        encodings = [("utf-16", "UTF-16")]
    elif b"\0" in content[:1000] and len(content) % 2 == 0:
        little = content[:1000:2].count(0) < content[1:1000:2].count(0)
        encodings = [("utf-16-le" if little else "utf-16-be", "UTF-16")]
    else:
        encodings = [("utf-8-sig", ""), ("cp1252", "Windows-1252")]
    for encoding, name in encodings:
        with suppress(UnicodeDecodeError):
            text = content.decode(encoding).replace("\r\n", "\n")
            # Text has no control characters, so a file with them is not text in any encoding.
            if not name or not _CONTROL.search(text[:10_000]):
                return text, name
    raise MeasurementsError("is not text", where=path, fix="save it as CSV in UTF-8")


def _without_row_numbers(text: str) -> tuple[str, bool]:
    """Return the text without an unnamed column before the time (as written by pandas), and whether it had one."""
    first = _first_line(text)
    for delimiter in _DELIMITERS:
        name, _, rest = first.partition(delimiter)
        if not name.strip(' "') and _names_time(rest, delimiter):
            return "\n".join(line.partition(delimiter)[2] for line in text.split("\n")), True
    return text, False


def _without_preamble(text: str) -> tuple[str, int]:
    """Return the text with the lines before the header emptied, and the number of these."""
    lines = text.split("\n", _PREAMBLE)
    for k, line in enumerate(lines[:_PREAMBLE]):
        if any(_names_time(line, delimiter) for delimiter in _DELIMITERS):
            return "\n" * k + "\n".join(lines[k:]), k if any(old.strip() for old in lines[:k]) else 0
    return text, 0


def _first_line(text: str) -> str:
    """Return the first line that is not blank."""
    return next((line for line in io.StringIO(text) if line.strip()), "").rstrip("\n")


def _names_time(line: str, delimiter: str) -> bool:
    cell = line.split(delimiter, 1)[0].strip().strip('"')
    return delimiter in line and name_and_unit(cell)[0].casefold() in TIMES


def _delimiter_of(text: str, columns: Sequence[str], path: Path) -> str:
    """Return the delimiter of cells in a file without a header."""
    first = _first_line(text)
    counts = {d: len(first.split(d)) for d in (";", "\t", ",")}
    for delimiter, count in counts.items():
        if count == len(columns):
            if not any(c.isdigit() for c in first.split(delimiter)[0]):
                raise MeasurementsError("has a header", where=path, fix="leave --columns out")
            return delimiter
    raise MeasurementsError(
        f"has {max(counts.values())} columns, {len(columns)} are named", where=path, fix="name every column"
    )


def _delimiter(text: str) -> str:
    """Return the first of comma, semicolon and tab that leaves `time` alone in the first cell."""
    first = _first_line(text)
    for delimiter in _DELIMITERS:
        if _names_time(first, delimiter):
            return delimiter
    return ","


def _read_header(header: list[str], path: Path) -> tuple[list[str], dict[str, str]]:
    cells = [name_and_unit(cell) for cell in header]
    names = [name for name, _ in cells]
    if re.fullmatch(r"[-+\d.,;eE\s]+", names[0]):
        raise MeasurementsError(
            "has no header", where=path, fix="name its columns: --columns 'time,tau [N.m]', one name for each"
        )
    if names[0].casefold() not in TIMES:
        raise MeasurementsError(
            f"the first column is '{names[0][:40]}'", where=path, fix="it must be 'time', in s"
        )
    if len(names) > MAX_COLUMNS:
        what = f"has {len(names)} columns, more than {MAX_COLUMNS}"
        raise MeasurementsError(what, where=path, fix="drop the columns that are not used")
    if len(names) < 2:
        raise MeasurementsError("has no column except time", where=path, fix="add the signals")
    seen: set[str] = set()
    for i, name in enumerate(names):
        if not name or not name.isprintable():
            raise MeasurementsError(f"column {i + 1} has no name", where=path, fix="name every column")
        if name in seen:
            raise MeasurementsError(f"column '{name}' appears twice", where=path, fix="rename one of the two")
        seen.add(name)
    return names, {name: unit for name, unit in cells if unit is not None}


def _units_row(text: str, skip: int, names: list[str], delimiter: str) -> list[str]:
    """Return the units in the line after the header; none if one of its cells is a number or not a unit."""
    line = text.split("\n", skip + 1)[skip] if text.count("\n") >= skip else ""
    cells = [cell.strip().strip('"[]() ') for cell in line.split(delimiter)]
    if len(cells) != len(names) or not cells[0].isalpha() or not any(cells[1:]):
        return []
    with suppress(UnitError):
        for cell in cells:
            check_unit(cell or "1")
        return cells
    return []


def _dates_as_seconds(text: str, skip: int, delimiter: str) -> tuple[str, bool]:
    """Return the text with ISO 8601 dates as seconds from the first one, and whether its times are dates."""
    lines = text.split("\n", skip + 1)
    first = lines[skip].partition(delimiter)[0].strip(' "\r') if len(lines) > skip else ""
    if "-" not in first or ":" not in first:
        return text, False
    lines = text.split("\n")
    rows = [
        (cell.strip(' "\r'), mark + rest) for cell, mark, rest in (s.partition(delimiter) for s in lines[skip:])
    ]
    try:
        start = datetime.fromisoformat(first)
        seconds = [repr((datetime.fromisoformat(c) - start).total_seconds()) if c else "" for c, _ in rows]
    except (ValueError, TypeError):  # some are not dates, or some have no time zone
        return text, False
    if delimiter != "," and not any("." in rest for _, rest in rows):
        seconds = [s.replace(".", ",") for s in seconds]
    return "\n".join((*lines[:skip], *(s + rest for s, (_, rest) in zip(seconds, rows, strict=True)))), True


def _in_seconds(time: FloatArray, unit: str, path: Path) -> FloatArray:
    try:
        time = conversion(unit, "s")(time)
    except UnitError as error:
        raise MeasurementsError(
            f"time is in '{unit}', which is not a unit of time ({error.what})", where=path, fix="correct its unit"
        ) from None
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise MeasurementsError(f"time is missing in sample {bad[0]}", where=path, fix="write every time, in s")
    bad = np.flatnonzero(np.diff(time) < 0)
    if bad.size:
        k = int(bad[0]) + 1
        raise MeasurementsError(
            f"time goes back from {time[k - 1]:.9g} s to {time[k]:.9g} s in sample {k}",
            where=path,
            fix="sort the rows by time",
        )
    return time


def _read_numbers(text: str, skip: int, names: list[str], path: Path, delimiter: str) -> tuple[FloatArray, bool]:
    """Return the values (N, columns), and whether they are written with decimal commas."""
    n = len(names)
    body = text.split("\n", skip)[skip] if text.count("\n") >= skip else ""
    decimal_comma = delimiter != "," and "." not in body and "," in body
    plain = body.replace(",", ".") if decimal_comma else body
    try:  # NumPy's reader is fast, but accepts no empty cells and names no column
        with warnings.catch_warnings(action="error"):  # it warns about a file without rows
            values = np.loadtxt(io.StringIO(plain), delimiter=delimiter, ndmin=2, quotechar='"', comments=None)
        if values.shape[1] == n:
            return values, decimal_comma
    except (ValueError, UserWarning):
        pass
    cells: list[list[float]] = []
    rows = csv.reader(io.StringIO(body), delimiter=delimiter, strict=True, skipinitialspace=True)
    try:
        for row in rows:
            if not any(cell.strip() for cell in row):
                continue
            where = f"{path} line {skip + rows.line_num}"
            if len(row) != n:
                raise MeasurementsError(
                    f"has {len(row)} cells, the header has {n}", where=where, fix="write one cell per column"
                )
            cells.append([_number(c, name, where, decimal_comma) for c, name in zip(row, names, strict=True)])
    except csv.Error as error:
        raise _malformed(path, skip + rows.line_num, error) from None
    return np.array(cells, dtype=np.float64).reshape(-1, n), decimal_comma


def _number(cell: str, name: str, where: str, decimal_comma: bool) -> float:
    text = cell.strip()
    if not text:
        return np.nan
    is_comma = _DECIMAL_COMMA.fullmatch(text) is not None
    try:
        return float(text.replace(",", ".") if decimal_comma and is_comma else text)
    except ValueError:
        fix = "write the decimal point as '.', everywhere" if is_comma else "write a number"
        raise MeasurementsError(
            f"'{text[:40]}' in column '{name}' is not a number", where=where, fix=fix
        ) from None


def _malformed(path: Path, line: int, error: csv.Error) -> MeasurementsError:
    return MeasurementsError(f"is not CSV ({error})", where=f"{path} line {line}", fix="correct the quotes")
