"""Timing of the signals of recorded runs: when inputs act, when outputs are read, and rows that a log has lost.

These are conventions of the recorder, each worth at most a sample. They are judged before a lag or a delay of less
than a sample is blamed on the machine.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from fmuid.core.campaign import Timing
from fmuid.core.errors import FmuidError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.cases import Case
from fmuid.init.seen_run import SeenRun
from fmuid.simulation.runners import Runner
from fmuid.simulation.segmented import Segmented
from fmuid.simulation.simulator import Variable

_NEARLY = 0.5  # of the way between two conventions: another effect rarely looks like the whole way
_SHARES = (0.25, 0.5, 0.75, 0.98)  # of a step, tried for the time from inputs to readings
_WORTH_TRYING = 0.2  # of the way to readings half a step later, from which these are tried
_CLEARLY = 0.8  # remaining share of the squared error for a convention to count as better
_MOST_RUNS = 3
_SURE = 12.0  # log likelihood ratio for a lost row, and for a convention where little else speaks for it
_EDGE, _BEYOND = 0.9, 1e-2  # of the Nyquist frequency; share of the changes of a band-limited input beyond it
_ONE = 0.3  # deviation from one row for a row to be lost
_AROUND = 3  # samples on either side of a lost row that have to be as usual


@dataclass(frozen=True, slots=True)
class Convention:
    """One timing of all signals, and how well a model explains the runs with it.

    Attributes
    ----------
    timing
        Timing of the model.
    signals
        Outputs of the model that differ from it, with their timing.
    read_after
        Time from the inputs of a row to the reading of its outputs, s.
    worse
        Factor by which held signals explain the runs worse (squared error, free parameters refitted).
    evidence
        Logarithm of the likelihood ratio to held signals, from the changes between samples, in which slow errors
        of a model hardly show.
    along
        Place of the runs on the way from held signals (0) to this convention (1).
    """

    timing: Timing
    signals: Mapping[str, Timing] = field(default_factory=dict)
    read_after: float = 0.0
    worse: float = 1.0
    evidence: float = 0.0
    along: float = 0.0

    @property
    def plain(self) -> bool:
        """Whether signals are held, and read when the inputs act."""
        return self.timing == "held" and not self.read_after

    @property
    def entries(self) -> str:
        """The entries of a model's table in campaign.toml."""
        after = f" and read_after = {self.read_after:g}" if self.read_after else ""
        return f'timing = "{self.timing}"{after}'

    @property
    def explains(self) -> bool:
        """Whether the runs support this convention against held signals; a fitted time is as far as they say."""
        better = self.worse > 1 / _CLEARLY or (self.worse > 1.0 and self.evidence > _SURE)
        return better and (self.read_after > 0.0 or abs(self.along - 1.0) < _NEARLY)

    def surpasses(self, other: Convention) -> bool:
        """Whether the runs support this convention, which has a fitted time, clearly against another one."""
        return self.evidence > other.evidence + _SURE or self.worse > other.worse / _CLEARLY


@dataclass(frozen=True, slots=True)
class LostRow:
    """A row that a run seems to lack, right before `sample`; later times are too early by its step."""

    run: str
    sample: int
    time: float
    evidence: float

    def __str__(self) -> str:
        """Return the finding in words."""
        return (
            f"a row seems to be missing in '{self.run}' right before {self.time:.6g} s:"
            " the outputs move by two rows at once"
        )


def timing_conventions(
    seen: Sequence[SeenRun], free: Sequence[Variable], known: Convention | None = None
) -> tuple[Convention, ...]:
    """Judge the conventions that a model can be simulated with, the best supported first.

    Each run is refitted with every convention. A missing effect may look like inputs that act earlier, but hardly
    by the whole way from one convention to another; so the runs have to lie near a convention on the way from held
    signals. It also has to leave less than four fifths of their squared error or, where noise is larger than that,
    be sure from the changes between samples. Among those that do, these changes decide. Band-limited inputs are
    near to linear ones; they are listed if linear ones explain the runs, no input has changes near the Nyquist
    frequency, and the changes between samples are clearly in their favour. Outputs that are read a part of a step
    after the inputs act have a fitted time; they are listed if they surpass the other conventions clearly.

    Parameters
    ----------
    seen
        The runs, with held inputs and outputs read before these act.
    free
        Parameters to refit.
    known
        Held signals that are read at a time from an earlier judgement, which is judged as well.
    """
    held = [one.refitted(free) for one in seen]
    conventions = [Convention("held")]
    later = {c.read_after: c for c in (known, *_read_later(held, free)) if c is not None and c.read_after}
    for convention in (Convention("linear"), *_read_at_once(held), *later.values()):
        try:
            tried = [timed(one, convention) for one in seen]
            if all(np.array_equal(a.nominal, b.nominal) for a, b in zip(seen, tried, strict=True)):
                continue
            refits = [one.refitted(free) for one in tried]
            conventions.append(_judged(convention, held, refits, free))
            if convention.timing == "linear" and conventions[-1].explains and all(map(_band_limited, seen)):
                conventions += _nearer_than(conventions[-1], held, refits, free)
        except FmuidError:
            continue  # an FMU that does not interpolate its inputs
    others = [c for c in conventions if c.explains and not c.read_after]
    conventions = [c for c in conventions if not c.read_after or all(map(c.surpasses, others))]
    return tuple(sorted(conventions, key=lambda c: (not (c.explains or c.plain), not c.read_after, -c.evidence)))


def _judged(
    convention: Convention, held: Sequence[SeenRun], refits: Sequence[SeenRun], free: Sequence[Variable]
) -> Convention:
    """Return a convention with how well it explains the runs; `held` and `refits` are refitted ones."""
    worse = sum(one.left for one in held) / max(sum(one.left for one in refits), 1e-300)
    evidence = sum(_evidence(a, b) for a, b in zip(held, refits, strict=True))
    return replace(convention, worse=worse, evidence=evidence, along=_along(held, convention, free))


def _along(
    before: Sequence[SeenRun], convention: Convention, free: Sequence[Variable], *, order: int = 0
) -> float:
    """Return the place of runs on the way to a convention, of their `order`-th changes between samples."""
    ways = [one.towards(timed(one, convention), free, order=order) for one in before]
    products, squares = np.sum(ways, axis=0)
    return float(products / max(squares, 1e-300))


def _nearer_than(
    linear: Convention, held: Sequence[SeenRun], refits: Sequence[SeenRun], free: Sequence[Variable]
) -> Sequence[Convention]:
    """Return band-limited inputs if they explain the runs clearly better than linear ones, else nothing.

    `held` and `refits` are runs refitted with held and with linear inputs.
    """
    smooth = Convention("band-limited")
    if abs(_along(refits, smooth, free, order=1) - 1.0) >= _NEARLY:
        return ()
    judged = _judged(smooth, held, [timed(one, smooth).refitted(free) for one in refits], free)
    return (judged,) if judged.evidence - linear.evidence > _SURE else ()


def _band_limited(run: SeenRun) -> bool:
    """Return whether no input of a run has a notable share of its changes near the Nyquist frequency."""
    for values in run.inputs.values():
        changes = np.diff(values)
        power = np.abs(np.fft.rfft(changes * np.hanning(len(changes)))) ** 2
        if np.sum(power[round(_EDGE * len(power)) :]) > _BEYOND * np.sum(power):
            return False
    return True


def conventions_of(
    cases: Sequence[tuple[Case, Mapping[str, float]]],
    names: Collection[str],
    runner: Runner,
    known: Convention | None = None,
) -> tuple[Convention, ...]:
    """Judge the conventions for cases of one model, as `timing_conventions` does for runs; only held if it cannot.

    Start states of a run are fitted with every convention. Cases that restart along a run, with a sensor model, or
    of a recorder that writes a row after each step are not judged.

    Parameters
    ----------
    cases
        Cases with the values of the model's variables from which the refits start.
    names
        Names of the parameters to refit, those of laws among them.
    known
        See `timing_conventions`.
    """
    plain = [(c, values) for c, values in cases if not c.lead and all(ch.plain for ch in c.channels)]
    plain = [(c, v) for c, v in plain if not isinstance(c.simulator, Segmented) or c.simulator.length == np.inf]
    plain = plain[:_MOST_RUNS]
    if not plain:
        return (Convention("held"),)
    seen = []
    for case, values in plain:
        measured = np.array([channel.mean for channel in case.channels])
        task = replace(case.task, interpolation="hold", linear=(), band_limited=(), after=(), read_after=0.0)
        model = case.simulator
        if isinstance(model, Segmented):  # the measurements may be without effects that the sensors show
            model = Segmented(model.simulator, task, model.length, measured, model.weight, at=model.at)
        seen.append(SeenRun(model, task, measured, runner, values=values))
    first, values = plain[0]
    named = {first.setting[n][0] if n in first.setting else n for n in names}  # laws have no setting
    free = [
        v if v.start else replace(v, start=values[v.name])
        for v in first.simulator.variables.values()
        if v.name in named and (v.start or values.get(v.name))
    ]
    return timing_conventions(seen, free, known)


def chosen(conventions: Sequence[Convention]) -> Convention:
    """Return the convention that the runs support, held signals if they support no other."""
    supported = [c for c in conventions if c.explains]
    return supported[0] if supported else next(c for c in conventions if c.plain)


def lost_rows(fits: Sequence[SeenRun], names: Sequence[str]) -> tuple[LostRow, ...]:
    """Return the rows that logs seem to have lost: where outputs move by two rows of their prediction at once.

    `fits` are refitted runs. A log that counts rows instead of reading a clock is too early from there on. Outputs
    that follow the logged inputs at once do not show it.
    """
    lost = []
    for name, fitted in zip(names, fits, strict=True):
        stored = _stored(fitted)
        if not stored.any():
            continue
        changes, moves = (np.diff(rows[stored], axis=1) for rows in (fitted.errors, fitted.response))
        sample, evidence = _most_likely_gap(changes, moves)
        if evidence > _SURE:
            lost.append(LostRow(name, sample, float(fitted.time[sample]), evidence))
    return tuple(lost)


def _stored(run: SeenRun) -> NDArray[np.bool_]:
    """Return which outputs do not depend on an input without delay; none if the model cannot tell."""
    try:
        before, after = run.timed("hold").nominal, run.timed("hold", run.outputs).nominal
        return np.asarray(np.all(before == after, axis=1))
    except FmuidError:  # coupled FMUs
        return np.zeros(len(run.outputs), dtype=bool)


def _most_likely_gap(changes: FloatArray, moves: FloatArray) -> tuple[int, float]:
    """Return the sample before which a row is missing most likely, and the log likelihood ratio.

    `changes` and `moves` are those of the errors and of the prediction from sample to sample, (outputs, N - 1).
    Changes next to a sample tell how fast the model departs there anyway. The first change is left out: it may be
    due to a start that differs from the model's.
    """
    scale = 1.4826 * np.nanmedian(np.abs(changes), axis=1, keepdims=True)
    scale = np.maximum(scale, 1e-9)
    off, move = changes / scale, np.append(moves[:, 1:], moves[:, -1:], axis=1) / scale
    known = np.isfinite(off)
    off = np.where(known, off, 0.0)
    off = off - median_filter(off, (1, 2 * _AROUND + 1))  # beyond what a model departs anyway
    move = np.where(known, move, 0.0)
    product, square = np.sum(off * move, axis=0), np.sum(move**2, axis=0)
    share = product / np.maximum(square, 1e-300)
    gain = product - 0.5 * square  # of one whole row
    gain[np.abs(share - 1.0) > _ONE] = -np.inf
    gain[0] = -np.inf
    k = int(np.argmax(gain))
    left = off.copy()
    left[:, k] -= move[:, k]
    around = left[:, max(0, k - _AROUND) : k + _AROUND + 1]
    usual = float(np.max(np.abs(around), initial=0.0)) < 5.0
    return k + 1, float(gain[k]) if usual else -np.inf


def _read_later(held: Sequence[SeenRun], free: Sequence[Variable]) -> list[Convention]:
    """Return held inputs with outputs read a part of a step after them, if that explains every run better.

    Where readings more than a step later explain the runs better still, it is the model that is late: none.
    A linear step from held signals would not do: the refitted parameters have moved to imitate later readings.
    """
    step = min(float(np.min(np.diff(one.time))) for one in held)
    first = Convention("held", read_after=_SHARES[1] * step)
    try:
        if not any(_along(held, first, free, order=order) >= _WORTH_TRYING for order in (0, 1)):
            return []
        squares = {0.0: [one.left for one in held]}

        def tried(share: float) -> float:
            later = Convention("held", read_after=share * step)
            squares[share] = [timed(one, later).refitted(free).left for one in held]
            return sum(squares[share])

        sums = [sum(squares[0.0]), *map(tried, _SHARES)]
        best = int(np.argmin(sums))
        if 0 < best < len(_SHARES):
            around = [(0.0, *_SHARES)[k] for k in (best - 1, best, best + 1)]
            bend, slope, _ = np.polyfit(around, sums[best - 1 : best + 2], 2)
            tried(float(-0.5 * slope / bend) if bend > 0.0 else around[1])
        elif best:
            more = [timed(one.a_row_later(), Convention("held", read_after=_SHARES[0] * step)) for one in held]
            if sum(one.refitted(free).left * (1 + 1 / len(one.time)) for one in more) < sums[-1]:
                return []
    except FmuidError:  # an FMU with a fixed step
        return []
    share = min(squares, key=lambda one: sum(squares[one]))
    better = all(a < b for a, b in zip(squares[share], squares[0.0], strict=True))
    return [Convention("held", read_after=float(f"{share * step:.3g}"))] if share and better else []


def _read_at_once(held: Sequence[SeenRun]) -> list[Convention]:
    """Return held inputs with those outputs read after them that then fit better; none if no output differs."""
    outputs = held[0].outputs
    try:
        late = [one.timed("hold", outputs) for one in held]
    except FmuidError:  # coupled FMUs
        return []
    before, after = (sum(_roughness(one) for one in runs) for runs in (held, late))
    same = np.all([np.all(a.nominal == b.nominal, axis=1) for a, b in zip(held, late, strict=True)], axis=0)
    better = ~same & (after < _CLEARLY * before)
    if not better.any():
        return []
    timings: dict[str, Timing] = {n: "held" for n, b, s in zip(outputs, better, same, strict=True) if not (b or s)}
    return [Convention("held-read-after", timings)]


def timed(run: SeenRun, convention: Convention) -> SeenRun:
    """Return a run with another timing of its signals."""
    if convention.timing in ("linear", "band-limited"):
        return run.timed(convention.timing)
    after = convention.timing == "held-read-after"
    late = tuple(n for n in run.outputs if after and n not in convention.signals)
    return run.timed("hold", late, convention.read_after)


def _roughness(run: SeenRun) -> FloatArray:
    """Return the sum of squared changes of each output's error between samples."""
    return np.asarray(np.nansum(np.diff(run.errors, axis=1) ** 2, axis=1))


def _evidence(held: SeenRun, other: SeenRun) -> float:
    """Return the log likelihood ratio of two responses to one run, from changes between samples.

    Where a law is missing, changes are like those before them: as a first-order autoregression, they count less.
    """
    count = np.sum(np.isfinite(np.diff(held.errors, axis=1)), axis=1)
    floor = 1e-12 * count  # changes far below the range of an output
    alike = np.clip(np.minimum(_alike(held), _alike(other)), 0.0, 1.0)
    count = 0.5 * count * (1.0 - alike) / (1.0 + alike)
    return float(np.sum(count * np.log((_roughness(held) + floor) / (_roughness(other) + floor))))


def _alike(run: SeenRun) -> FloatArray:
    """Return the correlation of each output's change of the error with the change before it."""
    changes = np.nan_to_num(np.diff(run.errors, axis=1))
    return np.asarray(
        np.sum(changes[:, 1:] * changes[:, :-1], axis=1) / np.maximum(np.sum(changes**2, axis=1), 1e-300)
    )
