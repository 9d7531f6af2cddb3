"""Which difference between BAM's model of the Go1 bench and that of `campaigns/go1` matters, one at a time.

BAM (Better Actuator Models) predicts the Go1 logs with a point as payload, goals interpolated to steps of 5 ms,
friction that stops the joint within a step, and the recorded speed as the start. Each row changes one of these to
what `campaigns/go1` does, and the last row all of them. M1 (Coulomb and viscous friction) and M3 (M1, and friction
in proportion to the torque through the gear) are fitted to 0, 1 and 2 kg by the mean absolute error of the
position, with differential evolution from a fixed seed; 3 kg is predicted.

Run: ``python -m benchmarks.go1_differences [FOLDER]``; the folder of the logs as in `campaigns.go1.convert`. Ten
minutes.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import differential_evolution

from campaigns.go1.convert import GEAR_RATIO, folder_from_environment
from fmuid.core.immutable import FloatArray

_G = 9.80665
# Inertia of the rotor at the joint (kg.m2), gain of the torque, offset of the encoder (rad), Coulomb (N.m) and
# viscous (N.m.s/rad) friction, radius of gyration of the payload (m), friction over torque through the gear.
_BOUNDS = ((1e-5, 0.05), (0.7, 1.3), (-0.1, 0.1), (0.0, 0.5), (0.0, 0.5), (0.0, 0.08), (0.0, 0.3))
_RADIUS, _LOAD = 5, 6
_POPULATION, _GENERATIONS = 12, 200  # members per parameter


@dataclass(frozen=True, slots=True)
class Variant:
    """A model of the bench, BAM's by default."""

    step: float = 5e-3  # s
    body: bool = False  # the payload has a radius of gyration
    held: bool = False  # goals are held from row to row
    start: bool = False  # the start speed is that of the joint


@dataclass(frozen=True, slots=True)
class Logs:
    """Logs on the even grid of a variant, one column each."""

    mass: FloatArray
    arm: FloatArray
    length: FloatArray
    kp: FloatArray
    kd: FloatArray
    goal: FloatArray
    enabled: FloatArray
    position: FloatArray
    speed: FloatArray


def read(folder: Path, variant: Variant, *, heavy: bool) -> Logs:
    """Return the logs with 3 kg, or the others."""
    logs = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]
    logs = [log for log in logs if (log["mass"] > 2.5) == heavy]
    end = min(log["entries"][-1]["timestamp"] for log in logs)
    time = np.arange(0.0, end, variant.step)

    def column(key: str, *, held: bool = False) -> FloatArray:
        columns = []
        for log in logs:
            stamps = np.array([entry["timestamp"] for entry in log["entries"]])
            values = np.array([float(entry[key]) for entry in log["entries"]])
            row = np.searchsorted(stamps, time + 1e-9, side="right") - 1
            columns.append(values[row] if held else np.interp(time, stamps, values))
        return np.array(columns).T

    def of_logs(key: str) -> FloatArray:
        return np.array([log[key] for log in logs])

    return Logs(
        *(of_logs(key) for key in ("mass", "arm_mass", "length", "kp", "damping")),
        goal=column("goal_position", held=variant.held),
        enabled=column("torque_enable", held=variant.held) > 0.5,
        position=column("position"),
        speed=column("speed")[0] * (GEAR_RATIO if variant.start else 1.0),
    )


def error(logs: Logs, variant: Variant, parameters: FloatArray) -> FloatArray:
    """Return the mean absolute error (rad) of each column of parameters, by rollouts of all logs."""
    inertia, gain, offset, dry, viscous, radius, load = (row[:, None] for row in parameters)
    mass = logs.mass * (logs.length**2 + radius**2) + logs.arm / 3 * logs.length**2 + inertia
    weight = (logs.mass + logs.arm / 2) * _G * logs.length
    angle = np.tile(logs.position[0], (parameters.shape[1], 1))
    speed = np.tile(logs.speed, (parameters.shape[1], 1))
    total = np.zeros(parameters.shape[1])
    h = variant.step
    for goal, enabled, position in zip(logs.goal, logs.enabled, logs.position, strict=True):
        total += np.abs(angle - position).mean(axis=1)
        motor = (gain * logs.kp * (goal - angle) - logs.kd * speed) * enabled
        outside = -weight * np.sin(angle + offset)
        stopping = mass / h * speed + motor + outside
        budget = dry + viscous * np.abs(speed) + load * np.abs(outside - motor)
        acceleration = (motor + outside - np.clip(stopping, -budget, budget)) / mass
        speed = speed + h * acceleration
        angle = angle + h * speed
    return total / len(logs.goal)


def fitted(folder: Path, variant: Variant, *, load: bool) -> tuple[float, float, FloatArray]:
    """Return the errors of the runs used and of those with 3 kg, and the parameters."""
    free = [k for k in range(len(_BOUNDS)) if (k != _RADIUS or variant.body) and (k != _LOAD or load)]
    light, heavy = (read(folder, variant, heavy=heavy) for heavy in (False, True))

    def every(columns: FloatArray) -> FloatArray:
        parameters = np.zeros((len(_BOUNDS), columns.shape[1]))
        parameters[free] = columns
        return parameters

    fit = differential_evolution(
        lambda columns: error(light, variant, every(columns)),
        [_BOUNDS[k] for k in free],
        popsize=_POPULATION,
        maxiter=_GENERATIONS,
        tol=1e-3,
        polish=False,
        updating="deferred",
        vectorized=True,
        seed=1,
    )
    best = every(np.asarray(fit.x)[:, None])
    return float(fit.fun), float(error(heavy, variant, best)[0]), best[:, 0]


def main() -> None:
    """Print one row for each variant."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else folder_from_environment()
    bam = Variant()
    variants = {
        "BAM": bam,
        "payload with a radius of gyration": replace(bam, body=True),
        "goals held": replace(bam, held=True),
        "start speed of the joint": replace(bam, start=True),
        "steps of 2 ms": replace(bam, step=2e-3),
        "all of them": Variant(2e-3, body=True, held=True, start=True),
    }
    print("| model | M1, 0 to 2 kg | M3, 0 to 2 kg | M1, 3 kg | M3, 3 kg | gain, % | K_l of M3 |")
    print("|---" * 7 + "|")
    for name, variant in variants.items():
        one, three = (fitted(folder, variant, load=load) for load in (False, True))
        cells = [1e3 * one[0], 1e3 * three[0], 1e3 * one[1], 1e3 * three[1], 100 * (1 - three[1] / one[1])]
        print(f"| {name} | {' | '.join(f'{cell:.1f}' for cell in cells)} | {three[2][_LOAD]:.3f} |", flush=True)


if __name__ == "__main__":
    main()
