"""The noise floor: whitened noise has unit variance, whatever its colour, and nothing else has."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from fmuid.core.errors import ProblemError
from fmuid.data.noise.outliers import just_moved, spikes_left
from fmuid.data.noise.resolution import quantum, repeating_variance, rounding_errors
from fmuid.data.noise.runs import RepeatedRuns
from fmuid.data.noise.spectrum import estimate_noise, whitener
from fmuid.data.noise.transform import coefficient_frequencies, from_real_spectrum, real_spectrum
from fmuid.diagnosis.cross_validation import Null, draw_noise
from fmuid.diagnosis.observed import Observed, excess, gap

DT = 1e-3
TIME = DT * np.arange(600)


def coloured(rng, shape):
    """Two correlated channels: one low-passed, the other that and some white noise."""
    white = rng.standard_normal((*shape, 2, len(TIME) + 200))
    slow = lfilter([1.0], [1.0, -0.9], white[..., 0, :])[..., 200:]
    return np.stack([slow, 0.5 * slow + white[..., 1, 200:]], axis=-2)


def repeated(rng, repeats=6, name="run", offset=0.0, setup="bench"):
    signal = np.sin(20 * TIME) * np.array([[1.0], [3.0]])
    values = signal + coloured(rng, (repeats,)) + offset * rng.standard_normal((repeats, 2, 1))
    return RepeatedRuns(name, setup, TIME, ("a", "b"), values)


def test_coefficients_keep_the_sum_of_squares_and_know_their_frequency():
    for n in (64, 65):
        time = np.arange(n) / n
        wave = np.cos(2 * np.pi * 5 * time)
        spectrum = real_spectrum(wave)
        assert spectrum @ spectrum == pytest.approx(wave @ wave)
        np.testing.assert_allclose(from_real_spectrum(real_spectrum(wave + time)), wave + time, atol=1e-12)
        assert coefficient_frequencies(n, 1 / n)[np.argmax(np.abs(spectrum))] == pytest.approx(5)


def test_whitened_coloured_noise_is_white():
    rng = np.random.default_rng(1)
    runs = [repeated(rng, name=f"run{k}") for k in range(8)]
    noise = estimate_noise(runs)
    assert noise.calibrated
    fresh = coloured(rng, (200,))
    z = whitener(runs[0], noise)(fresh)
    frequencies = coefficient_frequencies(len(TIME), DT)
    for low, high in ((1, 30), (30, 120), (120, 500)):
        part = z[..., (frequencies > low) & (frequencies <= high)]
        covariance = np.einsum("rcn,rdn->cd", part, part) / (part.shape[0] * part.shape[2])
        np.testing.assert_allclose(covariance, np.eye(2), atol=0.25)
    assert np.mean(z[..., 1:] ** 2) == pytest.approx(1.0, abs=0.08)


def test_beside_large_errors_of_a_model_every_sample_counts_alike():
    rng = np.random.default_rng(3)
    observed = Observed.from_runs([repeated(rng, name=f"run{k}", offset=2.0) for k in range(4)])
    slow, fast = (np.stack([np.cos(2 * np.pi * f * TIME), np.zeros(len(TIME))]) for f in (0.0, 450.0))

    def weights(of):
        return [np.sum(of.whiteners[0](x / np.linalg.norm(x)) ** 2) for x in (slow, fast)]

    means = [run.mean for run in observed.runs]
    assert observed.beside_errors(means) is observed
    before = weights(observed)
    assert before[0] < 0.1 * before[1]  # slow noise, and means that differ from run to run
    after = weights(observed.beside_errors([m + 100.0 * np.sin(7.0 * TIME) for m in means]))
    np.testing.assert_allclose(after, 1.0 / observed.noise["bench"].variance[0], rtol=0.05)


@pytest.mark.parametrize(("spike", "jump", "left_out"), [(1.0, 0.0, True), (0.0, 1.0, False)])
def test_a_spike_that_moves_an_input_through_a_controller_is_a_spike(spike, jump, left_out):
    """A jump of the prediction that the run shows a sample later is none, although its input moves as well."""
    rng, at = np.random.default_rng(3), 200
    predicted = np.sin(3.0 * TIME) + jump * (np.arange(len(TIME)) >= at)
    run = np.sin(3.0 * TIME) + jump * (np.arange(len(TIME)) > at) + 0.01 * rng.standard_normal(len(TIME))
    run[at] += spike
    stirred = just_moved([-20.0 * run], len(TIME))
    assert stirred[at]
    assert np.flatnonzero(spikes_left(run, predicted, stirred)).tolist() == ([at] if left_out else [])


@pytest.mark.parametrize("count", [3, 5])
def test_without_repeats_an_error_that_all_runs_share_is_no_shift_of_a_sensor(count):
    rng = np.random.default_rng(4)
    runs = [repeated(rng, repeats=1, name=f"run{k}") for k in range(count)]
    observed = Observed.from_runs(runs)
    sigma = np.sqrt(observed.noise["bench"].variance)
    noise = sigma[:, None] * rng.standard_normal((count, 2, len(TIME)))
    shared = [run.mean + 2.0 * sigma[:, None] + e for run, e in zip(runs, noise, strict=True)]
    assert gap(observed.residuals(shared), observed) < 0.3
    known = observed.bounded_by(shared, 2)
    assert gap(known.residuals(shared), known) > 0.9
    shifted = [run.mean + 2.0 * sign * sigma[:, None] for run, sign in zip(runs, (1, -1, 1, -1, 1), strict=False)]
    np.testing.assert_array_equal(
        observed.bounded_by(shifted, 2).noise["bench"].mean_variance, observed.noise["bench"].mean_variance
    )


def test_without_repeats_noise_is_at_most_what_a_model_leaves():
    rng = np.random.default_rng(5)
    runs = [repeated(rng, repeats=1, name=f"run{k}") for k in range(3)]
    observed = Observed.from_runs(runs)
    plain = observed.noise["bench"]
    errors = rng.standard_normal((3, *runs[0].mean.shape)) * np.sqrt(plain.variance)[:, None]
    errors[:, 0] *= 0.5  # one signal less than its fast changes seem to show
    errors[:, 1] *= 2.0
    known = observed.bounded_by([run.mean + e for run, e in zip(runs, errors, strict=True)], 2).noise["bench"]
    assert 0.25 < known.variance[0] / plain.variance[0] < 0.35
    assert known.variance[1] == plain.variance[1]
    np.testing.assert_allclose(known.covariance[0], np.diag(known.variance))


def test_the_mean_of_a_run_has_a_variance_of_its_own():
    rng = np.random.default_rng(2)
    runs = [repeated(rng, name=f"run{k}", offset=2.0) for k in range(8)]
    noise = estimate_noise(runs)
    fresh = coloured(rng, (300,)) + 2.0 * rng.standard_normal((300, 2, 1))
    z = whitener(runs[0], noise)(fresh)
    assert np.mean(z[..., 0] ** 2) == pytest.approx(1.0, abs=0.35)
    # A shift that is usual from run to run does not count, though the noise averaged over a run is far smaller.
    assert np.all(np.abs(whitener(runs[0], noise)(np.full((2, len(TIME)), 2.0))[:, 0]) < 2.0)


def test_missing_samples_count_for_nothing():
    rng = np.random.default_rng(3)
    run = repeated(rng)
    values = np.array(run.values)
    values[2, 0, 100:200] = np.nan
    holed = RepeatedRuns("run", "bench", TIME, run.channels, values)
    noise = estimate_noise([holed])
    residual = np.zeros((2, len(TIME)))
    residual[0, 100:200] = 1e6
    assert np.all(whitener(holed, noise)(residual) == 0.0)


@pytest.mark.parametrize(("repeats", "calibrated"), [(5, True), (4, False)])
def test_fewer_than_five_repeats_are_said_to_be_uncalibrated(repeats, calibrated):
    assert estimate_noise([repeated(np.random.default_rng(4), repeats)]).calibrated is calibrated


def test_a_signal_without_noise_is_refused():
    run = repeated(np.random.default_rng(5))
    values = np.array(run.values)
    values[:, 1] = values[0, 1]
    with pytest.raises(ProblemError, match="same in every repeat"):
        estimate_noise([RepeatedRuns("run", "bench", TIME, run.channels, values)])


def test_a_gap_does_not_depend_on_how_often_it_is_sampled():
    """Ten times the samples with noise of the same spectral density tell as much, and say the same."""
    gaps = []
    for factor in (1, 10):
        time = DT / factor * np.arange(600 * factor)
        rng = np.random.default_rng(3)
        signal = 40.0 * np.sin(20 * time) * np.sin(3 * time) ** 2
        noise = np.sqrt(factor) * rng.standard_normal((5, 1, time.size))
        runs = [RepeatedRuns(f"run{k}", "bench", time, ("a",), signal + noise) for k in range(3)]
        observed = Observed.from_runs(runs)
        wrong = (signal + 0.4 * np.sin(60 * time))[None]
        gaps.append(gap(observed.residuals([wrong] * 3), observed))
    assert gaps[0] > 0.5
    assert gaps[1] == pytest.approx(gaps[0], rel=0.25)  # noise and bands of an octave; a mean over all: 0.5


def test_what_only_the_model_has_belongs_to_the_gap():
    runs = [repeated(np.random.default_rng(7), 5, f"run{k}") for k in range(4)]
    observed = Observed.from_runs(runs)
    wrong = [run.mean + 3.0 * np.sin(500 * TIME) for run in runs]
    hidden, seen = (o.in_band[0].mean() for o in (observed, replace(observed, predicted=tuple(wrong))))
    assert hidden < 0.9 * seen


def test_runs_of_the_same_conditions_are_left_out_together():
    runs = [repeated(np.random.default_rng(k), 3, f"run{k}") for k in range(4)]
    runs = [replace(run, conditions=c) for run, c in zip(runs, ("a", "b", "a", ""), strict=True)]
    assert Observed.from_runs(runs).groups == (0, 1, 0, 3)


@pytest.mark.parametrize("repeats", [2, 3, 5])
def test_false_alarms_are_as_rare_as_promised(repeats):
    """Complete models with coloured noise and shifts between runs: p < 0.05 in about one of twenty."""
    alarms, gaps = 0, []
    for seed in range(40):
        rng = np.random.default_rng(100 + seed)
        runs = [repeated(rng, repeats, f"run{k}", offset=0.3) for k in range(4)]
        observed = Observed.from_runs(runs)
        truth = np.sin(20 * TIME) * np.array([[1.0], [3.0]])
        residuals = observed.residuals([truth] * len(runs))
        null = draw_noise(observed, draws=60, seed=seed).null(np.zeros((sum(r.size for r in residuals), 0)), [])
        alarms += null.p_value(excess(residuals, observed)) < 0.05
        gaps.append(gap(residuals, observed))
    assert alarms <= 7  # 2 expected; 8 or more have a probability of 1e-3 at 5 %
    assert np.median(gaps) < 0.2


def test_a_gap_of_three_times_the_noise_is_beyond_doubt():
    rng = np.random.default_rng(7)
    runs = [repeated(rng, 5, f"run{k}") for k in range(4)]
    wrong = np.sin(20 * TIME) * np.array([[4.0], [3.0]]) + 3.0 * np.sin(200 * TIME)
    observed = replace(Observed.from_runs(runs), predicted=(wrong,) * 4)
    residuals = observed.residuals([wrong] * 4)
    null = draw_noise(observed, draws=200).null(np.zeros((sum(r.size for r in residuals), 0)), [])
    assert null.p_value(excess(residuals, observed)) < 1e-6
    assert gap(residuals, observed) > 0.25


@pytest.mark.parametrize("repeats", [2, 3, 5])
def test_a_gap_as_large_as_the_noise_is_seen(repeats):
    rng = np.random.default_rng(7)
    runs = [repeated(rng, repeats, f"run{k}") for k in range(4)]
    wrong = np.sin(20 * TIME) * np.array([[1.8], [3.0]]) + 0.8 * np.sin(200 * TIME)
    observed = replace(Observed.from_runs(runs), predicted=(wrong,) * 4)
    residuals = observed.residuals([wrong] * 4)
    null = draw_noise(observed, draws=200).null(np.zeros((sum(r.size for r in residuals), 0)), [])
    assert null.p_value(excess(residuals, observed)) < 0.01
    assert 0.6 < gap(residuals, observed) < 1.1


@pytest.mark.parametrize("repeats", [2, 3, 5])
def test_noise_that_is_larger_or_smaller_in_whole_runs_is_no_gap(repeats):
    """Beside white noise, the gain of a signal varies from run to run."""
    course = np.sin(np.cumsum(np.random.default_rng(1).uniform(0.0, 1.0, len(TIME))))
    alarms = 0
    for seed in range(40):
        rng = np.random.default_rng(200 + seed)
        runs = []
        for k in range(4):
            gain = 40.0 + 1.5 * rng.standard_normal((repeats, 1, 1))
            values = gain * course + rng.standard_normal((repeats, 2, len(TIME)))
            runs.append(RepeatedRuns(f"run{k}", "bench", TIME, ("a", "b"), values))
        observed = Observed.from_runs(runs)
        residuals = observed.residuals([np.tile(40.0 * course, (2, 1))] * 4)
        null = draw_noise(observed, draws=100, seed=seed).null(np.zeros((sum(r.size for r in residuals), 0)), [])
        alarms += null.p_value(excess(residuals, observed)) < 0.05
    assert alarms <= 7  # 2 expected


def test_a_score_beyond_noise_is_as_unlikely_as_that_energy():
    null = Null(np.linspace(-1.0, 1.0, 399), np.linspace(0.0, 4.0, 399))
    assert null.p_value(0.0) == pytest.approx(0.5, abs=0.01)
    assert null.p_value(0.0, 1.0) == 1.0
    assert null.p_value(0.0, 5.0) == pytest.approx(2 / 400)
    assert null.p_value(9.0, 1.0) == pytest.approx(2.0 * null.p_value(9.0))
    assert null.p_value(9.0) < 1e-6


@pytest.mark.parametrize("step", [0.0, 0.5])
def test_the_noise_of_a_single_run_is_bounded_without_a_model(step):
    rng = np.random.default_rng(8)
    motion = 100.0 * np.sin(20 * TIME) + np.where(TIME > 0.3, 50.0, 0.0)
    values = motion + 2.0 * rng.standard_normal(len(TIME))
    values = step * np.round(values / step) if step else values
    observed = Observed.from_runs([RepeatedRuns("run", "bench", TIME, ("a",), values[None, None])])
    assert observed.bounded
    assert not observed.noise["bench"].calibrated
    assert 2.0 < observed.noise["bench"].sigma["a"] < 2.5
    (residual,) = observed.residuals([motion[None]])
    assert 0.6 < np.mean(residual**2) < 1.1


def test_a_smooth_signal_of_a_single_run_is_as_good_as_its_counts():
    values = 0.01 * np.round(np.sin(5 * TIME) / 0.01)
    observed = Observed.from_runs([RepeatedRuns("run", "bench", TIME, ("a",), values[None, None])])
    assert 1.0 <= observed.noise["bench"].sigma["a"] / (0.01 / np.sqrt(12)) < 1.35


def test_coloured_noise_of_a_single_run_is_beyond_its_bound():
    """Slow noise may be an effect: only the fast part is bounded."""
    rng = np.random.default_rng(9)
    slow = lfilter([1.0], [1.0, -0.95], rng.standard_normal(len(TIME)))
    observed = Observed.from_runs([RepeatedRuns("run", "bench", TIME, ("a",), slow[None, None])])
    assert observed.noise["bench"].sigma["a"] < 0.3 * np.std(slow)


@pytest.mark.parametrize("ratio", [0.0, 0.1, 0.2, 0.35, 0.6, 1.5])
def test_what_a_counter_rounds_alike_in_every_run_is_told_from_what_differs(ratio):
    """The variance of the mean of many runs is that of the rounding error that they share."""
    rng = np.random.default_rng(11)
    truth = rng.uniform(0.0, 50.0, 3000)
    runs = np.round(truth + ratio * rng.standard_normal((400, 3000)))
    differing = np.mean(np.var(runs, axis=0, ddof=1))
    shared = np.var(runs.mean(axis=0) - truth) - differing / 400
    assert repeating_variance(differing, 1.0) == pytest.approx(shared, rel=0.1, abs=3e-4)


def test_a_lattice_is_found_and_none_where_there_is_none():
    rng = np.random.default_rng(12)
    assert quantum(np.round(rng.standard_normal(300) / 0.01) * 0.01) == pytest.approx(0.01)
    assert quantum(np.repeat([0.3, 0.5], 20)) == pytest.approx(0.2)
    assert quantum(rng.standard_normal(300)) == 0.0
    assert quantum(np.array([1.0, 2.0])) == 0.0


def test_rounding_errors_have_the_spectrum_of_real_ones():
    """Slow sines counted coarsely: energy of the true rounding errors and of the drawn ones, band by band."""
    rng, time = np.random.default_rng(15), np.arange(2000) * 1e-3
    drawn, real = np.zeros(2000), np.zeros(2000)
    for _ in range(60):
        truth = rng.uniform(20, 40) * np.sin(2 * np.pi * rng.uniform(0.5, 2.0) * time + rng.uniform(0, 6))
        drawn += np.mean(real_spectrum(rounding_errors(np.round(truth), 1.0)) ** 2, axis=0)
        real += real_spectrum(np.round(truth) - truth) ** 2
    frequency = coefficient_frequencies(2000, 1e-3)
    for low, high in ((0, 30), (30, 120), (120, 500)):
        chosen = (frequency >= low) & (frequency < high)
        assert np.mean(drawn[chosen]) == pytest.approx(np.mean(real[chosen]), rel=0.35)


@pytest.mark.parametrize("repeats", [2, 3, 5])
def test_a_complete_model_of_slow_counted_signals_is_no_gap(repeats):
    """Settling signals rest on a few counts for long: their errors are slow, and the same in all repeats."""
    p_values = []
    for seed in range(40):
        rng = np.random.default_rng(1000 + seed)
        runs, truths = [], []
        for k in range(3):
            truth = rng.uniform(20, 60) * (1.0 - np.exp(-TIME / rng.uniform(0.05, 0.3))) + rng.uniform(0, 1)
            values = np.round(truth + 0.02 * rng.standard_normal((repeats, 1, len(TIME))))
            runs.append(RepeatedRuns(f"run{k}", "bench", TIME, ("w",), values))
            truths.append(truth[None])
        observed = replace(Observed.from_runs(runs), predicted=tuple(truths))
        residuals = observed.residuals(truths)
        null = draw_noise(observed, truths, draws=200, seed=seed).null(
            np.zeros((sum(r.size for r in residuals), 0)), []
        )
        p_values.append(null.p_value(excess(residuals, observed)))
    assert np.sum(np.array(p_values) < 0.05) <= 6  # 2 expected
    assert np.sum(np.array(p_values) < 0.5) >= 8  # 20 expected; the test sees gaps, too


@pytest.mark.parametrize("repeats", [2, 4, 5])
def test_a_counted_signal_that_repeats_exactly_is_as_wrong_as_its_counts(repeats):
    rng = np.random.default_rng(13)
    truth = np.stack([30.0 * np.sin(5 * TIME), np.sin(20 * TIME)])
    values = truth + np.array([[0.0], [0.3]]) * rng.standard_normal((repeats, 2, len(TIME)))
    values[:, 0] = np.round(values[:, 0])
    observed = Observed.from_runs([RepeatedRuns("run", "bench", TIME, ("w", "tau"), values)])
    (residual,) = observed.residuals([truth])
    assert repeats * np.mean(residual.reshape(2, -1)[0] ** 2) == pytest.approx(1.0, abs=0.3)
    null = draw_noise(observed, draws=100).null(np.zeros((residual.size, 0)), [])
    assert null.p_value(excess([residual], observed)) > 0.02
    assert observed.noise["bench"].sigma["w"] == pytest.approx(np.sqrt(1 / 12), rel=0.1)


def test_a_standard_deviation_that_was_given_takes_the_place_of_a_measured_one():
    rng = np.random.default_rng(14)
    once = RepeatedRuns("run", "bench", TIME, ("a",), rng.standard_normal((1, 1, len(TIME))), np.array([2.0]))
    observed = Observed.from_runs([once])
    (residual,) = observed.residuals([np.zeros((1, len(TIME)))])
    assert np.mean(residual**2) == pytest.approx(0.25, rel=0.15)
    many = RepeatedRuns("run", "bench", TIME, ("a",), rng.standard_normal((4, 1, len(TIME))), np.array([2.0]))
    (residual,) = Observed.from_runs([many]).residuals([np.zeros((1, len(TIME)))])
    assert 4 * np.mean(residual**2) == pytest.approx(0.25, rel=0.15)
