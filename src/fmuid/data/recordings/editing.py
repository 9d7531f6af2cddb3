"""Editing of a recorded run on import: cutting, shifting signals, masking samples by a condition."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fmu_build.suggest import suggestion
from fmuid.core.errors import MeasurementsError, ProblemError
from fmuid.core.formulas import parse
from fmuid.core.immutable import FloatArray
from fmuid.data.crosscheck_csv import Table

_COMPARED = re.compile(r"(?P<left>[^<>=!]+)(?P<sign><=|>=|<|>)(?P<right>[^<>=!]+)")


@dataclass(frozen=True, slots=True)
class Edits:
    """Edits of a run, applied in this order.

    Parameters
    ----------
    shifts
        Seconds by signal: its samples are moved to later times by this much.
    begin, end
        First and last time (s, as in the file) of the samples to keep.
    from_zero
        Whether the time of the first kept sample becomes 0.
    masks
        Conditions such as ``abs(tau) > 40``: where one is true, output samples become missing.
    """

    shifts: Mapping[str, float] = field(default_factory=dict)
    begin: float = -np.inf
    end: float = np.inf
    from_zero: bool = False
    masks: Sequence[str] = ()

    def __call__(self, table: Table, outputs: Sequence[str], where: object) -> Table:
        """Return the table as it is after the edits.

        Parameters
        ----------
        table
            The run.
        outputs
            The signals to which masks apply.
        where
            Place for error messages.

        Raises
        ------
        MeasurementsError
            A signal or a condition is invalid, or fewer than two samples remain.
        """
        time, columns = table.time, dict(table.columns)
        for name, seconds in self.shifts.items():
            _known(name, columns, where)
            known = np.isfinite(columns[name])
            shifted = np.interp(time, time[known] + seconds, columns[name][known])
            there = (time >= time[known][0] + seconds) & (time <= time[known][-1] + seconds)
            columns[name] = np.where(there | (name not in outputs), shifted, np.nan)
        for text in self.masks:
            hidden = _holds(text, columns, time, where)
            columns = {n: np.where(hidden, np.nan, v) if n in outputs else v for n, v in columns.items()}
        kept = (time >= self.begin) & (time <= self.end)
        if np.count_nonzero(kept) < 2:
            raise MeasurementsError(
                f"fewer than two samples lie between {self.begin:g} and {self.end:g} s",
                where=where,
                fix=f"the run lasts from {time[0]:g} to {time[-1]:g} s",
            )
        time = time[kept] - (time[kept][0] if self.from_zero else 0.0)
        return replace(table, time=time, columns={n: v[kept] for n, v in columns.items()})


def _holds(text: str, columns: Mapping[str, FloatArray], time: FloatArray, where: object) -> NDArray[np.bool_]:
    match = _COMPARED.fullmatch(text)
    if match is None:
        raise MeasurementsError(
            f"'{text}' is not a condition", where="--mask", fix='write one such as "abs(tau) > 40"'
        )
    sides = [_evaluated(match[side].strip(), {**columns, "time": time}, where) for side in ("left", "right")]
    with np.errstate(invalid="ignore"):
        compare = {"<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal}[match["sign"]]
        return np.asarray(compare(*sides), dtype=bool)


def _evaluated(text: str, columns: Mapping[str, FloatArray], where: object) -> FloatArray:
    try:
        formula = parse(text)
    except ProblemError as error:
        raise MeasurementsError(error.what, where="--mask", fix=error.fix) from None
    for name in formula.names:
        _known(name, columns, where)
    return formula.of_samples(columns)


def _known(name: str, columns: Mapping[str, FloatArray], where: object) -> None:
    if name not in columns:
        raise MeasurementsError(f"has no signal '{name}'", where=where, fix=suggestion(name, columns))
