"""Models with effects: built into their source, around FMUs without it, and variants that are built when tried.

What a law adds to a state's derivative is in the derivative's unit: the size of a friction contains the inertia.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from fmu_build import check_flat
from fmu_build.cache import remove_unused, user_cache
from fmu_build.domains import MECHANICAL, Domain
from fmu_build.errors import InputDerivativeError, ModelicaError
from fmu_build.flat_model import ADDED, FlatModel
from fmu_build.instrument import Added, Term, instrument
from fmu_build.model_ports import Kind, Port, places
from fmu_build.suggest import suggestion
from fmu_build.syntax import Part, Reference
from fmu_build.unit_strings import parse_unit
from fmuid.core.campaign import Campaign, ModelSource, ModelSpec
from fmuid.core.errors import CampaignError, FmuError, SimulationError
from fmuid.core.files import make_folder, write_atomically
from fmuid.core.immutable import FloatArray
from fmuid.effects.effect import Catalogue, Effect
from fmuid.simulation.fmu import Fmu, load_fmu
from fmuid.simulation.fmu_with_laws import CoefficientLaw, StateLaw, carrier_version, write_fmu_with_laws
from fmuid.simulation.model_source import built_with_terms, effects_inside, fitting_with_terms, flat_model
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


@dataclass(frozen=True, slots=True, eq=False)
class _Addition:
    """What an effect or a port adds to a model: terms, and the parameters or the input that they use."""

    terms: Sequence[Term]
    names: Sequence[Added]


def _built(
    source: ModelSource, flat: FlatModel, catalogue: Catalogue, tried: Collection[str], most: int | None = None
) -> Path:
    """Build a model with the additions of a catalogue; effects that make variants only if `tried`.

    What the model cannot be built with is left out with its parameters: an input of a signal that the model
    differentiates, say, or with `most` a law with which the model has more states than those and the law's own.
    """
    known = places(flat)
    inside = effects_inside(source)
    every = []
    for effect in catalogue.effects.values():
        if effect.expression and effect.port in known and effect.id not in inside and _has(flat, effect):
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

    return _with_what_fits(source, flat, every, most)


def _with_what_fits(
    source: ModelSource, flat: FlatModel, additions: Sequence[_Addition], most: int | None
) -> Path:
    """Build a model with those of the additions with which it compiles; a wrong term is an error.

    Which ones these are is kept in the cache.
    """
    known = fitting_with_terms(source, flat, *_together(additions), most)
    if known.is_file():
        return _with_what_fits(source, flat, [additions[k] for k in json.loads(known.read_text())], most)
    try:
        file = built_with_terms(source, flat, *_together(additions))
        if most is not None:
            _require_states(len(load_fmu(file).states), additions, most)
        return file
    except ModelicaError as error:
        fitting = _without_input(additions, error)
        if len(fitting) == len(additions):
            acting = sorted((one for one in additions if one.terms), key=lambda one: one.terms[0].where)  # by law
            kept = _fitting(flat, acting, most, None)  # nearly all that do not fit do not fit alone
            kept = _fitting(flat, acting, most) if len(kept) == len(acting) else kept
            fitting = [one for one in additions if not one.terms or one in kept]
        if len(fitting) == len(additions) or not any(one.terms for one in fitting):
            raise
    write_atomically(known, json.dumps([k for k, one in enumerate(additions) if one in fitting]))
    return _with_what_fits(source, flat, fitting, most)


def _require_states(states: int, additions: Iterable[_Addition], most: int | None) -> None:
    """Raise an error if a model has more states than `most` and those of the additions.

    If an effect makes a variable of the model a state, the equations are singular while the effect is off.
    """
    added = sum(len(term.states) for one in additions for term in one.terms)
    if most is not None and states > most + added:
        raise ModelicaError("the model has other states with it")


def _has(flat: FlatModel, effect: Effect) -> bool:
    """Return whether a model has what a coefficient depends on, which models of other setups may lack."""
    try:
        if effect.over:
            instrument(flat, effect.terms, effect.added(flat.variables))
    except ModelicaError:
        return False
    return True


def _together(additions: Iterable[_Addition]) -> tuple[list[Term], list[Added]]:
    every = [*additions]
    return [term for one in every for term in one.terms], [name for one in every for name in one.names]


def _without_input(additions: Sequence[_Addition], error: ModelicaError) -> list[_Addition]:
    """Return the additions without that of the input whose derivative is needed, if the error says so.

    Of several that use one input, such as a column on which coefficients may depend, not all need its derivative.
    """
    wanted = error.input if isinstance(error, InputDerivativeError) else None
    fewer = [one for one in additions if wanted not in {name.name for name in one.names}]
    return fewer if len(additions) - len(fewer) == 1 else [*additions]


def _fitting(
    flat: FlatModel, additions: Sequence[_Addition], most: int | None, before: Sequence[_Addition] | None = ()
) -> list[_Addition]:
    """Return those of `additions` with which the model can be translated, together with those `before` them.

    None stands for no others before any of them: what only fails together is then kept.

    Raises
    ------
    ModelicaError
        A term is wrong by itself: it names what does not exist, or is not Modelica.
    """
    try:
        every = [*(before or ()), *additions]
        _require_states(len(check_flat(instrument(flat, *_together(every)))), every, most)
    except ModelicaError as error:
        fewer = _without_input(additions, error)
        if len(fewer) < len(additions):
            return _fitting(flat, fewer, most, before)
        if len(additions) <= 1:
            instrument(flat, *_together(additions))
            return []
    else:
        return [*additions]
    half = len(additions) // 2
    first = _fitting(flat, additions[:half], most, before)
    return [*first, *_fitting(flat, additions[half:], most, None if before is None else [*before, *first])]


def left_out(models: Iterable[ModelSpec], catalogue: Catalogue, variables: Set[str]) -> dict[str, list[str]]:
    """Return effects that `models` could not be built with, so that `variables` lack them, by reason."""
    lacking = [e for e in catalogue.effects.values() if e.expression and variables.isdisjoint(e.neutral)]
    flat = [flat_model(model.source) for model in models if lacking and model.source is not None]
    ports = [places(one) for one in flat]
    reasons: dict[str, list[str]] = {}
    for effect in lacking:
        having = [one for one, names in zip(flat, ports, strict=True) if effect.port in names]
        if having:
            reasons.setdefault(_why_not(effect, having), []).append(effect.id)
    return reasons


def _why_not(effect: Effect, models: Iterable[FlatModel]) -> str:
    """Return the messages of compiling flat models with an effect alone."""
    for flat in models:
        try:
            check_flat(instrument(flat, effect.terms, effect.added(flat.variables)))
        except ModelicaError as error:
            return error.what
    return "it does not go together with other effects"


@dataclass(frozen=True, eq=False)
class Variants:
    """Models with effects that change the model even while they are off, built when one is first tried.

    Effects that have states or are part of algebraic loops share a model, in which those that are off stand still.
    Effects that cut connections or make states of the model's variables, and those that the shared model cannot be
    built with, get a model of their own.

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
    _loaded: dict[tuple[str, frozenset[str], bool], Simulator] = field(
        default_factory=dict, init=False, repr=False
    )

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
        shared = frozenset(e.id for e in self._effects if e in on or (uncut and e.acts != "cut"))
        alone = frozenset(e.id for e in on)  # where others change the equation in which a coefficient varies
        for tried in dict.fromkeys((shared, alone)):
            key = setup, tried, tried == alone
            if key not in self._loaded:
                self._loaded[key] = self._build(self.models[setup], tried, others_off=tried != alone)
            built = self._loaded[key]
            lacking = [e.id for e in on if any(u.name not in built.variables for u in e.unknowns)]
            if not lacking:
                return built
        raise SimulationError(f"the model cannot be built with '{lacking[0]}'", where=setup)

    def _build(self, model: ModelSpec, tried: frozenset[str], *, others_off: bool) -> Simulator:
        """Build a model with effects, some of which may be off."""
        assert model.source is not None
        most = len(load_fmu(model.fmu).states) if others_off else None
        file = _built(model.source, flat_model(model.source), self.catalogue, tried, most)
        return self.load(replace(model, fmu=file))


def _is_on(effect: Effect, values: Mapping[str, float]) -> bool:
    sizes = [u.name for u in effect.unknowns if u.name not in effect.shapes]
    return any(values.get(name, effect.neutral[name]) != effect.neutral[name] for name in sizes)


_SAME = 1e-6  # of its largest value: within it, the derivative of one state is another state
_DOMAINS: tuple[tuple[str, Domain, Kind, str], ...] = (
    ("rad/s", "rotational", "node", "rad"),
    ("m/s", "translational", "node", "m"),
    ("K", "thermal", "node", "K"),
    ("A", "electrical", "loop", ""),
    ("V", "electrical", "node", "V"),
    ("Pa", "fluid", "node", "Pa"),
    ("m", "fluid", "node", "m"),
    ("m3", "fluid", "node", "m3"),
)
"""Unit of a state, the domain and kind of its place, and the unit of the potential there."""


@dataclass(frozen=True, slots=True)
class StatePlace:
    """A place at a state, with the sizes (P, V, F, ...) of a nominal simulation.

    `names` are the variables of the FMU for the names that laws use, and `unit` is that of what laws add.
    """

    port: Port
    sizes: Mapping[str, float]
    names: Mapping[str, str]


def model_exchange(model: ModelSpec) -> Fmu | None:
    """Return the FMU of a model without source for model exchange, None if it does not offer that."""
    if model.source is not None or model.coupling is not None or model.fmu.suffix != ".fmu":
        return None
    fmu = load_fmu(model.fmu)
    offered = fmu.description.model_exchange is not None and bool(fmu.states)
    return load_fmu(model.fmu, "model exchange") if offered else None


def observed_states(fmu: Fmu) -> list[str]:
    """Return the variables to simulate for the sizes of places: states and their derivatives."""
    return list(dict.fromkeys([*fmu.derivatives, *fmu.derivatives.values()]))


def state_places(
    fmu: Fmu, times: Sequence[FloatArray], courses: Sequence[Mapping[str, FloatArray]]
) -> tuple[list[StatePlace], dict[str, str]]:
    """Return the places at the states of an FMU, and why other states are none, by state.

    Parameters
    ----------
    fmu
        The FMU.
    times, courses
        Times of nominal simulations, and the `observed_states` there.
    """
    derivatives = fmu.derivatives
    positions = _positions(derivatives, courses)
    places, reasons = [], {}
    for state, derivative in derivatives.items():
        if state in positions.values():
            continue  # its derivative is a speed, at which forces act
        domain_of_state = _domain(fmu, state, positions.get(state))
        if domain_of_state is None:
            unit = fmu.variables[state].unit
            reasons[state] = f"has the unit {unit}, for which there are no laws" if unit else "has no unit"
            continue
        domain, kind, potential = domain_of_state
        if kind == "loop":
            names = {"through": state}
        elif domain in MECHANICAL:
            names = {"rate": state, "acceleration": f"der({state})"}
            if state in positions and _is_angle_or_length(fmu, positions[state], potential):
                names["p"] = positions[state]
        else:
            names = {"p": state}
        port = _port(state, domain_of_state, fmu.variables[state].unit or "1", names)
        sizes = _sizes(port, derivative, times, courses)
        if sizes:
            places.append(StatePlace(port, sizes, names))
    return places, reasons


def _positions(derivatives: Mapping[str, str], courses: Sequence[Mapping[str, FloatArray]]) -> dict[str, str]:
    """Return the state of which each speed is the derivative."""
    positions = {}
    for speed in derivatives:
        for position, derivative in derivatives.items():
            same = [_alike(course[derivative], course[speed]) for course in courses]
            if position != speed and all(same) and any(np.ptp(course[speed]) > 0.0 for course in courses):
                positions[speed] = position
                break
    return positions


def _alike(a: FloatArray, b: FloatArray) -> bool:
    return bool(np.abs(a - b).max() <= _SAME * np.abs(b).max())


def _domain(fmu: Fmu, state: str, position: str | None) -> tuple[Domain, Kind, str] | None:
    """Return domain and kind of the place at a state, and the unit of the potential there."""
    dimension = _dimension(fmu.variables[state].unit)
    if position is not None and dimension in (None, _dimension("1")):
        turns = _dimension(fmu.variables[position].unit) == _dimension("rad")
        return ("rotational", "node", "rad") if turns else ("translational", "node", "m")
    for unit, domain, kind, potential in _DOMAINS:
        if dimension is not None and dimension == _dimension(unit):
            return domain, kind, potential
    return None


def _dimension(unit: str | None) -> tuple[int, ...] | None:
    parsed = parse_unit(unit) if unit else None
    return None if parsed is None else parsed[2]


def _is_angle_or_length(fmu: Fmu, position: str, potential: str) -> bool:
    """Return whether a position is in rad, or is a length."""
    unit = fmu.variables[position].unit
    parsed = parse_unit(unit) if unit else None
    return potential == "m" or parsed is None or parsed[0] == 1.0


def _port(state: str, place: tuple[Domain, Kind, str], unit: str, names: Mapping[str, str]) -> Port:
    domain, kind, potential = place
    if domain in MECHANICAL:
        plain = "/" in unit or unit == "1"
        units = (potential, f"{potential}.s-2" if plain else f"{unit}.s-1")
    else:
        units = (f"{unit}.s-1", unit) if kind == "loop" else (unit, f"{unit}.s-1")
    probes = {name: (names[name],) for name in ("p", "rate") if name in names}
    quantities = {name: Reference(ADDED, (Part(variable),)) for name, variable in names.items()}
    return Port(f"der({state})", kind, domain, (), units, quantities, probes)


def _sizes(
    port: Port, derivative: str, times: Sequence[FloatArray], courses: Sequence[Mapping[str, FloatArray]]
) -> dict[str, float]:
    """Return the sizes of a place; empty if nothing happens there."""

    def largest(series: Sequence[FloatArray]) -> float:
        return max(float(np.abs(one).max()) for one in series)

    flows = [course[derivative] for course in courses]
    state = port.name.removeprefix("der(").removesuffix(")")
    here = [course[state] for course in courses]
    sizes = {"T": max(float(t[-1] - t[0]) for t in times), "F": largest(flows)}
    if port.kind == "loop":  # the current is a flow; what opposes it is a drop of potential
        sizes |= {"P": sizes["F"], "F": largest(here), "V": sizes["F"]}
    elif port.domain in MECHANICAL:
        sizes |= {"V": largest(here), "A": sizes["F"]}
        if "p" in port.probes:
            p = [course[port.probes["p"][0]] for course in courses]
            sizes |= {"P": max(float(np.ptp(x)) for x in p), "M": largest(p), "Z": float(p[0][0])}
    else:
        sizes |= {"P": max(float(np.ptp(x)) for x in here), "M": largest(here), "V": sizes["F"]}
        sizes["Z"] = float(here[0][0])
    known = {name: value for name, value in sizes.items() if value > 0.0 or name == "Z"}
    return known if "F" in known and ("P" in known or "V" in known) else {}


def state_of(port: str, states: Collection[str]) -> str | None:
    """Return the state at whose derivative a port is, None if it is another port."""
    return next((s for s in states if port == f"der({s})"), None)


def varying_parameters(fmu: Fmu) -> list[str]:
    """Return the parameters of an FMU for model exchange that may vary during a run, none if it has events."""
    exchange = fmu.description.model_exchange
    inputs = [v for v in fmu.variables.values() if v.causality == "input"]
    steady = all(v.variability == "continuous" for v in inputs) and not fmu.description.n_indicators
    if exchange is None or exchange.once or not steady:
        return []
    return [
        v.name
        for v in fmu.variables.values()
        if v.causality == "parameter" and v.type in ("Real", "Float64") and fmu.slots[v.name].size == 1
    ]


def acts_on(fmu: Fmu, effect: Effect) -> bool:
    """Return whether an effect acts at a state or on a parameter of an FMU for model exchange."""
    if effect.acts == "parameter":
        return bool(effect.expression) and effect.port in fmu.slots
    return bool(effect.expression) and state_of(effect.port, fmu.states) is not None


def with_laws(fmu: Fmu, catalogue: Catalogue, effects: Collection[Effect] | None = None) -> tuple[Path, Path]:
    """Return copies of an FMU in the user's cache: as it is, and with the laws and inputs of a catalogue.

    Parameters
    ----------
    fmu
        The FMU, for model exchange.
    catalogue
        Its effects and inputs at the FMU's states are added.
    effects
        If given, only these effects and no inputs.

    Raises
    ------
    FmuError
        An effect varies a parameter that cannot vary.
    """
    states = fmu.states
    every = catalogue.effects.values() if effects is None else effects
    acting = [e for e in every if acts_on(fmu, e)]
    inputs = [(p, s) for p in catalogue.ports.values() if p.added and p.input and (s := state_of(p.name, states))]
    inputs = inputs if effects is None else []
    laws = [_law(fmu, e) for e in acting]
    added = list({one.name: one for e in acting for one in e.added(fmu.variables)}.values())
    laws += [StateLaw(s, port.input, where=f"[ports.{port.name!r}] input") for port, s in inputs if port.input]
    added += [Added(port.input, 0.0, port.unit, port.description, input=True) for port, _ in inputs if port.input]
    content = hashlib.sha256(fmu.path.read_bytes()).hexdigest()
    digest = hashlib.sha256(repr((content, laws, added, carrier_version())).encode()).hexdigest()
    folder = user_cache() / "models" / content[:16]
    plain, carrier = folder / fmu.path.name, folder / f"{fmu.path.stem}-{digest[:12]}.fmu"
    make_folder(folder)
    remove_unused(user_cache() / "models", "*/*-*.fmu")
    if not plain.is_file():
        shutil.copyfile(fmu.path, plain)
    if not carrier.is_file():
        write_fmu_with_laws(fmu, laws, added, carrier)
    return plain, carrier


def _law(fmu: Fmu, effect: Effect) -> StateLaw | CoefficientLaw:
    where = f"[effects.{effect.id!r}]"
    if effect.acts != "parameter":
        state = state_of(effect.port, fmu.states) or ""
        return StateLaw(state, effect.expression, _off(effect), effect.states, where)
    if effect.port not in varying_parameters(fmu):
        what = f"the parameter '{effect.port}' of {fmu.path.name} cannot vary during a run"
        raise FmuError(what, where=where, fix="leave the effect out; it needs an FMU without events")
    return CoefficientLaw(effect.port, effect.expression, _off(effect), effect.states, where)


def _off(effect: Effect) -> dict[str, float]:
    return {name: effect.neutral[name] for name in effect.sizes}


def exchanged(campaign: Campaign) -> dict[str, Fmu]:
    """Return the FMUs at whose states laws may act, by setup; none if an observer corrects the states."""
    if any(stage.observer for stage in campaign.stages.values()):
        return {}
    used = {e.setup for e in campaign.measurements}
    exchanged_models = {name: model_exchange(m) for name, m in campaign.models.items() if name in used}
    return {name: fmu for name, fmu in exchanged_models.items() if fmu is not None}
