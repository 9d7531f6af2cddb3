"""Refits over growing horizons: of the beginning of every run first, then of more of it.

Without feedback, a model drifts away from its plant, and where it is far off, the slopes of the cost mislead: over
a whole run the cost has many minima, over its beginning only few. (Ribeiro, Tiels, Umenberger, Schon and Aguirre:
On the smoothness of nonlinear system identification. Automatica 121, 2020.)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

from fmuid.core.errors import SimulationError
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.refit import about, descend
from fmuid.diagnosis.subject import Subject
from fmuid.effects.effect import Unknown
from fmuid.identification.problem.cases import Case

_SHARES = (1 / 8, 1 / 4, 1 / 2)  # of every run
_EARLY = _SHARES[1]  # of a run, over which effects are first compared
_SHORTEST = 64  # samples in a beginning: a spectrum needs as many
_ITERATIONS = 6  # for each horizon: the next one continues
_KEPT = 3  # starts that go on to the next horizon


def approached(
    subject: Subject,
    unknowns: Sequence[Unknown],
    start: Mapping[str, float],
    trials: Sequence[Mapping[str, float]],
) -> Mapping[str, float] | None:
    """Return the point that refits of the runs' beginnings lead to from a start with the best of several trials.

    A short beginning determines little, so trials are made again from where it leads to.

    None where runs are predicted in segments, which do not drift away, or are too short to be divided, or where no
    start can be simulated.
    """
    shares = _shares(subject)
    starts: list[Mapping[str, float]] = [start]
    for share in shares:
        part = beginning(subject, share)
        starts = [*starts, *({**starts[0], **trial} for trial in trials)]
        found = sorted(_ends(part, unknowns, starts), key=lambda end: end[0])
        starts = [values for cost, values in found if cost <= about(found[0][0])][:_KEPT]
        if not starts:
            return None
    return starts[0] if shares else None


def early(subject: Subject) -> Subject | None:
    """Return the subject with only an early part of every run; None if runs cannot be shortened."""
    return beginning(subject, _EARLY) if _EARLY in _shares(subject) else None


def _shares(subject: Subject) -> tuple[float, ...]:
    """Return the shares of every run that are beginnings of it: none where runs are predicted in segments."""
    shortest = min(len(case.time) for case in subject.model.cases)
    return () if subject.observed.nuisances else tuple(s for s in _SHARES if shortest * s >= _SHORTEST)


def beginning(subject: Subject, share: float) -> Subject:
    """Return the subject with no more than the first share of every run, and the same noise."""
    model = replace(subject.model, cases=tuple(_beginning(case, share) for case in subject.model.cases))
    noise = {setup: replace(n, pieces=1) for setup, n in subject.observed.noise.items()}
    return replace(subject, model=model, observed=Observed(model.runs, noise))


def _beginning(case: Case, share: float) -> Case:
    end = case.lead + round(share * len(case.time))
    task = replace(
        case.task, time=case.task.time[:end], inputs={name: u[:end] for name, u in case.task.inputs.items()}
    )
    channels = tuple(replace(c, repeats=c.repeats[:, : end - case.lead]) for c in case.channels)
    return replace(case, task=task, channels=channels, criteria=())


def _ends(
    part: Subject, unknowns: Sequence[Unknown], starts: Sequence[Mapping[str, float]]
) -> Iterator[tuple[float, Mapping[str, float]]]:
    """Yield the cost and the values where searches from the `starts` end, without those that cannot begin."""
    model = part.model
    for start in starts:
        with suppress(SimulationError):
            yield descend(
                model.predict, part.observed, unknowns, start, tangents=model.tangents, max_iterations=_ITERATIONS
            )
