"""`fmuid check`."""

from __future__ import annotations

import shlex
from dataclasses import asdict
from typing import Annotated

import typer

from fmuid.cli.output import CampaignPath, Json, Printer, Quiet, Trust
from fmuid.cli.supervised import MemoryLimit, TimeLimit, Workers, supervised


def check(
    campaign: CampaignPath,
    simulate: Annotated[
        bool, typer.Option(help="Also simulate, to find out which parameters affect an output.")
    ] = True,
    workers: Workers = None,
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
    trust: Trust = False,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Check a campaign before a run: files, names, units, signals, solvers, and the effect of each parameter.

    Exit code 1: there are findings of level error. 2: the campaign cannot be run.

    Example: fmuid check campaigns/force_feedback
    """
    from fmu_build.errors import counted
    from fmuid.campaigns.campaign_toml import load_campaign
    from fmuid.identification.check import load_models
    from fmuid.identification.full_check import static_check, with_effects

    loaded = load_campaign(campaign, trust=trust)
    models = load_models(loaded)
    checked = static_check(loaded, models)
    printer = Printer(quiet, json)
    if simulate:
        with (
            printer.working("varying the parameters one by one"),
            supervised(workers, time_limit, memory_limit) as runner,
        ):
            checked = with_effects(checked, loaded, models, runner)
    errors = checked.errors
    sizes = (("model", models), ("parameter", loaded.parameters), ("stage", loaded.stages))
    printer.say(
        f"{loaded.name}: {counted(len(loaded.measurements), 'run')} ({len(loaded.identification)} to identify,"
        f" {len(loaded.validation)} to validate), {', '.join(counted(len(what), word) for word, what in sizes)}"
    )
    if checked.effects:
        header = ("stage", "parameter", "sigma for 1 %", "step", "noise floor", "most in")
        rows = [(e.stage, e.parameter, e.change, e.step, e.floor, e.criterion) for e in checked.effects]
        printer.table(header, rows)
    for finding in checked.findings:
        printer.say(f"{finding.level}: {finding}")
    printer.say(counted(errors, "error") if errors else "no errors")
    if not errors:
        printer.next(shlex.join(["fmuid", "identify", str(campaign)]), "values and standard errors")
    printer.write(
        {
            "campaign": loaded.name,
            "ok": not errors,
            "findings": [asdict(f) for f in checked.findings],
            "effects": [asdict(e) for e in checked.effects],
        }
    )
    return 1 if errors else 0
