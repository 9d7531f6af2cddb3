"""`fmuid import`, `fmuid export` and `fmuid init`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from fmuid.cli.output import Json, Printer, Quiet, numbers, pairs
from fmuid.errors import FmuidError

_DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t"}


def import_(
    files: Annotated[
        list[Path], typer.Argument(help='CSV or MAT files, one a run; CSV headers as in "tau [N.m]".')
    ],
    setup: Annotated[str, typer.Option(help="Setup that the runs were made with.")],
    input_: Annotated[list[str], typer.Option("--input", "-i", help="Column that drives the model (repeat).")],
    out: Annotated[Path, typer.Option(help="Measurement file to write.")] = Path("measurements.h5"),
    unit: Annotated[list[str] | None, typer.Option(metavar="NAME=UNIT", help="Unit of a column (repeat).")] = None,
    sigma: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="Noise standard deviation (repeat).")
    ] = None,
    setting: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="Known value that the runs set (repeat).")
    ] = None,
    repeats: Annotated[bool, typer.Option("--repeats", help="Runs with the same inputs are repeats.")] = False,
    append: Annotated[bool, typer.Option("--append", help="Add the runs to the file at --out.")] = False,
    delimiter: Annotated[
        Literal["comma", "semicolon", "tab"], typer.Option(help="What separates cells.")
    ] = "comma",
    title: Annotated[str, typer.Option(help="Title of the measurement file.")] = "",
    json: Json = None,
    quiet: Quiet = False,
) -> None:
    """Import CSV or MATLAB files into a measurement file; a run's id is its file's name.

    Example: fmuid import step.csv prbs.csv --setup fixed_shaft --input i_cmd --out measurements.h5
    """
    from fmuid.campaign import Measurements
    from fmuid.importing import experiment_from_table, with_repeats
    from fmuid.measurements import read_measurements, write_measurements
    from fmuid.tables import read_table

    printer = Printer(quiet, json)
    if out.exists() and not append:
        raise FmuidError("is there already", where=out, fix="give --append to add to it, or another --out")
    old = read_measurements(out) if append and out.exists() else Measurements({}, title=title)
    experiments = dict(old.experiments)
    for file in files:
        if file.stem in experiments:
            raise FmuidError(f"there is a run '{file.stem}' already", where=file, fix="rename the file")
        table, ignored = read_table(file, delimiter=_DELIMITERS[delimiter])
        if ignored:
            printer.say(f"{file}: not used, no vectors over time: {', '.join(ignored)}")
        try:
            experiments[file.stem] = experiment_from_table(
                table,
                id=file.stem,
                setup=setup,
                inputs=input_,
                units=pairs(unit or [], "--unit"),
                sigmas=numbers(sigma or [], "--sigma"),
                settings=numbers(setting or [], "--setting"),
            )
        except FmuidError as error:
            if error.where != file.stem:
                raise
            raise type(error)(error.what, where=file, fix=error.fix) from None
    if repeats:
        experiments = with_repeats(experiments)
    measurements = Measurements(
        experiments, title=title or old.title, rig=old.rig, source=old.source, licence=old.licence
    )
    write_measurements(measurements, out)
    printer.table(
        ("experiment", "samples", "end s", "inputs", "outputs", "repeat of"),
        [
            (e.id, e.time.size, float(e.time[-1]), " ".join(e.inputs), " ".join(e.outputs), e.repeat_of or "")
            for e in measurements
        ],
    )
    printer.say(f"{out}: {len(measurements)} runs")
    printer.write({"out": out, "experiments": list(measurements.experiments)})


def export(
    measurements: Annotated[Path, typer.Argument(help="A measurement file.")],
    out: Annotated[Path, typer.Option(help="Folder for the CSV files.")] = Path(),
    experiment: Annotated[
        list[str] | None, typer.Option("--experiment", "-e", help="Id or glob of the runs (repeat).")
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> None:
    """Export the runs of a measurement file as CSV, one file each.

    Example: fmuid export measurements.h5 --out csv -e 'step_*'
    """
    from fmuid.campaign_toml import expand
    from fmuid.crosscheck_csv import write_csv
    from fmuid.importing import table_from_experiment
    from fmuid.measurements import read_measurements

    loaded = read_measurements(measurements)
    chosen = expand(experiment or ["*"], loaded, list(loaded.experiments), "--experiment")
    files = [out / f"{experiment_id}.csv" for experiment_id in chosen]
    for experiment_id, file in zip(chosen, files, strict=True):
        write_csv(table_from_experiment(loaded[experiment_id]), file)
    printer = Printer(quiet, json)
    printer.say(f"{out}: {len(files)} files")
    printer.write({"files": files})


def init(
    data: Annotated[list[Path], typer.Argument(metavar="CSV...", help="CSV files, one a run.")],
    fmu: Annotated[Path, typer.Option(help="The FMU to identify.")],
    out: Annotated[Path, typer.Option(help="Folder of the new campaign.")] = Path("campaign"),
    quiet: Quiet = False,
    json: Json = None,
) -> None:
    """Start a campaign from CSV files and an FMU: signals and parameters are guessed by name and unit.

    Example: fmuid init step.csv prbs.csv --fmu Drive.fmu --out campaigns/drive
    """
    from fmuid.new_campaign import new_campaign

    made = new_campaign(data, fmu, out)
    printer = Printer(quiet, json)
    for line in made.guesses:
        printer.say(line)
    printer.say(f"{out / 'campaign.toml'}: look it through, then run: fmuid check {out}; fmuid identify {out}")
    printer.write({"out": out, "guesses": made.guesses})
