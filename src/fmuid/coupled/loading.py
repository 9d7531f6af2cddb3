"""From what a campaign names as a model to one that can be simulated."""

from __future__ import annotations

import os
import shutil
import weakref
from collections.abc import Callable, Hashable
from pathlib import Path

from fmuid.campaign import ModelSpec
from fmuid.coupled.checks import unit_conversion, variable_at
from fmuid.coupled.model import CoupledModel
from fmuid.coupled.ssp import read_system
from fmuid.coupled.structure import Connection, Coupling, Master, Place
from fmuid.errors import FmuError
from fmuid.fmu import Fmu, extract, load_fmu
from fmuid.suggest import suggestion

SUFFIX = ".ssp"
_MAX_MODELS = 64

_models: dict[Hashable, CoupledModel] = {}  # in one process always the same object


def load_model(model: ModelSpec | str | Path) -> Fmu | CoupledModel:
    """Return the model of a setup, or the one in a file: an FMU, or several coupled (SSP).

    Raises
    ------
    FmuError
        A file is missing or cannot be used.
    """
    if not isinstance(model, ModelSpec):
        model = ModelSpec("", Path(model))
    if model.coupling is not None and model.coupling.components:
        return couple(model.coupling, model.fmu)
    if model.fmu.suffix == SUFFIX:
        return load_system(model.fmu, model.coupling.master if model.coupling else None)
    return load_fmu(model.fmu)


def load_system(path: str | Path, master: Master | None = None) -> CoupledModel:
    """Return the system that an SSP file describes: in one process the same object as long as it does not change.

    Raises
    ------
    FmuError
        It is no readable SSP file, uses what is not supported, or its components do not fit together.
    """
    file, master = Path(path).resolve(), master or Master()

    def make() -> CoupledModel:
        folder = extract(file)
        try:
            found = read_system(file, folder)
            model = CoupledModel(
                file,
                found.components,
                found.connections,
                ports=found.ports,
                master=master,
                starts=found.starts,
                experiment=found.experiment,
                reload=(load_system, (file, master)),
            )
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        weakref.finalize(model, _remove, folder, os.getpid())
        return model

    return _once((file, repr(master), _state(file)), make)


def couple(coupling: Coupling, path: str | Path = "system") -> CoupledModel:
    """Return FMUs coupled by a table of connections, in one process the same object; `path` names it in errors.

    Raises
    ------
    FmuError
        A file is missing, or the components do not fit together.
    """
    where = Path(path)
    files = {name: file.resolve() for name, file in coupling.components.items()}
    resolved = Coupling(coupling.master, files, coupling.connections)

    def make() -> CoupledModel:
        components = {name: Fmu(file) for name, file in files.items()}
        connections = []
        for target, (source, linear) in coupling.connections.items():
            begin, end = (_place(where, components, name) for name in (source, target))
            units = [variable_at(where, components, p).unit for p in (begin, end)]
            convert = unit_conversion(where, source, units[0], target, units[1])
            connections.append(Connection(begin, end, convert.then(linear)))
        return CoupledModel(
            where, components, connections, master=coupling.master, reload=(couple, (resolved, where))
        )

    return _once((where, repr(resolved), *map(_state, files.values())), make)


def _place(where: Path, components: dict[str, Fmu], name: str) -> Place:
    component, dot, variable = name.partition(".")
    if not dot:
        raise FmuError(
            f"'{name}' is no variable of a component",
            where=where,
            fix=f"write it as component.variable; {suggestion(name, components)}",
        )
    return Place(component, variable)


def _once(key: Hashable, make: Callable[[], CoupledModel]) -> CoupledModel:
    if key not in _models:
        while len(_models) >= _MAX_MODELS:
            _models.pop(next(iter(_models)))
        _models[key] = make()
    return _models[key]


def _state(file: Path) -> tuple[int, int]:
    try:
        state = file.stat()
    except OSError as error:
        raise FmuError(f"cannot be read ({error.strerror})", where=file, fix="check the path") from None
    return state.st_mtime_ns, state.st_size


def _remove(folder: Path, process: int) -> None:
    if os.getpid() == process:  # not in a fork, whose parent still needs it
        shutil.rmtree(folder, ignore_errors=True)
