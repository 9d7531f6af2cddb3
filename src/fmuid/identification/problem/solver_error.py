"""Solver tolerances that keep the errors of a model below the noise of its measurements.

An integrator's tolerance bounds its error in one step, not the error of a prediction. The tolerance is therefore
tightened until all samples of a run together change by less than `UNSEEN` standard deviations of their noise. No
test, cost or standard error can then differ by more than that. If a prediction keeps changing however tight the
tolerance is (chaos, or stick-slip at its limit), the run cannot be predicted from that time on, and its later
samples are excluded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fmuid.core.errors import ProblemError, SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.cases import Case
from fmuid.simulation.pool.parcels import name_of
from fmuid.simulation.runners import Outcome, Runner
from fmuid.simulation.simulator import Task

UNSEEN = 0.2
_TIGHTEST = 1e-10
_SAME = 1e-9  # relative difference of two equal simulations that is rounding
_SHRINKING = 0.25  # a tenth of the tolerance should leave less than this share of the previous change


@dataclass(frozen=True, slots=True)
class SolverAccuracy:
    """Solver tolerances that the cases need.

    Parameters
    ----------
    tolerances
        Tolerances by case; other cases use their model's default tolerance.
    until
        By case, the time (s) from which its prediction does not converge.
    """

    tolerances: Mapping[str, float] = field(default_factory=dict)
    until: Mapping[str, float] = field(default_factory=dict)

    def applied(self, cases: Sequence[Case]) -> tuple[Case, ...]:
        """Return the cases with these tolerances."""
        return tuple(
            replace(c, task=replace(c.task, tolerance=self.tolerances[c.id])) if c.id in self.tolerances else c
            for c in cases
        )

    @property
    def findings(self) -> tuple[str, ...]:
        """Findings for the user."""
        return tuple(
            f"'{case}' cannot be predicted from {time:.6g} s on and is left out from there: "
            "the prediction changes however tight the solver's tolerance is"
            for case, time in self.until.items()
        )


def check_repeatable(
    cases: Sequence[Case],
    starts: Sequence[Mapping[str, float]],
    runner: Runner,
    sigma: Sequence[FloatArray] | None = None,
) -> None:
    """Simulate one case of every model twice; the other arguments are those of `solver_accuracy`.

    Raises
    ------
    ProblemError
        The two simulations differ by more than the noise: the model draws random numbers, or keeps a state.
    """
    first = {id(case.simulator): k for k, case in reversed(list(enumerate(cases)))}
    jobs = [(cases[k].simulator, cases[k].task, starts[k]) for k in first.values() for _ in range(2)]
    outcomes = runner(jobs)
    for k, one, two in zip(first.values(), outcomes[::2], outcomes[1::2], strict=True):
        if isinstance(one, SimulationError) or isinstance(two, SimulationError):
            continue
        case, apart = cases[k], np.abs(np.asarray(one) - np.asarray(two))[:, cases[k].lead :]
        size = np.maximum(np.max(np.abs(np.asarray(one)), axis=1), np.finfo(float).tiny)
        if (
            np.all(apart <= _SAME * size[:, None])
            or _moved(case, apart, None if sigma is None else sigma[k])[-1] < UNSEEN
        ):
            continue
        worst = int(np.argmax(np.max(apart, axis=1) / size))
        raise ProblemError(
            f"two equal simulations differ in {case.channels[worst].variable} by up to {np.max(apart[worst]):.3g}"
            ": the model draws random numbers, or keeps a state from one run to the next",
            where=f"{name_of(case.simulator)}, experiment '{case.id}'",
            fix="fix the seed of its random numbers, or remove its noise",
        )


def solver_accuracy(
    cases: Sequence[Case],
    values: Mapping[str, float],
    starts: Sequence[Mapping[str, float]],
    runner: Runner,
    *,
    sigma: Sequence[FloatArray] | None = None,
    loosest: Sequence[float] = (),
) -> SolverAccuracy:
    """Find for each case the loosest tolerance whose error stays below the measurement noise.

    Parameters
    ----------
    values, starts
        The point to evaluate: parameters by name, and the start values that each case sets on its model.
    sigma
        (C,) standard deviations of the means that the predictions of each case are compared with, if not those of
        its channels.
    loosest
        Tolerances to try, largest first; by default the case's own tolerance, which is then only tightened. A case
        that cannot be simulated keeps its own tolerance.

    Raises
    ------
    ProblemError
        Two equal simulations of a model differ (`check_repeatable`).
    """
    check_repeatable(cases, starts, runner, sigma)

    def sensed(wanted: Sequence[tuple[int, Task]]) -> list[Outcome]:
        outcomes = runner([(cases[k].simulator, task, starts[k]) for k, task in wanted])
        return [
            o if isinstance(o, SimulationError) else cases[k].sensed(np.asarray(o), values)
            for (k, _), o in zip(wanted, outcomes, strict=True)
        ]

    return accuracy(cases, sensed, sigma=sigma, loosest=loosest)


def accuracy(
    cases: Sequence[Case],
    sensed: Callable[[Sequence[tuple[int, Task]]], Sequence[Outcome]],
    *,
    sigma: Sequence[FloatArray] | None = None,
    loosest: Sequence[float] = (),
) -> SolverAccuracy:
    """Do the same for any predictions: `sensed` returns those of the channels of a case by its number and task."""
    pending = {k: [*loosest] for k, c in enumerate(cases) if c.simulator.default_tolerance is not None}
    for k, ladder in pending.items():
        given = cases[k].task.tolerance
        tighter = loosest[-1] if loosest else given or cases[k].simulator.default_tolerance or 0.0
        ladder += [] if loosest else [given or 0.0]
        while tighter > 1.001 * _TIGHTEST:
            tighter = max(0.1 * tighter, _TIGHTEST)
            ladder.append(tighter)
    tolerances: dict[str, float] = {}
    until: dict[str, float] = {}
    before: dict[int, Outcome] = {}
    moves: dict[int, FloatArray] = {}
    level = 0
    while pending:
        wanted = [(k, replace(cases[k].task, tolerance=ladder[level] or None)) for k, ladder in pending.items()]
        for k, outcome in zip(list(pending), sensed(wanted), strict=True):
            looser, before[k] = before.get(k), outcome
            case, ladder = cases[k], pending[k]
            ended = level == len(ladder) - 1
            if looser is not None and not isinstance(looser, SimulationError):
                if isinstance(outcome, SimulationError):  # no tighter tolerance is possible
                    chosen, ended = ladder[level - 1], True
                else:
                    moved = _moved(case, looser - outcome, None if sigma is None else sigma[k])
                    settled = moved[-1] < UNSEEN
                    chosen, ended = ladder[level - 1] if settled else ladder[level], ended or settled
                    astray = (moved >= UNSEEN) & (moved >= _SHRINKING * moves.get(k, np.zeros(1)))
                    if ended and astray.any():
                        until[case.id] = float(case.time[int(np.argmax(astray))])
                    moves[k] = moved
                if ended and chosen:
                    tolerances[case.id] = chosen
            if ended:
                del pending[k]
        level += 1
    return SolverAccuracy(tolerances, until)


def _moved(case: Case, difference: FloatArray, sigma: FloatArray | None) -> FloatArray:
    """Return (N,) the number of standard deviations by which two predictions differ up to each sample."""
    total = np.zeros(len(case.time))
    for k, (channel, row) in enumerate(zip(case.channels, difference, strict=True)):
        there = channel.count > 0
        noise = channel.noise.of_mean(channel.count[there]) if sigma is None else sigma[k]
        total[there] += (row[there] / noise) ** 2
    return np.asarray(np.sqrt(np.cumsum(total)))
