"""Simulating any FMU: FMI 2.0 and 3.0, co-simulation and model exchange. Only this module imports FMPy."""

from __future__ import annotations

import functools
import os
import re
import shutil
import stat
import tempfile
import threading
import time
import weakref
import zipfile
import zlib
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from types import MappingProxyType, TracebackType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fmuid.core import scratch
from fmuid.core.campaign import Interface
from fmuid.core.errors import FmuError, SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.simulation import resets, stepper
from fmuid.simulation.band_limited import at_samples
from fmuid.simulation.branches import Branches
from fmuid.simulation.fmu_description import DescribedInterface, FmuDescription, library_name, read_description
from fmuid.simulation.fmu_library import FmuLibrary, ProcessSpentError
from fmuid.simulation.fmu_plan import UNKNOWN_TOLERANCE, PreparedTask, PreparedTasks, check_steps
from fmuid.simulation.fmu_variables import (
    MAX_VARIABLES,
    Slot,
    elements_of,
    in_words,
    read_feedthrough,
    read_variables,
)
from fmuid.simulation.simulator import EndedError, Simulator, Task, Variable
from fmuid.simulation.stepper import DONE, FUNCTIONS, Outcome

_STATUS = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")
_FATAL = 4
_CHECK_BUDGET = 0.5  # s for checking whether a reset is equivalent to a new instance


class Fmu(Simulator):
    """An FMU, extracted once, instantiated once and reset between simulations; a `Simulator`.

    Parameters
    ----------
    path
        The ``.fmu`` file.
    interface
        ``co-simulation`` or ``model exchange``; None chooses co-simulation if the FMU supports it.

    Notes
    -----
    * Inputs without a signal in the task keep their start value.
    * Start values can be set for parameters (fixed and tunable), for inputs, and for variables with ``initial``
      exact (the states' start values) or approx (a guess that the FMU may change), before initialisation.
    * Integer, Boolean and enumeration variables are set by their FMI type and take whole numbers only.
    * The first simulation is repeated after a reset (for up to half a second); an FMU whose reset is missing,
      fails or changes the predictions is instantiated anew for every simulation; `renewal` says which method is
      used. If the reset crashes, it ends one worker process of a pool, and the other workers instantiate anew.
      FMUs from ``fmuid build`` can be reset.
    * After a failed simulation the next one gets a new instance, and after fmi2Fatal a new copy of the library, so
      predictions depend only on the parameters, not on earlier simulations.
    * One object runs one simulation at a time; use processes for parallel simulations (`simulation.pool.workers`).

    Raises
    ------
    FmuError
        The file is not an FMU, has an FMI version other than 2.0 and 3.0, contains unsafe file names, or lacks a
        library for this machine or an interface that can be simulated.
    """

    def __init__(self, path: str | Path, interface: Interface | None = None) -> None:
        self.path = Path(path)
        self._file = self.path.resolve()  # the working folder may change, in workers too
        self._asked = interface
        self._description = _read_description(self.path)
        self.version = _major_version(self._description.version, self.path)
        self._interface = self._choose(interface)
        self._described = self._offered()[self.interface]
        self._variables, self._slots = read_variables(self._description, self.version, self.path)
        self._view = MappingProxyType(self._variables)
        self._lock = threading.RLock()
        self._library: FmuLibrary | None = None
        self._folder: Path | None = None
        self._instance: int | None = None
        self._instantiated = False  # at any time in this process
        self._used = False  # the instance has simulated and needs a reset
        self._renewal: Literal["reset", "instantiate"] | None = None
        self._set_before: dict[str, None] = {}
        self._differentiates: dict[frozenset[str], bool] = {}
        self._prepared = PreparedTasks()
        self._branches = Branches()
        self._patience = stepper.Patience()

    @property
    def variables(self) -> Mapping[str, Variable]:
        """Every scalar variable by name; arrays of FMI 3.0 element by element, as ``table[1,2]``."""
        return self._view

    @property
    def slots(self) -> Mapping[str, Slot]:
        """Location of each variable in the FMU, by name."""
        return MappingProxyType(self._slots)

    @property
    def name(self) -> str:
        """The model's name."""
        return self._description.name

    @property
    def tool(self) -> str:
        """The tool that made the FMU."""
        return self._description.tool or "unknown"

    @property
    def description(self) -> FmuDescription:
        """The model description."""
        return self._description

    @property
    def token(self) -> str:
        """The FMU's guid (FMI 2.0) or instantiation token (FMI 3.0)."""
        return self._description.token

    @property
    def files(self) -> tuple[Path, ...]:
        """The ``.fmu`` file."""
        return (self.path,)

    @property
    def interface(self) -> Interface:
        """How the FMU is simulated."""
        return self._interface

    @property
    def unsettable(self) -> frozenset[str]:
        """The states that the FMU calculates or that cannot be set exactly."""
        return frozenset(s for s in self.states if self._slots[s].refusal or not self._slots[s].exact)

    @property
    def default_experiment(self) -> Mapping[str, float]:
        """The FMU's suggestions for ``start``, ``stop``, ``step`` (s) and ``tolerance``, if any."""
        return MappingProxyType(dict(self._description.default_experiment))

    @property
    def default_tolerance(self) -> float:
        """The relative tolerance for tasks that name none, if the FMU states one."""
        return self.default_experiment.get("tolerance", UNKNOWN_TOLERANCE)

    @property
    def even_steps(self) -> bool:
        """Whether the FMU takes communication steps of one size only."""
        return not self._described.any_step

    def check_steps(self, steps: FloatArray, where: object) -> None:
        """Raise FmuError unless the FMU can take these communication steps (s); see `fmu_plan.check_steps`."""
        check_steps(steps, self._described, where)

    @property
    def interpolates_inputs(self) -> bool:
        """Whether the FMU interpolates its inputs between communication points."""
        return self.interface == "co-simulation" and self._described.interpolates_inputs

    @property
    def saves_state(self) -> bool:
        """Whether the FMU can be restored to an earlier state."""
        return self._described.saves_state

    @property
    def needed_tool(self) -> str | None:
        """The tool that must be installed to simulate the FMU (needsExecutionTool), None if it needs none."""
        return self.tool if self._described.needs_tool else None

    @property
    def states(self) -> tuple[str, ...]:
        """The continuous states, as the FMU names them; arrays of FMI 3.0 element by element."""
        return tuple(self.derivatives)

    @property
    def derivatives(self) -> Mapping[str, str]:
        """The variable that is the derivative of each state; arrays of FMI 3.0 element by element."""
        elements = {v.name: elements_of(v) for v in self._description.variables}
        pairs = zip(self._description.states, self._description.derivatives, strict=True)
        return {s: d for pair in pairs for s, d in zip(*(elements[n] for n in pair), strict=True)}

    @functools.cached_property
    def directional_references(self) -> NDArray[np.uint32] | None:
        """References of the derivatives, then of the states; None without directional derivatives."""
        slots = [self._slots[name] for name in (*self.derivatives.values(), *self.states)]
        given = self._described.directional and len(slots) == 2 * self._description.n_states
        if not given or any(slot.size != 1 for slot in slots):
            return None
        return np.array([slot.reference for slot in slots], dtype=np.uint32)

    @property
    def feedthrough(self) -> Mapping[str, frozenset[str]]:
        """The inputs on which each output depends without delay; all inputs if the FMU does not say."""
        return read_feedthrough(self._description, self._variables)

    def literals(self, name: str) -> Mapping[str, int]:
        """Return the values of an enumeration variable by their names, empty for other variables."""
        return next((v.literals for v in self._description.variables if v.name == name), {})

    @property
    def renewal(self) -> Literal["reset", "instantiate"] | None:
        """How the FMU is renewed between simulations; None before the first one."""
        return self._renewal

    def simulate(self, task: Task, parameters: Mapping[str, float]) -> FloatArray:
        """Return predictions, shape (len(task.outputs), N); see `fmuid.simulation.simulator.Simulator`.

        Parameters
        ----------
        task
            Times, inputs and outputs; prepared for the FMU once and kept as long as the task is in use.
        parameters
            Start values by variable name; they take precedence over the task's.

        Raises
        ------
        FmuError
            A name is unknown or cannot be set or read; the FMU cannot be instantiated.
        EndedError
            The FMU ended the simulation; the error has the predictions up to then.
        SimulationError
            The FMU failed, or an output is not finite.
        """
        with self._lock:
            prepared = self.prepare(task, parameters)
            if self._renewal is None and resets.deadly(self.token):
                self._renewal = "instantiate"
            if self._renewal is None:
                return at_samples(self._first(prepared), prepared.task)
            return at_samples(self._simulate(prepared), prepared.task)

    def renew(self, how: Literal["reset", "instantiate"]) -> None:
        """Renew the FMU in this way from now on, as determined by simulating."""
        self._renewal = how

    def differentiates(self, names: Collection[str]) -> bool:
        """Return whether runs can be differentiated with respect to `names`; true of FMUs from ``fmuid build``."""
        with self._lock:
            key = frozenset(names)
            if key not in self._differentiates:
                slots = [self._slots.get(name) for name in sorted(key)]
                references = [s.reference for s in slots if s is not None and s.size == 1 and s.suffix]
                ours = self.tool == "fmuid"  # no other FMU is loaded into this process for the question
                self._differentiates[key] = (
                    ours and len(references) == len(slots) and self._try_directions(references)
                )
            return self._differentiates[key]

    @property
    def moves_inputs(self) -> bool:
        """Whether inputs can move with parameters in runs with derivatives; FMUs of earlier versions cannot."""
        with self._lock:
            return self.differentiates(()) and bool(
                self._load().functions[FUNCTIONS.index("SET_INPUT_DIRECTIONS")]
            )

    def _try_directions(self, references: Sequence[int]) -> bool:
        library = self._load()
        if library.functions[FUNCTIONS.index("SET_DIRECTIONS")] is None:
            return False
        instance = library.instantiate(self.name, self.token, ((self._folder or Path()) / "resources").resolve())
        try:
            return library.takes_directions(instance, references)
        finally:
            library.free(instance)

    def close(self) -> None:
        """Free the instance and remove the extracted files; the next simulation extracts them again."""
        with self._lock:
            self.discard()
            self._library = None
            self._prepared.clear()
            if self._folder is not None:
                shutil.rmtree(self._folder, ignore_errors=True)
                self._folder = None

    def __enter__(self) -> Fmu:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, ...]:
        return load_fmu, (self._file, self._asked)

    def __repr__(self) -> str:
        return f"Fmu({str(self.path)!r}, FMI {self._description.version}, {self.interface})"

    def _offered(self) -> dict[Interface, DescribedInterface]:
        both: dict[Interface, DescribedInterface | None] = {
            "co-simulation": self._description.co_simulation,
            "model exchange": self._description.model_exchange,
        }
        return {name: described for name, described in both.items() if described is not None}

    def _choose(self, asked: Interface | None) -> Interface:
        offered = list(self._offered())
        if not offered or (asked is not None and asked not in offered):
            raise FmuError(
                f"offers {' and '.join(offered) or 'scheduled execution only'}"
                + (f", not {asked}" if asked else ""),
                where=self.path,
                fix=f"export it for {asked or 'co-simulation'}",
            )
        chosen = asked or offered[0]
        clocks = [v.name for v in self._description.variables if v.type == "Clock" and v.causality == "input"]
        if chosen == "model exchange" and clocks:
            raise FmuError(
                f"has the input clock '{clocks[0]}', and clocks are not supported in model exchange",
                where=self.path,
                fix="export it for co-simulation",
            )
        return chosen

    def _load(self) -> FmuLibrary:
        if self._library is None:
            self._folder = extract(self.path, without=_NOT_RUN)
            weakref.finalize(self, _remove, self._folder, os.getpid())
            library = self._folder / "binaries" / library_name(self.version, self._described.identifier)
            if not library.is_file():
                there = sorted(p.name for p in (self._folder / "binaries").glob("*") if any(p.iterdir()))
                raise FmuError(
                    f"has no library for {library.parent.name} (it has: {', '.join(there) or 'none'})",
                    where=self.path,
                    fix="export it for this machine, or compile its sources with `fmpy compile`",
                )
            self._library = FmuLibrary(library, self.version, self.interface == "model exchange", self.path)
            functions = dict(zip(FUNCTIONS, self._library.functions, strict=True))
            if functions["RESET"] is None:
                self._renewal = "instantiate"
            elif self.saves_state and functions["SET_DIRECTIONS"] is not None:
                # of `fmuid build`, not one with laws around another tool's: it does all that instantiating does
                self._renewal = "reset"
        return self._library

    def prepare(self, task: Task, parameters: Mapping[str, float]) -> PreparedTask:
        """Return the task prepared for this FMU, with `parameters` for the next run."""
        names = tuple(parameters)
        prepared = self._prepared.get(task, names)
        if prepared is None:
            library = self._load()
            prepared = PreparedTask(
                task,
                names,
                list(self._set_before),
                variables=self._variables,
                slots=self._slots,
                library=library,
                described=self._description,
                linear_inputs=self.interpolates_inputs,
                interface=self._described,
                directional_references=self.directional_references,
            )
            new = [n for n in (*names, *task.start_values) if n not in self._set_before]
            if new:  # tasks prepared earlier must restore these from now on
                self._set_before.update(dict.fromkeys(new))
                self._prepared.clear()
            self._prepared.add(prepared)
        prepared.set_parameters(parameters)
        return prepared

    def _first(self, prepared: PreparedTask) -> FloatArray:
        """Simulate, and check whether a reset restores the FMU to its initial state."""
        begun = time.perf_counter()
        predictions = self._simulate(prepared)
        elapsed = time.perf_counter() - begun
        if self._renewal is None:  # not rejected meanwhile
            n = len(prepared.task.time)
            n = min(n, max(2, int(n * _CHECK_BUDGET / max(elapsed, 1e-9))))
            same = False
            with suppress(SimulationError), resets.first(self.token):
                again = self._simulate(prepared, n)
                same = np.array_equal(again, predictions[:, :n])
            if self._renewal is None:
                self._renewal = "reset" if same else "instantiate"
        return predictions

    def linearise(
        self, task: Task, parameters: Mapping[str, float], knots: FloatArray, x: FloatArray, *, slopes: bool = True
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Evaluate the FMU for model exchange, initialised as for a run, at points of it.

        Derivatives by the states are the FMU's own where it offers directional derivatives.

        Parameters
        ----------
        task, parameters
            The run.
        knots
            (K,) numbers of samples: their times and inputs are used.
        x
            (K, n) states there.
        slopes
            Whether to return derivatives by the states as well.

        Returns
        -------
        f, y, derivatives
            (K, n) derivatives, (K, q) outputs, and (K, n + q, n) derivatives of both by the states.

        Raises
        ------
        SimulationError
            The FMU cannot be evaluated there.
        """
        with self._lock:
            prepared = self.prepare(task, parameters)
            plan, places = prepared.plan, knots.astype(np.intp)
            k, n, q = len(places), x.shape[1], len(task.outputs)
            times = np.ascontiguousarray(prepared.task.time[places])
            inputs = np.ascontiguousarray(prepared.inputs[places])
            x = np.ascontiguousarray(x)
            steps = 1e-5 * np.maximum(np.abs(x).max(axis=0), 1e-6)
            names = [*self.states, *self.derivatives.values(), *task.outputs]
            references = np.array([self._slots[name].reference for name in names], dtype=np.uint32)
            offered = self.directional_references is not None and all(
                self._slots[n].size == 1 for n in task.outputs
            )
            f, y, rows = np.zeros((k, n)), np.zeros((k, q)), np.zeros((k, n, n + q))
            self.engage(prepared, stepper.Patience(), k)
            arrays = (times, x, inputs, steps, references, f, y, rows, np.zeros(3 * n + 2 * q + 1))
            used = [a.ctypes.data for a in arrays]
            used[4] = used[4] if offered else None
            used[7] = used[7] if slopes else None
            outcome = stepper.library().fmuid_linearise(plan, k, *used)
            if outcome != Outcome.DONE:
                error = self.failure(Outcome(outcome), prepared)
                self.discard(plan.status == _FATAL)
                raise error
            return f, y, rows.transpose(0, 2, 1)

    def engage(self, prepared: PreparedTask, patience: stepper.Patience, n_times: int) -> None:
        """Give the plan an instance to run on, a new one if a reset is not equivalent; see `discard`.

        No communication step may take longer than a run over `n_times` points, if the FMU can look at the clock.
        """
        library = self._load()
        if self._used and self._renewal == "instantiate":
            self.discard()
        if self._instance is None:
            resources = (self._folder or Path()) / "resources"
            try:
                self._instance = library.instantiate(self.name, self.token, resources.resolve())
            except FmuError as error:
                if not self._instantiated and self._described.needs_tool:
                    fix = f"install {self.tool} and its licence: the FMU needs them (needsExecutionTool)"
                    raise FmuError(error.what, where=self.path, fix=fix) from None
                if not self._instantiated:
                    raise
                raise ProcessSpentError(
                    "can neither be reset nor be instantiated again in one process",
                    where=self.path.name,
                    fix="simulate it in worker processes (`fmuid.WorkerPool`), which are restarted for it",
                ) from None
            self._used, self._instantiated = False, True
        library.limit(self._instance, patience, n_times)
        prepared.plan.instance = self._instance
        prepared.plan.reset = int(self._used)
        self._used = True

    def _simulate(self, prepared: PreparedTask, n_times: int | None = None) -> FloatArray:
        plan = prepared.plan
        predictions = prepared.outputs(n_times)
        n_points = predictions.shape[-1]
        self.engage(prepared, self._patience, n_points)
        shares = prepared.task.shared is not None and self.saves_state
        key = self._branches.begin(prepared, predictions) if shares else None
        fatal = False
        finished = False
        try:
            outcome = self._patience.run_to_end(_run(), plan, n_points)
            if outcome == DONE:
                finished = True
                return predictions
            failed = FUNCTIONS[plan.call] if outcome == Outcome.CALL_FAILED else None
            fatal = failed is not None and plan.status == _FATAL
            error = self.failure(Outcome(outcome), prepared)
            if outcome == Outcome.TERMINATED and plan.reached >= 0:
                known = at_samples(predictions[:, : plan.reached + 1].copy(), prepared.task)
                fix = "compare it with runs that end by then (fmuid import --cut)"
                error = EndedError(error.what, where=error.where, fix=fix, predictions=known)
        finally:
            if key is not None and not fatal:
                self._branches.end(key, prepared, predictions if finished else None)
            if not finished:  # also on Ctrl-C, because the state of the FMU is then unknown
                self.discard(fatal)
        if failed == "RESET":
            self._renewal = "instantiate"
            return self._simulate(prepared, n_times)
        raise error

    def failure(self, outcome: Outcome, prepared: PreparedTask) -> SimulationError:
        """Return the error of a run that ended with `outcome`, with the FMU's messages."""
        plan, library = prepared.plan, prepared.library
        at = f"at t = {plan.reached_time:.9g} s"
        if outcome == Outcome.CALL_FAILED:
            function = library.function_name(FUNCTIONS[plan.call])
            status = _STATUS[plan.status] if plan.status < len(_STATUS) else str(plan.status)
            during = "in initialisation" if plan.reached < 0 else at
            what = f"{function} returned fmi{library.version}{status} {during}"
        elif outcome == Outcome.NOT_FINITE:
            what = f"output '{prepared.task.outputs[plan.column]}' is not finite {at}"
        else:
            what = f"{_REASONS[outcome]} {at}"
        logged = library.log.read()
        given = in_words(dict(zip(prepared.names, prepared.values.tolist(), strict=True)))
        return SimulationError(
            what + (f": {logged}" if logged else "") + (f" (with {given})" if given else ""), where=self.path.name
        )

    def discard(self, fatal: bool = False) -> None:
        """Release the instance; after fmi2Fatal no function of the library may be called again."""
        self._branches.clear(None if fatal else self._instance, self._library)
        if self._instance is not None and self._library is not None and not fatal:
            self._library.free(self._instance)
        self._instance, self._used = None, False
        if fatal:
            self._library = None
            self._prepared.clear()


_REASONS = {
    Outcome.TERMINATED: "the FMU ended the simulation",
    Outcome.EARLY_RETURN: "the FMU returned early from a step, which was not allowed,",
    Outcome.STEP_TOO_SMALL: "the integrator cannot keep its error within the tolerance",
    Outcome.TOO_SLOW: "the run took over 100 times as long as others and was stopped",
    Outcome.EVENTS_DO_NOT_SETTLE: "the event iteration does not settle",
}


def load_fmu(path: str | Path, interface: Interface | None = None) -> Fmu:
    """Return the FMU at `path`; a process gets the same object until the file changes.

    Parameters
    ----------
    path
        An ``.fmu`` file of FMI 2.0 or 3.0.
    interface
        ``co-simulation`` or ``model exchange``; None chooses co-simulation if the FMU supports it.

    Raises
    ------
    FmuError
        As `Fmu`.
    """
    file = Path(path).resolve()
    try:
        state = file.stat()
    except OSError as error:
        raise FmuError(f"cannot be read ({error.strerror})", where=path, fix="check the path") from None
    return _loaded(file, interface, state.st_mtime_ns, state.st_size)


MAX_EXTRACTED = 4e9  # bytes
MAX_FILES = 50_000
_NOT_RUN = ("sources/", "documentation/")


def _major_version(text: str, path: Path) -> int:
    major = text.split(".")[0]
    if not (major.isascii() and major.isdecimal()):
        raise FmuError(f"has FMI version '{text}'", where=path, fix="use an FMU of FMI 2.0 or 3.0")
    return int(major)


_UNREADABLE = (OSError, zipfile.BadZipFile, zlib.error, RuntimeError, ValueError)
_VERSION = re.compile(rb"""fmiVersion\s*=\s*["']([^"']*)""")


@functools.lru_cache(maxsize=64)
def _loaded(file: Path, interface: Interface | None, _mtime: int, _size: int) -> Fmu:
    return Fmu(file, interface)


def _read_description(path: Path) -> FmuDescription:
    try:
        _check_members(path)
        _check_version(path)
        description = read_description(path)
    except _UNREADABLE as error:
        reason = getattr(error, "strerror", None) or error
        raise FmuError(f"is not a readable FMU ({reason})", where=path, fix="check the file") from None
    return description


def _check_members(path: Path) -> None:
    """Refuse an archive that would write outside the folder it is extracted to, or fill the disk."""
    with zipfile.ZipFile(path) as archive:
        if len(archive.infolist()) > MAX_FILES:
            raise FmuError(f"contains more than {MAX_FILES} files", where=path, fix="do not use it")
        size = sum(member.file_size for member in archive.infolist())
        if size > MAX_EXTRACTED:
            raise FmuError(f"is {size / 1e9:.3g} GB unpacked", where=path, fix="do not use it")
        for member in archive.infolist():
            name = member.filename
            climbs = name.startswith("/") or "\\" in name or ":" in name or ".." in PurePosixPath(name).parts
            if climbs or stat.S_ISLNK(member.external_attr >> 16):
                raise FmuError(
                    f"contains the file name '{name}', which points outside the archive",
                    where=path,
                    fix="do not use it",
                )


def _check_version(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        if "modelDescription.xml" not in archive.namelist():
            raise FmuError("has no modelDescription.xml", where=path, fix="is it an FMU?")
        with archive.open("modelDescription.xml") as file:
            begin = chunk = file.read(10_000)
            count, version = 0, _VERSION.search(begin)
            while chunk and count <= MAX_VARIABLES:
                count += chunk.count(b"valueReference=")
                chunk = file.read(1_000_000)
    if version and version[1].partition(b".")[0] not in (b"2", b"3"):
        words = version[1].decode(errors="replace")
        raise FmuError(f"has FMI version {words}; 2.0 and 3.0 are supported", where=path, fix="export it again")
    if count > MAX_VARIABLES:
        raise FmuError(f"has more than {MAX_VARIABLES} variables", where=path, fix="export it with fewer")


def _remove(folder: Path, process: int) -> None:
    if os.getpid() == process:  # not in a fork, whose parent still needs it
        shutil.rmtree(folder, ignore_errors=True)


def _run() -> Callable[[stepper.Plan, int, float], int]:
    run: Callable[[stepper.Plan, int, float], int] = stepper.library().fmuid_run
    return run


def extract(path: Path, without: tuple[str, ...] = ()) -> Path:
    """Return a new folder with the content of an FMU or another archive, which the caller removes.

    Parameters
    ----------
    path
        The archive.
    without
        Prefixes of the names of members to leave out.

    Raises
    ------
    FmuError
        The archive cannot be read, or would write outside the folder.
    """
    folder = Path(tempfile.mkdtemp(dir=scratch.of_process())).resolve()
    try:
        _check_members(path)  # the file may have changed since
        with zipfile.ZipFile(path) as archive:
            archive.extractall(folder, [name for name in archive.namelist() if not name.startswith(without)])
    except BaseException as error:
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, OSError | zipfile.BadZipFile | zlib.error | RuntimeError):  # the last: encrypted
            raise FmuError(f"cannot be extracted ({error})", where=path, fix="check the file") from None
        raise
    return folder
