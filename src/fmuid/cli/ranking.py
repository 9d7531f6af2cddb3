"""`fmuid sensitivity`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Literal

import typer

from fmuid.cli.completion import stages
from fmuid.cli.interruption import INTERRUPTED
from fmuid.cli.output import Json, Printer, Quiet, Trust, writable
from fmuid.cli.supervised import MemoryLimit, TimeLimit, Workers, in_bytes


def sensitivity(
    campaign: Annotated[
        Path, typer.Argument(metavar="CAMPAIGN|RUN", help="A campaign or the run folder of fmuid identify.")
    ],
    method: Annotated[
        Literal["sobol", "morris"],
        typer.Option(help="sobol: shares of the variance; morris: a ranking from few simulations."),
    ] = "sobol",
    of: Annotated[
        Literal["change", "criterion", "mean", "final", "minimum", "maximum"],
        typer.Option(
            help="Scalar of each output: its change in standard deviations of the noise, or another one."
        ),
    ] = "change",
    stage: Annotated[
        str | None,
        typer.Option(
            help="Use the parameters and runs of this stage (default: all free parameters).", autocompletion=stages
        ),
    ] = None,
    experiment: Annotated[
        list[str] | None, typer.Option("--experiment", "-e", help="Id or glob of the runs (repeat for more).")
    ] = None,
    input_: Annotated[
        Path | None,
        typer.Option("--input", metavar="CSV", help="Inputs of a planned run, instead of recorded ones."),
    ] = None,
    setup: Annotated[str | None, typer.Option(help="Setup of the planned run.")] = None,
    samples: Annotated[
        int | None,
        typer.Option(help="Base samples, a power of two (sobol, 256), or trajectories (morris, 20)."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Output folder (default: runs/<campaign>-sensitivity).", callback=writable)
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the draws and of the bootstrap.")] = 0,
    workers: Workers = None,
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
    trust: Trust = False,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Rank the parameters by their effect on each output over their whole ranges (Sobol', Morris).

    Parameters are drawn between their bounds, or from their priors. No measurements are needed.

    Example: fmuid sensitivity campaigns/drive --method morris
    Example: fmuid sensitivity campaigns/drive --input runs/next/input.csv
    """
    from fmuid.diagnosis_pipeline import campaign_from
    from fmuid.sensitivity_pipeline import FILE_NAME, answer_of_sensitivity, global_sensitivity

    printer = Printer(quiet, json)
    loaded = campaign_from(campaign, trust=trust, planned=True)
    folder = out or Path("runs") / f"{loaded.name}-sensitivity"
    with printer.working("") as shown:
        ranked = global_sensitivity(
            loaded,
            method,
            of=of,
            stage=stage,
            experiments=experiment or (),
            inputs=input_,
            setup=setup,
            samples=samples,
            out=folder,
            seed=seed,
            workers=workers,
            time_limit=time_limit,
            memory_limit=in_bytes(memory_limit),
            say=lambda what, share: shown(share, what),
            trust=trust,
        )
    printer.say(str(ranked))
    printer.say(f"\n{folder / FILE_NAME}\npage: {folder / 'index.html'}")
    if not len(loaded.measurements):
        again = shlex.join(["fmuid", "design", str(campaign), "--for", "parameters"])
        printer.next(again, "the run that best determines these parameters")
    printer.write(answer_of_sensitivity(ranked, loaded))
    return INTERRUPTED if ranked.interrupted else 0
