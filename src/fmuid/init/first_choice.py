"""Choice of free parameters and of the timing of signals for a first campaign, from its first runs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from fmuid.core.campaign import segments_in_toml
from fmuid.core.errors import FmuidError, ProblemError, SimulationError
from fmuid.core.experiments import Experiment
from fmuid.core.immutable import FloatArray
from fmuid.core.toml_tables import toml_text
from fmuid.data.noise.level import GAP_THAT_MATTERS
from fmuid.data.noise.resolution import quantum
from fmuid.data.noise.single_run import single_run_variance
from fmuid.init.known_values import (
    DEFAULT,
    ModelText,
    is_drawn,
    plausible_change,
    table_entries,
    why_known,
)
from fmuid.init.seen_run import in_segments, seen_run
from fmuid.init.timing import Convention, LostRow, chosen, lost_rows, timed, timing_conventions
from fmuid.simulation.runners import Runner
from fmuid.simulation.segmented import Growth, Length, open_loop, states_of
from fmuid.simulation.simulator import Simulator, Variable

_MAX_RUNS = 3
_MAX_CANDIDATES = 60  # parameters whose effect is simulated
_LEAST_NEW = 1e-2  # least share of an effect that parameters chosen before do not explain
_LEAST_EFFECT = 1e-4  # least effect, relative to the largest
_ALL_BUT = 0.99  # relative to the longest column: a column of this length is as good
_DEPENDS = 0.05  # relative change of an estimate with a fixed value
_ELSEWHERE = 10.0  # standard deviations of noise between the first samples of a run and of the model
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
    depends
        Free parameter -> fixed ones on whose values its estimate depends.
    wide
        Free parameters that fits of single runs move by more than a factor of ten.
    """

    free: tuple[Variable, ...]
    held: Mapping[str, tuple[Variable, ...]]
    timing: Convention
    lost: tuple[LostRow, ...] = ()
    depends: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    wide: tuple[str, ...] = ()


def first_choice(
    model: Simulator,
    runs: Sequence[Experiment],
    mapping: Mapping[str, str],
    progress: Callable[[float], None] | None,
    runner: Runner,
    *,
    text: ModelText | None = None,
    cut: Restarts | None = None,
) -> FirstChoice:
    """Choose by the sensitivities of the first three runs at the start values.

    Parameters with independent effects on the outputs are free (QR with column pivoting of the relative
    sensitivities). Lengths and ratios come last: if one is redundant with parameters that only measurements can
    show, it is fixed, because it is known from drawings. Known values are also fixed.
    See `fmuid.init.timing` for the timing of the signals.

    Parameters
    ----------
    text
        The model's source.
    cut
        The segments within which the runs are predicted, if any.
    """
    parameters = [
        v
        for v in model.variables.values()
        if v.causality == "parameter" and v.type in ("Real", "Float64") and v.start is not None
    ]
    known = _known_parameters(parameters, text or ModelText())
    candidates = [v for v in parameters if v.start and v.name not in known]
    tried = candidates[:_MAX_CANDIDATES]
    segments = None if cut is None else cut.length
    seen = [seen_run(model, run, mapping, runner, segments=segments) for run in runs[:_MAX_RUNS]]
    steps, done = len(seen) * len(tried), itertools.count()
    tell = None if progress is None else lambda: progress(next(done) / steps)
    every = [one.effects(tried, tell) for one in seen]
    names = [v.name for v in tried if all(v.name in of_run for of_run in every)]
    changes = {v.name: plausible_change(v) for v in tried}
    effects = {n: np.concatenate([changes[n] * of_run[n].ravel() for of_run in every]) for n in names}
    drawn = {v.name for v in tried if is_drawn(v)}
    free = tuple(model.variables[n] for n in independent_columns(effects, last=drawn))
    held: dict[str, list[Variable]] = {r: [] for r in (EXPLAINED, CONSTRUCTION)}
    least = _LEAST_EFFECT * max((float(np.linalg.norm(e)) for e in effects.values()), default=0.0)
    for variable in parameters:
        if variable not in free:
            reason = known.get(variable.name) or _why_held(variable, effects, least, drawn)
            held.setdefault(reason, []).append(variable)
    of_held = {v.name: effects[v.name] for r in (EXPLAINED, CONSTRUCTION) for v in held[r]}
    depends = dependence({v.name: effects[v.name] for v in free}, of_held)
    timing, lost, wide = Convention("held"), tuple[LostRow, ...](), tuple[str, ...]()
    if free and segments != "auto":
        timing = chosen(timing_conventions(seen, free))
        fits = [timed(one, timing).refitted(free) for one in seen]
        lost = lost_rows(fits, [run.id for run in runs[:_MAX_RUNS]])
        wide = tuple(v.name for v in free if sum(fit.at_bound(v) for fit in fits) > len(fits) / 2)
    return FirstChoice(free, {r: tuple(v) for r, v in held.items() if v}, timing, lost, depends, wide)


def _known_parameters(parameters: Sequence[Variable], text: ModelText) -> dict[str, str]:
    """Return why the values of parameters are known, by name; defaults count only if something else remains."""
    tables = table_entries(parameters)
    known = {v.name: reason for v in parameters if (reason := why_known(v, text, tables)) is not None}
    if any(v.start and v.name not in known for v in parameters):
        return known
    return {name: reason for name, reason in known.items() if reason != DEFAULT}


def _why_held(variable: Variable, effects: Mapping[str, FloatArray], least: float, drawn: Collection[str]) -> str:
    effect = effects.get(variable.name)
    if not variable.start:
        return FROM_ZERO
    if effect is None:
        return NOT_TRIED
    if float(np.linalg.norm(effect)) <= least:
        return NO_EFFECT
    return CONSTRUCTION if variable.name in drawn else EXPLAINED


def dependence(free: Mapping[str, FloatArray], held: Mapping[str, FloatArray]) -> dict[str, tuple[str, ...]]:
    """Return the fixed parameters on which the estimate of each free one depends, by name.

    An estimate depends on a fixed value if it changes by more than a twentieth of the relative change of that
    value when all free parameters are fitted.
    """
    if not free or not held:
        return {}
    columns = np.stack(list(free.values()), axis=1)
    shares = np.linalg.lstsq(columns, np.stack(list(held.values()), axis=1), rcond=None)[0]
    others_of = {
        name: tuple(other for other, share in zip(held, row, strict=True) if abs(share) > _DEPENDS)
        for name, row in zip(free, shares, strict=True)
    }
    return {name: others for name, others in others_of.items() if others}


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
    try:
        whole = in_segments(model, max(runs, key=lambda run: float(np.ptp(run.time))), mapping)
    except ProblemError:  # a model that cannot be started anywhere
        return None
    growth = open_loop(whole)
    return growth if growth is not None and growth.runs_away else None


@dataclass(frozen=True, slots=True)
class Restarts:
    """Estimated start states of runs: the length of segments, and the reason."""

    length: Length
    why: str

    @property
    def line(self) -> str:
        """The line of the campaign."""
        return f"segments = {toml_text(str(segments_in_toml(self.length)))}"

    def __str__(self) -> str:
        """Return a line on the choice."""
        if self.length == "auto":
            return f"runs are cut into segments, because the simulation diverges in open loop ({self.why})"
        return f"the start states of each run are estimated, because {self.why}"


def restarts(
    model: Simulator, runs: Sequence[Experiment], mapping: Mapping[str, str], runner: Runner
) -> tuple[Restarts | None, tuple[str, ...]]:
    """Return how runs start if not as the model says, and a line on it or on why the model cannot follow."""
    away = runs_away(model, runs, mapping)
    if away is not None:
        chosen = Restarts("auto", str(away))
        return chosen, (str(chosen),)
    start = starts_elsewhere(model, runs, mapping, runner)
    if start is None:
        return None, ()
    elsewhere, run, sigmas = start
    try:
        held = [s for s in model.states if s not in states_of(model, whole=True)]
    except ProblemError as error:
        return None, (f"the model cannot start as the runs do: {elsewhere}, but {error.what}",)
    if not start_matters(model, run, mapping, sigmas):
        return None, ()
    chosen = Restarts(math.inf, elsewhere)
    left = f"; {', '.join(held)}, which the FMU calculates, cannot be estimated" if held else ""
    return chosen, (f"{chosen}{left}",)


def start_matters(
    model: Simulator, run: Experiment, mapping: Mapping[str, str], sigmas: Mapping[str, tuple[float, float]]
) -> bool:
    """Return whether a run that starts elsewhere leaves a gap that matters, and does not forget its start at once.

    If not, estimating start states takes several simulations for one, and hardly changes what the run says.
    `sigmas` are the distance of each output's first sample from the model's and the noise.
    """
    with suppress(SimulationError):
        cut = in_segments(model, run, mapping, math.inf)
        apart, noise = np.array([sigmas[n] for n in cut.task.outputs]).T
        moved = cut.state_tangents({}) / noise[:, None]
        moved /= np.maximum(np.sqrt((moved**2).sum(axis=(1, 2), keepdims=True)), 1e-300)
        change, *_ = np.linalg.lstsq(moved[:, :, 0].T, apart / noise, rcond=None)
        left = np.tensordot(change, moved, axes=1)
        return bool(np.sqrt((left**2).mean(axis=1)).max() > GAP_THAT_MATTERS)
    return True


def starts_elsewhere(
    model: Simulator, runs: Sequence[Experiment], mapping: Mapping[str, str], runner: Runner
) -> tuple[str, Experiment, dict[str, tuple[float, float]]] | None:
    """Return in words where a run begins and where the model does, beyond noise and one sample's motion.

    A difference that other values of the parameters could make does not count. Also return the run, and by output
    how far its first sample is from the model's, with the standard deviation of its noise.
    """
    parameters = [v for v in model.variables.values() if v.causality == "parameter" and v.start]
    parameters = [v for v in parameters if v.type in ("Real", "Float64")][:_MAX_CANDIDATES]
    for run in runs[:_MAX_RUNS]:
        one = seen_run(model, run, mapping, runner)
        first, measured = one.nominal[:, :2], one.measured
        apart = np.maximum(first.min(axis=1) - measured[:, 0], measured[:, 0] - first.max(axis=1))
        noise = np.sqrt([single_run_variance([y], quantum(y)) for y in measured])
        far = np.flatnonzero(apart > _ELSEWHERE * noise)
        if not far.size:
            continue
        effects = one.effects(parameters).values()
        reach = one.scale[:, 0] * sum((np.abs(e[:, 0]) for e in effects), start=np.zeros(len(apart)))
        for k in far[apart[far] > reach[far]].tolist():
            name = one.outputs[k]
            unit = model.variables[name].unit or ""
            begins = f"{name} = {measured[k, 0]:.3g} {unit}".rstrip()
            sigmas = dict(zip(one.outputs, zip(measured[:, 0] - first[:, 0], noise, strict=True), strict=True))
            return f"'{run.id}' starts at {begins}, the model at {first[k, 0]:.3g}", run, sigmas
    return None


def independent_columns(columns: Mapping[str, FloatArray], last: Collection[str] = ()) -> list[str]:
    """Return the names of columns that are neither small nor dependent on others, by pivoted QR.

    Names in `last` come last, whatever their size.
    """
    norms = {n: float(np.linalg.norm(c)) for n, c in columns.items()}
    least = _LEAST_EFFECT * max(norms.values(), default=0.0)
    left, chosen = dict(columns), list[str]()
    for group in ([n for n in columns if n not in last], [n for n in columns if n in last]):
        while True:
            lengths = {n: float(np.linalg.norm(left[n])) for n in group if n not in chosen}
            new = {n: x for n, x in lengths.items() if x > max(least, _LEAST_NEW * norms[n])}
            if not new:
                break
            # Of two redundant parameters, equal parts remain; then the first is chosen.
            name = next(n for n, length in new.items() if length >= _ALL_BUT * max(new.values()))
            direction = left[name] / new[name]
            chosen.append(name)
            left = {n: c - (direction @ c) * direction for n, c in left.items()}
    return chosen
