"""Reading, checking and writing measurement files (`measurements.h5`, version 1)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from fmu_build.suggest import did_you_mean
from fmuid.core.errors import MeasurementsError
from fmuid.core.experiments import NEAR_TIMES, SAME_TIMES, Causality, Experiment, Measurements, Signal
from fmuid.core.immutable import FloatArray
from fmuid.data import hdf5
from fmuid.data.isolated_reader import read_isolated

FORMAT = "fmuid-campaign"
VERSION = 1
UNIT_SUFFIX = ".unit"
_ROOT_TEXTS = ("title", "rig", "source", "licence", "history")
_CAUSALITIES = ("input", "output")
_Error = MeasurementsError


def read_measurements(path: str | Path, *, fix_missing: str | None = None) -> Measurements:
    """Read and check a measurement file.

    Parameters
    ----------
    path
        The HDF5 file.
    fix_missing
        Advice for the error message if the file does not exist.

    Raises
    ------
    MeasurementsError
        The file is missing or damaged, or violates the format; the message names file, experiment, signal and
        sample.

    Examples
    --------
    >>> measurements = fmuid.read_measurements("tank/measurements.h5")
    >>> measurements["log"].signals["T"].unit
    'K'
    """
    path = Path(path)
    if fix_missing is not None and not path.exists():
        raise _Error("no such file", where=path, fix=fix_missing)
    measurements = read_isolated(_read, path)
    for experiment in measurements:
        for values in (experiment.time, *(s.values for s in experiment.signals.values())):
            values.flags.writeable = False  # not preserved by pickle
    return measurements


def _read(path: Path) -> Measurements:
    with hdf5.reading(path) as file:
        _check_header(file, path)
        group = hdf5.member(file, "experiments", "group", _Error, str(path))
        experiments = {name: _read_experiment(group, name, path) for name in group.keys()}  # noqa: SIM118
        texts = {name: hdf5.text(file, name, _Error, str(path), default="") for name in _ROOT_TEXTS}
    measurements = Measurements(experiments, **texts)
    check_measurements(measurements, path)
    return measurements


def write_measurements(measurements: Measurements, path: str | Path) -> None:
    """Check `measurements` and write them to `path` atomically.

    Parameters
    ----------
    measurements
        The measurements to write.
    path
        The HDF5 file; its folder is made if it is missing.

    Raises
    ------
    MeasurementsError
        The measurements violate the format, so no reader would accept the file.
    """
    path = Path(path)
    check_measurements(measurements, path)

    def fill(file: Any) -> None:
        file.attrs["format"] = FORMAT
        file.attrs["version"] = VERSION
        for name in _ROOT_TEXTS:
            if getattr(measurements, name):
                file.attrs[name] = getattr(measurements, name)
        experiments = file.create_group("experiments", track_order=True)
        for experiment in measurements:
            _write_experiment(experiments.create_group(experiment.id, track_order=True), experiment)

    hdf5.write_file(path, fill)


def check_measurements(measurements: Measurements, path: str | Path) -> None:
    """Check every rule of the format about values.

    Raises
    ------
    MeasurementsError
        The measurements violate a rule; the message names `path`.
    """
    if not measurements.experiments:
        raise _Error("has no experiments", where=path, fix="write at least one under /experiments")
    for experiment_id, experiment in measurements.experiments.items():
        where = f"{path}: experiment '{experiment_id}'"
        if experiment.id != experiment_id or not _is_name(experiment_id):
            raise _Error("is not a usable id", where=where, fix="use printable characters without '/'")
        _check_experiment(experiment, where)
    for experiment in measurements:
        if experiment.repeats_another:
            _check_repeat(experiment, measurements, f"{path}: experiment '{experiment.id}'")


def _check_experiment(experiment: Experiment, where: str) -> None:
    if not _is_name(experiment.setup):
        raise _Error("has no setup", where=where, fix="write the attribute 'setup'")
    check_time(experiment.time, f"{where}, time")
    if not experiment.signals:
        raise _Error("has no signals", where=where, fix="write at least one under 'signals'")
    for name, signal in experiment.signals.items():
        if not _is_name(name) or signal.name != name:
            raise _Error("is not a usable signal name", where=f"{where}, signal '{name}'", fix="rename it")
        check_signal(signal, experiment.time.size, f"{where}, signal '{name}'")
    for name, signal in experiment.unused.items():
        check_signal(signal, experiment.time.size, f"{where}, unused '{name}'")
    for name, value in experiment.settings.items():
        if not np.isfinite(value):
            raise _Error(f"setting '{name}' is {value}", where=where, fix="write a finite number")


def check_time(time: FloatArray, where: str) -> None:
    """Raise MeasurementsError unless `time` has shape (N,), N >= 2, and is finite and strictly increasing."""
    if time.ndim != 1 or time.size < 2:
        raise _Error(f"has shape {time.shape}", where=where, fix="a run has at least 2 samples, shape (N,)")
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise _Error(
            f"sample {bad[0]} is {time[bad[0]]}", where=where, fix="every time must be a finite number, in s"
        )
    bad = np.flatnonzero(np.diff(time) <= 0)
    if bad.size:
        k = int(bad[0]) + 1
        raise _Error(
            f"sample {k} ({time[k]:.9g} s) is not after sample {k - 1} ({time[k - 1]:.9g} s)",
            where=where,
            fix="sort the samples by time and drop duplicates",
        )


def check_signal(signal: Signal, n_samples: int, where: str) -> None:
    """Raise MeasurementsError unless the signal is valid for a time axis of `n_samples`."""
    values = signal.values
    if signal.causality not in _CAUSALITIES:
        hint = did_you_mean(str(signal.causality), _CAUSALITIES)
        raise _Error(f"causality is '{signal.causality}'", where=where, fix=hint or "write 'input' or 'output'")
    if values.shape != (n_samples,):
        raise _Error(
            f"has shape {values.shape} but time has {n_samples} samples",
            where=where,
            fix="write one value for each time",
        )
    bad = np.flatnonzero(np.isinf(values))
    if bad.size:
        raise _Error(f"sample {bad[0]} is infinite", where=where, fix="write NaN where an output is missing")
    bad = np.flatnonzero(np.isnan(values))
    if signal.causality == "input" and bad.size:
        raise _Error(
            f"sample {bad[0]} of an input is NaN ({bad.size} in total)",
            where=where,
            fix="an input needs every sample: cut the run or fill the gap",
        )
    if not signal.unit.isprintable():
        raise _Error("unit has unprintable characters", where=where, fix="write it as plain text")
    if signal.sigma is not None and not (np.isfinite(signal.sigma) and signal.sigma > 0):
        raise _Error(f"sigma is {signal.sigma:g}", where=where, fix="write a positive number or leave it out")


def _check_repeat(experiment: Experiment, measurements: Measurements, where: str) -> None:
    attribute = "repeat_of" if experiment.repeat_of is not None else "repeat_of_reference"
    origin_id = experiment.repeat_of or experiment.repeat_of_reference or ""
    if experiment.repeat_of is not None and experiment.repeat_of_reference is not None:
        raise _Error("has repeat_of and repeat_of_reference", where=where, fix="remove one of them")
    origin = measurements.experiments.get(origin_id)
    if origin is None:
        hint = did_you_mean(origin_id, measurements.experiments)
        raise _Error(
            f"repeats '{origin_id}', which is not in the file", where=where, fix=hint or f"correct {attribute}"
        )
    if origin.repeats_another:
        raise _Error(
            f"repeats '{origin_id}', which is a repeat itself",
            where=where,
            fix=f"name the first run in {attribute}",
        )
    different = _first_difference(experiment, origin, inputs=experiment.repeat_of is not None)
    if different:
        raise _Error(
            f"repeats '{origin_id}' but its {different}",
            where=where,
            fix=f"a repeat has the same inputs; if this is a different experiment, remove {attribute}",
        )


def _first_difference(experiment: Experiment, origin: Experiment, *, inputs: bool) -> str | None:
    if experiment.setup != origin.setup:
        return f"setup is '{experiment.setup}', not '{origin.setup}'"
    if experiment.time.size != origin.time.size:
        return f"length is {experiment.time.size}, not {origin.time.size}"
    if not experiment.sampled_like(origin, within=SAME_TIMES if inputs else NEAR_TIMES):
        return "time axis differs"
    if dict(experiment.settings) != dict(origin.settings):
        return "settings differ"
    if experiment.inputs.keys() != origin.inputs.keys():
        return "inputs have different names"
    for name, signal in experiment.inputs.items():
        other = origin.inputs[name]
        bad = np.flatnonzero(inputs & ~np.isclose(signal.values, other.values, rtol=1e-9, atol=0))
        if bad.size or signal.unit != other.unit:
            return f"input '{name}' differs" + (f" at sample {bad[0]}" if bad.size else " in unit")
    return None


def _check_header(file: Any, path: Path) -> None:
    if hdf5.text(file, "format", _Error, str(path), default="") != FORMAT:
        raise _Error(
            "is HDF5 but not a measurement file",
            where=path,
            fix=f"the root attribute 'format' must be '{FORMAT}'",
        )
    version = hdf5.number(file, "version", _Error, str(path))
    if version != VERSION:
        stated = "no version" if version is None else f"version {version:g}"
        raise _Error(f"has {stated}", where=path, fix=f"this fmuid reads version {VERSION}")


def _read_experiment(experiments: Any, experiment_id: str, path: Path) -> Experiment:
    where = f"{path}: experiment '{experiment_id}'"
    group = hdf5.member(experiments, experiment_id, "group", _Error, str(path))
    time = hdf5.samples(hdf5.member(group, "time", "dataset", _Error, where), _Error, f"{where}, time")
    signals = hdf5.member(group, "signals", "group", _Error, where)
    settings, units = _read_settings(group, where)
    return Experiment(
        id=experiment_id,
        setup=hdf5.text(group, "setup", _Error, where),
        time=time,
        signals={name: _read_signal(signals, name, where) for name in signals.keys()},  # noqa: SIM118
        settings=settings,
        setting_units=units,
        repeat_of=hdf5.text(group, "repeat_of", _Error, where, default="") or None,
        repeat_of_reference=hdf5.text(group, "repeat_of_reference", _Error, where, default="") or None,
        machine=hdf5.text(group, "machine", _Error, where, default=""),
        description=hdf5.text(group, "description", _Error, where, default=""),
        unused={name: _read_signal(group["unused"], name, where) for name in group.get("unused", ())},
    )


def _read_signal(signals: Any, name: str, where: str) -> Signal:
    dataset = hdf5.member(signals, name, "dataset", _Error, where)
    where = f"{where}, signal '{name}'"
    causality = hdf5.text(dataset, "causality", _Error, where)
    return Signal(
        name=name,
        values=hdf5.samples(dataset, _Error, where),
        unit=hdf5.text(dataset, "unit", _Error, where),
        causality=cast(Causality, causality),  # check_signal refuses any other
        sigma=hdf5.number(dataset, "sigma", _Error, where),
        resampled=hdf5.text(dataset, "resampled", _Error, where, default=""),
    )


def _read_settings(group: Any, where: str) -> tuple[Mapping[str, float], Mapping[str, str]]:
    if "settings" not in group.keys():  # noqa: SIM118
        return {}, {}
    holder = hdf5.member(group, "settings", "group", _Error, where)
    where = f"{where}, settings"
    values: dict[str, float] = {}
    units: dict[str, str] = {}
    for name in holder.attrs:
        if name.endswith(UNIT_SUFFIX):
            of = name.removesuffix(UNIT_SUFFIX)
            if of not in holder.attrs:
                raise _Error(
                    f"'{name}' is the unit of a setting that is missing", where=where, fix=f"write '{of}'"
                )
            units[of] = hdf5.text(holder, name, _Error, where)
        else:
            values[name] = cast(float, hdf5.number(holder, name, _Error, where))  # it exists
    return values, units


def _write_experiment(group: Any, experiment: Experiment) -> None:
    group.attrs["setup"] = experiment.setup
    for name in ("machine", "repeat_of", "repeat_of_reference", "description"):
        if getattr(experiment, name):
            group.attrs[name] = getattr(experiment, name)
    if experiment.settings:
        settings = group.create_group("settings", track_order=True)
        for name, value in experiment.settings.items():
            settings.attrs[name] = float(value)
            if name in experiment.setting_units:
                settings.attrs[name + UNIT_SUFFIX] = experiment.setting_units[name]
    packing: dict[str, Any] = {"compression": "gzip", "shuffle": True} if experiment.time.size > 256 else {}
    group.create_dataset("time", data=experiment.time, **packing)
    for holder, members in (("signals", experiment.signals), ("unused", experiment.unused)):
        if members:
            _write_signals(group.create_group(holder, track_order=True), members, packing)


def _write_signals(signals: Any, members: Mapping[str, Signal], packing: Mapping[str, Any]) -> None:
    for name, signal in members.items():
        dataset = signals.create_dataset(name, data=signal.values, **packing)
        dataset.attrs["unit"] = signal.unit
        dataset.attrs["causality"] = signal.causality
        if signal.sigma is not None:
            dataset.attrs["sigma"] = float(signal.sigma)
        if signal.resampled:
            dataset.attrs["resampled"] = signal.resampled


def _is_name(name: str) -> bool:
    return bool(name.strip()) and name.isprintable() and "/" not in name and name not in (".", "..")
