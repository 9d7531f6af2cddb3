"""`fmuid identify`, `fmuid validate`, `fmuid diagnose` and `fmuid report`."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from fmuid.cli.output import CampaignPath, Json, Printer, Quiet
from fmuid.errors import FmuidError

RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Folder that an identification wrote.")]
_INTERRUPTED = 130


def identify(
    campaign: CampaignPath,
    out: Annotated[
        Path | None, typer.Option(help="Folder for result and history; runs/<campaign> by default.")
    ] = None,
    stage: Annotated[
        list[str] | None, typer.Option(help="Run this stage only (may be given several times).")
    ] = None,
    solver: Annotated[
        str | None, typer.Option(help="Solver for every stage instead of the campaign's, such as bobyqa.")
    ] = None,
    workers: Annotated[
        int, typer.Option(min=0, help="Worker processes to simulate in; 0: in this process.")
    ] = 0,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the interrupted run in --out.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of random solvers and starts.")] = 0,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Identify the parameters of a campaign, stage by stage.

    Ctrl-C keeps and reports what was reached; --resume goes on from there.

    Example: fmuid identify campaigns/force_feedback --out runs/force_feedback
    """
    from fmuid.campaign_toml import load_campaign
    from fmuid.identification import identify as run
    from fmuid.progress import TerminalProgress
    from fmuid.solvers import Status

    loaded = load_campaign(campaign)
    folder = out or Path("runs") / loaded.name
    with nullcontext() if quiet else TerminalProgress() as observer:
        result = run(
            loaded,
            out=folder,
            stages=stage,
            solver=solver,
            workers=workers,
            resume=resume,
            observer=observer,
            seed=seed,
        )
    printer = Printer(quiet, json)
    printer.say(f"{result}\n\nresult and history: {folder}")
    if json is not None:
        result.to_json(json)
    if result.status is Status.INTERRUPTED:
        return _INTERRUPTED
    return 1 if result.status is Status.FAILED else 0


def validate(
    run: RunFolder,
    campaign: Annotated[
        Path | None, typer.Argument(metavar="[CAMPAIGN]", help="Another campaign than the run's own.")
    ] = None,
    experiment: Annotated[
        list[str] | None, typer.Option(help="Runs to simulate instead of the validation set (ids or globs).")
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Simulate the runs that were kept for validation with the parameters that a run found.

    Example: fmuid validate runs/force_feedback
    """
    from fmuid.result import Result
    from fmuid.validation import validate as score

    validation = score(Result.from_json(run), campaign, experiments=experiment or None)
    printer = Printer(quiet, json)
    printer.say(str(validation))
    printer.write(validation.to_dict())
    return 1 if any(s.failure is not None for s in validation.scores) else 0


def diagnose(
    campaign: CampaignPath,
    out: Annotated[Path | None, typer.Option(help="Folder for the diagnosis.")] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Say where model and measurements part, and which effect is missing."""
    raise FmuidError("diagnose is not in this version yet")


def report(
    run: RunFolder,
    out: Annotated[Path | None, typer.Option(help="HTML file to write.")] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> None:
    """Write the report of a run as one HTML file."""
    raise FmuidError("report is not in this version yet")
