"""The effects of the blind check: the catalogue's, by the rig's laws, and some that no catalogue has.

The rig's laws differ from an FMU's on purpose: Maxwell-slip elements for presliding and hysteresis, a table for
hardening, a kinematic error that works back on the motor, two poles for a lag, heating by friction power.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from benchmarks.virtual_rig.rig import Rig

Shape = Mapping[str, float]


def _no_shape(rng: np.random.Generator) -> dict[str, float]:
    del rng
    return {}


@dataclass(frozen=True, slots=True)
class BlindEffect:
    """One effect: where it acts, how large it may be, and what else is drawn with it.

    Parameters
    ----------
    id
        Its id in the catalogue, or a name of its own outside it.
    port
        Where it acts, as a catalogue names its ports.
    low, high
        Range of its magnitude in which a gap is looked for; `high` is the largest that is plausible.
    put
        (rig, magnitude, shape) -> the rig with the effect.
    shape
        Draws what is not its magnitude: order, phase, time constant, sign.
    """

    id: str
    port: str
    low: float
    high: float
    put: Callable[[Rig, float, Shape], Rig]
    shape: Callable[[np.random.Generator], dict[str, float]] = _no_shape
    in_catalogue: bool = True


@dataclass(frozen=True, slots=True)
class DrawnEffect:
    """An effect with its magnitude and shape."""

    effect: BlindEffect
    magnitude: float
    shape: Shape = field(default_factory=dict)

    def put(self, rig: Rig) -> Rig:
        """Return the rig with the effect."""
        return self.effect.put(rig, self.magnitude, self.shape)


def _parameter(name: str, *, signed: bool = False, around: float = 0.0) -> Callable[[Rig, float, Shape], Rig]:
    """Return a function that sets one parameter of the rig, together with the other values of its shape."""

    def put(rig: Rig, magnitude: float, shape: Shape) -> Rig:
        sign = shape["sign"] if signed else 1.0
        rest = {k: v for k, v in shape.items() if k != "sign"}
        return rig.changed(**rest, **{name: around + sign * magnitude})

    return put


def _mesh_loss(rig: Rig, magnitude: float, shape: Shape) -> Rig:
    table = np.array(rig.loss_table)
    table[:, 1] -= magnitude
    table[:, 2] -= magnitude * shape["ratio"]
    return replace(rig, loss_table=table)


def _delay(rig: Rig, magnitude: float, shape: Shape) -> Rig:
    where = "delay" if shape["in_loop"] else "input_delay"
    return rig.changed(**{where: magnitude})


def _uniform(**ranges: tuple[float, float]) -> Callable[[np.random.Generator], dict[str, float]]:
    return lambda rng: {k: float(rng.uniform(*r)) for k, r in ranges.items()}


def _choice(**values: tuple[float, ...]) -> Callable[[np.random.Generator], dict[str, float]]:
    return lambda rng: {k: float(rng.choice(v)) for k, v in values.items()}


def _both(
    *draws: Callable[[np.random.Generator], dict[str, float]],
) -> Callable[[np.random.Generator], dict[str, float]]:
    return lambda rng: {k: v for draw in draws for k, v in draw(rng).items()}


_ANGLE = (0.0, 2 * np.pi)
_SIGN = _choice(sign=(-1.0, 1.0))
_FRICTION, _FLEXSPLINE, _MOTOR = "gear_friction", "flexspline_deflection", "motor_torque"
_SENSOR, _LOAD, _CURRENT = "torque_sensor", "load_torque", "current"

_CATALOGUE = (
    BlindEffect("viscous", _FRICTION, 1e-6, 3e-3, _parameter("viscous")),
    BlindEffect("stribeck", _FRICTION, 1e-4, 0.15, _parameter("stribeck"), _uniform(stribeck_speed=(2.0, 10.0))),
    BlindEffect("coulomb_asymmetry", _FRICTION, 1e-4, 0.5, _parameter("coulomb_asymmetry", signed=True), _SIGN),
    BlindEffect("mesh_loss", _FRICTION, 1e-4, 0.3, _mesh_loss, _uniform(ratio=(0.9, 1.5))),
    BlindEffect("presliding", _FRICTION, 3e-5, 3e-2, _parameter("presliding")),
    BlindEffect("backlash", _FLEXSPLINE, 1e-6, 3e-3, _parameter("backlash")),
    BlindEffect(
        "hardening", _FLEXSPLINE, 1e-3, 2.0, _parameter("hardening"), _uniform(hardening_angle=(2e-4, 6e-4))
    ),
    BlindEffect(
        "hysteresis",
        _FLEXSPLINE,
        1e-2,
        12.0,
        _parameter("hysteresis"),
        _uniform(hysteresis_angle=(1e-4, 4e-4)),
    ),
    BlindEffect(
        "kinematic_error",
        _FRICTION,  # the error works back on the Wave Generator: what signals show of it is its torque ripple
        1e-7,
        1e-3,
        _parameter("kinematic_error"),
        _uniform(kinematic_phase=_ANGLE),
    ),
    BlindEffect(
        "cogging",
        _MOTOR,
        1e-5,
        0.1,
        _parameter("cogging"),
        _both(_choice(cogging_order=(4.0, 6.0, 8.0, 12.0)), _uniform(cogging_phase=_ANGLE)),
    ),
    BlindEffect("current_lag", _CURRENT, 2e-5, 1e-2, _parameter("current_lag")),
    BlindEffect("saturation", _MOTOR, 0.05, 0.8, _parameter("saturation")),
    BlindEffect("sensor_offset", _SENSOR, 1e-3, 6.0, _parameter("sensor_offset", signed=True), _SIGN),
    BlindEffect("sensor_gain", _SENSOR, 1e-4, 0.3, _parameter("sensor_gain", signed=True, around=1.0), _SIGN),
    BlindEffect("sensor_lag", _SENSOR, 2e-5, 1e-2, _parameter("sensor_lag")),
    BlindEffect("imbalance", _LOAD, 1e-3, 8.0, _parameter("imbalance"), _uniform(imbalance_phase=_ANGLE)),
    BlindEffect(
        "thermal_friction",
        _FRICTION,
        1e-4,
        1.0,
        _parameter("thermal_friction"),
        _uniform(thermal_time=(3.0, 20.0)),
    ),
    BlindEffect("delay", _CURRENT, 4e-5, 1e-2, _delay, _choice(in_loop=(0.0, 1.0))),
)

_OUTSIDE = (
    BlindEffect("windage", _FRICTION, 1e-8, 3e-5, _parameter("windage")),
    BlindEffect(
        "friction_patch",
        _FRICTION,
        5e-3,
        3.0,
        _parameter("friction_patch"),
        _uniform(friction_patch_angle=_ANGLE),
    ),
    BlindEffect("rotor_rub", _FRICTION, 2e-3, 0.9, _parameter("rotor_rub")),
    BlindEffect("crosstalk", _SENSOR, 1e-3, 5.0, _parameter("crosstalk", signed=True), _SIGN),
    BlindEffect("encoder_eccentricity", "motor_encoder", 1e-4, 0.2, _parameter("encoder_eccentricity")),
    BlindEffect("load_brush", _LOAD, 0.05, 6.0, _parameter("load_brush")),
    BlindEffect(
        "gear_ripple",
        _FLEXSPLINE,
        1e-7,
        1e-3,
        _parameter("gear_ripple"),
        _choice(gear_ripple_order=(1.0, 3.0, 4.0, 7.0)),
    ),
    BlindEffect("line_hum", _CURRENT, 1e-4, 0.5, _parameter("line_hum")),
    BlindEffect(
        "sensor_creep", _SENSOR, 1e-4, 0.3, _parameter("sensor_creep"), _uniform(sensor_creep_time=(0.5, 5.0))
    ),
    BlindEffect(
        "relaxation", _FLEXSPLINE, 1e-3, 1.0, _parameter("relaxation"), _uniform(relaxation_time=(0.02, 0.5))
    ),
    BlindEffect(
        "torque_ripple",
        _MOTOR,
        1e-4,
        0.3,
        _parameter("torque_ripple"),
        _choice(torque_ripple_order=(6.0, 12.0)),
    ),
)

BLIND_EFFECTS: Mapping[str, BlindEffect] = MappingProxyType(
    {e.id: e for e in _CATALOGUE} | {e.id: replace(e, in_catalogue=False) for e in _OUTSIDE}
)
