"""Models with effects: one model with effects that vanish while off, and variants for the others when tried."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from fmu_build.errors import InputDerivativeError
from fmu_build.flat_model import FlatModel
from fmu_build.instrument import Added, Term
from fmu_build.model_ports import find_ports
from fmu_build.suggest import suggestion
from fmuid.core.campaign import ModelSource, ModelSpec
from fmuid.core.errors import CampaignError
from fmuid.diagnosis.catalogue import Catalogue, Effect
from fmuid.diagnosis.ports import Port
from fmuid.simulation.model_source import built_with_terms, effects_inside, flat_model
from fmuid.simulation.simulator import Simulator


def carrier(source: ModelSource, catalogue: Catalogue) -> Path:
    """Build the model with those effects and inputs of a catalogue that act at its ports.

    For effects that change the model even while they are off, it only has the parameters: see `Variants`.

    Raises
    ------
    CampaignError
        The model has none of the ports at which effects act.
    """
    flat = flat_model(source)
    known = {port.name for port in find_ports(flat)}
    acting = [e for e in catalogue.effects.values() if e.expression]
    if acting and not any(e.port in known for e in acting):
        raise CampaignError(
            f"the model has no port '{acting[0].port}'",
            where=f"[effects.{acting[0].id!r}]",
            fix=suggestion(acting[0].port, known),
        )
    return _built(source, flat, catalogue, frozenset())


def built_with(model: ModelSpec, catalogue: Catalogue) -> Path:
    """Build a model with all that a catalogue adds at its ports, including effects that make variants.

    Raises
    ------
    ModelicaError, BuildError
        The model cannot be built.
    """
    assert model.source is not None
    return _built(model.source, flat_model(model.source), catalogue, catalogue.effects)


def _built(source: ModelSource, flat: FlatModel, catalogue: Catalogue, tried: Collection[str]) -> Path:
    """Build a model with the additions of a catalogue; effects that make variants only if `tried`.

    A signal that the model differentiates gets no input, since the derivative of an input is not known.
    """
    known = {port.name: port.kind for port in find_ports(flat)}
    terms, added, inside = [], [], effects_inside(source)
    for effect in catalogue.effects.values():
        if effect.expression and effect.port in known and effect.id not in inside:
            where = f"[effects.{effect.id!r}] expression"
            if not effect.variant or effect.id in tried:
                terms += terms_of(effect, where)
            added += [
                Added(u.name, effect.neutral[u.name], effect.units.get(u.name, ""), effect.description)
                for u in effect.unknowns
                if u.name not in flat.variables
            ]
    ports = {port.input: port for port in catalogue.ports.values() if port.added and port.name in known}
    while True:
        inputs = [Added(n, 0.0, p.unit, p.description, input=True) for n, p in ports.items() if n]
        driven = [_driven(port, signal=known[port.name] == "signal") for n, port in ports.items() if n]
        try:
            return built_with_terms(source, flat, [*terms, *driven], [*added, *inputs])
        except InputDerivativeError as error:
            if ports.pop(error.input, None) is None:
                raise


def _driven(port: Port, *, signal: bool) -> Term:
    """Return the term that adds a port's input to its signal or its flow."""
    where = f"[ports.{port.name!r}] input"
    if signal:
        return Term(port.name, "signal", f"p + {port.input}", where)
    return Term(port.name, "flow", str(port.input), where)


def terms_of(effect: Effect, where: str) -> list[Term]:
    """Return the terms that add an effect: while it is off, they vanish at no cost and its states stand still."""
    sizes = [u.name for u in effect.unknowns if u.name not in effect.shapes]
    neutral = [(name, effect.neutral[name]) for name in sizes]
    on = " or ".join(f"abs({name} - {off!r}) > 0" if off else f"abs({name}) > 0" for name, off in neutral)
    if not on or effect.acts == "cut":
        return [Term(effect.port, effect.acts, effect.expression, where, effect.states)]

    def gated(text: str, off: str = "0") -> str:
        return f"noEvent(if {on} then {text} else {off})" if text else ""

    states = tuple(replace(s, derivative=gated(s.derivative)) for s in effect.states)
    value = gated(effect.expression, "p" if effect.acts == "signal" else "0")
    first = Term(effect.port, effect.acts, value, where, states, gated(effect.reaction))
    return [first, Term(effect.port, "flow", gated(effect.flow), where)] if effect.flow else [first]


@dataclass(frozen=True, eq=False)
class Variants:
    """Models with effects that change the model even while they are off, built when one is first tried.

    Effects that have states or are part of algebraic loops share a model, in which those that are off stand still.
    Effects that cut connections get a model of their own.

    Attributes
    ----------
    models
        Models with source, by setup; their `fmu` carries the other effects.
    load
        Loads a model.
    """

    models: Mapping[str, ModelSpec]
    catalogue: Catalogue
    load: Callable[[ModelSpec], Simulator]
    _loaded: dict[tuple[str, frozenset[str]], Simulator] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def _effects(self) -> tuple[Effect, ...]:
        sources = [model.source for model in self.models.values() if model.source is not None]
        inside = {id for source in sources for id in effects_inside(source)}
        return tuple(e for e in self.catalogue.effects.values() if e.variant and e.id not in inside)

    def simulator(self, setup: str, values: Mapping[str, float]) -> Simulator | None:
        """Return the variant of a setup's model that parameter values need; None if they need none.

        Raises
        ------
        ModelicaError, BuildError
            The variant cannot be built.
        """
        on = [e for e in self._effects if _is_on(e, values)]
        if not on or setup not in self.models:
            return None
        uncut = any(e.acts != "cut" for e in on)
        tried = frozenset(e.id for e in self._effects if e in on or (uncut and e.acts != "cut"))
        if (setup, tried) not in self._loaded:
            model = self.models[setup]
            assert model.source is not None
            file = _built(model.source, flat_model(model.source), self.catalogue, tried)
            self._loaded[setup, tried] = self.load(replace(model, fmu=file))
        return self._loaded[setup, tried]


def _is_on(effect: Effect, values: Mapping[str, float]) -> bool:
    sizes = [u.name for u in effect.unknowns if u.name not in effect.shapes]
    return any(values.get(name, effect.neutral[name]) != effect.neutral[name] for name in sizes)
