"""Runs in segments: the model is restarted at intervals, from estimated states.

In an open-loop simulation, an unstable plant, or one that integrates model errors, diverges from the measurement.
With segments, only the behaviour within a segment has to be predicted (multiple shooting without continuity; in
statistics, nuisance initial states). The states are fitted to the samples of the segment by Levenberg-Marquardt
steps and projected out of the residuals (variable projection, Golub and Pereyra, Inverse Problems 19:R1, 2003, in
Kaufman's form), so solvers and standard errors deal with the parameters only.
"""

from __future__ import annotations

import copy
import hashlib
import math
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from fmuid.core.errors import ProblemError, SimulationError
from fmuid.core.immutable import FloatArray, frozen_mapping, read_only
from fmuid.simulation.band_limited import refined
from fmuid.simulation.recorded import digest_of_values, digest_without_along
from fmuid.simulation.simulator import Simulator, Task, Wrapped

Length = float | Literal["auto"]
"""Length of a segment, s; ``auto`` for the longest over which small errors stay small."""

_STEPS = 30  # Gauss-Newton steps per segment, and trials per step, with increasing damping after failures
_TRIALS = 9
_DAMPING = 1e-3  # initial damping, for columns of unit length
_SETTLED = 1e-5  # relative to the norm of the residuals: smaller steps of the states gain 1e-10 of the cost
_LAST = 1e-6  # share of the cost: the gain of a step after which the next one is negligible
_STRAIGHT = 1e-3  # relative error of a step's predicted gain up to which slopes are the same after the step ...
_BENT = 0.1  # ... and from which they are no longer used
_RANK = 1e-8
_DIFFERENCE = 1e-4  # step of a state's finite difference, relative to its scale
_ERROR = 0.01  # relative error: the best accuracy of actuators, sensors and models
_NOISE = 10.0  # times the noise of a sample: a smaller error is hardly visible ...
_PART = 0.005  # ... as is less than this share of the output's movement within a segment
_SHARE = 0.9  # share of the segments that must stay within it
_LARGE = 1e12
_MOST_PIECES = 200  # largest number of pieces for analysing the growth of errors
_KEPT = 6  # layouts of tasks kept in memory
_FORGOTTEN = 1e-4  # relative to the largest response to an initial state: smaller ones move its estimate by 1e-4
_BEYOND = 1.2  # times the samples until then have to be seen, and again for parameters that forget more slowly


@dataclass(frozen=True, slots=True)
class Growth:
    """Growth of an error of 1 % in a run simulated in open loop.

    Parameters
    ----------
    whole
        Change of the worst output at the end of the run relative to its range, divided by the error that causes
        it.
    output, cause
        That output, and the source of the error: a state at the start (relative to its range) or an input
        throughout the run (relative to its variation).
    length
        Length of segments, s, within which an error of 1 % in an input has hardly any effect.
    duration
        Duration of the run, s.
    """

    whole: float
    output: str
    cause: str
    length: float
    duration: float

    @property
    def runs_away(self) -> bool:
        """Whether an error of 1 % moves the output by more than half its range by the end of the run."""
        return _ERROR * self.whole > 0.5

    def __str__(self) -> str:
        """Return in words why the run cannot be simulated in open loop."""
        factor = _ERROR * self.whole
        size = f"{factor:.2g} times its range" if factor < 1e4 else "beyond all bounds"
        return f"an error of 1 % in {self.cause} moves '{self.output}' by {size} over {self.duration:.3g} s"


@dataclass(frozen=True, slots=True, eq=False)
class _Cut:
    first: tuple[int, ...]  # first sample of each segment, and the end
    fit: tuple[int, ...]  # the end of each segment's samples to which its states are fitted
    guess: FloatArray  # (segments, states)
    scale: FloatArray  # (states,) their range
    growth: Growth | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Piece:
    """A segment of a task: without derivatives, with those by its initial states, and with all of them."""

    plain: Task
    sloped: Task
    whole: Task


@dataclass(frozen=True, slots=True, eq=False)
class _Begin:
    """Where segments begin that are not fitted: in the states that fit elsewhere."""

    origin: Segmented
    task: Task
    parameters: Mapping[str, float]

    @property
    def digest(self) -> bytes:
        """What the states in `origin` depend on, in brief."""
        values = digest_of_values(self.parameters)
        return hashlib.blake2b(digest_without_along(self.task) + values, digest_size=16).digest()


class Segmented(Wrapped):
    """A simulator that restarts in each segment, from the states that fit the segment's samples best.

    A `Simulator` of one case: its predictions depend on the measurement.

    Parameters
    ----------
    simulator
        The model; its `states` can be set before initialisation.
    task
        The whole run.
    length
        Length of the segments.
    target, weight
        (outputs, N) measured samples, and the weights of their errors: 0 where a sample does not count.
    at
        Start values of the model for choosing the segments and for the first estimate of their states.

    Raises
    ------
    ProblemError
        The states of the model cannot be set.
    """

    def __init__(
        self,
        simulator: Simulator,
        task: Task,
        length: Length,
        target: FloatArray,
        weight: FloatArray,
        *,
        at: Mapping[str, float],
    ) -> None:
        self.simulator, self.task, self.length = simulator, task, length
        self.target, self.weight = read_only(np.where(weight > 0.0, target, 0.0)), read_only(weight)
        self.at = frozen_mapping(at)
        self._seen = hashlib.blake2b(self.target.tobytes() + self.weight.tobytes(), digest_size=8).hexdigest()
        self._states = states_of(simulator, whole=length == math.inf)
        self.exact = simulator.differentiates(set(self.states))
        self._cut: _Cut | None = None
        self._pieces: OrderedDict[tuple[int, tuple[int, ...]], tuple[Task, list[_Piece]]] = OrderedDict()
        self._others: dict[int, Segmented] = {}
        self.missing: tuple[str, ...] = ()
        self._known: OrderedDict[bytes, FloatArray] = OrderedDict()

    @property
    def states(self) -> tuple[str, ...]:
        """States with which every segment begins."""
        return self._states

    @property
    def even_steps(self) -> bool:
        """True: the samples of a task are those of the measurement."""
        return True

    @property
    def token(self) -> str:
        """Identity of the model for fingerprints."""
        return f"{self.simulator.token} in segments of {self.length} of {self._seen}"

    @property
    def affinity(self) -> str:
        """The measurement: states that fit it at a point serve all runs near this point."""
        return self._seen

    @property
    def segments(self) -> int:
        """Number of segments."""
        return len(self._layout().first) - 1

    @property
    def nuisances(self) -> int:
        """Number of initial states that are fitted with the parameters."""
        return self.segments * len(self.states)

    @property
    def growth(self) -> Growth:
        """Growth of errors in the run, from which ``auto`` chooses the segments."""
        if self.length != "auto":
            return Segmented(
                self.simulator, self.task, "auto", target=self.target, weight=self.weight, at=self.at
            ).growth
        growth = self._layout().growth
        assert growth is not None
        return growth

    def differentiates(self, names: Collection[str]) -> bool:
        """Return whether the model can be differentiated with respect to the parameters `names` and its states."""
        return self.exact and self.simulator.differentiates({*names, *self.states})

    @property
    def moves_inputs(self) -> bool:
        """Whether inputs of the model can move along directions."""
        return self.exact and self.simulator.moves_inputs

    def simulate(self, task: Task, parameters: Mapping[str, float]) -> FloatArray:
        """Return the concatenated predictions of the segments; see `Simulator`.

        Derivatives along directions take the refit of the states into account (`Task.along`).

        Raises
        ------
        SimulationError
            A segment cannot be simulated.
        """
        return self._begun(_Begin(self, task, parameters), task, parameters)

    def _begun(self, begin: _Begin, task: Task, parameters: Mapping[str, float]) -> FloatArray:
        if self.missing:
            raise SimulationError(f"the model has no state '{self.missing[0]}' to begin a segment with")
        cut = self._layout()
        states = begin.origin.initial_states(begin.parameters, begin.task)
        outputs = np.empty((len(task.outputs) * (1 + len(task.along)), len(task.time)))
        for k, piece in enumerate(self._tasks(task)):
            part = slice(cut.first[k], cut.first[k + 1])
            if self.exact and task.along:
                outputs[:, part] = self._projected(piece, part, states[k], cut.scale, parameters)
            else:
                outputs[:, part] = self._run(piece.plain, parameters, states[k])
        return outputs

    def over(self, simulator: Simulator) -> Segmented:
        """Return the same segments of another model, such as this one with an effect.

        Additional states of that model begin each segment with their start values.
        """
        if id(simulator) not in self._others:
            other = copy.copy(self)
            other._cut, other._pieces, other._others = self._layout(), OrderedDict(), {}
            other._known = OrderedDict()
            other.simulator = simulator
            other.missing = tuple(s for s in self.states if s not in simulator.states)
            other.exact = simulator.differentiates(set(self.states))
            self._others[id(simulator)] = other
        return self._others[id(simulator)]

    def state_tangents(self, parameters: Mapping[str, float]) -> FloatArray:
        """Return the (segments * states, outputs, N) derivatives of the outputs by the initial states."""
        cut, n = self._layout(), len(self.task.outputs)
        tangents = np.zeros((self.segments, len(self.states), n, len(self.task.time)))
        for k, (piece, states) in enumerate(
            zip(self._tasks(self.task), self.initial_states(parameters), strict=True)
        ):
            part = slice(cut.first[k], cut.first[k + 1])
            tangents[k, :, :, part] = self._sloped(piece, parameters, states, cut.scale)[1]
        return tangents.reshape(-1, n, len(self.task.time))

    def from_states_at(self, origin: Segmented, task: Task, parameters: Mapping[str, float]) -> Simulator:
        """Return these segments, each starting from the states that fit in `origin` at a task and its parameters.

        Near that point, the prediction differs from the usual one only by what a change of the states explains.
        """
        return _BegunElsewhere(self, _Begin(origin, task, parameters))

    def initial_states(self, parameters: Mapping[str, float], task: Task | None = None) -> FloatArray:
        """Return the initial states of the segments, (segments, states), in a task or the whole run.

        Those of the latest calls are remembered.
        """
        task = self.task if task is None else task
        key = _Begin(self, task, parameters).digest
        if key not in self._known:
            fits = range(self.segments)
            self._known[key] = read_only(np.array([self._best_start(task, k, parameters) for k in fits]))
            while len(self._known) > _KEPT:
                self._known.popitem(last=False)
        return self._known[key]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_pieces": OrderedDict(), "_others": {}, "_known": OrderedDict()}

    # One segment

    def _best_start(self, task: Task, k: int, parameters: Mapping[str, float]) -> FloatArray:
        """Return the initial states of segment `k`: those that fit its samples until it forgets where it began."""
        cut = self._layout()
        begin, end, states = cut.first[k], cut.first[k + 1], cut.guess[k]
        if cut.fit[k] < end:
            part = slice(begin, cut.fit[k])
            piece = self._tasks(task, cut.fit)[k]
            states, slopes = self._fitted(piece, part, states, cut.scale, parameters)
            if self._remembered(slopes, part, _BEYOND) < part.stop:
                return states
        return self._fitted(self._tasks(task)[k], slice(begin, end), states, cut.scale, parameters)[0]

    def _remembered(self, slopes: FloatArray, part: slice, beyond: float) -> int:
        """Return the end of the samples that depend on the initial states, and of `beyond` times as many."""
        weight = self.weight[:, part]
        counts = np.max(np.abs(weight * slopes[:, : len(weight), : weight.shape[1]]), axis=1)
        left = np.any(counts > _FORGOTTEN * np.max(counts, axis=1, keepdims=True), axis=0)
        last = int(np.max(np.flatnonzero(left), initial=0))
        return min(int(part.start) + math.ceil(beyond * (last + 1)), int(part.stop))

    def _fitted(
        self, piece: _Piece, part: slice, guess: FloatArray, scale: FloatArray, parameters: Mapping[str, float]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the states that fit a segment's samples, and derivatives of the run by them nearby.

        `part` are the judged samples, the first ones of the piece. Slopes are kept while the steps that they give
        gain about what they promise; the last step is taken with those at its end.
        """
        states = np.array(guess)

        def errors(run: FloatArray) -> FloatArray:
            return self._errors(run, part)

        run, slopes = self._sloped(piece, parameters, states, scale)
        error, damping, current = errors(run), 0.0, True
        for _ in range(_STEPS):
            step = self._step(
                piece.plain,
                parameters,
                states,
                error=error,
                matrix=self._columns(slopes, part),
                errors=errors,
                damping=damping,
            )
            if step is None and current:
                break
            bent = np.inf
            if step is not None:
                before = float(error @ error)
                states, run, error, damping, bent = step
                if current and before - float(error @ error) <= _LAST * before:
                    break
            current = current and bent <= _STRAIGHT
            if bent > _BENT:
                run, slopes = self._sloped(piece, parameters, states, scale)
                error, current = errors(run), True
        return states, slopes

    def _projected(
        self, piece: _Piece, part: slice, states: FloatArray, scale: FloatArray, parameters: Mapping[str, float]
    ) -> FloatArray:
        """Return a segment's run from states that fit, with derivatives along which these follow."""
        rows = len(piece.whole.outputs)
        run = self._run(piece.whole, parameters, states)
        slopes = self._slopes(piece.whole, parameters, states, scale, run)
        tangents = run[rows * (1 + len(self.states)) :].reshape(-1, rows, run.shape[1])
        follow = -_solved(self._columns(slopes, part), self._columns(tangents, part))
        tangents = tangents + np.einsum("ka,kij->aij", follow, slopes)
        return np.concatenate([run[:rows], tangents.reshape(-1, run.shape[1])])

    def _errors(self, run: FloatArray, part: slice) -> FloatArray:
        """Return the weighted errors of a run, where they count."""
        weight, target = self.weight[:, part], self.target[:, part]
        error: FloatArray = (weight * (run[: len(target), : target.shape[1]] - target))[weight > 0.0]
        return error

    def _columns(self, slopes: FloatArray, part: slice) -> FloatArray:
        """Convert (k, rows, N) derivatives to the (m, k) derivatives of the weighted errors."""
        weight = self.weight[:, part]
        n, samples = weight.shape
        return np.stack([(weight * s[:n, :samples])[weight > 0.0] for s in slopes], axis=1)

    def _step(
        self,
        task: Task,
        parameters: Mapping[str, float],
        states: FloatArray,
        *,
        error: FloatArray,
        matrix: FloatArray,
        errors: Callable[[FloatArray], FloatArray],
        damping: float,
    ) -> tuple[FloatArray, FloatArray, FloatArray, float, float] | None:
        """Return better states, their run and its errors, the next damping, and the error of the promised gain.

        None if no better states are found nearby.
        """
        for _ in range(_TRIALS):
            step = -_solved(matrix, error, damping)
            if np.linalg.norm(matrix @ step) <= _SETTLED * np.linalg.norm(error):
                return None
            try:
                run = self._run(task, parameters, states + step)
                moved = errors(run)
            except SimulationError:
                moved = np.array([np.inf])
            gained, left = float(error @ error - moved @ moved), error + matrix @ step
            promised = float(error @ error - left @ left)
            if gained > 0.0:
                bent = abs(gained / promised - 1.0)
                return states + step, run, moved, 0.1 * damping if damping > _DAMPING else 0.0, bent
            if promised <= _LAST * float(error @ error):
                return None
            damping = max(10.0 * damping, _DAMPING)
        return None

    def _run(self, task: Task, parameters: Mapping[str, float], states: FloatArray) -> FloatArray:
        there = dict(parameters) | dict(zip(self.states, states.tolist(), strict=True))
        return self.simulator.simulate(task, there)

    def _sloped(
        self, piece: _Piece, parameters: Mapping[str, float], states: FloatArray, scale: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return a run, and its derivatives by its initial states."""
        run = self._run(piece.sloped, parameters, states)
        return run, self._slopes(piece.sloped, parameters, states, scale, run)

    def _slopes(
        self,
        task: Task,
        parameters: Mapping[str, float],
        states: FloatArray,
        scale: FloatArray,
        run: FloatArray,
    ) -> FloatArray:
        """Return the derivatives of a run by its initial states, (states, outputs, N)."""
        rows = len(task.outputs)
        if self.exact:
            return run[rows : rows * (1 + len(self.states))].reshape(len(self.states), rows, -1)
        slopes = []
        for i, size in enumerate(_DIFFERENCE * np.where(scale > 0.0, scale, np.maximum(np.abs(states), 1.0))):
            moved = states.copy()
            moved[i] += size
            if moved[i] == states[i]:
                raise SimulationError(f"the start state '{self.states[i]}' runs away, to {states[i]:.3g}")
            slopes.append((self._run(task, parameters, moved) - run) / (moved[i] - states[i]))
        return np.array(slopes)

    # All segments

    def _layout(self) -> _Cut:
        if self._cut is None:
            self._cut = self._cut_out()
        return self._cut

    def _tasks(self, task: Task, ends: tuple[int, ...] = ()) -> list[_Piece]:
        """Return the tasks of the segments, or of their beginnings up to `ends`.

        They are the same objects for the same task: simulators prepare them.
        """
        key = id(task), ends
        if key not in self._pieces:
            first = self._layout().first
            self._pieces[key] = (
                task,
                [self._piece(task, a, b) for a, b in zip(first[:-1], ends or first[1:], strict=True)],
            )
            while len(self._pieces) > 2 * _KEPT:
                self._pieces.popitem(last=False)
        return self._pieces[key][1]

    def _piece(self, task: Task, a: int, b: int, outputs: tuple[str, ...] | None = None) -> _Piece:
        by_state = tuple({s: 1.0} for s in self.states) if self.exact else ()
        fine = refined(task, self.variables)
        part = slice(fine.every * a, fine.every * (b - 1) + 1 + fine.first)
        plain = replace(
            fine,
            time=fine.time[part],
            inputs={n: u[part] for n, u in fine.inputs.items()},
            outputs=outputs or task.outputs,
            along=(),
            driven={},
        )
        sloped = replace(plain, along=by_state) if self.exact else plain
        driven = {n: np.vstack([np.zeros((len(by_state), b - a)), u[:, a:b]]) for n, u in task.driven.items()}
        along = by_state + task.along
        whole = replace(plain, along=along, driven=driven) if self.exact and task.along else sloped
        return _Piece(plain, sloped, whole)

    def _cut_out(self) -> _Cut:
        time, counts = self.task.time, np.count_nonzero(self.weight > 0.0, axis=0)
        least = len(self.states) + 1
        if self.length != "auto":
            first = tuple(_bounds(time, counts, float(self.length), least))
            return self._swept(first)[0]
        usual = max(10, 2 * least, len(time) // _MOST_PIECES) * float(np.median(np.diff(time)))
        first = tuple(_bounds(time, counts, usual, least))
        cut, pieces = self._swept(first)
        growth = self._growth(cut, pieces)
        first = tuple(_bounds(time, counts, growth.length, least))
        return replace(self._swept(first)[0], growth=growth)

    def _swept(self, first: Sequence[int]) -> tuple[_Cut, list[tuple[_Piece, FloatArray]]]:
        """Return the states found segment by segment, each starting where the last one ended, and the tasks."""
        outputs = (*self.task.outputs, *self.states)
        n, scale, guess, fit = len(self.task.outputs), np.zeros(len(self.states)), [], []
        begin = replace(
            self.task,
            time=self.task.time[:2],
            inputs={name: u[:2] for name, u in self.task.inputs.items()},
            outputs=self.states,
        )
        state = self.simulator.simulate(replace(begin, along=()), self.at)[:, 0]
        pieces: list[tuple[_Piece, FloatArray]] = []
        for a, b in pairwise(first):
            piece = self._piece(self.task, a, min(b + 1, len(self.task.time)), outputs)
            for row, name in enumerate(self.task.outputs):
                if name in self.states and self.weight[row, a] > 0.0:
                    state[self.states.index(name)] = self.target[row, a]
            state, slopes = self._fitted(piece, slice(a, b), state, scale, self.at)
            fit.append(self._remembered(slopes, slice(a, b), _BEYOND**2))
            run = self._run(piece.plain, self.at, state)
            guess.append(state)
            pieces.append((piece, state))
            state = run[n : n + len(self.states), -1].copy()
        states = np.array(guess)
        scale = np.ptp(np.vstack([states, state]), axis=0)
        return _Cut(tuple(first), tuple(fit), read_only(states), read_only(scale)), pieces

    def _growth(self, cut: _Cut, pieces: Sequence[tuple[_Piece, FloatArray]]) -> Growth:
        """Return how errors of 1 % grow from piece to piece along the measured run."""
        n, n_x = len(self.task.outputs), len(self.states)
        judged = np.where(self.weight > 0.0, self.target, np.nan)
        shown = np.flatnonzero(_range(judged) > 0.0)
        judged = judged[shown]
        span, noise = _range(judged), _noise(judged)
        driven = [u for u in self.task.inputs if self.variables[u].type in ("Real", "Float64", "Float32")]
        sizes = {u: _size(self.task.inputs[u]) for u in driven}
        driven = [u for u in driven if sizes[u] > 0.0]
        by_state, by_input = [], []
        for piece, state in pieces:
            run, slopes = self._sloped(piece, self.at, state, cut.scale)
            by_state.append(slopes[:, :, -1].T)
            moved = []
            for u in driven:
                inputs = dict(piece.plain.inputs) | {u: piece.plain.inputs[u] + _ERROR * sizes[u]}
                other = self._run(replace(piece.plain, inputs=inputs), self.at, state)
                moved.append((other - run[: n + n_x])[:, -1] / _ERROR)
            by_input.append(np.array(moved).T.reshape(n + n_x, len(driven)))
        count = len(pieces)
        excess = np.full((count, count), np.nan)  # [k, j]: over k + 1 pieces, starting from piece j
        worst = np.zeros((len(shown), n_x + len(driven)))
        local = [
            np.nanmedian(
                [_range(judged[:, cut.first[j] : cut.first[j + k + 1]]) for j in range(count - k)], axis=0
            )
            for k in range(count)
        ]
        for j in range(count):
            error = np.hstack([np.diag(cut.scale), np.zeros((n_x, len(driven)))])
            for k in range(count - j):
                added = np.hstack([np.zeros((n + n_x, n_x)), by_input[j + k]])
                reached = by_state[j + k] @ error + added
                error, moved_by = reached[n:], np.abs(reached[shown])
                if j == 0:
                    worst = moved_by / span[:, None]
                if not np.max(moved_by, initial=0.0) < _LARGE * np.max(span, initial=0.0):
                    excess[k : count - j, j] = _LARGE
                    break
                allowed = np.maximum(_NOISE * noise, _PART * local[k])[:, None]
                of_inputs = np.max(_ERROR * moved_by[:, n_x:] / allowed, initial=0.0)
                of_states = np.max(_ERROR * moved_by[:, :n_x] / span[:, None], initial=0.0)
                excess[k, j] = max(of_inputs, of_states)
        over = np.flatnonzero([np.nanquantile(row, _SHARE) > 1.0 for row in excess])
        kept = int(over[0]) if len(over) else count
        time = self.task.time
        duration = float(time[-1] - time[0])
        length = duration if kept == count else max(kept, 1) * duration / count
        row, column = np.unravel_index(int(np.argmax(worst)), worst.shape) if worst.size else (0, 0)
        causes = [f"the initial '{s}'" for s in self.states] + [f"'{u}'" for u in driven]
        output = self.task.outputs[int(shown[row])] if len(shown) else ""
        return Growth(float(np.max(worst, initial=0.0)), output, causes[int(column)], length, duration)


class _BegunElsewhere(Wrapped):
    """Segments of a model that begin in the states that fit elsewhere."""

    def __init__(self, simulator: Segmented, begin: _Begin) -> None:
        self.simulator: Segmented = simulator
        self._begin = begin

    @property
    def token(self) -> str:
        """Identity of the model for fingerprints."""
        return f"{self.simulator.token} from {self._begin.digest.hex()} in {self._begin.origin.token}"

    @property
    def affinity(self) -> str:
        """The measurement."""
        return self.simulator.affinity

    def simulate(self, task: Task, parameters: Mapping[str, float]) -> FloatArray:
        """Return the concatenated predictions of the segments; see `Segmented.simulate`."""
        return self.simulator._begun(self._begin, task, parameters)


def _range(values: FloatArray) -> FloatArray:
    """Return the range of each row, 0 where it has no sample."""
    low, high = (np.where(np.isnan(values), end, values) for end in (np.inf, -np.inf))
    return np.asarray(np.maximum(np.max(high, axis=1) - np.min(low, axis=1), 0.0))


def _noise(values: FloatArray) -> FloatArray:
    """Return an upper bound of each row's noise that needs no model, from its second and fourth differences."""
    noise = []
    for row in values:
        known = row[np.isfinite(row)]
        two, four = np.diff(known, 2), np.diff(known, 4)
        levels = [np.sqrt(np.mean(two**2) / 6.0), np.sqrt(np.mean(four**2) / 70.0)] if len(four) else [0.0]
        noise.append(float(min(levels)))
    return np.array(noise)


def _size(values: FloatArray) -> float:
    """Return how much an input varies, or its level if it hardly varies."""
    level = float(np.sqrt(np.mean(np.square(values))))
    spread = float(np.std(values))
    return spread if spread > _ERROR * level else level


def in_place_of(old: Simulator, new: Simulator) -> Simulator:
    """Return `new`, in the segments of `old` if it has any."""
    return old.over(new) if isinstance(old, Segmented) else new


def states_of(simulator: Simulator, *, whole: bool = False) -> tuple[str, ...]:
    """Return the continuous states of a model from which a run can be started.

    A `whole` run may start from some of them: the others, as those of effects, begin as the model says.

    Raises
    ------
    ProblemError
        The model has no states, or they cannot be set.
    """
    states = simulator.states
    if not states:
        raise ProblemError(
            f"the model has no continuous states that can be set ({type(simulator).__name__})",
            fix="do not use segments, or use a single FMU that lists its states with exact start values",
        )
    refused = [s for s in states if s in simulator.unsettable]
    if whole and len(refused) < len(states):
        return tuple(s for s in states if s not in refused)
    if refused:
        raise ProblemError(
            f"the state '{refused[0]}' cannot be started from a given value: the FMU calculates it",
            fix="give it a number as start value, with fixed = true, instead of an initial equation or parameter",
        )
    return states


def open_loop(simulator: Segmented) -> Growth | None:
    """Return the growth of errors in a run simulated as a whole; None if the model fails in that simulation."""
    try:
        return simulator.growth
    except SimulationError:
        return None


def _bounds(time: FloatArray, counts: FloatArray, length: float, least: int) -> Iterator[int]:
    """Yield the first sample of every segment, and the number of samples.

    Segments with fewer than `least` measured samples are merged with the previous one.
    """
    duration = float(time[-1] - time[0])
    pieces = max(1, round(duration / length)) if math.isfinite(length) else 1
    total = np.concatenate([[0], np.cumsum(counts)])
    begin = 0
    yield begin
    # The last samples: rounding must not leave an empty segment.
    for k in range(1, pieces):
        at = int(np.searchsorted(time, time[0] + k * duration / pieces - 1e-9 * duration))
        enough = total[at] - total[begin] >= least and total[-1] - total[at] >= least
        if enough and at - begin >= 2 and len(time) - at >= 2:
            begin = at
            yield at
    yield len(time)


def _solved(matrix: FloatArray, right: FloatArray, damping: float = 0.0) -> FloatArray:
    """Return the damped least-squares solution, zero along directions that the samples do not show."""
    scale = np.linalg.norm(matrix, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    matrix = matrix / scale
    if damping:
        matrix = np.vstack([matrix, np.sqrt(damping) * np.eye(len(scale))])
        right = np.concatenate([right, np.zeros((len(scale), *right.shape[1:]))])
    solution = np.linalg.lstsq(matrix, right, rcond=_RANK)[0]
    return np.asarray(solution / (scale if solution.ndim == 1 else scale[:, None]))
