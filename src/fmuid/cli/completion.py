"""Completion of names in a shell."""

from __future__ import annotations

import tomllib
from pathlib import Path

import typer


def solvers(incomplete: str) -> list[str]:
    """Return the names of solvers with this beginning; in a chain, for its next link."""
    from fmuid.identification.solvers import NAMES

    before, arrow, last = incomplete.rpartition(">")
    head = f"{before}{arrow} " if arrow else ""
    return [f"{head}{name}" for name in NAMES if name.startswith(last.strip())]


def stages(context: typer.Context, incomplete: str) -> list[str]:
    """Return the names of stages with this beginning; none if the campaign cannot be read."""
    # After an option that still waits for its value, the arguments before it have not been taken yet.
    words = [context.params.get("campaign"), *context.args]
    places = [Path(word) for word in words if word] or [Path()]
    files = [place / "campaign.toml" if place.is_dir() else place for place in places]
    try:
        names = tomllib.loads(next(file for file in files if file.is_file()).read_text()).get("stages", {})
    except (OSError, ValueError, StopIteration):
        return []
    return [name for name in names if name.startswith(incomplete)]
