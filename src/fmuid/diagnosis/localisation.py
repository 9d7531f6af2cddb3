"""Where a gap is: in which signals and regimes, at which ports it enters, and between which machines.

Where it enters. Whatever a hidden effect depends on, to the model it is a flow that acts somewhere over time, or a
sensor's error. A Gaussian process is put on that course at one port after the other. The port whose responses
explain what the model leaves with the smallest and smoothest course has the largest marginal likelihood (latent
force models: Alvarez, Luengo and Lawrence 2009).

Machines. The effects of the answer and the nominal parameters are refitted to the runs of each machine separately,
even if they are shared in the diagnosis; the estimates are then compared given their standard errors (Cochran's
test).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from fmuid.core.campaign import SEPARATOR, without_owner
from fmuid.core.immutable import FloatArray, read_only
from fmuid.diagnosis.candidates import Fitted, estimates, fit_effects
from fmuid.diagnosis.decide import OPEN, log_evidence, spread
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.free_functions import hats, moved_by
from fmuid.diagnosis.observed import Observed, excesses
from fmuid.diagnosis.refit import Refit
from fmuid.diagnosis.scores import nominal_basis
from fmuid.diagnosis.subject import Subject
from fmuid.diagnosis.verdict import BetweenMachines, Estimate, MachineParameter, Share
from fmuid.effects.effect import Port
from fmuid.identification.uncertainty.between_machines import machine_spread

_BINS = 6  # of a variable: enough to see where a gap lies, each with many samples
_SHOWN = 0.01  # share of the gap that is worth a row
_PROMINENT = 1 / 3  # of a row's energy: by how much a regime's share of it exceeds that of the samples


@dataclass(frozen=True, slots=True)
class Beyond:
    """Where a law acts: a regime's variable, and the threshold beyond which it does, on `either_side` of zero."""

    variable: str
    threshold: float
    either_side: bool


@dataclass(frozen=True, slots=True, eq=False)
class ExcessMap:
    """Excess energy of every experiment and signal, binned over regimes.

    Attributes
    ----------
    rows
        (experiment, signal) pairs.
    energy
        (rows,) excess energy in squared sigmas, never below 0.
    edges
        Regime variable -> (B + 1,) bin edges.
    binned
        Regime variable -> (rows, B) share of the row's energy.
    spent
        Regime variable -> (rows, B) share of the row's samples.
    """

    rows: tuple[tuple[str, str], ...]
    energy: FloatArray
    edges: Mapping[str, FloatArray]
    binned: Mapping[str, FloatArray]
    spent: Mapping[str, FloatArray]

    def shares(self, limit: int = 8, *, beyond: Beyond | None = None) -> tuple[Share, ...]:
        """Return the largest shares, each with the regime `beyond` a threshold or the most prominent one."""
        total = float(self.energy.sum())
        if total <= 0.0:
            return ()
        shares = []
        for row in np.argsort(-self.energy)[:limit]:
            share = float(self.energy[row]) / total
            if share < _SHOWN:
                break
            experiment, signal = self.rows[row]
            regime = self._prominent(int(row)) if beyond is None else self._beyond(int(row), beyond)
            shares.append(Share(experiment, signal, share, regime))
        return tuple(shares)

    def _prominent(self, row: int) -> tuple[str, float, float] | None:
        """Return the range that has most more of the row's energy than of its samples (Kuiper's statistic)."""
        most, regime = _PROMINENT, None
        for name, table in self.binned.items():
            ahead = np.cumsum([0.0, *(table[row] - self.spent[name][row])])
            more = np.triu(ahead - ahead[:, None])  # between two edges
            begin, end = np.unravel_index(int(np.argmax(more)), more.shape)
            if more[begin, end] > most:
                most = float(more[begin, end])
                regime = name, float(self.edges[name][begin]), float(self.edges[name][end])
        return regime

    def _beyond(self, row: int, beyond: Beyond) -> tuple[str, float, float]:
        """Return the range beyond a threshold, on the side where most of the row's energy is."""
        edges, energy = self.edges[beyond.variable], self.binned[beyond.variable][row]
        negative = float(energy[edges[1:] <= 0.0].sum()) > float(energy[edges[:-1] >= 0.0].sum())
        if beyond.either_side and negative:
            return beyond.variable, float(edges[0]), -beyond.threshold
        return beyond.variable, beyond.threshold, float(edges[-1])


def excess_map(
    observed: Observed, predictions: Sequence[FloatArray], regimes: Mapping[str, Sequence[FloatArray]]
) -> ExcessMap:
    """Bin the excess energy of predictions.

    Parameters
    ----------
    predictions
        (C, N) per experiment.
    regimes
        Variable -> (N,) samples per experiment: speed, load torque, time and so on.
    """
    whitened, taken = observed.residuals(predictions), observed.taken
    edges = {name: _edges(values) for name, values in regimes.items()}
    rows, energy = [], []
    binned: dict[str, list[FloatArray]] = {name: [] for name in regimes}
    spent: dict[str, list[FloatArray]] = {name: [] for name in regimes}
    for e, (run, prediction, z) in enumerate(zip(observed.runs, predictions, whitened, strict=True)):
        by_channel = z.reshape(len(run.channels), -1)
        for c, channel in enumerate(run.channels):
            n = float(np.sum(1.0 - taken[e].reshape(len(run.channels), -1)[c]))
            rows.append((run.id, channel))
            energy.append(max(0.0, float(by_channel[c] @ by_channel[c]) - n / run.n_repeats))
            raw = ((prediction[c] - run.mean[c]) * run.mask[c]) ** 2
            for name, values in regimes.items():
                index = np.clip(np.searchsorted(edges[name], values[e], side="right") - 1, 0, len(edges[name]) - 2)
                for table, weights in ((binned, raw), (spent, run.mask[c].astype(float))):
                    part = np.bincount(index, weights=weights, minlength=len(edges[name]) - 1)
                    table[name].append(part / max(float(part.sum()), 1e-300))
    return ExcessMap(
        tuple(rows),
        read_only(energy),
        {n: read_only(v) for n, v in edges.items()},
        *({n: read_only(np.array(v)) for n, v in table.items()} for table in (binned, spent)),
    )


def _edges(values: Sequence[FloatArray]) -> FloatArray:
    low = min(float(v.min()) for v in values)
    high = max(float(v.max()) for v in values)
    return np.linspace(low, high if high > low else low + 1.0, _BINS + 1)


_KNOTS = (24, 70)  # of a course in each experiment; the finer ones if the coarser ones leave too much
_ENOUGH = 0.75  # share of the excess energy that a course has to explain for its port to be judged by it
_ALL = 0.95  # of that energy: a single place accounts for nearly all
_LENGTHS = (0.0, 1.0, 3.0)  # knots over which a course may be smooth
_SIZES = np.geomspace(1e-4, 1e4, 33)  # standard deviation of a course, in units of the port's magnitude


@dataclass(frozen=True, slots=True)
class Entry:
    """What a course over time at a port explains.

    Attributes
    ----------
    evidence
        Logarithm of the marginal likelihood ratio of a course at its best size and smoothness to none.
    step
        Logarithm of the likelihood ratio that a linear step of the nominal parameters gains without a course:
        above 0 if they are at bounds, or not quite at the optimum.
    left
        Remaining energy beyond that of the noise, relative to it.
    explained
        Share of that energy which the course explains.
    """

    evidence: float
    step: float
    left: float
    explained: float

    @property
    def closure(self) -> float:
        """Share of the gap that the course closes."""
        return 1.0 - float(np.sqrt(1.0 - self.explained))


def places(entered: Mapping[str, Entry]) -> tuple[str, ...]:
    """Return the ports at which a course explains what a model leaves, the likeliest first.

    Named are those that the data cannot tell from the likeliest one, because the odds against them are short. None
    is named if no course explains anything.
    """
    order = sorted(entered, key=lambda name: -entered[name].evidence)
    if not order or entered[order[0]].evidence <= np.log(OPEN):
        return ()
    best = entered[order[0]]
    return tuple(name for name in order if not _beaten(entered[name].evidence, best))


def likelier(entered: Mapping[str, Entry], nominal: Fitted, named: Fitted) -> bool:
    """Return whether a course at one port explains what `nominal` leaves far better than `named` does.

    It has to account for nearly all of it: a course at the place of one cause imitates a part of another one.
    """
    best = max(entered.values(), key=lambda e: e.evidence, default=None)
    if best is None or best.explained < _ALL:
        return False
    return _beaten(log_evidence(nominal, named) - best.step, best)  # both with the nominal parameters fitted


def _beaten(evidence: float, best: Entry) -> bool:
    """Return whether the odds of `best` against something with this evidence are long."""
    return best.evidence - evidence >= float(np.log(OPEN)) * spread(best.left) ** 2


def entries(model: CampaignModel, observed: Observed, base: Refit, ports: Sequence[Port]) -> dict[str, Entry]:
    """Return the part of the residuals of `base` that a course over time explains, at every simulated port."""
    coarse, fine = (np.linspace(0.0, 1.0, knots) for knots in _KNOTS)
    entered = with_knots(model, observed, base, ports, coarse)
    if any(e.explained >= _ENOUGH for e in entered.values()):
        return entered
    return with_knots(model, observed, base, ports, fine, among=coarse)


def with_knots(
    model: CampaignModel,
    observed: Observed,
    base: Refit,
    ports: Sequence[Port],
    at: FloatArray,
    *,
    among: FloatArray | None = None,
) -> dict[str, Entry]:
    """Return the explanation by a course with knots `at` shares of a run, at every simulated port.

    If responses to a course with only the knots `among` these are known, they are used again: with those to the
    other knots, they span the same responses (hierarchical basis).
    """
    since = [case.time - case.time[0] for case in model.cases]
    knots, shares = len(at), [t / float(t[-1]) for t in since]
    courses, nodal = hats(shares, at), np.eye(knots)
    if among is not None:
        known = np.abs(at[:, None] - among).min(axis=1) < 1e-9
        courses = (*hats(shares, among), *(c for c, old in zip(courses, known, strict=True) if not old))
        nodal = np.linalg.inv(np.vstack([[h for (h,) in hats([at], among)], nodal[~known]]).T)
    weights = np.sqrt(observed.repeats)
    residuals = [w * r for w, r in zip(weights, base.residuals, strict=True)]
    basis = nominal_basis(base, observed)
    parts = np.split(basis, np.cumsum([len(r) for r in residuals])[:-1])
    fitted = sum((q.T @ r for q, r in zip(parts, residuals, strict=True)), np.zeros(basis.shape[1]))
    step = float(fitted @ fitted)
    energy = float(sum(r @ r for r in residuals)) - step
    count = sum(len(r) for r in residuals) - basis.shape[1]
    entries_of = {}
    for port in ports:
        moved = [m for m in moved_by(model, observed, base, port, courses) if m is not None]
        if len(moved) < knots:
            continue
        columns = [w * np.stack(m, axis=1) for w, m in zip(weights, zip(*moved, strict=True), strict=True)]
        shared = np.hstack([q.T @ c @ nodal for q, c in zip(parts, columns, strict=True)])
        gram = block_diag(*(nodal.T @ (c.T @ c) @ nodal for c in columns)) - shared.T @ shared
        pulls = [nodal.T @ (c.T @ r) for c, r in zip(columns, residuals, strict=True)]
        slope = np.concatenate(pulls) - shared.T @ fitted
        evidence, explained = max(_evidence(gram, slope, knots, length) for length in _LENGTHS)
        left = max(0.0, (energy - explained) / count - 1.0)
        entries_of[port.name] = Entry(
            evidence, 0.5 * step, left, 1.0 - left / max(energy / count - 1.0, left, 1e-12)
        )
    return entries_of


def _evidence(gram: FloatArray, slope: FloatArray, knots: int, length: float) -> tuple[float, float]:
    """Return the log evidence of courses of one smoothness, at their best size, and the energy they explain."""
    apart = np.subtract.outer(np.arange(knots), np.arange(knots))
    prior = np.exp(-0.5 * (apart / length) ** 2) + 1e-6 * np.eye(knots) if length else np.eye(knots)
    root = block_diag(*[np.linalg.cholesky(prior)] * (len(slope) // knots))
    values, vectors = np.linalg.eigh(root.T @ gram @ root)
    values, along = np.maximum(values, 0.0), (vectors.T @ (root.T @ slope)) ** 2
    gained = _SIZES[:, None] ** 2 / (1.0 + _SIZES[:, None] ** 2 * values)
    evidence = 0.5 * np.sum(gained * along - np.log1p(_SIZES[:, None] ** 2 * values), axis=1)
    best = int(np.argmax(evidence))
    return float(evidence[best]), float(np.sum(along * gained[best] * (2.0 - gained[best] * values)))


LEVEL = 0.05  # significance level of a difference in any of the parameters


def between_machines(subject: Subject, answer: Fitted) -> BetweenMachines | None:
    """Return which parameters of an answer differ between machines; None unless there are several machines.

    Parameters of single experiments are refitted as well, but not compared.
    """
    machines = tuple(dict.fromkeys(case.machine for case in subject.model.cases))
    if len(machines) < 2:
        return None
    of_parameter: dict[str, dict[str, Estimate]] = {}
    failed: list[str] = []
    beyond: list[tuple[FloatArray, FloatArray]] = []  # remaining squared gaps, and numbers of components averaged
    for machine in machines:
        alone = of_machine(subject, machine)
        fitted = fit_effects(alone, [e for e in alone.effects if e.id in answer.effects], [answer.fit.values])
        if fitted is None:
            failed.append(machine)
            continue
        beyond.append(excesses(fitted.fit.residuals, alone.observed))
        singles = {f"{SEPARATOR}{case.id}" for case in alone.model.cases} - {f"{SEPARATOR}{machine}"}
        for name, estimate in estimates(fitted, alone).items():
            if not any(name.endswith(single) for single in singles):
                of_parameter.setdefault(without_owner(name), {})[machine] = estimate
    compared = {
        name: alone
        for name, alone in of_parameter.items()
        if sum(1 for e in alone.values() if e.standard_error) > 1
    }
    parameters = [_compared(name, alone, len(compared)) for name, alone in compared.items()]
    parameters.sort(key=lambda p: (not p.differs, p.p_value))
    left_out = tuple(name for name in of_parameter if name not in compared)
    gap = None
    if not failed:
        squares, sizes = (np.concatenate(parts) for parts in zip(*beyond, strict=True))
        gap = float(np.sqrt(max(0.0, float(np.average(squares, weights=sizes)))))
    return BetweenMachines(machines, answer.effects, tuple(parameters), gap, left_out, tuple(failed))


def of_machine(subject: Subject, machine: str) -> Subject:
    """Return the subject with the runs of one machine alone, and the nominal parameters of these runs."""
    cases = tuple(case for case in subject.model.cases if case.machine == machine)
    owners = {machine, *(case.id for case in cases)}
    parts = [u.name.partition(SEPARATOR) for u in subject.nominal]
    nominal = tuple(
        u for u, (_, of_one, owner) in zip(subject.nominal, parts, strict=True) if not of_one or owner in owners
    )
    observed = subject.observed.select([case.id for case in cases])
    return replace(subject, model=replace(subject.model, cases=cases), observed=observed, nominal=nominal)


def _compared(name: str, of_machine: Mapping[str, Estimate], count: int) -> MachineParameter:
    known = {machine: e for machine, e in of_machine.items() if e.standard_error}
    errors = [e.standard_error for e in known.values() if e.standard_error]
    spread = machine_spread(name, list(known), [e.value for e in known.values()], errors)
    return MachineParameter(
        name,
        spread.p_value * count < LEVEL,
        spread.p_value,
        spread.mean,
        spread.spread,
        spread.next_machine,
        of_machine,
    )
