"""Choice of free parameters and of the timing of signals for a first campaign, from its first runs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fmuid.campaigns.seen_run import ports_of, seen_run
from fmuid.campaigns.timing import Convention, LostRow, chosen, lost_rows, timed, timing_conventions
from fmuid.core.errors import FmuidError, ProblemError
from fmuid.core.experiments import Experiment
from fmuid.core.immutable import FloatArray
from fmuid.core.units import convertible
from fmuid.simulation.runners import Runner
from fmuid.simulation.segmented import Growth, Segmented, open_loop
from fmuid.simulation.simulator import Simulator, Task, Variable

_MAX_RUNS = 3
_MAX_CANDIDATES = 60  # parameters whose effect is simulated
_DRAWN = ("m", "m2", "m3", "rad", "1")  # units of quantities that a drawing shows
_LEAST_NEW = 1e-2  # least share of an effect that parameters chosen before do not explain
_LEAST_EFFECT = 1e-4  # least effect, relative to the largest
_ALL_BUT = 0.99  # relative to the longest column: a column of this length is as good
_SAME = 1e-3  # difference between the FMU's solver and fmuid's, relative to an output's range

NO_EFFECT = "does not affect any measured output"
EXPLAINED = "redundant with the free parameters; if you know one of those, fix it instead"
CONSTRUCTION = "redundant with the free parameters; a dimension or ratio, which is known from a drawing"
FROM_ZERO = "starts at 0, so no bounds can be guessed"
NOT_TRIED = "not tried"


@dataclass(frozen=True, slots=True)
class FirstChoice:
    """The choices for a first campaign.

    Parameters
    ----------
    free
        Free parameters, the most influential first, lengths and ratios last.
    held
        Reason -> parameters that are fixed at the FMU's value for this reason.
    timing
        Timing of the signals.
    lost
        Rows that logs seem to have lost.
    """

    free: tuple[Variable, ...]
    held: Mapping[str, tuple[Variable, ...]]
    timing: Convention
    lost: tuple[LostRow, ...] = ()


def first_choice(
    model: Simulator,
    runs: Sequence[Experiment],
    mapping: Mapping[str, str],
    progress: Callable[[float], None] | None,
    runner: Runner,
) -> FirstChoice:
    """Choose by the sensitivities of the first three runs at the start values.

    Parameters with independent effects on the outputs are free (QR with column pivoting of the relative
    sensitivities). Lengths and ratios come last: if one is redundant with parameters that only measurements can
    show, it is fixed, because it is known from drawings. See `fmuid.campaigns.timing` for the
    timing of the signals.
    """
    parameters = [
        v
        for v in model.variables.values()
        if v.causality == "parameter" and v.type in ("Real", "Float64") and v.start is not None
    ]
    candidates = [v for v in parameters if v.start]
    tried = candidates[:_MAX_CANDIDATES]
    seen = [seen_run(model, run, mapping, runner) for run in runs[:_MAX_RUNS]]
    steps, done = len(seen) * len(tried), itertools.count()
    tell = None if progress is None else lambda: progress(next(done) / steps)
    every = [one.effects(tried, tell) for one in seen]
    names = [v.name for v in tried if all(v.name in own for own in every)]
    effects = {name: np.concatenate([own[name].ravel() for own in every]) for name in names}
    drawn = {v.name for v in tried if is_drawn(v)}
    free = tuple(model.variables[n] for n in independent_columns(effects, last=drawn))
    held: dict[str, list[Variable]] = {r: [] for r in (EXPLAINED, CONSTRUCTION, NO_EFFECT, NOT_TRIED, FROM_ZERO)}
    least = _LEAST_EFFECT * max((float(np.linalg.norm(e)) for e in effects.values()), default=0.0)
    for variable in parameters:
        if variable in free:
            continue
        effect = effects.get(variable.name)
        if not variable.start:
            reason = FROM_ZERO
        elif effect is None:
            reason = NOT_TRIED
        elif float(np.linalg.norm(effect)) <= least:
            reason = NO_EFFECT
        else:
            reason = CONSTRUCTION if variable.name in drawn else EXPLAINED
        held[reason].append(variable)
    timing, lost = Convention("held"), tuple[LostRow, ...]()
    if free:
        timing = chosen(timing_conventions(seen, free))
        lost = lost_rows([timed(one, timing) for one in seen], [run.id for run in runs[:_MAX_RUNS]], free)
    return FirstChoice(free, {r: tuple(v) for r, v in held.items() if v}, timing, lost)


def solver_error(
    model: Simulator, other: Simulator, run: Experiment, mapping: Mapping[str, str], runner: Runner
) -> float:
    """Return the difference between two simulators of one model.

    For example an FMU's fixed-step solver and one with error control. The difference is the root mean square over
    the range, for the output where it is largest; 0 if it is negligible.
    """
    try:
        one, two = (seen_run(each, run, mapping, runner) for each in (model, other))
    except FmuidError:
        return 0.0
    difference = float(np.max(np.sqrt(np.mean(((one.nominal - two.nominal) / one.scale) ** 2, axis=1))))
    return difference if difference > _SAME else 0.0


def runs_away(model: Simulator, runs: Sequence[Experiment], mapping: Mapping[str, str]) -> Growth | None:
    """Return the growth of errors in the longest run if it is too large for an open-loop simulation."""
    run = max(runs, key=lambda run: float(np.ptp(run.time)))
    inputs, measured = ports_of(model, run, mapping)
    task = Task(run.time, inputs, tuple(measured))
    values = np.array(list(measured.values()))
    try:
        whole = Segmented(model, task, "auto", target=values, weight=np.isfinite(values).astype(np.float64), at={})
    except ProblemError:  # a model that cannot be started anywhere
        return None
    found = open_loop(whole)
    return found if found is not None and found.runs_away else None


def is_drawn(parameter: Variable) -> bool:
    """Return whether a parameter is a length, an area, a volume, an angle or a plain number.

    Elements of tables, such as the efficiencies in a gear's loss table, are none of these.
    """
    if "," in parameter.name:
        return False
    return parameter.unit is None or any(convertible(parameter.unit, unit) for unit in _DRAWN)


def independent_columns(columns: Mapping[str, FloatArray], last: Collection[str] = ()) -> list[str]:
    """Return the names of columns that are neither small nor dependent on others, by pivoted QR.

    Names in `last` come last, whatever their size.
    """
    own = {n: float(np.linalg.norm(c)) for n, c in columns.items()}
    least = _LEAST_EFFECT * max(own.values(), default=0.0)
    left, chosen = dict(columns), list[str]()
    for group in ([n for n in columns if n not in last], [n for n in columns if n in last]):
        while True:
            lengths = {n: float(np.linalg.norm(left[n])) for n in group if n not in chosen}
            new = {n: x for n, x in lengths.items() if x > max(least, _LEAST_NEW * own[n])}
            if not new:
                break
            # Of two redundant parameters, equal parts remain; then the first is chosen.
            name = next(n for n, length in new.items() if length >= _ALL_BUT * max(new.values()))
            direction = left[name] / new[name]
            chosen.append(name)
            left = {n: c - (direction @ c) * direction for n, c in left.items()}
    return chosen
