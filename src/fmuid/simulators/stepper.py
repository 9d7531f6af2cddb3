"""The loop over communication points in compiled code, over any FMU's C functions.

``stepper.c``, ``model_exchange.c`` and ``coupled/master.c`` are compiled on first use and kept in the user's
cache folder under the hash of their content. Without a C compiler ``stepper_python`` runs the same calls in the
same order: slower, with identical results. Set the environment variable ``FMUID_STEPPER=python`` to ask for that.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import multiprocessing
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from contextlib import suppress
from ctypes import POINTER, c_char_p, c_double, c_int32, c_int64, c_size_t, c_void_p
from enum import IntEnum
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")
_SLICE = 0.1  # s between looks at Ctrl-C
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
    "GET_SENSITIVITIES",
    "SET_VALUES",
    "GET_VALUES",
)
"""Places in `Plan.function`, as in stepper.c."""

DTYPES = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8")
"""How values of `Group.type` are stored on the FMU's side, as in stepper.c."""


class Outcome(IntEnum):
    """Why a run ended, as in stepper.c."""

    DONE = 0
    PAUSED = 1
    CALL_FAILED = 2
    NOT_FINITE = 3
    TERMINATED = 4
    EARLY_RETURN = 5
    STEP_TOO_SMALL = 6
    EVENTS_DO_NOT_SETTLE = 7
    LOOP_NOT_SOLVED = 8


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
        ("unused", c_int32),
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
        ("work", c_void_p),
        ("pivots", c_void_p),
        ("step_size", c_double),
        ("next_event", c_double),
        ("next_event_defined", c_int32),
        ("reached", c_int64),
        ("status", c_int32),
        ("call", c_int32),
        ("column", c_int32),
        ("reached_time", c_double),
    )


def _cache_folder() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or (
        os.environ.get("LOCALAPPDATA") if sys.platform == "win32" else None
    )
    return Path(base) / "fmuid" if base else Path.home() / ".cache" / "fmuid"


def _compile(sources: list[Path]) -> Path | None:
    """Compile `sources` into the cache and return the library, or None where there is no working compiler."""
    # Contraction to fused multiply-adds would make the results depend on the machine.
    flags = ["-std=c11", "-O2", "-shared", "-fPIC", "-ffp-contract=off"]
    content = hashlib.sha256(b"".join(s.read_bytes() for s in [*sources, sources[0].with_suffix(".h")]))
    content.update(" ".join([*flags, sys.platform, platform.machine()]).encode())
    name = f"stepper-{content.hexdigest()[:24]}{'.dll' if sys.platform == 'win32' else '.so'}"
    for folder in (_cache_folder(), Path(tempfile.gettempdir()) / f"fmuid-{_user()}"):
        library = folder / name
        if library.is_file() and _own(library):
            return library
        compiler = next(filter(None, map(shutil.which, [os.environ.get("CC") or "cc", "gcc", "clang"])), None)
        if compiler is None:
            continue
        temporary: str | None = None
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            if not _own(folder):
                continue
            handle, temporary = tempfile.mkstemp(dir=folder, suffix=library.suffix)
            os.close(handle)
            command = [compiler, *flags, "-o", temporary, *map(str, sources), "-lm"]
            subprocess.run(command, check=True, capture_output=True, timeout=120)
            Path(temporary).replace(library)  # whole or not at all, whoever else compiles at the same time
            return library
        except (OSError, subprocess.SubprocessError):
            continue
        finally:
            if temporary is not None:
                with suppress(OSError):
                    Path(temporary).unlink(missing_ok=True)
    return None


def _user() -> str:
    return str(os.getuid()) if hasattr(os, "getuid") else "user"


def _own(path: Path) -> bool:
    """Whether nobody else could have put this file or folder there."""
    return not hasattr(os, "getuid") or path.stat().st_uid == os.getuid()


@functools.cache
def library() -> ctypes.CDLL | None:
    """Return the compiled stepper, or None where it cannot be had."""
    if os.environ.get("FMUID_STEPPER") == "python":
        return None
    sources = [Path(__file__).parent / n for n in ("stepper.c", "model_exchange.c", "../coupled/master.c")]
    stepper = None
    for _ in range(2):  # a library that cannot be loaded is made once more
        path = _compile(sources)
        if path is None:
            break
        try:
            stepper = ctypes.CDLL(str(path))
            break
        except OSError:
            path.unlink(missing_ok=True)
    if stepper is None:
        if multiprocessing.parent_process() is None:  # said once, not by every worker
            warnings.warn(
                "no working C compiler: FMUs are stepped in Python, with the same results but slower",
                stacklevel=2,
            )
        return None
    stepper.fmuid_run.argtypes = [POINTER(Plan), c_int32, c_double]
    stepper.fmuid_run.restype = c_int32
    stepper.fmuid_clear_log.restype = None
    stepper.fmuid_read_log.restype = c_char_p
    return stepper


def run_to_end(run: Callable[[T, int, float], int], subject: T) -> int:
    """Return the outcome of ``run(subject, resume, slice)``, which pauses so that Ctrl-C is seen."""
    outcome = run(subject, 0, _SLICE)
    while outcome == Outcome.PAUSED:
        outcome = run(subject, 1, _SLICE)
    return outcome
