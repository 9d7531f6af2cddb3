from dataclasses import replace

import numpy as np
import pytest

from fmuid.core.campaign import CriterionSpec
from fmuid.core.errors import ProblemError
from fmuid.data.noise.level import NoiseLevel
from fmuid.data.noise.runs import RepeatedRuns
from fmuid.identification.problem import criteria
from fmuid.identification.problem.criteria import Target, prepare
from fmuid.identification.problem.features import settling_time

TIME = np.linspace(0.0, 2.0, 401)


def target(mean, sigma=0.1, count=1.0, inputs=None):
    mean = np.asarray(mean, dtype=float)
    there = np.where(np.isfinite(mean), count, 0.0)
    return Target("y", TIME, mean, there, NoiseLevel(sigma**2), inputs or {})


def score(kind, prediction, measured, demand=1.0, **options):
    spec = CriterionSpec("y", kind, demand=demand, options=options)
    return criteria.value(prepare(spec, target(measured)).residuals(np.asarray(prediction, dtype=float)))


def second_order(zeta, w=10.0):
    wd = w * np.sqrt(1 - zeta**2)
    return 1 - np.exp(-zeta * w * TIME) * (np.cos(wd * TIME) + zeta * w / wd * np.sin(wd * TIME))


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("least_squares", 3.0),  # 0.3 off with sigma 0.1
        ("error_vector", 0.3),
        ("maximum", 0.3),
        ("quantile", 0.3),
        ("integral_absolute", 0.3),
        ("integral_squared", 0.3),
        ("integral_time_absolute", 0.3),
        ("steady_state", 0.3),
    ],
)
def test_value_of_a_constant_error(kind, expected):
    measured = np.sin(TIME)
    assert score(kind, measured + 0.3, measured) == pytest.approx(expected)
    assert score(kind, measured + 0.3, measured, demand=2.0) == pytest.approx(expected / 2)


def test_response_features_of_a_second_order_step():
    # Textbook: overshoot exp(-pi zeta / sqrt(1 - zeta^2)) = 37.2 % and 16.3 %.
    assert score("overshoot", second_order(0.3), second_order(0.5)) == pytest.approx(37.2 - 16.3, abs=0.3)
    # 10-90 % rise time of zeta = 0.5 is 1.64 / w.
    ideal = np.where(TIME < 0.5, 0.0, 1.0)
    assert score("rise_time", second_order(0.5), ideal) == pytest.approx(0.164, abs=0.005)
    assert score("settling_time", second_order(0.5), second_order(0.5)) == 0.0


def test_the_settling_band_is_a_share_of_the_change_whatever_the_level():
    rise = 1 - np.exp(-TIME / 0.1)  # within 5 % after three time constants
    for level in (0.0, 10.0, -1.0):
        assert settling_time(TIME, level + rise) == pytest.approx(0.3, abs=0.01)


def test_a_time_weighted_integral_counts_from_the_start_of_the_record():
    spec, early = CriterionSpec("y", "integral_time_absolute"), np.exp(-TIME)
    here, later = (
        criteria.value(prepare(spec, replace(target(0 * TIME), time=TIME + shift)).residuals(early))
        for shift in (0.0, 100.0)
    )
    # The integral of t exp(-t) over that of t, up to 2.
    assert here == pytest.approx((1 - 3 * np.exp(-2)) / 2, rel=0.01)
    assert later == pytest.approx(here)


def test_frequency_response_of_a_gain_and_a_delay():
    u = np.sin(2 * np.pi * 5 * TIME) + np.sin(2 * np.pi * 9 * TIME)
    spec = {"options": {"frequencies": [5.0, 9.0]}}
    aim = target(u, inputs={"u": u})
    magnitude = prepare(CriterionSpec("y", "magnitude", **spec), aim)
    assert magnitude.residuals(10 * u) == pytest.approx([20.0, 20.0])
    late = np.sin(2 * np.pi * 5 * (TIME - 0.01)) + np.sin(2 * np.pi * 9 * (TIME - 0.01))
    phase = prepare(CriterionSpec("y", "phase", **spec), aim)
    assert phase.residuals(late) == pytest.approx([-18.0, -32.4], abs=0.1)


@pytest.mark.parametrize("kind", ["least_squares", "maximum", "integral_absolute", "steady_state", "peak"])
def test_missing_samples_are_left_out(kind):
    measured = np.sin(TIME)
    gappy = measured.copy()
    gappy[50:80] = np.nan
    wild = measured.copy()
    wild[50:80] = 1e6  # only where nothing was measured
    assert score(kind, wild, gappy) == 0.0


def test_time_window_and_quantile_leave_outliers_out():
    measured = np.zeros(401)
    spiky = measured.copy()
    spiky[:10] = 100.0
    spec = CriterionSpec("y", "maximum", start_time=0.1)
    assert criteria.value(prepare(spec, target(measured)).residuals(spiky)) == 0.0
    assert score("quantile", spiky, measured, q=0.9) == 0.0


def test_user_functions_by_name_and_by_registration():
    assert score("user", np.ones(401), np.zeros(401), function="numpy:add") == pytest.approx(
        np.sqrt(np.mean((TIME + 1) ** 2))
    )
    criteria.register("largest_over", lambda time, p, m: max(0.0, float(np.max(p - m))))
    assert score("largest_over", np.full(401, -5.0), np.zeros(401)) == 0.0


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (CriterionSpec("y", "least_squared"), "unknown kind"),
        (CriterionSpec("y", demand=0.0), "demand"),
        (CriterionSpec("y", start_time=3.0), "time window"),
        (CriterionSpec("y", options={"sigmaa": 1.0}), "unknown option 'sigmaa'"),
        (CriterionSpec("y", "magnitude", options={"input": "v"}), "no input 'v'"),
        (CriterionSpec("y", "user"), "no function"),
    ],
)
def test_criteria_that_cannot_be_are_refused(spec, message):
    with pytest.raises(ProblemError, match=message):
        prepare(spec, target(np.zeros(401)))


def test_whitened_by_the_repeats_the_noise_is_white_and_its_size_is_known(coloured):
    time = np.arange(400) * 0.01
    runs = coloured(np.random.default_rng(0), 60, shift=2.0)
    repeated = (RepeatedRuns("run", "bench", time, ("y",), runs[:20, None]),)
    aim = Target("y", time, np.zeros(400), np.full(400, 4.0), NoiseLevel(1.0), {}, repeated)
    criterion = prepare(CriterionSpec("y", options={"whiten": "repeats"}), aim)
    assert criterion.smooth
    means = runs[20:].reshape(10, 4, 400).mean(axis=1)  # of four repeats, as the target counts
    white = np.array([criterion.residuals(mean) for mean in means])
    assert np.mean(white**2) == pytest.approx(1.0, abs=0.1)
    assert np.mean(white[:, :3] ** 2) == pytest.approx(1.0, abs=0.6)  # the first samples too
    assert np.mean(white[:, 1:] * white[:, :-1]) == pytest.approx(0.0, abs=0.06)
    # Of all that is slow, the shift included, as much is left as of everything else.
    assert np.mean(white.sum(axis=1) ** 2 / 400) == pytest.approx(1.0, abs=0.9)
    window = prepare(CriterionSpec("y", start_time=1.0, stop_time=2.0, options={"whiten": "repeats"}), aim)
    assert np.mean(window.residuals(means[0][:]) ** 2) == pytest.approx(1.0, abs=0.5)
    assert len(window.residuals(means[0])) == 101


def test_what_cannot_be_whitened_is_said():
    once = (RepeatedRuns("run", "bench", TIME, ("y",), np.zeros((1, 1, 401))),)
    aim = Target("y", TIME, np.zeros(401), np.ones(401), NoiseLevel(1.0), {}, once)
    with pytest.raises(ProblemError, match=r"'least_squares' on 'y': no experiment of setup .* repeated"):
        prepare(CriterionSpec("y", options={"whiten": "repeats"}), aim)
    with pytest.raises(ProblemError, match="unknown whiten 'spectrum'; known: sigma, repeats"):
        prepare(CriterionSpec("y", options={"whiten": "spectrum"}), target(np.zeros(401)))


@pytest.mark.parametrize(("error", "expected"), [(0.1, 0.0), (0.5, 0.0), (1.25, 0.5), (2.0, 1.0), (3.5, 2.0)])
def test_a_demand_may_be_an_interval_from_good_to_bad(error, expected):
    measured = np.zeros_like(TIME)
    assert score("maximum", measured + error, measured, demand=2.0, good=0.5) == pytest.approx(expected)
