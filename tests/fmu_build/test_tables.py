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
        ({"smoothness": CONSTANT}, 2.0, 3.0, 5.0), ({"smoothness": CONSTANT}, 4.0, NEVER, 11.0),
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
    with pytest.raises(ValueError, match="a table with jumps"):
        value(table(smoothness=2), 1, 0.5, 1.0, 0.0)


@pytest.mark.parametrize(
    ("smoothness", "values"),  # of the Standard Library's C code, at 0.5, 2, 3.5, 5, 6.25 and beyond the end
    [
        (2, (2.234375, 3.635416667, 4.075757576, 1.213068182, -2.056640625, 4.5)),
        (4, (2.142857143, 3.714285714, 4.0, 1.0, -1.78125, 2.0)),
        (5, (2.125, 3.75, 4.0, 1.0, -1.78125, 2.0)),
        (6, (2.220036765, 3.603663793, 4.083793103, 1.258214286, -2.041573661, 3.375)),
    ],
)
def test_smooth_curves(smoothness, values):
    rows = Array((6, 2), (0.0, 1, 1, 3, 3, 4, 4, 4, 6, -2, 7, 0))
    columns = Array((1,), (2,))
    one = EXTERNAL["ModelicaStandardTables_CombiTable1D_init3"]
    over_time = EXTERNAL["ModelicaStandardTables_CombiTimeTable_init3"]
    curve = one("NoName", "NoName", rows, 6, 2, columns, 1, smoothness, LAST_TWO, False)
    course = over_time(
        "NoName", "NoName", rows, 6, 2, 0.0, columns, 1, smoothness, LAST_TWO, 0.0, 3, False, ",", 0
    )
    for u, expected in zip((0.5, 2.0, 3.5, 5.0, 6.25, 8.0), values, strict=True):
        at_u = EXTERNAL["ModelicaStandardTables_CombiTable1D_getValue"](curve, 1, u)
        assert at_u == pytest.approx(expected, abs=1e-9)
        assert value(course, 1, u, NEVER, 0.0) == pytest.approx(at_u, abs=1e-12)
