"""Start values written into FMUs of other tools."""

from __future__ import annotations

import pytest

from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.fmu_copy import copy_with_starts, takes_effect


@pytest.mark.parametrize(
    ("fmi", "values"),
    [
        (2, {"c": 200.0, "flip": 1.0, "mode": 2.0, "x": 0.5}),
        (3, {"c": 200.0, "flip": 1.0, "table[1,2]": 10.0, "table[2,3]": -1.5}),
    ],
)
def test_the_description_says_the_new_values_and_whether_they_count_is_found_out(build, tmp_path, fmi, values):
    original = load_fmu(build(fmi))
    copy = tmp_path / "copy.fmu"
    copy_with_starts(original, values, copy)
    before, after = original.variables, load_fmu(copy).variables
    assert {n: v.start for n, v in after.items()} == {n: values.get(n, v.start) for n, v in before.items()}
    assert not takes_effect(original, values, copy), "this one's library holds its own"
    assert takes_effect(original, {"c": before["c"].start}, original.path)
