"""Rotating trains compiled from Modelica against their analytic solutions."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from fmu_build import build, compile_modelica
from fmu_build.errors import ModelicaError
from fmu_build.model import CompiledModel
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.simulator import Task
from tests.fmu_build.simulate import Instance, find, states, values

TRAINS = Path(__file__).parent / "models" / "Trains.mo"


@cache
def compiled(name: str) -> CompiledModel:
    return compile_modelica(TRAINS, f"Trains.{name}")


def test_oscillator():
    instance = Instance.of(compiled("Oscillator"))
    times = np.linspace(0.0, 3.0, 31)

    x = instance.simulate(times)

    y = [instance.get("y", t, state) for t, state in zip(times, x, strict=True)]
    np.testing.assert_allclose(y, 0.1 * np.cos(10.0 * times), atol=1e-7)


def test_parameters_change_the_result():
    instance = Instance.of(compiled("Oscillator"), {"spring.c": 100.0})
    x = instance.simulate([0.0, 1.0])
    assert instance.get("y", 1.0, x[-1]) == pytest.approx(0.1 * np.cos(5.0), abs=1e-7)


def test_two_mass_train_under_a_step():
    instance = Instance.of(compiled("TwoMass"))
    times = np.linspace(0.0, 2.0, 21)

    x = instance.simulate(times, lambda t: (2.0,))

    c, d, j1, j2 = 300.0, 0.5, 1.0, 3.0
    a = np.array(
        [
            [0, 1, 0, 0, 0],
            [-c / j1, -d / j1, c / j1, d / j1, 1 / j1],
            [0, 0, 0, 1, 0],
            [c / j2, d / j2, -c / j2, -d / j2, 0],
            [0, 0, 0, 0, 0],
        ]
    )
    exact = np.array([expm(a * t) @ [0, 0, 0.2, 0, 2.0] for t in times])
    assert states(instance.model) == ["one.phi", "one.w", "two.phi", "two.w"]
    np.testing.assert_allclose(x, exact[:, :4], atol=1e-6)


def test_rigid_coupling_has_two_states_and_the_cut_torque():
    instance = Instance.of(compiled("Rigid"))
    assert states(instance.model) == ["two.phi", "two.w"]
    assert not instance.model.has_initial

    x = instance.simulate([0.0, 1.0], lambda t: (6.0,))

    assert instance.get("w", 1.0, x[-1], [6.0]) == pytest.approx(2.0)
    assert instance.get("cut", 1.0, x[-1], [6.0]) == pytest.approx(4.0)
    assert instance.get("one.acc", 1.0, x[-1], [6.0]) == pytest.approx(2.0)


def test_gear_reflects_the_inertia_and_the_start_values():
    instance = Instance.of(compiled("Geared"))
    assert len(states(instance.model)) == 2
    start = instance.start()
    assert instance.get("motor.phi", 0.0, start) == pytest.approx(5.0)

    x = instance.simulate([0.0, 0.5], lambda t: (1.2,))

    assert instance.get("w_load", 0.5, x[-1]) == pytest.approx(1.2 * 10 / (2 + 0.1 * 100) * 0.5)
    assert instance.get("w_motor", 0.5, x[-1]) == pytest.approx(1.2 * 100 / (2 + 0.1 * 100) * 0.5)


def test_pendulum_keeps_its_energy_and_starts_where_the_parameter_says():
    instance = Instance.of(compiled("Pendulum"), {"phi0": 1.0})
    times = np.linspace(0.0, 5.0, 26)

    x = instance.simulate(times)

    assert x[0, 0] == 1.0
    energy = [instance.get("energy", t, state) for t, state in zip(times, x, strict=True)]
    np.testing.assert_allclose(energy, energy[0], rtol=1e-6)


def test_actuator_against_its_matrices():
    """Harmonic Drive between housing (C), rotor (W) and flexspline (F): phi_W = (1 - n) phi_C + n phi_F."""
    instance = Instance.of(compiled("Actuator"))
    names = states(instance.model)
    assert len(names) == 6
    n, c_s, d_s, c_g, d_g = 50.0, 1.3e5, 2.66, 25500.0, 70.6
    j_s, j_r, j_l = 3.0e-3, 2.0e-4, 0.06
    # coordinates: housing s, rotor r, load l; flexspline's input angle f = (r - (1 - n) s)/n
    f = np.array([(n - 1) / n, 1 / n, 0.0])
    g = np.array([0.0, 0.0, 1.0]) - f
    e = np.array([1.0, 0.0, 0.0])
    stiffness = c_s * np.outer(e, e) + c_g * np.outer(g, g)
    damping = d_s * np.outer(e, e) + d_g * np.outer(g, g)
    rng = np.random.default_rng(1)
    q, w, i = rng.normal(size=3) * 1e-3, rng.normal(size=3), 0.5
    force = 0.7 * i * np.array([-1.0, 1.0, 0.0]) - stiffness @ q - damping @ w
    expected = force / [j_s, j_r, j_l]
    value = {
        "housing.phi": q[0], "housing.w": w[0], "rotor.phi": q[1], "rotor.w": w[1], "load.phi": q[2],
        "load.w": w[2],
    }  # fmt: skip
    x = np.array([value[name] for name in names])

    dx = dict(zip(names, instance.derivative(0.0, x, [i]), strict=True))

    np.testing.assert_allclose([dx[f"{b}.w"] for b in ("housing", "rotor", "load")], expected, rtol=1e-12)
    np.testing.assert_allclose([dx[f"{b}.phi"] for b in ("housing", "rotor", "load")], w, rtol=1e-12)
    sensor = instance.get("tau_sensor", 0.0, x, [i])
    assert sensor == pytest.approx(-(c_s * q[0] + d_s * w[0]))


def test_actuator_at_rest_locked_gives_n_times_the_motor_torque():
    """Positive current: tau_sensor = + n K_m i with the output held (found from zero accelerations)."""
    instance = Instance.of(compiled("Actuator"))
    names = states(instance.model)
    torque = 50 * 0.7 * 0.5
    s = -torque / 1.3e5
    f = torque / 25500.0
    x = np.zeros(6)
    x[names.index("housing.phi")] = s
    x[names.index("rotor.phi")] = (1 - 50) * s + 50 * f

    assert instance.get("tau_sensor", 0.0, x, [0.5]) == pytest.approx(17.5)
    dx = dict(zip(names, instance.derivative(0.0, x, [0.5]), strict=True))
    assert dx["rotor.w"] == pytest.approx(0.0, abs=1e-6)
    assert dx["housing.w"] == pytest.approx(0.0, abs=1e-6)


def test_varying_constraint_with_chosen_states():
    instance = Instance.of(compiled("Crank"))
    assert states(instance.model) == ["phi", "w"]

    times = np.linspace(0.0, 2.0, 21)
    x = instance.simulate(times)

    energy = [instance.get("energy", t, state) for t, state in zip(times, x, strict=True)]
    np.testing.assert_allclose(energy, energy[0], rtol=1e-6)
    phi = x[-1, 0]
    assert instance.get("s", 2.0, x[-1]) == pytest.approx(
        0.1 * np.cos(phi) + np.sqrt(0.09 - 0.01 * np.sin(phi) ** 2)
    )


def test_a_pendulum_in_cartesian_coordinates_passes_every_position(tmp_path):
    assert states(compiled("Cartesian")) == ["x", "y", "vx", "vy"]
    assert states(compiled("Sticks")) == ["phi", "w"]
    assert states(compiled("Chosen")) == ["x", "vx"]
    time = np.linspace(0.0, 10.0, 501)
    motions = {}
    for name in ("Cartesian", "Sticks"):
        fmu = Fmu(build(TRAINS, f"Trains.{name}", tmp_path))
        motions[name] = np.array(fmu.simulate(Task(time, {}, ("x", "y")), {}))
    x, y = motions["Cartesian"]
    assert y.max() > 0.5
    assert x.max() > 0.99
    assert x.min() < -0.99
    np.testing.assert_allclose(np.hypot(x, y), 1.0, atol=1e-6)
    np.testing.assert_allclose(motions["Cartesian"], motions["Sticks"], atol=1e-3)


def test_reinit_of_what_a_constraint_ties_to_other_states_is_refused(tmp_path):
    text = TRAINS.read_text()
    start = text.index("  model Cartesian")
    body = text[start : text.index("  end Cartesian;")] + "    when time > 1 then\n  reinit(vx, 0);\n end when;\n"
    file = tmp_path / "Cartesian.mo"
    file.write_text(body + "  end Cartesian;\n")
    with pytest.raises(ModelicaError, match=r"Cartesian\.mo:\d+: reinit of 'vx', which a constraint ties"):
        compile_modelica(file, "Cartesian")


@pytest.mark.parametrize("name", ["TwoMass", "Geared", "Pendulum", "Actuator", "Crank"])
def test_derivatives_against_central_differences(name):
    instance = Instance.of(compiled(name))
    m, f = instance.model, instance.model.functions
    rng = np.random.default_rng(0)
    x, u = instance.start() + rng.normal(size=m.n_x) * 0.1, rng.normal(size=m.n_u)
    directions = [rng.normal(size=n) for n in (m.n_x, m.n_u, m.n_p)]
    directions[2] *= np.abs(instance.p)  # some parameters are small
    h = 1e-6

    def both(step: float) -> np.ndarray:
        p = instance.p + step * directions[2]
        moved = Instance(m, p, values(f["dependent"](p)))
        env = moved.env(0.0, x + step * directions[0], u + step * directions[1])
        return np.concatenate([values(f["derivatives"](*env)), values(f["variables"](*env))])

    directions.append(values(f["dependent_partials"](instance.p, directions[2])))
    seeds = [*instance.env(0.0, x, u), *directions, np.zeros(m.n_y)]
    along = np.concatenate([values(f[name](*seeds)) for name in ("partials", "variable_partials")])
    np.testing.assert_allclose(along, (both(h) - both(-h)) / (2 * h), rtol=1e-6, atol=1e-6)
    dx, by_x, by_t = f["jacobian"](*instance.env(0.0, x, u))
    only_x = f["partials"](*instance.env(0.0, x, u), directions[0], *(0 * s for s in directions[1:]), [])
    np.testing.assert_allclose(np.asarray(by_x) @ directions[0], values(only_x), rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(values(dx), values(f["derivatives"](*instance.env(0.0, x, u))))
    assert not np.any(values(by_t))


def test_same_input_same_bytes():
    again = compile_modelica(TRAINS, "Trains.Geared")
    assert again.c_source == compiled("Geared").c_source
    assert again.content_hash == compiled("Geared").content_hash
    assert str(TRAINS.parent) not in again.c_source + again.c_header


def test_description_of_the_variables():
    model = compiled("Rigid")
    w = find(model, "two.w")
    assert (w.unit, w.causality, w.initial, w.start) == ("rad/s", "local", "exact", 0.0)
    assert find(model, "der(two.w)").unit == "rad/s2"
    assert find(model, "w").depends_on == ("two.w",)
    assert find(model, "cut").depends_on == ("u",)
    unit = next(u for u in model.units if u.name == "N.m")
    assert unit.exponents == (1, 2, -2, 0, 0, 0, 0, 0)
    phi = next(u for u in model.units if u.name == "rad")
    assert phi.display_units[0].name == "deg"
