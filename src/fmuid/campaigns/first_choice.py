"""Choice of free parameters and input interpolation for a first campaign, from its first runs, without fitting."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from fmuid.core.campaign import Interpolation
from fmuid.core.errors import FmuidError, ProblemError, SimulationError
from fmuid.core.experiments import Experiment
from fmuid.core.immutable import FloatArray
from fmuid.core.units import conversion, convertible
from fmuid.identification.solvers.trust_region import trust_region
from fmuid.simulation.runners import Runner, simulated
from fmuid.simulation.segmented import Growth, Segmented, open_loop
from fmuid.simulation.simulator import Simulator, Task, Variable, differentiates

_MAX_RUNS = 3
_MAX_CANDIDATES = 60  # parameters whose effect is simulated
_DRAWN = ("m", "m2", "m3", "rad", "1")  # units of quantities that a drawing shows
_STEP = 0.01  # relative change of a parameter for estimating its effect
_LEAST_NEW = 1e-2  # least share of an effect that parameters chosen before do not explain
_LEAST_EFFECT = 1e-4  # least effect, relative to the largest
_ALL_BUT = 0.99  # relative to the longest column: a column of this length is as good
_SAME = 1e-3  # difference between the FMU's solver and fmuid's, relative to an output's range
_WITHIN = 10.0  # factor by which parameters may differ from their start values, as in a first campaign
_CONVERGED = 1e-2  # relative change of the squared error that ends a refit
_NEARLY = 0.5  # tolerance, in half samples: linear inputs act half a sample earlier than held ones
_CLEARLY = 0.8  # remaining share of the squared error for one interpolation of the inputs to count as better

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
    interpolation
        Interpolation of the inputs between their samples.
    gain
        Factor by which held inputs explain the runs worse than linear ones, if linear was chosen.
    """

    free: tuple[Variable, ...]
    held: Mapping[str, tuple[Variable, ...]]
    interpolation: Interpolation
    gain: float = 1.0


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
    show, it is fixed, because it is known from drawings. Inputs are linear between their samples instead of held
    if that leaves less than four fifths of the squared error after a refit of the free parameters to each run, and
    they seem to act about half a sample earlier; for example if an output responds instantly to an input sampled
    at the same time.
    """
    parameters = [
        v
        for v in model.variables.values()
        if v.causality == "parameter" and v.type in ("Real", "Float64") and v.start is not None
    ]
    candidates = [v for v in parameters if v.start]
    tried = candidates[:_MAX_CANDIDATES]
    seen = [_seen(model, run, mapping, runner) for run in runs[:_MAX_RUNS]]
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
    interpolation, gain = _interpolation(seen, free) if free else ("hold", 1.0)
    return FirstChoice(free, {r: tuple(v) for r, v in held.items() if v}, interpolation, gain)


def solver_error(
    model: Simulator, other: Simulator, run: Experiment, mapping: Mapping[str, str], runner: Runner
) -> float:
    """Return the difference between two simulators of one model.

    For example an FMU's fixed-step solver and one with error control. The difference is the root mean square over
    the range, for the output where it is largest; 0 if it is negligible.
    """
    try:
        one, two = (_seen(each, run, mapping, runner) for each in (model, other))
    except FmuidError:
        return 0.0
    difference = float(np.max(np.sqrt(np.mean(((one.nominal - two.nominal) / one.scale) ** 2, axis=1))))
    return difference if difference > _SAME else 0.0


def runs_away(model: Simulator, runs: Sequence[Experiment], mapping: Mapping[str, str]) -> Growth | None:
    """Return the growth of errors in the longest run if it is too large for an open-loop simulation."""
    run = max(runs, key=lambda run: float(np.ptp(run.time)))
    inputs, measured = _ports(model, run, mapping)
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


class _Seen:
    """A run, with the model's response at the start values; outputs are divided by their ranges.

    Parameters
    ----------
    values
        Values of parameters instead of their start values.
    scale
        Ranges of the outputs; those of the response by default.
    """

    def __init__(
        self,
        model: Simulator,
        task: Task,
        measured: FloatArray,
        runner: Runner,
        *,
        values: Mapping[str, float] | None = None,
        scale: FloatArray | None = None,
    ) -> None:
        self._model, self._task, self._measured, self._runner = model, task, measured, runner
        self._values = values or {}
        self.nominal = simulated(runner, model, task, self._values)
        own = np.maximum(np.ptp(self.nominal, axis=1, keepdims=True), 1e-12)
        self.scale = own if scale is None else scale

    def linear(self) -> _Seen:
        """Return the same run with linear interpolation of its inputs, relative to the same ranges."""
        task = replace(self._task, interpolation="linear")
        return _Seen(self._model, task, self._measured, self._runner, values=self._values, scale=self.scale)

    def _at(self, values: Mapping[str, float]) -> _Seen:
        """Return the same run with these values of parameters, relative to the same ranges."""
        return _Seen(self._model, self._task, self._measured, self._runner, values=values, scale=self.scale)

    def _value(self, parameter: Variable) -> float:
        return self._values.get(parameter.name, parameter.start or 0.0)

    def effects(
        self, parameters: Sequence[Variable], tell: Callable[[], object] | None = None
    ) -> dict[str, FloatArray]:
        """Return the (outputs, N) change of the outputs with each parameter's relative change.

        Redundant parameters look alike as far as derivatives are exact, which differences are not. Structural and
        otherwise delicate parameters, with which the model cannot be simulated, are left out. `tell` is called for
        every parameter.
        """
        exact = [v for v in parameters if differentiates(self._model, [v.name])]
        found: dict[str, FloatArray] = {}
        if exact:
            along = tuple({v.name: self._value(v)} for v in exact)
            with suppress(SimulationError):
                rows = simulated(self._runner, self._model, replace(self._task, along=along), self._values)
                slopes = np.split(rows, len(exact) + 1)[1:]
                found = {v.name: slope / self.scale for v, slope in zip(exact, slopes, strict=True)}
        for parameter in parameters:
            if tell is not None:
                tell()
            if parameter.name not in found:
                with suppress(FmuidError):
                    found[parameter.name] = self._difference(parameter)
        return found

    def _difference(self, parameter: Variable) -> FloatArray:
        own = self._value(parameter)
        above, below = (
            simulated(self._runner, self._model, self._task, {**self._values, parameter.name: own * factor})
            for factor in (1 + _STEP, 1 - _STEP)
        )
        return np.asarray((above - below) / self.scale / (2 * _STEP))

    def refitted(self, free: Sequence[Variable]) -> _Seen:
        """Return the run where these parameters explain it best, each within a factor of ten of its value."""
        start, most = np.zeros(len(free)), np.full(len(free), np.log(_WITHIN))
        known, tried = np.isfinite(self._measured), dict[bytes, _Seen | None]({start.tobytes(): self})

        def at(x: FloatArray) -> _Seen | None:
            if x.tobytes() not in tried:
                values = {v.name: self._value(v) * np.exp(own) for v, own in zip(free, x, strict=True)}
                try:
                    tried[x.tobytes()] = self._at(values)
                except SimulationError:
                    tried[x.tobytes()] = None
            return tried[x.tobytes()]

        def residuals(x: FloatArray) -> FloatArray:
            one = at(x)
            return np.full(int(known.sum()), np.nan) if one is None else one._error()[known]

        def jacobian(x: FloatArray) -> FloatArray:
            return -(at(x) or self)._columns(free)

        trust_region(residuals, jacobian, start, -most, most, cost_tolerance=_CONVERGED, step_tolerance=1e-4)
        return min((one for one in tried.values() if one is not None), key=lambda one: one.left)

    def towards(self, other: _Seen, free: Sequence[Variable]) -> tuple[float, float]:
        """Return the product of the error with the way to another simulation, and the square of that way.

        Of both, only what the parameters cannot imitate counts; the quotient is how far along that way the run is.
        """
        known, columns = np.isfinite(self._measured), self._columns(free)
        way = ((other.nominal - self.nominal) / self.scale)[known]
        way -= columns @ np.linalg.lstsq(columns, way, rcond=None)[0]
        return float(way @ self._error()[known]), float(way @ way)

    def _columns(self, free: Sequence[Variable]) -> FloatArray:
        """Return the changes of the measured samples with each parameter's relative change: 0 where unknown."""
        known, effects = np.isfinite(self._measured), self.effects(free)
        return np.stack([effects.get(v.name, np.zeros_like(self.nominal))[known] for v in free], axis=1)

    @property
    def left(self) -> float:
        """Squared error."""
        return float(np.nansum(self._error() ** 2))

    def _error(self) -> FloatArray:
        return np.asarray((self._measured - self.nominal) / self.scale)


def _ports(
    model: Simulator, run: Experiment, mapping: Mapping[str, str]
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Return the (N,) inputs and measured outputs of a run by the model's variables, in their units."""
    found: tuple[dict[str, FloatArray], dict[str, FloatArray]] = {}, {}
    for name, signal in run.signals.items():
        port = model.variables[mapping.get(name, name)]
        found[signal.causality == "output"][port.name] = conversion(signal.unit, port.unit)(signal.values)
    return found


def _seen(model: Simulator, run: Experiment, mapping: Mapping[str, str], runner: Runner) -> _Seen:
    inputs, measured = _ports(model, run, mapping)
    return _Seen(model, Task(run.time, inputs, tuple(measured)), np.array(list(measured.values())), runner)


def _interpolation(seen: Sequence[_Seen], free: Sequence[Variable]) -> tuple[Interpolation, float]:
    """Return the interpolation of the inputs, and the factor by which the alternative explains the runs worse.

    A missing effect may look like inputs that act earlier, but hardly by the half sample of linear ones.
    """
    try:
        held, on_lines = ([one.refitted(free) for one in s] for s in (seen, [one.linear() for one in seen]))
        products, squares = zip(*(one.towards(one.linear(), free) for one in held), strict=True)
    except FmuidError:
        return "hold", 1.0  # an FMU that does not interpolate its inputs
    worse = sum(one.left for one in held) / max(sum(one.left for one in on_lines), 1e-300)
    earlier = sum(products) / max(sum(squares), 1e-300)  # than held inputs, in half samples
    return ("linear", worse) if worse > 1 / _CLEARLY and abs(earlier - 1.0) < _NEARLY else ("hold", 1.0)
