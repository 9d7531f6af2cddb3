"""External functions of the Standard Library: tables in one variable (``ModelicaStandardTables``) and Strings.

The library interpolates in C behind external objects. Here such an object is the record of its arguments, and
reading it is an expression, whose derivatives by the abscissa and by the table's entries are exact.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path

from fmu_build import algebra
from fmu_build.algebra import Array, Scalar, Value, whole
from fmu_build.graph import SX

# Modelica.Blocks.Types.Smoothness; the fourth is monotone by Fritsch and Butland
_LINEAR, _AKIMA, _CONSTANT, _, _STEFFEN, _MAKIMA = range(1, 7)
_HOLD, _LAST_TWO, _PERIODIC = 1, 2, 3  # Modelica.Blocks.Types.Extrapolation
_NO_EVENTS = 3  # Modelica.Blocks.Types.TimeEvents
_INLINE = "NoName"


def _entries(file_name: Value, name: Value, table: Value) -> Value:
    """Entries of a table in the model, or in a text file in the library's format."""
    if name == _INLINE:
        return table
    try:
        text = Path(str(file_name)).read_text(encoding="utf-8")
    except (OSError, ValueError):
        raise ValueError(f"the table '{name}' cannot be read from the text file '{file_name}'") from None
    start = rf"^\s*(?:double|float)\s+{re.escape(str(name))}\s*\((\s*\d+\s*),(\s*\d+\s*)\)"
    head = re.search(start, text, re.MULTILINE)
    if head is None or not text.startswith("#1"):
        raise ValueError(f"'{file_name}' is no text file (#1) with a table '{name}'")
    shape = int(head[1]), int(head[2])
    numbers = re.sub("#.*|[,;]", " ", text[head.end() :]).split()[: shape[0] * shape[1]]
    try:
        entries = tuple(map(float, numbers))
    except ValueError:
        entries = ()
    if len(entries) != shape[0] * shape[1]:
        raise ValueError(f"the table '{name}' in '{file_name}' lacks some of its {shape[0]} x {shape[1]} numbers")
    return Array(shape, entries)


def _make(*arguments: Value) -> Value:
    file_name, table_name, table, _, _, columns, _, smoothness, extrapolation, *_ = arguments
    if whole(extrapolation) not in (_HOLD, _LAST_TWO):
        raise ValueError("tables are extrapolated by HoldLastPoint or LastTwoPoints; others are not supported")
    table = _entries(file_name, table_name, table)
    return {"table": table, "columns": columns, "smoothness": smoothness, "extrapolation": extrapolation}


def _column(table: Value, column: int) -> list[Scalar]:
    if not isinstance(table, Array):
        raise TypeError(f"a table is needed here, not {algebra.kind(table)}")
    return [table[(row, column)] for row in range(table.shape[0])]


def _same(a: Scalar, b: Scalar) -> bool:
    """Whether two abscissae are known to be equal."""
    return not isinstance(a, SX) and not isinstance(b, SX) and a == b


def _akima_slope(modified: bool, a: Scalar, b: Scalar, c: Scalar, d: Scalar) -> Scalar:
    """Slope between the second and the third of four lines: their mean, weighted by how little the others turn.

    H. Akima, A new method of interpolation and smooth curve fitting based on local procedures, J. ACM 17(4), 1970.
    `modified` is C. Ionita's formula of 2019, in which flat lines count as well.
    """
    size = algebra.FUNCTIONS["abs"]
    before, after = size(b - a), size(d - c)
    if modified:
        before, after = before + 0.5 * size(b + a), after + 0.5 * size(d + c)
    straight = algebra.LESS_EQUAL(before + after, 0.0)
    total = algebra.choose(straight, 2.0, before + after)
    weight = algebra.divide(algebra.choose(straight, 1.0, before), total)
    return b + weight * (c - b)


def _monotone_slope(kind: int, a: Scalar, b: Scalar, h: Scalar, k: Scalar) -> Scalar:
    """Slope between two lines of lengths h and k: zero at extrema.

    F. Fritsch, J. Butland, A method for constructing local monotone piecewise cubic interpolants, SIAM Journal on
    Scientific and Statistical Computing 5(2), 1984. M. Steffen, A simple method for monotonic interpolation in one
    dimension, Astronomy and Astrophysics 239, 1990.
    """
    rises = algebra.LESS(0.0, a * b)
    if kind == _STEFFEN:
        size = algebra.FUNCTIONS["abs"]
        steepest = 2.0 * algebra.MIN(size(a), size(b))
        slope = algebra.MAX(-steepest, algebra.MIN(steepest, algebra.divide(a * k + b * h, h + k)))
    else:
        below = algebra.choose(rises, (h + 2.0 * k) * b + (k + 2.0 * h) * a, 1.0)
        slope = 3.0 * (h + k) * a * algebra.divide(b, below)
    return algebra.choose(rises, slope, 0.0)


class _Curve:
    """A column of a table over its abscissae: segments between rows, and beyond the first and the last one."""

    def __init__(self, this: Mapping[str, Value], x: list[Scalar], column: int) -> None:
        self.x, self.y = x, _column(this["table"], whole(algebra.scalars(this["columns"])[column - 1]) - 1)
        self.kind = whole(this["smoothness"])
        if len(x) < 3 and self.kind != _CONSTANT:
            self.kind = _LINEAR
        self._goes_on = whole(this["extrapolation"]) == _LAST_TWO and len(x) > 1
        self.slopes = self._slopes()

    def _slope(self, k: int) -> Scalar:
        """Of the line from row k to the next one; zero where there is a jump."""
        (x, after), (y, end) = self.x[k : k + 2], self.y[k : k + 2]
        return 0.0 if _same(x, after) else algebra.divide(end - y, after - x)

    def _slopes(self) -> list[Scalar]:
        """Slopes of the lines, or of a smooth curve at the rows."""
        lines = [self._slope(k) for k in range(len(self.x) - 1)]
        if self.kind in (_LINEAR, _CONSTANT):
            return lines
        if any(_same(*pair) for pair in pairwise(self.x)):
            raise ValueError("a table with jumps has no smooth interpolation; choose LinearSegments")
        if self.kind in (_AKIMA, _MAKIMA):
            a, b, c, d = *lines[:2], *lines[-2:]
            around = [3 * a - 2 * b, 2 * a - b, *lines, 2 * d - c, 3 * d - 2 * c]
            return [_akima_slope(self.kind == _MAKIMA, *around[k : k + 4]) for k in range(len(self.x))]
        steps = [b - a for a, b in pairwise(self.x)]
        pairs = zip(pairwise(lines), pairwise(steps), strict=True)
        return [lines[0], *(_monotone_slope(self.kind, *two, *long) for two, long in pairs), lines[-1]]

    def segment(self, k: int, at: Scalar) -> Scalar:
        """Value between row k and the next one."""
        y, s, u = self.y[k], self.slopes[k], at - self.x[k]
        if self.kind == _CONSTANT:
            return y
        if self.kind == _LINEAR:
            return y + s * u
        line, length = self._slope(k), self.x[k + 1] - self.x[k]
        bend = algebra.divide(3 * line - 2 * s - self.slopes[k + 1], length)
        twist = algebra.divide(s + self.slopes[k + 1] - 2 * line, length * length)
        return y + ((twist * u + bend) * u + s) * u

    def beyond(self, k: int, at: Scalar) -> Scalar:
        """Value before the first row (k = 0) or after the last one (k = -1)."""
        return self.y[k] + self.slopes[k] * (at - self.x[k]) if self._goes_on else self.y[k]

    def value(self, at: Scalar) -> Scalar:
        """Value anywhere."""
        if self.kind == _LINEAR:
            return self._of_lines(at)
        out: Value = self.beyond(-1, at)
        for k in reversed(range(len(self.x) - 1)):
            out = algebra.choose(algebra.LESS(at, self.x[k + 1]), self.segment(k, at), out)
        return algebra.scalars(algebra.choose(algebra.LESS(at, self.x[0]), self.beyond(0, at), out))[0]

    def _of_lines(self, at: Scalar) -> Scalar:
        """Return a line, plus the change of slope at each row: no search, and continuous in everything."""
        if not self._goes_on:
            at = algebra.MAX(self.x[0], algebra.MIN(self.x[-1], at))
        out = self.y[0] if not self.slopes else self.segment(0, at)
        for start, (before, after) in zip(self.x[1:], pairwise(self.slopes), strict=False):
            out = out + (after - before) * algebra.MAX(0.0, at - start)
        return out


def _value(this: Value, column: Value, u: Value) -> Value:
    if not isinstance(this, dict):
        raise TypeError(f"a table is needed here, not {algebra.kind(this)}")
    return _Curve(this, _column(this["table"], 0), whole(column)).value(algebra.scalars(u)[0])


class _TimeTable:
    """A table over time (CombiTimeTable): an event at each instant, and the segment that ends at the next one.

    Between two events the value is that of one segment, so that a jump of the table falls between two steps of the
    integrator.
    """

    def __init__(self, this: Value) -> None:
        if not isinstance(this, dict):
            raise TypeError(f"a table is needed here, not {algebra.kind(this)}")
        self._this = this
        (shift,) = algebra.scalars(this["shift"])
        (self._start,) = algebra.scalars(this["start"])
        self._instants = [x + shift for x in _column(this["table"], 0)]
        self._periodic = whole(this["extrapolation"]) == _PERIODIC
        self._period = self._instants[-1] - self._instants[0]
        self._rows = [0, *(k + 1 for k, pair in enumerate(pairwise(self._instants)) if not _same(*pair))]

    def _slack(self) -> Scalar:
        """Instants closer than this count as one."""
        return algebra.FUNCTIONS["abs"](self._period) * 1e-10 + 1e-12

    def _turns(self, t: Scalar) -> Scalar:
        """Whole periods before a time."""
        return algebra.FLOOR(algebra.divide(t - self._instants[0], self._period)) if self._periodic else 0

    def next_event(self, t: Scalar) -> Scalar:
        now = t + self._slack()
        offset = self._turns(now) * self._period
        out: Value = self._instants[-1] + offset + self._period if self._periodic else 1e60
        if whole(self._this["events"]) == _NO_EVENTS:
            return 1e60
        for k in reversed(self._rows):
            instant = self._instants[k] + offset
            out = algebra.choose(algebra.LESS(now, instant), instant, out)
        (first,) = algebra.scalars(out)
        chosen = algebra.choose(algebra.LESS(now, self._start), algebra.MIN(self._start, first), first)
        return algebra.scalars(chosen)[0]

    def value(self, column: int, t: Scalar, next_event: Scalar) -> Scalar:
        curve = _Curve(self._this, self._instants, column)
        limit = t if whole(self._this["events"]) == _NO_EVENTS else next_event
        turns = self._turns(limit - self._slack())
        at, end = t - turns * self._period, limit - turns * self._period - self._slack()
        out: Value = curve.beyond(-1, at)
        for k in reversed(self._rows[1:]):
            out = algebra.choose(algebra.LESS_EQUAL(end, self._instants[k]), curve.segment(k - 1, at), out)
        if not self._periodic:
            out = algebra.choose(algebra.LESS_EQUAL(end, self._instants[0]), curve.beyond(0, at), out)
        started = algebra.choose(algebra.LESS(t, self._start), 0.0, out)
        out = algebra.choose(algebra.LESS_EQUAL(limit - self._slack(), self._start), started, out)
        return algebra.scalars(out)[0]


def _make_time_table(*arguments: Value) -> Value:
    file_name, table_name, table, _, _, start, columns, _, smoothness, extrapolation, shift, events, *_ = arguments
    if whole(extrapolation) not in (_HOLD, _LAST_TWO, _PERIODIC):
        raise ValueError("a time table without extrapolation is not supported")
    return {
        "table": _entries(file_name, table_name, table), "columns": columns, "smoothness": smoothness,
        "extrapolation": extrapolation, "start": start, "shift": shift, "events": events,
    }  # fmt: skip


def _time_value(this: Value, column: Value, t: Value, next_event: Value, before: Value) -> Value:  # noqa: ARG001
    return _TimeTable(this).value(whole(column), algebra.scalars(t)[0], algebra.scalars(next_event)[0])


def _next_event(this: Value, t: Value) -> Value:
    return _TimeTable(this).next_event(algebra.scalars(t)[0])


def _limit(row: int) -> Callable[[Value], Value]:
    def limit(this: Value) -> Value:
        if not isinstance(this, dict):
            raise TypeError(f"a table is needed here, not {algebra.kind(this)}")
        return _column(this["table"], 0)[row]

    return limit


def _substring(text: Value, first: Value, last: Value) -> Value:
    return str(text)[whole(first) - 1 : whole(last)]


def _compare(a: Value, b: Value, case_sensitive: Value = True) -> Value:
    """Ordinal of Modelica.Utilities.Types.Compare: Less, Equal, Greater."""
    left, right = (str(a), str(b)) if case_sensitive else (str(a).lower(), str(b).lower())
    return 2 + (left > right) - (left < right)


def _skip_blanks(text: Value, first: Value = 1) -> Value:
    position = whole(first)
    while position <= len(str(text)) and str(text)[position - 1].isspace():
        position += 1
    return position


# By the names of the C functions; init2 is for versions of the library before 4.1.
EXTERNAL: dict[str, Callable[..., Value]] = {
    "ModelicaStrings_length": lambda text: len(str(text)),
    "ModelicaStrings_substring": _substring,
    "ModelicaStrings_compare": _compare,
    "ModelicaStrings_skipWhiteSpace": _skip_blanks,
    "ModelicaStandardTables_CombiTable1D_init2": _make,
    "ModelicaStandardTables_CombiTable1D_init3": _make,
    "ModelicaStandardTables_CombiTimeTable_init2": _make_time_table,
    "ModelicaStandardTables_CombiTimeTable_init3": _make_time_table,
    "ModelicaStandardTables_CombiTimeTable_getValue": _time_value,
    "ModelicaStandardTables_CombiTimeTable_nextTimeEvent": _next_event,
    "ModelicaStandardTables_CombiTimeTable_minimumTime": _limit(0),
    "ModelicaStandardTables_CombiTimeTable_maximumTime": _limit(-1),
    "ModelicaStandardTables_CombiTable1D_getValue": _value,
    "ModelicaStandardTables_CombiTable1D_minimumAbscissa": _limit(0),
    "ModelicaStandardTables_CombiTable1D_maximumAbscissa": _limit(-1),
}
