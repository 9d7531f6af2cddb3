"""Folders in which Modelica tools keep libraries."""

from __future__ import annotations

import os
from pathlib import Path

_USUAL = (
    "~/.openmodelica/libraries",
    "~/AppData/Roaming/.openmodelica/libraries",
    "/usr/lib/omlibrary",
    "/usr/share/omlibrary",
    "/usr/local/lib/omlibrary",
    "/opt/dymola*/Modelica/Library",
    "/usr/local/dymola*/Modelica/Library",
    "/opt/Wolfram/System*Modeler/*/*Library",
    "/usr/local/Wolfram/System*Modeler/*/*Library",
    "/Applications/System*Modeler*.app/Contents/*Library",
)


def standard_folders() -> list[Path]:
    """Return the folders of ``MODELICAPATH`` and those of OpenModelica, Dymola and System Modeler that exist.

    An empty ``MODELICAPATH`` turns the search off.
    """
    given = os.environ.get("MODELICAPATH")
    if given is not None and not given.strip():
        return []
    named = [Path(part).expanduser() for part in (given or "").split(os.pathsep) if part]
    for pattern in _USUAL:
        path = Path(pattern).expanduser()
        start = Path(path.anchor)
        named += sorted(start.glob(str(path.relative_to(start))), reverse=True)  # the newest first
    return [folder for folder in dict.fromkeys(named) if folder.is_dir()]
