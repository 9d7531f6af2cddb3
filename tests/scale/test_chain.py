"""A model of any length: right, and translated to code that does not grow with it."""

from __future__ import annotations

import re

import numpy as np
import pytest
from chain import PARAMETERS, by_scipy, compiled

from fmu_build.elimination import plan
from fmu_build.packaging import package
from fmuid import Task, load_fmu

N = 40
TIMES = np.arange(101) * 0.02
FORCE = np.where(np.arange(101) // 30 % 2, -40.0, 40.0)


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    return load_fmu(package(compiled(N), tmp_path_factory.mktemp("chain")))


def test_values_against_scipy(fmu):
    truth = by_scipy(N, TIMES, FORCE)
    for tolerance in (1e-4, 1e-6, 1e-8):
        (y,) = fmu.simulate(Task(TIMES, {"F": FORCE}, ("y",), tolerance=tolerance), {})
        assert np.abs(y - truth).max() < 10 * tolerance * np.abs(truth).max()


@pytest.mark.slow
def test_sensitivities_against_scipy(fmu):
    along = tuple({name: 1.0} for name in PARAMETERS)
    task = Task(TIMES, {"F": FORCE}, ("y",), tolerance=1e-8, along=along)
    slopes = fmu.simulate(task, {})[1:]
    for name, slope in zip(PARAMETERS, slopes, strict=True):
        h = 1e-4 * PARAMETERS[name]
        up, down = (by_scipy(N, TIMES, FORCE, **{name: PARAMETERS[name] + d}) for d in (h, -h))
        expected = (up - down) / (2 * h)
        assert np.abs(slope - expected).max() < 1e-5 * np.abs(expected).max()


def code(n: int) -> list[str]:
    """The C functions, without tables."""
    model = compiled(n)
    text = model.c_source + model.c_rare
    return re.findall(r"^(?:static void|int) \w+\(.*?^\}", text, re.MULTILINE | re.DOTALL)


def test_code_does_not_grow_with_the_model():
    small, large = code(50), code(100)
    assert max(map(len, large)) < 10_000
    assert sum(map(len, large)) < sum(map(len, small))


def test_factorisation_grows_linearly():
    def counts(n: int) -> tuple[int, int]:
        pattern = compiled(n).functions["jacobian"].sparsity_out(1)
        start, rows = pattern.colind(), pattern.row()
        order = plan([rows[start[j] : start[j + 1]] for j in range(pattern.size2())])
        return order.multiplications, len(order.rows)

    small, large = np.array(counts(50)), np.array(counts(100))
    assert all(large <= 2.1 * small)
    assert small[0] < 15 * 200  # per state


def test_same_bytes():
    compiled.cache_clear()
    first = compiled(20)
    compiled.cache_clear()
    again = compiled(20)
    assert (first.c_source, first.c_rare, first.c_header) == (again.c_source, again.c_rare, again.c_header)
