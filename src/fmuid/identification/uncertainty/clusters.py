"""Standard errors that are robust to what a model misses: the scatter of estimates from run to run.

The residuals of a wrong model depend on what a run does, so autocorrelations within runs do not show by how much
other runs would move the estimate. The scores of whole runs do, repeats included, corrected for the part that each
run itself has in the estimate (CR2 of Bell and McCaffrey, 2002). A campaign of few runs is cut into blocks of time
as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.estimation_problem import Problem

Rows = NDArray[np.intp]
RUNS, BLOCKS = "runs", "blocks of time"
_FEWEST = 2  # runs that a variance from run to run needs
_ENOUGH = 8  # clusters; with fewer runs, blocks of time are looked at as well
_SHORTEST = 30  # samples of a block
_LEVERAGE = 0.95  # share of the information on a direction that one cluster may hold
CHANCE, PLAIN = (
    0.25,
    0.001,
)  # probability that clusters of a complete model scatter more: to use that, to report it


@dataclass(frozen=True, slots=True, eq=False)
class Clustered:
    """Variances (n,) of the estimate from the scatter between clusters, and how they are distributed.

    `degrees` (n,) are those of the t-distribution: one less than the clusters that inform on a parameter, fewer if
    some of them dominate (Satterthwaite). `clusters` is their number, `of` what they are in words, `p_value` the
    probability of a scatter between them as large if the residuals have the given noise (1 if it is unknown).
    """

    variances: FloatArray
    degrees: FloatArray
    clusters: int
    of: str
    p_value: float

    def exceeding(self, variances: FloatArray, chance: float = CHANCE) -> NDArray[np.bool_]:
        """Return (n,) whether the variance is larger than another; complete models reach that by `chance`."""
        from scipy.special import chdtri

        return np.asarray(self.variances > variances * chdtri(self.degrees, chance) / self.degrees)

    def wider_than(self, variances: FloatArray, degrees: FloatArray) -> NDArray[np.bool_]:
        """Return (n,) whether its interval is wider than that of other variances and degrees of freedom."""
        from scipy.special import stdtrit

        return np.asarray(
            stdtrit(self.degrees, 0.975) ** 2 * self.variances > stdtrit(degrees, 0.975) ** 2 * variances
        )


@dataclass(frozen=True, slots=True, eq=False)
class Apart:
    """Residuals (m,) without the moves of each run, and how many parameters the runs have moved together."""

    residuals: FloatArray
    removed: int


def without_moves(problem: Problem, residuals: FloatArray, j: FloatArray) -> Apart:
    """Return the (m,) residuals after every run has moved the parameters of the Jacobian on its own."""
    left, removed = residuals.copy(), 0
    for rows in _rows(problem, 1):
        move, _, rank, _ = np.linalg.lstsq(j[rows], residuals[rows], rcond=1e-7)
        left[rows] -= j[rows] @ move
        removed += int(rank)
    return Apart(left, removed)


def information_of_runs(problem: Problem, j: FloatArray) -> FloatArray:
    """Return the (runs, n) share of each run in the information on each parameter, from the Jacobian (m, n)."""
    nothing = np.zeros(len(j))
    parts = [np.sum(part.jacobian**2, axis=0) for part in _runs(problem, nothing, j, nothing)]
    return np.asarray(np.array(parts) / np.maximum(np.sum(parts, axis=0), np.finfo(float).tiny))


def clustered(
    problem: Problem, residuals: FloatArray, j: FloatArray, noise: FloatArray, memory: int | None
) -> list[Clustered]:
    """Return the variances between runs, and between blocks of time if there are few runs.

    Parameters
    ----------
    residuals, j
        Residuals (m,) at the estimate and their Jacobian (m, n).
    noise
        (m,) standard deviations of the residuals, 0 where they are unknown.
    memory
        Samples over which residuals are correlated; None if they are white, so that blocks of time show no more.
    """
    runs = _runs(problem, residuals, j, noise)
    clusterings = [_between(runs, RUNS)] if len(runs) >= _FEWEST else []
    if len(runs) < _ENOUGH and memory is not None:
        longest = min(len(case.time) for case in problem.cases)
        parts = min(-(-_ENOUGH // len(runs)), longest // max(_SHORTEST, 2 * memory))
        if parts > 1 and len(runs) * parts >= _FEWEST:
            blocks = [_Part(residuals[rows], j[rows], noise[rows]) for rows in _rows(problem, parts)]
            clusterings.append(_between(blocks, BLOCKS))
    return clusterings


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Residuals (m,) of one cluster, their Jacobian (m, n), and their standard deviations, 0 if unknown."""

    residuals: FloatArray
    jacobian: FloatArray
    noise: FloatArray


def _runs(problem: Problem, residuals: FloatArray, j: FloatArray, noise: FloatArray) -> list[_Part]:
    """Return the parts of the runs; those of repeats add up to their case's."""
    parts: list[_Part] = []
    for case in problem.cases:
        of_case = [k for k, (owner, _) in enumerate(problem.criteria) if owner is case]
        channels = {c.signal: c for c in case.channels}
        repeats: list[list[_Part]] = [[] for _ in case.channels[0].repeats]
        if not all(problem.criteria[k][1].affine and problem.criteria[k][1].rows is not None for k in of_case):
            repeats = [[]]
        for k in of_case:
            rows, criterion = problem.slices[k], problem.criteria[k][1]
            whole, channel = _Part(residuals[rows], j[rows], noise[rows]), channels[criterion.signal]
            if criterion.rows is None or len(repeats) == 1:
                repeats[0].append(whole)
                continue
            root = np.sqrt(channel.count[criterion.rows])
            for y, of_repeat in zip(channel.repeats, repeats, strict=True):
                there = np.isfinite(y[criterion.rows])
                reading = criterion.residuals(np.where(np.isfinite(y), y, channel.mean))
                left = (whole.residuals - problem.root_weights[k] * reading) / root
                of_repeat.append(_Part(left[there], (whole.jacobian / root[:, None])[there], whole.noise[there]))
        parts += [_joined(of_repeat) for of_repeat in repeats if of_repeat]
    return parts


def _joined(parts: Sequence[_Part]) -> _Part:
    return _Part(
        np.concatenate([p.residuals for p in parts]),
        np.concatenate([p.jacobian for p in parts]),
        np.concatenate([p.noise for p in parts]),
    )


def _rows(problem: Problem, parts: int) -> list[Rows]:
    """Return the residuals of every case, in `parts` equal spans of time; features belong to the first."""
    groups: dict[tuple[str, int], list[Rows]] = {}
    for (case, criterion), place in zip(problem.criteria, problem.slices, strict=True):
        numbers = np.arange(place.start, place.stop)
        at = np.zeros(len(numbers)) if criterion.rows is None else criterion.rows / len(case.time)
        for part in range(parts):
            inside = (at * parts).astype(int) == part
            groups.setdefault((case.id, part), []).append(numbers[inside])
    whole = [np.concatenate(rows) for rows in groups.values()]
    return [rows for rows in whole if len(rows)]


def whitening(information: FloatArray) -> FloatArray:
    """Return R (n, n), so that J R has orthonormal columns, of the `information` J' J of a Jacobian."""
    values, vectors = np.linalg.eigh(information)
    return np.asarray(vectors / np.sqrt(np.maximum(values, 1e-14 * values[-1])))


def _between(groups: Sequence[_Part], of: str) -> Clustered:
    from scipy.special import chdtrc

    count, n = len(groups), groups[0].jacobian.shape[1]
    root = whitening(np.sum([g.jacobian.T @ g.jacobian for g in groups], axis=0))
    moves, expected, pull = np.zeros((count, n)), np.zeros((count, n)), np.zeros((count, n, n))
    score, rank = 0.0, 0
    for k, group in enumerate(groups):
        part = group.jacobian @ root
        shares, axes = np.linalg.eigh(part.T @ part)
        shares = np.clip(shares, 0.0, 1.0)
        scores, turned, axes = axes.T @ (part.T @ group.residuals), axes, root @ axes
        weights = 1.0 / np.sqrt(1.0 - np.minimum(shares, _LEVERAGE))
        moves[k] = axes @ (scores * weights)
        expected[k] = axes**2 @ shares
        pull[k] = (axes * (shares * weights)) @ turned.T
        seen = shares > 1e-9
        level = np.mean(group.noise**2)
        if level > 0.0:
            score += float(np.sum(scores[seen] ** 2 / shares[seen])) / float(level)
            rank += int(np.sum(seen))
    spare = rank - n
    return Clustered(
        np.sum(moves**2, axis=0),
        np.clip(_degrees(expected, pull), 1.0, count - 1.0),
        count,
        of,
        float(chdtrc(spare, score)) if spare > 0 else 1.0,
    )


def _degrees(expected: FloatArray, pull: FloatArray) -> FloatArray:
    """Return the (n,) degrees of freedom by which the clusters' moves scatter, for residuals that are white.

    The moves (K, n) have the variances `expected`, (K, n), and are correlated because each cluster pulls the
    estimate, by `pull` (K, n, n), from where the others would have it (Satterthwaite's approximation).
    """
    products = np.einsum("kni,lni->nkl", pull, pull)
    count = np.arange(len(expected))
    products[:, count, count] = expected.T
    return np.asarray(np.sum(expected, axis=0) ** 2 / np.sum(products**2, axis=(1, 2)))
