"""`fmuid build`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from fmu_build.errors import ModelicaError
from fmuid.cli.libraries import Roots, given_or_included, shipped_library
from fmuid.cli.output import Json, Printer, Quiet, writable

Fmi = Literal["2", "3"]
Compiler = Literal["own", "omc"]


def build(
    source: Annotated[
        Path, typer.Argument(help="A .mo file, the folder of a package, or an included package: Drives.")
    ],
    class_name: Annotated[str, typer.Argument(metavar="CLASS", help="Qualified name of the model to export.")],
    out: Annotated[Path, typer.Option(help="Folder for the FMU.", callback=writable)] = Path("build/fmus"),
    fmi: Annotated[Fmi, typer.Option(help="Version of FMI.")] = "2",
    compiler: Annotated[Compiler, typer.Option(help="Modelica front end; omc must be on the PATH.")] = "own",
    root: Roots = None,
    json: Json = None,
    quiet: Quiet = False,
) -> None:
    """Build an FMU (co-simulation and model exchange in one) from Modelica source.

    Example: fmuid build modelica/Drives Drives.Setups.FixedShaft --out build/fmus
    """
    from fmu_build import build as build_fmu

    printer = Printer(quiet, json)
    file = given_or_included(source)
    if not file.exists():
        packages = sorted(p.parent.name for p in shipped_library().glob("*/package.mo"))
        fix = f"check the path, or choose an included package: {', '.join(packages)}"
        raise ModelicaError("no such Modelica file", where=source, fix=fix)
    with printer.working(f"building {class_name}"):
        path = build_fmu(file, class_name, out, fmi=fmi, compiler=compiler, roots=root or ())
    printer.say(str(path))
    printer.write({"fmu": path, "class": class_name, "source": source})
