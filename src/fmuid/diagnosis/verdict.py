"""Verdict and results of a diagnosis, and their JSON form (format ``fmuid-diagnosis``, version 3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Kind = Literal["complete", "effect", "partial", "ambiguous", "unknown", "insufficient"]
NONE, UNKNOWN = ("none",), ("unknown",)
"""Answers without an effect: nothing is missing, or something is missing that no effect explains."""


@dataclass(frozen=True, slots=True)
class Rest:
    """The remaining gap after the verdict: its size in noise floors, and its place as text."""

    gap: float
    where: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """The conclusion of a diagnosis.

    Attributes
    ----------
    kind
        ``effect`` explains the gap, ``partial`` a part of it.
    effects
        Effects that every surviving answer contains.
    one_of
        Sets of effects, one of which is needed in addition; for an ``ambiguous`` verdict only.
    ports
        The places where the gap may enter, which these sensors cannot separate; empty if none is named.
    stable
        Whether leaving out any single experiment would give no contradictory verdict; None if that cannot be
        judged.
    rest
        The gap that the effects leave, if it exceeds the noise.
    provisional
        Whether slow noise or something unknown is not excluded: the probability is below 0.9, but what the effects
        close on left-out data is more than chance.
    within_tolerance
        Whether the model is complete to within the tolerances that the user stated, whatever it lacks.
    """

    kind: Kind
    effects: tuple[str, ...] = ()
    one_of: tuple[tuple[str, ...], ...] = ()
    ports: tuple[str, ...] = ()
    stable: bool | None = None
    rest: Rest | None = None
    provisional: bool = False
    within_tolerance: bool = False

    @property
    def answers(self) -> tuple[tuple[str, ...], ...]:
        """The answers that the verdict leaves open, one of which is taken to be true."""
        match self.kind:
            case "complete" | "insufficient":
                return (NONE,)
            case "unknown":
                return (UNKNOWN,)
            case "ambiguous":
                return tuple((*self.effects, *others) for others in self.one_of)
            case _:
                return (self.effects,)


@dataclass(frozen=True, slots=True)
class Tolerated:
    """The error of a signal beyond the noise, after a refit, against the user's tolerance.

    Attributes
    ----------
    error
        Root mean square error of the refitted nominal model beyond the noise, in `unit`.
    tolerance
        The largest error that is tolerated; None for a signal without a tolerance whose error exceeds the noise.
    probability
        Probability that the error is within the tolerance, or within the noise.
    """

    signal: str
    unit: str
    error: float
    tolerance: float | None
    probability: float


@dataclass(frozen=True, slots=True)
class Gap:
    """The sim-to-real gap in noise floors.

    Attributes
    ----------
    present
        Whether the residual of the refitted nominal model exceeds the noise.
    p_value
        p-value of that residual under the noise floor.
    nominal, nominal_refit, corrected
        Gap at the start values, with the nominal parameters refitted, and with the verdict's effects added.
    floor_units
        Standard deviation of each signal's noise, in its unit.
    calibrated
        Whether every experiment had the five runs that the floor needs.
    bounded
        Whether the floor is only a bound, because no run was repeated.
    """

    present: bool
    p_value: float
    nominal: float
    nominal_refit: float
    corrected: float
    floor_units: Mapping[str, float]
    calibrated: bool = True
    bounded: bool = False


@dataclass(frozen=True, slots=True)
class Share:
    """A part of the gap: of one signal in one experiment, within a range of a variable."""

    experiment: str
    signal: str
    share: float
    regime: tuple[str, float, float] | None = None


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value with its standard error, None if the data do not determine it.

    Attributes
    ----------
    from_noise
        The part of the standard error that noise alone causes; the rest is what the model still lacks.
    """

    value: float
    standard_error: float | None = None
    from_noise: float | None = None


@dataclass(frozen=True, slots=True)
class PhysicalGap:
    """Root mean square difference of model and measurement, in the signal's unit.

    Attributes
    ----------
    before, after
        Error on left-out data with the nominal parameters refitted, and with the effects added.
    floor
        The gap that noise alone leaves in the mean of the repeats.
    """

    unit: str
    before: float
    after: float
    floor: float


@dataclass(frozen=True, slots=True)
class Closure:
    """Share of the gap that effects close, beyond what refitting the nominal parameters closes.

    Attributes
    ----------
    train, held_out
        Closure on the data that the effects were fitted to, and on held-out experiments.
    interval
        The 90 % interval of the latter.
    physical
        By signal, the error on left-out data before and after, over all runs.
    """

    train: float
    held_out: float
    interval: tuple[float, float]
    physical: Mapping[str, PhysicalGap] = field(default_factory=dict)

    @property
    def validated(self) -> float:
        """The closure that held-out experiments support: beyond `train`, only the nominal model predicts badly."""
        return min(self.train, self.held_out)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return {**asdict(self), "interval": list(self.interval)}


@dataclass(frozen=True, slots=True)
class Refinement:
    """A table in the model: it corrects the shape of a law, or is learned where no law holds.

    Attributes
    ----------
    effect
        Id of the effect whose law it refines, over the law's own variable at its own port, or its own id if it is
        learned; its JSON name is ``law``.
    id
        Id of the table as an effect of the corrected model.
    variables, units
        What it is over: one variable, or two.
    knots
        Its knots, by variable.
    values
        What it adds at the knots; of two variables, nested lists.
    unit
        Unit of the values.
    trend
        1 if it may only rise, -1 if it may only fall, 0 if neither.
    entry
        The table as an effect of a catalogue.
    """

    effect: str
    id: str
    port: str
    variables: tuple[str, ...]
    units: tuple[str, ...]
    knots: tuple[tuple[float, ...], ...]
    values: Sequence[Any]
    unit: str = ""
    trend: int = 0
    entry: Mapping[str, Any] = field(default_factory=dict)

    @property
    def learned(self) -> bool:
        """Whether it stands for itself, and refines no law."""
        return self.effect == self.id

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        axes = [
            {"variable": name, "unit": unit, "knots": list(knots)}
            for name, unit, knots in zip(self.variables, self.units, self.knots, strict=True)
        ]
        trend = {1: "rising", -1: "falling"}.get(self.trend)
        table = {"axes": axes, "values": list(self.values), "unit": self.unit, "monotone": trend}
        variable = " and ".join(self.variables)
        about = {"id": self.id, "law": self.effect, "learned": self.learned, "port": self.port}
        return {**about, "variable": variable, "table": table, "effect": dict(self.entry)}


@dataclass(frozen=True, slots=True)
class Best:
    """The best explanation of the gap, whatever the verdict.

    Attributes
    ----------
    effects
        Its effects; the corrected model contains them.
    closure
        Closure of the gap, as for an answer.
    gap
        The remaining gap, in noise floors.
    by_experiment
        By experiment and signal, the errors on left-out data before and after.
    parameters
        Parameters of the effects.
    refinements
        Tables that refine the effects' laws, or that are learned and are then also among the effects.
    """

    effects: tuple[str, ...]
    closure: Closure
    gap: float
    by_experiment: Mapping[str, Mapping[str, PhysicalGap]] = field(default_factory=dict)
    parameters: Mapping[str, Estimate] = field(default_factory=dict)
    refinements: tuple[Refinement, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            "effects": list(self.effects),
            "refinements": [r.to_dict() for r in self.refinements],
            "closure": self.closure.to_dict(),
            "gap": self.gap,
            "rms": {name: asdict(p) for name, p in self.closure.physical.items()},
            "by_experiment": {
                e: {name: asdict(p) for name, p in signals.items()} for e, signals in self.by_experiment.items()
            },
            "parameters": {name: asdict(e) for name, e in self.parameters.items()},
        }


@dataclass(frozen=True, slots=True)
class Answer:
    """A set of effects that may be all that is missing, or `NONE` or `UNKNOWN`; with its probability."""

    effects: tuple[str, ...]
    probability: float
    closure: Closure | None = None


@dataclass(frozen=True, slots=True)
class Candidate:
    """One effect of the catalogue.

    Attributes
    ----------
    probability
        Probability that the effect is in the right answer.
    score
        Fall of the cost that its signature promises, in squared noise units.
    closure
        Closure of the best model that has it: the verdict's, or the one with it alone.
    """

    id: str
    probability: float
    score: float | None = None
    closure: Closure | None = None
    parameters: Mapping[str, Estimate] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Hidden:
    """Effects that these data cannot show, whatever their plausible size.

    Attributes
    ----------
    unseen
        No sensor shows them.
    imitated
        The fitted parameters can do whatever they do.
    """

    unseen: tuple[str, ...] = ()
    imitated: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Samples that were excluded: spikes, held or lost samples."""

    experiment: str
    signal: str
    samples: int


@dataclass(frozen=True, slots=True)
class NextExperiment:
    """A run that would distinguish the open answers."""

    setup: str
    description: str
    separation_sigma: float
    between: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class AddedSensor:
    """A sensor with which the existing experiments would distinguish the open answers."""

    id: str
    description: str
    separation_sigma: float
    between: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class LawParameter:
    """A parameter of a law found: value, unit, standard error and 95 % interval; None where not determined."""

    value: float
    unit: str
    standard_error: float | None
    interval: tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class Curve:
    """A law over the quantity that it depends on, with others at `held` values: (n,) values and flows."""

    variable: str
    unit: str
    flow_unit: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    held: str = ""


@dataclass(frozen=True, slots=True)
class LawFound:
    """An equation for a gap that no effect explains, or the `reason` why there is none.

    Attributes
    ----------
    id, port
        Id of the law as an effect, and the port where it acts: a flow out of a node, or from the second node of a
        branch to the first.
    beside
        Effects of the verdict that are also in the model with the law.
    formula
        The law with numbers and units.
    effect
        The law as a table of a catalogue, with its Modelica `expression`, its parameters and its own states.
    parameters
        Parameters of the law.
    values
        Values of all parameters of the model with the law.
    closure
        Closure of the gap, as for an answer.
    gap, p_value
        The remaining gap, in noise floors, and how likely noise alone leaves as much.
    curve
        The law as a curve, if it depends on one quantity.
    """

    id: str = ""
    port: str = ""
    beside: tuple[str, ...] = ()
    formula: str = ""
    effect: Mapping[str, Any] = field(default_factory=dict)
    parameters: Mapping[str, LawParameter] = field(default_factory=dict)
    values: Mapping[str, float] = field(default_factory=dict)
    closure: Closure | None = None
    gap: float | None = None
    p_value: float | None = None
    curve: Curve | None = None
    reason: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        if self.reason:
            return {"formula": None, "reason": self.reason}
        return {
            "id": self.id,
            "port": self.port,
            "beside": list(self.beside),
            "formula": self.formula,
            "modelica": self.effect["expression"],
            "parameters": {name: asdict(p) for name, p in self.parameters.items()},
            "effect": dict(self.effect),
            "model": {"parameters": dict(self.values)},
            "closure": None if self.closure is None else self.closure.to_dict(),
            "gap": self.gap,
            "p_value": self.p_value,
            "curve": None if self.curve is None else asdict(self.curve),
            "reason": None,
        }


@dataclass(frozen=True, slots=True)
class MachineParameter:
    """One parameter, refitted to the runs of each machine.

    Attributes
    ----------
    differs
        Whether the machines differ beyond the errors of the estimates, with all parameters considered
        (Bonferroni).
    p_value
        p-value of Cochran's test that all machines have the same value.
    mean, spread
        Mean over all machines of this kind, and standard deviation between them.
    next_machine
        95 % prediction interval of the next machine's value; None for two machines.
    machines
        Estimates by machine.
    """

    name: str
    differs: bool
    p_value: float
    mean: float
    spread: float
    next_machine: tuple[float, float] | None
    machines: Mapping[str, Estimate]


@dataclass(frozen=True, slots=True)
class BetweenMachines:
    """Which parameters differ between machines.

    Attributes
    ----------
    machines
        Names of the machines.
    effects
        Effects that were refitted with the nominal parameters.
    parameters
        Compared parameters, those that differ first.
    gap
        The remaining gap, in noise floors, if each machine has its own values for all of them; None if one cannot
        be refitted.
    left_out
        Names of parameters that the runs of fewer than two machines determine.
    failed
        Machines whose runs could not be refitted.
    """

    machines: tuple[str, ...]
    effects: tuple[str, ...]
    parameters: tuple[MachineParameter, ...]
    gap: float | None = None
    left_out: tuple[str, ...] = ()
    failed: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            "names": list(self.machines),
            "effects": list(self.effects),
            "parameters": [
                asdict(p) | {"next_machine": None if p.next_machine is None else list(p.next_machine)}
                for p in self.parameters
            ],
            "gap": self.gap,
            "left_out": list(self.left_out),
            "failed": list(self.failed),
        }


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Everything a diagnosis found.

    Attributes
    ----------
    answers
        The surviving answers, likeliest first, with `NONE` and `UNKNOWN`: their probabilities sum to 1.
    effects
        All candidates.
    port_closures
        By port, the share of the gap that an arbitrary course over time there closes.
    power
        By effect, the smallest values of its parameters at which it would have been seen.
    hidden
        Effects that would not be seen at any plausible size.
    law_found
        The law found, or the reason for none, where the verdict leaves more than noise and a law was looked for.
    machines
        Differences between machines, if runs of several were diagnosed.
    best
        The best explanation of the gap; None if there is no gap, or nothing closes a part of it.
    equal
        Groups of sets of effects that are one model under several names.
    tolerated
        The model's errors against the tolerances that the user stated.
    """

    verdict: Verdict
    gap: Gap
    where: tuple[Share, ...]
    answers: tuple[Answer, ...]
    effects: tuple[Candidate, ...]
    alias_classes: tuple[tuple[str, ...], ...]
    model: Mapping[str, float]
    next_experiment: NextExperiment | None = None
    added_sensor: AddedSensor | None = None
    port_closures: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    power: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    hidden: Hidden = Hidden()
    outliers: tuple[LeftOut, ...] = ()
    law_found: LawFound | None = None
    machines: BetweenMachines | None = None
    best: Best | None = None
    equal: tuple[tuple[tuple[str, ...], ...], ...] = ()
    tolerated: tuple[Tolerated, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object that `diagnosis.schema.json` describes."""
        verdict = self.verdict
        return {
            "format": "fmuid-diagnosis",
            "version": 3,
            "verdict": {
                "kind": verdict.kind,
                "effects": list(verdict.effects),
                "one_of": [list(effects) for effects in verdict.one_of],
                "port": verdict.ports[0] if verdict.ports else None,
                "ports": list(verdict.ports),
                "stable": verdict.stable,
                "rest": None if verdict.rest is None else asdict(verdict.rest),
                "provisional": verdict.provisional,
                **({"within_tolerance": True} if verdict.within_tolerance else {}),
            },
            "best": None if self.best is None else self.best.to_dict(),
            "refinements": [] if self.best is None else [r.to_dict() for r in self.best.refinements],
            "equal": [[list(names) for names in group] for group in self.equal],
            "gap": {
                "present": self.gap.present,
                "p_value": self.gap.p_value,
                "nominal": self.gap.nominal,
                "nominal_refit": self.gap.nominal_refit,
                "corrected": self.gap.corrected,
                "floor_units": dict(self.gap.floor_units),
                "calibrated": self.gap.calibrated,
                "bounded": self.gap.bounded,
            },
            "where": [_share(s) for s in self.where],
            "answers": [
                {
                    "effects": list(a.effects),
                    "probability": a.probability,
                    "closure": None if a.closure is None else a.closure.to_dict(),
                }
                for a in self.answers
            ],
            "effects": [_candidate(c) for c in self.effects],
            "alias_classes": [list(c) for c in self.alias_classes],
            "model": {"parameters": dict(self.model)},
            "next_experiment": None if self.next_experiment is None else _experiment(self.next_experiment),
            "added_sensor": None if self.added_sensor is None else asdict(self.added_sensor),
            "port_closures": dict(self.port_closures),
            "notes": list(self.notes),
            "power": {effect: dict(values) for effect, values in self.power.items()},
            "hidden": {"unseen": list(self.hidden.unseen), "imitated": list(self.hidden.imitated)},
            "outliers": [asdict(o) for o in self.outliers],
            "law_found": None if self.law_found is None else self.law_found.to_dict(),
            **({"tolerated": [asdict(t) for t in self.tolerated]} if self.tolerated else {}),
            **({} if self.machines is None else {"machines": self.machines.to_dict()}),
        }


def _share(share: Share) -> dict[str, Any]:
    entry: dict[str, Any] = {"experiment": share.experiment, "signal": share.signal, "share": share.share}
    if share.regime is not None:
        variable, begin, end = share.regime
        entry["regime"] = {"variable": variable, "from": begin, "to": end}
    return entry


def _candidate(candidate: Candidate) -> dict[str, Any]:
    entry: dict[str, Any] = {"id": candidate.id, "probability": candidate.probability}
    if candidate.score is not None:
        entry["score"] = candidate.score
    if candidate.closure is not None:
        entry["closure"] = candidate.closure.to_dict()
    if candidate.parameters:
        entry["parameters"] = {name: asdict(e) for name, e in candidate.parameters.items()}
    return entry


def _experiment(experiment: NextExperiment) -> dict[str, Any]:
    return {
        "setup": experiment.setup,
        "description": experiment.description,
        "separation_sigma": experiment.separation_sigma,
        "between": list(experiment.between),
    }


def as_version_2(answer: Mapping[str, Any]) -> dict[str, Any]:
    """Convert the JSON object of a diagnosis to version 2, for programs that read no later one.

    A provisional verdict becomes *insufficient*, as version 2 called it.
    """
    without_new = {k: v for k, v in answer.items() if k not in ("best", "refinements", "equal")} | {"version": 2}
    verdict = {k: v for k, v in answer["verdict"].items() if k != "provisional"}
    if answer["verdict"]["provisional"]:
        verdict |= {"kind": "insufficient", "effects": [], "one_of": [], "port": None, "ports": [], "rest": None}
    return without_new | {"verdict": verdict}
