"""The compiled loop over communication points, for the C functions of any FMU.

``stepper.c``, ``model_exchange.c`` and ``coupled/master.c`` are one library, which is compiled when fmuid is
installed (``setup.py``). It does not depend on Python, so one build serves every Python version.
"""

from __future__ import annotations

import ctypes
import functools
import time
from array import array
from collections.abc import Callable
from ctypes import POINTER, c_char_p, c_double, c_int32, c_int64, c_size_t, c_void_p
from enum import IntEnum
from importlib.util import find_spec
from typing import Protocol, TypeVar

import numpy as np

from fmuid.core.errors import FmuError


class _Run(Protocol):
    """What a run is of: a `Plan`, or coupled ones; `taken` is its time (s) in steps since it began or went on."""

    taken: float


T = TypeVar("T", bound=_Run)
_REINSTALL = "install fmuid again, in a clone with `pip install --editable .`"
_SLICE = 0.1  # s between checks for Ctrl-C
_PATIENCE, _SLOWER = 2.0, 100.0  # s, and times the median of the runs that ended: see `Patience`
FUNCTIONS = (
    "RESET",
    "SETUP_EXPERIMENT",
    "ENTER_INITIALIZATION",
    "EXIT_INITIALIZATION",
    "TERMINATE",
    "DO_STEP",
    "SET_INPUT_DERIVATIVES",
    "GET_BOOLEAN_STATUS",
    "ENTER_EVENT_MODE",
    "UPDATE_DISCRETE_STATES",
    "ENTER_CONTINUOUS_TIME_MODE",
    "COMPLETED_INTEGRATOR_STEP",
    "SET_TIME",
    "SET_STATES",
    "GET_STATES",
    "GET_DERIVATIVES",
    "GET_INDICATORS",
    "GET_NOMINALS",
    "GET_FMU_STATE",
    "SET_FMU_STATE",
    "FREE_FMU_STATE",
    "SET_DIRECTIONS",
    "SET_INPUT_DIRECTIONS",
    "GET_SENSITIVITIES",
    "GET_DIRECTIONAL_DERIVATIVE",
    "SET_VALUES",
    "GET_VALUES",
)
"""Places in `Plan.function`, as in stepper.c."""

SAMPLES = 8
"""Samples in `Plan.sensitivities`, as in stepper.h."""

DTYPES = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8")
"""How values of `Group.type` are stored on the FMU's side, as in stepper.c."""


class Outcome(IntEnum):
    """Reasons why a run ended, as in stepper.c; `Patience` ends one that is too slow."""

    DONE = 0
    PAUSED = 1
    CALL_FAILED = 2
    NOT_FINITE = 3
    TERMINATED = 4
    EARLY_RETURN = 5
    STEP_TOO_SMALL = 6
    EVENTS_DO_NOT_SETTLE = 7
    LOOP_NOT_SOLVED = 8
    TOO_SLOW = 9


DONE, _PAUSED = int(Outcome.DONE), int(Outcome.PAUSED)  # for every run: members of an enumeration are found slowly


class Group(ctypes.Structure):
    """Variables of one type, set or read by one call; as in stepper.c."""

    _fields_ = (
        ("function", c_void_p),
        ("references", c_void_p),
        ("n_references", c_size_t),
        ("n_values", c_size_t),
        ("type", c_int32),
        ("direct", c_int32),
        ("n_columns", c_int32),
        ("after", c_int32),
        ("column", c_void_p),
        ("place", c_void_p),
        ("buffer", c_void_p),
    )


class Plan(ctypes.Structure):
    """Everything one simulation needs; as in stepper.c."""

    _fields_ = (
        ("instance", c_void_p),
        ("function", c_void_p * len(FUNCTIONS)),
        ("fmi", c_int32),
        ("model_exchange", c_int32),
        ("reset", c_int32),
        ("linear", c_int32),
        ("tolerance_defined", c_int32),
        ("completed_step_needed", c_int32),
        ("rewinds", c_int32),
        ("tolerance", c_double),
        ("stop", c_double),
        ("fixed_step", c_double),
        ("n_times", c_size_t),
        ("n_inputs", c_size_t),
        ("n_outputs", c_size_t),
        ("n_starts", c_size_t),
        ("n_states", c_size_t),
        ("n_indicators", c_size_t),
        ("time", c_void_p),
        ("inputs", c_void_p),
        ("starts", c_void_p),
        ("outputs", c_void_p),
        ("row", c_void_p),
        ("n_start_groups", c_int32),
        ("n_input_groups", c_int32),
        ("n_output_groups", c_int32),
        ("n_slope_groups", c_int32),
        ("n_slopes", c_int32),
        ("start_groups", POINTER(Group)),
        ("input_groups", POINTER(Group)),
        ("output_groups", POINTER(Group)),
        ("slope_groups", POINTER(Group)),
        ("slope_references", c_void_p),
        ("slope_columns", c_void_p),
        ("slope_orders", c_void_p),
        ("slopes", c_void_p),
        ("n_directions", c_size_t),
        ("n_moved", c_size_t),
        ("moved", c_void_p),
        ("weights", c_void_p),
        ("output_references", c_void_p),
        ("sensitivities", c_void_p),
        ("n_kept", c_size_t),
        ("n_driven", c_size_t),
        ("driven", c_void_p),
        ("driven_lines", c_void_p),
        ("seeds", c_void_p),
        ("rates", c_void_p),
        ("measured", c_void_p),
        ("gain", c_void_p),
        ("n_measured", c_size_t),
        ("work", c_void_p),
        ("pivots", c_void_p),
        ("derivative_references", c_void_p),
        ("step_size", c_double),
        ("next_event", c_double),
        ("next_event_defined", c_int32),
        ("from_state", c_void_p),
        ("begin", c_int64),
        ("branch", c_int64),
        ("kept", c_void_p),
        ("reached", c_int64),
        ("status", c_int32),
        ("call", c_int32),
        ("column", c_int32),
        ("reached_time", c_double),
        ("taken", c_double),
    )


@functools.cache
def library() -> ctypes.CDLL:
    """Return the compiled stepper.

    Raises
    ------
    FmuError
        The library is missing, or was compiled from other sources.
    """
    spec = find_spec("fmuid.simulation._stepper")
    if spec is None or spec.origin is None:
        raise FmuError("the compiled stepper is missing", where="fmuid", fix=_REINSTALL)
    stepper = ctypes.CDLL(spec.origin)
    if stepper.fmuid_plan_size() != ctypes.sizeof(Plan):
        raise FmuError("the compiled stepper is older than the code", where=spec.origin, fix=_REINSTALL)
    stepper.fmuid_run.argtypes = [POINTER(Plan), c_int32, c_double]
    stepper.fmuid_run.restype = c_int32
    stepper.fmuid_linearise.argtypes = [POINTER(Plan), c_size_t, *[c_void_p] * 9]
    stepper.fmuid_linearise.restype = c_int32
    stepper.fmuid_clear_log.restype = None
    stepper.fmuid_read_log.restype = c_char_p
    return stepper


def require_reading_after() -> None:
    """Raise FmuError if the compiled stepper is from before outputs could be read after the inputs act."""
    if not hasattr(library(), "fmuid_reads_after"):
        raise FmuError("the compiled stepper is older than the code", where="fmuid", fix=_REINSTALL)


class Patience:
    """How long the simulations of one model may take, learned from those that end.

    A search may try parameters at which a model does next to nothing but switch to and fro. Such a run fails
    when it has taken 2 s of processor time, and 100 times as long a communication point as most runs that ended
    (their median). With every run that fails late, the next ones have less of the 2 s: the n-th has 2/n s, because
    a search soon knows no other runs. Until a run has ended there is no limit.
    """

    def __init__(self) -> None:
        self._taken = array("d")  # s of processor time for each communication point, of runs that ended
        self._usual = np.inf  # their median, as of the last power of two of them
        self._late = 0  # number of runs that failed after more than their share of time

    def of_run(self, n_times: int) -> float:
        """Return how long a run over so many communication points may take, s; infinite before one has ended."""
        least, slow = _PATIENCE / (1 + self._late), _SLOWER * self._usual * n_times
        return slow if slow > least else least

    def run_to_end(self, run: Callable[[T, int, float], int], subject: T, n_times: int) -> int:
        """Return the outcome of ``run(subject, resume, slice)``; it pauses so that Ctrl-C takes effect.

        Up to the first pause, the clock stands for processor time, which takes longer to ask for. It shows more
        if the machine slept, so no more than a slice counts.
        """
        called = time.perf_counter()
        outcome = run(subject, 0, _SLICE)
        taken = min(subject.taken, _SLICE)
        if outcome == _PAUSED:
            begun = time.thread_time() - taken
            patience = self.of_run(n_times)
            while outcome == _PAUSED:
                if time.thread_time() - begun > patience:
                    outcome = Outcome.TOO_SLOW
                    break
                outcome = run(subject, 1, _SLICE)
            taken = time.thread_time() - begun
        if outcome == DONE:
            self._taken.append(taken / n_times)
            if (n := len(self._taken)) & (n - 1) == 0:
                self._usual = float(np.median(self._taken))
        else:
            self._late += time.perf_counter() - called > _SLOWER * self._usual * n_times
        return outcome
