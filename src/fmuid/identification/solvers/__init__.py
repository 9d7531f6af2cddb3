"""Solvers with a common signature; `make` finds one by name, `choose` by the structure of the problem.

Names: ``trf``, ``lm``, ``dfols`` (least squares); ``nelder_mead``, ``sbplx``, ``cobyla``, ``bobyqa``,
``newuoa_bound``, ``praxis``, ``pattern_search``, ``lbfgs``, ``slsqp`` (local); ``crs2``, ``isres``, ``direct``,
``direct_l``, ``esch``, ``mlsl``, ``ags`` (global). ``"crs2 > bobyqa"`` is a chain; the option ``starts = 8`` makes
a multistart.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fmu_build.suggest import suggestion
from fmuid.core.errors import ProblemError
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.solvers.compound import Chain, Lexicographic, MultiStart
from fmuid.identification.solvers.least_squares import DfoLs, TrustRegion
from fmuid.identification.solvers.nlopt_solver import _ALIASES, ALGORITHMS, NloptSolver
from fmuid.identification.solvers.pattern_search import PatternSearch
from fmuid.identification.solvers.search import (
    Outcome,
    Search,
    Solver,
    Start,
    Status,
    StopRules,
    StopSearch,
    number_of,
)
from fmuid.identification.solvers.verified import Verified

__all__ = [
    "NAMES",
    "Outcome",
    "Search",
    "Solver",
    "Start",
    "Status",
    "StopRules",
    "StopSearch",
    "choose",
    "make",
]

NAMES = ("auto", "trf", "lm", "dfols", "pattern_search", *ALGORITHMS)


def make(name: str, options: Mapping[str, Any], problem: Problem) -> tuple[Solver, str]:
    """Return the solver for `name` and `options`, and the reason for the choice.

    Raises
    ------
    ProblemError
        The name or an option is unknown, or the solver cannot handle the problem.
    """
    options = dict(options)
    starts, seed = options.pop("starts", 1), options.pop("seed", 0)  # the latter is the search's
    for key, value, least in (("starts", starts, 1), ("seed", seed, 0)):
        if not isinstance(value, int) or value < least:
            raise ProblemError(
                f"solver option {key} is {value!r}", fix=f"write a whole number of at least {least}"
            )
    why = "requested"
    if name == "auto":
        name, why = choose(problem)
    links = [part.strip() for part in name.split(">")]
    if len(links) == 1:
        solver = _single(links[0], options)
    else:
        # In a chain, options = { crs2 = { evaluations = 500 }, ... } hold the options of each link.
        solver = Chain(tuple(_single(link, _of_link(link, options.pop(link, {}))) for link in links))
        if options:
            raise ProblemError(
                f"unknown solver option '{next(iter(options))}'",
                fix=f"in a chain, write {links[0]} = {{ ... }}",
            )
    local = _local(solver, problem)
    solver = Verified(MultiStart(solver, starts) if starts > 1 else solver, local, local is not solver)
    if problem.combination.kind == "lexicographic":
        solver = Lexicographic(solver)
    solver.check(problem)
    return solver, why


def choose(problem: Problem) -> tuple[str, str]:
    """Return the name of the solver for the problem's structure, and the reason in words."""
    n = len(problem.space)
    free = f"{n} parameter{'s' if n > 1 else ''}"
    if problem.smooth:
        return "trf", f"smooth sum of squares over {free}: least squares uses its structure"
    if problem.constraints or problem.combination.kind in ("min_max", "lexicographic"):
        return "cobyla", "constraints or a worst-case criterion: COBYLA models each of them"
    if all(criterion.smooth for _, criterion in problem.criteria) and n > 1:
        return "bobyqa", f"smooth cost of {free} that is not a sum of squares: quadratic models"
    return "sbplx", "non-smooth criteria: a simplex search needs no derivatives"


def _local(solver: Solver, problem: Problem) -> Solver:
    """Return the local solver that continues from where `solver` ended: itself, unless it is a global one."""
    if not isinstance(solver, NloptSolver) or "evaluations" in solver.options:
        return solver
    if not ALGORITHMS[solver.name].finite_bounds:
        return solver
    if problem.constraints or problem.combination.kind in ("min_max", "lexicographic"):
        return NloptSolver("cobyla")
    return NloptSolver("bobyqa" if len(problem.space) > 1 and problem.smooth else "sbplx")


def _of_link(link: str, options: Any) -> dict[str, Any]:
    if not isinstance(options, Mapping):
        raise ProblemError(f"options of '{link}' are {options!r}", fix=f"in a chain, write {link} = {{ ... }}")
    return dict(options)


def _single(name: str, options: dict[str, Any]) -> Solver:
    match name:
        case "trf" | "lm" | "least_squares":
            tolerance = number_of(options, "tolerance", 1e-10, solver=name)
            if unknown := options.keys() - {"tolerance"}:
                raise ProblemError(f"solver '{name}' has no option '{min(unknown)}'", fix="it has: tolerance")
            return TrustRegion("lm" if name == "lm" else "trf", tolerance)
        case "dfols":
            return DfoLs(options)
        case "pattern_search":
            return PatternSearch(options)
    if name in ALGORITHMS or name in _ALIASES:
        return NloptSolver(name, options)
    raise ProblemError(f"unknown solver '{name}'", fix=suggestion(name, NAMES))
