"""Features of a response and its frequency response, on records whose values are worked out by hand."""

import numpy as np
import pytest

from fmuid.identification.problem.features import (
    excited_frequencies,
    frequency_response,
    overshoot,
    peak,
    rise_time,
    settling_time,
    steady_state,
)

LATER = 5.0 + np.arange(11.0)  # a record that does not begin at 0


def test_the_steady_state_is_the_mean_of_the_last_tenth():
    assert steady_state(LATER, np.array([9, 9, 9, 9, 9, 9, 9, 9, 9, 1, 3])) == 2.0
    coarse = np.array([0.0, 0.5, 0.89, 0.9, 1.0])  # by time, not by samples
    assert steady_state(coarse, np.array([7.0, 7.0, 7.0, 1.0, 2.0])) == 1.5


def test_the_peak_is_the_sample_farthest_from_the_first():
    assert peak(LATER, np.array([1.0, 5.0, -4.0, 2.0])) == -4.0
    assert peak(LATER, np.array([-3.0, 1.0, -5.0])) == 1.0


@pytest.mark.parametrize(
    ("first", "largest", "end", "percent"),
    [
        (1.0, 4.0, 3.0, 50.0),
        (3.0, 0.0, 1.0, 50.0),
        (0.0, 1.0, 1.0, 0.0),
        (0.0, 0.5, 1.0, 0.0),
        (2.0, 9.0, 2.0, 0.0),
    ],
)
def test_an_overshoot_is_a_share_of_the_change(first, largest, end, percent):
    y = np.array([first, first, largest, *[end] * 8])
    assert overshoot(LATER, y) == pytest.approx(percent)


@pytest.mark.parametrize(("level", "change"), [(0.0, 1.0), (2.0, 5.0), (4.0, -3.0)])
def test_a_rise_takes_from_a_tenth_to_nine_tenths_of_the_change(level, change):
    time = 5.0 + np.array([0.0, 1.0, 3.0, 4.5, 7.0, 8.0, 9.0, 40.0, 100.0])
    ramp = np.clip((time - 5.0) / 8.0, 0.0, 1.0)  # straight between samples, reached after 8 s
    assert rise_time(time, level + change * ramp) == pytest.approx(0.8 * 8.0)


def test_a_rise_is_found_between_the_samples():
    time = 5.0 + np.array([0.0, 1.0, 3.0, 10.0])
    # A tenth is crossed a fifth of the way to 1 s, nine tenths four fifths of the way from 1 s to 3 s.
    assert rise_time(time, np.array([0.0, 0.5, 1.0, 1.0])) == pytest.approx(1.0 + 0.8 * 2.0 - 0.2)
    assert np.isnan(rise_time(time, np.array([1.0, 4.0, 2.0, 1.0])))


def test_a_response_has_settled_after_the_last_sample_outside_the_band():
    y = np.array([2.0, 5.0, 3.8, 4.3, 4.0, 4.09, 4.11, 4.0, 4.0, 4.0, 4.0])  # a change of 2
    assert settling_time(LATER, y) == 7.0  # 4.11 is the last one outside 0.1
    assert settling_time(LATER, y, band=0.1) == 4.0
    assert settling_time(LATER, y, band=2.0) == 0.0
    assert settling_time(LATER, np.array([0.0] * 9 + [3.0, -1.0])) == 10.0  # not within the record
    assert settling_time(LATER, 6.0 - y) == 7.0
    exactly = np.array([0.0, 0.5, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    assert settling_time(LATER, exactly, band=0.5) == 1.0  # on its edge is inside


def test_a_frequency_response_needs_neither_even_sampling_nor_a_zero_mean():
    rng = np.random.default_rng(0)
    time = 3.0 + np.sort(np.append(rng.uniform(0.0, 4.0, 3000), [0.0, 4.0]))

    def signal(t):
        return 5.0 + np.sin(2 * np.pi * 3.0 * t) + 0.5 * np.sin(2 * np.pi * 8.0 * t)

    frequencies = np.array([3.0, 8.0])
    response = frequency_response(time, signal(time), -7.0 + 2.0 * signal(time - 0.01), frequencies)
    np.testing.assert_allclose(response, 2.0 * np.exp(-2j * np.pi * frequencies * 0.01), rtol=0.01)


def test_frequencies_of_a_tone_beside_its_leakage():
    """By Hann-windowed integrals: a tone an octave off leaks less than a thousandth."""
    time = np.linspace(0.0, 2.0, 2001)
    tones = [np.sin(2 * np.pi * f * time) for f in (5.0, 10.0)]
    (there, elsewhere) = frequency_response(time, tones[0], tones[0] + tones[1], np.array([5.0, 10.0]))
    assert abs(there - 1.0) < 1e-3
    assert abs(elsewhere) > 1e3


def test_excited_frequencies_are_those_of_most_power_in_order():
    time = 1.0 + np.linspace(0.0, 4.0, 801)
    u = 3.0 + np.sin(2 * np.pi * 20.0 * time) + 0.6 * np.sin(2 * np.pi * 4.0 * time)
    u += 0.05 * np.sin(2 * np.pi * 50.0 * time)  # a four-hundredth of the power
    assert excited_frequencies(time, u, count=2) == pytest.approx([4.0, 20.0], abs=0.1)
    found = excited_frequencies(time, u)
    assert list(found) == sorted(found)
    assert np.all(np.minimum(abs(found - 4.0), abs(found - 20.0)) < 0.6)
    assert np.ptp(found) > 15.0
    jittered = time + 1e-3 * np.sin(np.arange(801.0))
    sampled = np.sin(2 * np.pi * 20.0 * jittered)
    assert excited_frequencies(jittered, sampled, count=1) == pytest.approx([20.0], abs=0.2)
    assert len(excited_frequencies(time, np.random.default_rng(0).standard_normal(801))) == 10
