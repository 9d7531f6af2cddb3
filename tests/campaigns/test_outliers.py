"""Spiked and held samples are found run by run and left out; what a signal really does is not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fmuid import Experiment, Measurements, Signal
from fmuid.data.noise.level import noise_level
from fmuid.data.noise.outliers import without_outliers

TIME = np.linspace(0.0, 2.0, 1001)


def recorded(values, inputs=None):
    """Runs (R, N) of one experiment."""
    driven = {} if inputs is None else {"u": Signal("u", inputs, "A", "input")}
    return Measurements(
        {
            f"r{k}": Experiment(
                f"r{k}",
                "bench",
                TIME,
                {**driven, "y": Signal("y", row, "rad/s", "output")},
                repeat_of=None if k == 0 else "r0",
            )
            for k, row in enumerate(values)
        }
    )


def runs(repeats, rng, sigma=0.01):
    return np.sin(8.0 * TIME) + sigma * rng.standard_normal((repeats, len(TIME)))


@pytest.mark.parametrize("repeats", [1, 2, 5])
def test_spikes_are_left_out_and_the_noise_is_what_it_was(repeats):
    rng = np.random.default_rng(1)
    values = runs(repeats, rng)
    spiked = values.copy()
    where = [(0, 100), (0, 500), (0, 501), (repeats - 1, 777), (repeats - 1, 300)]
    for run, k in where:
        spiked[run, k] += 0.5
    cleaned, outliers = without_outliers(recorded(spiked))
    assert {(o.experiment, o.kind) for o in outliers} == {(f"r{r}", "spike") for r, _ in where}
    assert sorted(t for o in outliers for t in o.times) == pytest.approx(sorted(TIME[k] for _, k in where))
    left = np.array([e.outputs["y"].values for e in cleaned])
    assert np.isnan(left).sum() == len(where)
    if repeats > 1:
        assert noise_level(left, [None]).sigma == pytest.approx(noise_level(values, [None]).sigma, rel=0.01)
        assert noise_level(spiked, [None]).sigma > 1.4 * noise_level(values, [None]).sigma


@pytest.mark.parametrize("step", [0.0, 0.002])
@pytest.mark.parametrize("repeats", [1, 3])
def test_a_value_that_a_sensor_held_is_left_out(step, repeats):
    values = runs(repeats, np.random.default_rng(2), sigma=0.001)
    values = step * np.round(values / step) if step else values
    values[0, 200:230] = values[0, 200]
    _, (outlier,) = without_outliers(recorded(values))
    assert (outlier.kind, outlier.experiment) == ("held", "r0")
    assert outlier.times == pytest.approx(tuple(TIME[201:230]))


def test_what_a_signal_does_is_no_outlier():
    rng = np.random.default_rng(3)
    steps = np.repeat([0.0, 1.0, -1.0, 0.5], 251)[:1001]
    counted = 0.01 * np.round(np.cumsum(0.002 * np.abs(np.sin(3 * TIME))) / 0.01)
    rest = np.where(TIME < 0.5, 0.0, np.sin(8 * (TIME - 0.5)))
    ringing = np.where(TIME > 1.0, np.exp(-8 * (TIME - 1)) * np.sin(1200 * (TIME - 1)), 0.0)
    peak = np.zeros(1001)
    peak[252:254] = 5.0  # an answer to the step of the input
    blips = 0.01 * (rng.random(1001) < 0.01)
    signals = (steps, counted, rest, ringing, ringing + 1e-3 * rng.standard_normal(1001), peak, blips)
    for k, signal in enumerate(signals):
        for noise in (0.0, 1e-3):
            values = signal + noise * rng.standard_normal((1, 1001)) * (k not in (1, 6))
            assert without_outliers(recorded(values, steps))[1] == (), (k, noise)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), colour=st.sampled_from([0.0, 0.5, 0.95]), repeats=st.sampled_from([1, 2, 4]))
def test_noise_has_no_outliers(seed, colour, repeats):
    from scipy.signal import lfilter

    rng = np.random.default_rng(seed)
    noise = lfilter([1.0], [1.0, -colour], rng.standard_normal((repeats, len(TIME))))
    scale = 1.0 + np.abs(np.sin(5 * TIME))  # noise that grows with the signal
    assert without_outliers(recorded(np.sin(5 * TIME) + 0.1 * scale * noise))[1] == ()
