"""What each law looks like, for `docs/laws.md`: ``python docs/pictures/laws.py docs/figures/laws.png``."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

mpl.use("agg")
import matplotlib.pyplot as plt

Floats = NDArray[np.float64]
Lines = list[tuple[Floats, Floats, str]]


def bristle(travel: Floats, distance: float) -> Floats:
    """Return the deflection of a Dahl bristle along a path, as a share of the largest."""
    deflection = np.zeros_like(travel)
    for k, step in enumerate(np.diff(travel)):
        deflection[k + 1] = deflection[k] + (step - abs(step) * deflection[k]) / distance
    return deflection


def panels() -> list[tuple[str, str, str, Lines]]:
    """Return title, labels and lines of every panel: plain model grey where one helps, the law over it."""
    w = np.linspace(-1.0, 1.0, 401)
    sign = np.tanh(w / 0.01)
    higher = 0.6 + 0.4 * np.exp(-((w / 0.2) ** 2))  # near standstill
    turn = np.linspace(0.0, 2.0 * np.pi, 400)
    t = np.linspace(0.0, 1.0, 400)
    path = np.concatenate([np.linspace(0, 1, 200), np.linspace(1, -1, 400), np.linspace(-1, 1, 400)])
    step = (t > 0.1).astype(float)
    behind = np.where(t > 0.1, 1.0 - np.exp(-(t - 0.1) / 0.12), 0.0)
    speed, deflection, angle, time = "speed", "deflection", "angle", "time"
    friction, torque, reading = "friction", "torque", "signal"
    return [
        ("viscous", speed, friction, [(w, w, "")]),
        ("coulomb", speed, friction, [(w, sign, "")]),
        ("stribeck", speed, friction, [(w, 0.6 * sign, "plain"), (w, sign * higher, "")]),
        ("asymmetry", speed, friction, [(w, 0.7 * sign, "plain"), (w, 0.7 * sign + 0.25 * sign**2, "")]),
        ("quadratic", speed, friction, [(w, w * abs(w), "")]),
        ("load_friction", speed, friction, [(w, 0.4 * sign, "plain"), (w, 0.9 * sign, "")]),
        ("position_friction", angle, friction, [(turn, 0 * turn, "plain"), (turn, 0.3 * np.cos(turn), "")]),
        ("thermal_friction", time, friction, [(t, 0 * t + 1.0, "plain"), (t, 0.6 + 0.4 * np.exp(-t / 0.3), "")]),
        ("presliding", "travel", friction, [(path, bristle(path, 0.15), "")]),
        ("cogging", angle, torque, [(turn, np.sin(6 * turn), "")]),
        ("imbalance, weight", angle, torque, [(turn, np.sin(turn), "")]),
        ("hardening", deflection, torque, [(w, w, "plain"), (w, w + 0.8 * w**3, "")]),
        ("backlash", deflection, torque, [(w, w, "plain"), (w, w - np.clip(w, -0.25, 0.25), "")]),
        ("hysteresis", deflection, torque, [(path, path, "plain"), (path, path + 0.3 * bristle(path, 0.2), "")]),
        ("kinematic_error", angle, "error", [(turn, np.cos(turn) - 1, "")]),
        ("lag", time, reading, [(t, step, "plain"), (t, behind, "")]),
        ("delay", time, reading, [(t, step, "plain"), (t, (t > 0.3).astype(float), "")]),
        ("drift", time, reading, [(t, step, "plain"), (t, step + 0.3 * t, "")]),
        ("saturation", "signal", reading, [(w, w, "plain"), (w, np.clip(w, -0.6, 0.6), "")]),
        ("dead_zone", "signal", reading, [(w, w, "plain"), (w, w - np.clip(w, -0.25, 0.25), "")]),
    ]  # fmt: skip


def main(arguments: Sequence[str]) -> int:
    """Draw the picture into the file that is named."""
    (out,) = arguments
    figure, axes = plt.subplots(5, 4, figsize=(9.2, 10.4), layout="constrained")
    for axis, (title, x, y, lines) in zip(axes.flat, panels(), strict=True):
        for abscissa, ordinate, kind in lines:
            axis.plot(abscissa, ordinate, *(["#999999"] if kind else ["#0072b2"]), lw=1.2 if kind else 2.0)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel(x, fontsize=8)
        axis.set_ylabel(y, fontsize=8)
        axis.set_xticks([])
        axis.set_yticks([])
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(out, dpi=120)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
