"""The factorisations of linear.c and pivoting.c, planned and with pivots by size, against NumPy."""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path

import numpy as np
import pytest

import fmu_build
from fmu_build.elimination import plan
from fmu_build.straight import GROWTH, is_short, straight_code
from tests.conftest import c_compiler

FLAGS = ["-std=c99", "-O1", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-pedantic", "-fPIC", "-shared"]
RUNTIME = Path(fmu_build.__file__).parent / "runtime"
DRIVER = """
#include "linear.h"
int run(int n, const int *const *t, int nonzeros, int filled, const double *a, double *b) {
    double value[100000], work[2000] = {0};
    Pattern p = {.n = n, .nonzeros = nonzeros, .factors = filled, .start = t[0], .row = t[1], .column = t[2], .place = t[3],
                 .lu_start = t[4], .lu_diagonal = t[5], .lu_row = t[6], .growth = 1e5};
    Factors f = {value, 0, work, 0, 0, 0};
    for (int again = 0; again < 2; again++)
        if (factorise(n, 0, &p, a, &f)) return -1;
    solve(n, 0, &p, &f, b);
    free_pivoted(&f.other);
    return f.use_other;
}
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    folder = tmp_path_factory.mktemp("linear")
    (folder / "driver.c").write_text(DRIVER)
    subprocess.run(
        [
            *(c_compiler(), *FLAGS, f"-I{RUNTIME}"),
            "-o",
            folder / "linear.so",
            folder / "driver.c",
            *(RUNTIME / f"{n}.c" for n in ("linear", "pivoting")),
            "-lm",
        ],
        check=True,
    )
    return ctypes.CDLL(str(folder / "linear.so"))


def solve(library, matrix: np.ndarray, b: np.ndarray) -> tuple[int, np.ndarray]:
    """Whether pivots were chosen by size (-1: singular), and the solution."""
    n = len(matrix)
    columns = [np.flatnonzero(matrix[:, j]).tolist() for j in range(n)]
    order = plan(columns)
    start = np.cumsum([0, *map(len, columns)])
    tables = [
        start,
        [row for column in columns for row in column],
        order.columns,
        order.places,
        order.start,
        order.diagonal,
        order.rows,
    ]
    tables = [np.array(t, dtype=np.intc) for t in tables]
    pointers = (ctypes.c_void_p * 7)(*(t.ctypes.data for t in tables))
    values = np.concatenate([matrix[column, j] for j, column in enumerate(columns)])
    x = b.copy()
    result = library.run(
        n, pointers, len(values), len(order.rows), values.ctypes.data_as(ctypes.c_void_p), x.ctypes.data_as(ctypes.c_void_p)
    )  # fmt: skip
    return result, x


def random(n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.where(rng.uniform(size=(n, n)) < 3 / n, rng.normal(size=(n, n)), 0.0)


@pytest.mark.parametrize("n", [1, 5, 60])
def test_dominant_diagonal_keeps_the_planned_pivots(library, n):
    matrix, b = random(n, n) + 10 * np.eye(n), np.arange(1.0, n + 1)
    other, x = solve(library, matrix, b)
    assert other == 0
    np.testing.assert_allclose(matrix @ x, b, rtol=1e-13, atol=1e-13 * n)


@pytest.mark.parametrize("seed", range(5))
def test_empty_diagonal(library, seed):
    """As of a loop whose equations are in another order than its unknowns."""
    matrix = np.roll(random(30, seed) + 10 * np.eye(30), 1, axis=0)
    b = np.cos(np.arange(30.0))
    _, x = solve(library, matrix, b)
    np.testing.assert_allclose(matrix @ x, b, atol=1e-12)


@pytest.mark.parametrize("pivot", [0.0, 1e-18])
def test_a_vanishing_pivot_is_not_taken(library, pivot):
    matrix = np.array([[1e-300, 2.0, 0.0], [3.0, 1.0, 1.0], [0.0, 1.0, 4.0]])
    b = np.array([1.0, 2.0, 3.0])
    other, _ = solve(library, np.where(matrix == 1e-300, pivot or 1e-320, matrix), b)
    assert other == 1
    exact = np.where(matrix == 1e-300, pivot, matrix)
    np.testing.assert_allclose(solve(library, matrix, b)[1], np.linalg.solve(exact, b), rtol=1e-14)


def test_units_do_not_matter(library):
    """Rows scaled by powers of ten are no growth."""
    n = 40
    matrix = (random(n, 3) + 10 * np.eye(n)) * 10.0 ** np.random.default_rng(0).integers(-12, 12, n)[:, None]
    b = matrix @ np.ones(n)
    other, x = solve(library, matrix, b)
    assert other == 0
    np.testing.assert_allclose(x, 1.0, rtol=1e-12)


def test_singular(library):
    matrix = np.ones((3, 3))
    assert solve(library, matrix, np.ones(3))[0] == -1


STRAIGHT = """
#include <math.h>
#include "linear.h"
%s
int with_tables(int n, const int *const *t, int nonzeros, int filled, const double *a, double *lu, double *b) {
    double work[2000] = {0};
    Pattern p = {.n = n, .nonzeros = nonzeros, .factors = filled, .start = t[0], .row = t[1], .column = t[2], .place = t[3],
                 .lu_start = t[4], .lu_diagonal = t[5], .lu_row = t[6], .growth = %r};
    Factors f = {lu, 0, work, 0, 0, 0};
    if (factorise(n, 0, &p, a, &f)) return -1;
    if (!f.use_other) solve(n, 0, &p, &f, b);
    free_pivoted(&f.other);
    return f.use_other;
}
int straight(const double *a, double *lu, double *b) {
    const int grown = it_factor(a, lu);
    if (!grown) it_solve(lu, b);
    return grown;
}
"""


@pytest.mark.parametrize("seed", range(3))
def test_straight_code_gives_the_same_bits(tmp_path, seed):
    """It also refuses the same pivots."""
    n = 12
    rng = np.random.default_rng(seed)
    matrix = random(n, seed) + 3 * np.eye(n)
    columns = [np.flatnonzero(matrix[:, j]).tolist() for j in range(n)]
    order = plan(columns)
    assert is_short(order)
    start = np.cumsum([0, *map(len, columns)]).tolist()
    rows = [row for column in columns for row in column]
    code = straight_code("it", start, rows, order)
    (tmp_path / "code.c").write_text(STRAIGHT % (code, GROWTH))
    sources = [str(RUNTIME / f"{name}.c") for name in ("linear", "pivoting")]
    built = tmp_path / "code.so"
    subprocess.run(
        [c_compiler(), *FLAGS, f"-I{RUNTIME}", "-o", built, tmp_path / "code.c", *sources, "-lm"], check=True
    )
    library = ctypes.CDLL(str(built))
    given = [start, rows, order.columns, order.places, order.start, order.diagonal, order.rows]
    tables = [np.array(t, dtype=np.intc) for t in given]
    pointers = (ctypes.c_void_p * 7)(*(t.ctypes.data for t in tables))

    def at(array: np.ndarray) -> ctypes.c_void_p:
        return array.ctypes.data_as(ctypes.c_void_p)

    refused = 0
    for trial in range(40):
        values = np.concatenate([matrix[column, j] for j, column in enumerate(columns)])
        values *= 10.0 ** rng.uniform(-trial / 4, trial / 4, len(values))
        b = rng.normal(size=n)
        solved = []
        for function, first in (
            (library.with_tables, (n, pointers, len(values), len(order.rows))),
            (library.straight, ()),
        ):
            lu, x = np.zeros(len(order.rows)), b.copy()
            solved.append((function(*first, at(values), at(lu), at(x)), lu.tobytes(), x.tobytes()))
        assert solved[0] == solved[1]
        refused += solved[0][0]
    assert 0 < refused < 40
