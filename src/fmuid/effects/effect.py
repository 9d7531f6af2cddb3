"""An effect as a value: a law, the place where it acts, its parameters, states, flow and reaction."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from fmu_build.instrument import Acts, Added, State, Term

THRESHOLD = "beyond a threshold"  # words of a law that acts there only


@dataclass(frozen=True, slots=True)
class Unknown:
    """A parameter that is searched: bounds, and a step that is small but well above solver noise.

    With an `sd`, prior knowledge of it is a normal distribution around its start.
    """

    name: str
    start: float
    lower: float
    upper: float
    step: float
    sd: float = np.inf


@dataclass(frozen=True, slots=True)
class Port:
    """A place where an effect may act: an additive input of the model, or an output that is misread.

    Attributes
    ----------
    name
        Name of the port, as used by effects.
    input, output
        The model's input that is zero by default, or the measured output.
    magnitude
        A plausible disturbance in `unit`, at which responses are taken.
    added
        Whether `input` is to be added to the model's source, to the flow or the signal at the port of this name.
    """

    name: str
    input: str | None
    output: str | None
    magnitude: float
    unit: str = ""
    description: str = ""
    added: bool = False


@dataclass(frozen=True, slots=True)
class Regime:
    """A variable of the model that laws may depend on.

    Attributes
    ----------
    name
        Name used in the report.
    variable
        Variable of the model.
    kind
        ``speed`` (its sign is the direction), ``angle`` (in rad; laws repeat every turn) or ``value``.
    orders
        Periods per turn, for an angle.
    ports
        The only ports where functions of it act; any port if empty.
    """

    name: str
    variable: str
    kind: str = "value"
    unit: str = ""
    orders: tuple[int, ...] = (1, 2, 3, 4, 5, 6)
    ports: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Effect:
    """One effect of a catalogue.

    Attributes
    ----------
    id
        Short name; part of the interface.
    description, source
        Description of the effect, and its physical source.
    port
        Place where it acts on the model.
    law
        Name of its law, which may also act at other ports; ``value`` for a held parameter that may be off.
    unknowns
        Its parameters, both sizes and shapes; all are free in a refit.
    neutral
        Values at which the effect is off; for a shape, which matters only while the effect is on, its start value.
    shapes
        The parameters that are shapes.
    natural
        The parameters whose bounds are where the law itself ends, such as a share of 0 or 1.
    acts, expression
        How the effect acts at a port of the model's source, and the Modelica expression added there; empty if the
        model already has the effect (see `fmu_build.instrument`).
    flow, reaction
        Flow that acts in addition to a drop of potential, through the branch or out of its first node; empty if
        none does.
    states
        States of the expression.
    usual
        Whether this law is physically usual at this port, and so preferred among indistinguishable effects.
    variant
        Whether the effect changes the model even while it is off. Such a model is built only when the effect is
        tried.
    trials
        Plausible values for scoring: two or three magnitudes, with shapes where they matter.
    two_sided
        Whether a size of the opposite sign is equally plausible.
    units
        Units of the parameters.
    among
        Number of candidates of its kind from which it was chosen by a comparison with the same measurements.
    inputs
        Inputs that the model gets for the expression, with their units: logged columns that it does not use.
    over, within
        What a coefficient depends on, as in the id, and the places whose laws say the same: the branch or node
        whose coefficient and variable these are, or the input that multiplies it; empty for other effects.
    """

    id: str
    description: str
    port: str
    unknowns: tuple[Unknown, ...]
    neutral: Mapping[str, float]
    trials: tuple[Mapping[str, float], ...]
    law: str = ""
    source: str = ""
    two_sided: bool = False
    units: Mapping[str, str] = field(default_factory=dict)
    shapes: frozenset[str] = frozenset()
    natural: frozenset[str] = frozenset()
    acts: Acts = "flow"
    expression: str = ""
    flow: str = ""
    reaction: str = ""
    states: tuple[State, ...] = ()
    usual: bool = True
    variant: bool = False
    inputs: Mapping[str, str] = field(default_factory=dict)
    among: int = 1
    over: str = ""
    within: tuple[str, ...] = ()

    @property
    def sizes(self) -> tuple[str, ...]:
        """The parameters that are sizes."""
        return tuple(u.name for u in self.unknowns if u.name not in self.shapes)

    @property
    def threshold(self) -> str:
        """The parameter beyond whose value alone the effect acts; empty if it always acts."""
        beyond = (name for name in self.units if name.endswith("_threshold") and THRESHOLD in self.description)
        return next(beyond, "")

    @property
    def preference(self) -> tuple[bool, int, bool]:
        """Key by which indistinguishable effects are sorted: first the usual, the simple, a deviating value."""
        return not self.usual, len(self.unknowns), self.law != "value"

    @property
    def terms(self) -> list[Term]:
        """The terms that add the effect to a model: while it is off, they vanish and its states stand still."""
        where = f"[effects.{self.id!r}] expression"
        neutral = [(name, self.neutral[name]) for name in self.sizes]
        on = " or ".join(f"abs({name} - {off!r}) > 0" if off else f"abs({name}) > 0" for name, off in neutral)
        if not on or self.acts == "cut":
            return [Term(self.port, self.acts, self.expression, where, self.states)]

        def gated(text: str, off: str = "0") -> str:
            return f"noEvent(if {on} then {text} else {off})" if text else ""

        states = tuple(replace(s, derivative=gated(s.derivative)) for s in self.states)
        value = gated(self.expression, "p" if self.acts in ("signal", "parameter") else "0")
        first = Term(self.port, self.acts, value, where, states, gated(self.reaction))
        return [first, Term(self.port, "flow", gated(self.flow), where)] if self.flow else [first]

    def added(self, known: Collection[str] = ()) -> list[Added]:
        """Return the parameters and inputs that the terms use and that are not `known` to the model."""
        every = [
            Added(u.name, self.neutral[u.name], self.units.get(u.name, ""), self.description)
            for u in self.unknowns
        ]
        every += [Added(name, 0.0, unit, input=True) for name, unit in self.inputs.items()]
        return [one for one in every if one.name not in known]

    def scaled(self, trial: Mapping[str, float], factor: float, *, clipped: bool = True) -> dict[str, float]:
        """Return a trial with sizes scaled by `factor` from neutral, by default kept within their bounds."""
        values = {**self.neutral, **trial}
        for u in self.unknowns:
            if u.name in trial and u.name not in self.shapes:
                neutral = self.neutral[u.name]
                value = neutral + factor * (trial[u.name] - neutral)
                values[u.name] = float(np.clip(value, u.lower, u.upper)) if clipped else value
        return values

    def without(self, names: Collection[str]) -> Effect:
        """Return the effect without some of its parameters, and without the trials that concern them."""
        return replace(
            self,
            unknowns=tuple(u for u in self.unknowns if u.name not in names),
            neutral={n: v for n, v in self.neutral.items() if n not in names},
            trials=tuple(trial for trial in self.trials if not trial.keys() & set(names)),
            shapes=self.shapes - set(names),
            natural=self.natural - set(names),
            units={n: u for n, u in self.units.items() if n not in names},
        )


@dataclass(frozen=True, slots=True)
class Sensor:
    """A sensor that could be added: the variable of the model that it would read, and its white noise."""

    name: str
    variable: str
    noise: float
    unit: str = ""
    description: str = ""


@dataclass(frozen=True, slots=True)
class Catalogue:
    """Effects, ports, regimes and sensors by id, and FMUs with effects (by file stem of the plain FMU)."""

    effects: Mapping[str, Effect]
    ports: Mapping[str, Port]
    regimes: Mapping[str, Regime] = field(default_factory=dict)
    models: Mapping[str, str] = field(default_factory=dict)
    sensors: Mapping[str, Sensor] = field(default_factory=dict)
