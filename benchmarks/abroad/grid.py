"""The grid of the check abroad: what each case is, as a function of seed and number.

Cases come in blocks that hold the strata in their shares, and go through rigs, effects, repeats, noise and rates
in shuffled rounds, so that the first so many are a fair sample of all. Each block ends with twins of some of its
cases: the same plant recorded with the same information in another way.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeVar

import numpy as np

from benchmarks.abroad.check_rigs import CHECKED_ON
from benchmarks.abroad.compiled_rig import directed
from benchmarks.abroad.gap import SizedPlant
from benchmarks.abroad.logs import INPUT_NOISE, Noise, Recording, drawn_factors
from benchmarks.abroad.plant import Rig

COUNT = 1000  # without twins
Stratum = Literal["none", "one", "two", "outside", "held"]
_BLOCK: Mapping[Stratum, int] = {"none": 6, "one": 7, "two": 2, "outside": 3, "held": 2}
_REPEATS = (1,) * 5 + (2,) * 5 + (3,) * 7 + (5,) * 3
_NOISE: tuple[Noise, ...] = ("white",) * 8 + 2 * (
    "coloured", "heteroscedastic", "quantised", "drift", "spikes", "inputs"
)  # fmt: skip
_EVERY = (1, 2)
_SIGMA = (True, False)  # whether the user states the noise of white single runs
_GAPS = (1.0, 10.0)  # floors
_TOLD_APART = 3.0  # standard deviations
_NOTHING = 0.05  # floors
_WHOLE = "cogging"  # whose shape is a whole number
Twin = Literal["rate", "units", "idle"]
_TWINS: tuple[Twin, ...] = ("rate", "units", "idle")
_T = TypeVar("_T")


@dataclass(frozen=True)
class Case:
    """A case before its effects have been sized.

    Attributes
    ----------
    number
        Its place in the grid.
    drawn
        Number that its plant is drawn by: that of the case it is a twin of.
    gaps
        What each effect is to leave, in floors.
    sigma
        Whether the user states the noise.
    """

    number: int
    drawn: int
    rig: Rig
    stratum: Stratum
    effects: tuple[str, ...]
    gaps: tuple[float, ...]
    recording: Recording
    sigma: bool
    twin: Twin | None = None

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"c{self.number:04d}"


def plan(seed: int, count: int = COUNT, rigs: Sequence[Rig] = CHECKED_ON) -> tuple[Case, ...]:
    """Return the grid: `count` cases and their twins."""
    rng = np.random.default_rng(seed)
    strata = [s for s in _BLOCK if any(_effects(rig, s) for rig in rigs)]
    draws = {s: _Stratum(s, [rig for rig in rigs if _effects(rig, s)], rng) for s in strata}
    twins = _rounds(_TWINS, rng)
    cases: list[Case] = []
    planned = 0
    while planned < count:
        block = []
        for stratum in rng.permutation([s for s in strata for _ in range(_BLOCK[s])]).tolist():
            if planned < count:
                block.append(draws[stratum].case(len(cases) + len(block)))
                planned += 1
        cases += block
        repeated = [c for c in block if c.recording.repeats > 1 and c.recording.noise == "white"]
        for k in rng.permutation(len(repeated))[: len(_TWINS)]:
            cases.append(_twin(repeated[k], next(twins), len(cases)))
    return tuple(cases)


def label(case: Case, seed: int) -> dict[str, Any]:
    """Size the effects of a case and return its label, a JSON value."""
    rng = np.random.default_rng([seed, case.drawn])
    factors = drawn_factors(case.rig, rng)
    inputs = INPUT_NOISE if case.recording.noise == "inputs" else 0.0
    plant = SizedPlant(case.rig, factors, noise=case.recording.noise, inputs=inputs)
    effect: dict[str, float] = {}
    parts: dict[str, dict[str, float]] = {}
    gaps: list[float] = []
    same: dict[str, list[str]] = {}
    for name, gap in zip(case.effects, case.gaps, strict=True):
        shape = 1.0 if name.startswith(_WHOLE) else float(np.exp(rng.uniform(-0.4, 0.4)))
        sign = float(rng.choice([-1.0, 1.0])) if directed(name) else 1.0
        sized, found = plant.sized(case.rig.effects[name], gap, sign=sign, shape=shape)
        effect |= sized
        parts[name] = sized
        gaps.append(found)
        same[name] = [*case.rig.same.get(name, ()), *_hidden_by_noise(case, name, plant, sized, found)]
    how = case.recording
    return {
        "case": case.name, "rig": case.rig.name, "kind": case.stratum, "effects": list(case.effects),
        "sizes": effect, "gaps": gaps, "gap": plant.gap(effect) if len(gaps) > 1 else sum(gaps),
        "beside": [plant.beside(effect, own) for own in list(parts.values())[::-1]] if len(parts) == 2 else gaps,
        "same": same, "factors": factors,
        "repeats": how.repeats, "noise": how.noise, "every": how.every, "quieter": how.quieter,
        "sigma": case.sigma, "twin": case.twin, "twin_of": f"c{case.drawn:04d}" if case.twin else None,
    }  # fmt: skip


def _hidden_by_noise(
    case: Case, name: str, plant: SizedPlant, effect: Mapping[str, float], gap: float
) -> Iterator[str]:
    """Yield the effects that this case's recordings cannot tell from one of its own."""
    how = case.recording
    repeats = 1 if how.noise == "quantised" else how.repeats  # rounding repeats with the signal
    recordings = repeats * how.quieter**2
    rivals = case.rig.near.get(name, {}) if gap > _NOTHING else {}
    for other, unit in rivals.items():
        sized = [plant.sized(unit, gap, sign=sign) for sign in ((1.0, -1.0) if directed(other) else (1.0,))]
        reached = [rival for rival, gap in sized if np.isfinite(gap)]
        apart = [plant.separation(effect, rival, recordings, how.every) for rival in reached]
        if min(apart, default=np.inf) < _TOLD_APART:
            yield from (other, *case.rig.same.get(other, ()))


def _rounds(values: Sequence[_T], rng: np.random.Generator) -> Iterator[_T]:
    """Go through values in shuffled rounds."""
    while True:
        yield from (values[k] for k in rng.permutation(len(values)))


class _Stratum:
    def __init__(self, stratum: Stratum, rigs: Sequence[Rig], rng: np.random.Generator) -> None:
        self._stratum: Stratum = stratum
        self._rng = rng
        rounds = partial(_rounds, rng=rng)
        self._rigs, self._repeats, self._noise = rounds(rigs), rounds(_REPEATS), rounds(_NOISE)
        self._every, self._sigma = rounds(_EVERY), rounds(_SIGMA)
        self._effects = {rig.name: rounds(_effects(rig, stratum)) for rig in rigs}

    def case(self, number: int) -> Case:
        rig, noise, repeats = next(self._rigs), next(self._noise), next(self._repeats)
        effects: list[str] = []
        while len(effects) < {"none": 0, "two": 2}.get(self._stratum, 1):
            effect = next(self._effects[rig.name])
            if all(effect not in (e, *rig.same.get(e, ())) for e in effects):
                effects.append(effect)
        gaps = np.exp(self._rng.uniform(*np.log(_GAPS), len(effects)))
        repeats = min(repeats, 2) if noise == "inputs" else repeats  # no run of these has repeats of its own
        recording = Recording(repeats, noise, next(self._every))
        sigma = noise == "white" and repeats == 1 and next(self._sigma)
        return Case(
            number, number, rig, self._stratum, tuple(effects), tuple(gaps.tolist()), recording, sigma=sigma
        )


def _effects(rig: Rig, stratum: Stratum) -> list[str]:
    """Return the effects that a stratum draws from."""
    held = [e for e in rig.effects if e.startswith("value@")]
    inside = [e for e in rig.effects if e not in rig.outside and e not in held]
    return {"none": [""], "one": inside, "two": inside, "outside": list(rig.outside), "held": held}[stratum]


def _twin(case: Case, kind: Twin, number: int) -> Case:
    how = case.recording
    if kind == "rate":  # the same spectral density of the noise
        every = 1 if how.every == 2 else 2
        how = replace(how, every=every, quieter=how.quieter * np.sqrt(every / how.every))
    return replace(case, number=number, recording=replace(how, other_units=kind == "units"), twin=kind)
