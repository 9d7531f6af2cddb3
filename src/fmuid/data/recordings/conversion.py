"""Conversion of recorded runs to measurement files and back."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fmu_build.suggest import suggestion
from fmuid.core.errors import MeasurementsError, UnitError
from fmuid.core.experiments import NEAR_TIMES, SAME_TIMES, Causality, Experiment, Measurements, Signal
from fmuid.core.immutable import FloatArray
from fmuid.core.units import check_unit
from fmuid.data.crosscheck_csv import Table
from fmuid.data.noise.resolution import quantum
from fmuid.data.noise.single_run import fast_variance
from fmuid.data.recordings import read_recording
from fmuid.data.recordings.dataframe import from_frame
from fmuid.data.recordings.resampling import TimeBase, aliased, one_time_base
from fmuid.data.table_layout import TableLayout

_MOST_STEPS = 0.25  # share of rows at the time of another one: more are times without enough digits
_SAME_TIME = 1e-9  # of the usual step: times that differ by less are one time, rounded
_STEP_APART = 1e-3  # of the shortest step: the distance of the two rows of a step
_NEARLY = 0.05  # of a signal's standard deviation
_SEEN = 4.0  # standard deviations of noise by which two runs begin apart: one false alarm in 10,000
_TENTHS = 10  # parts of a run
_STEADY = 0.9  # share of a fall in what a course moves: a random walk from far away falls so once in 250 times
_GONE = 16.0  # ratio of energies: that of a random walk from anywhere exceeds it once in 60 times
_UNUSUAL = 4.0  # ratio of energies: twice the usual difference
_APART = 0.5  # of a column's standard deviation over all runs: nearer than that, it tells little of a difference


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A recorded run on one time base; `resampled` says how signals were resampled, `notes` what was detected."""

    table: Table
    resampled: Mapping[str, str]
    notes: tuple[str, ...]


def read_run(
    log: Path | Any,
    signals: Collection[str] = (),
    base: TimeBase | None = None,
    layout: TableLayout | None = None,
    *,
    name: str = "",
) -> Run:
    """Read one run from a file or data frame called `name`, and resample it to one time base as `base` says.

    Two rows at one time are a step: the second one is moved to a later time by a thousandth of the shortest step.

    Raises
    ------
    MeasurementsError
        As for `fmuid.data.recordings.read_recording` and `fmuid.data.recordings.resampling.one_time_base`.
    """
    path = log if isinstance(log, Path) else Path(name)
    if log is path:
        recording = read_recording(path, signals, layout)
    else:
        recording = from_frame(log, name, layout or TableLayout()).only(signals, path)
    table, resampled = one_time_base(recording, base, path)
    table, steps = _with_steps_apart(table, path)
    notes = [*recording.notes, *steps, *(f"'{name}' resampled: {how}" for name, how in resampled.items())]
    fast = aliased(table, recording, base) if base is not None else ()
    if fast:
        notes.append(
            f"{', '.join(fast)}: sampled more slowly than recorded; if they contain frequencies above half the"
            " new rate, --method mean averages them out"
        )
    return Run(table, resampled, tuple(notes))


def _with_steps_apart(table: Table, path: Path) -> tuple[Table, list[str]]:
    """Return the table with distinct times, and a note if two rows at one time became a step.

    Of more than two rows at one time, the first and the last are kept; of equal rows, the first.
    """
    time = table.time
    steps = np.diff(time)
    least = _SAME_TIME * float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    same = (steps >= 0.0) & (steps <= least)
    if not same.any():
        return table, []
    if np.mean(same) > _MOST_STEPS:
        raise MeasurementsError(
            f"{int(same.sum()) + 1} of {time.size} rows have the time of another row",
            where=path,
            fix="write times with more digits, or choose the other columns (--columns) and give --rate",
        )
    follows, precedes = np.append(False, same), np.append(same, False)
    keep = ~(follows & precedes)
    values = np.column_stack(list(table.columns.values()))
    first = np.flatnonzero(keep & ~follows)
    begins = first[np.searchsorted(first, np.arange(time.size), side="right") - 1]
    keep &= ~follows | ~np.all((values == values[begins]) | (np.isnan(values) & np.isnan(values[begins])), axis=1)
    moved = keep & follows
    later = time + np.where(moved, _STEP_APART * float(np.min(steps[~same])), 0.0)
    apart = replace(table, time=later[keep], columns={n: v[keep] for n, v in table.columns.items()})
    count = int(moved.sum())
    note = f"{count} time{'s' if count > 1 else ''} with two rows: the second row is a step right after the first"
    return apart, [note] if count else ["repeated rows are left out"]


def experiment_from_table(
    table: Table,
    *,
    id: str,
    setup: str,
    inputs: Collection[str],
    units: Mapping[str, str] | None = None,
    sigmas: Mapping[str, float] | None = None,
    settings: Mapping[str, float] | None = None,
    setting_units: Mapping[str, str] | None = None,
    resampled: Mapping[str, str] | None = None,
) -> Experiment:
    """Return one run from a table whose columns are its signals.

    Parameters
    ----------
    table
        Time and signals; units may be in its header.
    id, setup
        Id of the run and the setup it was made with.
    inputs
        Names of the columns that drive the model; the others are outputs.
    units, sigmas
        Units (these win over the header's) and noise standard deviations by column.
    settings, setting_units
        Values that the run sets on the model, and their units.
    resampled
        Resampling notes, for columns that were not recorded on the run's time base.

    Raises
    ------
    MeasurementsError
        A name is not a column, or a column has no unit.
    """
    units, sigmas, resampled = units or {}, sigmas or {}, resampled or {}
    for what, names in (("input", inputs), ("unit", units), ("sigma", sigmas)):
        for name in names:
            if name not in table.columns:
                raise MeasurementsError(
                    f"no column '{name}' ({what})", where=id, fix=suggestion(name, table.columns)
                )
    signals: dict[str, Signal] = {}
    for name, values in table.columns.items():
        unit = units.get(name, table.units.get(name))
        if unit is None:
            raise MeasurementsError(
                f"column '{name}' has no unit",
                where=id,
                fix=f'write it in the header as "{name} [N.m]", or give --unit {name}=N.m (1 for none)',
            )
        causality: Causality = "input" if name in inputs else "output"
        try:
            check_unit(unit)
        except UnitError as error:
            raise MeasurementsError(f"column '{name}': {error.what}", where=id, fix=error.fix) from None
        signals[name] = Signal(name, values, unit, causality, sigmas.get(name), resampled.get(name, ""))
    return Experiment(id, setup, table.time, signals, settings or {}, setting_units or {})


def further_runs(logs: Sequence[Path], known: Measurements) -> Measurements:
    """Read further runs of a known rig from logs with the same columns; units that they do not state are known.

    Parameters
    ----------
    logs
        One file a run; its name is the run's id.
    known
        Earlier runs: their signals, and the setup, settings and machine if these are the same for all.

    Raises
    ------
    MeasurementsError
        A log cannot be read or lacks an input or every output, or the earlier runs differ in setup, settings or
        machine.
    """
    first, *others = known
    for other in others:
        for what in ("setup", "settings", "machine"):
            if getattr(other, what) != getattr(first, what):
                fix = "import the logs with fmuid import, and give the measurement file"
                raise MeasurementsError(f"the campaign's runs differ in {what}", where=logs[0], fix=fix)
    signals = {name: signal for run in reversed([*known]) for name, signal in run.signals.items()}
    experiments: dict[str, Experiment] = {}
    for log in logs:
        if log.stem in experiments:
            raise MeasurementsError(f"a run '{log.stem}' already exists", where=log, fix="rename the file")
        run = read_run(log)
        table = run.table
        used = [name for name in table.columns if name in signals]
        if lacking := [name for name in first.inputs if name not in used]:
            fix = suggestion(lacking[0], table.columns)
            raise MeasurementsError(f"has no input '{lacking[0]}'", where=log, fix=fix)
        if not set(used) - first.inputs.keys():
            fix = f"it needs at least one of {', '.join(n for n in signals if n not in first.inputs)}"
            raise MeasurementsError("has no output of the campaign", where=log, fix=fix)
        made = experiment_from_table(
            Table(table.time, {n: table.columns[n] for n in used}, {}),
            id=log.stem,
            setup=first.setup,
            inputs=first.inputs,
            units={n: table.units.get(n) or signals[n].unit for n in used},
            sigmas={n: s for n in used if (s := signals[n].sigma) is not None},
            settings=first.settings,
            setting_units=first.setting_units,
            resampled=run.resampled,
        )
        unused = {n: replace(s, values=table.columns[n]) for n, s in first.unused.items() if n in table.columns}
        experiments[made.id] = replace(made, machine=first.machine, unused=unused)
    return replace(known, experiments=with_repeats(experiments))


def with_repeats(experiments: Mapping[str, Experiment]) -> dict[str, Experiment]:
    """Return the experiments, with each run marked as a repeat of an earlier run that has the same inputs.

    Clocks may begin at any time. A run whose inputs differ from an earlier one's by less than 5 % of their
    standard deviation, or whose sampling has jitter, repeats its reference: the two say hardly more than one of
    them about what the model gets wrong. But where outputs differ by more than noise and the logs show a reason,
    because the runs begin elsewhere or under other conditions, the difference is no noise. Noise is fast, or as
    large as between runs that differ without a reason.
    """
    every = list(experiments.values())
    conditions = {n for e in every for n, s in e.unused.items() if not _counts(s.values)}
    courses = {n: np.concatenate([e.unused[n].values for e in every if n in e.unused]) for n in conditions}
    spread = {n: float(np.nanstd(values)) for n, values in courses.items() if np.isfinite(values).any()}

    def reason(a: Experiment, b: Experiment) -> bool:
        return _begin_apart(a, b) or _conditions_differ(a, b, spread)

    slow: dict[str, list[float]] = {}
    for k, b in enumerate(every):
        a = next((e for e in every[:k] if _same_run(e, b, within=_NEARLY)), None)
        for name, (x, y) in ({} if a is None or reason(a, b) else _shared(a.outputs, b.outputs)).items():
            slow.setdefault(name, []).append(float(np.mean((x - y) ** 2)))
    usual = {name: float(np.median(of_pairs)) for name, of_pairs in slow.items()}

    def repeats(a: Experiment, b: Experiment, within: float) -> bool:
        return _same_run(a, b, within=within) and not (_outputs_differ(a, b, usual) and reason(a, b))

    marked: dict[str, Experiment] = {}
    for experiment in every:
        firsts = [e for e in marked.values() if not e.repeats_another]
        same = next((e.id for e in firsts if repeats(e, experiment, 0.0)), None)
        near = None if same else next((e.id for e in firsts if repeats(e, experiment, _NEARLY)), None)
        marked[experiment.id] = replace(experiment, repeat_of=same, repeat_of_reference=near)
    return marked


def _shared(a: Mapping[str, Signal], b: Mapping[str, Signal]) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return the samples that two runs both have of each signal."""
    shared = {}
    for name, signal in a.items():
        if name in b:
            x, y = signal.values, b[name].values
            there = np.isfinite(x) & np.isfinite(y)
            if there.any():
                shared[name] = x[there], y[there]
    return shared


def _outputs_differ(a: Experiment, b: Experiment, usual: Mapping[str, float]) -> bool:
    """Return whether outputs of two runs differ by twice the energy of their fast noise, and unusually."""
    return any(
        np.mean((x - y) ** 2) > max(2.0 * _noise(x, y), _UNUSUAL * usual.get(name, 0.0))
        for name, (x, y) in _shared(a.outputs, b.outputs).items()
    )


def _begin_apart(a: Experiment, b: Experiment) -> bool:
    """Return whether outputs of two runs begin apart, and approach each other.

    They begin apart by more than their noise, and than 5 % of what they move. Slow noise comes and goes.
    """
    return any(
        (x[0] - y[0]) ** 2 > _SEEN**2 * _noise(x, y) + (_NEARLY * max(np.std(x), np.std(y))) ** 2 and _fades(x - y)
        for x, y in _shared(a.outputs, b.outputs).values()
    )


def _fades(difference: FloatArray) -> bool:
    """Return whether a course is largest in its first tenth and falls steadily, or is gone in its second half."""
    tenths = np.array_split(difference, _TENTHS)
    means = np.array([np.mean(tenth) for tenth in tenths])
    steady = abs(means[0] - means[-1]) > _STEADY * np.sum(np.abs(np.diff(means)))
    gone = np.mean(tenths[0] ** 2) > _GONE * np.mean(difference[len(difference) // 2 :] ** 2)
    return bool((steady and np.argmax(np.abs(means)) == 0) or gone)


def _conditions_differ(a: Experiment, b: Experiment, spread: Mapping[str, float]) -> bool:
    """Return whether columns that the model does not use differ by half of their `spread` over all runs."""
    return any(
        np.mean((x - y) ** 2) > _noise(x, y) + (_APART * spread[name]) ** 2
        for name, (x, y) in _shared(a.unused, b.unused).items()
        if name in spread
    )


def _noise(x: FloatArray, y: FloatArray) -> float:
    """Return the variance of the difference of two signals due to fast noise."""
    return sum(fast_variance([v], quantum(v)) + quantum(v) ** 2 / 12.0 for v in (x, y))


def _counts(values: FloatArray) -> bool:
    """Return whether a column only rises or only falls, as clocks and counters do."""
    steps = np.diff(values)
    return bool(np.all(steps >= 0.0) or np.all(steps <= 0.0))


def table_from_experiment(experiment: Experiment) -> Table:
    """Return a run's signals as a table with units."""
    return Table(
        experiment.time,
        {name: signal.values for name, signal in experiment.signals.items()},
        {name: signal.unit for name, signal in experiment.signals.items()},
    )


def _same_run(a: Experiment, b: Experiment, *, within: float = 0.0) -> bool:
    """Return whether two runs agree, their inputs `within` a share of their standard deviations (RMS)."""
    jitter = NEAR_TIMES if within else SAME_TIMES
    return (
        a.setup == b.setup
        and dict(a.settings) == dict(b.settings)
        and b.sampled_like(a, within=jitter)
        and bool(a.inputs)
        and a.inputs.keys() == b.inputs.keys()
        and all(_same_course(s.values, b.inputs[n].values, within) for n, s in a.inputs.items())
    )


def _same_course(a: FloatArray, b: FloatArray, within: float) -> bool:
    if within == 0.0:
        return np.array_equal(a, b)
    return bool(np.sqrt(np.mean((a - b) ** 2)) <= within * np.std(a))
