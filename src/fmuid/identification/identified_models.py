"""Writing back what was identified: FMUs that start with it, and a parameter set (SSP 1.0)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from fmuid.core.campaign import Campaign
from fmuid.core.errors import ProblemError
from fmuid.core.files import write_atomically
from fmuid.data.noise.level import conversion_at
from fmuid.identification.check import load_models
from fmuid.identification.modelica_class import short_class
from fmuid.identification.parameter_set import parameter_set
from fmuid.identification.result import Result
from fmuid.identification.robot_description import described
from fmuid.identification.solvers import Status
from fmuid.simulation.coupled.coupled_model import CoupledModel
from fmuid.simulation.coupled.loading import load_model
from fmuid.simulation.coupled.ssp_writing import write_system
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.fmu_copy import copy_with_starts, takes_effect
from fmuid.simulation.runners import Runner, in_process
from fmuid.simulation.simulator import Simulator

PARAMETERS = "parameters.ssv"


@dataclass(frozen=True, slots=True)
class Identified:
    """What was written: FMUs (or SSP files) by setup, the parameter set, and what the user should know.

    `modelica` are short classes, one for each Modelica model; `robot` is the robot's description.
    """

    fmus: Mapping[str, Path]
    parameters: Path
    warnings: tuple[str, ...] = ()
    modelica: tuple[Path, ...] = ()
    robot: Path | None = None


def write_identified(
    result: Result, campaign: Campaign, folder: str | Path, runner: Runner = in_process
) -> Identified:
    """Write ``<model>.fmu``, one for each FMU of the campaign, and ``parameters.ssv``; coupled FMUs as ``.ssp``.

    Of models with Modelica source also ``<model>Identified.mo``, a short class with the values; and the robot's
    description, where the campaign names one.

    Start values of a copy are what all runs of its setup have in common: the result's parameters, the
    campaign's settings and initial values; not the settings of a run, nor parameters that each run has its own
    of. The parameter set lists the same values by FMU variable, as ``setup.variable`` where setups differ.
    `runner` simulates, to see whether the copies start so.

    Returns
    -------
    Identified
        With a warning for each FMU that does not start with what its copy says.

    Raises
    ------
    ProblemError
        The result is of an identification that failed or was interrupted.
    CampaignError
        The robot's description cannot be read, or lacks a joint.
    FmuError
        A value cannot be a start value of its variable.
    """
    if result.status in (Status.FAILED, Status.INTERRUPTED):
        raise ProblemError(f"the identification is {result.status.value}", fix="finish it first")
    models = {setup: load_model(campaign.models[setup]) for setup in load_models(campaign)}
    values = {s: start_values(campaign, result.parameters, s, model) for s, model in models.items()}
    folder = Path(folder)
    modelica = {}
    for setup, model in models.items():
        source = campaign.models[setup].source
        if source is not None:
            name = f"{source.class_name.rpartition('.')[2]}Identified"
            starts = {n: v.start for n, v in model.variables.items() if v.start is not None}
            own = {n: v for n, v in values[setup].items() if model.variables[n].causality == "parameter"}
            modelica[folder / f"{name}.mo"] = short_class(name, source.class_name, own, starts)
    for file, text in modelica.items():
        write_atomically(file, text)
    robot = None
    if campaign.robot is not None:
        robot = folder / campaign.robot.file.name
        write_atomically(robot, described(campaign.robot, result.parameters))
    written = write_models(campaign.name, values, models, folder, runner)
    return replace(written, modelica=tuple(modelica), robot=robot)


def write_models(
    name: str,
    values: Mapping[str, Mapping[str, float]],
    models: Mapping[str, Fmu | CoupledModel],
    folder: Path,
    runner: Runner = in_process,
    *,
    stems: Mapping[str, str] | None = None,
) -> Identified:
    """Write copies of models that start with `values`, by setup and variable, and their parameter set `name`.

    `stems` are the names of their files, by setup; those of the originals by default.

    Raises
    ------
    FmuError
        A value cannot be a start value of its variable.
    """
    written: dict[str, Path] = {}
    warnings = []
    for setup, model in models.items():
        same = [s for s in written if models[s] is model and values[s] == values[setup]]
        if same:
            written[setup] = written[same[0]]
            continue
        stem = (stems or {}).get(setup, model.path.stem)
        suffix = ".ssp" if isinstance(model, CoupledModel) else ".fmu"
        target = folder / f"{stem}{suffix}"
        if target in written.values():
            target = folder / f"{stem}_{setup}{suffix}"
        written[setup] = target
        if isinstance(model, CoupledModel):
            write_system(model, parameter_set(name, {setup: values[setup]}, models), target)
            continue
        copy_with_starts(model, values[setup], target)
        if not takes_effect(model, values[setup], target, runner):
            warnings.append(
                f"{target.name}: {model.tool} lets its FMU start with other values than its description says; "
                "set those of parameters.ssv"
            )
    parameters = folder / PARAMETERS  # the last: it says that all is there
    write_atomically(parameters, parameter_set(name, values, models))
    return Identified(written, parameters, tuple(warnings))


def start_values(
    campaign: Campaign, values: Mapping[str, float], setup: str, simulator: Simulator
) -> dict[str, float]:
    """Return what all runs of a setup start with, by variable: settings, initial values, parameters' `values`."""
    model, variables = campaign.models[setup], simulator.variables
    settings = {model.variable(n): v for n, v in campaign.settings.items()}
    found = {n: v for n, v in settings.items() if n in variables} | dict(model.initial)
    for spec in campaign.parameters.values():
        variable = model.variable(spec.name)
        if variable in variables and spec.per == "campaign" and spec.name in values:
            convert = conversion_at(spec.unit, variables[variable].unit, f"parameter '{spec.name}'")
            found[variable] = convert.factor * values[spec.name] + convert.offset
    return found
