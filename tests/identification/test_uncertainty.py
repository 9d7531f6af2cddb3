import numpy as np
import pytest

from fmuid import ParameterSpec, Problem, Task, identify, measured_case, profile_interval, propagate

TIME = np.linspace(0.0, 10.0, 201)


def line(time, inputs, p):
    return {"y": p["a"] + p["b"] * time}


def fitted(analytic, function, names, y, sigma=0.1, specs=None, with_uncertainty=True):
    case = measured_case("run", analytic(function, names), Task(TIME, {}, ("y",)), {"y": y}, sigma={"y": sigma})
    problem = Problem([case], specs or [ParameterSpec(n, 1.0) for n in names])
    return problem, identify(problem).stages[0]


def test_standard_errors_of_a_line_are_the_textbook_ones(analytic):
    noise = 0.1 * np.random.default_rng(0).standard_normal(TIME.size)
    _, stage = fitted(analytic, line, ["a", "b"], 2 + 0.5 * TIME + noise)
    design = np.column_stack([np.ones_like(TIME), TIME])
    textbook = 0.1 * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    assert stage.uncertainty.standard_errors == pytest.approx(textbook, rel=0.2)
    # a and b of a line over 0..10: correlation -sqrt(3)/2.
    assert stage.uncertainty.correlation[0][1] == pytest.approx(-np.sqrt(0.75), abs=0.03)
    whiteness = stage.uncertainty.whiteness[0]
    assert whiteness.variance == pytest.approx(1.0, abs=0.2)
    assert whiteness.p_value > 0.01


def coverage(draws, colour):
    """Share of 95 % intervals of a line's slope that hold the truth, the sandwich's and the naive one's."""
    from conftest import Analytic  # the class itself: fixtures are made once a test

    hits = np.zeros(2)
    generator = np.random.default_rng(1)
    for _ in range(draws):
        white = 0.1 * generator.standard_normal(TIME.size + 50)
        noise = np.zeros_like(white)
        for k in range(1, white.size):
            noise[k] = colour * noise[k - 1] + white[k]
        _, stage = fitted(Analytic, line, ["a", "b"], 2 + 0.5 * TIME + noise[50:])
        low, high = stage["b"].interval
        hits += low < 0.5 < high, abs(stage["b"].value - 0.5) < 1.96 * stage.uncertainty.naive_errors[1]
    return hits / draws


@pytest.mark.slow
def test_intervals_cover_under_white_and_coloured_noise(monkeypatch):
    monkeypatch.syspath_prepend(__file__.rpartition("/")[0])
    assert 0.90 <= coverage(200, 0.0)[0] <= 0.98
    aware, naive = coverage(200, 0.9)
    assert naive < 0.6  # an interval that takes coloured residuals for white ones is far too narrow
    assert aware > 0.85


@pytest.mark.slow
def test_intervals_of_a_nonlinear_model_cover(msd, msd_truth):
    hits = np.zeros(3)
    for seed in range(200):
        stage = identify(msd(seed=seed)).stages[0]
        for i, (name, truth) in enumerate(msd_truth.items()):
            low, high = stage[name].interval
            hits[i] += low < truth < high
    assert np.all(hits >= 0.90 * 200)
    assert np.all(hits <= 0.98 * 200)


def test_two_resistors_and_a_capacitor_are_not_separately_identifiable(analytic):
    # A divider R1, R2 loaded by C: gain R2/(R1+R2), time constant C R1 R2/(R1+R2).
    def divider(time, inputs, p):
        gain = p["R2"] / (p["R1"] + p["R2"])
        return {"y": gain * (1 - np.exp(-time / (gain * p["R1"] * p["C"])))}

    truth = {"R1": 1e3, "R2": 2e3, "C": 1e-3}
    noise = 1e-3 * np.random.default_rng(0).standard_normal(TIME.size)
    specs = [
        ParameterSpec("R1", 800.0, 10, 1e5),
        ParameterSpec("R2", 2500.0, 10, 1e5, scale="log"),
        ParameterSpec("C", 2e-3, 1e-5, 1, scale="log"),
    ]
    y = divider(TIME, {}, truth)["y"] + noise
    _, stage = fitted(analytic, divider, truth, y, sigma=1e-3, specs=specs)
    found = stage.uncertainty.identifiability
    assert found.rank == 2
    assert found.undetermined == ("R1", "R2", "C")
    assert found.combinations == ("R1*C", "R2*C")
    assert str(found) in stage.warnings
    assert stage["R1"].interval is None
    assert stage["R1"].value * stage["C"].value == pytest.approx(1.0, rel=0.01)


def test_a_rotor_spun_down_by_friction_shows_only_the_ratio(analytic):
    spin = lambda time, inputs, p: {"y": 100 * np.exp(-p["c"] / p["J"] * time)}  # noqa: E731
    y = spin(TIME, {}, {"c": 0.02, "J": 0.1})["y"]
    specs = [ParameterSpec("c", 0.05, 1e-3, 1), ParameterSpec("J", 0.1, 1e-2, 1)]
    _, stage = fitted(analytic, spin, ["c", "J"], y, specs=specs)
    assert str(stage.uncertainty.identifiability) == "c, J are not separately identifiable; only c/J"


def test_a_sum_is_named_as_a_sum_and_a_dead_parameter_as_dead(analytic):
    both = lambda time, inputs, p: {"y": (p["a"] + p["b"]) * time + p["c"]}  # noqa: E731
    _, stage = fitted(analytic, both, ["a", "b", "c", "d"], 3 * TIME + 1)
    found = stage.uncertainty.identifiability
    assert found.undetermined == ("a", "b", "d")
    assert found.combinations == ("a + b",)
    assert stage["c"].standard_error == pytest.approx(0.0, abs=1e-6)


def test_an_offset_near_zero_is_determined(analytic):
    noise = 0.1 * np.random.default_rng(2).standard_normal(TIME.size)
    _, stage = fitted(analytic, line, ["a", "b"], 0.5 * TIME + noise)
    assert stage.uncertainty.identifiability.complete
    assert stage["a"].interval[0] < 0.0 < stage["a"].interval[1]


def test_a_parameter_at_its_bound_gets_no_interval(analytic):
    specs = [ParameterSpec("a", 0.5, 0.0, 1.0), ParameterSpec("b", 1.0)]
    _, stage = fitted(analytic, line, ["a", "b"], 2 + 0.5 * TIME, specs=specs)
    assert stage["a"].at_bound == "upper"
    assert stage["a"].interval is None
    assert "a is at its upper bound" in stage.warnings


def test_profile_interval_equals_the_linear_one_of_a_linear_model(analytic):
    noise = 0.1 * np.random.default_rng(0).standard_normal(TIME.size)
    problem, stage = fitted(analytic, line, ["a", "b"], 2 + 0.5 * TIME + noise)
    assert profile_interval(problem, stage.uncertainty, "b") == pytest.approx(stage["b"].interval, rel=1e-3)


def test_profile_interval_is_open_where_the_data_end(analytic):
    # Only 1/tau matters once tau is long: no upper end.
    decay = lambda time, inputs, p: {"y": np.exp(-time / p["tau"])}  # noqa: E731
    noise = 0.05 * np.random.default_rng(3).standard_normal(TIME.size)
    specs = [ParameterSpec("tau", 50.0, 1.0)]
    problem, stage = fitted(analytic, decay, ["tau"], np.exp(-TIME / 400) + noise, sigma=0.05, specs=specs)
    low, high = profile_interval(problem, stage.uncertainty, "tau")
    assert 50.0 < low < 400.0
    assert high > 1000.0 or high == np.inf


def test_propagated_band_covers_the_prediction_and_widens_outwards(analytic):
    noise = 0.1 * np.random.default_rng(0).standard_normal(TIME.size)
    problem, stage = fitted(analytic, line, ["a", "b"], 2 + 0.5 * TIME + noise)
    band = propagate(problem, stage.uncertainty, draws=400)
    width = (band.upper[0] - band.lower[0])[0]
    # Standard error of a line's value: sigma sqrt(1/N + (t - mean)^2 / S).
    middle, end = 0.1 * np.sqrt(1 / TIME.size), 0.1 * np.sqrt(4 / TIME.size)
    assert width[100] == pytest.approx(2 * 1.96 * middle, rel=0.25)
    assert width[-1] == pytest.approx(2 * 1.96 * end, rel=0.25)
