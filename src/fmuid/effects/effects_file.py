"""Effects as data: what a model may lack, the parameters that add it, and plausible magnitudes.

The file format: ``docs/formats.md``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from fmu_build.instrument import Acts, State
from fmu_build.suggest import suggestion
from fmuid.core.errors import CampaignError
from fmuid.core.toml_tables import Table, convert, read_toml
from fmuid.effects.effect import Catalogue, Effect, Port, Regime, Sensor, Unknown


class _Parameter(Table):
    lower: float
    upper: float
    step: float
    neutral: float | None = None
    start: float | None = None
    sd: Annotated[float, msgspec.Meta(gt=0)] = math.inf
    natural: bool = False
    unit: str = ""


class _State(Table):
    derivative: str
    start: str = "0"
    unit: str = ""


class _Effect(Table):
    description: str
    port: str
    trials: list[dict[str, float]]
    parameters: dict[str, _Parameter]
    source: str = ""
    two_sided: bool = False
    acts: Acts = "flow"
    expression: str = ""
    flow: str = ""
    reaction: str = ""
    states: dict[str, _State] = msgspec.field(default_factory=dict)
    usual: bool = True
    variant: bool = False
    inputs: dict[str, str] = msgspec.field(default_factory=dict)
    among: Annotated[int, msgspec.Meta(ge=1)] = 1
    over: str = ""
    within: str | tuple[str, ...] = ()


class _Port(Table):
    description: str = ""
    unit: str = ""
    magnitude: float = 1.0
    input: str | None = None
    output: str | None = None
    added: bool = False


class _Regime(Table):
    variable: str
    kind: Literal["speed", "angle", "value"] = "value"
    unit: str = ""
    orders: tuple[int, ...] = (1, 2, 3, 4, 5, 6)
    ports: tuple[str, ...] = ()


class _Sensor(Table):
    variable: str
    noise: Annotated[float, msgspec.Meta(gt=0)]
    unit: str = ""
    description: str = ""


class _File(Table):
    format: str
    version: int
    effects: dict[str, _Effect]
    ports: dict[str, _Port] = msgspec.field(default_factory=dict)
    regimes: dict[str, _Regime] = msgspec.field(default_factory=dict)
    models: dict[str, str] = msgspec.field(default_factory=dict)
    sensors: dict[str, _Sensor] = msgspec.field(default_factory=dict)


def load_catalogue(path: Path) -> Catalogue:
    """Read and check a catalogue of effects.

    Raises
    ------
    CampaignError
        The file is missing, malformed, or an effect names a parameter or port that it does not declare.
    """
    file = convert(read_toml(path), _File, str(path))
    if file.format != "fmuid-effects" or file.version != 1:
        raise CampaignError(
            "is not a catalogue of effects, version 1", where=path, fix='write format = "fmuid-effects"'
        )
    ports = {
        name: Port(name, p.input, p.output, p.magnitude, p.unit, p.description, p.added)
        for name, p in file.ports.items()
    }
    effects = {name: _effect(name, e, ports, f"{path} [effects.{name}]") for name, e in file.effects.items()}
    _refuse_shared(effects, path)
    regimes = {n: Regime(n, r.variable, r.kind, r.unit, r.orders, r.ports) for n, r in file.regimes.items()}
    for regime in regimes.values():
        for port in regime.ports:
            _known_port(port, ports, f"{path} [regimes.{regime.name}]")
    sensors = {n: Sensor(n, s.variable, s.noise, s.unit, s.description) for n, s in file.sensors.items()}
    return Catalogue(effects, ports, regimes, dict(file.models), sensors)


def _known_port(port: str, ports: Mapping[str, Port], where: str) -> None:
    if port not in ports:
        raise CampaignError(f"unknown port '{port}'", where=where, fix=suggestion(port, ports))


def _refuse_shared(effects: Mapping[str, Effect], path: Path) -> None:
    """Refuse a parameter shared by two effects: fitted together, they could not be separated."""
    owner: dict[str, str] = {}
    for effect in effects.values():
        for u in effect.unknowns:
            if owner.setdefault(u.name, effect.id) != effect.id:
                raise CampaignError(
                    f"'{u.name}' is also a parameter of '{owner[u.name]}'",
                    where=f"{path} [effects.{effect.id}]",
                    fix="give each parameter to one effect",
                )


def _effect(name: str, raw: _Effect, ports: Mapping[str, Port], where: str) -> Effect:
    _known_port(raw.port, ports, where)
    for trial in raw.trials:
        for key in trial:
            if key not in raw.parameters:
                raise CampaignError(
                    f"a trial names '{key}', which is not one of its parameters",
                    where=where,
                    fix=suggestion(key, raw.parameters),
                )
    unknowns, neutral = [], {}
    for key, p in raw.parameters.items():
        start = p.neutral if p.neutral is not None else p.start
        if start is None or not p.lower <= start <= p.upper or p.step == 0.0:
            raise CampaignError(
                f"'{key}' needs a neutral or start value within its bounds, and a step", where=where, fix="add it"
            )
        unknowns.append(Unknown(key, start, p.lower, p.upper, abs(p.step), p.sd))
        neutral[key] = start
    if not raw.trials or not np.all([len(t) > 0 for t in raw.trials]):
        raise CampaignError("has no trials", where=where, fix="give plausible values for scoring it")
    return Effect(
        id=name,
        description=raw.description,
        port=raw.port,
        unknowns=tuple(unknowns),
        neutral=neutral,
        trials=tuple(dict(t) for t in raw.trials),
        law=name.partition("@")[0],
        source=raw.source,
        two_sided=raw.two_sided,
        units={key: p.unit for key, p in raw.parameters.items()},
        shapes=frozenset(key for key, p in raw.parameters.items() if p.neutral is None),
        natural=frozenset(key for key, p in raw.parameters.items() if p.natural),
        acts=raw.acts,
        expression=raw.expression,
        flow=raw.flow,
        reaction=raw.reaction,
        states=tuple(State(key, s.derivative, s.start, s.unit) for key, s in raw.states.items()),
        usual=raw.usual,
        variant=raw.variant or bool(raw.states) or raw.acts == "cut",
        inputs=dict(raw.inputs),
        among=raw.among,
        over=raw.over,
        within=(raw.within,) if isinstance(raw.within, str) else raw.within,
    )


def document_type() -> type[Table]:
    """Return the type of a whole catalogue, for editors."""
    return _File
