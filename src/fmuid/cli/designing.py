"""`fmuid design`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Literal

import typer

from fmuid.cli.interruption import INTERRUPTED
from fmuid.cli.output import Json, Printer, Quiet, Trust, writable
from fmuid.cli.supervised import MemoryLimit, TimeLimit, Workers, in_bytes


def design(
    campaign: Annotated[
        Path,
        typer.Argument(metavar="CAMPAIGN|RUN", help="A campaign, or the run folder of identify or diagnose."),
    ],
    for_: Annotated[
        Literal["diagnosis", "parameters"],
        typer.Option("--for", help="diagnosis: separate its answers; parameters: shrink their intervals."),
    ],
    from_: Annotated[
        Path | None,
        typer.Option("--from", metavar="RUN", help="Run folder of identify or diagnose for this campaign."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Output folder (default: runs/<campaign>-design).", callback=writable)
    ] = None,
    stage: Annotated[
        str | None, typer.Option(help="Use the parameters of this stage (default: all free parameters).")
    ] = None,
    optimality: Annotated[
        Literal["D", "A"],
        typer.Option(help="D: smallest confidence region; A: smallest sum of squared relative errors."),
    ] = "D",
    evaluations: Annotated[int, typer.Option(min=8, help="Excitations to try.")] = 200,
    seed: Annotated[int, typer.Option(help="Seed of the search and of random phases.")] = 0,
    workers: Workers = None,
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
    trust: Trust = False,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Design the next experiment within the campaign's limits: an input as CSV, and its expected information.

    Limits are in the `limits` table of campaign.toml. A design for parameters needs no measurements.

    Example: fmuid design campaigns/drive --for parameters --out runs/next
    Example: fmuid design runs/drive-diagnosis --for diagnosis
    """
    from fmuid.design_pipeline import INPUT, campaign_and_diagnosis, design_experiment

    printer = Printer(quiet, json)
    loaded, _ = campaign_and_diagnosis(campaign, from_, trust=trust)
    folder = out or Path("runs") / f"{loaded.name}-design"
    with printer.working("") as shown:
        designed = design_experiment(
            campaign,
            for_,
            start=from_,
            out=folder,
            stage=stage,
            optimality=optimality,
            evaluations=evaluations,
            seed=seed,
            workers=workers,
            time_limit=time_limit,
            memory_limit=in_bytes(memory_limit),
            say=lambda what, share: shown(share, what),
            trust=trust,
        )
    printer.say(str(designed))
    printer.say(f"\n{folder / INPUT}\npage: {folder / 'index.html'}")
    command = ["fmuid", "import", "RECORDED.csv", "--setup", str(designed.answer["setup"])]
    command += [word for name in designed.inputs for word in ("--input", name)]
    command += ["--out", str(loaded.measurements_file or "measurements.h5")]
    command += ["--append"] if len(loaded.measurements) else []
    printer.next(shlex.join(command), f"once the rig has played {INPUT} and RECORDED.csv is what it measured")
    printer.write(designed.answer)
    return INTERRUPTED if designed.interrupted else 0
