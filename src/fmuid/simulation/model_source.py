"""Models that a campaign names by their Modelica source: built when needed, and kept in the user's cache."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from fmu_build import build, compile_flat, load
from fmu_build.flat_model import FlatModel
from fmu_build.instrument import Added, Term, instrument
from fmu_build.packaging import package
from fmuid.core.campaign import ModelSource
from fmuid.core.files import user_cache


def flat_model(source: ModelSource) -> FlatModel:
    """Flatten the class.

    Raises
    ------
    ModelicaError
        The source is missing, wrong, or outside the supported subset.
    """
    return load(source.file, source.class_name)


def built_model(source: ModelSource) -> Path:
    """Return the FMU of the class, built unless the cache has it.

    Raises
    ------
    ModelicaError
        The source is missing, wrong, or outside the supported subset.
    BuildError
        There is no C compiler, or it fails.
    """
    return build(source.file, source.class_name, _folder(source))


def built_with_terms(source: ModelSource, flat: FlatModel, terms: Sequence[Term], added: Iterable[Added]) -> Path:
    """Return the FMU of the class with terms at its ports, beside the plain one, built unless the cache has it.

    Raises
    ------
    ModelicaError
        A term does not fit the model.
    BuildError
        There is no C compiler, or it fails.
    """
    changed = instrument(flat, terms, added)
    model = replace(compile_flat(changed), name=_stem(source))
    target = _folder(source) / f"{_stem(source)}-{model.content_hash[:12]}.fmu"
    return target if target.is_file() else package(model, target)


def _stem(source: ModelSource) -> str:
    return source.class_name.rpartition(".")[2]


def _folder(source: ModelSource) -> Path:
    digest = hashlib.sha256(f"{source.file.resolve()}\n{source.class_name}".encode()).hexdigest()
    return user_cache() / "models" / digest[:16]
