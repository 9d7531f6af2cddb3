"""Names of the columns of a file, and its sampling rate, as the user gives them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from fmu_build.suggest import suggestion
from fmuid.core.errors import MeasurementsError

_CHOSEN = re.compile(r"(?P<header>[^=]*[^=\s])\s*=\s*(?P<source>[^=\s][^=]*)")


@dataclass(frozen=True, slots=True)
class TableLayout:
    """The columns of a file without a usable header, and its rate if it has no time.

    Parameters
    ----------
    columns
        Headers in the file's order, as in ``tau [N.m]``; or chosen columns, each as ``HEADER=SOURCE``. A source is
        the column's name or its number from 1, and for a matrix in a MATLAB file ``data[4]``.
    rate
        Samples per second of a file without times; the first sample is at 0 s.

    Raises
    ------
    MeasurementsError
        Only some columns have a source, or the rate is not positive.
    """

    columns: tuple[str, ...] = ()
    rate: float | None = None

    def __post_init__(self) -> None:
        chosen = [c for c in self.columns if _CHOSEN.fullmatch(c)]
        if chosen and len(chosen) < len(self.columns):
            plain = next(c for c in self.columns if c not in chosen)
            fix = f"write HEADER=SOURCE for every column, as in '{chosen[0]}'"
            raise MeasurementsError(f"'{plain}' has no source", where="--columns", fix=fix)
        if self.rate is not None and not 0 < self.rate < float("inf"):
            raise MeasurementsError(
                f"{self.rate:g} is not a rate", where="--rate", fix="give samples per second, such as 1000"
            )

    @property
    def ordered(self) -> tuple[str, ...]:
        """The headers in the file's order; empty if columns are chosen or the file's own headers are used."""
        return () if self.chosen else self.columns

    @property
    def chosen(self) -> tuple[tuple[str, str], ...]:
        """Header and source of each chosen column."""
        matches = (_CHOSEN.fullmatch(column) for column in self.columns)
        return tuple((m["header"].strip(), m["source"].strip()) for m in matches if m is not None)


def source_of(source: str, names: Sequence[str], where: object) -> int:
    """Return the position of the column with this name, or else with this number from 1.

    Raises
    ------
    MeasurementsError
        There is no such column.
    """
    if source in names:
        return names.index(source)
    if source.isdecimal() and 1 <= int(source) <= len(names):
        return int(source) - 1
    fix = f"it has {len(names)}" if source.isdecimal() else suggestion(source, names)
    raise MeasurementsError(f"has no column '{source}'", where=where, fix=fix)
