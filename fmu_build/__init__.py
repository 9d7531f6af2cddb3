"""From Modelica source to a tested FMU with packages from PyPI and a C compiler."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fmu_build.build import build, check_tools, load

if TYPE_CHECKING:
    from fmu_build.flat_model import FlatModel
    from fmu_build.model import CompiledModel

__all__ = ["build", "check_flat", "compile_flat", "compile_modelica", "load"]


def compile_flat(flat: FlatModel) -> CompiledModel:
    """Translate a flat model; see `fmu_build.compiler.compile_flat`."""
    check_tools()
    from fmu_build.compiler import compile_flat as compile_

    return compile_(flat)


def check_flat(flat: FlatModel) -> tuple[str, ...]:
    """Return the names of the states of a flat model; see `fmu_build.compiler.check_flat`."""
    check_tools()
    from fmu_build.compiler import check_flat as check

    return check(flat)


def compile_modelica(file: Path, class_name: str, roots: Sequence[Path] = ()) -> CompiledModel:
    """Translate a Modelica class; see `fmu_build.compiler.compile_modelica`."""
    check_tools()
    from fmu_build.compiler import compile_modelica as compile_

    return compile_(file, class_name, roots)
