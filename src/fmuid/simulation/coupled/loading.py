"""Loading of the models that a campaign names."""

from __future__ import annotations

import functools
import os
import shutil
import weakref
from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from pathlib import Path

from fmu_build.suggest import suggestion
from fmuid.core.campaign import ModelSpec
from fmuid.core.coupling import Connection, Coupling, Linear, Master, Place
from fmuid.core.errors import FmuError, FmuidError
from fmuid.simulation.coupled.connection_checks import check_connections, unit_conversion, variable_at
from fmuid.simulation.coupled.coupled_model import CoupledModel
from fmuid.simulation.coupled.ssp import read_system
from fmuid.simulation.fmu import Fmu, extract, load_fmu
from fmuid.simulation.signal_model import SignalModel
from fmuid.simulation.simulator import Simulator

SUFFIX = ".ssp"
_MAX_MODELS = 64

_models: dict[Hashable, CoupledModel] = {}  # always the same object within a process


def load_model(model: ModelSpec | str | Path) -> Fmu | CoupledModel:
    """Return the model of a setup or of a file: an FMU, or coupled FMUs (SSP).

    Parameters
    ----------
    model
        A setup of a campaign, or an ``.fmu`` or ``.ssp`` file.

    Raises
    ------
    FmuError
        A file is missing or cannot be used.
    """
    if not isinstance(model, ModelSpec):
        model = ModelSpec("", Path(model))
    if model.coupling is not None and model.coupling.components:
        try:
            return load_coupling(model.coupling, model.fmu)
        except FmuidError as error:
            if error.where != str(model.fmu):
                raise
            raise type(error)(error.what, where=f"[models.{model.setup}]", fix=error.fix) from None
    if model.fmu.suffix == SUFFIX:
        coupling = model.coupling or Coupling()
        return load_system(model.fmu, coupling.master, coupling.main)
    return load_fmu(model.fmu, model.interface)


def load_simulator(model: ModelSpec) -> Simulator:
    """Return the model of a setup, with its signal effects as parameters if it has any.

    Raises
    ------
    FmuError
        A file is missing or cannot be used, or an effect names no signal.
    """
    loaded = load_model(model)
    if not model.signal_effects:
        return loaded
    differentiated = frozenset(model.variable(name) for name in model.map if model.differentiates(name))
    return _with_signals(loaded, model.signal_effects, differentiated)


@functools.lru_cache(maxsize=_MAX_MODELS)  # always the same object within a process
def _with_signals(
    model: Fmu | CoupledModel, names: tuple[str, ...], differentiated: frozenset[str]
) -> SignalModel:
    return SignalModel(model, names, differentiated)


def load_system(path: str | Path, master: Master | None = None, main: str = "") -> CoupledModel:
    """Return the system of an SSP file; a process gets the same object until the file changes.

    Variables of the component `main` are named without a prefix.

    Raises
    ------
    FmuError
        The file is not a readable SSP file, uses an unsupported feature, or its components do not fit together.
    """
    file, master = Path(path).resolve(), master or Master()

    def make() -> CoupledModel:
        folder = extract(file)
        try:
            system = read_system(file, folder)
            model = CoupledModel(
                file,
                system.components,
                system.connections,
                ports=system.ports,
                master=master,
                starts=system.starts,
                experiment=system.experiment,
                main=main,
                reload=(load_system, (file, master, main)),
            )
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        weakref.finalize(model, _remove, folder, os.getpid())
        return model

    return _once((file, repr(master), main, _state(file)), make)


def couple(
    components: Mapping[str, str | Path],
    connections: Mapping[str, str | tuple[str, float, float]],
    master: Master | None = None,
) -> CoupledModel:
    """Return FMUs coupled by connections.

    Parameters
    ----------
    components
        FMU files by the names of the components.
    connections
        ``component.input`` -> ``component.output``, or (output, factor, offset): the input is then ``factor *
        output + offset``, with the output converted to the input's unit.
    master
        Step size, algorithm and handling of loops.

    Raises
    ------
    FmuError
        A file is missing, or the components do not fit together.
    UnitError
        Connected variables have incompatible units.
    """
    wires = {i: (o, Linear()) if isinstance(o, str) else (o[0], Linear(*o[1:])) for i, o in connections.items()}
    return load_coupling(Coupling(master or Master(), {n: Path(f) for n, f in components.items()}, wires))


def load_coupling(coupling: Coupling, path: str | Path = "system") -> CoupledModel:
    """Return FMUs coupled by a table of connections, the same object within a process; errors name `path`.

    Raises
    ------
    FmuError
        A file is missing, or the components do not fit together.
    """
    where = Path(path)
    files = {name: file.resolve() for name, file in coupling.components.items()}
    resolved = replace(coupling, components=files)

    def make() -> CoupledModel:
        components = {name: Fmu(file) for name, file in files.items()}
        plain = [
            Connection(_place(where, components, source), _place(where, components, target), linear)
            for target, (source, linear) in coupling.connections.items()
        ]
        check_connections(where, components, plain)
        connections = [_converting(where, components, k) for k in plain]
        return CoupledModel(
            where,
            components,
            connections,
            master=coupling.master,
            main=coupling.main,
            reload=(load_coupling, (resolved, where)),
        )

    return _once((where, repr(resolved), *map(_state, files.values())), make)


def _place(where: Path, components: dict[str, Fmu], name: str) -> Place:
    component, dot, variable = name.partition(".")
    if not dot:
        raise FmuError(
            f"'{name}' is not a variable of a component",
            where=where,
            fix=f"write it as component.variable; {suggestion(name, components)}",
        )
    return Place(component, variable)


def _converting(where: Path, components: dict[str, Fmu], k: Connection) -> Connection:
    units = [variable_at(where, components, place).unit for place in (k.source, k.target)]
    convert = unit_conversion(where, str(k.source), units[0], str(k.target), units[1])
    return Connection(k.source, k.target, convert.then(k.linear))


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
