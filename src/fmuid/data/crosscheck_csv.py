"""CSV files: written as in the FMI Cross-Check (comma, quoted header, `time` first), and read in logger formats.

A logger's file may separate cells by semicolons, tabs or blanks and then use decimal commas; it may state units in
the header or in a separate row, and time in a unit other than s; a cell may be a list. The table's notes list
what was detected.
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

from fmu_build.errors import counted
from fmuid.core.errors import MeasurementsError, UnitError
from fmuid.core.files import write_atomically
from fmuid.core.immutable import FloatArray, frozen_mapping, read_only
from fmuid.core.units import check_unit, conversion, convertible
from fmuid.data.table_layout import TableLayout, source_of

MAX_BYTES = 2_000_000_000
MAX_COLUMNS = 10_000
MAX_LINE = 2**20  # bytes
_LINE_ENDS = re.compile(rb"[\r\n\0]")  # or the NUL bytes of a damaged file
TIMES = ("time", "t", "timestamp", "timestamps", "datetime", "zeit")
"""Names of a time axis, in upper or lower case."""
_DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab"}
_BLANKS = " "
_AS_WRITTEN = TableLayout()
_FIRST_LINE = 'write a header "time","..." and the samples'
PER_MINUTE = ("1/min", "min-1", "min^-1", "/min")
"""Units that loggers write for rpm."""
_PREAMBLE = 100  # lines searched for a header
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
# "tau [N.m]", "tau[N.m]", "tau (N.m)": a name and its unit; but lossTable[1,2] and der(v) are names.
_QUOTIENT = re.compile(r"(?P<name>.*\S)\s(?:/|in)\s(?P<unit>\S+)")  # "Drehmoment / N.m", as in ISO 80000
_NUMBER = re.compile(r"[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?|nan|[-+]?inf", re.IGNORECASE)
_MISSING = ("", "na", "n/a", "null", "none")
_LIST = re.compile(r"\[(?P<items>[^\[\]]*)\]|\((?P<round>[^()]*)\)")
_COMMENT = re.compile(r"\A(?P<before>\s*)[#%]+[ \t]*")  # before a header
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


def read_csv(path: str | Path, layout: TableLayout = _AS_WRITTEN) -> Table:
    """Read a CSV file with a header row, one of whose columns is `time`.

    Lines before the header are skipped, and row numbers before the time. Text is UTF-8, UTF-16 or otherwise
    Windows-1252. Columns of text are left out.

    Parameters
    ----------
    path
        The file.
    layout
        Names of the columns of a file without a header, columns to choose, and the rate of a file without times.

    Raises
    ------
    MeasurementsError
        The file is missing or is not such a table; the message names row and column.
    """
    path = Path(path)
    text, notes = _read_text(path)
    text, delimiter, more = _separated(text, layout, path)
    notes += more
    header, skip = _header(text, layout, delimiter, path)
    dates = any(_is_date(_first_cell(text, line, delimiter)) for line in (skip, skip + 1))  # below a row of units
    if dates and layout.rate is None and not layout.chosen and not any(map(_is_time, header)):
        notes.append(f"'{header[0]}' contains dates and is taken as time")
        header = ["time", *header[1:]]
    names, units = _read_header(header, layout, path)
    if not units and (below := _units_row(text, skip, names, delimiter)):
        units = {n: u for n, u in zip(names, below, strict=True) if u}
        notes.append(f"units are on line {skip + 1}")
        skip += 1
    text, dated = _dates_as_seconds(text, skip, delimiter) if names[0].casefold() in TIMES else (text, False)
    notes += ["time starts at the first date"] if dated else []
    columns, decimal_comma, others = _read_numbers(text, skip, names, path, delimiter)
    notes += ["decimal commas"] if decimal_comma else []
    notes += [f"not used (not numeric): {', '.join(others)}"] if others else []
    of_lists = {n: units[n.partition("[")[0]] for n in columns if n.partition("[")[0] in units}
    units = of_lists | {n: u for n, u in units.items() if n in columns}
    if layout.chosen:
        columns, units = _chosen(columns, names, units, layout=layout, path=path)
    for name, unit in units.items():
        if unit.replace(" ", "") in PER_MINUTE:
            units[name] = "rpm"
            notes.append(per_minute_note(name, unit))
    return _over_time(columns, units, notes, dated=dated, layout=layout, path=path)


def _over_time(
    columns: dict[str, FloatArray],
    units: dict[str, str],
    notes: list[str],
    *,
    dated: bool,
    layout: TableLayout,
    path: Path,
) -> Table:
    """Return columns as a table over the times in one of them, or of the layout's rate."""
    time_name = time_column({name: units.get(name) for name in columns})
    rows = len(next(iter(columns.values()), ()))
    if rows < 2:
        raise MeasurementsError(
            f"has {counted(rows, 'row')} of values", where=path, fix="a run has at least 2 samples"
        )
    if layout.rate is not None:
        if time_name is not None:
            raise two_time_axes(time_name, path)
        return Table(np.arange(rows) / layout.rate, columns, units, tuple(notes))
    if time_name is None:
        fix = "choose one, as in --columns 'time [ms]=1,...', or give --rate"
        raise MeasurementsError("has no column of times", where=path, fix=fix)
    stated = units.pop(time_name, "s")
    unit = "s" if dated or not stated else stated
    time = _checked_times(in_seconds(columns.pop(time_name), unit, path), path)
    notes += [f"time converted from {unit} to s"] if unit != "s" else []
    if not columns:
        raise MeasurementsError("has no column except time", where=path, fix="add the signals")
    return Table(time, columns, units, tuple(notes))


def time_column(units: Mapping[str, str | None]) -> str | None:
    """Return the column of times among those with these units; a `T` in kelvin is a temperature."""
    named = [name for name, unit in units.items() if name.casefold() in TIMES and _may_be_time(name, unit)]
    return min(named, key=lambda name: (TIMES.index(name.casefold()), name != name.casefold()), default=None)


def _may_be_time(name: str, unit: str | None) -> bool:
    """Return whether a name of times is one; a single letter also stands for other quantities."""
    return len(name) > 1 or not unit or not _is_unit(unit) or convertible(unit, "s")


def two_time_axes(time_name: str, path: Path) -> MeasurementsError:
    """Return the error of a file with times for which a rate is given."""
    what = f"has times in '{time_name}', and a rate is given"
    return MeasurementsError(what, where=path, fix="leave --rate out, or choose other columns with --columns")


def _separated(text: str, layout: TableLayout, path: Path) -> tuple[str, str, list[str]]:
    """Return the text from the header on, the delimiter of its cells, and notes."""
    notes: list[str] = []
    skipped = 0
    if layout.rate is None and not layout.ordered:
        text, numbered = _without_row_numbers(text)
        text, skipped = _without_preamble(text)
        notes += ["the first column has no name, so it is taken for row numbers and left out"] if numbered else []
        notes += [f"the header is on line {skipped + 1}"] if skipped else []
    text = _COMMENT.sub(r"\g<before>", text)
    delimiter = _delimiter(text, layout, path)
    if delimiter == _BLANKS:
        text = "\n".join(re.sub(r"[ \t]+", "\t", line.strip()) for line in text.split("\n"))
        return text, "\t", [*notes, "cells are separated by blanks"]
    notes += [] if delimiter == "," else [f"cells are separated by {_DELIMITERS[delimiter]}s"]
    return text, delimiter, notes


def per_minute_note(name: str, unit: str) -> str:
    """Return the note on a signal in `PER_MINUTE`."""
    return f"'{name}' in {unit} is read as revolutions per minute (rpm)"


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


def _read_text(path: Path) -> tuple[str, list[str]]:
    """Return the text of a file, and notes on its encoding and on damaged lines."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise MeasurementsError("is larger than 2 GB", where=path, fix="split it")
        content = path.read_bytes()
    except FileNotFoundError:
        raise MeasurementsError("no such file", where=path, fix="check the path") from None
    except OSError as error:
        raise MeasurementsError(f"cannot be read ({error.strerror})", where=path, fix="check the path") from None
    _check_lines(content, path)
    begin, encodings = content[:1000], [("utf-8-sig", ""), ("cp1252", "Windows-1252")]
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        encodings = [("utf-16", "UTF-16")]
    elif b"\0" in begin and len(content) % 2 == 0:
        low, high = begin[::2].count(0), begin[1::2].count(0)
        if max(low, high) > 0.4 * len(begin[::2]) and min(low, high) < 0.1 * max(low, high):
            encodings = [("utf-16-le" if low < high else "utf-16-be", "UTF-16")]
    for encoding, name in encodings:
        with suppress(UnicodeDecodeError):
            text, notes = _without_nul(content.decode(encoding).replace("\r\n", "\n"))
            # Text has no control characters, so a file with them is not text in any encoding.
            if not name or not _CONTROL.search(text[:10_000]):
                return text, [*([f"read as {name}"] if name else []), *notes]
    raise MeasurementsError("is not text", where=path, fix="save it as CSV in UTF-8")


def _check_lines(content: bytes, path: Path) -> None:
    """Refuse endless lines before they are decoded and split, which takes many times their size."""
    for k in range(0, len(content) - MAX_LINE + 1, MAX_LINE):
        if not _LINE_ENDS.search(content, k, k + MAX_LINE):
            line = content.count(b"\n", 0, k) + 1
            fix = "write one row for each time"
            raise MeasurementsError("is longer than 1 MB", where=f"{path} line {line}", fix=fix)


def _without_nul(text: str) -> tuple[str, list[str]]:
    """Return the text without NUL characters, and a note on them.

    A logger that lost power leaves a block of them, and the rest of a line next to it is not a row. If most lines
    have some, they fill up cells and mean nothing.
    """
    if "\0" not in text:
        return text, []
    lines = text.split("\n")
    damaged = [k for k, line in enumerate(lines) if "\0" in line]
    if 2 * len(damaged) > len(lines) and len(lines) > 2:
        return text.replace("\0", ""), ["NUL bytes are left out"]
    for k in damaged:
        lines[k] = ""
    count = f"{len(damaged)} line{'s' if len(damaged) > 1 else ''}"
    return "\n".join(lines), [f"NUL bytes: {count} left out (line {damaged[0] + 1} first)"]


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
    cells = _cells(line, delimiter)
    return len(cells) > 1 and any(_is_time(cell) for cell in cells)


def _cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of a header line, without quotes and a comment sign before the first."""
    cells = line.lstrip("#% ").split(None if delimiter == _BLANKS else delimiter)
    return [cell.strip().strip('"').strip() for cell in cells]


def _is_time(header: str) -> bool:
    return _suffixed_time(header) or name_and_unit(header)[0].casefold() in TIMES


def _suffixed_time(header: str) -> bool:
    """Return whether a header such as ``t_s`` or ``time_ms`` names the time and its unit."""
    name, _, unit = header.strip().rpartition("_")
    return name.casefold() in TIMES and _is_unit(unit) and convertible(unit, "s")


def _name_and_suffix(header: str) -> tuple[str, str | None]:
    """Return the name and the unit in ``u_V``; None without a unit."""
    name, _, unit = header.strip().rpartition("_")
    return (name, unit) if name and _is_unit(unit) else (header.strip(), None)


def _is_unit(text: str) -> bool:
    with suppress(UnitError):
        check_unit(text)
        return bool(text)
    return False


def _delimiter(text: str, layout: TableLayout, path: Path) -> str:
    """Return the delimiter that isolates the named time column, or else that of the first lines."""
    lines = [line for line in text.split("\n", 200) if line.strip()][:2]
    if not lines:
        raise MeasurementsError("is empty", where=path, fix=_FIRST_LINE)
    every = (*_DELIMITERS, _BLANKS)
    if layout.ordered:
        counts = {d: len(_cells(lines[0], d)) for d in (";", "\t", ",", _BLANKS)}
        for delimiter, count in counts.items():
            if count == len(layout.ordered):
                return delimiter
        what = f"has {max(counts.values())} columns, {len(layout.ordered)} are named"
        raise MeasurementsError(what, where=path, fix="name every column")
    named = [d for d in every if _names_time(lines[0], d)]
    if named and layout.rate is None:
        return named[0]
    for delimiter in (";", "\t", ",", _BLANKS):
        widths = {len(_cells(line, delimiter)) for line in lines}
        if len(widths) == 1 and widths != {1}:
            return delimiter
    return ","


def _header(text: str, layout: TableLayout, delimiter: str, path: Path) -> tuple[list[str], int]:
    """Return the headers, and the number of lines up to and including theirs."""
    first = _first_line(text)
    cells = [cell.strip().strip('"') for cell in first.split(delimiter)]
    bare = bool(_NUMBER.fullmatch(cells[0]) or _LIST.fullmatch(cells[0]))
    if layout.ordered:
        if not bare and not any(c.isdigit() for c in cells[0]):
            raise MeasurementsError("has a header", where=path, fix="leave --columns out")
        return list(layout.ordered), 0
    if bare and not layout.chosen:
        shown = ", ".join(cells[:4]) + (", ..." if len(cells) > 4 else "")
        fix = "name its columns: --columns 'time,tau [N.m]', one name for each"
        what = f"has no header (its first row has {counted(len(cells), 'cell')}: {shown})"
        raise MeasurementsError(what, where=path, fix=fix)
    if bare:
        return [str(k + 1) for k in range(len(cells))], 0
    rows = csv.reader(io.StringIO(text), delimiter=delimiter, strict=True, skipinitialspace=True)
    try:
        header = next((row for row in rows if any(cell.strip() for cell in row)), None)
    except csv.Error as error:
        raise _malformed(path, 1, error) from None
    if header is None:
        raise MeasurementsError("is empty", where=path, fix=_FIRST_LINE)
    return header, rows.line_num


def _read_header(header: list[str], layout: TableLayout, path: Path) -> tuple[list[str], dict[str, str]]:
    """Return the names and the units of columns; in the style ``t_s``, units follow the last underscore."""
    suffixed = any(_suffixed_time(cell) for cell in header)
    cells = [_name_and_suffix(cell) if suffixed else name_and_unit(cell) for cell in header]
    names = [name for name, _ in cells]
    if not layout.chosen and layout.rate is None and not any(name.casefold() in TIMES for name in names):
        raise MeasurementsError(
            f"no column is named 'time' (the first one is '{names[0][:40]}')",
            where=path,
            fix="name it so, or choose it: --columns 'time [s]=1,...'; a file without times needs --rate",
        )
    if len(names) > MAX_COLUMNS:
        what = f"has {len(names)} columns, more than {MAX_COLUMNS}"
        raise MeasurementsError(what, where=path, fix="drop the columns that are not used")
    seen: set[str] = set()
    for i, name in enumerate(names):
        if not name or not name.isprintable():
            raise MeasurementsError(f"column {i + 1} has no name", where=path, fix="name every column")
        if name in seen:
            raise MeasurementsError(f"column '{name}' appears twice", where=path, fix="rename one of the two")
        seen.add(name)
    return names, {name: unit for name, unit in cells if unit is not None}


def _chosen(
    read: Mapping[str, FloatArray],
    names: Sequence[str],
    units: Mapping[str, str],
    *,
    layout: TableLayout,
    path: Path,
) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Return the chosen columns under their new names, and their units."""
    columns, stated = dict[str, FloatArray](), dict[str, str]()
    for header, source in layout.chosen:
        old = source if source in read else names[source_of(source, names, path)]
        if old not in read:
            raise MeasurementsError(f"column '{source}' is not numeric", where=path, fix="choose another one")
        name, unit = name_and_unit(header)
        columns[name] = read[old]
        if (unit := units.get(old) if unit is None else unit) is not None:
            stated[name] = unit
    return columns, stated


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


def _first_cell(text: str, number: int, delimiter: str) -> str:
    """Return the first cell of a line; empty if there is no such line."""
    lines = text.split("\n", number + 1)
    return lines[number].partition(delimiter)[0].strip(' "\r') if len(lines) > number else ""


def _is_date(cell: str) -> bool:
    with suppress(ValueError):
        return "-" in cell and ":" in cell and datetime.fromisoformat(cell) is not None
    return False


def _dates_as_seconds(text: str, skip: int, delimiter: str) -> tuple[str, bool]:
    """Return the text with ISO 8601 dates as seconds from the first one, and whether its times are dates."""
    first = _first_cell(text, skip, delimiter)
    if not _is_date(first):
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


def in_seconds(time: FloatArray, unit: str | None, path: Path) -> FloatArray:
    """Return times in s; raise an error if `unit` is not a unit of time."""
    try:
        return conversion(unit or "s", "s")(time)
    except UnitError as error:
        what = f"time is in '{unit}', which is not a unit of time ({error.what})"
        raise MeasurementsError(what, where=path, fix="correct its unit") from None


def _checked_times(time: FloatArray, path: Path) -> FloatArray:
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


def _read_numbers(
    text: str, skip: int, names: list[str], path: Path, delimiter: str
) -> tuple[dict[str, FloatArray], bool, list[str]]:
    """Return the columns, whether they are written with decimal commas, and the names of columns of text.

    Columns of lists become one column per element: ``q[1]``, ``q[2]``.
    """
    n = len(names)
    body = text.split("\n", skip)[skip] if text.count("\n") >= skip else ""
    decimal_comma = delimiter != "," and "." not in body and "," in body
    plain = body.replace(",", ".") if decimal_comma else body
    try:  # NumPy's reader is fast, but accepts no empty cells and names no column
        with warnings.catch_warnings(action="error"):  # it warns about a file without rows
            values = np.loadtxt(io.StringIO(plain), delimiter=delimiter, ndmin=2, quotechar='"', comments=None)
        if values.shape[1] == n:
            return {name: values[:, i] for i, name in enumerate(names)}, decimal_comma, []
    except (ValueError, UserWarning):
        pass
    cells: list[list[str]] = []
    lines: list[int] = []
    rows = csv.reader(io.StringIO(body), delimiter=delimiter, strict=True, skipinitialspace=True)
    try:
        for row in rows:
            if not any(cell.strip() for cell in row):
                continue
            if len(row) != n:
                where = f"{path} line {skip + rows.line_num}"
                raise MeasurementsError(
                    f"has {counted(len(row), 'cell')}, the header has {n}",
                    where=where,
                    fix="write one cell per column",
                )
            cells.append(row)
            lines.append(skip + rows.line_num)
    except csv.Error as error:
        raise _malformed(path, skip + rows.line_num, error) from None
    columns: dict[str, FloatArray] = {}
    others: list[str] = []
    for name, column in zip(names, zip(*cells, strict=True), strict=False):
        texts = [cell.strip() for cell in column]
        if any(texts) and all(_LIST.fullmatch(cell) for cell in texts if cell):
            columns |= _elements(name, texts, lines, path)
        elif name.casefold() not in TIMES and any(texts) and not any(_NUMBER.fullmatch(cell) for cell in texts):
            others.append(name)
        else:
            numbers = [
                _number(c, name, f"{path} line {k}", decimal_comma) for c, k in zip(texts, lines, strict=True)
            ]
            columns[name] = np.array(numbers, dtype=np.float64)
    return columns, decimal_comma, others


def _elements(name: str, cells: Sequence[str], lines: Sequence[int], path: Path) -> dict[str, FloatArray]:
    """Return the columns of the elements of lists, NaN where a cell is empty."""
    split = [re.split(r"[\s,;]+", cell[1:-1].strip(" ,;")) if cell else [] for cell in cells]
    width = max(map(len, split))
    values = np.full((len(cells), width), np.nan)
    for k, (items, line) in enumerate(zip(split, lines, strict=True)):
        where = f"{path} line {line}"
        if items and len(items) != width:
            what = f"the list in column '{name}' has {counted(len(items), 'element')}, others have {width}"
            raise MeasurementsError(what, where=where, fix="write lists of one length")
        values[k, : len(items)] = [_number(item, name, where, decimal_comma=False) for item in items]
    return {f"{name}[{i + 1}]": values[:, i] for i in range(width)}


def _number(cell: str, name: str, where: str, decimal_comma: bool) -> float:
    text = cell.strip()
    if text.casefold() in _MISSING:
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
