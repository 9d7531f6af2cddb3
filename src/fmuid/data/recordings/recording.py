"""The content of a recorded file, and functions shared by the readers."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fmu_build.suggest import suggestion
from fmuid.core.errors import MeasurementsError, UnitError
from fmuid.core.immutable import FloatArray
from fmuid.core.units import conversion
from fmuid.data.crosscheck_csv import Table


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """The signals of one run.

    Parameters
    ----------
    tables
        One table per time base, the one with the most signals first; each name is in one table only.
    notes
        What was left out or detected, one line each.
    """

    tables: tuple[Table, ...]
    notes: tuple[str, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of all signals."""
        return tuple(name for table in self.tables for name in table.columns)

    def only(self, names: Collection[str], path: Path | None = None) -> Recording:
        """Return the recording with only the signals in `names`, all for None; `path` is for errors.

        Raises
        ------
        MeasurementsError
            The recording lacks one of them.
        """
        if not names:
            return self
        for name in names:
            if name not in self.columns:
                raise MeasurementsError(f"has no signal '{name}'", where=path, fix=suggestion(name, self.columns))
        tables = (table.only([n for n in table.columns if n in names]) for table in self.tables)
        return Recording(tuple(t for t in tables if t.columns), self.notes)


@dataclass(frozen=True, slots=True, eq=False)
class Vector:
    """One signal and its time axis as read from a file, (N,) each."""

    name: str
    time: FloatArray
    values: FloatArray
    unit: str | None = None


def by_time_base(vectors: Iterable[Vector], path: Path, notes: Collection[str] = ()) -> Recording:
    """Group vectors into tables, one per time axis.

    Raises
    ------
    MeasurementsError
        There is no vector, or a name appears twice.
    """
    groups: list[list[Vector]] = []
    seen: set[str] = set()
    for vector in vectors:
        if vector.name in seen:
            raise MeasurementsError(
                f"has the signal '{vector.name}' twice", where=path, fix="rename one of the two"
            )
        seen.add(vector.name)
        group = next((g for g in groups if np.array_equal(g[0].time, vector.time)), None)
        if group is None:
            groups.append([vector])
        else:
            group.append(vector)
    if not groups:
        raise MeasurementsError(
            "has no signal over time",
            where=path,
            fix="save a vector 'time' or 't', in s, and signals as long as it",
        )
    groups.sort(key=lambda g: -len(g))
    tables = (
        Table(g[0].time, {v.name: v.values for v in g}, {v.name: v.unit for v in g if v.unit is not None})
        for g in groups
    )
    return Recording(tuple(tables), tuple(notes))


def in_seconds(time: FloatArray, unit: str | None, path: Path) -> FloatArray:
    """Return times in s; raise an error if `unit` is not a unit of time."""
    try:
        return conversion(unit or "s", "s")(time)
    except UnitError as error:
        raise MeasurementsError(
            f"time is in '{unit}', which is not a unit of time ({error.what})", where=path, fix="correct its unit"
        ) from None


def is_numeric(values: Any) -> bool:
    """Return whether `values` is an array of real numbers or truth values."""
    return isinstance(values, np.ndarray) and values.dtype.kind in "fiub"


def left_out(names: Collection[str], why: str) -> tuple[str, ...]:
    """Return the note on unused names."""
    listed = ", ".join(sorted(names)[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "")
    return (f"not used ({why}): {listed}",) if names else ()
