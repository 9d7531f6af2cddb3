"""C code of a factorisation and a solution without tables: what ``runtime/linear.c`` does, for one small matrix.

The operations are those of the tables, in the same order, so the results are the same to the last bit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from fmu_build.elimination import Elimination

GROWTH = 1e5  # by how much an entry may outgrow the largest of its row: the digits that a solution may lose
_MOST = 600  # entries of the factors and multiplications: beyond that, tables cost the compiler far less

_LARGEST = "static inline double {name}_larger(double b, double a) {{ return fabs(a) > b ? fabs(a) : b; }}"


def is_short(plan: Elimination) -> bool:
    """Return whether straight code for a matrix is short enough to be worth the compiler's time."""
    return len(plan.rows) + plan.multiplications <= _MOST


def straight_code(name: str, start: Sequence[int], rows: Sequence[int], plan: Elimination) -> str:
    """Return the C functions ``NAME_factor(a, lu)``, which is 1 if a pivot will not do, and ``NAME_solve(lu, b)``.

    Parameters
    ----------
    start, rows
        The matrix: column j has entries in ``rows[start[j]:start[j + 1]]``.
    plan
        Order of its elimination.
    """
    factor = [
        _LARGEST.format(name=name),
        f"int {name}_factor(const double* restrict a, double* restrict lu) {{",
        "  int grown = 0;",
    ]
    factor += [*_bounds(name, start, rows, plan), *_factor(start, rows, plan), "  return grown;", "}"]
    solve = [f"void {name}_solve(const double* restrict lu, double* restrict b) {{", *_solve(plan), "}"]
    return "\n".join([*factor, *solve, ""])


def _bounds(name: str, start: Sequence[int], rows: Sequence[int], plan: Elimination) -> Iterator[str]:
    """Yield the largest size that an entry of each row may have."""
    of_place: dict[int, list[int]] = {}
    for k in range(start[-1]):
        of_place.setdefault(plan.places[rows[k]], []).append(k)
    for place in range(len(plan.columns)):
        largest = "0."
        for k in of_place.get(place, []):
            largest = f"{name}_larger({largest}, a[{k}])"
        yield f"  const double b{place} = {GROWTH!r}*{largest};"


def _factor(start: Sequence[int], rows: Sequence[int], plan: Elimination) -> Iterator[str]:
    below = [range(plan.diagonal[k] + 1, plan.start[k + 1]) for k in range(len(plan.columns))]
    for k, column in enumerate(plan.columns):
        given = {plan.places[rows[q]]: q for q in range(start[column], start[column + 1])}
        yield "  {"
        for q in range(plan.start[k], plan.start[k + 1]):
            row = plan.rows[q]
            yield f"    double x{row} = {f'a[{given[row]}]' if row in given else '0.'};"
        for q in range(plan.start[k], plan.diagonal[k]):
            j = plan.rows[q]
            yield f"    lu[{q}] = x{j};"
            yield f"    grown |= !(fabs(x{j}) <= b{j});"
            yield from (f"    x{plan.rows[r]} -= lu[{r}]*x{j};" for r in below[j])
        yield f"    const int usable = fabs(x{k}) <= b{k} && fabs(x{k}) > 0.;"
        yield f"    const double inverse = usable ? 1./x{k} : 0.;"
        yield "    grown |= !usable;"
        yield f"    lu[{plan.diagonal[k]}] = inverse;"
        for r in below[k]:
            yield f"    grown |= !(fabs(x{plan.rows[r]}) <= b{plan.rows[r]});"
            yield f"    lu[{r}] = x{plan.rows[r]}*inverse;"
        yield "  }"


def _solve(plan: Elimination) -> Iterator[str]:
    n = len(plan.columns)
    row_of = {place: row for row, place in enumerate(plan.places)}
    yield from (f"  double y{place} = b[{row_of[place]}];" for place in range(n))
    for k in range(n):
        below = range(plan.diagonal[k] + 1, plan.start[k + 1])
        yield from (f"  y{plan.rows[r]} -= lu[{r}]*y{k};" for r in below)
    for k in reversed(range(n)):
        yield f"  y{k} *= lu[{plan.diagonal[k]}];"
        yield from (f"  y{plan.rows[q]} -= lu[{q}]*y{k};" for q in range(plan.start[k], plan.diagonal[k]))
        yield f"  b[{plan.columns[k]}] = y{k};"
