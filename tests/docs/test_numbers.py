"""Every number set by hand in a diagnosis has a reason; the site lists them."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.chosen_numbers import MODULES, numbers, table


@pytest.mark.parametrize("path", MODULES, ids=lambda p: p.stem)
def test_every_number_has_a_reason(path: Path) -> None:
    assert [number for number, reason in numbers(path).items() if not reason] == []


def test_the_table_has_the_numbers_of_a_verdict() -> None:
    assert "| `SURE = 0.9` | `decide` | probability of what is named without repeats" in table()
