"""Effects as data: what a model may lack, the parameters that add it, and plausible magnitudes to try."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from fmuid.diagnosis.refit import Unknown


@dataclass(frozen=True, slots=True)
class Effect:
    """One effect of a catalogue.

    Attributes
    ----------
    id
        Short name; part of the interface.
    description, source
        What it is, and what it physically comes from.
    port
        Where it acts on the model.
    unknowns
        Its parameters, sizes and shapes alike: all are free in a refit. A parameter starts at its neutral value.
    neutral
        Values at which the effect is off.
    trials
        Plausible values to score it by, two or three magnitudes; shapes where they matter.
    two_sided
        Whether a size of the other sign is as plausible.
    """

    id: str
    description: str
    port: str
    unknowns: tuple[Unknown, ...]
    neutral: Mapping[str, float]
    trials: tuple[Mapping[str, float], ...]
    source: str = ""
    two_sided: bool = False
    units: Mapping[str, str] = field(default_factory=dict)
