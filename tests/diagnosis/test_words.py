"""Words of a diagnosis: names as the model writes them, quantities of the rig's domain."""

from __future__ import annotations

import numpy as np
import pytest

from fmuid.diagnosis.summary import _lowered
from fmuid.diagnosis.varying import Course
from fmuid.effects.laws import numeral
from fmuid.effects.quantities import quantity_words, words_of


@pytest.mark.parametrize(
    ("effect", "sentence", "text"),
    [
        ("varies@K", "K falls with the current", "K falls with the current"),
        ("varies@Kp", "Kp falls with the current", "Kp falls with the current"),
        ("varies@G_env(wind)", "G_env grows with wind", "G_env grows with wind"),
        ("varies@K:w(i)", "K:w falls with i", "K:w falls with i"),
        ("value@motor.R", "R is larger", "R is larger"),
        ("T1_drift", "T1 drifts", "T1 drifts"),
        ("loss@boiler", "boiler: loss of heat", "boiler: loss of heat"),
        ("air_drag", "Friction grows with speed", "friction grows with speed"),
        ("eddy@coil", "A shorted turn", "a shorted turn"),
    ],
)
def test_names_keep_their_capitals(effect: str, sentence: str, text: str) -> None:
    assert _lowered(sentence, effect) == text


def test_a_course_that_turns_is_told_by_both_of_its_parts() -> None:
    x = np.linspace(-2.0, 1.0, 4)
    stiffness = Course("k", "N/m", "x", "m", x, 1.0 + x**2, None)
    assert f"{stiffness}" == "k falls with x, from 5 to 1 N/m between -2 and 0 m, then grows to 2 N/m at 1 m"
    rising = Course("k", "N/m", "x", "m", x, 5.0 + x, 0.2)
    assert f"{rising}" == "k grows with x by 20 % per m, from 3 to 6 N/m between -2 and 1 m"


def test_quantities_have_the_words_of_their_domain() -> None:
    assert quantity_words("thermal", "K") == {
        "p": "temperature",
        "rate": "rate of temperature",
        "through": "heat flow",
    }
    assert quantity_words("rotational", "rad")["rate"] == "speed"
    assert quantity_words("fluid", "m")["p"] == "level"
    assert {"speed", "rate of temperature", "rate of level"} <= set(words_of("rate"))
    assert words_of("acceleration") == ()


def test_negative_numbers_in_expressions_are_in_parentheses() -> None:
    assert f"x - {numeral(-0.25, 3)}" == "x - (-0.25)"
    assert f"x - {numeral(0.25, 3)}" == "x - 0.25"
