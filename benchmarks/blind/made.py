"""Answers with a made catalogue, in the names of the virtual rig's labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.blind.blind_score import Scored
from benchmarks.blind.renamed import renamed
from fmuid.diagnosis.summary import named

_BEARINGS = ("motor", "rotor")

# Effect of the rig -> laws and ports of the made catalogue. Stator and rotor move as Circular Spline and Wave
# Generator do. An offset of the current is a constant torque, and so is friction that depends on the direction.
# The plain gear has a presliding deflection of its own. The rig's delay is that of any recorded input.
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
    "delay": ("delay@i_cmd", "delay@w_ref"),
    "saturation": ("saturation@motor.i", "saturation@i_cmd"),
    "sensor_offset": ("offset@tau_sensor",),
    "sensor_gain": ("gain@tau_sensor",),
    "sensor_lag": ("lag@tau_sensor",),
    "imbalance": ("imbalance@load",),
}
# Effects that the virtual rig's own catalogue lacks, and laws that are the same in physics. A rub of the rotor
# scales the friction by the cosine of its angle.
_OUTSIDE: Mapping[str, tuple[str, ...]] = {
    "windage": ("quadratic@motor", "quadratic@rotor"),
    "rotor_rub": ("position_friction@motor", "position_friction@rotor"),
    "crosstalk": ("crosstalk@tau_sensor",),
    "load_brush": ("coulomb@load", "stribeck@load"),
}
# Ripples by the periods of the Flexspline's or rotor's turn that their parameter counts.
_RIPPLE: Mapping[str, tuple[str, float]] = {
    "cogging@motor": ("motor.cogging_order", 1.0),
    "cogging@rotor": ("rotor.cogging_order", 1.0),
    "kinematic_error@flexspline": ("flexspline.kinematic_error_order", 50.0),  # the gear's ratio
}
_ORDERS: Mapping[str, str] = {"gear_ripple": "gear_ripple_order", "cogging": "cogging_order"}
_FOREIGN = ("kinematic_error", "cogging")  # a law, and the effect that it does not stand for whatever its order
_ERRORS = ("kinematic_error", "gear_ripple")  # of the gear: they move the Flexspline and work back on the motor

PLACES: Mapping[str, tuple[str, ...]] = {
    "gear_friction": _BEARINGS,
    "motor_torque": (*_BEARINGS, "motor.i"),
    "flexspline_deflection": ("flexspline",),
    "load_torque": ("load", "gear.F"),
    "current": ("motor.i", "i_cmd", "w_ref"),
    "torque_sensor": ("tau_sensor", "sensor"),
    "motor_encoder": ("w_motor", "controller.w"),
}


def scored(
    label: Mapping[str, Any],
    answer: Mapping[str, Any],
    closure: float | None = None,
    second: Mapping[str, Any] | None = None,
) -> Scored:
    """Return a case to be scored in the label's names.

    Of an effect that the rig's own catalogue lacks, *unknown* is right, and so is the law that it is.
    """
    return Scored(label, _told(label, answer), closure, second and _told(label, second))


def _told(label: Mapping[str, Any], answer: Mapping[str, Any]) -> dict[str, Any]:
    name = {own: rig for rig, alike in {**_SAME, **_OUTSIDE}.items() for own in alike}
    for own, (parameter, turns) in _RIPPLE.items():
        order = answer["model"]["parameters"].get(parameter)
        law = own.partition("@")[0]
        name[own] = law if order is None else _ripple(label, law, float(order) / turns)
    place = {own: port for port in label["ports"] for own in PLACES.get(port, ())}
    for effect, port in zip(label["effects"], label["ports"], strict=True):
        if effect in _ERRORS:
            place["flexspline"] = port
    verdict = answer["verdict"]
    ports = list(dict.fromkeys(place.get(p, p) for p in verdict["ports"]))
    port = place.get(verdict["port"], verdict["port"])
    told = renamed({**answer, "verdict": {**verdict, "port": port, "ports": ports}}, name)
    if label["effects"] and set(named(told["verdict"])) == set(label["effects"]):  # the law includes its place
        told["verdict"] |= {"port": label["ports"][0], "ports": list(label["ports"])}
    return _as_unknown(told, label["effects"]) if label["kind"] == "outside" else told


def _as_unknown(answer: Mapping[str, Any], effects: Sequence[str]) -> dict[str, Any]:
    """Return an answer in which these effects count as *unknown*."""
    told = renamed(answer, dict.fromkeys(effects, "unknown"))
    told["effects"] = [e for e in told["effects"] if e["id"] != "unknown"]
    told["baselines"] = {k: [n for n in names if n != "unknown"] for k, names in told["baselines"].items()}
    if named(told["verdict"]) == ["unknown"]:
        told["verdict"] = {**told["verdict"], "kind": "unknown", "effects": [], "one_of": []}
    return told


def _ripple(label: Mapping[str, Any], law: str, order: float) -> str:
    """Return what a ripple of so many periods per turn of the rotor is called on the rig."""
    if abs(order - 2.0) < 0.1:  # a transmission error works back on the motor twice a turn
        return "kinematic_error"
    for effect, shape in zip(label["effects"], label["shapes"], strict=True):
        if effect in _ORDERS and abs(shape[_ORDERS[effect]] - order) < 0.1 and (law, effect) != _FOREIGN:
            return str(effect)
    return "cogging" if law == "cogging" and "gear_ripple" not in label["effects"] else "another ripple"
