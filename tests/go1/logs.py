"""Logs as the bench writes them, simulated with the servo pendulum."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.simulator import Task

INTERVAL = 0.016
RATIO = 6.33
TRAJECTORIES = {
    "sin_sin": lambda t: (1.5 * np.sin(t) + 0.5 * np.sin(5.0 * t) * np.sin(2.0 * t), t >= 0.0),
    "lift_and_drop": lambda t: (-1.4 * np.minimum(t / 1.2, 1.0) ** 2, t < 1.2),
}


def plain_log(mass: float = 1.0, trajectory: str = "sin_sin", count: int = 5, **head: Any) -> dict[str, Any]:
    """Return a log that nothing simulated."""
    names = ("position", "speed", "torque_demand", "goal_position")
    entries = [
        {"timestamp": 0.008 + INTERVAL * k, **{n: 0.1 * k + j for j, n in enumerate(names)}, "torque_enable": True}
        for k in range(count)
    ]
    known = {"mass": mass, "arm_mass": 0.078, "length": 0.15, "kp": 10.0, "damping": 0.3, "motor": "unitree_go1"}
    return {**known, "trajectory": trajectory, **head, "entries": entries}


def simulated_log(fmu: Path, mass: float, trajectory: str, truth: Mapping[str, float]) -> dict[str, Any]:
    """Return the signals that the bench would record, with the steps of its numbers."""
    time = INTERVAL * np.arange(188)
    goal, on = TRAJECTORIES[trajectory](time)
    inputs = {"q_ref": goal, "enable": on.astype(float)}
    task = Task(time, inputs, ("q", "w", "tau_motor"), {"m": mass, "q_start": 0.01})
    q, w, tau = load_fmu(fmu).simulate(task, truth)
    rows = zip(time, goal, on, q, 0.1 * np.trunc(w / 0.1) / RATIO, np.round(tau * 256) / 256, strict=True)
    entries = [
        {
            "timestamp": 0.0079 + t,
            "position": round(angle, 5),
            "speed": round(speed, 5),
            "torque_demand": round(torque, 5),
            "goal_position": aim,
            "torque_enable": bool(enabled),
        }
        for t, aim, enabled, angle, speed, torque in rows
    ]
    return {**plain_log(mass, trajectory), "entries": entries}


def write(folder: Path, *logs: Mapping[str, Any]) -> Path:
    """Write logs into a folder, named as the bench does, and return it."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, log in enumerate(logs):
        (folder / f"2025-05-13_05h{k:02d}m00.json").write_text(json.dumps(log))
    return folder
