"""`fmuid import`, `fmuid export` and `fmuid init`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fmuid.cli.libraries import Roots
from fmuid.cli.output import Json, Printer, Quiet, command_line, numbers, pairs, writable
from fmuid.cli.supervised import MemoryLimit, TimeLimit, Workers, supervised
from fmuid.core.errors import FmuidError

if TYPE_CHECKING:
    from fmuid.data.recordings.resampling import TimeBase
    from fmuid.data.table_layout import TableLayout
    from fmuid.init.starting import GivenModel


_METHODS = ("linear", "hold", "mean")
_ROWS = 12  # of runs in a table
Signals = Annotated[list[str] | None, typer.Option("--signal", help="Use this signal only (repeat).")]
Resample = Annotated[
    float | None,
    typer.Option(metavar="RATE", help="Resample all signals at RATE samples per second."),
]
Align = Annotated[
    str | None, typer.Option(metavar="SIGNAL", help="Resample all signals at the times of this one.")
]
Methods = Annotated[
    list[str] | None,
    typer.Option(
        "--method",
        metavar="[SIGNAL=]METHOD",
        help="Resampling method, for all signals or one (repeat): linear (default), hold or mean.",
    ),
]
Columns = Annotated[
    str | None,
    typer.Option(
        metavar="NAMES",
        help="Headers of files that have none: 'time,tau [N.m]', one for each column; or chosen columns:"
        " 'time=data[1],tau [N.m]=data[4]', by name or number.",
    ),
]
Rate = Annotated[
    float | None, typer.Option(metavar="HZ", help="Samples per second of files without a time column.")
]
Units = Annotated[list[str] | None, typer.Option(metavar="NAME=UNIT", help="Unit of a signal (repeat).")]
Sigmas = Annotated[
    list[str] | None, typer.Option(metavar="NAME=VALUE", help="Noise standard deviation of a signal (repeat).")
]


def import_(
    context: typer.Context,
    files: Annotated[
        list[Path],
        typer.Argument(
            help='CSV, MAT, HDF5, Parquet or MF4 files, one per run; names as in "tau [N.m]" state units.'
        ),
    ],
    setup: Annotated[str, typer.Option(help="Setup that the runs were made with.")],
    input_: Annotated[
        list[str], typer.Option("--input", "-i", help="Input signal, which drives the model (repeat).")
    ],
    out: Annotated[Path, typer.Option(help="Measurement file to write.", callback=writable)] = Path(
        "measurements.h5"
    ),
    signal: Signals = None,
    resample: Resample = None,
    align: Align = None,
    method: Methods = None,
    unit: Units = None,
    sigma: Sigmas = None,
    setting: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[RUN:]NAME=VALUE",
            help="Known value of all runs, or of those that match RUN, a glob (repeat).",
        ),
    ] = None,
    columns: Columns = None,
    rate: Rate = None,
    cut: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[RUN:]FROM..TO", help="Keep only this time span, s; either end may be omitted (repeat)."
        ),
    ] = None,
    from_zero: Annotated[
        bool, typer.Option("--from-zero", help="Shift time so that the first sample is at 0.")
    ] = False,
    shift: Annotated[
        list[str] | None,
        typer.Option(metavar="SIGNAL=SECONDS", help="Shift the samples of a signal by this time, s (repeat)."),
    ] = None,
    mask: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CONDITION", help='Mask samples of outputs where a condition holds: "abs(tau) > 40" (repeat).'
        ),
    ] = None,
    machine: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[RUN:]NAME",
            help="Machine that was measured, in all runs or in those that match RUN (repeat).",
        ),
    ] = None,
    repeats: Annotated[bool, typer.Option("--repeats", help="Mark runs with the same inputs as repeats.")] = False,
    append: Annotated[bool, typer.Option("--append", help="Add the runs to the file at --out.")] = False,
    title: Annotated[str, typer.Option(help="Title of the measurement file.")] = "",
    json: Json = None,
    quiet: Quiet = False,
) -> None:
    """Import recorded runs into a measurement file; the id of a run is the name of its file.

    Signals with different time bases are refused until you choose a common one.

    Example: fmuid import step.csv prbs.csv --setup fixed_shaft --input i_cmd --out measurements.h5

    Example: fmuid import step.mf4 --setup fixed_shaft -i i_cmd --signal i_cmd --signal w --resample 1000
    """
    from dataclasses import replace

    from fmu_build.errors import counted
    from fmuid.core.experiments import Measurements
    from fmuid.core.formatting import once_each
    from fmuid.data.measurements import read_measurements, write_measurements
    from fmuid.data.recordings.conversion import experiment_from_table, read_run, with_repeats
    from fmuid.data.recordings.editing import Edits

    printer = Printer(quiet, json)
    if out.exists() and not append:
        raise FmuidError("already exists", where=out, fix="give --append to add to it, or another --out")
    old = read_measurements(out) if append and out.exists() else Measurements({}, title=title)
    experiments = dict(old.experiments)
    base = _time_base(resample, align, method or [])
    notes: list[tuple[str, str]] = []
    spans = {file.stem: _span(_of_run(cut or [], file.stem)) for file in files}
    for file in files:
        if file.stem in experiments:
            raise FmuidError(f"a run '{file.stem}' already exists", where=file, fix="rename the file")
        with printer.working(f"reading {file}"):
            run = read_run(file, signal or (), base, layout_of(columns, rate))
        notes += [(str(file), note) for note in run.notes]
        begin, end = spans.get(file.stem, (float("-inf"), float("inf")))
        shifts = numbers(shift or [], "--shift")
        edits = Edits(shifts, begin, end, from_zero, mask or ())
        outputs = [name for name in run.table.columns if name not in input_]
        run = replace(run, table=edits(run.table, outputs, file))
        try:
            experiments[file.stem] = experiment_from_table(
                run.table,
                id=file.stem,
                setup=setup,
                inputs=input_,
                units=pairs(unit or [], "--unit"),
                sigmas=numbers(sigma or [], "--sigma"),
                settings=numbers(_of_run(setting or [], file.stem), "--setting"),
                resampled=run.resampled,
            )
            if machines := _of_run(machine or [], file.stem):
                experiments[file.stem] = replace(experiments[file.stem], machine=machines[-1])
        except FmuidError as error:
            if error.where != file.stem:
                raise
            raise type(error)(error.what, where=file, fix=error.fix) from None
    if repeats:
        experiments = with_repeats(experiments)
    measurements = Measurements(
        experiments,
        title=title or old.title,
        rig=old.rig,
        source=old.source,
        licence=old.licence,
        history="\n".join(filter(None, [old.history, command_line(context)])),
    )
    for line in once_each(notes):
        printer.say(line)
    with printer.working(f"writing {out}"):
        write_measurements(measurements, out)
    shown = list(measurements)
    shown = shown if len(shown) <= _ROWS else shown[: _ROWS // 2]
    printer.table(
        ("experiment", "samples", "end s", "inputs", "outputs", "repeat of"),
        [
            (
                e.id,
                e.time.size,
                float(e.time[-1]),
                " ".join(e.inputs),
                " ".join(e.outputs),
                e.repeat_of or e.repeat_of_reference or "",
            )
            for e in shown
        ],
    )
    if len(shown) < len(measurements):
        printer.say(f"... and {len(measurements) - len(shown)} more")
    printer.say(f"{out}: {counted(len(measurements), 'run')}")
    resampled = {e.id: {s.name: s.resampled for s in e.signals.values() if s.resampled} for e in measurements}
    printer.write({"out": out, "experiments": list(measurements.experiments), "resampled": resampled})


def export(
    measurements: Annotated[Path, typer.Argument(help="A measurement file.")],
    out: Annotated[Path, typer.Option(help="Folder for the CSV files.", callback=writable)] = Path(),
    experiment: Annotated[
        list[str] | None, typer.Option("--experiment", "-e", help="Id or glob of the runs (repeat).")
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> None:
    """Export the runs of a measurement file as CSV, one file each.

    Example: fmuid export measurements.h5 --out csv -e 'step_*'
    """
    from fmu_build.errors import counted
    from fmuid.campaigns.campaign_toml import expand
    from fmuid.data.crosscheck_csv import write_csv
    from fmuid.data.measurements import read_measurements
    from fmuid.data.recordings.conversion import table_from_experiment

    loaded = read_measurements(measurements)
    chosen = expand(experiment or ["*"], loaded, list(loaded.experiments), "--experiment")
    files = [out / f"{experiment_id}.csv" for experiment_id in chosen]
    for experiment_id, file in zip(chosen, files, strict=True):
        write_csv(table_from_experiment(loaded[experiment_id]), file)
    printer = Printer(quiet, json)
    printer.say(f"{out}: {counted(len(files), 'file')}")
    printer.write({"files": files})


def init(
    data: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="CSV, MAT, HDF5, Parquet or MF4 files, one per run.")
    ],
    fmu: Annotated[Path | None, typer.Option(help="The FMU to identify.")] = None,
    model: Annotated[Path | None, typer.Option(help="Or the Modelica file of the model to identify.")] = None,
    class_name: Annotated[str | None, typer.Option("--class", help="Class name (default: file name).")] = None,
    root: Roots = None,
    out: Annotated[Path, typer.Option(help="Folder of the new campaign.", callback=writable)] = Path("campaign"),
    signal: Signals = None,
    resample: Resample = None,
    align: Align = None,
    method: Methods = None,
    unit: Units = None,
    sigma: Sigmas = None,
    columns: Columns = None,
    rate: Rate = None,
    workers: Workers = None,
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
    quiet: Quiet = False,
    json: Json = None,
) -> None:
    """Start a campaign from recorded runs and an FMU or a Modelica model.

    Signals and parameters are guessed by name and unit.

    Example: fmuid init step.csv prbs.csv --fmu Drive.fmu --out campaigns/drive
    """
    from dataclasses import asdict

    from fmuid.init.new_campaign import new_campaign
    from fmuid.init.starting import by_name

    printer = Printer(quiet, json)
    given = given_of(fmu, model, class_name, root or [])
    shown = printer.working(f"trying the parameters of {given.fmu.name}")
    with shown as progress, supervised(workers, time_limit, memory_limit) as runner:
        made = new_campaign(
            by_name(data),
            given.fmu,
            out,
            source=given.source,
            signals=signal or (),
            base=_time_base(resample, align, method or []),
            units=pairs(unit or [], "--unit"),
            sigmas=numbers(sigma or [], "--sigma"),
            layout=layout_of(columns, rate),
            progress=progress,
            runner=runner,
        )
    for line in (*made.guesses, *map(str, made.not_looked_for)):
        printer.say(line)
    printer.say(f"{out / 'campaign.toml'}: please review these guesses")
    command = shlex.join(["fmuid", "identify", str(out)])
    printer.next(
        command, "values and standard errors of the free parameters; fmuid check shows what the runs determine"
    )
    printer.write(
        {"out": out, "guesses": made.guesses, "not_looked_for": [asdict(n) for n in made.not_looked_for]}
    )


def layout_of(columns: str | None, rate: float | None) -> TableLayout:
    """Return the layout that `--columns` and `--rate` describe."""
    from fmuid.data.table_layout import TableLayout

    return TableLayout(tuple(name.strip() for name in columns.split(",")) if columns else (), rate)


def _of_run(texts: list[str], run: str) -> list[str]:
    """Return the texts that apply to all runs or to this one: RUN:TEXT, with RUN a glob."""
    from fnmatch import fnmatchcase

    texts_of_run = []
    for text in texts:
        name, colon, rest = text.partition(":")
        if not colon:
            texts_of_run.append(text)
        elif fnmatchcase(run, name):
            texts_of_run.append(rest)
    return texts_of_run


def _span(texts: list[str]) -> tuple[float, float]:
    """Return the last span FROM..TO."""
    span = (float("-inf"), float("inf"))
    for text in texts:
        begin, dots, end = text.partition("..")
        try:
            span = (float(begin or "-inf"), float(end or "inf"))
        except ValueError:
            dots = ""
        if not dots or not span[0] < span[1]:
            raise FmuidError(
                f"'{text}' is not a time span", where="--cut", fix="write it as in --cut 0.5..10 or --cut 0.5.."
            )
    return span


def given_of(fmu: Path | None, model: Path | None, class_name: str | None, roots: list[Path]) -> GivenModel:
    """Return the model that `--fmu` or `--model` names."""
    from fmuid.init.starting import given_model

    given = [file for file in (fmu, model) if file is not None]
    if len(given) != 1:
        what = "an FMU and a model" if given else "neither an FMU nor a model"
        raise FmuidError(what, fix="give --fmu FILE.fmu or --model FILE.mo")
    return given_model(given[0], class_name, roots)


def _time_base(rate: float | None, align: str | None, methods: list[str]) -> TimeBase | None:
    from fmuid.data.recordings.resampling import TimeBase

    for_one: dict[str, Any] = pairs([m for m in methods if "=" in m], "--method")
    for_all: list[Any] = [m for m in methods if "=" not in m]
    for method in (*for_all, *for_one.values()):
        if method not in _METHODS:
            raise FmuidError(f"no method '{method}'", where="--method", fix=f"known: {', '.join(_METHODS)}")
    if rate is None and align is None:
        if methods:
            raise FmuidError("--method without a time base", fix="also give --resample RATE or --align SIGNAL")
        return None
    if rate is not None and align is not None:
        raise FmuidError("--resample and --align are two time bases", fix="leave one out")
    if rate is not None and not 0 < rate < float("inf"):
        raise FmuidError(f"rate {rate:g} is none", where="--resample", fix="give samples a second, such as 1000")
    return TimeBase(rate, align, for_all[-1] if for_all else "linear", for_one)
