"""Global sensitivity of a campaign: load, simulate in worker processes, and write the results."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fmuid.core.campaign import Campaign, ModelSpec, StageSpec
from fmuid.core.errors import CampaignError, MeasurementsError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.core.files import write_atomically
from fmuid.core.folder_lock import claim
from fmuid.core.one_thread import in_one_thread
from fmuid.core.progress import Say, quiet
from fmuid.data.crosscheck_csv import read_csv
from fmuid.design.parameters import posed_stage
from fmuid.design.planned import unrecorded_run, unrecorded_times
from fmuid.diagnosis_pipeline import campaign_from
from fmuid.identification.problem.cases import experiments_of
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.result import Result
from fmuid.identification.uncertainty.sobol_morris import (
    GlobalSensitivity,
    Method,
    Quantity,
    global_sensitivity_of,
)
from fmuid.simulation.pool.choice import runner_on
from fmuid.simulation.simulator import Simulator

FILE_NAME = "sensitivity.json"


@in_one_thread
def global_sensitivity(
    campaign: Campaign | Result | str | Path,
    method: Method = "sobol",
    *,
    of: Quantity = "change",
    stage: str | None = None,
    experiments: Sequence[str] = (),
    inputs: str | Path | None = None,
    setup: str | None = None,
    samples: int | None = None,
    out: str | Path | None = None,
    seed: int = 0,
    workers: int | None = 0,
    time_limit: float | None = None,
    memory_limit: int | None = None,
    say: Say = quiet,
    trust: bool = False,
) -> GlobalSensitivity:
    """Return how much each parameter matters to each output over its whole range.

    Only the inputs of the runs count, unless `of` is ``criterion``, so the outputs need not be measured yet.

    Parameters
    ----------
    campaign
        A campaign or its folder, even without measurements; or an identification's result or run folder, whose
        values are the start.
    method, of, samples, seed
        As in `global_sensitivity_of`.
    stage
        Stage whose parameters, ties and runs are used; by default the campaign's only stage, or all its free
        parameters and identification runs.
    experiments
        Ids or globs, instead of the stage's runs.
    inputs
        CSV file with the inputs of a planned run, in place of recorded ones.
    setup
        Setup of the planned run; by default the campaign's only one, or that of its first run.
    out
        Folder for ``sensitivity.json`` and the page ``index.html``. If None, nothing is written.
    workers, time_limit, memory_limit
        As in `fmuid.diagnose`.
    say
        Called with the current task and the fraction done (0 to 1).
    trust
        Whether functions that the campaign names may be imported and called.

    Raises
    ------
    CampaignError, FmuError, ProblemError
        The campaign has neither runs nor `inputs`, they do not fit the model, or a parameter has no range.
    SimulationError
        The start values, or too many draws, cannot be simulated.

    Examples
    --------
    >>> matters = fmuid.global_sensitivity("tank", samples=64)
    >>> matters.names
    ('G', 'C')
    """
    from fmuid.simulation.coupled.loading import load_simulator

    loaded = campaign_from(campaign, trust=trust, planned=True)
    posed = posed_stage(loaded, stage)
    if inputs is not None or not loaded.measurements:
        if of == "criterion":
            raise CampaignError(
                "nothing is measured in a planned run",
                where="criterion",
                fix="take another quantity, such as change",
            )
        loaded, posed = _with_planned_run(loaded, posed, load_simulator, inputs, setup)
    elif experiments:
        chosen = experiments_of(loaded, experiments, where="--experiment")
        posed = replace(posed, experiments=tuple(e.id for e in chosen))
    if of != "criterion":  # every measured output counts, whatever the stage compares
        posed = replace(posed, criteria=(), constraints=(), combine="weighted_sum")
    runs = experiments_of(loaded, posed.experiments, where=f"stage '{posed.name}'")
    simulators = {s: load_simulator(loaded.models[s]) for s in dict.fromkeys(e.setup for e in runs)}
    with runner_on(workers, time_limit=time_limit, memory_limit=memory_limit) as runner:
        say("simulating the start values", 0.0)
        problem = Problem.of_stage(loaded, posed, simulators, runner=runner)
        sensitivity = global_sensitivity_of(
            problem, method, of=of, samples=samples, seed=seed, say=lambda share: say("simulating draws", share)
        )
    if out is not None:
        say("drawing", 1.0)
        _write(sensitivity, loaded, Path(out))
    return sensitivity


def _with_planned_run(
    campaign: Campaign,
    posed: StageSpec,
    load: Callable[[ModelSpec], Simulator],
    inputs: str | Path | None,
    setup: str | None,
) -> tuple[Campaign, StageSpec]:
    """Return the campaign with the planned run, and the stage with that run alone."""
    where = campaign.file or campaign.folder
    recorded = [e.setup for e in campaign.measurements]
    setup = setup or campaign.design.setup or next(iter([*recorded, *campaign.models]), None)
    if setup is None or setup not in campaign.models:
        known = ", ".join(campaign.models) or "none"
        raise CampaignError(f"no setup '{setup}'", where=where, fix=f"the campaign has: {known}")
    simulator = load(campaign.models[setup])
    run = _planned_run(campaign, simulator, setup, inputs)
    runs = {**campaign.measurements.experiments, run.id: run}
    campaign = replace(campaign, measurements=Measurements(runs))
    return campaign, replace(posed, experiments=(run.id,), criteria=(), segments=None, observer=False)


def _planned_run(campaign: Campaign, simulator: Simulator, setup: str, inputs: str | Path | None) -> Experiment:
    if inputs is None:
        design = campaign.design
        driven = any(v.causality == "input" for v in simulator.variables.values())
        if not driven and design.duration is not None:
            return unrecorded_run(
                campaign, simulator, setup, unrecorded_times(design.duration, design.sample_time)
            )
        raise CampaignError(
            "has no run",
            where=campaign.file or campaign.folder,
            fix="give the inputs of one with --input; fmuid design --for parameters writes such a file"
            if driven
            else "write duration = ... into [limits]",
        )
    table = read_csv(Path(inputs))
    model, signals = campaign.models[setup], {}
    for name, values in table.columns.items():
        variable = simulator.variables.get(model.variable(name))
        if not np.isfinite(values).all():
            raise MeasurementsError(f"input '{name}' has gaps", where=inputs, fix="fill them")
        unit = table.units.get(name) or (variable.unit if variable is not None else None) or "1"
        signals[name] = Signal(name, values, unit, "input")
    run = unrecorded_run(campaign, simulator, setup, table.time, signals)
    taken, id = campaign.measurements.experiments, Path(inputs).stem
    return replace(run, id=f"{id} (planned)" if id in taken else id)


def answer_of_sensitivity(sensitivity: GlobalSensitivity, campaign: Campaign) -> Mapping[str, Any]:
    """Return the value of ``sensitivity.json``."""
    answer = sensitivity.to_dict()
    head = {key: answer.pop(key) for key in ("format", "version")}
    return {**head, "campaign": None if campaign.file is None else str(campaign.file), **answer}


def _write(sensitivity: GlobalSensitivity, campaign: Campaign, out: Path) -> None:
    from fmuid.report.provenance_table import provenance_of
    from fmuid.report.sensitivity_page import write_sensitivity_page

    with claim(out):
        write_atomically(
            out / FILE_NAME, json.dumps(answer_of_sensitivity(sensitivity, campaign), indent=2) + "\n"
        )
        provenance = provenance_of(campaign, sensitivity.seed, "SALib")
        units = {spec.name: spec.unit or "" for spec in campaign.parameters.values()}
        write_sensitivity_page(sensitivity, out, campaign=campaign.title, units=units, provenance=provenance)
