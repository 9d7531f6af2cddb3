"""Laws as effects of a catalogue, and models that contain them, built as if a user had written the laws."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fmu_build.errors import ModelicaError
from fmu_build.flat_model import FlatModel
from fmu_build.instrument import State
from fmuid.core.campaign import ModelSpec
from fmuid.core.immutable import FloatArray
from fmuid.diagnosis.subject import Subject
from fmuid.diagnosis.variants import built_with, left_out, model_exchange
from fmuid.diagnosis.variants import with_laws as at_states
from fmuid.discovery.places import Spot
from fmuid.discovery.terms import HIDDEN, Term, names_in
from fmuid.effects.effect import Catalogue, Effect, Unknown
from fmuid.identification.problem.cases import LOGGED, RUN_TIME
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.segmented import in_place_of
from fmuid.simulation.simulator import Simulator

_MOST = 20.0  # largest coefficient, relative to the largest flow at the port
_STEP = 2e-3  # step of a coefficient, relative to that flow; ten times as much for a shape, relative to its value


@dataclass(frozen=True, slots=True, eq=False)
class Law:
    """Terms at a place, with the names of their parameters.

    Attributes
    ----------
    spot
        The place.
    terms
        Terms of the law.
    base
        Prefix of the names of its parameters.
    """

    spot: Spot
    terms: tuple[Term, ...]
    base: str

    @property
    def sizes(self) -> tuple[str, ...]:
        """Names of the coefficients, one per term."""
        return tuple(self._name("size", k) for k in range(len(self.terms)))

    def shapes(self, k: int) -> dict[str, str]:
        """Return the names of a term's shapes in the model, by those in its text."""
        return {n: self._name(n, k) for n in self.terms[k].shapes}

    def state(self, k: int) -> str:
        """Return the name of a term's state in the model."""
        return self._name(HIDDEN, k)

    def _name(self, what: str, k: int) -> str:
        return f"{self.base}_{what}" + (f"_{k + 1}" if len(self.terms) > 1 else "")

    @property
    def expression(self) -> str:
        """The law in Modelica: a flow at its port, or a coefficient that changes relative to its value."""
        flow = " + ".join(
            f"{size}*{_put_in(term.text, self._meant(k))}"
            for k, (size, term) in enumerate(zip(self.sizes, self.terms, strict=True))
        )
        return f"p*(1 + ({flow}))" if self.spot.port.kind == "parameter" else flow

    @property
    def states(self) -> tuple[State, ...]:
        """The law's own states."""
        return tuple(
            State(self.state(k), _put_in(term.rate, self._meant(k)))
            for k, term in enumerate(self.terms)
            if term.rate
        )

    def courses(self, values: Mapping[str, float]) -> tuple[FloatArray, ...]:
        """Return the (N,) flow along the time series of its place, in every experiment."""
        return tuple(
            np.sum(
                [
                    values[size] * term.course(c, t, {n: values[name] for n, name in self.shapes(k).items()})
                    for k, (size, term) in enumerate(zip(self.sizes, self.terms, strict=True))
                ],
                axis=0,
            )
            for c, t in zip(self.spot.courses, self.spot.time, strict=True)
        )

    def formula(self, values: Mapping[str, float]) -> str:
        """Return the law with numbers and units."""
        flow, text = self.spot.port.added_unit, ""
        for k, (size, term) in enumerate(zip(self.sizes, self.terms, strict=True)):
            numbers = {n: f"{values[name]:.4g} {term.shapes[n].unit}" for n, name in self.shapes(k).items()}
            product = f"{abs(values[size]):.4g} {flow} * {_put_in(term.text, numbers)}"
            sign = "-" if values[size] < 0.0 else "+"
            text += f" {sign} {product}" if text else product if sign == "+" else f"-{product}"
            if term.rate:
                text += f" where der({HIDDEN}) = {_put_in(term.rate, numbers)}"
        return text

    def _meant(self, k: int) -> dict[str, str]:
        return {**self.shapes(k), HIDDEN: self.state(k)}

    @property
    def rank(self) -> int:
        """Complexity of the law."""
        return sum(t.rank + 1 for t in self.terms)

    def effect(self, id: str, description: str, starts: Mapping[str, float] | None = None) -> Effect:
        """Return the law as an effect, off at its neutral values; shapes start from their values or `starts`."""
        flow, unit = self.spot.flow, self.spot.port.added_unit
        unknowns = [Unknown(n, 0.0, -_MOST * flow, _MOST * flow, _STEP * flow) for n in self.sizes]
        units = dict.fromkeys(self.sizes, unit)
        for k, term in enumerate(self.terms):
            for key, name in self.shapes(k).items():
                shape = term.shapes[key]
                start = min(max((starts or {}).get(name, shape.value), shape.lower), shape.upper)
                unknowns.append(Unknown(name, start, shape.lower, shape.upper, 10.0 * _STEP * shape.value))
                units[name] = shape.unit
        used = frozenset().union(
            *(names_in(text) for term in self.terms for text in (term.text, term.rate) if text)
        )
        logged = {q.name: q.unit for q in self.spot.quantities if q.name.startswith(LOGGED)} | {RUN_TIME: "s"}
        return Effect(
            id=id,
            description=description,
            port=self.spot.port.name,
            unknowns=tuple(unknowns),
            neutral={u.name: u.start for u in unknowns},
            trials=(dict.fromkeys(self.sizes, 0.05 * flow),),
            source="found from the measurements",
            two_sided=True,
            units=units,
            shapes=frozenset(units) - frozenset(self.sizes),
            expression=self.expression,
            acts="parameter" if self.spot.port.kind == "parameter" else "flow",
            states=self.states,
            variant=True,
            inputs={name: unit for name, unit in logged.items() if name in used},
        )


def free_name(models: Iterable[FlatModel | Fmu], port: str, word: str) -> str:
    """Return a name for a law at a port: a model that has laws of earlier diagnoses keeps their names."""
    taken = {n for model in models for n in model.variables}
    words = (f"{word}{k or ''}" for k in (0, *range(2, len(taken) + 3)))
    return next(w for w in words if not any(n.startswith(f"{port}.{w}_") for n in taken))


def _put_in(text: str, names: Mapping[str, str]) -> str:
    return re.sub(r"(?<![\w.])[A-Za-z_]\w*(?![\w.(])", lambda m: names.get(m.group(), m.group()), text)


def entry(effect: Effect) -> dict[str, Any]:
    """Return the table of an effect in a catalogue."""
    states = {s.name: {"derivative": s.derivative, "start": s.start} for s in effect.states}
    return {
        "description": effect.description,
        "source": effect.source,
        "port": effect.port,
        "acts": effect.acts,
        "expression": effect.expression,
        "two_sided": effect.two_sided,
        "variant": effect.variant,
        "trials": [dict(t) for t in effect.trials],
        **({"states": states} if states else {}),
        **({"inputs": dict(effect.inputs)} if effect.inputs else {}),
        "parameters": {
            u.name: {
                "start" if u.name in effect.shapes else "neutral": effect.neutral[u.name],
                "lower": u.lower,
                "upper": u.upper,
                "step": u.step,
                "unit": effect.units[u.name],
                **({"sd": u.sd} if np.isfinite(u.sd) else {}),
                **({"natural": True} if u.name in effect.natural else {}),
            }
            for u in effect.unknowns
        },
    }


def of_second_order(effect: Effect) -> Effect | None:
    """Return a law with two lags of half the time in a row for each one that it has; None if it has none."""
    states: list[State] = []
    for state in effect.states:
        driven, lags, time = state.derivative[1:].partition(f" - {state.name})/")
        if lags:
            before = State(f"{state.name}_before", f"({driven} - {state.name}_before)/({time}/2)", state.start)
            states += [before, replace(state, derivative=f"({before.name} - {state.name})/({time}/2)")]
        else:
            states.append(state)
    return replace(effect, states=tuple(states)) if len(states) > len(effect.states) else None


def _built(model: ModelSpec, catalogue: Catalogue) -> Path:
    """Build a model with all laws of a catalogue, if need be at the states of an FMU without source."""
    fmu = model_exchange(model)
    return built_with(model, catalogue) if fmu is None else at_states(fmu, catalogue)[1]


def with_laws(
    subject: Subject,
    models: Mapping[str, ModelSpec],
    load: Callable[[ModelSpec], Simulator],
    laws: Sequence[Effect],
    beside: Sequence[str],
) -> Subject:
    """Return the subject with models that carry `laws` and the effects `beside` them, and no other effects.

    Raises
    ------
    ModelicaError, BuildError
        A model cannot be built with them.
    """
    kept = {id: e for id, e in subject.catalogue.effects.items() if id in beside}
    catalogue = replace(subject.catalogue, effects=kept | {law.id: law for law in laws})
    used = {setup: models[setup] for setup in {case.setup for case in subject.model.cases}}
    simulators = {setup: load(replace(spec, fmu=_built(spec, catalogue))) for setup, spec in used.items()}
    variables = {name for simulator in simulators.values() for name in simulator.variables}
    for why, (id, *_) in left_out([models[setup] for setup in simulators], catalogue, variables).items():
        raise ModelicaError(f"the model cannot be built with '{id}': {why}")
    cases = tuple(
        case.with_model(in_place_of(case.simulator, simulators[case.setup])) for case in subject.model.cases
    )
    model = replace(subject.model, cases=cases, variant=lambda _, __: None)
    return replace(subject, model=model, catalogue=catalogue, effects=(*kept.values(), *laws))
