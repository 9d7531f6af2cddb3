"""Actuators and inputs that the tests of the rig share."""

from __future__ import annotations

import numpy as np

from benchmarks.virtual_rig import Rig

PAPER_TABLE = np.array(
    [
        [0, 0.985, 0.955, 0.125, 0.12],
        [10, 0.979, 0.945, 0.086781, 0.086781],
        [20, 0.854, 0.847, 0.0565, 0.049],
        [300, 0.83, 0.82, 0.165, 0.158],
    ]
)


def paper() -> Rig:
    return Rig(PAPER_TABLE)


def constant(tau: float = 0.09) -> Rig:
    """Linear train with constant bearing friction, as the base model of a diagnosis."""
    return Rig(np.array([[0.0, 1.0, 1.0, tau, tau]]))


def lossless() -> Rig:
    return constant(0.0)


def held(value: float, n: int) -> np.ndarray:
    return np.full(n, value)


def ramped(value: float, n: int, interval: float, rise: float = 0.5) -> np.ndarray:
    return value * np.minimum(np.arange(n) * interval / rise, 1.0)
