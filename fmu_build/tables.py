"""External functions of the Standard Library: tables in one variable (``ModelicaStandardTables``) and Strings.

The library interpolates in C behind external objects. Here such an object is the record of its arguments, and
reading it is an expression, whose derivatives by the abscissa and by the table's entries are exact.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

from fmu_build import algebra
from fmu_build.algebra import Array, Scalar, Value, whole
from fmu_build.graph import SX

_LINEAR, _CONSTANT = 1, 3  # Modelica.Blocks.Types.Smoothness
_HOLD, _LAST_TWO, _PERIODIC = 1, 2, 3  # Modelica.Blocks.Types.Extrapolation
_NO_EVENTS = 3  # Modelica.Blocks.Types.TimeEvents
_INLINE = "NoName"


def _make(*arguments: Value) -> Value:
    file_name, table_name, table, _, _, columns, _, smoothness, extrapolation, *_ = arguments
    if file_name != _INLINE or table_name != _INLINE:
        raise ValueError("a table read from a file is not supported")
    if whole(smoothness) not in (_LINEAR, _CONSTANT):
        raise ValueError("tables are interpolated by LinearSegments or ConstantSegments; others are not supported")
    if whole(extrapolation) not in (_HOLD, _LAST_TWO):
        raise ValueError("tables are extrapolated by HoldLastPoint or LastTwoPoints; others are not supported")
    return {"table": table, "columns": columns, "smoothness": smoothness, "extrapolation": extrapolation}


def _column(table: Value, column: int) -> list[Scalar]:
    if not isinstance(table, Array):
        raise TypeError(f"a table is needed here, not {algebra.kind(table)}")
    return [table[(row, column)] for row in range(table.shape[0])]


def _value(this: Value, column: Value, u: Value) -> Value:
    if not isinstance(this, dict):
        raise TypeError(f"a table is needed here, not {algebra.kind(this)}")
    x = _column(this["table"], 0)
    y = _column(this["table"], whole(algebra.scalars(this["columns"])[whole(column) - 1]) - 1)
    (at,) = algebra.scalars(u)
    if whole(this["smoothness"]) == _CONSTANT:
        out: Scalar = y[0]
        for start, step in zip(x[1:], pairwise(y), strict=True):
            out = out + algebra.FUNCTIONS["abs"](algebra.LESS_EQUAL(start, at)) * (step[1] - step[0])
        return out
    if whole(this["extrapolation"]) == _HOLD:
        at = algebra.MAX(x[0], algebra.MIN(x[-1], at))
    # a line, plus the change of slope at each row: no search, and continuous in everything
    slopes = [algebra.divide(b - a, q - p) for (a, b), (p, q) in zip(pairwise(y), pairwise(x), strict=True)]
    out = y[0] if not slopes else y[0] + slopes[0] * (at - x[0])
    for start, (before, after) in zip(x[1:], pairwise(slopes), strict=False):
        out = out + (after - before) * algebra.MAX(0.0, at - start)
    return out


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
        self._rows = [0, *(k for k in range(1, len(self._instants)) if not self._same(k - 1, k))]

    def _same(self, j: int, k: int) -> bool:
        a, b = self._instants[j], self._instants[k]
        return not isinstance(a, SX) and not isinstance(b, SX) and a == b

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
        y = _column(self._this["table"], column)
        limit = t if whole(self._this["events"]) == _NO_EVENTS else next_event
        turns = self._turns(limit - self._slack())
        at, end = t - turns * self._period, limit - turns * self._period - self._slack()
        last = len(y) - 1
        out: Value = self._beyond(y, last - 1 if len(self._rows) > 1 else last, last, at)
        for k in reversed(range(1, len(y))):
            if not self._same(k - 1, k):
                out = algebra.choose(
                    algebra.LESS_EQUAL(end, self._instants[k]), self._segment(y, k - 1, k, at), out
                )
        if not self._periodic:
            before = self._beyond(y, 0, 1 if len(y) > 1 else 0, at, first=True)
            out = algebra.choose(algebra.LESS_EQUAL(end, self._instants[0]), before, out)
        out = algebra.choose(
            algebra.LESS_EQUAL(limit - self._slack(), self._start), self._before_start(out, t), out
        )
        return algebra.scalars(out)[0]

    def _before_start(self, out: Value, t: Scalar) -> Value:
        return algebra.choose(algebra.LESS(t, self._start), 0.0, out)

    def _segment(self, y: list[Scalar], j: int, k: int, t: Scalar) -> Scalar:
        if whole(self._this["smoothness"]) == _CONSTANT:
            return y[j]
        a, b = self._instants[j], self._instants[k]
        return y[j] + algebra.divide(y[k] - y[j], b - a) * (t - a)

    def _beyond(self, y: list[Scalar], j: int, k: int, t: Scalar, first: bool = False) -> Scalar:
        edge = y[j] if first else y[k]
        if whole(self._this["extrapolation"]) != _LAST_TWO or j == k or self._same(j, k):
            return edge
        return edge if whole(self._this["smoothness"]) == _CONSTANT else self._segment(y, j, k, t)


def _make_time_table(*arguments: Value) -> Value:
    file_name, table_name, table, _, _, start, columns, _, smoothness, extrapolation, shift, events, *_ = arguments
    if file_name != _INLINE or table_name != _INLINE:
        raise ValueError("a table read from a file is not supported")
    if whole(smoothness) not in (_LINEAR, _CONSTANT):
        raise ValueError("tables are interpolated by LinearSegments or ConstantSegments; others are not supported")
    if whole(extrapolation) not in (_HOLD, _LAST_TWO, _PERIODIC):
        raise ValueError("a time table without extrapolation is not supported")
    return {
        "table": table, "columns": columns, "smoothness": smoothness, "extrapolation": extrapolation,
        "start": start, "shift": shift, "events": events,
    }  # fmt: skip


def _time_value(this: Value, column: Value, t: Value, next_event: Value, before: Value) -> Value:  # noqa: ARG001
    table = _TimeTable(this)
    assert isinstance(this, dict)
    place = whole(algebra.scalars(this["columns"])[whole(column) - 1]) - 1
    return table.value(place, algebra.scalars(t)[0], algebra.scalars(next_event)[0])


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
