"""The rig's C code, compiled on first use and called through ctypes."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from pathlib import Path
from types import MappingProxyType

import numpy as np

from fmu_build.errors import BuildError
from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray

SETUPS = ("fixed_shaft", "free_shaft", "eccentric_load")
WORKS = ("motor", "friction", "dampers", "load")
# No fused multiply-add and no -march: the same numbers on every x86-64 machine.
_FLAGS = ("-std=c11", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
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


def _cache_folder() -> Path:
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "fmuid"


def compiled(name: str, *sources: Path, beside: Sequence[Path] = ()) -> Path:
    """Return the shared library of C sources, compiled if it is not in the cache; headers lie `beside` them."""
    text = b"".join(source.read_bytes() for source in (*sources, *beside))
    key = hashlib.sha256(text + " ".join(_FLAGS).encode()).hexdigest()[:16]
    target = _cache_folder() / f"{name}-{key}.so"
    if target.exists():
        return target
    compiler = os.environ.get("CC") or shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        raise BuildError("no C compiler found for the virtual rig", fix="install gcc or set CC")
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        built = Path(folder) / target.name
        command = [compiler, *_FLAGS, "-o", str(built), *map(str, sources), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            first = (done.stderr.strip() or "no message").splitlines()[0]
            raise BuildError(f"the C compiler refused the virtual rig: {first}", where=sources[0].name)
        built.replace(target)  # atomic: a second process sees all of it or nothing
    return target


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
