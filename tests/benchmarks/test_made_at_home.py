"""Answers with a made catalogue, scored in the names of the virtual rig."""

from __future__ import annotations

import pytest

from benchmarks.blind.made import scored


def case(effects, ports, *, kind="one", shapes=None):
    return {"kind": kind, "effects": effects, "ports": ports, "shapes": shapes or [{}], "gap": 3.0, "gaps": [3.0]}


def answer(*sets, ports, model=()):
    names = list(dict.fromkeys(n for s in sets for n in s))
    alone = len(sets) == 1
    return {
        "verdict": {
            "kind": "effect" if alone else "ambiguous",
            "effects": list(sets[0]) if alone else [],
            "one_of": [] if alone else [list(s) for s in sets],
            "port": ports[0],
            "ports": list(ports),
        },
        "answers": [{"effects": list(s), "probability": 0.9 / len(sets)} for s in sets],
        "effects": [{"id": n, "probability": 0.9 / len(names)} for n in names],
        "model": {"parameters": dict(model)},
        "baselines": {"hold_out_rmse": list(names)},
    }


def test_two_names_of_one_cause_are_one_answer():
    said = answer(("asymmetry@motor",), ("offset@motor.i",), ports=("motor", "motor.i"))
    found = scored(case(["coulomb_asymmetry"], ["gear_friction"]), said)
    assert found.right
    assert found.ranked[0] == ("coulomb_asymmetry", pytest.approx(0.9))
    assert found.answer["baselines"] == {"hold_out_rmse": ["coulomb_asymmetry"]}
    assert found.answer["verdict"]["port"] == "gear_friction"


def test_a_law_that_is_the_effect_has_the_right_place():
    found = scored(case(["coulomb_asymmetry"], ["gear_friction"]), answer(("offset@motor.i",), ports=("motor.i",)))
    assert found.right
    assert found.answer["verdict"]["port"] == "gear_friction"


def test_other_causes_stay_apart():
    said = answer(("asymmetry@motor",), ("lag@tau_sensor",), ports=("motor", "tau_sensor"))
    found = scored(case(["coulomb_asymmetry"], ["gear_friction"]), said)
    assert found.kind == "ambiguous"
    assert not found.right


@pytest.mark.parametrize(
    ("effect", "shape", "order", "right"),
    [
        ("kinematic_error", {}, 2.001, True),
        ("kinematic_error", {}, 6.0, False),
        ("cogging", {"cogging_order": 6.0}, 6.02, True),
        ("cogging", {"cogging_order": 6.0}, 2.0, False),
        ("gear_ripple", {"gear_ripple_order": 3.0}, 3.0, True),
        ("gear_ripple", {"gear_ripple_order": 3.0}, 7.0, False),  # another ripple is not it
    ],
)
def test_a_ripple_is_told_by_its_order(effect, shape, order, right):
    said = answer(("cogging@rotor",), ports=("rotor",), model={"rotor.cogging_order": order})
    kind = "outside" if effect == "gear_ripple" else "one"
    assert scored(case([effect], ["motor_torque"], kind=kind, shapes=[shape]), said).right is right


@pytest.mark.parametrize(("order", "right"), [(100.1, True), (50.0, False)])
def test_an_error_of_the_gear_is_told_by_its_order_at_the_flexspline(order, right):
    said = answer(
        ("kinematic_error@flexspline",),
        ports=("flexspline",),
        model={"flexspline.kinematic_error_order": order},
    )
    found = scored(case(["kinematic_error"], ["gear_friction"]), said)
    assert found.right is right
    assert found.answer["verdict"]["port"] == "gear_friction"


@pytest.mark.parametrize(
    ("effect", "law", "right"),
    [
        ("rotor_rub", "position_friction@rotor", True),
        ("rotor_rub", "viscous@rotor", False),
        ("windage", "quadratic@motor", True),
        ("friction_patch", "position_friction@motor", False),
    ],
)
def test_of_an_effect_outside_the_rig_s_catalogue_its_own_law_is_right_and_so_is_unknown(effect, law, right):
    label = case([effect], ["gear_friction"], kind="outside")
    said = answer((law,), ports=(law.partition("@")[2],))
    said["answers"].append({"effects": ["unknown"], "probability": 0.08})
    found = scored(label, said)
    assert found.right is right
    assert found.ranked[0][1] == pytest.approx(0.98 if right else 0.9)
    unknown = {**said["verdict"], "kind": "unknown", "effects": []}
    assert scored(label, {**said, "verdict": unknown}).right
