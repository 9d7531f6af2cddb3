"""A first campaign from recorded runs and an FMU: guessed, written with comments, ready to run."""

from __future__ import annotations

import difflib
import json
import os
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fmuid.campaign import Experiment, FloatArray, Measurements
from fmuid.campaign_toml import FILE_NAME, load_campaign
from fmuid.crosscheck_csv import Table
from fmuid.errors import CampaignError, FmuidError, UnitError
from fmuid.files import write_atomically
from fmuid.importing import Run, experiment_from_table, read_run, with_repeats
from fmuid.measurements import write_measurements
from fmuid.resampling import TimeBase
from fmuid.runners import Runner, in_process, simulated
from fmuid.simulation import Simulator, Task, Variable
from fmuid.suggest import known_names
from fmuid.units import conversion

_MAX_CANDIDATES = 60  # parameters whose effect is simulated
_MAX_FREE = 6
_STEP = 0.01  # relative change of a parameter to see its effect
_LEAST_NEW = 1e-2  # of an effect, not explained by the parameters chosen before


@dataclass(frozen=True, slots=True)
class NewCampaign:
    """What was written, and one line for each guess behind it."""

    folder: Path
    guesses: tuple[str, ...]


def new_campaign(
    files: Sequence[Path],
    fmu: Path,
    folder: Path,
    *,
    signals: Collection[str] = (),
    base: TimeBase | None = None,
    progress: Callable[[float], None] | None = None,
    runner: Runner = in_process,
) -> NewCampaign:
    """Write a campaign that runs from recorded runs (a file each) and an FMU.

    Columns become signals by the name or, where that is unique, the unit of the FMU's inputs and outputs.
    Free are the parameters with the most independent effects on the outputs (QR with column pivoting of the
    relative sensitivities at the start values), at most six. The last run is kept for validation.

    Parameters
    ----------
    files, fmu, folder
        What there is, and where the campaign goes.
    signals
        Of the files, the signals to use; all by default.
    base
        What signals with different time bases are brought onto.
    progress
        Called with the share of the work that is behind.
    runner
        What simulates; in this process by default.

    Raises
    ------
    FmuidError
        A file cannot be read, nothing in it fits the FMU, or there is a campaign already.
    """
    from fmuid.coupled.loading import load_model

    target = folder / FILE_NAME
    if target.exists():
        raise CampaignError("is there already", where=target, fix="name another folder with --out")
    model = load_model(fmu)
    ports = {n: v for n, v in model.variables.items() if v.causality in ("input", "output")}
    guesses: list[str] = []
    runs: dict[str, Experiment] = {}
    mapping: dict[str, str] = {}
    for file in files:
        if file.stem in runs:
            raise CampaignError(f"two runs are called '{file.stem}'", where=file, fix="rename one file")
        run = read_run(file, signals, base)
        table = run.table
        matched = match_columns(table, ports)
        if not any(ports[v].causality == "output" for v in matched.values()):
            raise CampaignError(
                f"no column is an output of {fmu.name}",
                where=file,
                fix=f"name the columns after its variables; {known_names(ports)}",
            )
        runs[file.stem] = _run(run, matched, ports, file.stem, fmu.stem)
        guesses += [f"{file.name}: {note}" for note in run.notes]
        guesses += _lines(table, matched, ports, file.name)
        mapping |= {c: v for c, v in matched.items() if c != v}
    runs = with_repeats(runs)
    free, others = _choose_parameters(model, next(iter(runs.values())), mapping, progress, runner)
    guesses.append(f"free parameters: {', '.join(v.name for v in free) or 'none found'}")
    if not free:
        raise CampaignError(
            f"no parameter of {fmu.name} moves a measured output",
            where=files[0],
            fix="check inputs and outputs",
        )
    write_measurements(Measurements(runs), folder / "measurements.h5")
    write_atomically(target, _toml(folder, fmu, runs, mapping, free, others))
    load_campaign(folder)
    return NewCampaign(folder, tuple(dict.fromkeys(guesses)))


def match_columns(table: Table, ports: Mapping[str, Variable]) -> dict[str, str]:
    """Return column -> FMU variable for the columns that one stands for.

    In this order: the same name; the same but for case and punctuation; the one unclaimed variable of the
    same unit; the most similar name among the unclaimed variables of the same unit.
    """
    matched: dict[str, str] = {}

    def claim(rule: Mapping[str, str]) -> None:
        for column, variable in rule.items():
            if column not in matched and variable not in matched.values():
                matched[column] = variable

    claim({c: c for c in table.columns if c in ports})
    folded = {_fold(n): n for n in ports}
    claim({c: folded[_fold(c)] for c in table.columns if _fold(c) in folded})
    for column in table.columns:
        if column in matched or column not in table.units:
            continue
        left = [n for n, v in ports.items() if n not in matched.values() and _fits(table.units[column], v.unit)]
        near = difflib.get_close_matches(_fold(column), [_fold(n) for n in left], n=1, cutoff=0.5)
        if len(left) == 1:
            matched[column] = left[0]
        elif near:
            matched[column] = folded[near[0]]
    return matched


def _fold(name: str) -> str:
    return re.sub(r"[\W_]", "", name).casefold()


def _fits(unit: str, other: str | None) -> bool:
    try:
        conversion(unit, other)
    except UnitError:
        return False
    return other is not None


def _run(run: Run, matched: Mapping[str, str], ports: Mapping[str, Variable], id: str, setup: str) -> Experiment:
    table = run.table
    units = {c: table.units.get(c) or ports[v].unit or "1" for c, v in matched.items()}
    kept = Table(table.time, {c: table.columns[c] for c in matched}, {})
    inputs = [c for c, v in matched.items() if ports[v].causality == "input"]
    return experiment_from_table(kept, id=id, setup=setup, inputs=inputs, units=units, resampled=run.resampled)


def _lines(table: Table, matched: Mapping[str, str], ports: Mapping[str, Variable], file: str) -> list[str]:
    lines = []
    for column in table.columns:
        if column not in matched:
            lines.append(f"{file}: column '{column}' is not used, no input or output of the FMU fits")
            continue
        variable = ports[matched[column]]
        unit = table.units.get(column)
        stated = f"in {unit}" if unit else f"taken to be in {variable.unit or '1'}, as the FMU's"
        lines.append(f"{file}: '{column}' is {variable.causality} '{variable.name}', {stated}")
    return lines


def _choose_parameters(
    model: Simulator,
    run: Experiment,
    mapping: Mapping[str, str],
    progress: Callable[[float], None] | None,
    runner: Runner,
) -> tuple[list[Variable], list[Variable]]:
    """Return the parameters to free, most influential first, and the others."""
    candidates = [
        v
        for v in model.variables.values()
        if v.causality == "parameter" and v.type in ("Real", "Float64") and v.start
    ]
    variables = model.variables
    inputs = {}
    for name, signal in run.inputs.items():
        port = variables[mapping.get(name, name)]
        inputs[port.name] = conversion(signal.unit, port.unit)(signal.values)
    task = Task(run.time, inputs, tuple(mapping.get(n, n) for n in run.outputs))
    nominal = simulated(runner, model, task, {})
    scale = np.maximum(np.ptp(nominal, axis=1, keepdims=True), 1e-12)
    effects: dict[str, FloatArray] = {}
    tried = candidates[:_MAX_CANDIDATES]
    for k, candidate in enumerate(tried):
        if progress is not None:
            progress(k / len(tried))
        start = candidate.start or 0.0
        try:
            moved = simulated(runner, model, task, {candidate.name: start * (1 + _STEP)})
        except FmuidError:
            continue  # a structural or otherwise delicate parameter: not one to start with
        effects[candidate.name] = ((moved - nominal) / scale / _STEP).ravel()
    names = independent_columns(effects)
    free = [variables[n] for n in names[:_MAX_FREE]]
    return free, [v for v in candidates if v not in free]


def independent_columns(columns: Mapping[str, FloatArray]) -> list[str]:
    """Return the names of the columns that are neither small nor explained by larger ones, by pivoted QR."""
    left = {n: c.copy() for n, c in columns.items()}
    chosen: list[str] = []
    while left:
        name = max(left, key=lambda n: float(np.linalg.norm(left[n])))
        remaining = float(np.linalg.norm(left[name]))
        largest = max(float(np.linalg.norm(c)) for c in columns.values())
        if remaining <= 1e-4 * largest or remaining == 0.0:
            break
        direction = left.pop(name) / remaining
        if remaining > _LEAST_NEW * float(np.linalg.norm(columns[name])):
            chosen.append(name)
            left = {n: c - (direction @ c) * direction for n, c in left.items()}
    return chosen


def _toml(
    folder: Path,
    fmu: Path,
    runs: Mapping[str, Experiment],
    mapping: Mapping[str, str],
    free: Iterable[Variable],
    others: Iterable[Variable],
) -> str:
    setup = fmu.stem
    firsts = [r.id for r in runs.values() if r.repeat_of is None]
    identification, validation = (firsts[:-1], firsts[-1:]) if len(firsts) > 1 else (firsts, [])
    path = Path(os.path.relpath(fmu.resolve(), folder.resolve())).as_posix()
    renamed = ", ".join(f"{_text(k)} = {_text(v)}" for k, v in mapping.items())
    lines = [
        "# A campaign: which model, which parameters, which runs. See docs/formats.md.",
        "[campaign]",
        f"name = {_text(folder.resolve().name)}",
        'measurements = "measurements.h5"',
        "",
        "# The model of each setup. `map` names the FMU's variable for a signal, setting or parameter.",
        f"[models.{_text(setup)}]",
        f"fmu = {_text(path)}",
        f"map = {{ {renamed} }}" if renamed else "map = {}",
        'interpolation = "hold" # or "linear": the inputs between samples',
        "",
        "# Parameters: start and bounds in the FMU's unit. Narrow the bounds to what you know.",
    ]
    for variable in free:
        lines += _parameter_lines(variable)
    others = list(others)
    if others:
        lines += ["# Held at the FMU's start value; take the # away to identify it too.", ""]
    for variable in others:
        lines += [f"# {line}" if line else "" for line in _parameter_lines(variable)]
    lines += [
        "# Which runs the fit sees, and which only judge it. Repeats come along.",
        "[roles]",
        f"identification = [{', '.join(map(_text, identification))}]",
        f"validation = [{', '.join(map(_text, validation))}]",
        "",
        "# One stage: every free parameter, all runs for identification, least squares on every output.",
        "[stages.all]",
        "budget = { evaluations = 500 }",
    ]
    return "\n".join(lines) + "\n"


def _parameter_lines(variable: Variable) -> list[str]:
    start = variable.start or 0.0
    low, high = (start / 10, start * 10) if start > 0 else (start * 10, -start * 10)
    low = max(low, variable.min if variable.min is not None else low)
    high = min(high, variable.max if variable.max is not None else high)
    lines = [f"[parameters.{_text(variable.name)}]"]
    if variable.description:
        lines[0] += f" # {' '.join(variable.description.split())}"
    lines += [f"start = {start!r}", f"lower = {low!r}", f"upper = {high!r}"]
    if variable.unit:
        lines.append(f"unit = {_text(variable.unit)}")
    if low > 0:
        lines.append('scale = "log"')
    return [*lines, ""]


def _text(value: str) -> str:
    """Return `value` as a TOML basic string."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
