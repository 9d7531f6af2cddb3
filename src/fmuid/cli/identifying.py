"""`fmuid identify`, `fmuid validate`, `fmuid diagnose` and `fmuid report`."""

from __future__ import annotations

import json as json_library
import shlex
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from fmuid.cli import completion
from fmuid.cli.diagnosis_text import print_diagnosis, print_validation
from fmuid.cli.interruption import INTERRUPTED
from fmuid.cli.output import CampaignPath, Json, Printer, Quiet, Trust, pairs, writable
from fmuid.cli.supervised import MemoryLimit, TimeLimit, Workers, in_bytes, supervised
from fmuid.core.errors import FmuidError

if TYPE_CHECKING:
    from fmuid.core.campaign import Campaign
    from fmuid.core.experiments import Measurements
    from fmuid.identification.result import Result
    from fmuid.identification.validate import Validation
    from fmuid.simulation.runners import Runner

RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder of fmuid identify.")]
Dask = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Simulate on the Dask cluster of this scheduler.")
]


def identify(
    campaign: CampaignPath,
    out: Annotated[
        Path | None, typer.Option(help="Run folder (default: runs/<campaign>).", callback=writable)
    ] = None,
    stage: Annotated[
        list[str] | None,
        typer.Option("--stage", help="Run this stage only (repeat).", autocompletion=completion.stages),
    ] = None,
    solver: Annotated[
        str | None, typer.Option(help="Use this solver in every stage.", autocompletion=completion.solvers)
    ] = None,
    evaluations: Annotated[
        int | None, typer.Option(min=1, help="Largest number of evaluations per stage.")
    ] = None,
    seconds: Annotated[float | None, typer.Option(min=0.0, help="Longest simulation time per stage, s.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the run in --out.")] = False,
    workers: Workers = None,
    dask: Dask = None,
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
    seed: Annotated[int, typer.Option(help="Seed for random solvers and start points.")] = 0,
    with_report: Annotated[bool, typer.Option("--report/--no-report", help="Also write the report.")] = True,
    trust: Trust = False,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Identify the parameters of a campaign stage by stage, validate them, and write the report.

    Exit code 1: a stage failed. 130: interrupted; progress is saved; continue with `--resume`.

    Example: fmuid identify campaigns/force_feedback --out runs/force_feedback
    Example: fmuid identify campaigns/force_feedback --dask tcp://127.0.0.1:8786
    """
    from fmuid.campaigns.campaign_toml import load_campaign
    from fmuid.core.folder_lock import claim
    from fmuid.identification.history import JOURNAL
    from fmuid.identification.identify import identify as run
    from fmuid.identification.solvers import Status, StopRules
    from fmuid.simulation.pool.choice import runner_on
    from fmuid.simulation.pool.remote import dask_executor
    from fmuid.simulation.pool.workers import available_processors

    loaded = load_campaign(campaign, trust=trust)
    folder = out or Path("runs") / loaded.name
    stop = StopRules(evaluations, seconds) if evaluations or seconds else None
    printer = Printer(quiet, json)
    limits: dict[str, Any] = {"time_limit": time_limit, "memory_limit": in_bytes(memory_limit)}
    asked: dict[str, Any] = {"--stage": stage, "--solver": solver, "--evaluations": evaluations}
    asked |= {"--seconds": seconds, "--seed": seed, "--trust": trust}
    with (
        _told_how_to_look(folder, printer),
        _told_how_to_go_on(folder / JOURNAL, _again("identify", campaign, folder, asked), printer),
        claim(folder),
        dask_executor(dask) if dask else nullcontext() as executor,
    ):
        result = _found_before(folder) if resume else None
        with nullcontext() if result else _progress(quiet) as observer:
            result = result or run(
                loaded,
                out=folder,
                stages=stage,
                solver=solver,
                stop=stop,
                resume=resume,
                executor=executor,
                workers=available_processors() if workers is None else workers,
                **limits,
                observer=observer,
                seed=seed,
            )
        printer.say(str(result))
        summary: dict[str, Any] = {"out": folder, "result": json_library.loads(result.to_json())}
        interrupted = result.status is Status.INTERRUPTED
        with runner_on(workers, executor=executor, **limits) as runner:
            if loaded.validation and not interrupted and result.stages[-1].cost is not None:
                summary |= _validation(_validated(result, printer, runner), printer)
            if with_report and not interrupted:
                from fmuid.report import write_report

                with printer.working("writing the report") as shown:
                    summary["report"] = write_report(folder, campaign=loaded, runner=runner, progress=shown)
                printer.say(f"\nreport: {summary['report']}")
            if result.status not in (Status.INTERRUPTED, Status.FAILED):
                summary |= _write_back(result, loaded, folder, printer, runner)
    if result.status not in (Status.INTERRUPTED, Status.FAILED):
        unexplained = any("run fmuid diagnose" in warning for stage in result.stages for warning in stage.warnings)
        why = "what the model misses" if unexplained else "does the model miss something?"
        printer.next(shlex.join(["fmuid", "diagnose", str(folder)]), why)
    printer.write(summary)
    return INTERRUPTED if interrupted else int(result.status is Status.FAILED)


def validate(
    run: Annotated[
        Path,
        typer.Argument(metavar="RUN", help="Run folder of fmuid identify, or the JSON file of fmuid diagnose."),
    ],
    campaign: Annotated[
        Path | None,
        typer.Argument(metavar="[CAMPAIGN]", help="Validate on this campaign instead of the run's own."),
    ] = None,
    experiment: Annotated[
        list[str] | None,
        typer.Option(
            "--experiment", "-e", help="Id or glob (default: the validation set, without runs that were used)."
        ),
    ] = None,
    measurements: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="For a diagnosis: validate on all runs of a measurement file, or on logs such as CSV (repeat).",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Write measurements and predictions as CSV into this folder.", callback=writable),
    ] = None,
    workers: Workers = None,
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Simulate the validation runs with the identified values and compare the errors with the sensor noise.

    For a diagnosis, the corrected model is compared with the refitted nominal one, on runs that the diagnosis was
    not made from. Exit code 1: a run cannot be simulated; the table gives the reason.

    Example: fmuid validate runs/force_feedback
    Example: fmuid validate runs/diagnosis/diagnosis.json campaigns/force_feedback
    """
    from fmuid.identification.result import Result

    printer = Printer(quiet, json)
    with supervised(workers, time_limit, memory_limit) as runner:
        if run.suffix == ".json" or (run / "diagnosis.json").is_file():
            file = run if run.suffix == ".json" else run / "diagnosis.json"
            asked = _Judged(file, campaign, tuple(measurements or ()), tuple(experiment or ()))
            printer.write(_diagnosis_validation(asked, printer, runner))
            return 0
        if measurements:
            raise FmuidError("is for a diagnosis", where="--measurements", fix="choose a campaign with these runs")
        validation = _validated(Result.from_json(run), printer, runner, campaign, experiment)
    printer.write(_validation(validation, printer, out))
    return int(any(score.failure is not None for score in validation.scores))


def diagnose(
    campaign: Annotated[
        Path,
        typer.Argument(metavar="CAMPAIGN|RUN", help="A campaign or the run folder of fmuid identify."),
    ],
    from_: Annotated[
        Path | None,
        typer.Option("--from", metavar="RUN", help="Start from the values of this identification."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Output folder (default: runs/<campaign>-diagnosis).", callback=writable),
    ] = None,
    experiment: Annotated[
        list[str] | None,
        typer.Option(
            "--experiment",
            "-e",
            help="Id or glob (repeat; default: the campaign's choice, without validation runs).",
        ),
    ] = None,
    measurements: Annotated[
        Path | None, typer.Option(help="Diagnose these measurements instead of the campaign's own.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the diagnosis in --out.")] = False,
    workers: Workers = None,
    dask: Dask = None,
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
    seed: Annotated[int, typer.Option(help="Seed of the null distribution and the bootstrap.")] = 0,
    rehearse: Annotated[
        int,
        typer.Option(
            min=0,
            help=(
                "First diagnose this many plants with known effects, simulated from the fitted model with logs "
                "like yours, and list which effects a diagnosis of this campaign can find."
            ),
        ),
    ] = 0,
    law: Annotated[
        bool, typer.Option(help="Search for an equation if no effect of the catalogue explains the gap.")
    ] = True,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SIGNAL=VALUE",
            help=(
                "Largest error (RMS) of a signal that is tolerated (repeat): in the log's unit, with a unit"
                " ('s=0.2 mm'), or as a share of its range (s=5%)."
            ),
        ),
    ] = None,
    trust: Trust = False,
    json: Json = None,
    json_version: Annotated[int, typer.Option(min=2, max=3, help="Version of the JSON written with --json.")] = 3,
    quiet: Quiet = False,
) -> None:
    """Locate the gap between model and measurements, and name the unmodelled effect that causes it.

    Exit code 0: any answer, also "A or B" or "unknown". 130: interrupted; continue with `--resume`. The output
    folder contains `corrected`: the model with the named effects, and a campaign that continues from it.

    Example: fmuid diagnose campaigns/force_feedback --out runs/diagnosis
    Example: fmuid diagnose runs/force_feedback
    """
    from fmuid.diagnosis.corrected import FOLDER
    from fmuid.diagnosis.verdict import as_version_2
    from fmuid.diagnosis_pipeline import FILE_NAME, JOURNAL, answer_of, campaign_from
    from fmuid.diagnosis_pipeline import diagnose as run
    from fmuid.simulation.pool.remote import dask_executor

    loaded = campaign_from(campaign, from_, measurements=measurements, trust=trust)
    folder = out or Path("runs") / f"{loaded.name}-diagnosis"
    printer = Printer(quiet, json)
    asked: dict[str, Any] = {"--from": from_, "--experiment": experiment, "--measurements": measurements}
    asked |= {"--seed": seed, "--tolerance": tolerance}
    asked |= {"--rehearse": rehearse, "--no-law": not law, "--trust": trust}
    again = _again("diagnose", campaign, folder, asked)
    with (
        _told_how_to_go_on(folder / JOURNAL, again, printer),
        dask_executor(dask) if dask else nullcontext() as executor,
        printer.working("") as shown,
    ):
        outcome = run(
            loaded,
            out=folder,
            experiments=experiment or (),
            resume=resume,
            executor=executor,
            workers=workers,
            time_limit=time_limit,
            memory_limit=in_bytes(memory_limit),
            say=lambda what, share: shown(share, what),
            seed=seed,
            rehearse=rehearse,
            law=law,
            tolerance=pairs(tolerance or (), "--tolerance"),
        )
    answer = answer_of(outcome, loaded)
    print_diagnosis(answer, printer)
    printer.say(f"\n{folder / FILE_NAME}\nreport: {folder / 'index.html'}")
    if answer.get("corrected"):
        corrected, named = folder / FOLDER, " and ".join(answer["corrected"])
        printer.say(f"corrected: {corrected} (the model with {named}, the estimated values, and a campaign)")
        again = shlex.join(["fmuid", "diagnose", str(corrected)])
        printer.next(again, "is anything else missing? fmuid identify also accepts this folder")
    left_open = answer["verdict"]["kind"] in ("ambiguous", "partial", "unknown")
    if left_open and not outcome.subject.observed.nuisances:  # segments begin where a run was measured
        further = shlex.join(["fmuid", "design", str(folder), "--for", "diagnosis"])
        printer.next(further, "the run that best settles what is still open")
    printer.write(as_version_2(answer) if json_version == 2 else answer)


def report(
    run: RunFolder,
    out: Annotated[
        Path | None, typer.Option(help="Folder for index.html, figures and data.", callback=writable)
    ] = None,
    format_: Annotated[
        list[str] | None, typer.Option("--format", help="Format of the figures: png, svg, pdf (repeat).")
    ] = None,
    workers: Workers = None,
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
    trust: Trust = False,
    json: Json = None,
    quiet: Quiet = False,
) -> None:
    """Write the report of a run as one HTML file that opens offline, with its figures and their data.

    Example: fmuid report runs/force_feedback --format svg
    """
    from fmuid.core.files import check_folder
    from fmuid.report import write_report

    formats: Any = tuple(format_ or ("png",))
    unknown = [f for f in formats if f not in ("png", "svg", "pdf")]
    if unknown:
        raise FmuidError(f"no format '{unknown[0]}'", where="--format", fix="known: png, svg, pdf")
    printer = Printer(quiet, json)
    if out is not None:
        check_folder(out)
    with printer.working("") as shown, supervised(workers, time_limit, memory_limit) as runner:
        page = write_report(run, out, formats=formats, trust=trust, runner=runner, progress=shown)
    printer.say(str(page))
    printer.write({"run": run, "report": page})


class _Judged(NamedTuple):
    """A diagnosis with its campaign and measurements."""

    file: Path
    campaign: Path | None
    measurements: tuple[Path, ...]
    experiments: tuple[str, ...]


def _diagnosis_validation(asked: _Judged, printer: Printer, runner: Runner) -> dict[str, Any]:
    from fmuid.campaigns.campaign_toml import load_campaign
    from fmuid.diagnosis.corrected import FOLDER, read_diagnosis, validate_diagnosis
    from fmuid.diagnosis.made_catalogue import with_kept_catalogue

    answer = read_diagnosis(asked.file)
    campaign = asked.campaign or answer.get("campaign")
    if campaign is None:
        raise FmuidError("no campaign to validate on", where=asked.file, fix="give one as second argument")
    loaded = with_kept_catalogue(load_campaign(campaign), asked.file.parent)
    recorded = _recorded(asked.measurements, loaded)
    others = load_campaign(campaign, measurements=recorded, judged=True) if recorded is not None else None
    written = asked.file.parent / FOLDER / "campaign.toml"
    corrected = (
        load_campaign(written, measurements=recorded, judged=recorded is not None)
        if answer.get("corrected") and written.is_file()
        else None
    )
    with printer.working("simulating the runs"):
        validation = validate_diagnosis(
            answer, loaded, others=others, corrected=corrected, experiments=asked.experiments, runner=runner
        )
    print_validation(validation, answer, printer)
    return {"diagnosis": asked.file, "campaign": campaign, **validation.to_dict()}


def _recorded(files: tuple[Path, ...], campaign: Campaign) -> Measurements | None:
    """Return the runs of a measurement file, or of logs with the campaign's columns; None without a file."""
    from fmuid.data.measurements import read_measurements
    from fmuid.data.recordings.conversion import further_runs

    if not files:
        return None
    if len(files) == 1 and files[0].suffix in (".h5", ".hdf5"):
        return read_measurements(files[0])
    return further_runs(files, campaign.measurements)


def _found_before(folder: Path) -> Result | None:
    """Return the result of a run that was killed before its last files were written."""
    from fmuid.identification.history import JOURNAL
    from fmuid.identification.identified_models import PARAMETERS
    from fmuid.identification.result import FILE, Result

    complete = (folder / FILE).exists() and not (folder / JOURNAL).exists()
    return Result.from_json(folder) if complete and not (folder / "identified" / PARAMETERS).exists() else None


def _write_back(
    result: Result, campaign: Campaign, folder: Path, printer: Printer, runner: Runner
) -> dict[str, Any]:
    from fmuid.identification.identified_models import write_identified

    written = write_identified(result, campaign, folder / "identified", runner)
    more = [f.name for f in (*written.modelica, written.robot) if f is not None]
    contents = ", ".join(["FMUs with these values", "parameters.ssv", *more])
    printer.say(f"identified: {folder / 'identified'} ({contents})")
    for warning in written.warnings:
        printer.say(f"! {warning}")
    files = {"fmus": written.fmus, "parameters": written.parameters, "modelica": written.modelica}
    return {"identified": files | ({} if written.robot is None else {"robot": written.robot})}


def _again(command: str, campaign: Path, folder: Path, options: Mapping[str, Any]) -> str:
    """Return the command that continues an interrupted one."""
    words = ["fmuid", command, str(campaign), "--out", str(folder)]
    for name, value in options.items():
        for one in value if isinstance(value, list) else [value]:
            words += [] if not one else [name] if one is True else [name, str(one)]
    return shlex.join([*words, "--resume"])


@contextmanager
def _told_how_to_go_on(journal: Path, again: str, printer: Printer) -> Iterator[None]:
    """Print at the end how to continue an interrupted command."""
    try:
        yield
    finally:
        if journal.exists() and not isinstance(sys.exception(), FmuidError):
            printer.say(f"\ncontinue with: {again}")


@contextmanager
def _told_how_to_look(folder: Path, printer: Printer) -> Iterator[None]:
    """Print at the end how to see the results of an interrupted run, without waiting for figures."""
    from fmuid.identification.history import JOURNAL
    from fmuid.identification.result import FILE

    report = shlex.join(["fmuid", "report", str(folder)])
    try:
        yield
    except KeyboardInterrupt:
        if not (folder / JOURNAL).exists() and (folder / FILE).exists():
            printer.say(f"\nthe result is in {folder}; write the report with: {report}")
        raise
    finally:
        if (folder / JOURNAL).exists() and not isinstance(sys.exception(), FmuidError):
            printer.say(f"or write a report of the results so far with: {report}")


def _progress(quiet: bool) -> Any:
    if quiet:
        return nullcontext()
    from fmuid.identification.terminal_progress import TerminalProgress

    return TerminalProgress()


def _validated(
    result: Result,
    printer: Printer,
    runner: Runner,
    campaign: Path | None = None,
    experiments: list[str] | None = None,
) -> Validation:
    from fmuid.identification.validate import validate as score

    with printer.working("simulating the runs"):
        return score(result, campaign, experiments=experiments, runner=runner)


def _validation(validation: Validation, printer: Printer, out: Path | None = None) -> dict[str, Any]:
    printer.say(f"\nvalidation\n{validation}")
    if out is not None:
        from fmu_build.errors import counted
        from fmuid.data.crosscheck_csv import Table, write_csv

        for case, prediction in zip(validation.cases, validation.predictions, strict=True):
            columns = {f"{c.signal}_measured": c.mean for c in case.channels}
            if prediction is not None:
                columns |= {c.signal: y for c, y in zip(case.channels, prediction, strict=True)}
            units = {n: c.unit for c in case.channels for n in (c.signal, f"{c.signal}_measured") if c.unit}
            write_csv(
                Table(case.task.time, columns, {n: units[n] for n in columns if n in units}),
                out / f"{case.id}.csv",
            )
        printer.say(f"{out}: {counted(len(validation.cases), 'file')}")
    return {"validation": validation.to_dict()["scores"]}
