"""The experiments of the blind check: those of the sealed campaigns, and others for the held-out score."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchmarks.virtual_rig.inputs import polyline, prbs, sine, step
from benchmarks.virtual_rig.rig_plan import PlannedExperiment
from fmuid.core.immutable import FloatArray

_BITS = "+----+++----+---++----++--++-++++-"  # of 15 ms each
_LOADED = {"J_L": 0.5}


def _grid(duration: float, interval: float) -> FloatArray:
    return np.asarray(interval * np.arange(round(duration / interval)), dtype=np.float64)


def _fixed(name: str, inputs: FloatArray) -> PlannedExperiment:
    return PlannedExperiment(name, "fixed_shaft", 1e-3, inputs)


def _turning(
    name: str,
    duration: float,
    times: list[float],
    speeds: list[float],
    settings: Mapping[str, float] | None = None,
) -> PlannedExperiment:
    setup, interval = ("free_shaft", 5e-3) if settings is None else ("eccentric_load", 1e-2)
    inputs = polyline(_grid(duration, interval), times=times, values=speeds)
    return PlannedExperiment(name, setup, interval, inputs, settings or {})


def _loaded(name: str, duration: float, speed: float, mgr: float) -> PlannedExperiment:
    return _turning(name, duration, [0.0, 0.5], [0.0, speed], {"mgr": mgr, **_LOADED})


def sealed_experiments() -> tuple[PlannedExperiment, ...]:
    """Return the nine experiments of a sealed campaign: same ids, inputs, sampling and lengths."""
    long, short = _grid(0.5, 1e-3), _grid(0.2, 1e-3)
    bits = np.repeat([0.8 if bit == "+" else -0.8 for bit in _BITS], 15)[: len(long)]
    return (
        _loaded("ecc_10_35", 32.0, 10.0, 35.5),
        _loaded("ecc_20_13", 20.0, -20.0, 13.5),
        _loaded("ecc_30_25", 12.0, 30.0, 25.0),
        _turning("free_100", 6.0, [0.0, 0.3, 3.0, 3.6], [0.0, 100.0, 100.0, -100.0]),
        _turning("free_20", 6.0, [0.0, 0.3, 3.0, 3.6], [0.0, 20.0, 20.0, -20.0]),
        _turning("free_slow", 8.0, [0.0, 1.0, 3.0, 5.0, 7.0, 9.0], [0.0, 12.0, -12.0, 12.0, -12.0, 12.0]),
        _fixed("prbs_0p8", bits),
        _fixed("sine_0p75_10", sine(long, amplitude=0.75, frequency=10.0)),
        _fixed("step_0p5", step(short, amplitude=0.5, at=0.01)),
    )


def held_out_experiments() -> tuple[PlannedExperiment, ...]:
    """Return runs at other speeds, loads and inputs, on which a corrected model is scored."""
    long = _grid(0.5, 1e-3)
    return (
        _loaded("ecc_15_25", 20.0, 15.0, 25.0),
        _loaded("ecc_25_35_back", 12.0, -25.0, 35.5),
        _turning("free_60", 6.0, [0.0, 0.3, 3.0, 3.6], [0.0, -60.0, -60.0, 60.0]),
        _fixed("prbs_0p6", prbs(long, amplitude=0.6, clock=12e-3, first=100)),
        _fixed("sine_0p5_5", sine(long, amplitude=0.5, frequency=5.0)),
    )
