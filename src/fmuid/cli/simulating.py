"""`fmuid simulate`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fmuid.cli.output import Json, Printer, Quiet, numbers, pairs, writable
from fmuid.cli.supervised import MemoryLimit, TimeLimit, Workers, supervised
from fmuid.core.errors import FmuError, FmuidError, SimulationError

if TYPE_CHECKING:
    from fmuid.core.immutable import FloatArray
    from fmuid.data.crosscheck_csv import Table
    from fmuid.simulation.runners import Outcome, Runner
    from fmuid.simulation.simulator import Variable

_NO_NUMBERS = ("String", "Binary", "Clock")


def simulate(
    model: Annotated[
        Path, typer.Argument(metavar="FMU|SSP|CAMPAIGN", help="An .fmu or .ssp file, or a campaign.")
    ],
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Set a parameter (repeat for more)."),
    ] = None,
    experiment: Annotated[
        list[str] | None, typer.Option("--experiment", "-e", help="Id or glob of the runs of a campaign.")
    ] = None,
    input_: Annotated[
        Path | None,
        typer.Option(
            "--input",
            metavar="FILE",
            help="File with the inputs of an FMU (CSV, MATLAB); also sets the output times.",
        ),
    ] = None,
    stop: Annotated[float | None, typer.Option(help="Stop time of an FMU, s.")] = None,
    step: Annotated[float | None, typer.Option(help="Output step of an FMU, s.")] = None,
    output: Annotated[
        list[str] | None, typer.Option("--output", help="Record this variable (repeat for more).")
    ] = None,
    interpolation: Annotated[
        Literal["hold", "linear", "band-limited"],
        typer.Option(help="Interpolation between the samples of --input."),
    ] = "hold",
    master: Annotated[
        list[str] | None,
        typer.Option(
            metavar="WORD=VALUE",
            help="Option of the master of an .ssp, with the keys of campaign.toml: step=1e-3.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="CSV file for an FMU, folder for a campaign.", callback=writable)
    ] = None,
    workers: Workers = None,
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
    json: Json = None,
    quiet: Quiet = False,
) -> None:
    """Simulate an FMU, coupled FMUs (SSP), or the runs of a campaign at its start values, and write CSV files.

    For an FMU, the file contains inputs and outputs, so it can be a reference for fmuid compare.

    Example: fmuid simulate FixedShaft.fmu --input step.csv --set d_S=2.66 --out result.csv

    Example: fmuid simulate campaigns/force_feedback -e 'step_*' --set d_S=2.66
    """
    from fmu_build.errors import counted

    printer = Printer(quiet, json)
    if master and model.suffix != ".ssp":
        raise FmuidError("--master applies to .ssp files only", fix="write its keys into campaign.toml")
    if model.suffix in (".fmu", ".ssp"):
        if experiment:
            raise FmuidError("--experiment applies to campaigns only", fix="leave it out for an FMU")
        with printer.working(f"simulating {model}"), supervised(workers, time_limit, memory_limit) as runner:
            table, notes = _simulate_fmu(
                model,
                master or [],
                pairs(set_ or [], "--set"),
                input_,
                stop,
                step,
                output or [],
                interpolation,
                runner,
            )
        target = out or Path(f"{model.stem}.csv")
        _write(table, target)
        for note in notes:
            printer.say(f"note: {note}")
        printer.say(f"{target}: {table.time.size} samples of {', '.join(table.columns)}")
        printer.write({"model": model, "out": target, "variables": list(table.columns), "notes": notes})
        return
    if input_ or stop or step or output:
        raise FmuidError(
            "--input, --stop, --step and --output apply to FMUs only", fix="leave them out for a campaign"
        )
    values = numbers(set_ or [], "--set")
    with printer.working("") as shown, supervised(workers, time_limit, memory_limit) as runner:
        answer = _simulate_campaign(model, values, experiment or ["*"], out, shown, runner)
    for note in answer["notes"]:
        printer.say(f"note: {note}")
    printer.table(("experiment", "signal", "NRMSE"), [tuple(row.values()) for row in answer["nrmse"]])
    printer.say(f"{answer['out']}: {counted(len({row['experiment'] for row in answer['nrmse']}), 'file')}")
    printer.write(answer)


def _value(name: str, text: str, variable: Variable, literals: Mapping[str, int]) -> float:
    """Return a value as the FMU takes it; enumerations and Booleans may be given by name or number."""
    if variable.type in _NO_NUMBERS:
        what = f"'{name}' is a {variable.type}, and only numbers can be set"
        raise FmuidError(what, where="--set", fix="export the FMU with the value that you want")
    if literals:
        number = literals.get(text, next((v for v in literals.values() if text == str(v)), None))
        wanted = f"choose one of {', '.join(f'{n} ({v})' for n, v in literals.items())}"
    elif variable.type == "Boolean":
        number = {"true": 1, "1": 1, "false": 0, "0": 0}.get(text.casefold())
        wanted = "choose true or false"
    else:
        value = numbers([f"{name}={text}"], "--set")[name]
        low, high = variable.min, variable.max
        if (low is None or value >= low) and (high is None or value <= high):
            return value
        ends = [f"{word} {end:g}" for word, end in (("from", low), ("to", high)) if end is not None]
        what = f"'{name}' cannot be {text}: it is declared {' '.join(ends)}"
        raise FmuidError(what, where="--set", fix="give a value within these bounds")
    if number is None:
        raise FmuidError(f"'{name}' cannot be {text}", where="--set", fix=wanted)
    return float(number)


def _simulate_fmu(
    path: Path,
    master: list[str],
    texts: dict[str, str],
    input_: Path | None,
    stop: float | None,
    step: float | None,
    outputs: list[str],
    interpolation: Literal["hold", "linear", "band-limited"],
    runner: Runner,
) -> tuple[Table, list[str]]:
    """Return inputs and outputs, and notes on the simulation."""
    import numpy as np

    from fmu_build.suggest import suggestion
    from fmuid.core.units import convert_factor
    from fmuid.data.crosscheck_csv import Table
    from fmuid.data.recordings.conversion import read_run
    from fmuid.simulation.coupled.coupling_table import master_of
    from fmuid.simulation.coupled.loading import load_model, load_system
    from fmuid.simulation.fmu import Fmu
    from fmuid.simulation.simulator import EndedError, Task

    fmu = load_system(path, master_of(master, "--master")) if path.suffix == ".ssp" else load_model(path)
    variables = fmu.variables
    for name in (*texts, *outputs):
        if name not in variables:
            raise FmuError(f"{path.name} has no variable '{name}'", fix=suggestion(name, variables))
    literals = {n: fmu.literals(n) if isinstance(fmu, Fmu) else {} for n in texts}
    values = {n: _value(n, text, variables[n], literals[n]) for n, text in texts.items()}
    outputs = outputs or [n for n, v in variables.items() if v.causality == "output" and v.type not in _NO_NUMBERS]
    notes: list[str] = []
    inputs: dict[str, FloatArray] = {}
    recorded: dict[str, FloatArray] = {}  # inputs as they are in the file
    units: dict[str, str] = {}
    time: FloatArray
    if input_ is not None:
        run = read_run(input_)
        table, notes = run.table, list(run.notes)
        if stop is not None or step is not None:
            raise FmuidError("--input already has times", fix="leave out --stop and --step")
        time, recorded, units = table.time, dict(table.columns), dict(table.units)
        for name, samples in table.columns.items():
            if name not in variables or variables[name].causality != "input":
                known = [n for n, v in variables.items() if v.causality == "input"]
                raise FmuError(f"{path.name} has no input '{name}'", where=input_, fix=suggestion(name, known))
            factor = 1.0
            if name in table.units:
                factor = convert_factor(table.units[name], variables[name].unit, where=f"{input_}: '{name}'")
            inputs[name] = factor * samples
    else:
        default = fmu.default_experiment
        begin = default.get("start", 0.0)
        end = stop if stop is not None else default.get("stop", begin + 1.0)
        if not end > begin:
            raise FmuidError(f"stop time {end:g} s is not after {begin:g} s", fix="give a later --stop")
        step = step if step is not None else default.get("step", (end - begin) / 500)
        if not 0 < step <= end - begin or (end - begin) / step > 1e8:
            raise FmuidError(f"step {step:g} s does not fit into {end - begin:g} s", fix="give another --step")
        time = np.asarray(begin + step * np.arange(round((end - begin) / step) + 1), dtype=np.float64)
    if tool := fmu.needed_tool:
        notes.append(f"{path.name} needs {tool} to be installed (needsExecutionTool)")
    changed = [n for n, value in values.items() if value != variables[n].start]
    points = [values, *({k: v for k, v in values.items() if k != n} for n in changed)]
    outcome, *without = runner(
        [(fmu, Task(time, inputs, tuple(outputs), point, interpolation), {}) for point in points]
    )
    if isinstance(outcome, EndedError):
        notes.append(f"{outcome.what}; results up to then are kept")
    elif isinstance(outcome, SimulationError):
        raise outcome
    predictions = _part(outcome)
    within = 10 * (fmu.default_tolerance or 0.0) * np.abs(predictions).max(axis=1, initial=0.0, keepdims=True)
    others = dict(zip(changed, map(_part, without), strict=True))
    no_effect = [
        n
        for n, other in others.items()
        if other.shape == predictions.shape and np.all(np.abs(other - predictions) <= within)
    ]
    if no_effect:
        notes.append(f"no recorded variable depends on {', '.join(no_effect)}")
    units |= {n: variables[n].unit or "" for n in outputs if variables[n].unit}
    kept = {n: v[: predictions.shape[1]] for n, v in recorded.items()}
    columns = kept | dict(zip(outputs, predictions, strict=True))
    return Table(time[: predictions.shape[1]], columns, units), notes


def _part(outcome: Outcome) -> FloatArray:
    """Return the predictions of a simulation, empty if it failed."""
    import numpy as np

    from fmuid.simulation.simulator import EndedError

    if isinstance(outcome, EndedError):
        return outcome.predictions
    return np.empty((0, 0)) if isinstance(outcome, SimulationError) else outcome


def _simulate_campaign(
    path: Path,
    values: dict[str, float],
    patterns: list[str],
    out: Path | None,
    shown: Callable[..., None],
    runner: Runner,
) -> dict[str, Any]:
    import numpy as np

    from fmu_build.suggest import suggestion
    from fmuid.campaigns.campaign_toml import expand, load_campaign
    from fmuid.core.campaign import without_owner
    from fmuid.data.crosscheck_csv import Table
    from fmuid.identification.check import load_models, match_models
    from fmuid.identification.problem.cases import from_campaign
    from fmuid.simulation.simulator import EndedError

    campaign = load_campaign(path)
    models = load_models(campaign)
    match_models(campaign, models)
    for name in values:
        if name not in campaign.parameters:
            raise FmuidError(
                f"unknown parameter '{name}'", where="--set", fix=suggestion(name, campaign.parameters)
            )
    roles = set(campaign.identification + campaign.validation)
    among = [i for i in campaign.measurements.experiments if i in roles]
    chosen = expand(patterns, campaign.measurements, among, "--experiment")
    target = out or Path("runs") / campaign.name / "simulated"
    starts = campaign.start_values
    point = {n: v for n, v in starts.items() if without_owner(n) not in values} | values
    rows: list[tuple[str, str, float]] = []
    notes: list[str] = []
    for k, experiment_id in enumerate(chosen):
        experiment = campaign.measurements[experiment_id]
        (case,) = from_campaign(campaign, [experiment], (), models)
        shown(k / len(chosen), f"simulating {experiment_id}")
        (outcome,) = runner([(case.simulator, case.task, case.start_values(point))])
        outputs = _part(outcome)
        if isinstance(outcome, EndedError):
            notes.append(f"{experiment_id}: {outcome.what}; results up to then are kept")
            missing = case.task.time.size - outputs.shape[1]
            outputs = np.pad(outputs, ((0, 0), (0, missing)), constant_values=np.nan)
        elif isinstance(outcome, SimulationError):
            raise outcome
        prediction = case.sensed(outputs, point)
        columns: dict[str, FloatArray] = {}
        units: dict[str, str] = {}
        for channel, predicted in zip(case.channels, prediction, strict=True):
            columns[channel.signal] = predicted
            columns[f"{channel.signal}_measured"] = channel.mean
            if channel.unit:
                units |= {channel.signal: channel.unit, f"{channel.signal}_measured": channel.unit}
            known = np.isfinite(channel.mean) & np.isfinite(predicted)
            error = predicted[known] - channel.mean[known]
            rows.append((experiment_id, channel.signal, _nrmse(error, channel.mean[known])))
        _write(Table(experiment.time, columns, units), target / f"{experiment_id}.csv")
    return {
        "campaign": campaign.name,
        "out": target,
        "parameters": point,
        "notes": notes,
        "nrmse": [{"experiment": e, "signal": s, "nrmse": v} for e, s, v in rows],
    }


def _nrmse(error: FloatArray, measured: FloatArray) -> float:
    """Return the root mean square error divided by the range of the measurement."""
    if not error.size:
        return float("nan")
    scale = float(measured.max() - measured.min()) or 1.0
    return float((error @ error / error.size) ** 0.5) / scale


def _write(table: Table, path: Path) -> None:
    from fmuid.data.crosscheck_csv import write_csv

    write_csv(table, path)
