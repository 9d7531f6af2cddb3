"""`fmuid study`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fmuid.cli.completion import stages
from fmuid.cli.output import CampaignPath, Json, Printer, Quiet, Trust, writable
from fmuid.cli.supervised import MemoryLimit, TimeLimit, Workers, supervised

TABLE = "study.csv"


def study(
    campaign: CampaignPath,
    over: Annotated[
        list[str],
        typer.Option(
            metavar="NAME=VALUES",
            help="Parameter and its values: k=1..3:7 (seven), k=1..100:5:log, or k=0.5,1,2 (repeat for a grid).",
        ),
    ],
    stage: Annotated[
        str | None, typer.Option(help="Stage with the criteria (default: the first).", autocompletion=stages)
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Output folder (default: runs/<campaign>-study).", callback=writable)
    ] = None,
    workers: Workers = None,
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
    trust: Trust = False,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Evaluate the criteria of a stage on a grid of parameter values; other parameters keep their start values.

    Exit code 1: no point can be simulated.

    Example: fmuid study campaigns/drive --over k=1..3:7 --over T=0.1,0.2,0.5
    """
    from fmuid.campaigns.campaign_toml import load_campaign
    from fmuid.core.files import write_atomically
    from fmuid.identification.check import load_models, match_models
    from fmuid.identification.parameter_study import grid_values, parameter_study
    from fmuid.report.study_page import table_of, write_study_page

    printer = Printer(quiet, json)
    grid = dict(map(grid_values, over))
    loaded = load_campaign(campaign, trust=trust)
    folder = out or Path("runs") / f"{loaded.name}-study"
    models = load_models(loaded)
    match_models(loaded, models)
    with printer.working("simulating the grid") as shown, supervised(workers, time_limit, memory_limit) as runner:
        table = parameter_study(loaded, grid, stage=stage, simulators=models, runner=runner, progress=shown)
    units = {name: spec.unit or "" for name, spec in loaded.parameters.items()}
    page = write_study_page(table, folder, campaign=loaded.title or loaded.name, units=units)
    write_atomically(folder / TABLE, table_of(table).csv())
    printer.say(str(table))
    printer.say(f"\n{folder / TABLE}\npage: {page}")
    printer.write(
        {
            "stage": table.stage,
            "over": table.over,
            "columns": table.header,
            "rows": [table.row(k) for k in range(len(table.points))],
            "failures": table.failures,
            "best": table.best,
            "page": page,
        }
    )
    return int(table.best is None)
