"""Events: models with state, time and sample events, simulated as FMUs, against exact or event-driven solutions."""

from __future__ import annotations

import math
from pathlib import Path

import fmpy
import numpy as np
import pytest

from fmu_build import build, compile_modelica
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.simulator import Task
from tests.fmu_build.simulate import Instance, find, states, values

HYBRID = Path(__file__).parent / "models" / "Hybrid.mo"


@pytest.fixture(scope="module")
def simulate(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hybrid")

    def run(name: str, outputs: list[str], stop: float, step: float, inputs=None, kind="CoSimulation"):
        return fmpy.simulate_fmu(
            str(build(HYBRID, f"Hybrid.{name}", folder)),
            stop_time=stop,
            output_interval=step,
            fmi_type=kind,
            relative_tolerance=1e-8,
            output=outputs,
            input=inputs,
        )

    return run


def test_bouncing_ball(simulate):
    result = simulate("BouncingBall", ["h", "v", "bounces", "flying"], 1.4, 0.1)
    first = math.sqrt(2 / 9.81)
    second = first + 2 * 0.8 * first
    speed = 9.81 * first
    exact = []
    for t in result["time"]:
        if t < first:
            exact.append((1 - 9.81 * t**2 / 2, 0))
        elif t < second:
            exact.append((0.8 * speed * (t - first) - 9.81 * (t - first) ** 2 / 2, 1))
        else:
            exact.append((0.64 * speed * (t - second) - 9.81 * (t - second) ** 2 / 2, 2))
    np.testing.assert_allclose(result["h"], [h for h, _ in exact], atol=1e-6)
    np.testing.assert_array_equal(result["bounces"], [n for _, n in exact])
    assert all(result["flying"])


def test_sampled_controller(simulate):
    result = simulate("Sampled", ["x", "u", "xs", "k", "late"], 1.0, 0.1)
    x, u, xs = 0.0, 0.0, 0.0
    x_at = {0.0: x}
    for k in range(10):
        x = u + (x - u) * math.exp(-0.05)
        xs, u = x, u + 0.5 * (1 - x)
        x = u + (x - u) * math.exp(-0.05)
        x_at[round(0.1 * (k + 1), 1)] = x
    np.testing.assert_allclose(result["x"], list(x_at.values()), atol=1e-7)
    assert result["xs"][-1] == pytest.approx(xs, abs=1e-7)
    assert result["u"][-1] == pytest.approx(u, abs=1e-7)
    assert list(result["k"]) == list(range(11))
    assert list(result["late"]) == [t > 0.72 for t in result["time"]]


def test_a_held_control_alone_on_a_side(simulate):
    result = simulate("DeadBeat", ["x"], 1.05, 0.05)
    np.testing.assert_allclose(result["x"], np.maximum(0.0, 1.0 - result["time"] / 0.1), atol=1e-7)


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_relay_with_hysteresis(simulate, kind):
    result = simulate("Relay", ["x", "on", "switches", "edges"], 5.0, 0.5, kind=kind)
    up = -math.log(0.2)
    period = 2 * math.log(4.0)
    at = result["time"] == 4.0
    assert result["switches"][at][-1] == 2
    assert result["edges"][at][-1] == 1
    assert result["x"][at][-1] == pytest.approx(1 - 0.8 * math.exp(-(4.0 - up - math.log(4.0))), abs=1e-6)
    assert up + period < 5.0
    assert (result["switches"][-1], result["on"][-1]) == (3, False)


def test_floor_mod_and_if_make_events(simulate):
    result = simulate("Steps", ["y", "saw", "s", "x"], 0.95, 0.05)
    t = result["time"][1:]
    off = t - 1e-9  # at the event itself the left or the right value may be recorded
    np.testing.assert_allclose(result["x"][1:], np.maximum(0, t - 1 / 3) + np.maximum(0, t - 2 / 3), atol=1e-7)
    inside = np.min(np.abs(t[:, None] - [1 / 3, 2 / 3, 0.5, 0.25]), axis=1) > 1e-6
    np.testing.assert_array_equal(result["y"][1:][inside], np.floor(3 * off)[inside])
    np.testing.assert_allclose(result["saw"][1:][inside], np.mod(off, 0.5)[inside], atol=1e-7)
    np.testing.assert_array_equal(result["s"][1:][inside], (off > 0.25)[inside])


def test_stick_slip_against_set_valued_coulomb_friction(simulate):
    """The mode logic of BearingFriction against a time stepping with the set-valued law."""
    time = np.arange(3001) * 1e-3
    inputs = np.zeros(time.size, dtype=[("time", float), ("F", float)])
    inputs["time"], inputs["F"] = time, 2 * np.sin(2 * np.pi * time)
    result = simulate("Coulomb", ["v", "f", "sa", "mode", "lossEnergy", "a"], 3.0, 1e-3, inputs)

    h, v, reference = 1e-5, 0.0, [0.0]
    for force in inputs["F"][:-1]:
        for _ in range(100):
            if v == 0.0:
                friction = force if abs(force) <= 1.5 else math.copysign(1.0, force)
            else:
                friction = math.copysign(1.0, v)
            new = v + h * (force - friction)
            v = 0.0 if new * v < 0.0 else new
        reference.append(v)
    np.testing.assert_allclose(result["v"], reference, atol=1e-9)
    assert set(result["mode"]) == {-1, 0, 1}
    assert np.all(np.diff(result["lossEnergy"]) >= -1e-12)
    stuck = (result["mode"] == 0) & (result["a"] == 0.0)
    assert np.max(np.abs(result["sa"][stuck])) <= 1.5 + 0.02


def test_initial_algorithm_and_initial_values_of_discrete_variables(simulate):
    result = simulate("Pulse", ["y", "count", "z", "x"], 1.0, 0.04)
    t = result["time"]
    phase = (t + 1.0) / 0.3
    inside = np.abs(2 * phase - np.round(2 * phase)) > 1e-6
    np.testing.assert_array_equal(result["count"][inside], np.floor(phase)[inside])
    np.testing.assert_array_equal(result["y"][inside], (phase % 1.0 < 0.5)[inside])
    np.testing.assert_allclose(result["z"], np.where(t < 0.5, 4.0, 0.0), atol=1e-7)
    assert result["x"][-1] == pytest.approx(0.0, abs=1e-7)


def test_initial_in_when_clauses(simulate):
    """A condition that is true from the start does not fire, unless initial() lets it."""
    result = simulate("AtStart", ["a", "b", "c"], 1.0, 0.25)
    assert [tuple(result[n]) for n in "abc"] == [(1, 1, 1, 2, 2), (1,) * 5, (0,) * 5]


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_sample_fires_at_the_start_itself(simulate, kind):
    result = simulate("SampledFromStart", ["n", "k"], 1.0, 0.1, kind=kind)
    at = {round(t, 2): (n, k) for t, n, k in zip(result["time"], result["n"], result["k"], strict=True)}
    assert [at[t] for t in (0.0, 0.2, 0.4, 0.7, 0.9)] == [(1, 1), (1, 1), (2, 1), (3, 2), (4, 3)]


def test_terminate(simulate):
    result = simulate("Ends", ["x"], 1.0, 0.05)
    assert result["time"][-1] == pytest.approx(0.5, abs=1e-6)


def test_boolean_input(simulate):
    samples = [(0, 0), (0.2, 0), (0.2, 1), (0.5, 1), (0.5, 0), (0.7, 0), (0.7, 1), (1, 1)]
    inputs = np.array(samples, dtype=[("time", float), ("b", bool)])
    result = simulate("BooleanInput", ["n", "x"], 1.0, 0.1, inputs)
    assert result["n"][-1] == 2
    assert result["x"][-1] == pytest.approx(0.6)


def test_relations_inside_no_event_make_no_indicators():
    model = compile_modelica(HYBRID, "Hybrid.Quiet")
    assert (model.n_m, model.n_z, model.has_events) == (0, 0, False)
    assert Instance.of(model).get("y", 2.0, np.zeros(0)) == 1.0


def test_an_impact_settles_and_fires_once():
    model = compile_modelica(HYBRID, "Hybrid.BouncingBall")
    instance = Instance.of(model)
    z, _, x = instance.settle(instance.env(0.3, np.array([-1e-9, -4.0])))
    assert x[1] == pytest.approx(3.2)
    assert z[find(model, "bounces").location.index] == 1


@pytest.mark.parametrize("side", [-1e-12, 0.0, 1e-12])
def test_a_gear_that_comes_to_rest_under_load_finds_its_stuck_mode(side):
    """From backward sliding the plain fixed point would alternate between starting forward and backward."""
    model = compile_modelica(HYBRID, "Hybrid.Lossy")
    instance = Instance.of(model)
    x = np.array([{"phi": 0.9, "w": side, "lossEnergy": 1.3}[name] for name in states(model)])
    env = instance.env(1.9345, x, [-0.4029, 2.357])
    z = np.zeros(model.n_z)
    z[find(model, "mode").location.index] = -1
    env[5] = env[6] = z
    env[7] = (values(model.functions["indicators"](*env)) > 0).astype(float)

    z, m, _ = instance.settle(env)

    if side >= 0.0:  # at -1e-12 it still slides
        assert z[find(model, "mode").location.index] == 0
        assert z[find(model, "locked").location.index] == 1
        env[5], env[6], env[7] = z, z, m
        assert values(model.functions["derivatives"](*env))[states(model).index("w")] == pytest.approx(
            0, abs=1e-12
        )


def set_valued_gear(time, u, load):
    """Lossy with a set-valued loss torque, by time stepping: angle, speed and loss energy on side a."""
    j_a, j_b, ratio, eta1, eta2, tau_bf = 0.01, 1.0, 5.0, 0.8, 0.7, 0.1

    def sliding(side, u_k, load_k):
        for share, positive in ((1 - eta1, side > 0), (1 - 1 / eta2, side < 0)):
            # a = (u - tau)/J_a and J_b a/ratio = ratio (tau - loss) + load with loss = share tau + side tau_bf
            tau = (j_b * u_k / (ratio * j_a) + ratio * side * tau_bf - load_k) / (
                j_b / (ratio * j_a) + ratio * (1 - share)
            )
            if (tau >= 0) == positive:
                return (u_k - tau) / j_a, share * tau + side * tau_bf
        raise AssertionError("no branch of Table 1 is consistent")

    w, energy, rows = 0.0, 0.0, []
    dt = time[1] - time[0]
    for u_k, load_k in zip(u, load, strict=True):
        rows.append((w, energy))
        if w == 0.0:
            held = u_k + load_k / ratio
            high = (1 - eta1) * u_k + tau_bf if u_k >= 0 else (1 - 1 / eta2) * u_k + tau_bf
            low = (1 - 1 / eta2) * u_k - tau_bf if u_k >= 0 else (1 - eta1) * u_k - tau_bf
            if low <= held <= high:
                continue
            side = 1.0 if held > high else -1.0
        else:
            side = np.sign(w)
        a, loss = sliding(side, u_k, load_k)
        new = w + dt * a
        if w * new < 0.0:
            new = 0.0
        energy += loss * 0.5 * (w + new) * dt
        w = new
    return np.array(rows).T


def test_a_lossy_gear_with_modes_runs_as_an_fmu(tmp_path):
    fmu = Fmu(build(HYBRID, "Hybrid.Lossy", tmp_path))
    time = np.arange(0.0, 6.0, 5e-4)
    inputs = {"u": 0.6 * np.sin(2.0 * time), "load": 2.4 * np.sin(1.3 * time + 1.0)}
    w, energy = fmu.simulate(Task(time, inputs, ("w_a", "lossEnergy")), {})
    expected_w, expected_energy = set_valued_gear(time, inputs["u"], inputs["load"])
    assert np.ptp(expected_w) > 1.0
    assert np.count_nonzero(expected_w == 0.0) > 100  # it also sticks
    assert np.max(np.abs(w - expected_w)) < 5e-3 * np.ptp(expected_w)
    assert np.max(np.abs(energy - expected_energy)) < 5e-3 * expected_energy[-1]
    assert np.all(np.diff(energy) > -1e-9)


@pytest.mark.slow
def test_a_bridge_of_ideal_diodes_rectifies(tmp_path):
    """Where its diodes stop to conduct, all modes meet, and conductances differ by ten powers of ten."""
    fmu = build(Path(__file__).parent / "models" / "Rectifier.mo", "Rectifier.PowerSupply", tmp_path)
    at = np.linspace(0.0, 0.1, 1001)
    v, _ = Fmu(fmu).simulate(Task(at, {}, ("v", "i"), tolerance=1e-8), {})
    assert np.abs(v[at < 0.01]).max() < 1e-9
    # Between the peaks of 12 V the capacitor alone feeds the load, with a time constant of 1 s.
    half, w = 1 / 120, 2 * math.pi * 60
    leaves = half / 2 + math.atan(1 / w) / w  # where 12 sin(w t) falls as fast as the capacitor does
    expected = []
    for t in at[at > 0.0125]:
        since = (t - leaves) % half
        falling = 12 * math.sin(w * leaves) * math.exp(-since)
        expected.append(max(falling, 12 * abs(math.sin(w * t))))
    np.testing.assert_allclose(v[at > 0.0125], expected, atol=2e-3)


def test_a_boolean_variable_may_be_a_sample(tmp_path):
    file = tmp_path / "M.mo"
    file.write_text("model M Boolean b = sample(0.1, 0.2); discrete Real y(start = 0, fixed = true); "
                    "equation when b then y = pre(y) + 1; end when; end M;")  # fmt: skip
    result = fmpy.simulate_fmu(str(build(file, "M", tmp_path)), stop_time=1, output_interval=0.05, output=["y"])
    np.testing.assert_array_equal(result["y"][[0, 1, 3, 5, 7, -1]], [0, 0, 1, 1, 2, 5])


def run_model(tmp_path: Path, body: str, outputs: list[str], stop: float = 1.0) -> np.ndarray:
    """Last values of a model's variables."""
    (tmp_path / "M.mo").write_text(f"model M {body} end M;")
    fmu = build(tmp_path / "M.mo", "M", tmp_path)
    result = fmpy.simulate_fmu(str(fmu), stop_time=stop, output_interval=stop / 10, output=outputs)
    return np.array(result[outputs].tolist())


def test_initial_equations_between_pre_values(tmp_path):
    """As the steps of a state graph have them: what is given for `active` goes on to what it is defined by."""
    body = """
      model Step output Boolean active; Boolean local; Boolean new; Boolean old; input Boolean leave;
      initial equation pre(new) = pre(local); pre(old) = pre(local);
      equation active = local; local = pre(new); new = local and not leave; when leave then old = local; end when; end Step;
      model First extends Step; initial equation active = true; end First;
      First first(leave = time > 0.55); Step other(leave = false); Real a = if first.active then 1 else 0;
      Real b = if other.active then 1 else 0;"""
    a, b = run_model(tmp_path, body, ["a", "b"]).T
    assert a.tolist() == [1.0] * 6 + [0.0] * 5
    assert not b.any()


def test_start_values_of_variables_that_are_no_states(tmp_path):
    """A tank: the states are mass and energy, and at zero mass its equations are not defined."""
    body = """
      Real U; Real m; Real level(start = 2, fixed = true); Real h(start = 3, fixed = true);
      equation m = 4*level; h = U/m; der(m) = -1; der(U) = -h;"""
    m, energy = run_model(tmp_path, body, ["m", "U"])[-1]
    assert m == pytest.approx(7.0)
    assert energy == pytest.approx(21.0)


@pytest.mark.parametrize("n", [0, 2])
def test_semi_linear_of_arrays(tmp_path, n):
    body = f"""
      parameter Integer n = {n}; Real a[n] = semiLinear(0.5 - time, fill(2.0, n), fill(3.0, n)); Real y = sum(a);"""
    y = run_model(tmp_path, body, ["y"])
    assert y[0, 0] == pytest.approx(n)
    assert y[-1, 0] == pytest.approx(-1.5 * n)
