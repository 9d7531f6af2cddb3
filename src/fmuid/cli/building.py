"""`fmuid build`."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

import typer

from fmu_build.errors import ModelicaError
from fmuid.cli.output import Json, Printer, Quiet, writable

Fmi = Literal["2", "3"]
Compiler = Literal["own", "omc"]


def build(
    source: Annotated[
        Path, typer.Argument(help="A .mo file, the folder of a package, or one that is shipped: Drives.")
    ],
    class_name: Annotated[str, typer.Argument(metavar="CLASS", help="Qualified name of the model to export.")],
    out: Annotated[Path, typer.Option(help="Folder for the FMU.", callback=writable)] = Path("build/fmus"),
    fmi: Annotated[Fmi, typer.Option(help="Version of FMI.")] = "2",
    compiler: Annotated[Compiler, typer.Option(help="Modelica front end; omc has to be on the PATH.")] = "own",
    root: Annotated[
        list[Path] | None,
        typer.Option(help="Folder with further libraries (repeat); modelica is the one that is shipped."),
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> None:
    """Build an FMU (co-simulation and model exchange in one) from Modelica source.

    Example: fmuid build modelica/Drives Drives.Setups.FixedShaft --out build/fmus
    """
    from fmu_build import build as build_fmu

    printer = Printer(quiet, json)
    file = _found(source)
    if not file.exists():
        packages = sorted(p.parent.name for p in _library().glob("*/package.mo"))
        fix = f"check the path, or name a package that is shipped: {', '.join(packages)}"
        raise ModelicaError("no such Modelica file", where=source, fix=fix)
    with printer.working(f"building {class_name}"):
        roots = [_found(folder) for folder in root or ()]
        path = build_fmu(file, class_name, out, fmi=fmi, compiler=compiler, roots=roots)
    printer.say(str(path))
    printer.write({"fmu": path, "class": class_name, "source": source})


def _found(path: Path) -> Path:
    """Return `path`; where there is none, the shipped folder ``modelica``, or the package of that name in it."""
    library = _library()
    shipped = library.joinpath(*path.parts[1:]) if path.parts[:1] == ("modelica",) else library / path
    return shipped if shipped.is_dir() and not path.exists() else path


def _library() -> Path:
    """Return the folder of the Modelica packages beside the code, installed or in a clone."""
    spec = find_spec("modelica")
    places = (spec and spec.submodule_search_locations) or ()
    return next(place for place in map(Path, places) if place.is_dir())
