"""The content of a recorded file, and functions shared by the readers."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fmu_build.suggest import known_names, suggestion
from fmuid.core.errors import MeasurementsError
from fmuid.core.immutable import FloatArray
from fmuid.data.crosscheck_csv import (
    PER_MINUTE,
    Table,
    in_seconds,
    name_and_unit,
    per_minute_note,
    time_column,
    two_time_axes,
)
from fmuid.data.table_layout import TableLayout, source_of

_STEPS = ("Ts", "ts", "dt", "Fs", "fs")  # names of a sample time or rate


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


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """Values of a column or vector, and its unit if the file states it."""

    values: FloatArray
    unit: str | None = None


def from_columns(
    columns: Mapping[str, Column], layout: TableLayout, path: Path, *, notes: Collection[str] = ()
) -> Recording:
    """Return the recording in columns, one of which is the time unless the layout gives a rate.

    Columns of another length are left out.

    Raises
    ------
    MeasurementsError
        There is no time, or no column as long as it; or a chosen column is missing.
    """
    if layout.ordered:
        fix = "choose columns: --columns 'w [rad/s]=NAME,...'"
        raise MeasurementsError("has names for its columns", where=path, fix=fix)
    columns = _chosen(columns, layout, path) if layout.chosen else columns
    time_name, time = _times(columns, layout, path)
    fitting = {n: c for n, c in columns.items() if n != time_name and c.values.shape == time.shape}
    others = [n for n in columns if n != time_name and n not in fitting]
    if not fitting:
        raise MeasurementsError(
            f"has no vector as long as '{time_name or 'the others'}' ({time.size})",
            where=path,
            fix="save the signals, N by 1",
        )
    what = f"as long as '{time_name}'" if time_name else f"of {time.size} samples"
    notes = [*notes, *left_out(others, f"not vectors {what}")]
    vectors = []
    for name, column in fitting.items():
        unit = column.unit
        if unit is not None and unit.replace(" ", "") in PER_MINUTE:
            notes.append(per_minute_note(name, unit))
            unit = "rpm"
        vectors.append(Vector(name, time, column.values.astype(np.float64), unit))
    return by_time_base(vectors, path, notes)


def _chosen(columns: Mapping[str, Column], layout: TableLayout, path: Path) -> dict[str, Column]:
    names, chosen = list(columns), dict[str, Column]()
    for header, source in layout.chosen:
        old = columns[names[source_of(source, names, path)]]
        name, unit = name_and_unit(header)
        chosen[name] = Column(old.values, unit or old.unit)
    return chosen


def _times(columns: Mapping[str, Column], layout: TableLayout, path: Path) -> tuple[str | None, FloatArray]:
    """Return the name of the column of times, None for a rate, and the times."""
    name = time_column({n: column.unit for n, column in columns.items()})
    if layout.rate is not None:
        if name is not None:
            raise two_time_axes(name, path)
        sizes = [c.values.size for c in columns.values()]
        if max(sizes, default=0) < 2:
            raise MeasurementsError("has no signal", where=path, fix="save the signals, N by 1")
        return None, np.arange(max(sizes, key=lambda n: (sizes.count(n) if n > 1 else 0, n))) / layout.rate
    if name is None:
        steps = [f" (the file has {n} = {c.values[0]:g})" for n, c in columns.items() if n in _STEPS]
        fix = f"save one, choose one (--columns 'time=NAME,...') or give --rate HZ{''.join(steps[:1])}"
        raise MeasurementsError("has no column 'time' or 't'", where=path, fix=f"{fix}; {known_names(columns)}")
    time = in_seconds(columns[name].values, columns[name].unit, path)
    if time.ndim != 1 or time.size < 2:
        raise MeasurementsError(f"'{name}' is not a vector of times", where=path, fix="save it N by 1, in s")
    return name, time


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


def is_numeric(values: Any) -> bool:
    """Return whether `values` is an array of real numbers or truth values."""
    return isinstance(values, np.ndarray) and values.dtype.kind in "fiub"


def left_out(names: Collection[str], why: str) -> tuple[str, ...]:
    """Return the note on unused names."""
    listed = ", ".join(sorted(names)[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "")
    return (f"not used ({why}): {listed}",) if names else ()
