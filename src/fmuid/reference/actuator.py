"""The force-feedback actuator: equations of motion of the three setups, by hand.

Bodies: housing (C, with stator and Circular Spline), rotor (W, with Wave Generator), load (L). The gear ties
the massless Flexspline to both: phi_F = (phi_W - (1 - n) phi_C)/n. Its spring and damper give the torque T
on the motor side as a function of the states. With the loss torque D acting on w_W - w_C:

    J_R der(w_W) =  K_m i - T - D
    J_S der(w_C) = -K_m i - (n - 1) T + D + tau_sensor
    J_L der(w_L) =  n T - mgr sin(phi_L)
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sin

from fmuid.reference.friction_law import bristle, loss_table, sliding_torque
from fmuid.reference.reference_fmu import Equations, Values, computed, input_variable, parameter
from fmuid.simulation.simulator import Variable

ROW_SPEEDS = (0.0, 10.0, 15.0, 20.0, 30.0, 100.0, 300.0)
BLEND = 1e-3  # N.m, width over which the branches of Table 1 join


class _Actuator:
    """The actuator with the current `i` of its motor and the motion of its load given."""

    def __init__(self, p: Values) -> None:
        self.n, self.K_m = p["n"], p["K_m"]
        self.J_R, self.J_S, self.J_L = p["J_R"], p["J_S"], p["J_L"]
        self.c_S, self.d_S, self.c_G, self.d_G = p["c_S"], p["d_S"], p["c_G"], p["d_G"]
        self.phi_s, self.t_s, self.z_e = p["phi_s"], p["t_s"], p["z_e"]
        rows = range(1, len(ROW_SPEEDS) + 1)
        self.losses = loss_table([[p[f"lossTable[{row},{column}]"] for column in range(1, 6)] for row in rows])

    def torques(self, x: Sequence[float], phi_load: float, w_load: float) -> tuple[float, ...]:
        """Return T, D, tau_sensor, der(z) and the power lost, from (phi_C, w_C, phi_W, w_W, z)."""
        phi_c, w_c, phi_w, w_w, z = x[:5]
        n = self.n
        wind = (phi_w + (n - 1.0) * phi_c) / n - phi_load
        unwinding = (w_w + (n - 1.0) * w_c) / n - w_load
        load_torque = (self.c_G * wind + self.d_G * unwinding) / n
        speed = w_w - w_c
        row = self.losses(abs(speed))
        forward = sliding_torque(load_torque, row, BLEND)
        backward = sliding_torque(-load_torque, row, BLEND)
        dz, share = bristle(speed / self.phi_s, z, self.t_s, self.z_e)
        loss_torque = share * (forward if share > 0.0 else backward)
        released = z * (forward if z > 0.0 else backward) * self.phi_s * dz
        sensor = -self.c_S * phi_c - self.d_S * w_c
        return load_torque, loss_torque, sensor, dz, loss_torque * speed - released

    def motion(self, x: Sequence[float], torques: Sequence[float], current: float) -> list[float]:
        """Return the derivatives of (phi_C, w_C, phi_W, w_W, z)."""
        load_torque, loss_torque, sensor, dz, _ = torques
        motor = self.K_m * current
        return [
            x[1],
            (-motor - (self.n - 1.0) * load_torque + loss_torque + sensor) / self.J_S,
            x[3],
            (motor - load_torque - loss_torque) / self.J_R,
            dz,
        ]

    def common_values(self, x: Sequence[float], torques: Sequence[float], current: float) -> dict[str, float]:
        return {
            "w_motor": x[3] - x[1],
            "tau_sensor": torques[2],
            "motor.tau": self.K_m * current,
            "housing.phi": x[0],
            "housing.w": x[1],
            "rotor.phi": x[2],
            "rotor.w": x[3],
            "gear.bristle.z": x[4],
            "gear.tau_load": torques[0],
            "gear.dtau": torques[1],
            "gear.lossPower": torques[4],
        }


class _FixedShaft(_Actuator):
    """States (phi_C, w_C, phi_W, w_W, z); input i_cmd."""

    def start(self) -> list[float]:
        return [0.0] * 5

    def derivatives(self, x: Sequence[float], u: Sequence[float]) -> list[float]:
        return self.motion(x, self.torques(x, 0.0, 0.0), u[0])

    def values(self, x: Sequence[float], u: Sequence[float]) -> dict[str, float]:
        return self.common_values(x, self.torques(x, 0.0, 0.0), u[0])


class _SpeedControlled(_Actuator):
    """States (phi_C, w_C, phi_W, w_W, z, phi_L, w_L, integral part of the current); input w_ref."""

    FADE = 1e-3  # the integral stops within this share of i_max beyond the limit

    def __init__(self, p: Values) -> None:
        super().__init__(p)
        self.kp, self.ki, self.i_max = p["kp"], p["ki"], p["i_max"]
        self.mgr = p.get("mgr", 0.0)
        phi, w = p["phi_load_start"], p["w_motor_start"]
        self._start = [0.0, 0.0, self.n * phi, w, 0.0, phi, w / self.n, p["i_start"]]

    def start(self) -> list[float]:
        return self._start

    def current(self, x: Sequence[float], w_ref: float) -> tuple[float, float]:
        """Return the limited current and the derivative of its integral part."""
        error = w_ref - (x[3] - x[1])
        command = self.kp * error + x[7]
        excess = abs(command) / self.i_max - 1.0
        hold = min(1.0, max(0.0, excess / self.FADE))
        return max(-self.i_max, min(self.i_max, command)), (1.0 - hold) * self.ki * error

    def derivatives(self, x: Sequence[float], u: Sequence[float]) -> list[float]:
        current, integration = self.current(x, u[0])
        torques = self.torques(x, x[5], x[6])
        load = (self.n * torques[0] - self.mgr * sin(x[5])) / self.J_L
        return [*self.motion(x, torques, current), x[6], load, integration]

    def values(self, x: Sequence[float], u: Sequence[float]) -> dict[str, float]:
        current = self.current(x, u[0])[0]
        return {
            **self.common_values(x, self.torques(x, x[5], x[6]), current),
            "i_motor": current,
            "phi_load": x[5],
            "load.phi": x[5],
            "load.w": x[6],
            "controller.integral": x[7],
        }


def _parameters(load_inertia: float, bearing_friction: float) -> list[Variable]:
    table = [
        parameter(f"lossTable[{i},{j}]", value)
        for i, speed in enumerate(ROW_SPEEDS, start=1)
        for j, value in enumerate((speed, 1.0, 1.0, bearing_friction, bearing_friction), start=1)
    ]
    return [
        parameter("n", 50.0, "1"),
        parameter("K_m", 0.7, "N.m/A"),
        parameter("J_R", 2e-4, "kg.m2", 0.0),
        parameter("J_S", 0.003, "kg.m2", 0.0),
        parameter("c_S", 130000.0, "N.m/rad", 0.0),
        parameter("d_S", 0.6, "N.m.s/rad", 0.0),
        parameter("c_G", 25500.0, "N.m/rad", 0.0),
        parameter("d_G", 50.0, "N.m.s/rad", 0.0),
        parameter("J_L", load_inertia, "kg.m2", 0.0),
        *table,
        parameter("phi_s", 2e-5, "rad", 0.0),
        parameter("t_s", 1e-3, "s", 0.0),
        parameter("z_e", 0.9, "1", 0.0),
    ]


_LOCALS = (
    computed("motor.tau", "N.m", "local"),
    computed("housing.phi", "rad", "local"),
    computed("housing.w", "rad/s", "local"),
    computed("rotor.phi", "rad", "local"),
    computed("rotor.w", "rad/s", "local"),
    computed("gear.bristle.z", "1", "local"),
    computed("gear.tau_load", "N.m", "local"),
    computed("gear.dtau", "N.m", "local"),
    computed("gear.lossPower", "W", "local"),
)
_SENSORS = (computed("w_motor", "rad/s"), computed("tau_sensor", "N.m"))
_BODY_SCALE = (1e-4, 1e-2, 1e-2, 1.0, 1.0)


def fixed_shaft() -> Equations:
    """Output shaft locked, motor current given."""
    variables = [*_parameters(0.05, 0.0), input_variable("i_cmd", "A"), *_SENSORS, *_LOCALS]
    return Equations("FixedShaft", tuple(variables), _BODY_SCALE, _FixedShaft)


def _speed_controlled(name: str, load_inertia: float, extra: Sequence[Variable]) -> Equations:
    variables = [
        *_parameters(load_inertia, 0.09),
        parameter("kp", 0.02, "A.s/rad"),
        parameter("ki", 0.4, "A/rad"),
        parameter("i_max", 6.0, "A", 0.0),
        parameter("phi_load_start", 0.0, "rad"),
        parameter("w_motor_start", 0.0, "rad/s"),
        parameter("i_start", 0.0, "A"),
        input_variable("w_ref", "rad/s"),
        computed("i_motor", "A"),
        *_SENSORS,
        *_LOCALS,
        computed("load.phi", "rad", "local"),
        computed("load.w", "rad/s", "local"),
        computed("controller.integral", "A", "local"),
        *extra,
    ]
    return Equations(name, tuple(variables), (*_BODY_SCALE, 1e-2, 1e-2, 1e-1), _SpeedControlled)


def free_shaft() -> Equations:
    """Output shaft free, rotor speed controlled."""
    return _speed_controlled("FreeShaft", 0.05, ())


def eccentric_load() -> Equations:
    """Eccentric mass on the output shaft, rotor speed controlled."""
    return _speed_controlled("EccentricLoad", 0.5, (parameter("mgr", 25.0, "N.m"), computed("phi_load", "rad")))
