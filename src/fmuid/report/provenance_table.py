"""Provenance of a result: versions of the software and hashes of the files."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path

from fmuid.core.campaign import Campaign
from fmuid.identification import provenance
from fmuid.report.plotly_js import plotly_js_version
from fmuid.report.plots.figure_data import Table

_PACKAGES = ("fmuid", "numpy", "scipy", "nlopt", "h5py", "casadi")


def versions(*more: str) -> dict[str, str]:
    """Return the versions of Python and of the packages that affect numbers, including `more`."""
    return {"python": platform.python_version(), **provenance.versions((*_PACKAGES, *more))}


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file's content, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hashes(paths: Iterable[Path], folder: Path) -> dict[str, str]:
    """Return ``name (SHA-256)`` -> hash of every file that exists, named relative to `folder` if inside."""
    hashes = {}
    for path in paths:
        if path.is_file():
            inside = path.is_relative_to(folder)
            name = path.relative_to(folder).as_posix() if inside else path.name
            hashes[f"{name} (SHA-256)"] = file_hash(path)
    return hashes


def provenance_of(campaign: Campaign, seed: int, *more: str, files: Iterable[Path] = ()) -> dict[str, str]:
    """Return the hashes of a campaign, its models and `files`, the versions including `more`, and the seed."""
    of_campaign = [campaign.file or campaign.folder / "campaign.toml"]
    of_campaign += [file for model in campaign.models.values() for file in model.files]
    return {**hashes(dict.fromkeys([*of_campaign, *files]), campaign.folder), **versions(*more), "seed": str(seed)}


def provenance_table(values: Mapping[str, str]) -> Table:
    """Return `values`, as recorded by the run, and the version that wrote the report, as a table."""
    writer = f"fmuid {version('fmuid')}, matplotlib {version('matplotlib')}, plotly.js {plotly_js_version()}"
    return Table(("what", "value"), (*values.items(), ("report written by", writer)), "provenance")
