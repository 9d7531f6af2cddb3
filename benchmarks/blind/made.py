"""Answers with a made catalogue, in the names of the virtual rig's labels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.blind.blind_score import Scored
from benchmarks.blind.renamed import renamed

_BEARINGS = ("motor", "rotor")

# Effect of the rig -> laws and ports of the made catalogue. Stator and rotor move as Circular Spline and Wave
# Generator do. An offset of the current is a constant torque, and so is friction that depends on the direction.
# The plain gear has a presliding deflection of its own.
_SAME: Mapping[str, tuple[str, ...]] = {
    "viscous": ("viscous@motor", "viscous@rotor"),
    "stribeck": ("stribeck@motor", "stribeck@rotor"),
    "coulomb_asymmetry": ("asymmetry@motor", "asymmetry@rotor", "offset@motor.i", "offset@i_cmd"),
    "mesh_loss": ("load_friction@motor", "load_friction@rotor"),
    "presliding": ("presliding@motor", "presliding@rotor", "value@phi_s", "value@z_e", "value@t_s"),
    "thermal_friction": ("thermal_friction@motor", "thermal_friction@rotor"),
    "backlash": ("backlash@flexspline",),
    "hardening": ("hardening@flexspline",),
    "hysteresis": ("hysteresis@flexspline",),
    "current_lag": ("lag@motor.i", "lag@i_cmd"),
    "delay": ("delay@i_cmd",),
    "saturation": ("saturation@motor.i", "saturation@i_cmd"),
    "sensor_offset": ("offset@tau_sensor",),
    "sensor_gain": ("gain@tau_sensor",),
    "sensor_lag": ("lag@tau_sensor",),
    "imbalance": ("imbalance@load",),
    "windage": ("quadratic@motor", "quadratic@rotor"),
    "friction_patch": ("position_friction@motor", "position_friction@rotor"),
    "crosstalk": ("crosstalk@tau_sensor",),
    "load_brush": ("coulomb@load",),
}
_RIPPLE = ("cogging@motor", "cogging@rotor")
_ORDERS: Mapping[str, str] = {"gear_ripple": "gear_ripple_order", "cogging": "cogging_order"}

PLACES: Mapping[str, tuple[str, ...]] = {
    "gear_friction": _BEARINGS,
    "motor_torque": _BEARINGS,
    "flexspline_deflection": ("flexspline",),
    "load_torque": ("load", "gear.F"),
    "current": ("motor.i", "i_cmd"),
    "torque_sensor": ("tau_sensor", "sensor"),
    "motor_encoder": ("w_motor", "controller.w"),
}


def scored(
    label: Mapping[str, Any],
    answer: Mapping[str, Any],
    closure: float | None = None,
    second: Mapping[str, Any] | None = None,
) -> Scored:
    """Return a case to be scored in the label's names; effects that made catalogues have are not outside."""
    kind = label["kind"]
    if kind == "outside" and set(label["effects"]) <= {*_SAME, *_ORDERS}:
        kind = "one"
    return Scored({**label, "kind": kind}, _told(label, answer), closure, second and _told(label, second))


def _told(label: Mapping[str, Any], answer: Mapping[str, Any]) -> dict[str, Any]:
    name = {own: rig for rig, alike in _SAME.items() for own in alike}
    for own in _RIPPLE:
        order = answer["model"].get(f"{own.partition('@')[2]}.cogging_order")
        name[own] = "cogging" if order is None else _ripple(label, float(order))
    place = {own: port for port in label["ports"] for own in PLACES.get(port, ())}
    verdict = answer["verdict"]
    ports = list(dict.fromkeys(place.get(p, p) for p in verdict["ports"]))
    port = place.get(verdict["port"], verdict["port"])
    return renamed({**answer, "verdict": {**verdict, "port": port, "ports": ports}}, name)


def _ripple(label: Mapping[str, Any], order: float) -> str:
    """Return what a ripple of the motor's torque, of so many periods a turn, is called on the rig."""
    if abs(order - 2.0) < 0.1:  # a transmission error works back on the motor twice a turn
        return "kinematic_error"
    for effect, shape in zip(label["effects"], label["shapes"], strict=True):
        if effect in _ORDERS and abs(shape[_ORDERS[effect]] - order) < 0.1:
            return str(effect)
    return "cogging" if "gear_ripple" not in label["effects"] else "another ripple"
