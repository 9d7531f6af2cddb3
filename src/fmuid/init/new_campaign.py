"""A first campaign from recorded runs and an FMU: guessed, commented and ready to run."""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fmu_build.suggest import known_names, suggestion
from fmuid.campaigns.campaign_toml import FILE_NAME, load_campaign
from fmuid.core.campaign import Interface, ModelSource, Timing
from fmuid.core.errors import CampaignError, FmuidError, MeasurementsError, UnitError
from fmuid.core.experiments import Experiment, Measurements, Signal, widened
from fmuid.core.files import check_folder, path_from, write_atomically
from fmuid.core.formatting import once_each, shortened
from fmuid.core.toml_tables import SCHEMAS, toml_text
from fmuid.core.units import conversion, conversion_at
from fmuid.data.crosscheck_csv import Table
from fmuid.data.measurements import check_measurements, write_measurements
from fmuid.data.recordings.conversion import Run, experiment_from_table, read_run, with_repeats
from fmuid.data.recordings.resampling import TimeBase
from fmuid.data.table_layout import TableLayout
from fmuid.init.first_choice import FROM_ZERO, FirstChoice, Restarts, first_choice, restarts, solver_error
from fmuid.init.known_values import CERTAIN, ModelText, guessed_bounds, is_temperature
from fmuid.init.not_looked_for import NotLookedFor, not_looked_for
from fmuid.init.seen_run import seen_run
from fmuid.simulation.coupled.coupled_model import CoupledModel
from fmuid.simulation.coupled.loading import load_model, load_simulator
from fmuid.simulation.fmu import Fmu, load_fmu
from fmuid.simulation.runners import Runner, in_process
from fmuid.simulation.simulator import Variable

_TIMINGS = {
    "held": "inputs are held between their samples",
    "linear": "inputs are linear between their samples",
    "band-limited": "inputs are band-limited, as after an anti-aliasing filter",
    "held-read-after": "inputs are held between their samples, and outputs are read just after they act",
}
_NEAR, _FAR = 10.0, 300.0  # factors to the start value within which a parameter is searched
_FEW = 4  # runs for the fit: with fewer, too little is left to predict one of them from
_BEYOND = 0.5  # share of the range of an input in other runs by which a run may exceed it
_MAX_NAMES = 8  # fixed parameters named in one line


@dataclass(frozen=True, slots=True)
class NewCampaign:
    """The new campaign, one line for each guess, and what a diagnosis of it will not look for."""

    folder: Path
    guesses: tuple[str, ...]
    not_looked_for: tuple[NotLookedFor, ...] = ()


def new_campaign(
    logs: Mapping[str, Path | Any],
    fmu: Path,
    folder: Path,
    *,
    replacing: bool = False,
    source: ModelSource | None = None,
    signals: Collection[str] = (),
    base: TimeBase | None = None,
    units: Mapping[str, str] | None = None,
    sigmas: Mapping[str, float] | None = None,
    layout: TableLayout | None = None,
    progress: Callable[[float], None] | None = None,
    runner: Runner = in_process,
) -> NewCampaign:
    """Write a campaign, ready to run, from recorded runs and an FMU.

    Columns are matched with the FMU's inputs and outputs by name or, if unique, by unit. See
    `fmuid.init.first_choice` for the choice of free parameters and input interpolation. The last run is kept
    for validation, unless one of few others would then be the only one in its range of an input.

    Parameters
    ----------
    logs
        Runs by name, each a file or a data frame.
    fmu, folder
        The FMU, and the folder of the campaign.
    replacing
        Whether an existing campaign in the folder is replaced, once the new one is complete.
    source
        The FMU's Modelica source, which the campaign names instead of the FMU.
    signals
        Signals to use; all by default.
    base
        Common time base for signals with different time bases.
    units, sigmas
        Units (these win over the logs') and noise standard deviations by column.
    layout
        Names of columns, and the rate of logs without times.
    progress
        Called with the fraction done (0 to 1).
    runner
        Runner of the simulations; this process by default.

    Raises
    ------
    FmuidError
        A file cannot be read, no column matches the FMU, or the campaign already exists.
    """
    target = folder / FILE_NAME
    check_folder(folder)
    if target.exists() and not replacing:
        raise CampaignError("already exists", where=target, fix="choose another folder with --out")
    model = load_model(fmu)
    ports = {n: v for n, v in model.variables.items() if v.causality in ("input", "output")}
    notes: list[tuple[str, str]] = []
    runs: dict[str, Experiment] = {}
    mapping: dict[str, str] = {}
    for id, log in logs.items():
        file = log if isinstance(log, Path) else Path(id)
        run = read_run(log, signals, base, layout, name=id)
        run = replace(run, table=_with_units(run.table, units or {}))
        table = run.table
        matched = match_columns(table, ports)
        _require_output(matched, ports, fmu, file)
        runs[id] = _run(id, file, run, matched=matched, ports=ports, setup=fmu.stem, sigmas=sigmas or {})
        notes += [(file.name, note) for note in (*run.notes, *_lines(table, matched, ports))]
        mapping |= {c: v for c, v in matched.items() if c != v}
    known = dict.fromkeys(n for run in runs.values() for n in run.signals)
    for what, names in (("--unit", units or {}), ("--sigma", sigmas or {})):
        if unused := [name for name in names if name not in known]:
            fix = suggestion(unused[0], known)
            raise CampaignError(f"no signal '{unused[0]}' is used", where=what, fix=fix)
    guesses = once_each(notes)
    if tool := model.needed_tool:
        guesses.append(f"{fmu.name} needs {tool} to be installed (needsExecutionTool)")
    runs = with_repeats(runs)
    used = _for_identification(runs)
    interface: Interface | None = None
    other = _by_model_exchange(model)
    error = solver_error(model, other, used[0], mapping, runner) if other is not None else 0.0
    if other is not None and error:
        model, interface = other, "model exchange"
        guesses.append(
            f"model exchange: the solver inside {fmu.name} is off by {100 * error:.2g} % of an output's range"
        )
    seen_run(model, used[0], mapping, runner)  # a model that crashes does so under supervision
    cut, start_notes = restarts(model, used, mapping, runner)
    choice = first_choice(model, used, mapping, progress, runner, text=ModelText(source), cut=cut)
    if not choice.free:
        zero = ", ".join(v.name for v in choice.held.get(FROM_ZERO, ()))
        raise CampaignError(
            f"no parameter of {fmu.name} affects a measured output"
            + (f"; not tried, because they start at 0: {shortened(zero)}" if zero else ""),
            where=next(iter(logs)),
            fix="check inputs and outputs" + (", or give these parameters plausible start values" if zero else ""),
        )
    guesses += _choice_lines(choice, any(run.inputs for run in runs.values()))
    guesses += start_notes
    write_measurements(Measurements(runs), folder / "measurements.h5")
    write_atomically(
        target,
        _toml(folder, source or fmu, runs=runs, mapping=mapping, choice=choice, interface=interface, cut=cut),
    )
    unlooked = not_looked_for(load_campaign(folder), load_simulator, runner)
    return NewCampaign(folder, tuple(dict.fromkeys(guesses)), unlooked)


def match_columns(table: Table, ports: Mapping[str, Variable]) -> dict[str, str]:
    """Return column -> FMU variable for the columns that match a variable.

    Matches are tried in this order: the same name; the same name except for case and punctuation; the only
    unmatched variable of the same unit, if no other column is a candidate; the most similar name among unmatched
    variables of that unit.
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
        rivals = [
            c for c, unit in table.units.items() if c not in matched and left and _fits(unit, ports[left[0]].unit)
        ]
        near = difflib.get_close_matches(_fold(column), [_fold(n) for n in left], n=1, cutoff=0.5)
        if len(left) == len(rivals) == 1:
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


def _with_units(table: Table, units: Mapping[str, str]) -> Table:
    return replace(table, units=dict(table.units) | {n: u for n, u in units.items() if n in table.columns})


def _require_output(matched: Mapping[str, str], ports: Mapping[str, Variable], fmu: Path, file: Path) -> None:
    if not any(ports[v].causality == "output" for v in matched.values()):
        outputs = [f"{n} [{v.unit or '1'}]" for n, v in ports.items() if v.causality == "output"]
        if not outputs:
            raise CampaignError("the model has no outputs", where=fmu, fix="declare what the log shows as output")
        raise CampaignError(
            f"no column matches an output of {fmu.name} by name or unit",
            where=file,
            fix=f"choose columns (--columns '{outputs[0]}=COLUMN,...') or state their units (--unit);"
            f" {known_names(outputs)}",
        )


def _run(
    id: str,
    file: Path,
    run: Run,
    *,
    matched: Mapping[str, str],
    ports: Mapping[str, Variable],
    setup: str,
    sigmas: Mapping[str, float],
) -> Experiment:
    table, units = run.table, {}
    for column, variable in matched.items():
        units[column] = table.units.get(column) or ports[variable].unit or "1"
        conversion_at(units[column], ports[variable].unit, f"{file}: column '{column}'")
        if not np.isfinite(table.columns[column]).any():
            raise MeasurementsError(f"column '{column}' has no value", where=file, fix="leave it out, or fill it")
    made = experiment_from_table(
        Table(table.time, {c: table.columns[c] for c in matched}, {}),
        id=id,
        setup=setup,
        inputs=[c for c, v in matched.items() if ports[v].causality == "input"],
        units=units,
        sigmas={n: s for n, s in sigmas.items() if n in matched},
        resampled=run.resampled,
    )
    made = replace(made, unused=_unused(table, matched))
    check_measurements(Measurements({made.id: made}), file)
    return made


def _unused(table: Table, matched: Mapping[str, str]) -> dict[str, Signal]:
    """Return the complete columns that match nothing: a coefficient of the model may depend on one."""
    return {
        name: Signal(name, values, table.units.get(name) or "1", "input")
        for name, values in table.columns.items()
        if name not in matched and np.isfinite(values).all()
    }


def _by_model_exchange(model: Fmu | CoupledModel) -> Fmu | None:
    """Return the same FMU on fmuid's solver, if it can also be simulated that way."""
    if isinstance(model, CoupledModel) or model.interface == "model exchange":
        return None
    try:
        return load_fmu(model.path, "model exchange")
    except FmuidError:
        return None


def _for_identification(runs: Mapping[str, Experiment]) -> list[Experiment]:
    """Return all runs but the last one, without repeats.

    All are returned if fewer than three are recorded: a diagnosis leaves each out in turn and needs another to
    learn from. So they are if few would be left, and one of these would be alone, such as in its direction.
    """
    firsts = [run for run in runs.values() if not run.repeats_another]
    left = firsts[:-1]
    return firsts if len(left) < 2 or (len(left) < _FEW and _alone(left) - _alone(firsts)) else left


def _alone(runs: Sequence[Experiment]) -> set[str]:
    """Return the runs with an input that the others are far from."""
    alone = set()
    for run in runs:
        for name, signal in run.inputs.items():
            others = [u.inputs[name].values for u in runs if u is not run and name in u.inputs]
            low, high = widened(others, _BEYOND) if others else (-np.inf, np.inf)
            if signal.values.min() < low or signal.values.max() > high:
                alone.add(run.id)
    return alone


def _choice_lines(choice: FirstChoice, driven: bool) -> list[str]:
    timing = choice.timing
    lines = [_TIMINGS[timing.timing]] if driven else []
    if timing.read_after:
        lines[0] += f", and outputs are read {timing.read_after:g} s after they act"
    if not timing.plain:
        lines[0] += f"; held inputs explain the runs {timing.worse:.2g} times worse"
    if timing.signals:
        lines.append(f"read before the inputs act: {', '.join(timing.signals)}")
    lines += map(str, choice.lost)
    lines.append(f"free parameters: {', '.join(v.name for v in choice.free)}")
    if choice.wide:
        far = ", ".join(choice.wide)
        lines.append(f"wide bounds, a factor of {_FAR:g}: {far} (runs fit best far from the start value)")
    for reason, variables in choice.held.items():
        names = _collapsed(variables)
        more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
        lines.append(f"fixed: {', '.join(names[:_MAX_NAMES])}{more} ({reason})")
    return lines


def _collapsed(variables: Sequence[Variable]) -> list[str]:
    """Return names, those of elements of one array as one entry with their number."""
    arrays = Counter(v.name.partition("[")[0] for v in variables if "[" in v.name)
    names = {v.name: v.name.partition("[")[0] for v in variables}
    shown = (f"{n} ({arrays[n]} entries)" if n in arrays and n != name else name for name, n in names.items())
    return list(dict.fromkeys(shown))


def _lines(table: Table, matched: Mapping[str, str], ports: Mapping[str, Variable]) -> list[str]:
    lines = []
    for column in table.columns:
        if column not in matched:
            continue
        variable = ports[matched[column]]
        unit = table.units.get(column)
        stated = f"in {unit}" if unit else f"taken to be in {variable.unit or '1'}, as the FMU's"
        lines.append(f"'{column}' is {variable.causality} '{variable.name}', {stated}")
    if unused := [column for column in table.columns if column not in matched]:
        shown = f"{', '.join(unused[:_MAX_NAMES])}" + (" and others" if len(unused) > _MAX_NAMES else "")
        what = "no input or output of the model matches; a diagnosis tries whether a coefficient depends on them"
        lines.append(f"columns that nothing uses: {shown} ({what})")
    return lines


def _toml(
    folder: Path,
    model: Path | ModelSource,
    *,
    runs: Mapping[str, Experiment],
    mapping: Mapping[str, str],
    choice: FirstChoice,
    interface: Interface | None,
    cut: Restarts | None,
) -> str:
    setup = next(iter(runs.values())).setup
    identification = [run.id for run in _for_identification(runs)]
    validation = [r.id for r in runs.values() if not r.repeats_another and r.id not in identification]
    file = model.file if isinstance(model, ModelSource) else model
    path = path_from(folder, file)
    named = [f"fmu = {toml_text(path)}"]
    if isinstance(model, ModelSource):
        named = [f"source = {toml_text(path)}", f"class = {toml_text(model.class_name)}"]
        roots = [toml_text(path_from(folder, root)) for root in model.roots]
        named += [f"roots = [{', '.join(roots)}] # folders of the libraries that it uses"] if roots else []
        versions = [f"{toml_text(name)} = {toml_text(version)}" for name, version in model.libraries]
        named += [f"libraries = {{ {', '.join(versions)} }} # their versions"] if versions else []
    renamed = ", ".join(f"{toml_text(k)} = {toml_text(v)}" for k, v in mapping.items())
    lines = [
        f"#:schema {SCHEMAS}/campaign.schema.json",
        "# A campaign: which model, which parameters, which runs. See docs/formats.md.",
        "[campaign]",
        f"name = {toml_text(folder.resolve().name)}",
        f"title = {toml_text(model.class_name if isinstance(model, ModelSource) else setup)}",
        'measurements = "measurements.h5"',
        "",
        "# The model of each setup. `map` names the FMU's variable for a signal, setting or parameter.",
        f"[models.{toml_text(setup)}]",
        *named,
        f"map = {{ {renamed} }}" if renamed else "map = {}",
        "# Inputs are held until the next sample, and outputs are read before an input acts (held) or after it",
        "# (held-read-after); or linear between samples; or band-limited (as after an anti-aliasing filter); or",
        "# held since the preceding one (preceding).",
        f"timing = {toml_text(choice.timing.timing)}",
        *(
            [f"read_after = {choice.timing.read_after:g} # s, from inputs to the reading of outputs"]
            if choice.timing.read_after
            else []
        ),
        *(
            ["# Simulated with fmuid's solver, not the FMU's.", f"interface = {toml_text(interface)}"]
            if interface
            else []
        ),
        "",
        *_signal_lines(mapping, choice.timing.signals),
        "# Parameters: start and bounds in the FMU's unit. Narrow the bounds to what you know.",
    ]
    for variable in choice.free:
        within = _FAR if variable.name in choice.wide else _NEAR
        lines += _parameter_lines(variable, choice.depends.get(variable.name, ()), within)
    for reason in CERTAIN:
        for variable in choice.held.get(reason, ()):
            lines += [*_parameter_lines(variable)[:-1], f"free = false # {reason}", "known = true", ""]
    doubtful = {reason: variables for reason, variables in choice.held.items() if reason not in CERTAIN}
    if doubtful:
        lines += ["# Fixed at the FMU's start value; uncomment to identify it as well.", ""]
    for reason, variables in doubtful.items():
        lines += [f"# Fixed: {reason}.", ""]
        for variable in variables:
            lines += [f"# {line}" if line else "" for line in _parameter_lines(variable)]
    lines += [
        "# Runs for the fit, and runs kept for validation. Repeats are included.",
        "[roles]",
        f"identification = [{', '.join(map(toml_text, identification))}]",
        f"validation = [{', '.join(map(toml_text, validation))}]",
        "",
        "# One stage: every free parameter, all runs for identification, least squares on every output.",
        "[stages.all]",
        "budget = { evaluations = 500 }",
        *(() if cut is None else (f"# The states at the start are estimated: {cut.why}.", cut.line)),
        "",
    ]
    return "\n".join(lines) + "\n"


def _signal_lines(mapping: Mapping[str, str], timings: Mapping[str, Timing]) -> list[str]:
    lines: list[str] = []
    for variable, timing in timings.items():
        name = next((n for n, v in mapping.items() if v == variable), variable)
        lines += [f"[signals.{toml_text(name)}]", f"timing = {toml_text(timing)}", ""]
    return lines


def _parameter_lines(variable: Variable, depends: Sequence[str] = (), within: float = _NEAR) -> list[str]:
    low, high = guessed_bounds(variable, within)
    lines = [f"[parameters.{toml_text(variable.name)}]"]
    if variable.description:
        lines[0] += f" # {' '.join(variable.description.split())}"
    lines += [f"start = {variable.start or 0.0!r}"]
    if low < high:
        lines += [f"lower = {low!r}", f"upper = {high!r}"]
    if variable.unit:
        lines.append(f"unit = {toml_text(variable.unit)}")
    if low > 0 and not is_temperature(variable):
        lines.append('scale = "log"')
    if depends:
        lines.append(
            f"depends_on = [{', '.join(map(toml_text, depends))}] # fixed values that its estimate rests on"
        )
    return [*lines, ""]


def parameter_text(variable: Variable) -> str:
    """Return the table of a free parameter as `new_campaign` writes it: the model's value, and guessed bounds."""
    return "\n".join(_parameter_lines(variable))
