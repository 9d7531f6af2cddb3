"""`fmuid check`."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from fmuid.cli.output import CampaignPath, Json, Printer, Quiet


def check(
    campaign: CampaignPath,
    simulate: Annotated[bool, typer.Option(help="Simulate too, to see which parameters move an output.")] = True,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Check a campaign before a run: files, names, units, signals, and whether each parameter has an effect.

    What makes a run impossible ends with exit code 2; findings of level error with 1.

    Example: fmuid check campaigns/force_feedback
    """
    from fmuid.campaign_toml import load_campaign
    from fmuid.model_check import check_effects, check_signals, load_models, match_models

    loaded = load_campaign(campaign)
    models = load_models(loaded)
    findings = match_models(loaded, models) + check_signals(loaded)
    if simulate:
        findings += check_effects(loaded, models)
    errors = sum(f.level == "error" for f in findings)
    printer = Printer(quiet, json)
    runs = len(loaded.measurements)
    printer.say(
        f"{loaded.name}: {runs} runs ({len(loaded.identification)} to identify, {len(loaded.validation)} to"
        f" validate), {len(models)} models, {len(loaded.parameters)} parameters, {len(loaded.stages)} stages"
    )
    for finding in findings:
        printer.say(f"{finding.level}: {finding}")
    printer.say(f"{errors} errors" if errors else "no errors")
    printer.write({"campaign": loaded.name, "ok": not errors, "findings": [asdict(f) for f in findings]})
    return 1 if errors else 0
