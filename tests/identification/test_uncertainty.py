import numpy as np
import pytest

from fmuid import (
    AnalysisSpec,
    CriterionSpec,
    ParameterSpec,
    Problem,
    Task,
    identify,
    measured_case,
    profile_of,
    propagate,
)
from fmuid.identification.problem.combination import Constraint
from fmuid.identification.uncertainty.propagation import worst_points

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


SPARSE = np.array([0.0, 10.0])


def sparse(analytic, y, **options):
    task = Task(SPARSE, {}, ("y",))
    case = measured_case("run", analytic(line, ["a", "b"]), task, {"y": np.array(y)}, **options)
    return identify(Problem([case], [ParameterSpec("a", 1.0), ParameterSpec("b", 1.0)])).stages[0]


def test_as_many_samples_as_parameters_leave_the_sigma_that_was_given(analytic):
    stage = sparse(analytic, [2.0, 7.0], sigma={"y": 0.1})
    assert stage.uncertainty.standard_errors == pytest.approx([0.1, 0.01 * np.sqrt(2)], rel=1e-6)
    low, high = stage["a"].interval
    assert (low, high) == pytest.approx((2.0 - 1.95996 * 0.1, 2.0 + 1.95996 * 0.1), rel=1e-5)
    assert stage.uncertainty.degrees_of_freedom is None


def test_as_many_samples_as_parameters_and_no_sigma_give_no_interval_and_say_why(analytic):
    stage = sparse(analytic, [2.0, 7.0])
    assert (stage["a"].standard_error, stage["a"].interval) == (None, None)
    assert stage.warnings == (
        "no standard errors: 2 residuals for 2 parameters say nothing about the noise; give sigma, or "
        "record more data",
    )
    assert "2 residuals for 2 parameters" in str(stage)


def test_as_many_samples_as_parameters_have_the_sigma_of_their_repeats(analytic):
    stage = sparse(analytic, [[1.9, 7.0], [2.1, 7.0], [2.0, 7.3]])
    sigma = np.sqrt((0.02 + 0.06) / 4)
    assert stage.uncertainty.standard_errors[0] == pytest.approx(sigma / np.sqrt(3), rel=1e-6)
    assert stage.uncertainty.degrees_of_freedom == 4


def test_a_sigma_that_was_given_is_taken_unless_the_residuals_contradict_it(analytic):
    noise = 0.1 * np.random.default_rng(0).standard_normal(TIME.size)
    design = np.column_stack([np.ones_like(TIME), TIME])
    unit = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    for sigma, expected, exactly in ((0.1, 0.1, 1e-6), (0.5, 0.5, 1e-6), (0.02, 0.1, 0.2)):
        _, stage = fitted(analytic, line, ["a", "b"], 2 + 0.5 * TIME + noise, sigma)
        assert stage.uncertainty.standard_errors == pytest.approx(expected * unit, rel=exactly)
        assert (stage.uncertainty.degrees_of_freedom is None) == (exactly == 1e-6)
    slow = 2 + 0.5 * TIME + 0.1 * np.sin(TIME)
    _, stage = fitted(analytic, line, ["a", "b"], slow, 0.1)
    assert np.all(np.array(stage.uncertainty.standard_errors) > 1.5 * 0.1 * unit)


@pytest.mark.parametrize("limit", ["max", "min", "equal", "inactive"])
@pytest.mark.parametrize(("expression", "across"), [("a - 4*b", (1.0, -4.0)), ("b", (0.0, 1.0))])
def test_at_an_active_constraint_standard_errors_are_those_along_it(analytic, expression, across, limit):
    y = 2 + 0.5 * TIME + 0.1 * np.random.default_rng(0).standard_normal(TIME.size)
    design = np.column_stack([np.ones_like(TIME), TIME])
    covariance = 0.01 * np.linalg.inv(design.T @ design)
    # One standard error away from the value without the constraint.
    free = float(across @ np.linalg.lstsq(design, y)[0])
    beside = (1.0 if limit in ("min", "inactive") else -1.0) * np.sqrt(across @ covariance @ across)
    table = {"expression": expression, "max" if limit == "inactive" else limit: free + beside}
    case = measured_case("run", analytic(line, ["a", "b"]), Task(TIME, {}, ("y",)), {"y": y}, sigma={"y": 0.1})
    specs = [ParameterSpec("a", 1.0), ParameterSpec("b", 1.0)]
    problem = Problem([case], specs, constraints=[Constraint.from_mapping(table)])
    stage = identify(problem, options={"tolerance": 1e-9}).stages[0]
    errors = stage.uncertainty.standard_errors
    if limit == "inactive":
        assert errors == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-4)
        assert stage.uncertainty.notes == ()
        return
    assert stage.warnings[0] == f"standard errors apply along the active constraint on '{expression}'"
    along = np.array([-across[1], across[0]])
    expected = 0.1 * np.abs(along) / np.linalg.norm(design @ along)
    if expression == "b":  # which leaves it no freedom at all
        assert (errors[1], stage["b"].interval) == (None, None)
        assert stage.warnings[1] == "no standard error, because the active constraints alone determine: b"
        assert errors[0] == pytest.approx(0.1 / np.sqrt(TIME.size), rel=1e-4)
    else:
        assert errors == pytest.approx(expected, rel=1e-4)


def test_an_active_constraint_leaves_a_degree_of_freedom_to_the_noise(analytic):
    y = 2 + 0.5 * TIME + 0.1 * np.random.default_rng(0).standard_normal(TIME.size)
    case = measured_case("run", analytic(line, ["a", "b"]), Task(TIME, {}, ("y",)), {"y": y})
    specs = [ParameterSpec("a", 1.0), ParameterSpec("b", 1.0)]
    held = [Constraint.from_mapping({"expression": "a - 4*b", "equal": 0.1})]
    for constraints, parameters in (([], 2), (held, 1)):
        uncertainty = identify(Problem([case], specs, constraints=constraints)).stages[0].uncertainty
        effective = sum(w.effective for w in uncertainty.whiteness)
        assert uncertainty.degrees_of_freedom == pytest.approx(effective - parameters)


def test_the_standard_error_of_few_samples_is_that_of_their_mean(analytic):
    """With n - 1 in the denominator, exactly, where no sigma was given."""
    y = 2 + 0.1 * np.random.default_rng(0).standard_normal(5)
    level = analytic(lambda time, inputs, p: {"y": p["a"] + 0 * time}, ["a"])
    case = measured_case("run", level, Task(np.arange(5.0), {}, ("y",)), {"y": y})
    stage = identify(Problem([case], [ParameterSpec("a", 1.0)])).stages[0]
    assert stage["a"].standard_error == pytest.approx(np.std(y, ddof=1) / np.sqrt(5), rel=1e-6)


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


def of_coloured_noise(analytic, y, whiten):
    rise = lambda time, inputs, p: {"y": p["a"] * (1 - np.exp(-time / p["tau"]))}  # noqa: E731
    task, criteria = Task(np.arange(400) * 0.01, {}, ("y",)), [CriterionSpec("y", options={"whiten": whiten})]
    y = y + rise(task.time, {}, {"a": 50.0, "tau": 0.6})["y"]
    case = measured_case("run", analytic(rise, ["a", "tau"]), task, {"y": y}, criteria=criteria)
    specs = [ParameterSpec("a", 50.0, 1.0, 500.0), ParameterSpec("tau", 0.6, 0.01, 10.0)]
    return identify(Problem([case], specs)).stages[0]


def test_whitening_by_the_repeats_takes_the_colour_off_the_residuals(analytic, coloured):
    noise = coloured(np.random.default_rng(0), 10, shift=1.0)
    plain, white = (of_coloured_noise(analytic, noise, w) for w in ("sigma", "repeats"))
    assert plain.uncertainty.whiteness[0].p_value < 1e-6
    assert white.uncertainty.whiteness[0].p_value > 0.01
    assert white.uncertainty.whiteness[0].variance == pytest.approx(1.0, abs=0.2)
    # The textbook's errors hold for what is white, and are far too small for what is not.
    for name, textbook in zip(("a", "tau"), white.uncertainty.naive_errors, strict=True):
        assert white[name].standard_error == pytest.approx(textbook, rel=0.5)
    assert plain["tau"].standard_error > 3 * plain.uncertainty.naive_errors[1]


@pytest.mark.slow
def test_intervals_cover_where_residuals_are_whitened(analytic, coloured):
    generator, hits = np.random.default_rng(1), np.zeros(2)
    for _ in range(200):
        stage = of_coloured_noise(analytic, coloured(generator, 10, shift=0.5), "repeats")
        for i, (name, truth) in enumerate((("a", 50.0), ("tau", 0.6))):
            hits[i] += stage[name].interval[0] < truth < stage[name].interval[1]
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
    identifiability = stage.uncertainty.identifiability
    assert identifiability.rank == 2
    assert identifiability.undetermined == ("R1", "R2", "C")
    assert identifiability.combinations == ("R1*C", "R2*C")
    assert str(identifiability) in stage.warnings
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
    identifiability = stage.uncertainty.identifiability
    assert identifiability.undetermined == ("a", "b", "d")
    assert identifiability.combinations == ("a + b",)
    design = np.column_stack([TIME, np.ones_like(TIME)])
    expected = 0.1 * np.sqrt(np.linalg.inv(design.T @ design)[1, 1])  # by the sigma that is given
    assert stage["c"].standard_error == pytest.approx(expected, rel=1e-4)


def test_an_offset_near_zero_is_determined(analytic):
    noise = 0.1 * np.random.default_rng(2).standard_normal(TIME.size)
    _, stage = fitted(analytic, line, ["a", "b"], 0.5 * TIME + noise)
    assert stage.uncertainty.identifiability.complete
    assert stage["a"].interval[0] < 0.0 < stage["a"].interval[1]


@pytest.mark.parametrize("scatter", [1e-4, 1e-3])  # of an output of 130, as an integrator's tolerance leaves it
@pytest.mark.parametrize("farthest", [0.5, 10.0])
def test_a_small_offset_is_determined_by_a_simulator_that_scatters(analytic, scatter, farthest):
    def settling(time, inputs, p):
        samples = np.arange(time.size)
        noise = scatter * np.sin(1e7 * (p["gain"] * (samples + 1) + p["T"] * samples + p["offset"]) + samples**2)
        return {"y": 100 * p["gain"] * (1 - np.exp(-time / p["T"])) + p["offset"] + noise}

    truth = {"gain": 1.3, "T": 1.7, "offset": 0.3}
    noise = 0.1 * np.random.default_rng(0).standard_normal(TIME.size)
    specs = [ParameterSpec("gain", 1.0, 0.1, 10), ParameterSpec("T", 1.0, 0.1, 10)]
    specs += [ParameterSpec("offset", 0.0, -farthest, farthest)]
    _, stage = fitted(analytic, settling, truth, settling(TIME, {}, truth)["y"] + noise, specs=specs)
    assert stage.uncertainty.identifiability.complete
    assert stage["offset"].standard_error == pytest.approx(0.0336, rel=0.1)  # of a simulator that does not scatter
    assert stage["offset"].interval[0] < 0.3 < stage["offset"].interval[1]


def test_a_parameter_at_its_bound_gets_no_interval(analytic):
    specs = [ParameterSpec("a", 0.5, 0.0, 1.0), ParameterSpec("b", 1.0)]
    _, stage = fitted(analytic, line, ["a", "b"], 2 + 0.5 * TIME, specs=specs)
    assert stage["a"].at_bound == "upper"
    assert stage["a"].interval is None
    assert "a is at its upper bound" in stage.warnings


def test_profile_interval_equals_the_linear_one_of_a_linear_model(analytic):
    noise = 0.1 * np.random.default_rng(0).standard_normal(TIME.size)
    problem, stage = fitted(analytic, line, ["a", "b"], 2 + 0.5 * TIME + noise)
    assert profile_of(problem, stage.uncertainty, "b").interval == pytest.approx(stage["b"].interval, rel=1e-3)


def test_profile_interval_is_open_where_the_data_end(analytic):
    # Only 1/tau matters once tau is long: no upper end.
    decay = lambda time, inputs, p: {"y": np.exp(-time / p["tau"])}  # noqa: E731
    noise = 0.05 * np.random.default_rng(3).standard_normal(TIME.size)
    specs = [ParameterSpec("tau", 50.0, 1.0)]
    problem, stage = fitted(analytic, decay, ["tau"], np.exp(-TIME / 400) + noise, sigma=0.05, specs=specs)
    low, high = profile_of(problem, stage.uncertainty, "tau").interval
    assert 50.0 < low < 400.0
    assert high is None or high > 1000.0


def test_propagated_band_covers_the_prediction_and_widens_outwards(analytic):
    noise = 0.1 * np.random.default_rng(0).standard_normal(TIME.size)
    problem, stage = fitted(analytic, line, ["a", "b"], 2 + 0.5 * TIME + noise)
    band = propagate(problem, stage.uncertainty, draws=400)
    width = (band.upper[0] - band.lower[0])[0]
    # Standard error of a line's value: sigma sqrt(1/N + (t - mean)^2 / S).
    middle, end = 0.1 * np.sqrt(1 / TIME.size), 0.1 * np.sqrt(4 / TIME.size)
    assert width[100] == pytest.approx(2 * 1.96 * middle, rel=0.25)
    assert width[-1] == pytest.approx(2 * 1.96 * end, rel=0.25)


def test_worst_case_over_the_uncertainty_is_the_farthest_point_of_the_region(analytic):
    # Only a counts, with standard error s: the 95 % region of one parameter reaches 1.96 s.
    level = lambda time, inputs, p: {"y": p["a"]}  # noqa: E731
    noise = 0.1 * np.random.default_rng(0).standard_normal(TIME.size)
    case = measured_case(
        "run",
        analytic(level, ["a"]),
        Task(TIME, {}, ("y",)),
        {"y": 2 + noise},
        sigma={"y": 0.1},
        criteria=[CriterionSpec("y"), CriterionSpec("y", "steady_state", demand=0.01, weight=0.0)],
    )
    problem = Problem([case], [ParameterSpec("a", 1.0, 0.0, 5.0)])
    stage = identify(problem, analyses=AnalysisSpec(monte_carlo=400)).stages[0]
    squares, steady = stage.spread
    error = stage["a"].standard_error
    corners = [problem.space.to_model(x)["a"] - stage["a"].value for x in worst_points(problem, stage.uncertainty)]
    assert np.abs(corners) == pytest.approx(1.96 * error, rel=1e-3)
    assert np.sign(corners[1]) == np.sign(stage["a"].value - 2 - np.mean(noise[-21:]))
    assert squares.worst >= np.sqrt(squares.value**2 + (1.96 * error / 0.1) ** 2) * 0.999
    assert squares.value == pytest.approx(np.std(noise) / 0.1, rel=1e-3)
    end = abs(stage["a"].value - 2 - np.mean(noise[-21:])) / 0.01
    assert steady.value == pytest.approx(end, rel=0.05)
    assert steady.worst >= end + 1.9 * error / 0.01
    assert squares.median < squares.high < squares.worst


def test_what_is_not_determined_has_no_profile_and_no_monte_carlo(analytic):
    spin = lambda time, inputs, p: {"y": 100 * np.exp(-p["c"] / p["J"] * time) + p["b"]}  # noqa: E731
    y = spin(TIME, {}, {"c": 0.02, "J": 0.1, "b": 1.0})["y"] + 0.1 * np.random.default_rng(0).standard_normal(
        TIME.size
    )
    specs = [ParameterSpec("c", 0.05, 1e-3, 1), ParameterSpec("J", 0.1, 1e-2, 1), ParameterSpec("b", 0.5)]
    case = measured_case(
        "run", analytic(spin, ["c", "J", "b"]), Task(TIME, {}, ("y",)), {"y": y}, sigma={"y": 0.1}
    )
    stage = identify(Problem([case], specs), analyses=AnalysisSpec(profiles=True, monte_carlo=20)).stages[0]
    assert [p.name for p in stage.profiles] == ["b"]
    assert stage.spread == ()
    assert any(
        w.startswith("no Monte Carlo: c, J are not separately identifiable; only c/J") for w in stage.warnings
    )


def test_a_profile_is_skew_where_the_model_is(analytic):
    decay = lambda time, inputs, p: {"y": np.exp(-time / p["tau"])}  # noqa: E731
    noise = 0.05 * np.random.default_rng(3).standard_normal(TIME.size)
    specs = [ParameterSpec("tau", 50.0, 1.0)]
    problem, stage = fitted(analytic, decay, ["tau"], np.exp(-TIME / 100) + noise, sigma=0.05, specs=specs)
    profile = profile_of(problem, stage.uncertainty, "tau")
    low, high = profile.interval
    # Where the rise is 1, by the model itself.
    cost = lambda tau: np.sum((np.exp(-TIME / tau) - np.exp(-TIME / 100) - noise) ** 2) / 0.05**2  # noqa: E731
    rises = [cost(end) - cost(stage["tau"].value) for end in (low, high)]
    assert rises[0] == pytest.approx(rises[1], rel=0.02)
    assert high - stage["tau"].value > 1.1 * (stage["tau"].value - low)
    assert list(profile.values) == sorted(profile.values)
    assert min(profile.rise) == 0.0


def test_a_worst_criterion_has_no_standard_errors(analytic):
    from fmuid.identification.problem.combination import Combination

    case = measured_case("run", analytic(line, ["a", "b"]), Task(TIME, {}, ("y",)), {"y": 2 + 0.5 * TIME**1.1})
    stage = identify(
        Problem([case], [ParameterSpec(n, 1.0) for n in "ab"], combination=Combination("min_max"))
    ).stages[0]
    assert stage["a"].standard_error is None
    assert any("no standard errors: min_max" in w for w in stage.warnings)


def test_the_worst_case_of_a_curved_criterion_is_found_by_optimisation(analytic):
    """The peak of a bump within the confidence region: neither a draw nor the linearised model is there."""
    spread = 0.2 / np.sqrt(TIME.size)

    def bump(time, inputs, p):
        return {"y": p["a"] + 0.0 * time, "z": 1.0 + np.exp(-(((p["a"] - 1.0 - 1.2 * spread) / spread) ** 2))}

    model, task = analytic(bump, ["a"], ("y", "z")), Task(TIME, {}, ("y", "z"))
    y = 1.0 + 0.2 * np.random.default_rng(0).standard_normal(TIME.size)
    criteria = [CriterionSpec("y"), CriterionSpec("z", "error_vector", weight=0.0)]
    data = {"y": y - np.mean(y) + 1.0, "z": np.zeros(TIME.size)}
    case = measured_case("run", model, task, data, sigma={"y": 0.2, "z": 1.0}, criteria=criteria)
    asked = AnalysisSpec(monte_carlo=3)
    worst = identify(Problem([case], [ParameterSpec("a", 0.9)]), analyses=asked).stages[0].spread
    assert worst[1].worst == pytest.approx(2.0, abs=0.01)
