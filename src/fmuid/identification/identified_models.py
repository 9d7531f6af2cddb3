"""Writing identified values to copies of the FMUs and to a parameter set (SSP 1.0)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from fmuid.core.campaign import Campaign
from fmuid.core.errors import ProblemError
from fmuid.core.files import write_atomically
from fmuid.core.units import conversion_at
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
    """The files written: FMUs (or SSP files) by setup and the parameter set; and warnings.

    `modelica` are short classes, one for each Modelica model; `robot` is the robot description.
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

    For models with Modelica source, also write ``<model>Identified.mo``, a short class with the values; and write
    the robot description if the campaign names one.

    The start values of a copy are those common to all runs of its setup: the result's parameters and the
    campaign's settings and initial values, but not the settings of a single run, nor parameters per run. The
    parameter set lists the same values by FMU variable, as ``setup.variable`` where setups differ. `runner`
    simulates the copies to check that they start with these values.

    Returns
    -------
    Identified
        With a warning for each FMU that does not start with the values in its copy.

    Raises
    ------
    ProblemError
        The identification failed or was interrupted.
    CampaignError
        The robot description cannot be read, or lacks a joint.
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
            parameters = {n: v for n, v in values[setup].items() if model.variables[n].causality == "parameter"}
            modelica[folder / f"{name}.mo"] = short_class(name, source.class_name, parameters, starts)
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
    """Write copies of models with start values `values`, by setup and variable, and the parameter set `name`.

    `stems` are the file names by setup; by default those of the originals.

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
                f"{target.name}: {model.tool} exports an FMU that ignores the start values in its description; "
                "set the values of parameters.ssv"
            )
    parameters = folder / PARAMETERS  # written last: it shows that everything is there
    write_atomically(parameters, parameter_set(name, values, models))
    return Identified(written, parameters, tuple(warnings))


def start_values(
    campaign: Campaign, values: Mapping[str, float], setup: str, simulator: Simulator
) -> dict[str, float]:
    """Return the start values common to all runs of a setup: settings, initial values, parameters' `values`."""
    model, variables = campaign.models[setup], simulator.variables
    settings = {model.variable(n): v for n, v in campaign.settings.items()}
    starts = {n: v for n, v in settings.items() if n in variables} | dict(model.initial)
    for spec in campaign.parameters.values():
        variable = model.variable(spec.name)
        if variable in variables and spec.per == "campaign" and spec.name in values:
            convert = conversion_at(spec.unit, variables[variable].unit, f"parameter '{spec.name}'")
            starts[variable] = convert.factor * values[spec.name] + convert.offset
    return starts
