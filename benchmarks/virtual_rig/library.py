"""The rig's C code, compiled on first use and called through ctypes."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from pathlib import Path
from types import MappingProxyType

import numpy as np

from benchmarks.shared_library import compiled
from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray

SETUPS = ("fixed_shaft", "free_shaft", "eccentric_load")
WORKS = ("motor", "friction", "dampers", "load")
_DOUBLES = np.ctypeslib.ndpointer(dtype=np.float64, flags="C_CONTIGUOUS")


class Channel(IntEnum):
    """Columns of what the rig records, before any sensor noise."""

    TAU_SENSOR = 0
    THETA = 1
    W_MOTOR = 2
    I_MOTOR = 3
    PHI_LOAD = 4
    LOAD_TORQUE = 5
    FRICTION = 6
    W_LOAD = 7


@dataclass(frozen=True, slots=True)
class ParameterInfo:
    """One parameter of the rig: value at which its effect is absent, unit, meaning."""

    name: str
    neutral: float
    unit: str
    description: str


@cache
def _library() -> ctypes.CDLL:
    library = ctypes.CDLL(str(compiled("virtual_rig", Path(__file__).with_name("rig.c"))))
    for name in ("rig_name", "rig_unit", "rig_text"):
        getattr(library, name).restype = ctypes.c_char_p
    library.rig_neutral.restype = ctypes.c_double
    library.rig_run.restype = ctypes.c_long
    library.rig_run.argtypes = [
        _DOUBLES,
        _DOUBLES,
        ctypes.c_int,
        ctypes.c_int,
        ctypes.c_long,
        ctypes.c_long,
        ctypes.c_double,
        _DOUBLES,
        _DOUBLES,
        _DOUBLES,
    ]
    return library


@cache
def parameter_table() -> Mapping[str, ParameterInfo]:
    """Return every parameter of the rig by name, in the order of the C code."""
    library = _library()
    infos = (
        ParameterInfo(
            library.rig_name(i).decode(),
            library.rig_neutral(i),
            library.rig_unit(i).decode(),
            library.rig_text(i).decode(),
        )
        for i in range(library.rig_count())
    )
    return MappingProxyType({info.name: info for info in infos})


def run(
    parameters: FloatArray, loss_table: FloatArray, setup: str, inputs: FloatArray, interval: float, substeps: int
) -> tuple[FloatArray, FloatArray]:
    """Run one experiment from rest; return the channels (N, 8) and the works (4,) in J.

    Raises
    ------
    SimulationError
        The motion went to infinity.
    """
    samples = len(inputs)
    channels = np.empty((samples, len(Channel)))
    works = np.zeros(len(WORKS))
    failed = _library().rig_run(
        np.ascontiguousarray(parameters, dtype=np.float64),
        np.ascontiguousarray(loss_table, dtype=np.float64),
        len(loss_table),
        SETUPS.index(setup),
        samples,
        substeps,
        interval,
        np.ascontiguousarray(inputs, dtype=np.float64),
        channels,
        works,
    )
    if failed >= 0:
        raise SimulationError(f"the rig's motion is not finite at t = {failed * interval:g} s", where=setup)
    return channels, works
