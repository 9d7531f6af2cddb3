"""Models given by their Modelica source: built when needed, and kept in the user's cache."""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from fmu_build import build, check_flat, compile_flat, load
from fmu_build.build import built_by, libraries_of
from fmu_build.cache import remove_unused, user_cache
from fmu_build.errors import ModelicaError
from fmu_build.flat_model import FlatModel
from fmu_build.instrument import Added, Term, instrument
from fmu_build.model_ports import places
from fmuid.core.campaign import ModelSource
from fmuid.effects.effects_file import load_catalogue
from fmuid.simulation.fmu import load_fmu


def flat_model(source: ModelSource) -> FlatModel:
    """Flatten the class, and add the effects that the model includes.

    Raises
    ------
    ModelicaError
        The source is missing, wrong, or outside the supported subset, or an effect does not fit it.
    CampaignError
        The catalogue does not exist, or its effects have no expressions.
    """
    flat = load(source.file, source.class_name, source.roots)
    _check_libraries(source, flat.libraries)
    if source.effects is None:
        return flat
    effects = load_catalogue(source.effects).effects.values()
    ports = places(flat)
    # A campaign's models share a catalogue, but each has only some of its ports.
    here = [e for e in effects if e.port in ports] or [*effects]
    return instrument(flat, [term for e in here for term in e.terms], [one for e in here for one in e.added()])


def effects_inside(source: ModelSource) -> frozenset[str]:
    """Return the ids of the effects that the model includes."""
    return frozenset() if source.effects is None else frozenset(load_catalogue(source.effects).effects)


def built_model(source: ModelSource) -> Path:
    """Return the FMU of the class with its effects, built unless it is in the cache.

    Raises
    ------
    ModelicaError
        The source is missing, wrong, or outside the supported subset.
    BuildError
        There is no C compiler, or it fails.
    """
    if source.effects is not None:
        return built_with_terms(source, flat_model(source), (), ())
    fmu = build(source.file, source.class_name, _folder(source), roots=source.roots)
    _check_libraries(source, libraries_of(fmu))
    return fmu


def with_libraries(source: ModelSource) -> ModelSource:
    """Return the source of a built model with the versions of the libraries that it uses."""
    return replace(source, libraries=libraries_of(_folder(source) / f"{_stem(source)}.fmu"))


def _check_libraries(source: ModelSource, libraries: Sequence[tuple[str, str]]) -> None:
    """Warn if a library has another version than the one with which the campaign was made."""
    made = dict(source.libraries)
    for name, version in libraries:
        if made.get(name, version) != version:
            warnings.warn(
                f"{source.file}: the campaign was made with {name} {made[name]}, but {version} is used; "
                f"give the folder of {made[name]} as `roots`, or change `libraries`",
                stacklevel=2,
            )


def built_with_terms(source: ModelSource, flat: FlatModel, terms: Sequence[Term], added: Iterable[Added]) -> Path:
    """Return the FMU of the class with terms at its ports, built next to the plain one unless it is in the cache.

    Raises
    ------
    ModelicaError
        A term does not fit the model.
    BuildError
        There is no C compiler, or it fails.
    """
    names = [*added]
    target = _with_terms(source, flat, terms, names)
    if target.is_file():
        with suppress(OSError):  # a cache that may only be read
            os.utime(target)
        return target
    remove_unused(_models(), "*/*-*")  # an edited model has others
    from fmu_build.packaging import package  # needs CasADi

    changed = instrument(flat, terms, names)
    model = compile_flat(changed)
    states = {v.derivative_of for v in model.variables}
    if not _plain_states(source) <= states and (kept := with_plain_states(source, changed)) is not changed:
        model = compile_flat(kept)
    return package(replace(model, name=_stem(source)), target)


def with_plain_states(source: ModelSource, flat: FlatModel) -> FlatModel:
    """Return a model with effects that has the states of the one without, where preferring them suffices.

    Its runs then begin in the same states.
    """
    kept = _plain_states(source)
    if kept <= {*check_flat(flat)}:
        return flat
    preferred = flat.with_preference(kept)
    with suppress(ModelicaError):
        if kept <= {*check_flat(preferred)}:
            return preferred
    return flat


def _plain_states(source: ModelSource) -> frozenset[str]:
    """Return the states of the class without effects."""
    return frozenset(load_fmu(built_model(replace(source, effects=None))).states)


def fitting_with_terms(
    source: ModelSource, flat: FlatModel, terms: Sequence[Term], added: Sequence[Added], most: int | None
) -> Path:
    """Return the file in the cache for the terms that fit, if not all do; with `most`, that number of states."""
    suffix = ".json" if most is None else f".{most}.json"
    return _with_terms(source, flat, terms, added).with_suffix(suffix)


def _with_terms(source: ModelSource, flat: FlatModel, terms: Sequence[Term], added: Sequence[Added]) -> Path:
    return _folder(source) / f"{_stem(source)}-{_digest(source, flat, terms, added)[:12]}.fmu"


def _digest(source: ModelSource, flat: FlatModel, terms: Sequence[Term], added: Sequence[Added]) -> str:
    """Return a digest of all that the FMU of a class with terms depends on."""
    files = [*flat.files, *filter(None, [source.effects])]
    contents = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]
    inside = [replace(term, where="") for term in terms]
    return hashlib.sha256(repr((contents, inside, [*added], built_by())).encode()).hexdigest()


def _stem(source: ModelSource) -> str:
    return source.class_name.rpartition(".")[2]


def _folder(source: ModelSource) -> Path:
    parts = [source.file.resolve(), source.class_name, *(root.resolve() for root in source.roots)]
    digest = hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()
    return _models() / digest[:16]


def _models() -> Path:
    return user_cache() / "models"
