"""CSV files as in the FMI Cross-Check: comma, quoted header, `time` first; read and written."""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fmuid.campaign import FloatArray, frozen_mapping, read_only
from fmuid.errors import MeasurementsError
from fmuid.files import write_atomically

if TYPE_CHECKING:
    import _csv

MAX_BYTES = 2_000_000_000
_DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab"}
# "tau [N.m]", "tau[N.m]", "tau (N.m)": a name and its unit; but lossTable[1,2] and der(v) are names.
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
        Name -> unit, for the names whose header states one, as in ``"tau [N.m]"``.
    """

    time: FloatArray
    columns: Mapping[str, FloatArray]
    units: Mapping[str, str]

    def __post_init__(self) -> None:
        object.__setattr__(self, "time", read_only(self.time))
        columns = {name: read_only(values) for name, values in self.columns.items()}
        object.__setattr__(self, "columns", frozen_mapping(columns))
        object.__setattr__(self, "units", frozen_mapping(self.units))


def read_csv(path: str | Path, *, delimiter: str = ",") -> Table:
    """Read a CSV file with a header row whose first column is `time`.

    Raises
    ------
    MeasurementsError
        The file is missing or no such table; the line names row and column.
    """
    path = Path(path)
    text = _read_text(path)
    rows = csv.reader(io.StringIO(text), delimiter=delimiter, strict=True, skipinitialspace=True)
    try:
        header = next((row for row in rows if any(cell.strip() for cell in row)), None)
    except csv.Error as error:
        raise _malformed(path, 1, error) from None
    if header is None:
        raise MeasurementsError("is empty", where=path, fix='write a header "time","..." and the samples')
    names, units = _read_header(header, path, delimiter)
    values = _read_numbers(text, rows, names, path, delimiter)
    if len(values) < 2:
        raise MeasurementsError(
            f"has {len(values)} row(s) of values", where=path, fix="a run has at least 2 samples"
        )
    time = values[:, 0]
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
    return Table(time, {name: values[:, i] for i, name in enumerate(names) if i}, units)


def write_csv(table: Table, path: str | Path) -> None:
    """Write `table` with 17 significant digits, whole or not at all; a missing sample is an empty cell."""
    names = ["time", *table.columns]
    header = [f"{n} [{table.units[n]}]" if n in table.units else n for n in names]
    lines = [",".join('"' + h.replace('"', '""') + '"' for h in header)]
    for row in np.column_stack([table.time, *table.columns.values()]).tolist():
        lines.append(",".join("" if v != v else repr(v) for v in row))
    write_atomically(Path(path), "\n".join(lines) + "\n")


def _read_text(path: Path) -> str:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise MeasurementsError("is larger than 2 GB", where=path, fix="split it")
        return path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise MeasurementsError("no such file", where=path, fix="check the path") from None
    except UnicodeDecodeError:
        raise MeasurementsError("is not UTF-8 text", where=path, fix="save it as CSV in UTF-8") from None
    except OSError as error:
        raise MeasurementsError(f"cannot be read ({error.strerror})", where=path, fix="check the path") from None


def _read_header(header: list[str], path: Path, delimiter: str) -> tuple[list[str], dict[str, str]]:
    names, units = [], {}
    for cell in header:
        name = cell.strip()
        match = _WITH_UNIT.fullmatch(name)
        if match:
            name = match["name"]
            units[name] = (match["square"] or match["tight"] or match["round"] or "").strip()
        names.append(name)
    if len(names) == 1:
        for other, word in _DELIMITERS.items():
            if other != delimiter and other in header[0]:
                raise MeasurementsError(
                    f"is separated by {word}s", where=path, fix=f"import it with: --delimiter {word}"
                )
    if names[0].casefold() not in ("time", "t"):
        raise MeasurementsError(
            f"the first column is '{names[0]}'", where=path, fix="the first column is 'time', in s"
        )
    if units.pop(names[0], "s") != "s":
        raise MeasurementsError("time is not in s", where=path, fix="convert the first column to seconds")
    if len(names) < 2:
        raise MeasurementsError("has no column beside time", where=path, fix="add the signals")
    for i, name in enumerate(names):
        if not name or not name.isprintable():
            raise MeasurementsError(f"column {i + 1} has no name", where=path, fix="name every column")
        if name in names[:i]:
            raise MeasurementsError(f"column '{name}' is there twice", where=path, fix="rename one of the two")
    return names, units


def _read_numbers(text: str, rows: _csv.Reader, names: list[str], path: Path, delimiter: str) -> FloatArray:
    skip = rows.line_num
    n = len(names)
    try:  # NumPy's reader is fast but takes no empty cells and names no column
        with warnings.catch_warnings(action="error"):  # it warns of a file without rows
            values = np.loadtxt(
                io.StringIO(text), delimiter=delimiter, skiprows=skip, ndmin=2, quotechar='"', comments=None
            )
        if values.shape[1] == n:
            return values
    except (ValueError, UserWarning):
        pass
    cells: list[list[float]] = []
    try:
        for row in rows:
            if not any(cell.strip() for cell in row):
                continue
            where = f"{path} line {rows.line_num}"
            if len(row) != n:
                raise MeasurementsError(
                    f"has {len(row)} cells, the header has {n}", where=where, fix="write one cell a column"
                )
            cells.append([_number(cell, name, where) for cell, name in zip(row, names, strict=True)])
    except csv.Error as error:
        raise _malformed(path, rows.line_num, error) from None
    return np.array(cells, dtype=np.float64).reshape(-1, n)


def _number(cell: str, name: str, where: str) -> float:
    text = cell.strip()
    if not text:
        return np.nan
    try:
        return float(text)
    except ValueError:
        fix = "write the decimal point as '.'" if re.fullmatch(r"[-+]?\d+,\d+", text) else "write a number"
        raise MeasurementsError(
            f"'{text[:40]}' in column '{name}' is not a number", where=where, fix=fix
        ) from None


def _malformed(path: Path, line: int, error: csv.Error) -> MeasurementsError:
    return MeasurementsError(f"is not CSV ({error})", where=f"{path} line {line}", fix="correct the quotes")
