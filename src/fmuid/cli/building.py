"""`fmuid build`."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

import typer

from fmuid.cli.output import Json, Printer, Quiet

Fmi = Literal["2", "3"]
Compiler = Literal["rumoca", "omc"]


def build(
    source: Annotated[
        Path, typer.Argument(help="A .mo file, the folder of a package, or one that is shipped: Drives.")
    ],
    class_name: Annotated[str, typer.Argument(metavar="CLASS", help="Qualified name of the model to export.")],
    out: Annotated[Path, typer.Option(help="Folder for the FMU.")] = Path("build/fmus"),
    fmi: Annotated[Fmi, typer.Option(help="Version of FMI.")] = "2",
    compiler: Annotated[Compiler, typer.Option(help="Modelica front end; omc has to be on the PATH.")] = "rumoca",
    root: Annotated[list[Path] | None, typer.Option(help="Folder with further libraries (repeat).")] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> None:
    """Build an FMU (co-simulation and model exchange in one) from Modelica source.

    Example: fmuid build modelica/Drives Drives.Setups.FixedShaft --out build/fmus
    """
    from fmu_build import build as build_fmu

    printer = Printer(quiet, json)
    with printer.working(f"building {class_name}"):
        path = build_fmu(_found(source), class_name, out, fmi, compiler, root or ())
    printer.say(str(path))
    printer.write({"fmu": path, "class": class_name, "source": source})


def _found(source: Path) -> Path:
    """Return `source`, or the shipped package of that name where there is no such file."""
    if not source.exists():
        from importlib.resources import files

        with suppress(ModuleNotFoundError, NotADirectoryError):
            shipped = Path(str(files("modelica") / str(source)))
            if shipped.is_dir():
                return shipped
    return source
