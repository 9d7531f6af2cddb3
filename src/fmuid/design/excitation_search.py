"""The search for an excitation: a few from every family, then derivative-free improvement of the best."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fmuid.core.errors import FmuidError
from fmuid.core.immutable import FloatArray
from fmuid.design.excitation import Signals
from fmuid.identification.solvers.nlopt_solver import minimised

_BARRIER = 1e3  # exceeds every cost of a run within limits
_FIRST = 0.4  # share of the evaluations for the first few of every family
_SHRUNK = 0.5  # factor on the size of a run that exceeds its limits, for the next trial
_STEP = 0.15  # initial step of the local search


@dataclass(frozen=True, slots=True)
class Judged:
    """The evaluation of one excitation.

    Attributes
    ----------
    cost
        Cost; lower is better.
    violation
        Violation of the limits as a share of their range; 0 within the limits, infinite if the run cannot be
        simulated.
    worst
        The limit with the largest violation.
    """

    cost: float
    violation: float = 0.0
    worst: str = ""

    @property
    def total(self) -> float:
        """One number for comparison: every run within the limits ranks before any run outside them."""
        return self.cost if self.violation <= 0.0 else _BARRIER * (1.0 + min(self.violation, 1e6))


@dataclass(frozen=True, slots=True, eq=False)
class Excitation:
    """An excitation: (inputs, N) samples, their evaluation, a description, and the evaluations of its search."""

    samples: FloatArray
    judged: Judged
    description: str
    evaluations: int
    interrupted: bool = False


def search(
    shapes: Sequence[Signals],
    time: FloatArray,
    judge: Callable[[FloatArray], Judged],
    *,
    evaluations: int,
    seed: int = 0,
    say: Callable[[float], None] = lambda _: None,
) -> list[Excitation]:
    """Return the excitation of least cost of every family, best first, if it stays within every limit.

    Every family starts from the same number of points of a Sobol' sequence; an excitation that violates a limit is
    scaled down. Subplex improves the best of each family, then the best of all. If interrupted, the search returns
    the best excitations so far.

    Parameters
    ----------
    judge
        Judges (inputs, N) samples.
    evaluations
        Number of calls of `judge`.
    say
        Called with the fraction done (0 to 1).

    Raises
    ------
    FmuidError
        None of the excitations tried stays within every limit.
    """
    tried: list[tuple[Judged, int, FloatArray]] = []

    def cost(k: int, x: FloatArray) -> float:
        judged = judge(shapes[k](x, time))
        tried.append((judged, k, np.array(x)))
        say(len(tried) / evaluations)
        return judged.total

    def better(k: int, count: int) -> None:
        start = min((t for t in tried if t[1] == k), key=lambda t: t[0].total)[2]
        if count > 0:
            minimised(lambda x: cost(k, x), start, step=_STEP, evaluations=count)

    interrupted = False
    try:
        each = max(2, int(_FIRST * evaluations / len(shapes)))
        for k, shape in enumerate(shapes):
            _begin(shape, each, seed, lambda x, k=k: cost(k, x))  # type: ignore[misc]
        # A few points say little about a family: the best of each is improved for a while, then the best of all.
        every = (evaluations - len(tried)) // (2 * len(shapes))
        for k in range(len(shapes)):
            better(k, every)
        better(min(tried, key=lambda t: t[0].total)[1], evaluations - len(tried))
    except KeyboardInterrupt:
        interrupted = True
        if not tried or min(j.total for j, _, _ in tried) >= _BARRIER:
            raise
    least = {k: min((t for t in tried if t[1] == k), key=lambda t: t[0].total) for k in {k for _, k, _ in tried}}
    best = sorted(least.values(), key=lambda t: t[0].total)
    if (judged := best[0][0]).violation > 0.0:
        reason = f"each one exceeds {judged.worst}" if np.isfinite(judged.violation) else "none could be simulated"
        raise FmuidError(
            f"none of {len(tried)} excitations stays within every limit: {reason}",
            where="[limits]",
            fix="widen it, or shorten the run",
        )
    return [
        Excitation(shapes[k](x, time), judged, shapes[k].words(x, time), len(tried), interrupted)
        for judged, k, x in best
        if judged.violation <= 0.0
    ]


def _begin(shape: Signals, count: int, seed: int, cost: Callable[[FloatArray], float]) -> None:
    """Try `count` points of a Sobol' sequence; one that exceeds a limit is tried again at smaller sizes."""
    from scipy.stats import qmc  # takes a second to import

    points = qmc.Sobol(shape.size, rng=seed).random_base2(max(1, int(np.ceil(np.log2(count)))))
    sizes = np.arange(0, shape.size, shape.size // len(shape.bounds))
    points[:, sizes] = 1.0 - 0.3 * points[:, sizes]  # information grows with size
    left = count
    for point in points:
        shrunk = 0
        while left > 0:
            left -= 1
            if cost(point) < _BARRIER or shrunk == 4:
                break
            shrunk += 1
            point = np.where(np.isin(np.arange(shape.size), sizes), _SHRUNK * point, point)
