"""Folders of Modelica libraries given to commands."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer


def given_or_included(path: Path) -> Path:
    """Return `path`; where there is none, the shipped folder ``modelica``, or the package of that name in it."""
    library = shipped_library()
    shipped = library.joinpath(*path.parts[1:]) if path.parts[:1] == ("modelica",) else library / path
    return shipped if shipped.is_dir() and not path.exists() else path


def shipped_library() -> Path:
    """Return the folder of the included Modelica packages, installed or in a clone."""
    spec = find_spec("modelica")
    places = (spec and spec.submodule_search_locations) or ()
    return next(place for place in map(Path, places) if place.is_dir())


Roots = Annotated[
    list[Path] | None,
    typer.Option(
        "--root",
        metavar="FOLDER",
        help="Folder with libraries of the Modelica model (repeat); modelica is the included one.",
        callback=lambda folders: [given_or_included(folder) for folder in folders or ()],
    ),
]
