"""The Standard Library's tables in one variable (``ModelicaStandardTables``), as symbolic expressions.

The library interpolates in C behind external objects. Here such an object is the record of what it was made with,
and reading it is an expression, whose derivatives by the abscissa and by the table's entries are exact.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

from fmu_build import algebra
from fmu_build.algebra import Array, Scalar, Value, whole

_LINEAR, _CONSTANT = 1, 3  # Modelica.Blocks.Types.Smoothness
_HOLD, _LAST_TWO = 1, 2  # Modelica.Blocks.Types.Extrapolation
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
    # a line, and what each row adds to its slope: no search, and continuous in everything
    slopes = [algebra.divide(b - a, q - p) for (a, b), (p, q) in zip(pairwise(y), pairwise(x), strict=True)]
    out = y[0] if not slopes else y[0] + slopes[0] * (at - x[0])
    for start, (before, after) in zip(x[1:], pairwise(slopes), strict=False):
        out = out + (after - before) * algebra.MAX(0.0, at - start)
    return out


def _limit(row: int) -> Callable[[Value], Value]:
    def limit(this: Value) -> Value:
        if not isinstance(this, dict):
            raise TypeError(f"a table is needed here, not {algebra.kind(this)}")
        return _column(this["table"], 0)[row]

    return limit


# By the names of the C functions; init2 is that of versions before 4.1 of the library.
EXTERNAL: dict[str, Callable[..., Value]] = {
    "ModelicaStandardTables_CombiTable1D_init2": _make,
    "ModelicaStandardTables_CombiTable1D_init3": _make,
    "ModelicaStandardTables_CombiTable1D_getValue": _value,
    "ModelicaStandardTables_CombiTable1D_minimumAbscissa": _limit(0),
    "ModelicaStandardTables_CombiTable1D_maximumAbscissa": _limit(-1),
}
