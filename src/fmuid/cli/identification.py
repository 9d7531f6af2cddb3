"""`fmuid identify`, `fmuid validate`, `fmuid diagnose` and `fmuid report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fmuid.cli.output import CampaignPath, Json, Quiet
from fmuid.errors import FmuidError

RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Folder that an identification wrote.")]


def identify(
    campaign: CampaignPath,
    out: Annotated[Path | None, typer.Option(help="Folder for history, result and report.")] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Identify the parameters of a campaign, stage by stage.

    Example: fmuid identify campaigns/force_feedback --out runs/force_feedback
    """
    raise FmuidError("identify is not in this version yet")


def validate(
    run: RunFolder,
    out: Annotated[Path | None, typer.Option(help="Folder for figures and tables.")] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Simulate the runs that were kept for validation with the parameters that a run found."""
    raise FmuidError("validate is not in this version yet")


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
