"""Intervals as text: as many digits as their width needs."""

from __future__ import annotations

import pytest

from fmuid.core.formatting import interval_text


@pytest.mark.parametrize(
    ("low", "high", "text"),
    [
        (0.0039212, 0.0064167, "0.0039212 .. 0.0064167"),
        (11.1250002, 11.1250009, "11.1250002 .. 11.1250009"),
        (-2.0, 2.0, "-2 .. 2"),
        (3.0, 3.0, "3 .. 3"),
        (0.0, float("inf"), "0 .. inf"),
    ],
)
def test_the_ends_of_an_interval_differ_as_text(low: float, high: float, text: str) -> None:
    assert interval_text(low, high) == text
