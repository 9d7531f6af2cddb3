"""The servo pendulum's FMUs, and motions to drive them by."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from fmuid.simulation.simulator import Task
from tests.conftest import MODELICA, build_once

SETUPS = ("PositionDriven", "TorqueDriven")
LAW_M6 = {
    "friction.K_v": 0.04,
    "friction.K_c": 0.11,
    "friction.K_cs": 0.06,
    "friction.w_s": 0.4,
    "friction.alpha": 1.7,
    "friction.K_m": 0.03,
    "friction.K_e": 0.05,
    "friction.K_ms": 0.04,
    "friction.K_es": 0.02,
    "friction.K_mq": 0.01,
    "friction.K_eq": 0.015,
}
RIG = {"J_R": 1.6e-4, "r_g": 0.02, "torque_gain": 0.96, "q_offset": 0.004, "reading_gain": 1.04, "m": 2.0}


def servo_task(setup: str) -> Task:
    """Return 4 s of a motion with stops, reversals and, position driven, a drop."""
    time = np.arange(251) * 0.016
    outputs = ("q", "w", "tau_motor")
    if setup == "TorqueDriven":
        torque = 0.35 * np.sin(2.0 * time) + 0.15 * np.sin(7.0 * time)
        return Task(time, {"tau_ref": torque}, outputs, {"q_start": 0.1})
    reference = 1.2 * np.sin(time) + 0.4 * np.sin(5.0 * time) * np.sin(2.0 * time)
    enable = np.where(time < 2.8, 1.0, 0.0)
    return Task(time, {"q_ref": reference, "enable": enable}, outputs, {"q_start": 0.02, "w_start": -0.3})


@pytest.fixture(scope="session")
def pendulum_fmus() -> Mapping[str, Path]:
    """The FMUs of the servo pendulum by name."""
    setups = MODELICA / "Pendulum" / "Setups"
    return {n: build_once(setups / f"{n}.mo", f"Pendulum.Setups.{n}", roots=[MODELICA]) for n in SETUPS}
