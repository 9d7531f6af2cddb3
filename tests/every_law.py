"""Models with every law that their ports allow, at the same size everywhere."""

from __future__ import annotations

from pathlib import Path

from fmu_build.flat_model import FlatModel
from fmu_build.model_ports import find_ports
from fmuid.diagnosis.made_catalogue import catalogue_text
from fmuid.effects.effect import Catalogue
from fmuid.effects.effects_file import load_catalogue
from fmuid.effects.laws import SIZES, Place

HEAD = 'format = "fmuid-effects"\nversion = 1\n'


def written(model: FlatModel, size: float = 1.0) -> str:
    """The text of the catalogue of every law at every port."""
    sizes = dict.fromkeys(SIZES, size)
    return catalogue_text([Place(port, sizes) for port in find_ports(model) if not port.passed], {}, HEAD)


def every_law(model: FlatModel, folder: Path, size: float = 1.0) -> Catalogue:
    """The same, read."""
    file = folder / "effects.toml"
    file.write_text(written(model, size))
    return load_catalogue(file)
