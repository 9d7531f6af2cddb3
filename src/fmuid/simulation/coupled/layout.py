"""A task prepared for the components of a coupled system and their master: prepared once, run many times."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterable, Mapping, Sequence
from ctypes import POINTER, c_double, c_int32, c_int64, c_size_t, c_uint32, c_void_p
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmuid.core.coupling import Connection, Linear, Master, Place
from fmuid.core.errors import FmuError
from fmuid.core.immutable import FloatArray
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.fmu_plan import PreparedTask
from fmuid.simulation.simulator import Task
from fmuid.simulation.stepper import Plan

MAX_STEPS = 10**9


class Link(ctypes.Structure):
    """An input connected to an output; as in master.c."""

    _fields_ = (
        ("source", c_int32),
        ("from_", c_int32),
        ("component", c_int32),
        ("column", c_int32),
        ("linear", c_int32),
        ("unknown", c_int32),
        ("factor", c_double),
        ("offset", c_double),
        ("start", c_double),
        ("reference", c_uint32),
        ("unused", c_int32),
    )


class Feed(ctypes.Structure):
    """An input connected to a signal of the task; as in master.c."""

    _fields_ = (
        ("signal", c_int32),
        ("component", c_int32),
        ("column", c_int32),
        ("linear", c_int32),
        ("factor", c_double),
        ("offset", c_double),
    )


class Record(ctypes.Structure):
    """An output of the system; as in master.c."""

    _fields_ = (("source", c_int32), ("unused", c_int32), ("factor", c_double), ("offset", c_double))


class System(ctypes.Structure):
    """Everything one simulation of coupled FMUs needs; as in master.c."""

    _fields_ = (
        ("plans", POINTER(POINTER(Plan))),
        ("places", c_void_p),
        ("loops", c_void_p),
        ("states", c_void_p),
        ("links", POINTER(Link)),
        ("feeds", POINTER(Feed)),
        ("records", POINTER(Record)),
        ("n_components", c_int32),
        ("n_links", c_int32),
        ("n_feeds", c_int32),
        ("n_records", c_int32),
        ("n_values", c_int32),
        ("n_signals", c_int32),
        ("n_unknowns", c_int32),
        ("gauss_seidel", c_int32),
        ("iterations", c_int32),
        ("tolerance", c_double),
        ("n_times", c_int64),
        ("time", c_void_p),
        ("steps", c_void_p),
        ("signals", c_void_p),
        ("outputs", c_void_p),
        ("window", c_void_p),
        ("before", c_void_p),
        ("now", c_void_p),
        ("next", c_void_p),
        ("n_directions", c_size_t),
        ("before_slopes", c_void_p),
        ("now_slopes", c_void_p),
        ("next_slopes", c_void_p),
        ("seeds", c_void_p),
        ("rates", c_void_p),
        ("driven", c_void_p),
        ("known", c_void_p),
        ("members", c_void_p),
        ("unknowns", c_void_p),
        ("residual", c_void_p),
        ("last", c_void_p),
        ("change", c_void_p),
        ("scale", c_void_p),
        ("moved", c_void_p),
        ("left", c_void_p),
        ("inverse", c_void_p),
        ("reached", c_int64),
        ("step", c_int32),
        ("failed", c_int32),
        ("step_before", c_double),
        ("taken", c_double),
    )


@dataclass(frozen=True, slots=True)
class Wiring:
    """The part common to all tasks: components in stepping order, connections and master settings.

    Parameters
    ----------
    loops
        For each component, the (exclusive) end in stepping order of the iterated loop that begins with it; 0 if
        none begins there.
    """

    components: Mapping[str, Fmu]
    connections: Sequence[Connection]
    master: Master
    loops: Sequence[int]


class Layout:
    """A `System` for one task, with the arrays it points to and the task of each component.

    Parameters
    ----------
    inputs
        For each input of the task, the variables of components that it sets.
    outputs
        The variable that each output of the task shows.
    starts
        Start values from the task, by component.
    along
        The task's directions, by each component whose outputs move along one.
    """

    def __init__(
        self,
        wiring: Wiring,
        task: Task,
        *,
        asked: Task,
        inputs: Mapping[str, Sequence[tuple[Place, Linear]]],
        outputs: Sequence[tuple[Place, Linear]],
        starts: Mapping[str, Mapping[str, float]],
        along: Mapping[str, Sequence[Mapping[str, float]]],
        where: object,
    ) -> None:
        self.task, self.asked = task, asked
        self._loops = wiring.loops
        self._kept: list[Any] = []  # arrays the system points into
        names = list(wiring.components)
        number = {name: i for i, name in enumerate(names)}
        columns: dict[str, dict[str, int]] = {name: {} for name in names}
        for place in [k.target for k in wiring.connections] + [p for ends in inputs.values() for p, _ in ends]:
            columns[place.component].setdefault(place.variable, len(columns[place.component]))
        rows: dict[str, dict[str, int]] = {name: {} for name in names}
        for place in [k.source for k in wiring.connections] + [p for p, _ in outputs]:
            rows[place.component].setdefault(place.variable, len(rows[place.component]))
        places = np.cumsum([0, *(len(rows[name]) for name in names)])
        source = {
            Place(name, v): int(places[i]) + row for i, name in enumerate(names) for v, row in rows[name].items()
        }
        steps = _steps(wiring, task, where)
        self.window = np.array([task.time[0], task.time[0] + (task.time[1] - task.time[0]) / steps[0]])
        ahead = task.interpolation == "linear"
        driven = {p.component for ends in inputs.values() for p, _ in ends}
        self.tasks = {
            name: Task(
                self.window,
                {v: np.full(2, _start(wiring.components[name], v)) for v in columns[name]},
                tuple(rows[name]),
                starts.get(name, {}),
                "linear" if wiring.master.extrapolates(name) or (ahead and name in driven) else "hold",
                task.tolerance,
                tuple(along.get(name, ())),
            )
            for name in names
        }
        system = self.system = System()
        links, unknowns = [], 0
        for k in wiring.connections:
            inside = _together(wiring.loops, number[k.source.component], number[k.target.component])
            links.append(
                Link(
                    source[k.source],
                    number[k.source.component],
                    number[k.target.component],
                    columns[k.target.component][k.target.variable],
                    wiring.master.extrapolates(k.target.component) and _smooth(wiring, k),
                    unknowns if inside else -1,
                    *k.linear,
                    _start(wiring.components[k.target.component], k.target.variable),
                    wiring.components[k.target.component].slots[k.target.variable].reference,
                )
            )
            unknowns += inside
        feeds = [
            Feed(
                j,
                number[p.component],
                columns[p.component][p.variable],
                ahead and wiring.components[p.component].variables[p.variable].variability == "continuous",
                *linear,
            )
            for j, ends in enumerate(inputs.values())
            for p, linear in ends
        ]
        records = [Record(source[p], 0, *linear) for p, linear in outputs]
        system.n_components, system.n_values = len(names), int(places[-1])
        system.n_links, system.links = self._structures(Link, links)
        system.n_feeds, system.feeds = self._structures(Feed, feeds)
        system.n_records, system.records = self._structures(Record, records)
        system.n_signals, system.n_times, system.n_unknowns = len(inputs), len(task.time), unknowns
        system.gauss_seidel = wiring.master.algorithm == "gauss_seidel"
        system.tolerance, system.iterations = wiring.master.loop_tolerance, wiring.master.loop_iterations
        self.signals = np.empty((len(task.time), len(inputs)))
        for j, name in enumerate(inputs):
            self.signals[:, j] = _samples(task, name, where)
        self.size = self.signals.nbytes
        system.places, system.loops = self._pointer(places, "i4"), self._pointer(np.array(wiring.loops), "i4")
        system.time, system.steps = self._pointer(task.time), self._pointer(steps, "i4")
        system.signals, system.window = self._pointer(self.signals), self._pointer(self.window)
        system.states = self._pointer(np.zeros(len(names)), "u8")
        system.known, system.members = (self._pointer(np.zeros(n + 1), "i4") for n in (len(names), unknowns))
        for name in ("before", "now", "next"):
            setattr(system, name, self._pointer(np.zeros(system.n_values + 1)))
        system.n_directions = len(task.along)
        for name in ("before_slopes", "now_slopes", "next_slopes"):
            setattr(system, name, self._pointer(np.zeros(system.n_values * len(task.along) + 1)))
        system.seeds, system.rates = (self._pointer(np.zeros(len(links) * len(task.along) + 1)) for _ in range(2))
        system.driven = self._pointer(np.zeros(len(links) + 1), "u4")
        for name in ("unknowns", "residual", "last", "change", "scale"):
            setattr(system, name, self._pointer(np.zeros(unknowns * (1 + len(task.along)) + 1)))
        for name in ("moved", "left"):
            setattr(system, name, self._pointer(np.zeros(unknowns + 1)))
        system.inverse = self._pointer(np.zeros(unknowns * unknowns + 1))
        before_end, end = float(task.time[-2]), float(task.time[-1])
        last = before_end + (end - before_end) * ((int(steps[-1]) - 1) / int(steps[-1]))
        self._stop = max(float(np.max(task.time[:-1] + np.diff(task.time))), last + (end - last))

    def run_on(self, prepared: Sequence[PreparedTask]) -> None:
        """Point the system at the components' plans, in stepping order."""
        plans = (POINTER(Plan) * len(prepared))(*(ctypes.pointer(p.plan) for p in prepared))
        for i, p in enumerate(prepared):
            p.plan.time, p.plan.stop = self.system.window, self._stop
            p.plan.rewinds = _together(self._loops, i, i)
        self._plans = plans, [p.outputs() for p in prepared]  # the master does not write to these
        self.system.plans = ctypes.cast(plans, POINTER(POINTER(Plan)))

    def outputs(self, n_times: int | None = None) -> FloatArray:
        """Return a new array for the predictions of all or `n_times` samples, and point the system at it."""
        self.system.n_times = len(self.task.time) if n_times is None else n_times
        array = np.empty((self.system.n_records * (1 + len(self.task.along)), self.system.n_times))
        self.system.outputs = array.__array_interface__["data"][0]
        return array

    def _pointer(self, array: NDArray[Any], dtype: str = "f8") -> int:
        array = np.ascontiguousarray(array, dtype=dtype)
        self._kept.append(array)
        address: int = array.__array_interface__["data"][0]
        return address

    def _structures(self, kind: type[ctypes.Structure], items: Sequence[Any]) -> tuple[int, Any]:
        array = (kind * max(1, len(items)))(*items)
        self._kept.append(array)
        return len(items), ctypes.cast(array, POINTER(kind))


def _steps(wiring: Wiring, task: Task, where: object) -> NDArray[np.int32]:
    """Return the number of communication steps between the samples."""
    time = task.time
    if time.ndim != 1 or len(time) < 2 or not np.isfinite(time).all() or np.any(np.diff(time) <= 0):
        raise FmuError("times must be at least two, finite and strictly increasing", where=where, fix="check them")
    size, step = np.diff(time), wiring.master.step or math.inf
    count = np.maximum(1.0, np.ceil(size / step * (1 - 1e-9)))
    if count.sum() > MAX_STEPS:
        raise FmuError(f"takes {count.sum():.3g} communication steps", where=where, fix="take a longer step")
    for name, fmu in wiring.components.items():
        fmu.check_steps(size / count, f"{where}, component '{name}'")
    return count.astype(np.int32)


def _samples(task: Task, name: str, where: object) -> FloatArray:
    values = task.inputs[name]
    if values.shape != task.time.shape or not np.isfinite(values).all():
        raise FmuError(
            f"input '{name}' must have {len(task.time)} finite samples, one for each time",
            where=where,
            fix="an input may not have missing samples",
        )
    return values


def _start(fmu: Fmu, variable: str) -> float:
    return fmu.variables[variable].start or 0.0


def _smooth(wiring: Wiring, k: Connection) -> bool:
    ends = (
        wiring.components[k.source.component].variables[k.source.variable],
        wiring.components[k.target.component].variables[k.target.variable],
    )
    return all(v.variability == "continuous" for v in ends)


def _together(loops: Iterable[int], a: int, b: int) -> bool:
    """Return whether components a and b belong to the same iterated loop."""
    return any(first <= a < end and first <= b < end for first, end in enumerate(loops))
