"""Linear response of a model's outputs to parameters that vary during a run.

A model is linearised along a simulated run: its Jacobians at the samples give, for every course of a parameter,
the course of each output. Any number of courses costs little more than one, so that many dependences of many
parameters can be compared before a model with one of them is built.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from fmu_build.model import CompiledModel, Variable
from fmuid.core.immutable import FloatArray
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.simulator import Task

_NEWTON = 6  # iterations for the unknowns of algebraic loops, which the run itself already gives to its tolerance
_LARGER = 1.25  # times a parameter: where another derivative tells the power that rates follow
_ROUGHLY = 0.01  # relative: derivatives that are less alike than this follow no power
_MOST = 1500  # samples of a run at which it is linearised; responses are lines between them


@dataclass(frozen=True, eq=False)
class LinearResponse:
    """The model along one run.

    Attributes
    ----------
    time
        (N,) times of the samples of the run.
    knots
        (K,) samples at which it is linearised.
    transition, driven
        (K-1, n, n) how states pass on from knot to knot, and (K-1, n, P) what a constant relative change of 1 of
        each parameter adds.
    observed, direct
        (K, q, n) and (K, q, P) derivatives of the outputs by the states, and by the relative changes.
    rates
        (K, n, P) derivatives of the states' rates by the relative changes.
    powers
        (P,) powers of the parameters that the rates follow: -1 for a mass; 1 where they follow none.
    """

    time: FloatArray
    knots: FloatArray
    transition: FloatArray
    driven: FloatArray
    observed: FloatArray
    direct: FloatArray
    rates: FloatArray
    powers: FloatArray

    def to(self, parameter: int, courses: FloatArray) -> FloatArray:
        """Return the (R, q, N) response of the outputs to (R, N) courses of a parameter's relative change."""
        at_knots = courses[:, self.knots.astype(np.intp)]
        middle = 0.5 * (at_knots[:, 1:] + at_knots[:, :-1])
        states = self._passed_on(self.driven[:, :, parameter, None] * middle.T[:, None, :])
        responses = (
            self.observed @ states + self.direct[:, :, parameter, None] * at_knots.T[:, None, :]
        )  # (K, q, R)
        if len(self.knots) == len(self.time):
            return responses.transpose(2, 1, 0)
        before, share = self._between
        here, there = (responses.transpose(2, 1, 0)[..., k] for k in (before, before + 1))
        return np.asarray(here + share * (there - here))

    @cached_property
    def _between(self) -> tuple[NDArray[np.intp], FloatArray]:
        """The knot before each sample, and the share of the way from it to the next one."""
        at = self.time[self.knots.astype(np.intp)]
        before = np.clip(np.searchsorted(at, self.time, side="right") - 1, 0, len(at) - 2)
        return before, (self.time - at[before]) / np.diff(at)[before]

    @cached_property
    def _blocks(self) -> tuple[FloatArray, FloatArray]:
        """The transitions in blocks, (b, s, n, n), and how states pass on from the beginning of each block."""
        steps, n = len(self.transition), self.transition.shape[-1]
        size = math.isqrt(steps) + 1
        count = -(-steps // size)
        padded = np.zeros((count * size, n, n))
        padded[:steps] = self.transition
        blocks = padded.reshape(count, size, n, n)
        products = np.array(blocks)
        for i in range(1, size):
            products[:, i] = blocks[:, i] @ products[:, i - 1]
        return blocks, products

    def _passed_on(self, added: FloatArray) -> FloatArray:
        """Return the (K, n, R) states that begin at zero and to which (K-1, n, R) are added from knot to knot.

        All blocks of knots begin at zero side by side; then the states at their beginnings are passed on.
        """
        blocks, products = self._blocks
        count, size, n, _ = blocks.shape
        columns = added.shape[-1]
        padded = np.zeros((count * size, n, columns))
        padded[: len(added)] = added
        inside = padded.reshape(count, size, n, columns)
        for i in range(1, size):
            inside[:, i] += blocks[:, i] @ inside[:, i - 1]
        begins = np.zeros((count, n, columns))
        for j in range(1, count):
            begins[j] = products[j - 1, -1] @ begins[j - 1] + inside[j - 1, -1]
        states = (inside + products @ begins[:, None]).reshape(count * size, n, columns)
        return np.concatenate([np.zeros((1, n, columns)), states[: len(added)]])


class Linearised:
    """A compiled model whose Jacobians are evaluated along runs.

    Parameters
    ----------
    model
        The model.
    parameters
        Names of the parameters that vary.
    """

    def __init__(self, model: CompiledModel, parameters: Sequence[str]) -> None:
        self._model = model
        self._by_name = {v.name: v for v in model.variables}
        self.parameters = [p for p in parameters if self._place(p, "p") is not None]

    def _place(self, name: str, vector: str) -> int | None:
        v = self._by_name.get(name)
        return v.location.index if v is not None and v.location.vector == vector else None

    @cached_property
    def _stored(self) -> Mapping[str, list[Variable]]:
        """The variable that shows each entry of the vectors of states, inputs and loop unknowns."""
        stored: dict[str, list[Variable]] = {}
        for vector, size in (("x", self._model.n_x), ("u", self._model.n_u), ("y", self._model.n_y)):
            shown: dict[int, Variable] = {}
            for v in self._model.variables:
                if v.location.vector == vector and (v.location.index not in shown or v.causality == "input"):
                    shown[v.location.index] = v
            stored[vector] = [shown[i] for i in range(size) if i in shown]
        return stored

    @property
    def states(self) -> list[str]:
        """Names of the states."""
        return [v.name for v in self._stored["x"]]

    @property
    def needed(self) -> list[str]:
        """Variables whose courses linearisation needs."""
        return [v.name for vector in ("x", "y") for v in self._stored[vector]]

    def kind(self, name: str) -> str:
        """Return the vector in which a variable is stored: x, u, p, v ...; empty if the model lacks it."""
        v = self._by_name.get(name)
        return "" if v is None else v.location.vector

    def direct(self, name: str) -> bool:
        """Return whether a variable is a state or an input."""
        return self.kind(name) in ("x", "u")

    def along(
        self,
        time: FloatArray,
        courses: Mapping[str, FloatArray],
        values: Mapping[str, float],
        outputs: Sequence[str],
    ) -> LinearResponse:
        """Linearise the model along a run.

        Parameters
        ----------
        time
            (N,) times.
        courses
            (N,) values of the states, inputs and unknowns of loops, by variable.
        values
            Values of parameters that differ from the model's own.
        outputs
            Variables whose responses are wanted.
        """
        m, f = self._model, self._model.functions
        knots = _knots(time)
        n = len(knots)

        def rows(vector: str, size: int) -> FloatArray:
            seeds = np.zeros((size, n))
            for v in self._stored[vector]:
                value = courses[v.name][knots] if v.name in courses else np.full(n, v.start or 0.0)
                seeds[v.location.index] = v.location.sign * value
            return seeds

        p = np.zeros(m.n_p)
        for given in ({v.name: v.start for v in m.variables if v.start is not None}, values):  # others are aliases
            for v in m.variables:
                if v.location.vector == "p" and v.name in given:
                    p[v.location.index] = v.location.sign * given[v.name]
        d = np.array(f["dependent"](p)).ravel()
        z = np.array(f["start"](p, d)[1]).ravel()
        environment = [
            time[knots][None, :],
            rows("x", m.n_x),
            rows("u", m.n_u),
            *(a[:, None] for a in (p, d, z, z)),
            np.zeros((m.n_m, 1)),
            rows("y", m.n_y),
        ]
        if m.n_m:
            environment[7] = (_evaluated(f["indicators"], environment)[0] > 0.0).astype(float)
        for _ in range(_NEWTON if m.n_y else 0):
            r, slope, _ = _matrices(f["loop"], environment)
            environment[8] = environment[8] - np.linalg.solve(slope, r)[..., 0].T
        return self._assembled(time, knots, environment, p, outputs)

    def _assembled(
        self,
        time: FloatArray,
        knots: FloatArray,
        environment: list[FloatArray],
        p: FloatArray,
        outputs: Sequence[str],
    ) -> LinearResponse:
        m, f = self._model, self._model.functions
        n, nx, ny = len(knots), m.n_x, m.n_y
        _, jacobian, _ = _matrices(f["jacobian"], environment)  # (n, nx + ny, nx + ny)
        zeros = [np.zeros((size, 1)) for size in (m.n_z, m.n_z)] if m.n_z else []
        moved, linearisations = np.zeros((n, nx + ny, len(self.parameters))), []
        powers = np.ones(len(self.parameters))

        def moves(at: FloatArray, seed: FloatArray) -> tuple[list[FloatArray], FloatArray]:
            computed = (at, np.array(f["dependent"](at)).ravel())
            place = [*environment[:3], *(a[:, None] for a in computed), *environment[5:]]
            followers = np.array(f["dependent_partials"](at, seed)).ravel()
            along = [a[:, None] for a in (seed, followers)]
            return along, _evaluated(f["move_partials"], [*place, *along, *zeros])[0].T

        for j, name in enumerate(self.parameters):
            seed = np.zeros(m.n_p)
            place = self._by_name[name].location
            seed[place.index] = p[place.index]  # a relative change
            along, moved[:, :, j] = moves(p, seed)
            linearisations.append(along)
            powers[j] = _power(moved[:, :, j], moves(p + (_LARGER - 1.0) * seed, seed)[1])
        # Unknowns of loops follow states and parameters.
        follow = np.zeros((n, ny, nx + len(self.parameters)))
        if ny:
            right = np.concatenate([jacobian[:, nx:, :nx], moved[:, nx:]], axis=2)
            follow = -np.linalg.solve(jacobian[:, nx:, nx:], right)
        a = jacobian[:, :nx, :nx] + jacobian[:, :nx, nx:] @ follow[:, :, :nx]
        b = moved[:, :nx] + jacobian[:, :nx, nx:] @ follow[:, :, nx:]
        seeds = [np.zeros((size, 1)) for size in (nx, m.n_u, m.n_p, m.n_d, ny)]

        def shown(which: int, entry: int) -> FloatArray:
            along = list(seeds)
            along[which] = np.zeros_like(seeds[which])
            along[which][entry] = 1.0
            return _evaluated(f["variable_partials"], [*environment, *along, *zeros])[0].T

        by_state = np.stack([shown(0, i) for i in range(nx)], axis=2) if nx else np.zeros((n, m.n_v, 0))
        by_parameter = np.zeros((n, m.n_v, len(self.parameters)))
        for j, (seed, followers) in enumerate(linearisations):
            along = [seeds[0], seeds[1], seed, followers, seeds[4]]
            by_parameter[:, :, j] = _evaluated(f["variable_partials"], [*environment, *along, *zeros])[0].T
        if ny:
            by_loop = np.stack([shown(4, i) for i in range(ny)], axis=2)
            by_state = by_state + by_loop @ follow[:, :, :nx]
            by_parameter = by_parameter + by_loop @ follow[:, :, nx:]
        tables = {
            "x": (np.broadcast_to(np.eye(nx), (n, nx, nx)), np.zeros((n, nx, len(self.parameters)))),
            "dx": (a, b), "y": (follow[:, :, :nx], follow[:, :, nx:]), "v": (by_state, by_parameter),
        }  # fmt: skip
        c, direct = np.zeros((n, len(outputs), nx)), np.zeros((n, len(outputs), len(self.parameters)))
        for i, name in enumerate(outputs):
            place = self._by_name[name].location
            if place.vector in tables:
                states, parameters = tables[place.vector]
                c[:, i], direct[:, i] = (
                    place.sign * states[:, place.index],
                    place.sign * parameters[:, place.index],
                )
        return _response(time, knots, (a, b), (c, direct), powers)


class LinearisedFmu:
    """An FMU for model exchange whose Jacobians are evaluated along runs.

    Derivatives by states are the FMU's directional derivatives where it offers them, else central differences.
    Those by parameters compare instances with other values, because parameters are fixed during a run.

    Parameters
    ----------
    fmu
        The FMU.
    parameters
        Names of the parameters that vary.
    """

    def __init__(self, fmu: Fmu, parameters: Sequence[str]) -> None:
        self._fmu = fmu
        self.parameters = list(parameters)

    @property
    def states(self) -> list[str]:
        """Names of the states."""
        return list(self._fmu.states)

    @property
    def needed(self) -> list[str]:
        """Variables whose courses linearisation needs."""
        return self.states

    def direct(self, name: str) -> bool:
        """Return whether a variable is a state or an input."""
        return name in self.states or self._fmu.variables[name].causality == "input"

    def along(
        self,
        time: FloatArray,
        courses: Mapping[str, FloatArray],
        values: Mapping[str, float],
        outputs: Sequence[str],
    ) -> LinearResponse:
        """Linearise the FMU along a run; see `Linearised.along`.

        Parameters that outputs depend on directly, or on which derivatives do not depend as quotients of lines,
        have the response zero.
        """
        fmu, knots = self._fmu, _knots(time)
        inputs = {n: u for n, u in courses.items() if n in fmu.variables and fmu.variables[n].causality == "input"}
        x = np.array([courses[n][knots] for n in self.states]).T
        settable = {
            n: v for n, v in values.items() if n in fmu.slots and not fmu.slots[n].refusal and n not in inputs
        }
        task = Task(time, inputs, tuple(outputs), settable)
        f, _, slopes = fmu.linearise(task, {}, knots, x)
        n, size, nx = len(knots), len(self.parameters), len(self.states)
        b = np.zeros((n, nx, size))
        for j, name in enumerate(self.parameters):
            p = settable.get(name, fmu.variables[name].start or 0.0)
            at = {k: fmu.linearise(task, {name: k * p}, knots, x, slopes=False) for k in _FACTORS}
            steady = all(np.allclose(y, at[_FACTORS[0]][1], rtol=1e-9, atol=0.0) for _, y, _ in at.values())
            low, high, far = (at[k][0] for k in _FACTORS[2:])
            if steady and _as_quotients(f, low, high, far):
                b[:, :, j] = (at[_FACTORS[1]][0] - at[_FACTORS[0]][0]) / (_FACTORS[1] - _FACTORS[0])
        c, direct = slopes[:, nx:], np.zeros((n, len(outputs), size))
        return _response(time, knots, (slopes[:, :nx], b), (c, direct), np.ones(size))


_FACTORS = (1.0 - 1e-4, 1.0 + 1e-4, 0.8, 1.25, 1.5)  # on a parameter: for derivatives by it, and for their shape


def _as_quotients(f: FloatArray, low: FloatArray, high: FloatArray, far: FloatArray) -> bool:
    """Return whether derivatives at the last factors are those of quotients of lines in a parameter."""
    first, second = high - f, high - low
    near = np.abs(second) <= 1e-9 * np.abs(f).max(axis=0)
    with np.errstate(all="ignore"):
        k = (0.5 * 0.45) / (0.7 * 0.25) * first / second  # as `between` in laws.c
        guessed = np.where(near, f, f + k * (f - low) / (1.0 - k))
    return bool(np.abs(guessed - far).max() <= 1e-3 * max(float(np.abs(far - f).max()), 1e-12))


def _knots(time: FloatArray) -> FloatArray:
    stride = -(-len(time) // _MOST)
    return np.unique([*range(0, len(time), stride), len(time) - 1])


def _response(
    time: FloatArray,
    knots: FloatArray,
    moving: tuple[FloatArray, FloatArray],
    shown: tuple[FloatArray, FloatArray],
    powers: FloatArray,
) -> LinearResponse:
    """Return the response of a model from the Jacobians of its derivatives and of its outputs."""
    a, b = moving
    nx, step = a.shape[1], np.diff(time[knots])[:, None, None]
    step = step.max() * np.round(step / step.max(), 9)  # equal ones differ in their last digits
    joined = np.zeros((len(knots) - 1, 2 * nx, 2 * nx))
    joined[:, :nx, :nx] = 0.5 * (a[1:] + a[:-1]) * step
    joined[:, :nx, nx:] = np.eye(nx) * step
    passed = joined
    if nx:  # that of a linear model is always the same
        different, one_of = np.unique(joined, axis=0, return_inverse=True)
        passed = expm(different)[one_of]
    driven = passed[:, :nx, nx:] @ (0.5 * (b[1:] + b[:-1]))
    return LinearResponse(time, knots, passed[:, :nx, :nx], driven, *shown, b, powers)


def _power(moved: FloatArray, farther: FloatArray) -> float:
    """Return the power that rates follow, from their derivatives at a parameter and at `_LARGER` times it."""
    energy, common = float(np.sum(moved**2)), float(np.sum(moved * farther))
    if energy <= 0.0 or common <= 0.0 or np.sum((farther - common / energy * moved) ** 2) > _ROUGHLY**2 * energy:
        return 1.0
    return 1.0 + float(np.log(common / energy) / np.log(_LARGER))


def _evaluated(function: Any, arguments: Sequence[FloatArray]) -> list[FloatArray]:
    """Return the (size, N) values of a function's vectors for (size, N) columns of its arguments.

    An argument that does not vary has one column: CasADi repeats it faster than it reads a wide one.
    """
    import casadi as ca  # only models with a source are linearised

    results = function(*(ca.DM(a) if a.size else ca.DM(*a.shape) for a in arguments))
    return [np.asarray(one.full()) for one in (results if isinstance(results, tuple | list) else [results])]


def _matrices(function: Any, arguments: Sequence[FloatArray]) -> list[FloatArray]:
    """Return the results of a function for each of N columns of its arguments as (N, rows, columns)."""
    n = arguments[0].shape[1]
    return [one.reshape(one.shape[0], n, -1).transpose(1, 0, 2) for one in _evaluated(function, arguments)]
