"""What a shell offers when a name is asked for."""

from __future__ import annotations

import tomllib
from pathlib import Path

import typer


def solvers(incomplete: str) -> list[str]:
    """Return the names of solvers that begin so; of a chain those of its next link."""
    from fmuid.identification.solvers import NAMES

    before, arrow, last = incomplete.rpartition(">")
    head = f"{before}{arrow} " if arrow else ""
    return [f"{head}{name}" for name in NAMES if name.startswith(last.strip())]


def stages(context: typer.Context, incomplete: str) -> list[str]:
    """Return the names of the campaign's stages that begin so; none as long as the campaign cannot be read."""
    campaign = Path(context.params.get("campaign") or ".")
    file = campaign / "campaign.toml" if campaign.is_dir() else campaign
    try:
        names = tomllib.loads(file.read_text()).get("stages", {})
    except (OSError, ValueError):
        return []
    return [name for name in names if name.startswith(incomplete)]
