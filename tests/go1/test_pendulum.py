"""The servo pendulum: FMU against the hand-written model, the friction laws."""

from __future__ import annotations

import fmpy
import numpy as np
import pytest

from fmu_build import build
from fmuid.reference import reference_fmu
from fmuid.reference.servo_pendulum import friction_budget
from fmuid.simulation.simulator import Task
from tests.conftest import MODELICA
from tests.go1.conftest import LAW_M6, RIG, SETUPS, servo_task
from tests.reference.plain_fmpy import simulate_fmu

LAWS = {
    "CoulombViscous": (),
    "Stribeck": ("K_cs", "w_s", "alpha"),
    "LoadDependent": ("K_l",),
    "StribeckLoadDependent": ("K_cs", "w_s", "alpha", "K_l", "K_ls"),
    "Directional": ("K_cs", "w_s", "alpha", "K_m", "K_e", "K_ms", "K_es"),
    "Quadratic": ("K_cs", "w_s", "alpha", "K_m", "K_e", "K_ms", "K_es", "K_mq", "K_eq"),
}


@pytest.mark.parametrize("setup", SETUPS)
def test_fmu_is_the_hand_written_model(pendulum_fmus, setup):
    task, values = servo_task(setup), {**LAW_M6, **RIG}
    expected = reference_fmu(setup).simulate(task, values)
    outputs = simulate_fmu(pendulum_fmus[setup], task, values)

    for variable, y, reference in zip(task.outputs, outputs, expected, strict=True):
        assert np.sqrt(np.mean((y - reference) ** 2)) <= 1e-5 * np.ptp(reference), variable


@pytest.mark.parametrize("setup", SETUPS)
def test_reference_has_the_fmu_s_variables(pendulum_fmus, setup):
    description = fmpy.read_model_description(str(pendulum_fmus[setup]))
    of_fmu = {v.name: v for v in description.modelVariables}

    for variable in reference_fmu(setup).variables.values():
        twin = of_fmu[variable.name]
        unit = twin.unit or (twin.declaredType.unit if twin.declaredType else None)
        assert (twin.causality, unit) == (variable.causality, variable.unit), variable.name
        if variable.causality in ("parameter", "input"):
            assert float(twin.start) == variable.start, variable.name


@pytest.fixture(scope="module")
def budgets(tmp_path_factory):
    """An FMU with every law side by side, at a given speed and given torques."""
    values = {**{n.removeprefix("friction."): v for n, v in LAW_M6.items()}, "K_l": 0.03, "K_ls": 0.02}
    parts = "\n".join(
        f"  Pendulum.Friction.{law} law{k}({', '.join(f'{n} = {values[n]}' for n in ('K_c', 'K_v', *terms))});\n"
        f"  output Real budget{k} = law{k}.budget;"
        for k, (law, terms) in enumerate(LAWS.items(), 1)
    )
    turned = "\n".join(
        f"  law{k}.tau_m = tau_m;\n  law{k}.tau_e = tau_e;\n  connect(law{k}.flange, joint.flange_a);"
        for k in range(1, len(LAWS) + 1)
    )
    folder = tmp_path_factory.mktemp("laws")
    source = f"""model Laws
  parameter Real w0 = 0;
  parameter Real tau_m = 0;
  parameter Real tau_e = 0;
  Drives.Components.Inertia joint(J = 1e9, phi(start = 0, fixed = true), w(start = w0, fixed = true));
{parts}
equation
{turned}
end Laws;
"""
    (folder / "Laws.mo").write_text(source)
    return build(folder / "Laws.mo", "Laws", folder, roots=[MODELICA])


@pytest.mark.parametrize(
    ("w", "tau_m", "tau_e"),
    [(0.05, 1.5, -1.2), (-0.6, 1.5, -2.2), (0.0, -0.7, 0.7), (3.0, 0.0, -2.0), (0.3, 1.0, 2.0)],
)
def test_each_law_is_its_formula_and_a_part_of_m6(budgets, w, tau_m, tau_e):
    task = Task(np.array([0.0, 1e-9]), {}, tuple(f"budget{k}" for k in range(1, 7)))
    simulated = simulate_fmu(budgets, task, {"w0": w, "tau_m": tau_m, "tau_e": tau_e})[:, 0]

    off = {n: 0.0 for n in LAW_M6 if n not in ("friction.w_s", "friction.alpha")}
    base = {**LAW_M6, **off, "friction.K_c": LAW_M6["friction.K_c"]}
    stribeck = {"friction.K_cs": LAW_M6["friction.K_cs"]}
    load, standstill = 0.03, 0.02
    as_m6 = [
        base,
        {**base, **stribeck},
        {**base, "friction.K_m": load, "friction.K_e": load},
        {**base, **stribeck, "friction.K_m": load, "friction.K_e": load}
        | {"friction.K_ms": standstill, "friction.K_es": standstill},
        {**LAW_M6, "friction.K_mq": 0.0, "friction.K_eq": 0.0},
        LAW_M6,
    ]
    assert simulated == pytest.approx([friction_budget(p, w, tau_m, tau_e) for p in as_m6], rel=1e-6)


def test_a_law_by_hand():
    p = {**LAW_M6, "friction.K_ms": 0.0, "friction.K_es": 0.0}
    stribeck = np.exp(-(((0.4 / 0.4) ** 2 + 1e-6) ** 0.85))
    lifting = 0.11 + abs(0.03 * 3.0 + 0.05 * 2.0) + stribeck * (0.06 + 0.015 * 2.0**2)

    assert friction_budget(p, 0.4, 3.0, -2.0) == pytest.approx(lifting, rel=1e-6)


def test_friction_holds_up_to_its_budget_and_no_further(pendulum_fmus):
    time = np.arange(201) * 0.016
    enough = (0.2 * 6.33 - 0.3) / (
        1.039 * 9.80665 * 0.15
    )  # sine of the angle above which friction need not give way
    for sine, moves in ((enough + 0.02, False), (enough - 0.1, True)):
        start = float(np.arcsin(sine))
        task = Task(time, {"tau_ref": np.full(201, 0.2)}, ("q",), {"q_start": start})
        (q,) = simulate_fmu(pendulum_fmus["TorqueDriven"], task, {"friction.K_c": 0.3})
        assert (abs(q[-1] - start) > 0.05) == moves
