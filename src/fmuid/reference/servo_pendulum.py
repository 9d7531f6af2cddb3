"""The servo pendulum, by hand, with friction law M6 (the others are parts of it).

(J + n^2 J_R) der(w) = n motor.tau - mgl sin(phi) - K_v w - budget share
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, sin, tanh

from fmuid.reference.friction_law import bristle
from fmuid.reference.reference_fmu import Equations, Values, computed, input_variable, parameter
from fmuid.simulation.simulator import Variable

GRAVITY = 9.80665  # m/s2
DRIVING_WIDTH = 0.05  # N.m, over which the larger of motor and load changes


def friction_budget(p: Values, w: float, tau_m: float, tau_e: float) -> float:
    """Return the dry friction in N.m at the joint's speed and torques of motor and load (law M6)."""
    s = exp(-(((w / p["friction.w_s"]) ** 2 + 1e-6) ** (p["friction.alpha"] / 2.0)))
    load = abs(p["friction.K_m"] * tau_m - p["friction.K_e"] * tau_e)
    standstill = p["friction.K_cs"] + abs(p["friction.K_ms"] * tau_m - p["friction.K_es"] * tau_e)
    driving = 0.5 * (1.0 + tanh((abs(tau_m) - abs(tau_e)) / DRIVING_WIDTH))
    opposed = min(abs(tau_m), abs(tau_e)) if tau_m * tau_e < 0.0 else 0.0
    square = (driving * p["friction.K_eq"] + (1.0 - driving) * p["friction.K_mq"]) * opposed**2
    return p["friction.K_c"] + load + s * (standstill + square)


class _TorqueDriven:
    """States (phi, w, z); input tau_ref."""

    def __init__(self, p: Values) -> None:
        self.p = dict(p)
        arm = p["m"] * (p["l"] ** 2 + p["r_g"] ** 2) + p["m_a"] * p["l"] ** 2 / 3.0
        self.inertia = arm + p["n"] ** 2 * p["J_R"]
        self.mgl = (p["m"] + p["m_a"] / 2.0) * GRAVITY * p["l"]

    def start(self) -> list[float]:
        return [self.p["q_start"] - self.p["q_offset"], self.p["w_start"], 0.0]

    def demand(self, x: Sequence[float], *inputs: float) -> float:
        """Return the torque demanded of the motor."""
        del x
        return inputs[0]

    def torques(self, x: Sequence[float], u: Sequence[float]) -> tuple[float, float, float, float, float]:
        """Return the motor's torque (motor side), the load's, the friction budget, friction and der(z)."""
        p, (phi, w, z) = self.p, x
        motor = p["torque_gain"] * max(-p["tau_max"], min(p["tau_max"], self.demand(x, *u)))
        load = -self.mgl * sin(phi)
        dz, share = bristle(w / p["friction.phi_s"], z, p["t_s"], p["z_e"])
        budget = friction_budget(p, w, p["n"] * motor, load)
        return motor, load, budget, p["friction.K_v"] * w + budget * share, dz

    def derivatives(self, x: Sequence[float], u: Sequence[float]) -> list[float]:
        motor, load, _, friction, dz = self.torques(x, u)
        return [x[1], (self.p["n"] * motor + load - friction) / self.inertia, dz]

    def values(self, x: Sequence[float], u: Sequence[float]) -> dict[str, float]:
        motor, load, budget, friction, _ = self.torques(x, u)
        return {
            "q": x[0] + self.p["q_offset"],
            "w": x[1],
            "tau_motor": self.p["reading_gain"] * self.demand(x, *u) + self.p["reading_offset"],
            "motor.tau": motor,
            "arm.tau_e": load,
            "friction.budget": budget,
            "friction.tau": friction,
            "friction.bristle.z": x[2],
        }


class _PositionDriven(_TorqueDriven):
    """States (phi, w, z); inputs q_ref and enable."""

    def demand(self, x: Sequence[float], *inputs: float) -> float:
        p, (q_ref, enable) = self.p, inputs
        return enable * (p["kp"] * (q_ref - x[0] - p["q_offset"]) - p["kd"] * x[1]) / p["n"]


_COMMON = (
    parameter("n", 6.33, "1"),
    parameter("J_R", 1.25e-4, "kg.m2", 0.0),
    parameter("m", 1.0, "kg", 0.0),
    parameter("m_a", 0.078, "kg", 0.0),
    parameter("l", 0.15, "m"),
    parameter("r_g", 0.0, "m", 0.0),
    parameter("q_start", 0.0, "rad"),
    parameter("w_start", 0.0, "rad/s"),
    parameter("q_offset", 0.0, "rad"),
    parameter("torque_gain", 1.0, "1"),
    parameter("reading_gain", 1.0, "1"),
    parameter("reading_offset", 0.0, "N.m"),
    parameter("tau_max", 3.7, "N.m", 0.0),
    parameter("t_s", 2e-3, "s", 0.0),
    parameter("z_e", 0.9, "1", 0.0),
    parameter("friction.K_v", 0.1, "N.m.s/rad"),
    parameter("friction.K_c", 0.2, "N.m", 0.0),
    parameter("friction.phi_s", 2e-5, "rad", 0.0),
    parameter("friction.K_cs", 0.0, "N.m", 0.0),
    parameter("friction.w_s", 0.2, "rad/s", 1e-3),
    parameter("friction.alpha", 1.35, "1", 0.2),
    *(parameter(f"friction.K_{share}", 0.0, "1", 0.0) for share in ("m", "e", "ms", "es")),
    *(parameter(f"friction.K_{square}", 0.0, "1/(N.m)", 0.0) for square in ("mq", "eq")),
    computed("q", "rad"),
    computed("w", "rad/s"),
    computed("tau_motor", "N.m"),
    computed("motor.tau", "N.m", "local"),
    computed("arm.tau_e", "N.m", "local"),
    computed("friction.budget", "N.m", "local"),
    computed("friction.tau", "N.m", "local"),
    computed("friction.bristle.z", "1", "local"),
)
_SCALE = (1e-2, 1e-1, 1.0)


def torque_driven() -> Equations:
    """Servo pendulum under a given torque."""
    return Equations("TorqueDriven", (*_COMMON, input_variable("tau_ref", "N.m")), _SCALE, _TorqueDriven)


def position_driven() -> Equations:
    """Servo pendulum under its position controller."""
    extra = (
        parameter("kp", 10.0, "N.m/rad", 0.0),
        parameter("kd", 0.3, "N.m.s/rad", 0.0),
        input_variable("q_ref", "rad"),
        Variable("enable", "input", "continuous", "1", 1.0),
    )
    return Equations("PositionDriven", (*_COMMON, *extra), _SCALE, _PositionDriven)
