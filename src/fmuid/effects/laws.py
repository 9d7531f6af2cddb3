"""The library of laws, and the entries of a catalogue that laws make at the places of a model."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files

import msgspec

from fmu_build.instrument import Acts
from fmu_build.model_ports import Port
from fmuid.core.formulas import parse
from fmuid.core.toml_tables import Table, convert, toml_text
from fmuid.effects.effect import THRESHOLD

SIZES = "PMZVAFTLWN"
SHARES = (0.01, 0.05, 0.2)  # sizes at which a law is tried, as shares of the nominal flow
_SHARPEST = 0.005  # of the range of what a law depends on: how soon it acts beyond a threshold, at least
_FIRST = 0.04  # of that range: how soon it does where the search for that begins, about half a step of thresholds
_FARTHER = 0.5  # of that range: how far outside a threshold may lie, as a model that lacks the law moves less


class LawParameter(Table):
    """A parameter of a law; its numbers are formulas of the sizes at a place."""

    least: str
    most: str
    off: str | None = None
    start: str | None = None
    scale: str | None = None
    natural: bool = False
    unit: str = ""


class LawState(Table):
    """A state of a law, in Modelica."""

    derivative: str
    start: str = "0"


class Law(Table):
    """A law of the library; ``laws.toml`` explains its keys."""

    words: str
    origin: str
    source: str
    domains: list[str]
    on: list[str]
    acts: Acts
    expression: str | dict[str, str]
    parameters: dict[str, LawParameter]
    flow: str = ""
    reaction: str = ""
    states: dict[str, LawState] = msgspec.field(default_factory=dict)
    two_sided: bool = False
    compliant: bool = False
    body: bool = False
    absolute: bool = False
    coil: bool = False
    signed: bool = False
    memory: bool = False
    variant: bool = False
    trials: list[dict[str, str]] | None = None

    def of(self, domain: str) -> str:
        """Return the expression in a domain."""
        return self.expression if isinstance(self.expression, str) else self.expression[domain]

    def slides_at(self, port: Port) -> bool:
        """Return whether the law is one of sliding, and the port a branch that slides."""
        return port.slides and "slide" in self.on

    def may_act(self, port: Port) -> bool:
        """Return whether the law is for a port of this domain and kind, and the port has what it uses."""
        if port.domain not in self.domains or not (port.kind in self.on or self.slides_at(port)):
            return False
        cuts = self.acts == "cut"
        if (self.compliant and (port.slides or not port.compliant)) or (
            cuts and port.kind == "branch" and not port.rigid
        ):
            return False
        if (self.body and "acceleration" not in port.quantities) or (self.absolute and port.units[0] != "K"):
            return False
        if self.coil and not (port.coil or port.kind == "loop"):
            return False
        drops = port.kind == "loop" or bool(port.differences)
        if port.shares and (cuts or self.reaction or (self.acts == "potential" and not drops)):
            return False
        if port.shares and port.kind == "branch" and len(port.shares) == 1 and not self.compliant:
            return False  # a node has the law, too
        given = {*port.quantities, "time", *self.parameters, *self.states, *SIZES}
        given |= {"rate"} if cuts else {"position"} if port.kind == "branch" else set()
        of_states = (text for s in self.states.values() for text in (s.derivative, s.start))
        used = [self.of(port.domain), self.flow, self.reaction, *of_states]
        return all(names_in(text) <= given for text in used)

    def changes(self, port: Port) -> bool:
        """Return whether the law changes the model even while it is off, if only its states or its loops."""
        loops = port.loops and "load" in names_in(self.of(port.domain))
        makes_loops = self.variant and port.kind != "loop"  # the current through a coil is a state
        return makes_loops or loops or (self.acts == "potential" and bool(port.preferred or port.differences))

    def at(self, port: Port) -> Law:
        """Return the law at a port; where the flow through a branch is unknown, without what acts besides."""
        if not port.differences or names_in(self.flow) <= {*port.quantities, *self.parameters}:
            return self
        used = set().union(*map(names_in, (self.of(port.domain), *(s.derivative for s in self.states.values()))))
        return self._with(used, flow="")

    def beyond(
        self,
        domain: str,
        of: str,
        reach: tuple[float, float],
        *,
        threshold: float,
        unit: str,
        fixed: Collection[str] = (),
    ) -> Law:
        """Return the law in a domain where what it depends on is beyond a threshold, and no effect below it.

        Parameters
        ----------
        of, reach
            What it depends on, in Modelica, and its range in runs of a model without the law, which may move less.
        threshold
            Where the search for it begins.
        fixed
            Shapes of the law that stay where they start.
        """
        least, most = reach
        width = most - least
        text = _put_in(self.of(domain), {key: f"({self.parameters[key].start})" for key in fixed})
        farther, first = _FARTHER * width, _FIRST * width
        here = LawParameter(
            repr(least - farther), repr(most + farther), start=repr(threshold), natural=True, unit=unit
        )
        soon = LawParameter(repr(_SHARPEST * width), repr(width), start=repr(first), natural=True, unit=unit)
        law = self._with(self.parameters.keys() - {*fixed}, words=f"{self.words} {THRESHOLD}")
        return msgspec.structs.replace(
            law,
            expression=f"({text})*(0.5 + 0.5*tanh(({of} - threshold)/transition))",
            parameters={**law.parameters, "threshold": here, "transition": soon},
        )

    def _with(self, kept: Collection[str], **changes: str) -> Law:
        """Return the law with some of its parameters, and trials of these."""
        parameters = {key: p for key, p in self.parameters.items() if key in kept}
        trials = [{k: v for k, v in trial.items() if k in kept} for trial in self.trials or ()] or None
        return msgspec.structs.replace(self, parameters=parameters, trials=trials, **changes)

    def may_be_sized(self, sizes: Collection[str]) -> bool:
        """Return whether these sizes are all that the law's numbers depend on."""
        texts = [t for p in self.parameters.values() for t in (p.scale, p.most, p.start) if t]
        used = {n for text in texts for n in parse(text).names}
        expressions = [self.expression] if isinstance(self.expression, str) else self.expression.values()
        every = (*expressions, *(s.derivative for s in self.states.values()))
        used |= {n for text in every for n in names_in(text) & set(SIZES)}
        return used <= set(sizes)


@dataclass(frozen=True, slots=True)
class Place:
    """A port with the sizes (P, V, F, ...) of its nominal simulation.

    Attributes
    ----------
    names
        Of a place at a state of an FMU: the FMU's variables for the names that laws use.
    owner
        What the parameters of laws belong to by their names; the port if empty.
    """

    port: Port
    sizes: Mapping[str, float]
    names: Mapping[str, str] = field(default_factory=dict)
    owner: str = ""


@cache
def laws() -> Mapping[str, Law]:
    """Return the library of laws by name."""
    text = files("fmuid.effects").joinpath("laws.toml").read_text()
    return {name: convert(raw, Law, f"laws.toml [{name}]") for name, raw in tomllib.loads(text).items()}


def fitting(place: Place) -> Iterator[tuple[str, Law]]:
    """Yield the laws that may act at a port: for its domain and kind, using quantities and sizes that it has."""
    for name, law in laws().items():
        here = law.at(place.port)
        if here.may_act(place.port) and here.may_be_sized(place.sizes):
            yield name, here


def names_in(modelica: str) -> set[str]:
    """Return the names of variables in a Modelica expression."""
    words = re.findall(r"(?<!\w)([A-Za-z_]\w*)\s*(\(?)", modelica)
    return {name for name, called in words if not called} - {"if", "then", "else", "elseif", "and", "or", "not"}


@dataclass(frozen=True, slots=True)
class Dependence:
    """What a coefficient depends on: name, Modelica text, whether it is usual and whether it makes a variant.

    `inputs` are inputs that the model gets for it, with their units; `among` is the number of dependences that
    were compared; `within` are the places of both, or the input that multiplies it.
    """

    name: str
    text: str
    usual: bool
    variant: bool
    inputs: Mapping[str, str]
    among: int = 1
    within: tuple[str, ...] = ()


def varying_id(parameter: str, over: str) -> str:
    """Return the id of the effect that a parameter varies over something, whatever the shape of the law."""
    return f"varies@{parameter}({over})"


def effect_lines(name: str, law: Law, place: Place, over: Dependence | None = None) -> list[str]:
    """Return the lines of a catalogue for a law at a place; of a coefficient that varies `over` something."""
    port, sizes = place.port, place.sizes
    base, id, words = f"{place.owner or port.name}.{name}", f"{name}@{port.name}", f"{port.name}: {law.words}"
    if over is not None:
        name = name.partition("_")[0]
        base = f"{port.name.replace(':', '.')}.{name}.{re.sub(r'[^A-Za-z0-9]+', '_', over.name).strip('_')}"
        id, words = varying_id(port.name, over.name), f"{words} {over.name}"
    parameter_names = {key: base if key == "size" else f"{base}_{key}" for key in law.parameters}

    def value(text: str) -> float:
        return parse(text, where=f"laws.toml [{name}]")(sizes)

    states = {key: f"{base}_{key}" for key in law.states}
    numerals = {s: numeral(v, 6 if over else 3) for s, v in sizes.items()}
    meant = {**place.names, **parameter_names, **states, **numerals}
    if over is not None:
        meant["x"] = over.text
    expression = _put_in(law.of(port.domain), meant)
    if law.trials is None:
        trials = [
            {
                parameter_names[k]: value(p.off or "0") + share * value(p.scale)
                for k, p in law.parameters.items()
                if p.scale
            }
            for share in SHARES
        ]
    else:
        every = [{parameter_names[k]: value(v) for k, v in trial.items()} for trial in law.trials]
        trials = [trial for i, trial in enumerate(every) if trial not in every[:i]]
    units = {"p": port.units[0], "f": port.units[1], "x": port.units[0]}
    table = f"[effects.{toml_text(id)}"
    common = port.kind == law.on[0] or law.slides_at(port) or (law.coil and port.coil)
    usual = common if over is None else over.usual
    variant = law.changes(port) if over is None else over.variant
    lines = [
        f"{table}]",
        f"description = {toml_text(words)}",
        f"source = {toml_text(f'{law.origin}. {law.source}')}",
        f"port = {toml_text(port.name)}",
        f"acts = {toml_text(law.acts)}",
        f"expression = {toml_text(expression)}",
        *([f"flow = {toml_text(_put_in(law.flow, meant))}"] if law.flow else []),
        *([f"reaction = {toml_text(_put_in(law.reaction, meant))}"] if law.reaction else []),
        *(["two_sided = true"] if law.two_sided else []),
        *([] if usual else ["usual = false"]),
        *(["variant = true"] if variant else []),
        *([f"among = {over.among}", f"over = {toml_text(over.name)}"] if over is not None else []),
        *([f"within = [{', '.join(map(toml_text, over.within))}]"] if over is not None and over.within else []),
        *(f"inputs.{toml_text(n)} = {toml_text(unit)}" for n, unit in (over.inputs if over else {}).items()),
        f"trials = [{', '.join(inline(t) for t in trials)}]",
        f"{table}.parameters]",
    ]
    for key, state in law.states.items():
        derivative = _put_in(state.derivative, meant)
        start = _put_in(state.start, meant)
        rows = f"derivative = {toml_text(derivative)}, start = {toml_text(start)}"
        lines.insert(-1, f"states.{toml_text(states[key])} = {{ {rows} }}")
    for key, p in law.parameters.items():
        least, most = value(p.least), value(p.most)
        kind = "neutral" if p.off is not None else "start"
        first = value(p.off if p.off is not None else p.start or "0")
        step = 2e-3 * value(p.scale) if p.scale else 0.02 * first or 2e-3 * (most - least)
        numbers = {kind: first, "lower": least, "upper": most, "step": step}
        inside = ", ".join(f"{k} = {v:.6g}" for k, v in numbers.items()) + ", natural = true" * p.natural
        known = all(units[what] for what in re.findall(r"{(\w)}", p.unit))
        unit = toml_text(p.unit.format(**units) if known else "")
        lines.append(f"{toml_text(parameter_names[key])} = {{ {inside}, unit = {unit} }}")
    return [*lines, ""]


def numeral(value: float, digits: int) -> str:
    """Return a number to put into an expression; Modelica has no ``x - -1``."""
    return f"({value:.{digits}g})" if value < 0.0 else f"{value:.{digits}g}"


def _put_in(expression: str, names: Mapping[str, str]) -> str:
    return re.sub(r"(?<!\w)[A-Za-z_]\w*", lambda m: names.get(m.group(), m.group()), expression)


def inline(values: Mapping[str, float]) -> str:
    """Return numbers as an inline table."""
    return "{ " + ", ".join(f"{toml_text(n)} = {v:.6g}" for n, v in values.items()) + " }"
