"""Plants in C: parameters, what they have beyond their models, and devices at inputs and outputs."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.shared_library import compiled
from fmuid.core.errors import SimulationError
from tests.known_rigs.plant import Floats, lagged

SHAPE = ".shape"  # next to the size of an effect
_PLANTS = ("BeltAxis", "ThermalBlock", "Circuit", "Tanks")
_DOUBLES = np.ctypeslib.ndpointer(dtype=np.float64, flags="C_CONTIGUOUS")
_PARTS = 8  # of a sample, in which a late sensor is followed


@dataclass(frozen=True)
class Place:
    """Where something may act on a plant: its number there, and usual sizes of potential and rate."""

    number: int
    range: float
    rate: float
    turning: bool = False


@dataclass(frozen=True)
class CompiledPlant:
    """A plant by its name in C; `simulate` of a `Rig`.

    Attributes
    ----------
    parameters
        Values by the model's names, in the order of the C code.
    inputs, outputs
        Names, in the order of the C code.
    places
        By the name that a diagnosis gives them.
    zero
        Potential that stores begin at.
    substeps
        Steps a sample.
    crosstalk
        Output -> output or input that couples into it.
    largest
        Input -> its largest size over all runs.
    """

    name: str
    parameters: Mapping[str, float]
    inputs: Sequence[str]
    outputs: Sequence[str]
    places: Mapping[str, Place]
    substeps: int
    zero: float = 0.0
    crosstalk: Mapping[str, str] = field(default_factory=dict)
    largest: Mapping[str, float] = field(default_factory=dict)

    def __call__(
        self, factors: Mapping[str, float], effect: Mapping[str, float], time: Floats, u: Floats
    ) -> Floats:
        """Return the (outputs, N) readings without noise.

        Parameters
        ----------
        factors
            On the parameters.
        effect
            Size by ``law@place``, and what shapes it by the same with `SHAPE`. ``value@parameter`` is the
            logarithm of what the parameter is off by.
        u
            (N,) or (inputs, N), held from sample to sample.
        """
        given = np.atleast_2d(u)
        lag, delay, extras = np.zeros(len(given)), np.zeros(len(given)), []
        values = {n: v * factors.get(n, 1.0) for n, v in self.parameters.items()}
        drive = dict(zip(self.inputs, given, strict=True))
        for name, size in effect.items():
            law, _, where = name.partition("@")
            if name.endswith(SHAPE) or where in self.outputs:
                continue
            if law == "value":
                values[where] *= np.exp(size)
            elif where in self.inputs:
                k = self.inputs.index(where)
                lag[k] += size if law == "lag" else 0.0
                delay[k] += size if law == "delay" else 0.0
                drive[where] = _driven(law, size, drive[where], self.largest[where])
            else:
                place = self.places[where]
                kind = "pendulum_weight" if law == "weight" and place.turning else law
                row = (_kinds()[kind], place.number, size, effect[name + SHAPE], place.rate, place.range)
                extras.append([*row, float(time[-1] - time[0])])
        # A late sensor is late between the samples as well.
        parts = _PARTS if any(f"{law}@{n}" in effect for law in ("lag", "delay") for n in self.outputs) else 1
        fine = np.interp(np.arange((len(time) - 1) * parts + 1) / parts, np.arange(len(time)), time)
        acting, given = (
            np.repeat(x, parts, axis=1)[:, : len(fine)] for x in (np.stack(list(drive.values())), given)
        )
        y = np.empty((len(fine), len(self.outputs)))
        failed = _library().plant_run(
            _PLANTS.index(self.name), np.array(list(values.values())), self.zero, len(extras),
            np.ascontiguousarray(np.reshape(extras, (-1, 7)), dtype=np.float64), len(fine),
            -(-self.substeps // parts), float(time[1] - time[0]) / parts, np.ascontiguousarray(acting.T),
            lag, delay, y,
        )  # fmt: skip
        if failed >= 0:
            raise SimulationError(f"not finite at t = {fine[failed]:g} s", where=self.name)
        read = dict(zip((*self.outputs, *self.inputs), (*y.T, *given), strict=True))
        return np.stack([self._read(n, read, effect, fine)[::parts] for n in self.outputs])

    def _read(self, output: str, read: Mapping[str, Floats], effect: Mapping[str, float], time: Floats) -> Floats:
        y = read[output]
        for name, size in effect.items():
            law, _, where = name.partition("@")
            if where != output:
                continue
            match law:
                case "gain":
                    y = y * (1.0 + size)
                case "offset":
                    y = y + size
                case "drift":
                    y = y + size * (time - time[0]) / (time[-1] - time[0])
                case "lag":
                    y = lagged(time, y, size)
                case "delay":
                    y = np.interp(time - size, time, y)
                case "crosstalk":
                    y = y + size * read[self.crosstalk[output]]
                case _:
                    raise KeyError(name)
        return y


def _driven(law: str, size: float, u: Floats, largest: float) -> Floats:
    match law:
        case "gain":
            return u * (1.0 + size)
        case "offset":
            return u + size
        case "dead_zone":
            return u - np.clip(u, -size, size)
        case "saturation":  # an amplifier whose limit is lower by a share of the largest input
            return np.clip(u, -(1.0 - size) * largest, (1.0 - size) * largest)
        case "lag" | "delay":
            return u
        case _:
            raise KeyError(law)


@cache
def _library() -> ctypes.CDLL:
    folder = Path(__file__).with_name("plants")
    library = ctypes.CDLL(str(compiled("rigs", *sorted(folder.glob("*.c")), beside=sorted(folder.glob("*.h")))))
    library.extra_name.restype = ctypes.c_char_p
    library.plant_run.restype = ctypes.c_long
    library.plant_run.argtypes = [
        ctypes.c_int, _DOUBLES, ctypes.c_double, ctypes.c_int, _DOUBLES, ctypes.c_long, ctypes.c_int,
        ctypes.c_double, _DOUBLES, _DOUBLES, _DOUBLES, _DOUBLES,
    ]  # fmt: skip
    return library


@cache
def _kinds() -> Mapping[str, int]:
    names = []
    while (name := _library().extra_name(len(names))) is not None:
        names.append(name.decode())
    return {name: k for k, name in enumerate(names)}
