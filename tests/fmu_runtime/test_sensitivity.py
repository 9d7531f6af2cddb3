"""Forward sensitivities of whole runs against central differences of accurate runs."""

from __future__ import annotations

import ctypes
from pathlib import Path

import fmpy
import numpy as np
import pytest

from fmu_build import build
from tests.conftest import build_setups


def choose(one, names):
    vr = (ctypes.c_uint * len(names))(*[one.vr[n] for n in names])
    return one.c.dll.fmuidSetSensitivityParameters(
        ctypes.c_void_p(one.c.component), vr, ctypes.c_size_t(len(names))
    )


def sensitivities(one, names, n):
    vr = (ctypes.c_uint * len(names))(*[one.vr[v] for v in names])
    values = (ctypes.c_double * (len(names) * n))()
    status = one.c.dll.fmuidGetSensitivities(
        ctypes.c_void_p(one.c.component), vr, ctypes.c_size_t(len(names)), values
    )
    assert status == 0, one.messages
    return np.array(values).reshape(len(names), n)


CASES = {
    "pendulum": (["phi", "energy", "der(w)", "through"], ["phi", "m", "l", "damping"], "tau", 0.05, 40),
    "train": (["tau_sensor", "w_motor", "b"], ["K_m", "J_R", "J_S", "d_S", "tau_bf"], "i_cmd", 5e-4, 40),
    "algebraic_loop": (["x", "out"], ["x", "a"], "u", 0.1, 10),
    "dependent_start": (["x", "out", "y", "c"], ["b"], None, 0.1, 20),
}


@pytest.mark.parametrize("name", CASES)
def test_sensitivities_of_a_run(fmu, name):
    outputs, parameters, drive, h, steps = CASES[name]
    u = 0.5 * np.where(np.arange(steps) // 6 % 2, -1.0, 1.0)
    one = fmu(name)
    assert choose(one, parameters) == 0
    one.start(1e-7)
    got = [sensitivities(one, outputs, len(parameters))]
    for k in range(steps):
        one.set(**({drive: u[k]} if drive else {}))
        one.c.doStep(k * h, h)
        got.append(sensitivities(one, outputs, len(parameters)))
    exact = np.empty_like(got)
    values = np.empty(len(parameters))
    for j, parameter in enumerate(parameters):
        value = one.get(parameter) if parameter not in ("phi", "x") else {"phi": 1.0, "x": 2.0}[parameter]
        values[j] = value
        eps = 1e-5 * value
        ends = [
            fmu(name)
            .start(1e-11, **{parameter: value + s * eps})
            .run(outputs, steps, h, inputs={drive: u} if drive else None)
            for s in (1, -1)
        ]
        exact[:, :, j] = (ends[0] - ends[1]) / (2 * eps)
    # changes for equal relative changes of the parameters; a difference has the noise of the largest in it
    got, exact = np.array(got) * values, exact * values
    size = np.abs(exact).max(axis=(0, 2))
    error = np.abs(got - exact).max(axis=(0, 2))
    # the worst by far is a stiff bristle as it turns; its mean error is small
    assert np.all(error <= np.where(np.array(outputs) == "b", 5e-3, 1e-3) * size)


def run_with(one, names, outputs, steps, h, drive, u, slopes=None, tolerance=1e-6):
    """Sensitivities at every communication point; inputs held, or linear between their samples."""
    assert choose(one, names) == 0
    one.start(tolerance, **({drive: u[0]} if drive else {}))
    rows = []
    for k in range(steps):
        if drive:
            one.set(**{drive: u[k]})
        if slopes is not None:
            one.c.setRealInputDerivatives([one.vr[drive]], [1], [slopes[k]])
        one.c.doStep(k * h, h)
        rows.append(sensitivities(one, outputs, len(names)))
    return np.array(rows)


@pytest.fixture
def instances(fmu, tmp_path):
    """Gives functions that make instances of an FMU, freed at the end."""
    kind, made = type(fmu("pendulum")), []

    def of(path: Path):
        folder = Path(fmpy.extract(str(path), str(tmp_path / "unpacked")))

        def instance():
            made.append(kind(path, folder))
            return made[-1]

        return instance

    yield of
    for one in made:
        one.c.freeInstance()


def test_kinks_do_not_spoil_the_sensitivities(instances):
    """Friction that turns around every few milliseconds, with the bristle's kinks inside the integrator's steps."""
    instance = instances(build_setups(("FixedShaft",))["FixedShaft"])
    names, outputs = ["K_m", "d_S", "lossTable[2,4]"], ["tau_sensor", "w_motor"]
    u = 0.8 * np.repeat(np.random.default_rng(3).choice([-1.0, 1.0], 30), 4)
    one = instance()
    values = one.get(*names)
    got = run_with(one, names, outputs, len(u), 1e-3, "i_cmd", u) * values
    exact = np.empty_like(got)
    for j, (name, value) in enumerate(zip(names, values, strict=True)):
        ends = []
        for sign in (1, -1):
            other = instance().start(1e-12, **{name: value * (1 + sign * 1e-5), "i_cmd": u[0]})
            ends.append(other.run(outputs, len(u), 1e-3, inputs={"i_cmd": u})[1:])
        exact[:, :, j] = (ends[0] - ends[1]) / 2e-5
    error = np.abs(got - exact).max(axis=(0, 2)) / np.abs(exact).max(axis=(0, 2))
    assert np.all(error < 4e-5), error


def test_sensitivities_under_a_ramp_and_with_dependence_on_time(fmu):
    u = np.sin(np.arange(21) * 0.3)
    slopes = np.diff(u) / 0.1
    got = run_with(fmu("forced"), ["x"], ["x", "y"], 20, 0.1, "u", u, slopes, 1e-8)[:, 0, 0]
    ends = []
    for sign in (1, -1):
        one = fmu("forced").start(1e-12, x=1 + sign * 1e-5, u=u[0])
        values = []
        for k in range(20):
            one.set(u=u[k])
            one.c.setRealInputDerivatives([one.vr["u"]], [1], [slopes[k]])
            one.c.doStep(k * 0.1, 0.1)
            values.append(one.get("x"))
        ends.append(np.array(values))
    np.testing.assert_allclose(got, (ends[0] - ends[1]) / 2e-5, rtol=1e-6)


INITIAL = """
model Steady "Starts where its cubic balances a parameter and a friction that follows from others"
  parameter Real u = 2;
  parameter Real k = 0.5;
  parameter Real a = k^2 "calculated";
  Real x(start = 1);
  Real w(start = 3*k, fixed = true);
  output Real y = x*w + a;
initial equation
  der(x) = 0;
equation
  der(x) = u - a*x^3 + w;
  der(w) = -w;
end Steady;
"""


def test_initial_equations_and_calculated_parameters(instances, tmp_path):
    """x(0) = ((u + 3 k)/k^2)^(1/3), w = 3 k e^-t; the derivative of what follows by central differences."""
    (tmp_path / "Steady.mo").write_text(INITIAL)
    instance = instances(build(tmp_path / "Steady.mo", "Steady", tmp_path))
    one = instance()
    choose(one, ["u", "k"])
    one.start(1e-10)
    u, k = 2.0, 0.5
    x = np.cbrt((u + 3 * k) / k**2)
    by_u, by_k = 1 / (3 * x**2 * k**2), (3 / k**2 - 2 * (u + 3 * k) / k**3) / (3 * x**2)
    np.testing.assert_allclose(
        sensitivities(one, ["x", "w", "a", "der(x)", "y"], 2),
        [[by_u, by_k], [0, 3], [0, 2 * k], [0, 0], [by_u * 3 * k, by_k * 3 * k + 3 * x + 2 * k]],
        rtol=1e-9,
        atol=1e-12,
    )
    one.c.doStep(0.0, 1.0)
    got = sensitivities(one, ["x", "y"], 2)
    for j, (name, value) in enumerate((("u", u), ("k", k))):
        ends = []
        for sign in (1, -1):
            other = instance().start(1e-13, **{name: value + sign * 1e-5})
            other.c.doStep(0.0, 1.0)
            ends.append(other.get("x", "y"))
        np.testing.assert_allclose(got[:, j], (ends[0] - ends[1]) / 2e-5, rtol=1e-7)


HIDDEN = """
model Hidden
  parameter Real k = 2;
  parameter Real c[2] = {1, 3};
  Real x(start = 1, fixed = true);
  Real y(start = 0.5);
  Real between;
  Real half;
  Real power;
  output Real shown;
equation
  der(x) = -k*x + y;
  y^3 + y = c[1]*x + c[2];
  between = 3*x - 2*y + c[1];
  half = 0.5*time;
  power = k*x*y;
  shown = x^2 + c[2]*y;
end Hidden;
"""


@pytest.mark.parametrize("asked", [["between", "half", "shown"], ["between", "power", "shown", "half"]])
def test_variables_that_are_no_outputs(instances, tmp_path, asked):
    """Linear ones follow without code of their own; with others among them, all do one direction at a time."""
    (tmp_path / "Hidden.mo").write_text(HIDDEN)
    instance = instances(build(tmp_path / "Hidden.mo", "Hidden", tmp_path))
    given = {"k": 2.0, "c[1]": 1.0, "c[2]": 3.0}
    one = instance()
    choose(one, list(given))
    one.start(1e-9)
    one.c.doStep(0.0, 0.4)
    got = sensitivities(one, asked, len(given))
    for j, (name, value) in enumerate(given.items()):
        ends = []
        for sign in (1, -1):
            other = instance().start(1e-13, **{name: value + sign * 1e-5})
            other.c.doStep(0.0, 0.4)
            ends.append(other.get(*asked))
        np.testing.assert_allclose(got[:, j], (ends[0] - ends[1]) / 2e-5, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "output", "parameter", "start", "h"),
    [("train", "tau_sensor", "d_S", {"i_cmd": 0.5}, 1e-3), ("algebraic_loop", "out", "a", {}, 0.03)],
)
def test_sensitivities_do_not_change_the_run(fmu, name, output, parameter, start, h):
    plain = fmu(name).start(1e-6, **start).run([output], 40, h)
    one = fmu(name)
    choose(one, [parameter])
    one.start(1e-6, **start)
    for k in range(40):
        one.c.doStep(k * h, h)
        sensitivities(one, [output, "time"], 1)
        assert one.get(output) == plain[k + 1, 0]


def test_what_has_no_sensitivity_is_refused(fmu):
    one = fmu("pendulum")
    assert choose(one, ["energy"]) == 3
    assert "no parameter" in one.messages[-1]
    late = fmu("pendulum").start()
    assert choose(late, ["m"]) == 3
    assert "before a co-simulation starts" in late.messages[-1]


def test_parameters_that_move_together(fmu):
    # one direction of two parameters is the weighted sum of their own
    names, weights = ["J_R", "d_S", "tau_bf"], [[0.0, 2.0, -3.0], [1.0, 0.0, 0.0]]
    single, joint = fmu("train"), fmu("train")
    assert choose(single, names) == 0
    vr = (ctypes.c_uint * 3)(*[joint.vr[n] for n in names])
    flat = (ctypes.c_double * 6)(*np.ravel(weights))
    n = ctypes.c_size_t
    c = ctypes.c_void_p(joint.c.component)
    assert joint.c.dll.fmuidSetSensitivityDirections(c, vr, n(3), flat, n(2)) == 0
    for one in (single, joint):
        one.start(1e-7, i_cmd=0.5).run(["tau_sensor"], 20, 1e-3)
    each = sensitivities(single, ["tau_sensor", "b"], 3)
    both = sensitivities(joint, ["tau_sensor", "b"], 2)
    assert np.any(each[0] != 0.0)
    np.testing.assert_allclose(both, each @ np.transpose(weights), rtol=1e-6, atol=1e-12)


def test_sensitivities_go_back_with_the_state(fmu):
    outputs, parameters, drive, h, steps = CASES["pendulum"]
    one = fmu("pendulum")
    choose(one, parameters)
    one.start(1e-7)

    def go_on(first):
        courses = []
        for k in range(first, steps):
            one.set(**{drive: 0.5 * (-1) ** (k // 6)})
            one.c.doStep(k * h, h)
            courses.append(sensitivities(one, outputs, len(parameters)))
        return courses

    for k in range(10):
        one.c.doStep(k * h, h)
    state = one.c.getFMUstate()
    there = go_on(10)
    one.c.setFMUstate(state)
    np.testing.assert_array_equal(go_on(10), there)
    with pytest.raises(fmpy.fmi1.FMICallException):
        one.c.serializeFMUstate(state)
    assert "cannot be serialised" in one.messages[-1]
    one.c.reset()
    with pytest.raises(fmpy.fmi1.FMICallException):
        one.c.setFMUstate(state)
    assert "not these sensitivities" in one.messages[-1]
    one.c.freeFMUstate(state)


def test_inputs_that_move_along_a_direction(fmu):
    # tau = a sin(t), held or along lines: the derivative by a is that of two runs
    shown, h = ("phi", "energy", "der(w)", "tau"), 0.05

    def run(a, held, *, differentiated=False):
        one = fmu("pendulum")
        call, c, n = one.c.dll, ctypes.c_void_p(one.c.component), ctypes.c_size_t
        if differentiated:
            assert call.fmuidSetSensitivityDirections(c, None, n(0), None, n(1)) == 0
        one.start(1e-9)
        courses = []
        for k in range(30):
            now, then = np.sin(h * k), np.sin(h * (k + 1))
            slope = 0.0 if held else (then - now) / h
            one.set(tau=a * now)
            one.c.setRealInputDerivatives([one.vr["tau"]], [1], [a * slope])
            if differentiated:
                vr = (ctypes.c_uint * 1)(one.vr["tau"])
                seed, rate = ((ctypes.c_double * 1)(v) for v in (now, slope))
                assert call.fmuidSetInputDirections(c, vr, n(1), seed, rate) == 0
            one.c.doStep(h * k, h)
            courses.append(
                sensitivities(one, shown, 1)[:, 0] if differentiated else [one.get(name) for name in shown]
            )
        return np.array(courses)

    for held in (True, False):
        differences = (run(1.0 + 1e-4, held) - run(1.0 - 1e-4, held)) / 2e-4
        np.testing.assert_allclose(run(1.0, held, differentiated=True), differences, rtol=1e-5, atol=1e-6)


def test_only_real_inputs_move_along_directions(fmu):
    one = fmu("pendulum")
    call, c, one_number = one.c.dll, ctypes.c_void_p(one.c.component), (ctypes.c_double * 1)(1.0)
    names = [(ctypes.c_uint * 1)(one.vr[name]) for name in ("tau", "m")]
    assert call.fmuidSetInputDirections(c, names[0], ctypes.c_size_t(1), one_number, one_number) == 3
    assert "no sensitivities were chosen" in one.messages[-1]
    choose(one, ["m"])
    assert call.fmuidSetInputDirections(c, names[1], ctypes.c_size_t(1), one_number, one_number) == 3
    assert "no real input" in one.messages[-1]
    infinite = (ctypes.c_double * 1)(np.inf)
    assert call.fmuidSetInputDirections(c, names[0], ctypes.c_size_t(1), infinite, one_number) == 3
    assert "not finite" in one.messages[-1]
