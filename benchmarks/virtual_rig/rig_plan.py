"""A measurement plan, `rig.toml`: which actuator, which sensors, which experiments; and its execution."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from benchmarks.virtual_rig.inputs import samples
from benchmarks.virtual_rig.library import parameter_table
from benchmarks.virtual_rig.recorder import Sensors, record
from benchmarks.virtual_rig.rig import Rig, Run, usual_step
from fmu_build.suggest import suggestion
from fmuid.core.errors import CampaignError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.core.immutable import FloatArray, frozen_mapping, read_only
from fmuid.core.toml_tables import Table, convert, numbers, read_toml

FILE_NAME = "rig.toml"


@dataclass(frozen=True, slots=True, eq=False)
class PlannedExperiment:
    """One experiment to be recorded: `inputs` (N,) every `interval` s, and the settings it is run with."""

    id: str
    setup: str
    interval: float
    inputs: FloatArray
    settings: Mapping[str, float] = field(default_factory=dict)
    description: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "inputs", read_only(self.inputs))
        object.__setattr__(self, "settings", frozen_mapping(self.settings))


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """What is to be measured, on what, how often."""

    rig: Rig
    sensors: Sensors
    experiments: tuple[PlannedExperiment, ...]
    repeats: int = 5
    seed: int = 0
    title: str = ""


class _RigTable(Table):
    loss_table: list[list[float]]
    title: str = ""
    seed: int = 0
    repeats: int = 5
    parameters: dict[str, Any] = msgspec.field(default_factory=dict)
    sensors: dict[str, Any] = msgspec.field(default_factory=dict)


class _ExperimentTable(Table):
    setup: str
    interval: float
    duration: float
    input: dict[str, Any]
    settings: dict[str, Any] = msgspec.field(default_factory=dict)
    description: str = ""


class _Document(Table):
    rig: dict[str, Any]
    experiments: dict[str, dict[str, Any]] = msgspec.field(default_factory=dict)


def load_plan(path: Path) -> Plan:
    """Read a `rig.toml`, or that of a campaign folder.

    Raises
    ------
    FmuidError
        It is missing, malformed, or names what the rig does not have.
    """
    file = path / FILE_NAME if path.is_dir() else path
    document = convert(read_toml(file), _Document, str(file))
    table = convert(document.rig, _RigTable, f"{file} [rig]")
    return Plan(
        rig=Rig(np.array(table.loss_table), numbers(table.parameters, f"{file} [rig.parameters]")),
        sensors=_sensors(numbers(table.sensors, f"{file} [rig.sensors]"), f"{file} [rig.sensors]"),
        experiments=tuple(_planned(n, t, f"{file} [experiments.{n}]") for n, t in document.experiments.items()),
        repeats=table.repeats,
        seed=table.seed,
        title=table.title,
    )


def _sensors(values: Mapping[str, float], where: str) -> Sensors:
    sensors = Sensors()
    for name, value in values.items():
        if name not in Sensors.__slots__:
            raise CampaignError(
                f"the rig has no sensor value '{name}'", where=where, fix=suggestion(name, Sensors.__slots__)
            )
        sensors = replace(sensors, **{name: value})
    return sensors


def _planned(name: str, raw: Mapping[str, Any], where: str) -> PlannedExperiment:
    table = convert(raw, _ExperimentTable, where)
    time = read_only(table.interval * np.arange(round(table.duration / table.interval) + 1))
    options = dict(table.input)
    kind = options.pop("kind", "")
    return PlannedExperiment(
        id=name,
        setup=table.setup,
        interval=table.interval,
        inputs=samples(kind, time, options, where),
        settings=numbers(table.settings, where),
        description=table.description,
    )


def run_planned(rig: Rig, planned: PlannedExperiment, *, preceding: bool = False, coarser: float = 1.0) -> Run:
    """Run one experiment on the rig, without sensors.

    Parameters
    ----------
    preceding
        The recorder writes a row after each step: input sample k has acted before output sample k.
    coarser
        Time step over the usual one.
    """
    rig, inputs = rig.changed(**planned.settings), planned.inputs
    step = None if coarser == 1.0 else coarser * usual_step(planned.setup, planned.interval)
    if not preceding:
        return rig.run(planned.setup, inputs, planned.interval, step=step)
    run = rig.run(planned.setup, np.append(inputs, inputs[-1]), planned.interval, step=step)
    return replace(run, time=run.time[:-1], inputs=inputs, channels=run.channels[1:])


def carry_out(plan: Plan) -> Measurements:
    """Return the recordings of the plan's experiments; the same plan gives the same numbers.

    Repeats of an experiment share its motion; noise, offset and encoder angle are drawn anew by seed,
    experiment id and repeat, so that adding an experiment leaves the others as they were.
    """
    units = {name: info.unit for name, info in parameter_table().items()}
    recorded: dict[str, Experiment] = {}
    for planned in plan.experiments:
        run = run_planned(plan.rig, planned)
        for repeat in range(plan.repeats):
            rng = np.random.default_rng([plan.seed, zlib.crc32(planned.id.encode()), repeat])
            signals: dict[str, Signal] = record(run, plan.sensors, rng)
            name = planned.id if repeat == 0 else f"{planned.id}_r{repeat}"
            recorded[name] = Experiment(
                id=name,
                setup=planned.setup,
                time=run.time,
                signals=signals,
                settings=planned.settings,
                setting_units={k: units[k] for k in planned.settings},
                repeat_of=None if repeat == 0 else planned.id,
                description=planned.description,
            )
    return Measurements(recorded, title=plan.title, rig="fmuid virtual rig", source="simulated")
