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
    assert peak(LATER, np.array([0.0, 3.0, -2.0, 2.0])) == 3.0


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
    y = np.array([first, (first + end) / 2.0, largest, *[end] * 8])
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
    pausing = np.array([0.0, 0.9, 0.9, *[1.0] * 8])  # at nine tenths from the first sample on
    assert rise_time(LATER, pausing) == pytest.approx(1.0 - 1 / 9)


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


def test_a_window_keeps_one_tone_out_of_another_and_means_out_of_both():
    time = 1.0 + np.linspace(0.0, 2.0, 2001)
    slow, fast = (np.sin(2 * np.pi * f * time) for f in (0.5, 10.0))
    (there, elsewhere) = frequency_response(time, 5.0 + slow, -7.0 + 2.0 * slow + fast, np.array([0.5, 10.0]))
    assert there == pytest.approx(2.0, abs=1e-3)
    assert abs(elsewhere) > 1e3


def test_a_hann_window_shows_half_of_the_next_tone_and_none_of_others():
    """The window's transform is -1/2 one cycle of the record away, and 0 at two cycles or more."""
    time = 0.3 + np.linspace(0.0, 2.0, 2001)
    five, six, seven = (np.cos(np.pi * cycles * (time - 0.3)) for cycles in (5, 6, 7))
    (response,) = frequency_response(time, five, 2.0 * five + 3.0 * six + 9.0 * seven, np.array([2.5]))
    assert response == pytest.approx(2.0 - 0.5 * 3.0, rel=1e-9)
    one = np.sin(np.pi * (time - 0.3))  # next to the mean
    (response,) = frequency_response(time, 4.0 + one, -6.0 + 3.0 * one, np.array([0.5]))
    assert response == pytest.approx(3.0, rel=1e-9)


def test_excited_frequencies_are_those_of_most_power_in_order():
    time = 1.0 + np.linspace(0.0, 4.0, 801)
    u = 3.0 + np.sin(2 * np.pi * 20.0 * time) + 0.6 * np.sin(2 * np.pi * 4.0 * time)
    u += 0.15 * np.sin(2 * np.pi * 50.0 * time)  # a fiftieth of the power
    u += 0.05 * np.sin(2 * np.pi * 70.0 * time)  # a four-hundredth
    resolution = 800 / (801 * 4.0)  # Hz
    assert excited_frequencies(time, u, count=2) == pytest.approx([16 * resolution, 80 * resolution], rel=1e-9)
    frequencies = excited_frequencies(time, u)
    assert list(frequencies) == sorted(frequencies)
    assert {round(f, -1) for f in frequencies} == {0.0, 20.0, 50.0}
    assert len(excited_frequencies(time, np.random.default_rng(0).standard_normal(801))) == 10


def test_what_is_slow_is_excited_and_what_is_constant_is_not():
    time = np.linspace(0.0, 4.0, 801)
    frequencies = excited_frequencies(time, (time - 2.0) ** 2 + np.sin(2 * np.pi * 0.75 * time))
    assert 0.0 < frequencies[0] < 0.6


def test_excited_frequencies_need_no_even_sampling():
    time = 2.0 + np.linspace(0.0, 2.0, 801) ** 2  # ever slower samples
    tone = np.sin(2 * np.pi * 20.0 * time)
    assert excited_frequencies(time, tone, count=1) == pytest.approx([80 * 800 / (801 * 4.0)], rel=1e-9)


@pytest.mark.parametrize("gap", ["first", "last"])
def test_excited_frequencies_hold_for_a_record_with_a_gap_at_an_end(gap):
    time = np.linspace(1.0, 4.0, 1501)
    time = np.append(0.0, time) if gap == "first" else np.append(time, 5.0)
    assert excited_frequencies(time, np.sin(2 * np.pi * 10.0 * time), count=1) == pytest.approx([10.0], abs=0.25)
