"""Models with effects: one model with effects that vanish while off, and variants for the others when tried."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from fmu_build import compile_flat
from fmu_build.errors import InputDerivativeError, ModelicaError
from fmu_build.flat_model import FlatModel
from fmu_build.instrument import Added, Term, instrument
from fmu_build.model_ports import places
from fmu_build.suggest import suggestion
from fmuid.core.campaign import ModelSource, ModelSpec
from fmuid.core.errors import CampaignError, SimulationError
from fmuid.effects.effect import Catalogue, Effect
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
    known = places(flat).keys()
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
        The plain model cannot be built, or a term is wrong by itself.
    """
    assert model.source is not None
    return _built(model.source, flat_model(model.source), catalogue, catalogue.effects)


@dataclass(frozen=True, slots=True)
class _Addition:
    """What an effect or a port adds to a model: terms, and the parameters or the input that they use."""

    terms: Sequence[Term]
    names: Sequence[Added]


def _built(source: ModelSource, flat: FlatModel, catalogue: Catalogue, tried: Collection[str]) -> Path:
    """Build a model with the additions of a catalogue; effects that make variants only if `tried`.

    What the model cannot be built with is left out with its parameters: an input of a signal that the model
    differentiates, say, or a law that decides how many states there are.
    """
    known = places(flat)
    inside = effects_inside(source)
    every = []
    for effect in catalogue.effects.values():
        if effect.expression and effect.port in known and effect.id not in inside:
            acts = not effect.variant or effect.id in tried
            every.append(_Addition(effect.terms if acts else [], effect.added(flat.variables)))
    for port in catalogue.ports.values():
        if port.added and port.input and port.name in known:
            where = f"[ports.{port.name!r}] input"
            term = (
                Term(port.name, "signal", f"p + {port.input}", where)
                if known[port.name] == "signal"
                else Term(port.name, "flow", port.input, where)
            )
            every.append(_Addition([term], [Added(port.input, 0.0, port.unit, port.description, input=True)]))

    return _with_what_fits(source, flat, every)


def _with_what_fits(source: ModelSource, flat: FlatModel, additions: Sequence[_Addition]) -> Path:
    """Build a model with those of the additions with which it compiles; a wrong term is an error."""
    try:
        return built_with_terms(source, flat, *_together(additions))
    except ModelicaError as error:
        fitting = _without_input(additions, error)
        if len(fitting) == len(additions):
            acting = sorted((one for one in additions if one.terms), key=lambda one: one.terms[0].where)  # by law
            kept = {id(one) for one in _fitting(flat, acting)}
            fitting = [one for one in additions if not one.terms or id(one) in kept]
        if len(fitting) == len(additions) or not any(one.terms for one in fitting):
            raise
    return _with_what_fits(source, flat, fitting)


def _together(additions: Iterable[_Addition]) -> tuple[list[Term], list[Added]]:
    every = [*additions]
    return [term for one in every for term in one.terms], [name for one in every for name in one.names]


def _without_input(additions: Sequence[_Addition], error: ModelicaError) -> list[_Addition]:
    """Return the additions without the input whose derivative is needed, if the error says so."""
    wanted = error.input if isinstance(error, InputDerivativeError) else None
    return [one for one in additions if wanted not in {name.name for name in one.names}]


def _fitting(flat: FlatModel, additions: Sequence[_Addition], before: Sequence[_Addition] = ()) -> list[_Addition]:
    """Return those of `additions` with which the model can be compiled, together with those `before` them.

    Raises
    ------
    ModelicaError
        A term is wrong by itself: it names what does not exist, or is not Modelica.
    """
    instrumented = instrument(flat, *_together((*before, *additions)))
    try:
        compile_flat(instrumented)
    except ModelicaError as error:
        fewer = _without_input(additions, error)
        if len(fewer) < len(additions):
            return _fitting(flat, fewer, before)
        if len(additions) <= 1:
            return []
    else:
        return [*additions]
    half = len(additions) // 2
    first = _fitting(flat, additions[:half], before)
    return [*first, *_fitting(flat, additions[half:], [*before, *first])]


def left_out(models: Iterable[ModelSpec], catalogue: Catalogue, variables: Set[str]) -> dict[str, list[str]]:
    """Return effects that `models` could not be built with, so that `variables` lack them, by reason."""
    lacking = [e for e in catalogue.effects.values() if e.expression and variables.isdisjoint(e.neutral)]
    flat = [flat_model(model.source) for model in models if lacking and model.source is not None]
    ports = [places(one) for one in flat]
    found: dict[str, list[str]] = {}
    for effect in lacking:
        having = [one for one, own in zip(flat, ports, strict=True) if effect.port in own]
        if having:
            found.setdefault(_why_not(effect, having), []).append(effect.id)
    return found


def _why_not(effect: Effect, models: Iterable[FlatModel]) -> str:
    """Return the messages of compiling flat models with an effect alone."""
    for flat in models:
        try:
            compile_flat(instrument(flat, effect.terms, effect.added(flat.variables)))
        except ModelicaError as error:
            return error.what
    return "it does not go together with other effects"


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
        SimulationError
            The model cannot be built with an effect that is on.
        BuildError
            The C compiler fails.
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
        built = self._loaded[setup, tried]
        for effect in on:
            if any(u.name not in built.variables for u in effect.unknowns):
                raise SimulationError(f"the model cannot be built with '{effect.id}'", where=setup)
        return built


def _is_on(effect: Effect, values: Mapping[str, float]) -> bool:
    sizes = [u.name for u in effect.unknowns if u.name not in effect.shapes]
    return any(values.get(name, effect.neutral[name]) != effect.neutral[name] for name in sizes)
