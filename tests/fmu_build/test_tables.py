"""Tables over time: the next event and the value of the segment that ends there, worked out by hand."""

from __future__ import annotations

import pytest

from fmu_build.algebra import Array
from fmu_build.tables import EXTERNAL

HOLD, LAST_TWO, PERIODIC = 1, 2, 3
LINEAR, CONSTANT = 1, 3
NEVER = 1e60
next_event = EXTERNAL["ModelicaStandardTables_CombiTimeTable_nextTimeEvent"]
value = EXTERNAL["ModelicaStandardTables_CombiTimeTable_getValue"]


def table(extrapolation=LAST_TWO, smoothness=LINEAR, start=0.0, shift=0.0, events=1):
    """From 0 to 2 within 1 s, a jump to 5, and to 9 within 2 s more."""
    rows = Array((4, 2), (0.0, 0.0, 1.0, 2.0, 1.0, 5.0, 3.0, 9.0))
    make = EXTERNAL["ModelicaStandardTables_CombiTimeTable_init3"]
    columns = Array((1,), (2,))
    return make("NoName", "NoName", rows, 4, 2, start, columns, 1, smoothness, extrapolation, shift, events, False)


@pytest.mark.parametrize(
    ("options", "time", "expected"),
    [
        ({}, 0.0, 1.0), ({}, 1.0, 3.0), ({}, 2.9, 3.0), ({}, 3.0, NEVER), ({"shift": 10.0}, 0.0, 10.0),
        ({"start": 0.5}, 0.0, 0.5), ({"extrapolation": PERIODIC}, 3.0, 4.0), ({"extrapolation": PERIODIC}, 4.0, 6.0),
        ({"events": 3}, 0.0, NEVER),
    ],
)  # fmt: skip
def test_next_event(options, time, expected):
    assert next_event(table(**options), time) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("options", "time", "end", "expected"),
    [
        ({}, 0.5, 1.0, 1.0), ({}, 1.0, 1.0, 2.0), ({}, 1.0, 3.0, 5.0), ({}, 2.0, 3.0, 7.0), ({}, 4.0, NEVER, 11.0),
        ({"extrapolation": HOLD}, 4.0, NEVER, 9.0), ({"smoothness": CONSTANT}, 0.5, 1.0, 0.0),
        ({"smoothness": CONSTANT}, 2.0, 3.0, 5.0), ({"smoothness": CONSTANT}, 4.0, NEVER, 9.0),
        ({"shift": 10.0}, 10.5, 11.0, 1.0), ({"shift": 10.0}, 5.0, 10.0, -10.0),
        ({"shift": 10.0, "extrapolation": HOLD}, 5.0, 10.0, 0.0), ({"start": 0.5}, 0.2, 0.5, 0.0),
        ({"extrapolation": PERIODIC}, 3.5, 4.0, 1.0), ({"extrapolation": PERIODIC}, 4.0, 6.0, 5.0),
        ({"extrapolation": PERIODIC}, 8.0, 9.0, 7.0), ({"events": 3}, 2.0, NEVER, 7.0),
    ],
)  # fmt: skip
def test_value(options, time, end, expected):
    assert value(table(**options), 1, time, end, 0.0) == pytest.approx(expected)


def test_what_is_not_supported_is_said():
    with pytest.raises(ValueError, match="without extrapolation"):
        table(extrapolation=4)
    with pytest.raises(ValueError, match="LinearSegments"):
        table(smoothness=2)
