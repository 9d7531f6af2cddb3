"""The linear axis (EMPS), by hand: M der(v) = gtau vir - Fv v - Fc share - offset, open loop and closed."""

from __future__ import annotations

from collections.abc import Sequence

from fmuid.reference.friction_law import bristle
from fmuid.reference.reference_fmu import Equations, Values, computed, input_variable, parameter


class _OpenLoop:
    """States (s, v, z); input vir."""

    def __init__(self, p: Values) -> None:
        self.p = dict(p)

    def start(self) -> list[float]:
        return [self.p["q_start"], self.p["v_start"], 0.0]

    def voltage(self, x: Sequence[float], *inputs: float) -> float:
        del x
        return inputs[0]

    def friction(self, x: Sequence[float]) -> tuple[float, float, float]:
        """Return force, der(z) and power lost."""
        p, v, z = self.p, x[1], x[2]
        dz, share = bristle(v / p["s_s"], z, p["t_s"], p["z_e"])
        sliding = p["Fv"] * v + p["Fc"] * share
        return sliding + p["offset"], dz, sliding * v - p["Fc"] * z * p["s_s"] * dz

    def derivatives(self, x: Sequence[float], u: Sequence[float]) -> list[float]:
        force, dz, _ = self.friction(x)
        return [x[1], (self.p["gtau"] * self.voltage(x, *u) - force) / self.p["M"], dz]

    def values(self, x: Sequence[float], u: Sequence[float]) -> dict[str, float]:
        vir = self.voltage(x, *u)
        return {
            "qm": x[0],
            "v": x[1],
            "vir": vir,
            "force": self.p["gtau"] * vir,
            "friction.bristle.z": x[2],
            "friction.lossPower": self.friction(x)[2],
        }


class _ClosedLoop(_OpenLoop):
    """States (s, v, z, s behind the controller's lag); inputs qg and pulses."""

    def start(self) -> list[float]:
        p = self.p
        return [*super().start(), p["q_start"] - p["t_v"] * p["v_start"]]

    def voltage(self, x: Sequence[float], *inputs: float) -> float:
        p, (qg, pulses) = self.p, inputs
        command = p["kv"] * (p["kp"] * (qg - x[0]) - (x[0] - x[3]) / p["t_v"]) + pulses
        return max(-p["vir_max"], min(p["vir_max"], command))

    def derivatives(self, x: Sequence[float], u: Sequence[float]) -> list[float]:
        return [*super().derivatives(x, u), (x[0] - x[3]) / self.p["t_v"]]


_COMMON = (
    parameter("M", 95.0, "kg", 0.0),
    parameter("Fv", 200.0, "N.s/m", 0.0),
    parameter("Fc", 20.0, "N", 0.0),
    parameter("offset", 0.0, "N"),
    parameter("gtau", 35.15065188248547, "N/V"),
    parameter("q_start", 0.0, "m"),
    parameter("v_start", 0.0, "m/s"),
    parameter("s_s", 1e-7, "m", 0.0),
    parameter("t_s", 3e-3, "s", 0.0),
    parameter("z_e", 0.9, "1", 0.0),
    computed("qm", "m"),
    computed("v", "m/s"),
    computed("force", "N"),
    computed("friction.bristle.z", "1", "local"),
    computed("friction.lossPower", "W", "local"),
)
_SCALE = (1e-3, 1e-2, 1.0)


def linear_axis_open_loop() -> Equations:
    """Linear axis driven by a given control signal."""
    return Equations("LinearAxisOpenLoop", (*_COMMON, input_variable("vir", "V")), _SCALE, _OpenLoop)


def linear_axis_closed_loop() -> Equations:
    """Linear axis under its position controller, with a voltage added for test pulses."""
    extra = (
        parameter("kp", 160.18, "1/s"),
        parameter("kv", 243.45, "V.s/m"),
        parameter("t_v", 1e-3, "s", 1e-6),
        parameter("vir_max", 10.0, "V", 0.0),
        input_variable("qg", "m"),
        input_variable("pulses", "V"),
        computed("vir", "V"),
    )
    return Equations("LinearAxisClosedLoop", (*_COMMON, *extra), (*_SCALE, 1e-3), _ClosedLoop)
