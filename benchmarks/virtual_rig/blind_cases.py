"""The cases of the blind check: which actuator, which effects, how large, how noisy, how often repeated."""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np

from benchmarks.virtual_rig.blind_effects import BLIND_EFFECTS, BlindEffect, DrawnEffect, Shape
from benchmarks.virtual_rig.blind_experiments import sealed_experiments
from benchmarks.virtual_rig.blind_gap import NOMINAL, Gap
from benchmarks.virtual_rig.library import parameter_table
from benchmarks.virtual_rig.recorder import Sensors, record
from benchmarks.virtual_rig.rig import Rig
from benchmarks.virtual_rig.rig_plan import PlannedExperiment, run_planned
from fmuid.core.experiments import Experiment, Measurements

_T = TypeVar("_T")
Kind = Literal["none", "one", "two", "outside"]
SHARES: dict[Kind, float] = {"none": 0.25, "one": 0.45, "two": 0.15, "outside": 0.15}
GAPS = (0.5, 1.0, 3.0, 10.0)
NOISE = {"low": 0.5, "usual": 1.0, "high": 2.0}
REPEATS = (3, 6)
FRICTION_SPREAD = 0.015
"""Standard deviation of the bearing friction from run to run, relative."""
_RANGES = {"d_S": (1.5, 4.0), "J_S": (0.0025, 0.004), "d_G": (50.0, 95.0), "tau_bf": (0.05, 0.1)}


@dataclass(frozen=True, slots=True)
class Case:
    """One case as planned: what it has is known, how large it is only once its gap has been sought.

    `gaps` are the gaps aimed at, in floors, one for each of `effects` (ids).
    """

    index: int
    seed: int
    kind: Kind
    effects: tuple[str, ...]
    gaps: tuple[float, ...]
    noise: str
    repeats: int
    load_encoder: bool

    @property
    def name(self) -> str:
        """Folder of the case."""
        return f"c{self.index:03d}"

    @property
    def sensors(self) -> Sensors:
        """Its sensors."""
        level = NOISE[self.noise]
        return Sensors(torque_noise=0.12 * level, torque_offset=0.05 * level, current_noise=0.004 * level)

    def random(self, purpose: str) -> np.random.Generator:
        """Return a generator of its own for each purpose."""
        return np.random.default_rng([self.seed, self.index, zlib.crc32(purpose.encode())])


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What a case really is: the plain actuator, its effects, and the gap that each leaves, in floors."""

    case: Case
    plain: Rig
    drawn: tuple[DrawnEffect, ...]
    gaps: tuple[float, ...]
    gap: float

    @property
    def rig(self) -> Rig:
        """The actuator with its effects."""
        rig = self.plain
        for effect in self.drawn:
            rig = effect.put(rig)
        return rig


def plan_cases(count: int, seed: int) -> tuple[Case, ...]:
    """Return `count` cases in the shares of the specification, effects and circumstances in turn."""
    rng = np.random.default_rng(seed)
    ordered: list[Kind] = [kind for kind, share in SHARES.items() for _ in range(round(share * count))]
    ordered += ["one"] * (count - len(ordered))  # what rounding leaves
    kinds = [ordered[i] for i in rng.permutation(len(ordered))[:count]]
    known = _turns([e.id for e in BLIND_EFFECTS.values() if e.in_catalogue], rng)
    foreign = _turns([e.id for e in BLIND_EFFECTS.values() if not e.in_catalogue], rng)
    around = _turns(list(itertools.product(GAPS, NOISE, REPEATS, (True, False))), rng)
    cases = []
    for index, kind in enumerate(kinds):
        gap, noise, repeats, load_encoder = next(around)
        effects: tuple[str, ...] = ()
        gaps: tuple[float, ...] = (gap,)
        if kind == "none":
            gaps = ()
        elif kind == "one":
            effects = (next(known),)
        elif kind == "outside":
            effects = (next(foreign),)
        else:
            first = next(known)
            second = next(e for e in known if e != first)
            effects, gaps = (first, second), (max(gap, 1.0), float(rng.choice(GAPS[1:])))
        cases.append(Case(index, seed, kind, effects, gaps, noise, repeats, load_encoder))
    return tuple(cases)


def _turns(values: Sequence[_T], rng: np.random.Generator) -> Iterator[_T]:
    """Go through `values` again and again, each time in another order."""
    while True:
        for i in rng.permutation(len(values)):
            yield values[i]


def plain_actuator(case: Case) -> Rig:
    """Draw the case's actuator, without effects."""
    rng = case.random("actuator")
    values = {k: float(np.exp(rng.uniform(*np.log(r)))) for k, r in _RANGES.items()}
    tau = values.pop("tau_bf")
    return Rig(np.array([[0.0, 1.0, 1.0, tau, tau]]), {**values, "J_L": 0.05})


def _puts(effect: BlindEffect, rig: Rig, shape: Shape) -> Callable[[float], Rig]:
    return lambda magnitude: effect.put(rig, magnitude, shape)


def find_truth(case: Case) -> Truth:
    """Draw the case's actuator and its effects' shapes, and seek the magnitudes that leave its gaps."""
    plain = plain_actuator(case)
    if not case.effects:
        return Truth(case, plain, (), (), 0.0)
    gap = Gap(plain, case.sensors, sealed_experiments(), load_encoder=case.load_encoder)
    drawn, gaps = [], []
    for name, target in zip(case.effects, case.gaps, strict=True):
        effect = BLIND_EFFECTS[name]
        shape = effect.shape(case.random(name))
        magnitude, reached = gap.magnitude(_puts(effect, plain, shape), effect.low, effect.high, target)
        drawn.append(DrawnEffect(effect, magnitude, shape))
        gaps.append(reached)
    truth = Truth(case, plain, tuple(drawn), tuple(gaps), 0.0)
    return replace(truth, gap=gap.of(truth.rig))


def label(truth: Truth) -> dict[str, object]:
    """Return everything about a case that the diagnosing process must not see."""
    case = truth.case
    plain = {k: truth.plain.parameters[k] for k in NOMINAL[:3]}
    return {
        "case": case.name,
        "kind": case.kind,
        "effects": list(case.effects),
        "in_catalogue": case.kind != "outside",
        "ports": [e.effect.port for e in truth.drawn],
        "magnitudes": [e.magnitude for e in truth.drawn],
        "shapes": [dict(e.shape) for e in truth.drawn],
        "gaps_aimed_at": list(case.gaps),
        "gaps": list(truth.gaps),
        "gap": truth.gap,
        "noise": case.noise,
        "repeats": case.repeats,
        "load_encoder": case.load_encoder,
        "parameters": {**plain, "tau_bf": float(truth.plain.loss_table[0, 3])},
    }


def record_case(truth: Truth, experiments: Sequence[PlannedExperiment], purpose: str) -> Measurements:
    """Return the case's recorded runs; friction, sensor offset and encoder angle differ from run to run.

    As in the sealed campaigns, a row is written after each step, signals carry no `sigma`, and the file says
    nothing of the rig.
    """
    case, recorded = truth.case, {}
    units = {name: info.unit for name, info in parameter_table().items()}
    for planned in experiments:
        for repeat in range(case.repeats):
            name = planned.id if repeat == 0 else f"{planned.id}_r{repeat}"
            rng = case.random(f"{purpose} {name}")
            scale = 1 + FRICTION_SPREAD * rng.standard_normal()
            run = run_planned(truth.rig.changed(friction_scale=scale), planned, preceding=True)
            signals = record(run, case.sensors, rng, sigmas=False)
            if not case.load_encoder:
                signals.pop("phi_load", None)
            known = {k: v for k, v in planned.settings.items() if k == "mgr"}
            recorded[name] = Experiment(
                id=name,
                setup=planned.setup,
                time=run.time,
                signals=signals,
                settings=known,
                setting_units={k: units[k] for k in known},
                repeat_of=None if repeat == 0 else planned.id,
            )
    return Measurements(recorded, title="sealed", rig="withheld")
