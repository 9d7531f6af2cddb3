"""The models of a campaign with effects: predictions, and their slopes by the parameters."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from fmuid.core.campaign import SEPARATOR, without_owner
from fmuid.core.errors import SimulationError
from fmuid.core.formulas import Expression
from fmuid.core.immutable import FloatArray
from fmuid.data.noise.runs import RepeatedRuns
from fmuid.diagnosis.observed import Observed, squares_finite
from fmuid.effects.effect import Unknown
from fmuid.identification.problem.cases import Case
from fmuid.simulation.band_limited import refined
from fmuid.simulation.predictor import Predictor
from fmuid.simulation.runners import Job, Outcome, Runner, in_process
from fmuid.simulation.segmented import Segmented, in_place_of
from fmuid.simulation.signal_effects import (
    Disturbed,
    Effects,
    disturbed_readings,
    disturbed_task,
    effects_on_simulation,
    split_signal_parameters,
)
from fmuid.simulation.signal_model import SignalModel
from fmuid.simulation.simulator import Simulator, Task

Prediction = tuple[FloatArray, ...]
"""(C, N) predicted signals, one array per experiment."""

_HELD = 0.03  # share of the range by which a held course has to change: the integral of the input stays the same
_LINED = 0.1  # of one between lines, which follow it more closely
_WIDTH = 1e-4  # relative width of differences around a simulation, for ties and sensors
_POSED = 8  # tasks with disturbed signals that are kept for each case: those of a Jacobian
Direction = tuple[dict[str, float], float]
"""How a model's variables move with one parameter: their proportions, and the size of the move."""
_Values = frozenset[tuple[str, float]]
_Key = tuple[int, float | None, _Values, tuple[tuple[str, bytes], ...], _Values]


@dataclass(frozen=True, slots=True, eq=False)
class _Wanted:
    """A prediction of a case, by its number, at some values, with further inputs driven; see `predict`."""

    index: int
    case: Case
    values: Mapping[str, float]
    drive: Mapping[str, Sequence[FloatArray]] | None = None
    near: Mapping[str, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Differentiated:
    """Runs that give tangents; per parameter, its difference and end points.

    Per run, the directions moved, and the effects on signals outside its simulator.
    """

    jobs: Sequence[Job] = ()
    names: Sequence[str] = ()
    widths: Sequence[float] = ()
    ends: Sequence[Sequence[Mapping[str, float]]] = ()
    moves: Sequence[Sequence[Direction]] = ()
    outside: Sequence[tuple[Effects, Disturbed | None]] = ()


@dataclass(frozen=True, eq=False)
class CampaignModel:
    """Cases simulated together.

    Parameters
    ----------
    cases
        One case per experiment.
    runner
        Runner of the simulations.
    fixed
        Fixed parameter values, by name.
    tie
        Model variables that are expressions of campaign parameters.
    variant
        Function of setup and values that returns the model with effects that are only built when tried, or None.
    finer
        Solver tolerances by case id that points need which name certain parameters, such as an effect's.
    """

    cases: tuple[Case, ...]
    runner: Runner = in_process
    fixed: Mapping[str, float] = field(default_factory=dict)
    tie: Mapping[str, Expression] = field(default_factory=dict)
    variant: Callable[[str, Mapping[str, float]], Simulator | None] = lambda _, __: None
    finer: Mapping[frozenset[str], Mapping[str, float]] = field(default_factory=dict)
    _predictor: Predictor[_Key] = field(default_factory=Predictor, init=False, repr=False)
    _posed: OrderedDict[object, tuple[Disturbed | None, Task]] = field(
        default_factory=OrderedDict, init=False, repr=False
    )
    _sensing: dict[tuple[int, tuple[str, ...]], Segmented] = field(default_factory=dict, init=False, repr=False)
    _finer_cases: dict[tuple[int, float], Case] = field(default_factory=dict, init=False, repr=False)

    @property
    def runs(self) -> tuple[RepeatedRuns, ...]:
        """Measured runs, in the model's units."""
        return tuple(
            RepeatedRuns(
                case.id,
                case.setup,
                case.time,
                tuple(c.signal for c in case.channels),
                np.stack([c.repeats for c in case.channels], axis=1),
                np.array([c.noise.sigma if c.noise.source == "given" else np.nan for c in case.channels]),
                _conditions(case),
            )
            for case in self.cases
        )

    def predict(
        self, points: Sequence[Mapping[str, float]], near: Mapping[str, float] | None = None
    ) -> list[Prediction | SimulationError]:
        """Return the prediction of every point, or the error for a point without one.

        Segments of the runs begin in the states that fit at the point, or at `near`: what follows from a change of
        the states is then missing, which nuisances project off.
        """
        return self._simulate([(point, None) for point in points], near)

    def predict_driven(
        self, values: Mapping[str, float], drives: Sequence[Mapping[str, Sequence[FloatArray]]]
    ) -> list[Prediction | SimulationError]:
        """Return predictions at `values` with additional inputs driven, in the runs whose model has them.

        Each drive maps an input to (N,) samples for every experiment.
        """
        return self._simulate([(values, drive) for drive in drives], values)

    def moved_by(
        self, values: Mapping[str, float], name: str, size: float, courses: Sequence[Sequence[FloatArray]]
    ) -> list[Prediction | SimulationError]:
        """Return by how much each course of a further input moves the predictions at `values`.

        Parameters
        ----------
        values
            The point.
        name
            The input, which some models may lack.
        size
            Its size.
        courses
            Each has (N,) samples for every experiment, times `size`.

        Returns
        -------
        list
            For each course, (C, N) for every experiment. One run with derivatives gives the responses to all
            courses; a model without such runs is simulated with each of them, and without.
        """
        if (exact := self._moved_along(values, name, size, courses)) is not None:
            return exact
        drives = [{name: [size * u for u in course]} for course in courses]
        (base,) = self.predict([values])
        if isinstance(base, SimulationError):
            return [base] * len(courses)
        return [
            o if isinstance(o, SimulationError) else tuple(a - b for a, b in zip(o, base, strict=True))
            for o in self.predict_driven(values, drives)
        ]

    def _moved_along(
        self, values: Mapping[str, float], name: str, size: float, courses: Sequence[Sequence[FloatArray]]
    ) -> list[Prediction | SimulationError] | None:
        """Return the responses of `moved_by` by derivatives; None if a model has none by its inputs."""
        plain, effects = self._split(values)
        cases = self.cases_at(values)
        posed: list[tuple[Job, tuple[Effects, Disturbed | None]]] = []
        moved = []
        for k, case in enumerate(cases):
            point, signal = self._placed(case, plain, effects)
            simulator = self._simulator(case, point)
            if name not in simulator.variables:
                continue
            disturbed, task = self._pose(_Wanted(k, case, values), signal)
            more_points = len(task.time) != len(case.task.time) or refined(task, simulator.variables) is not task
            if more_points or not simulator.moves_inputs:
                return None
            lines = _draws_lines(case)
            moves = np.array([_led(case, np.asarray(course[k]), lines=lines) for course in courses])
            linear = (*task.linear, name) if lines else task.linear
            task = replace(task, along=({},) * len(courses), driven={name: moves}, linear=linear, shared=None)
            posed.append(((simulator, task, point), (signal, disturbed)))
            moved.append(k)
        results = [[np.zeros((len(case.channels), len(case.time))) for case in cases] for _ in courses]
        for k, (_, outside), outcome in zip(moved, posed, self.runner([job for job, _ in posed]), strict=True):
            if isinstance(outcome, SimulationError):
                return None
            case, n = cases[k], len(cases[k].task.outputs)
            base, slopes = outcome[:n], outcome[n:].reshape(-1, n, outcome.shape[1])
            for rows, slope in zip(results, slopes, strict=True):
                ends = (base + 0.5 * size * slope, base - 0.5 * size * slope)
                above, below = (self._shown(case, end, outside, plain) for end in ends)
                rows[k] = above - below
        return [tuple(rows) for rows in results]

    def cases_at(self, values: Mapping[str, float]) -> list[Case]:
        """Return the cases with the solver tolerances that a point needs."""
        tightened = [tolerances for names, tolerances in self.finer.items() if names <= values.keys()]
        needed = (min((t[case.id] for t in tightened if case.id in t), default=np.inf) for case in self.cases)
        return [self._finer_case(k, tolerance) for k, tolerance in enumerate(needed)]

    def _finer_case(self, index: int, tolerance: float) -> Case:
        case = self.cases[index]
        if (case.task.tolerance or np.inf) <= tolerance:
            return case
        key = index, tolerance
        if key not in self._finer_cases:
            self._finer_cases[key] = replace(case, task=replace(case.task, tolerance=tolerance))
        return self._finer_cases[key]

    def trajectories(self, values: Mapping[str, float], variables: Sequence[str]) -> tuple[FloatArray, ...]:
        """Return (len(variables), N) trajectories of model variables, one array per experiment.

        Raises
        ------
        SimulationError
            A run failed.
        """
        jobs = []
        for case in self.cases_at(values):
            # Segments are fitted to the measured outputs.
            read = case.task.outputs if isinstance(case.simulator, Segmented) else ()
            task = replace(case.task, outputs=tuple(dict.fromkeys((*read, *variables))))
            starts, _ = self._placed(case, *self._split(values))
            jobs.append((self._simulator(case, starts), task, starts))
        outcomes = self.runner(jobs)
        for outcome in outcomes:
            if isinstance(outcome, SimulationError):
                raise outcome
        return tuple(
            np.asarray(o)[[task.outputs.index(name) for name in variables], case.lead :]
            for o, case, (_, task, _) in zip(outcomes, self.cases, jobs, strict=True)
            if not isinstance(o, SimulationError)
        )

    def tangents(self, values: Mapping[str, float], names: Sequence[str]) -> dict[str, Prediction]:
        """Return the exact d prediction / d parameter by name, from one run of each case.

        Without parameters of effects on signals. Empty if a model cannot differentiate its runs with respect to
        the others.
        """
        return self.tangents_at([values], names)[0]

    def tangents_at(
        self, points: Sequence[Mapping[str, float]], names: Sequence[str]
    ) -> list[dict[str, Prediction]]:
        """Return the `tangents` at several points, simulated together."""
        posed = [self._differentiated(values, names) for values in points]
        outcomes = iter(self.runner([job for one in posed for job in one.jobs]))
        return [self._tangents(one, [next(outcomes) for _ in one.jobs]) for one in posed]

    def _differentiated(self, values: Mapping[str, float], names: Sequence[str]) -> _Differentiated:
        """Return the runs that give the tangents at a point; none if exact tangents are not available."""
        plain, effects = self._split(values)
        names = [name for name in names if name in plain]
        if not names:
            return _Differentiated()
        widths = [_WIDTH * (abs(plain[name]) or 1.0) for name in names]
        ends = [
            [{**plain, name: plain[name] + sign * width} for sign in (0.5, -0.5)]
            for name, width in zip(names, widths, strict=True)
        ]
        jobs, moves, outside = [], [], []
        for k, case in enumerate(self.cases_at(values)):
            directions = [
                _direction(self.start_values(case, above), self.start_values(case, below), width)
                for (above, below), width in zip(ends, widths, strict=True)
            ]
            moved = {name for along, _ in directions for name in along}
            point, signal = self._placed(case, plain, effects)
            simulator = self._simulator(case, point)
            if moved and not simulator.differentiates(moved):
                return _Differentiated()
            along = tuple(move for move, _ in directions if move)
            disturbed, task = self._pose(_Wanted(k, case, values), signal, along)
            jobs.append((simulator, task, point))
            moves.append(directions)
            outside.append((signal, disturbed))
        return _Differentiated(jobs, names, widths, ends, moves, outside)

    def _tangents(self, posed: _Differentiated, outcomes: Sequence[Outcome]) -> dict[str, Prediction]:
        tangents: dict[str, list[FloatArray]] = {name: [] for name in posed.names}
        cases = self.cases if outcomes else ()
        for case, directions, outside, outcome in zip(cases, posed.moves, posed.outside, outcomes, strict=True):
            if isinstance(outcome, SimulationError):
                return {}
            n = len(case.task.outputs)
            base, slopes = outcome[:n], iter(outcome[n:].reshape(-1, n, outcome.shape[1]))
            for name, pair, width, (along, size) in zip(
                posed.names, posed.ends, posed.widths, directions, strict=True
            ):
                half = 0.5 * width * size * next(slopes) if along else np.zeros_like(base)
                above, below = (
                    self._shown(case, o, outside, p) for o, p in zip((base + half, base - half), pair, strict=True)
                )
                tangents[name].append((above - below) / width)
        return {name: tuple(rows) for name, rows in tangents.items()}

    @cached_property
    def _known(self) -> frozenset[str]:
        return frozenset(n for case in self.cases for n in (*case.setting, *case.simulator.variables))

    @cached_property
    def _signals(self) -> frozenset[str]:
        outputs = {c.signal for case in self.cases for c in case.channels}
        return frozenset(outputs.union(*(case.task.inputs for case in self.cases)))

    def _split(self, values: Mapping[str, float]) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
        """Return the parameters of models, and those of signal effects by signal."""
        every = {**self.fixed, **values}
        of_model = {n for n in every if without_owner(n) in self._known}
        plain, disturbed = split_signal_parameters(
            {n: v for n, v in every.items() if n not in of_model}, self._signals
        )
        return {**plain, **{n: every[n] for n in every if n in of_model}}, disturbed

    def expanded(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return `values` with the model variables tied to them; as ``name@owner`` if those have owners."""
        every = {**self.fixed, **values}
        machines, everything = {case.machine for case in self.cases}, dict(values)
        for name, expression in self.tie.items():
            leaders = [n.split(SEPARATOR) for n in every if without_owner(n) in expression.names]
            owners = {owner for _, *of_one in leaders for owner in of_one}
            of_runs = not owners.isdisjoint(case.id for case in self.cases)
            if owners.isdisjoint(machines) and not of_runs:
                everything[name] = expression(every)
            else:
                by_owner = {case.id if of_runs else case.machine: case.values(every) for case in self.cases}
                everything |= {f"{name}{SEPARATOR}{owner}": expression(there) for owner, there in by_owner.items()}
        return everything

    def start_values(self, case: Case, values: Mapping[str, float]) -> dict[str, float]:
        """Return campaign parameters in the model's units; any other name is a variable of the model."""
        starts = {
            name: v for name, v in values.items() if name in case.simulator.variables and name not in case.setting
        }
        every = case.values(values) if self.tie else {}
        tied = {name: e(every) for name, e in self.tie.items() if name in case.simulator.variables}
        return {**starts, **case.start_values(values), **tied}

    def with_laws(self, values: Mapping[str, float]) -> list[tuple[Case, dict[str, float]]]:
        """Return the cases with the laws in their models, but no effects on signals, and what is set on these."""
        plain, _ = self._split(values)
        placed = [(case, self.start_values(case, plain)) for case in self.cases_at(values)]
        return [(replace(case, simulator=self._simulator(case, starts)), starts) for case, starts in placed]

    def _placed(self, case: Case, plain: Mapping[str, float], signal: Effects) -> tuple[dict[str, float], Effects]:
        """Return the start values of a case, and the effects on signals that act outside its simulator.

        States of segments are fitted to what the sensors show, so effects on signals act inside of them.
        """
        values = self.start_values(case, plain)
        if isinstance(case.simulator, Segmented):
            return values | _of_variables(case, signal), {}
        return values, signal

    def _simulator(self, case: Case, values: Mapping[str, float]) -> Simulator:
        variant = self.variant(case.setup, values)
        simulator = case.simulator if variant is None else in_place_of(case.simulator, variant)
        names = tuple(sorted(name for name in values if name not in simulator.variables))
        if not names or not isinstance(simulator, Segmented):
            return simulator
        key = id(simulator), names
        if key not in self._sensing:
            self._sensing[key] = simulator.over(SignalModel(simulator.simulator, names))
        return self._sensing[key]

    def predict_cases(self, wanted: Sequence[tuple[int, Task, Mapping[str, float]]]) -> list[Outcome]:
        """Return the (C, N) prediction of a case, by its number, as a variant of its task at some values."""
        return self._sensed([_Wanted(k, replace(self.cases[k], task=task), values) for k, task, values in wanted])

    def predict_at(self, wanted: Sequence[tuple[int, Mapping[str, float]]]) -> list[Outcome]:
        """Return the (C, N) prediction of each wanted case, by its number, at some values."""
        return self._sensed([_Wanted(k, self.cases_at(values)[k], values) for k, values in wanted])

    def residuals_of(
        self, wanted: Sequence[tuple[int, Mapping[str, float]]], observed: Observed
    ) -> list[FloatArray | None]:
        """Return the whitened residual of each wanted case, by its number, at some values; None where it fails."""
        outcomes = zip(wanted, self.predict_at(wanted), strict=True)
        residuals = [
            None if isinstance(outcome, SimulationError) else observed.residual(k, outcome)
            for (k, _), outcome in outcomes
        ]
        return [part if part is not None and squares_finite([part]) else None for part in residuals]

    def residuals_at(self, values: Mapping[str, float], observed: Observed) -> tuple[FloatArray, ...] | None:
        """Return the whitened residuals of all cases at some values; None if one cannot be simulated."""
        (outcome,) = self.predict([values])
        parts = None if isinstance(outcome, SimulationError) else observed.residuals(outcome)
        return parts if parts is not None and squares_finite(parts) else None

    def _simulate(
        self,
        wanted: Sequence[tuple[Mapping[str, float], Mapping[str, Sequence[FloatArray]] | None]],
        near: Mapping[str, float] | None = None,
    ) -> list[Prediction | SimulationError]:
        every = [
            _Wanted(
                k,
                case,
                values,
                drive and {n: u for n, u in drive.items() if n in case.simulator.variables},
                near if isinstance(case.simulator, Segmented) else None,
            )
            for values, drive in wanted
            for k, case in enumerate(self.cases_at(values))
        ]
        outcomes, results = iter(self._sensed(every)), list[Prediction | SimulationError]()
        for _ in wanted:
            rows, failed = [], None
            for _ in self.cases:
                outcome = next(outcomes)
                if isinstance(outcome, SimulationError):
                    failed = failed or outcome
                else:
                    rows.append(outcome)
            results.append(failed or tuple(rows))
        return results

    def _sensed(self, wanted: Sequence[_Wanted]) -> list[Outcome]:
        """Return the (C, N) prediction of each case that is wanted, as its sensors would show it."""
        split: dict[int, tuple[dict[str, float], dict[str, dict[str, float]]]] = {}  # by the identity of values
        keys: list[_Key] = []
        outside: list[tuple[Effects, Disturbed | None]] = []
        jobs: dict[_Key, Job] = {}
        refused: dict[_Key, SimulationError] = {}
        for want in wanted:
            for at in (want.values, want.near):
                if at is not None and id(at) not in split:
                    split[id(at)] = self._split(at)
            values, signal = self._placed(want.case, *split[id(want.values)])
            disturbed, task = self._pose(want, signal)
            keys.append(_key(want, values, disturbed))
            outside.append((signal, disturbed))
            if keys[-1] not in jobs and keys[-1] not in refused:
                try:
                    simulator = self._simulator(want.case, values)
                    if want.near is not None:
                        there, _ = self._placed(want.case, *split[id(want.near)])
                        simulator = _begun(want, simulator, self._simulator(want.case, there), there)
                    jobs[keys[-1]] = (simulator, task, values)
                except SimulationError as error:
                    refused[keys[-1]] = error
        simulated = {**self._predictor(jobs, self.runner), **refused}
        results: list[Outcome] = []
        for want, key, disturbing in zip(wanted, keys, outside, strict=True):
            outcome, plain = simulated[key], split[id(want.values)][0]
            failed = isinstance(outcome, SimulationError)
            results.append(outcome if failed else self._shown(want.case, np.asarray(outcome), disturbing, plain))
        return results

    def _pose(
        self, want: _Wanted, signal: Effects, along: tuple[Mapping[str, float], ...] = ()
    ) -> tuple[Disturbed | None, Task]:
        """Return the task of what is wanted with its signals disturbed, as it was last time if it is the same.

        Signals seldom change with a model's parameters, and a task that is known is prepared already.
        """
        if want.drive is not None or not (signal or along):
            disturbed = _disturbed(want.case, want.index, signal, want.drive)
            return disturbed, _task(want, disturbed)
        acting = effects_on_simulation(signal, want.case.task.inputs, [c.signal for c in want.case.channels])
        of_signals = tuple((name, *of_one.items()) for name, of_one in acting.items())
        key = want.index, want.case.task, of_signals, tuple(tuple(move.items()) for move in along)
        if key not in self._posed:
            disturbed = _disturbed(want.case, want.index, signal, None)
            self._posed[key] = disturbed, replace(_task(want, disturbed), along=along)
            while len(self._posed) > _POSED * len(self.cases):
                self._posed.popitem(last=False)
        self._posed.move_to_end(key)
        return self._posed[key]

    def _shown(
        self,
        case: Case,
        outputs: FloatArray,
        outside: tuple[Effects, Disturbed | None],
        plain: Mapping[str, float],
    ) -> FloatArray:
        """Return the (C, N) outputs of a simulation as the sensors of a case would show them."""
        signal, disturbed = outside
        if disturbed is not None:
            outputs = disturbed.readings(outputs, [c.differentiated for c in case.channels])
        sensed = case.sensed(outputs, {**self.fixed, **plain})
        inputs = {n: u[case.lead :] for n, u in case.task.inputs.items()}
        return disturbed_readings(sensed, [c.signal for c in case.channels], signal, case.time, inputs)


def _of_variables(case: Case, effects: Effects) -> dict[str, float]:
    """Return the effects on signals of a case as parameters of its model: ``variable.property``."""
    variables = {c.signal: c.variable for c in case.channels} | {name: name for name in case.task.inputs}
    parameters = {}
    for signal, properties in effects.items():
        for name, value in properties.items():
            other = name.removeprefix("crosstalk[").removesuffix("]")
            if signal in variables and (other == name or other in variables):
                prop = name if other == name else f"crosstalk[{variables[other]}]"
                parameters[f"{variables[signal]}.{prop}"] = value
    return parameters


def _begun(want: _Wanted, simulator: Simulator, origin: Simulator, values: Mapping[str, float]) -> Simulator:
    """Return the segments of a model, begun in the states that fit in `origin` at its values."""
    assert isinstance(simulator, Segmented)
    assert isinstance(origin, Segmented)
    return simulator.from_states_at(origin, want.case.task, values)


def _conditions(case: Case) -> str:
    """Return a digest of the conditions of a run: its setup, settings and inputs over time."""
    digest = hashlib.blake2b(repr((case.setup, sorted(case.task.start_values.items()))).encode())
    for name, values in sorted(case.task.inputs.items()):
        digest.update(name.encode() + np.asarray(values).tobytes())
    digest.update((case.task.time - case.task.time[0]).tobytes())
    return digest.hexdigest()


def _direction(above: Mapping[str, float], below: Mapping[str, float], width: float) -> Direction:
    """Return how a model's variables move from one point to another that is `width` away."""
    slopes = {name: (above[name] - below[name]) / width for name in above if above[name] != below[name]}
    size = max(map(abs, slopes.values()), default=0.0)
    return {name: round(slope / size, 9) for name, slope in slopes.items()}, size


def _key(want: _Wanted, values: Mapping[str, float], disturbed: Disturbed | None) -> _Key:
    """Return the key of a simulation's result; a value equal to the model's own start value is left out."""
    variables, task = want.case.simulator.variables, want.case.task
    settings = task.start_values
    relevant = frozenset(
        (n, v) for n, v in values.items() if n not in variables or v != variables[n].start or n in settings
    )
    changed = {} if disturbed is None else dict(disturbed.inputs)
    if disturbed is not None and disturbed.time is not task.time:
        changed[""] = disturbed.time
    digests = tuple((n, hashlib.blake2b(u.tobytes()).digest()) for n, u in changed.items())
    near = frozenset({} if want.near is None else want.near.items())
    return want.index, task.tolerance, relevant, digests, near


def _task(want: _Wanted, disturbed: Disturbed | None) -> Task:
    task = want.case.task
    if disturbed is None or (disturbed.time is task.time and not disturbed.inputs):
        return task
    linear = tuple(want.drive or ()) if _draws_lines(want.case) else ()
    shared = None
    if want.drive is not None and disturbed.time is task.time:
        begins = [int(np.flatnonzero(u)[0]) for n, u in disturbed.inputs.items() if n in want.drive and np.any(u)]
        # A line from zero begins at the sample before.
        shared = (want.index, max(0, min(begins) - bool(linear))) if begins else None
    return disturbed.task(linear=linear, shared=shared)


def _disturbed(
    case: Case, index: int, signal: Effects, drive: Mapping[str, Sequence[FloatArray]] | None
) -> Disturbed | None:
    """Return the case's task with its signals disturbed and further inputs driven; None if it is unchanged."""
    driven = {}
    linear = _draws_lines(case)
    for name, series in (drive or {}).items():
        values = _led(case, np.asarray(series[index]), lines=linear)
        if np.any(values) or case.simulator.variables[name].start != 0.0:
            driven[name] = _lined(values, case.task.time) if linear else _held(values)
    names = [c.signal for c in case.channels]
    if not driven and not effects_on_simulation(signal, case.task.inputs, names):
        return None
    return disturbed_task(
        case.task,
        signal,
        names,
        driven,
        any_times=not case.simulator.even_steps,
        linear_drive=linear,
        variables=case.simulator.variables,
    )


def _led(case: Case, values: FloatArray, *, lines: bool) -> FloatArray:
    """Return an input's samples at the times of a case, which may begin before the first measured sample.

    A step of the model ends at a measured sample: what is held during the step is known at that sample.
    """
    if not case.lead:
        return values
    return np.append(values[0], values) if lines else np.append(values, values[-1])


def _draws_lines(case: Case) -> bool:
    """Return whether further inputs of a case are linear between its samples, else held."""
    return case.simulator.interpolates_inputs or case.task.interpolation == "band-limited"


def _held(values: FloatArray) -> FloatArray:
    """Replace values by their mean until the next one differs by 3 % of the range; zeros stay zeros.

    An FMU stops where an input changes. The integral of the input stays the same, so a slow response hardly
    changes.
    """
    begins = [0, *_changes(values, _HELD)]
    length = np.diff([*begins, len(values)])
    return np.repeat(np.add.reduceat(values, begins) / length, length)


def _lined(values: FloatArray, time: FloatArray) -> FloatArray:
    """Replace values by lines between turning points and where they have changed by a tenth of the range."""
    steps = np.diff(values)
    turns = np.flatnonzero(steps[:-1] * steps[1:] < 0.0) + 1
    changes = np.array(_changes(values, _LINED), dtype=np.intp)
    leaves = changes[values[changes - 1] == 0.0] - 1  # zeros stay zeros
    knots = np.unique(np.concatenate([[0], turns, leaves, changes, [len(values) - 1]]))
    return np.asarray(np.interp(time, time[knots], values[knots]))


def _changes(values: FloatArray, share: float) -> list[int]:
    """Return the samples that differ by a share of the range from the last such one; where zeros begin and end."""
    width = share * float(np.ptp(values))
    changes, last = [], float(values[0])
    moves = np.flatnonzero(np.diff(values)) + 1
    for k, value in zip(moves.tolist(), values[moves].tolist(), strict=True):
        if abs(value - last) > width or (value == 0.0) != (last == 0.0):
            changes.append(k)
            last = value
    return changes


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """A model near a point: (C, N) predictions of every run, and their derivatives by each unknown."""

    values: Mapping[str, float]
    prediction: Prediction
    slopes: Mapping[str, Prediction]


def predicted(model: CampaignModel, points: Sequence[Mapping[str, float]]) -> list[Prediction]:
    """Return the predictions at every point.

    Raises
    ------
    SimulationError
        A run failed.
    """
    predictions: list[Prediction] = []
    for outcome in model.predict(points):
        if isinstance(outcome, SimulationError):
            raise outcome
        predictions.append(outcome)
    return predictions


def linear_at(
    model: CampaignModel, points: Sequence[Mapping[str, float]], unknowns: Sequence[Sequence[Unknown]]
) -> list[Linear]:
    """Return the model near every point, linearised along the unknowns of that point.

    Raises
    ------
    SimulationError
        A run failed.
    """
    names = list(dict.fromkeys(u.name for us in unknowns for u in us))
    exact = model.tangents_at(points, names)
    moved: list[tuple[int, Unknown, float, Mapping[str, float]]] = []
    for k, (values, us) in enumerate(zip(points, unknowns, strict=True)):
        for u in us:
            if u.name not in exact[k]:
                step = u.step if values[u.name] + u.step <= u.upper else -u.step
                moved.append((k, u, step, {**values, u.name: values[u.name] + step}))
    predictions = predicted(model, [*points, *(there for *_, there in moved)])
    slopes = [
        {u.name: tangents[u.name] for u in us if u.name in tangents}
        for tangents, us in zip(exact, unknowns, strict=True)
    ]
    for (k, u, step, _), there in zip(moved, predictions[len(points) :], strict=True):
        slopes[k][u.name] = tuple((a - b) / step for a, b in zip(there, predictions[k], strict=True))
    return [
        Linear(values, prediction, tangents)
        for values, prediction, tangents in zip(points, predictions, slopes, strict=False)
    ]
