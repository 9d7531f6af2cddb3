"""What a diagnosis says, and its JSON form (format ``fmuid-diagnosis``, version 1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Kind = Literal["complete", "effect", "ambiguous", "unknown", "insufficient"]


@dataclass(frozen=True, slots=True)
class Verdict:
    """The answer: a kind, the effects it names, and the port they act at."""

    kind: Kind
    effects: tuple[str, ...] = ()
    port: str | None = None


@dataclass(frozen=True, slots=True)
class Gap:
    """The sim-to-real gap in noise floors.

    Attributes
    ----------
    present
        Whether the refitted nominal model is outside what noise leaves.
    p_value
        Of that, under the noise floor.
    nominal, nominal_refit, corrected
        At the start values, with the nominal parameters refitted, and with the verdict's effects added.
    floor_units
        Standard deviation of each signal's noise, in its unit.
    calibrated
        Whether every experiment had the five runs that the floor needs.
    """

    present: bool
    p_value: float
    nominal: float
    nominal_refit: float
    corrected: float
    floor_units: Mapping[str, float]
    calibrated: bool = True


@dataclass(frozen=True, slots=True)
class Share:
    """A part of the gap: of one signal of one experiment, within a range of a variable."""

    experiment: str
    signal: str
    share: float
    regime: tuple[str, float, float] | None = None


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value with its standard error; None where the data do not determine it."""

    value: float
    standard_error: float | None


@dataclass(frozen=True, slots=True)
class Candidate:
    """One effect (or several together), ``none`` or ``unknown``.

    Attributes
    ----------
    probability
        That it is the answer.
    score
        Fall of the cost that its signature promises, in squared noise units.
    closure
        Share of the gap that it closes on the data it was fitted to, on experiments left out, and the 90 %
        bootstrap interval of the latter; beyond what refitting the nominal parameters closes.
    """

    id: str
    probability: float
    score: float | None = None
    closure: tuple[float, float, tuple[float, float]] | None = None
    parameters: Mapping[str, Estimate] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class NextExperiment:
    """A run that would tell apart what is still open."""

    setup: str
    description: str
    separation_sigma: float
    between: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class AddedSensor:
    """A sensor with which the campaign's own experiments would tell apart what is still open."""

    id: str
    description: str
    separation_sigma: float
    between: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Everything a diagnosis found."""

    verdict: Verdict
    gap: Gap
    where: tuple[Share, ...]
    effects: tuple[Candidate, ...]
    alias_classes: tuple[tuple[str, ...], ...]
    model: Mapping[str, float]
    next_experiment: NextExperiment | None = None
    added_sensor: AddedSensor | None = None
    ports: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    smallest_seen: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object that `diagnosis.schema.json` describes."""
        return {
            "format": "fmuid-diagnosis",
            "version": 1,
            "verdict": {
                "kind": self.verdict.kind,
                "effects": list(self.verdict.effects),
                "port": self.verdict.port,
            },
            "gap": {
                "present": self.gap.present,
                "p_value": self.gap.p_value,
                "nominal": self.gap.nominal,
                "nominal_refit": self.gap.nominal_refit,
                "corrected": self.gap.corrected,
                "floor_units": dict(self.gap.floor_units),
                "calibrated": self.gap.calibrated,
            },
            "where": [_share(s) for s in self.where],
            "effects": [_candidate(c) for c in self.effects],
            "alias_classes": [list(c) for c in self.alias_classes],
            "model": {"parameters": dict(self.model)},
            "next_experiment": None if self.next_experiment is None else _experiment(self.next_experiment),
            "added_sensor": None if self.added_sensor is None else asdict(self.added_sensor),
            "ports": dict(self.ports),
            "notes": list(self.notes),
            "smallest_seen": {effect: dict(values) for effect, values in self.smallest_seen.items()},
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
        train, held_out, interval = candidate.closure
        entry["closure"] = {"train": train, "held_out": held_out, "interval": list(interval)}
    if candidate.parameters:
        entry["parameters"] = {
            name: {"value": e.value, "standard_error": e.standard_error}
            for name, e in candidate.parameters.items()
        }
    return entry


def _experiment(experiment: NextExperiment) -> dict[str, Any]:
    return {
        "setup": experiment.setup,
        "description": experiment.description,
        "separation_sigma": experiment.separation_sigma,
        "between": list(experiment.between),
    }
