"""FMUs coupled by connections, used like a single model: a `fmuid.simulation.simulator.Simulator`."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from ctypes import POINTER, c_double, c_int32
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from fmu_build.suggest import suggestion
from fmuid.core.coupling import Connection, Linear, Master, Place, Port
from fmuid.core.errors import FmuError, SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.simulation import resets
from fmuid.simulation.band_limited import at_samples, refined
from fmuid.simulation.coupled.connection_checks import check_connections, check_ports
from fmuid.simulation.coupled.feedthrough import find_loop, loop_text, stepping_order
from fmuid.simulation.coupled.layout import Layout, System, Wiring
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.fmu_library import ProcessSpentError
from fmuid.simulation.simulator import Simulator, Task, Variable
from fmuid.simulation.stepper import FUNCTIONS, Outcome, Patience, library

_FATAL = 4
_CHECK_BUDGET = 0.5  # s for checking whether resets are equivalent to new instances
_MAX_LAYOUTS = 64 * 2**20  # bytes of task layouts kept in memory; the oldest is dropped first


class CoupledModel(Simulator):
    """Several FMUs stepped together by a master; a `Simulator`.

    A variable is named ``component.variable``; ports of the system have their own names. Between two communication
    points each FMU runs alone, with its connected inputs held or extrapolated linearly (Kübler and Schiehlen,
    2000). At a communication point, outputs with direct feedthrough are computed from the inputs at the end of the
    preceding step, as in FMI co-simulation; with ``loops = "iterate"`` the step of the FMUs that form a loop is
    repeated until inputs and outputs agree.

    Parameters
    ----------
    path
        Path for error messages.
    components
        FMUs by name, each a separate object.
    connections, ports
        Connections between the components, and ports to the outside.
    master
        Step size, algorithm and handling of loops.
    starts
        Start values that differ from the FMUs', by component and variable.
    experiment
        Suggested ``start`` and ``stop`` time, s, in place of those of the FMUs.
    main
        The component whose variables are named without a prefix; empty for none.
    reload
        A function and arguments that make the same model in another process.

    Raises
    ------
    FmuError
        A connection refers to something that does not exist or does not fit, an input has two sources, outputs
        form an algebraic loop, or an FMU lacks a capability that the master requires.
    UnitError
        Connected variables have incompatible units.
    """

    def __init__(
        self,
        path: Path,
        components: Mapping[str, Fmu],
        connections: Sequence[Connection],
        *,
        ports: Sequence[Port] = (),
        master: Master | None = None,
        starts: Mapping[str, Mapping[str, float]] | None = None,
        experiment: Mapping[str, float] | None = None,
        main: str = "",
        reload: tuple[Callable[..., CoupledModel], tuple[Any, ...]] | None = None,
    ) -> None:
        self.path, self.master = path, master or Master()
        self.connections, self.ports = tuple(connections), tuple(ports)
        check_connections(path, components, connections)
        check_ports(path, components, connections, ports)
        self._main = main
        self._reload, self._experiment = reload, experiment or {}
        self._starts = {name: dict(values) for name, values in (starts or {}).items()}
        self._wiring = self._wire(components)
        self._ports = {port.name: port for port in ports}
        if main and main not in components:
            raise FmuError(
                f"the main component '{main}' does not exist", where=path, fix=suggestion(main, components)
            )
        self._places: dict[str, Place] = {}
        for place in (Place(name, v) for name, fmu in components.items() for v in fmu.variables):
            if self._places.setdefault(place.variable if place.component == main else str(place), place) != place:
                raise FmuError(f"two variables are named '{place}'", where=path, fix="rename a component")
        self._variables = self._describe()
        self._view = MappingProxyType(self._variables)
        self._lock = threading.RLock()
        self._layouts: dict[tuple[int, tuple[str, ...]], Layout] = {}
        self._differentiates: dict[frozenset[str], bool] = {}
        self._patience = Patience()
        self._compared = False  # whether a reset was compared with a new instance

    @property
    def components(self) -> Mapping[str, Fmu]:
        """The FMUs by name, in the order they are stepped."""
        return self._wiring.components

    @property
    def variables(self) -> Mapping[str, Variable]:
        """Every variable by name; connected inputs are local."""
        return self._view

    @property
    def even_steps(self) -> bool:
        """True: the communication step is part of the definition of a coupled model."""
        return True

    def stepped(self, master: Master) -> CoupledModel:
        """Return a model of the same FMUs with another master."""
        return CoupledModel(
            self.path,
            self.components,
            self.connections,
            ports=self.ports,
            master=master,
            starts=self._starts,
            experiment=self._experiment,
            main=self._main,
            reload=(CoupledModel.stepped, (self, master)),
        )

    def home(self, name: str) -> Place:
        """Return the place of a variable, or the first place of a port."""
        self._known(name)
        return self._ports[name].ends[0][0] if name in self._ports else self._places[name]

    @property
    def name(self) -> str:
        """The model's name."""
        return self.path.stem

    @property
    def token(self) -> str:
        """A hash of the FMUs' tokens, their coupling and the settings of the master."""
        tokens = {name: fmu.token for name, fmu in self.components.items()}
        coupling = (tokens, self._main, self.connections, self.ports, sorted(self._starts.items()), self.master)
        return hashlib.sha256(repr(coupling).encode()).hexdigest()

    @property
    def files(self) -> tuple[Path, ...]:
        """The file of the system, and those of its FMUs."""
        return (self.path, *(fmu.path for fmu in self.components.values()))

    @property
    def default_experiment(self) -> Mapping[str, float]:
        """The suggestions of the FMUs: longest ``stop``, shortest ``step`` (s) and smallest ``tolerance``."""
        every = [fmu.default_experiment for fmu in self.components.values()]
        choices = {"start": min, "stop": max, "step": min, "tolerance": min}
        stated = {k: [e[k] for e in every if k in e] for k in choices}
        return {k: choices[k](values) for k, values in stated.items() if values} | dict(self._experiment)

    def differentiates(self, names: Collection[str]) -> bool:
        """Return whether runs can be differentiated with respect to `names`.

        They can if this is true of every FMU that a parameter reaches, by itself or through connections, and if
        what is connected there is real.
        """
        with self._lock:
            key = frozenset(names)
            if key not in self._differentiates:
                self._differentiates[key] = self._all_differentiate(key)
            return self._differentiates[key]

    def simulate(self, task: Task, parameters: Mapping[str, float]) -> FloatArray:
        """Return predictions, shape (len(task.outputs), N); see `fmuid.simulation.simulator.Simulator`.

        Raises
        ------
        FmuError
            A name is unknown or cannot be set or read; an FMU cannot be instantiated.
        SimulationError
            An FMU failed or ended the simulation, an output is not finite, or a loop could not be solved.
        """
        with self._lock:
            layout = self._lay_out(task, parameters)
            values = self._by_component(parameters)
            if self._compared:
                return at_samples(self._simulate(layout, values), layout.task)
            return at_samples(self._first(layout, values), layout.task)

    def close(self) -> None:
        """Free the instances and remove extracted files; the next simulation extracts them again."""
        with self._lock:
            self._layouts.clear()
            for fmu in self.components.values():
                fmu.close()

    def __reduce__(self) -> tuple[Any, ...]:
        if self._reload is None:
            raise TypeError("a coupled model built in Python code cannot be sent to another process")
        return self._reload

    def __repr__(self) -> str:
        return f"CoupledModel({str(self.path)!r}, {', '.join(self.components)})"

    def _wire(self, components: Mapping[str, Fmu]) -> Wiring:
        master = self.master
        feedthrough = {name: fmu.feedthrough for name, fmu in components.items()}
        loop = find_loop(self.connections, feedthrough)
        if loop and master.loops == "refuse":
            raise FmuError(
                f"algebraic loop: {loop_text(loop)}",
                where=self.path,
                fix='iterate it with loops = "iterate", or let the communication step delay it: loops = "delay"',
            )
        if not isinstance(master.extrapolation, str):
            for name in master.extrapolation:
                if name not in components:
                    raise FmuError(f"no component '{name}'", where=self.path, fix=suggestion(name, components))
        groups = stepping_order(list(components), self.connections, feedthrough)
        order = [name for group, _ in groups for name in group]
        ends: list[int] = []
        for group, looped in groups:
            iterated = looped and master.loops == "iterate"
            for name in group if iterated else ():
                fmu = components[name]
                if fmu.interface != "co-simulation" or not fmu.saves_state:
                    raise FmuError(
                        f"loop {loop_text(loop)} cannot be iterated: component '{name}' cannot go back to an "
                        "earlier state",
                        where=self.path,
                        fix='export it for co-simulation with canGetAndSetFMUstate, or write loops = "delay"',
                    )
            ends += [len(ends) + len(group) if iterated else 0, *([0] * (len(group) - 1))]
        return Wiring({name: components[name] for name in order}, self.connections, master, ends)

    def _describe(self) -> dict[str, Variable]:
        driven = {k.target for k in self.connections} | {
            p for port in self.ports if port.causality == "input" for p, _ in port.ends
        }
        passed = {p for port in self.ports if port.causality == "parameter" for p, _ in port.ends}
        variables: dict[str, Variable] = {}
        for name, place in self._places.items():
            variable = replace(self.components[place.component].variables[place.variable], name=name)
            start = self._starts.get(place.component, {}).get(place.variable, variable.start)
            if place in driven:
                variable = replace(variable, causality="local", start=None)
            elif place in passed:
                variable = replace(variable, causality="calculatedParameter", start=None)
            elif start != variable.start:
                variable = replace(variable, start=start)
            variables[name] = variable
        for port in self.ports:
            place, linear = port.ends[0]
            end = self.components[place.component].variables[place.variable]
            start = self._starts.get(place.component, {}).get(place.variable, end.start)
            if port.causality == "output" or start is None or linear.factor == 0.0:
                start = None
            else:
                start = (start - linear.offset) / linear.factor
            variables[port.name] = Variable(port.name, port.causality, end.variability, port.unit, start)
        return variables

    def _lay_out(self, task: Task, parameters: Mapping[str, float]) -> Layout:
        key = id(task), tuple(parameters)
        layout = self._layouts.get(key)
        if layout is None:
            fine = refined(task, self._variables)
            if fine.after or fine.linear:
                raise FmuError(
                    "coupled FMUs have one timing for all signals, which are read before the inputs act",
                    where=self.path,
                    fix='use timing = "held", "linear" or "band-limited"',
                )
            starts = self._by_component({k: v for k, v in task.start_values.items() if k not in parameters})
            inputs = {name: self._driven_by(name) for name in task.inputs}
            for name, ends in inputs.items():
                for start in (*task.start_values, *parameters):
                    if start == name or any(p == self._places.get(start) for p, _ in ends):
                        raise FmuError(
                            f"'{start}' has both a signal and a start value",
                            where=self.path,
                            fix="give one of them",
                        )
            signalled = {p for ends in inputs.values() for p, _ in ends} | {k.target for k in self.connections}
            merged = {
                name: {v: x for v, x in self._starts.get(name, {}).items() if Place(name, v) not in signalled}
                | values
                for name, values in starts.items()
            }
            layout = Layout(
                self._wiring,
                fine,
                asked=task,
                inputs=inputs,
                outputs=[self._shown_by(n) for n in task.outputs],
                starts=merged,
                along=self._along(task.along),
                where=self.path,
            )
            while self._layouts and sum(other.size for other in self._layouts.values()) > _MAX_LAYOUTS:
                self._layouts.pop(next(iter(self._layouts)))
            self._layouts[key] = layout  # keeps `task`, and so its id, alive
        return layout

    def _all_differentiate(self, names: Collection[str]) -> bool:
        try:
            moved = {place for name in names for place, _ in self._set_by(name)}
        except FmuError:
            return False
        reached = self._reached({place.component for place in moved})
        real = all(
            self.components[end.component].variables[end.variable].type in ("Real", "Float64")
            for k in self.connections
            if k.source.component in reached
            for end in (k.source, k.target)
        )
        return real and all(
            fmu.moves_inputs and fmu.differentiates({p.variable for p in moved if p.component == name})
            for name, fmu in self.components.items()
            if name in reached
        )

    def _reached(self, components: Collection[str]) -> set[str]:
        """Return the components and all that follow them through connections."""
        reached, count = set(components), -1
        while len(reached) != count:
            count = len(reached)
            reached |= {k.target.component for k in self.connections if k.source.component in reached}
        return reached

    def _along(self, directions: Sequence[Mapping[str, float]]) -> dict[str, list[dict[str, float]]]:
        """Return the directions by the components that they reach."""
        moved = {place.component for along in directions for name in along for place, _ in self._set_by(name)}
        moves = {component: [dict[str, float]() for _ in directions] for component in self._reached(moved)}
        for j, along in enumerate(directions):
            for name, weight in along.items():
                for place, linear in self._set_by(name):
                    move = moves[place.component][j]
                    move[place.variable] = move.get(place.variable, 0.0) + weight * linear.factor
        return moves

    def _by_component(self, values: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Return start values by component and variable."""
        by_component: dict[str, dict[str, float]] = {name: {} for name in self.components}
        for name, value in values.items():
            for place, linear in self._set_by(name):
                by_component[place.component][place.variable] = linear(value)
        return by_component

    def _set_by(self, name: str) -> Sequence[tuple[Place, Linear]]:
        variable = self._known(name)
        if name in self._ports and variable.causality != "output":
            return self._ports[name].ends
        place = self._places.get(name)
        for k in self.connections:
            if k.target == place:
                raise FmuError(
                    f"'{name}' follows '{k.source}': its start value cannot be set",
                    where=self.path,
                    fix=f"set what '{k.source}' depends on",
                )
        for port in self.ports:
            if port.causality != "output" and any(p == place for p, _ in port.ends):
                raise FmuError(f"'{name}' follows '{port.name}'", where=self.path, fix=f"set '{port.name}'")
        if place is None:
            raise FmuError(f"'{name}' is an output: its start value cannot be set", where=self.path)
        return ((place, Linear()),)

    def _driven_by(self, name: str) -> Sequence[tuple[Place, Linear]]:
        if self._known(name).causality != "input":
            raise FmuError(
                f"'{name}' is not an input of the system but has causality {self._variables[name].causality}",
                where=self.path,
                fix=suggestion(name, [n for n, v in self._variables.items() if v.causality == "input"]),
            )
        return self._set_by(name)

    def _shown_by(self, name: str) -> tuple[Place, Linear]:
        self._known(name)
        if name not in self._ports:
            return self._places[name], Linear()
        place, linear = self._ports[name].ends[0]
        if self._ports[name].causality == "output":
            return place, linear
        if linear.factor == 0.0:
            raise FmuError(f"'{name}' cannot be read back", where=self.path, fix=f"record '{place}'")
        return place, Linear(1.0 / linear.factor, -linear.offset / linear.factor)

    def _known(self, name: str) -> Variable:
        try:
            return self._variables[name]
        except KeyError:
            near = suggestion(name.removeprefix(f"{self._main}."), self._variables)
            raise FmuError(f"no variable '{name}'", where=self.path, fix=near) from None

    def _first(self, layout: Layout, values: Mapping[str, Mapping[str, float]]) -> FloatArray:
        """Simulate, and check whether a reset restores the FMUs to their initial state."""
        for fmu in self.components.values():
            if resets.deadly(fmu.token):
                fmu.renew("instantiate")
        begun = time.perf_counter()
        predictions = self._simulate(layout, values)
        elapsed = time.perf_counter() - begun
        n = len(layout.task.time)
        n = min(n, max(2, int(n * _CHECK_BUDGET / max(elapsed, 1e-9))))
        same = False
        new = [fmu.token for fmu in self.components.values() if fmu.renewal is None]
        with suppress(SimulationError), resets.first(*new):
            same = np.array_equal(self._simulate(layout, values, n), predictions[:, :n])
        how: Literal["reset", "instantiate"] = "reset" if same else "instantiate"
        for fmu in self.components.values():
            if fmu.renewal is None:
                fmu.renew(how)
        self._compared = True
        return predictions

    def _simulate(
        self, layout: Layout, values: Mapping[str, Mapping[str, float]], n_times: int | None = None
    ) -> FloatArray:
        prepared = []
        for name, fmu in self.components.items():
            try:
                prepared.append(fmu.prepare(layout.tasks[name], values[name]))
            except FmuError as refusal:
                raise self._located(refusal, name) from None
        layout.run_on(prepared)
        predictions = layout.outputs(n_times)
        system, finished, fatal, failed = layout.system, False, False, ""
        try:
            for (name, fmu), plan in zip(self.components.items(), prepared, strict=True):
                try:
                    fmu.engage(plan, self._patience, predictions.shape[-1])
                except (FmuError, ProcessSpentError) as refusal:
                    raise self._located(refusal, name) from None
            outcome = Outcome(self._patience.run_to_end(_master(), system, predictions.shape[-1]))
            if outcome == Outcome.DONE:
                finished = True
                return predictions
            failed, fmu = list(self.components.items())[system.failed]
            plan = prepared[system.failed].plan
            call = FUNCTIONS[plan.call] if outcome == Outcome.CALL_FAILED else None
            fatal = call is not None and plan.status == _FATAL
            if outcome == Outcome.LOOP_NOT_SOLVED:
                error = self._unsolved(plan.reached < 0, plan.reached_time)
            else:
                error = self._located(fmu.failure(outcome, prepared[system.failed]), failed)
        finally:
            if not finished:  # also on Ctrl-C, because the state of the FMUs is then unknown
                for name, other in self.components.items():
                    other.discard(fatal and name == failed)
        if call == "RESET":
            fmu.renew("instantiate")
            return self._simulate(layout, values, n_times)
        raise error

    def _unsolved(self, initialising: bool, at: float) -> SimulationError:
        loop = find_loop(self.connections, {name: fmu.feedthrough for name, fmu in self.components.items()})
        when = "in initialisation" if initialising else f"at t = {at:.9g} s"
        after = f"after {self.master.loop_iterations} iterations {when}"
        if loop:
            return SimulationError(f"the loop {loop_text(loop)} is not solved {after}", where=self.path.name)
        return SimulationError(f"connected outputs do not settle {after}", where=self.path.name)

    def _located(self, error: FmuError | SimulationError, component: str) -> Any:
        what = error.what[:1].lower() + error.what[1:] if error.what.startswith("It ") else error.what
        return type(error)(what, where=f"{self.path.name}, component '{component}'", fix=error.fix)


def _master() -> Callable[[System, int, float], int]:
    compiled = library()
    compiled.fmuid_run_coupled.argtypes = [POINTER(System), c_int32, c_double]
    compiled.fmuid_run_coupled.restype = c_int32
    master: Callable[[System, int, float], int] = compiled.fmuid_run_coupled
    return master
