"""`fmuid build`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fmuid.cli.output import Json, Printer, Quiet


def build(
    source: Annotated[Path, typer.Argument(help="A .mo file, or the folder of a package.")],
    class_name: Annotated[str, typer.Argument(metavar="CLASS", help="Qualified name of the model to export.")],
    out: Annotated[Path, typer.Option(help="Folder for the FMU.")] = Path("build/fmus"),
    json: Json = None,
    quiet: Quiet = False,
) -> None:
    """Build an FMU (FMI 2.0, co-simulation and model exchange) from Modelica source.

    Example: fmuid build modelica/Drives Drives.Setups.FixedShaft --out build/fmus
    """
    from fmu_build import build as build_fmu

    path = build_fmu(source, class_name, out)
    printer = Printer(quiet, json)
    printer.say(str(path))
    printer.write({"fmu": path, "class": class_name, "source": source})
