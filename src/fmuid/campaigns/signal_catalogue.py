"""A first catalogue of effects for `fmuid diagnose`: what may go wrong between any FMU and its signals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from fmuid.core.experiments import Experiment
from fmuid.core.toml_tables import toml_text
from fmuid.core.units import conversion
from fmuid.simulation.simulator import Variable

FILE_NAME = "effects.toml"
_HEAD = """\
# What the model may lack, for `fmuid diagnose`: effects between the FMU and its signals, which change no FMU.
# Sizes are guesses from ranges and sample times; correct them by what you know. Inputs are named as in the FMU,
# outputs as in the measurements; all is in the FMU's units. Effects inside the model: docs/tutorials/effect.md.
format = "fmuid-effects"
version = 1
"""
_WORDS = {
    ("input", "gain"): ("'{}' acts in a wrong scale", "Calibration of the actuator"),
    ("input", "offset"): ("'{}' acts with a constant added", "Zero of the actuator"),
    ("input", "lag"): ("'{}' acts with a first-order lag", "Bandwidth of the actuator"),
    ("input", "delay"): (
        "'{}' acts late",
        "Communication and sampling; about half a sample: `interpolation` in campaign.toml",
    ),
    ("output", "gain"): ("'{}' is read in a wrong scale", "Calibration of the sensor"),
    ("output", "offset"): ("'{}' is read with a constant added", "Zero of the sensor"),
    ("output", "lag"): ("'{}' is read with a first-order lag", "Filter of the sensor"),
}


def signal_catalogue(
    runs: Iterable[Experiment],
    mapping: Mapping[str, str],
    model: Mapping[str, Variable],
    ids: str = "{signal}_{law}",
) -> str:
    """Return the text of a catalogue with the effects of every signal that is not zero throughout.

    Inputs: gain, offset, first-order lag, dead time; outputs: gain, offset, lag. Trials are 2 and 10 % of scale,
    1 and 5 % of the range, one and five sample times.

    Parameters
    ----------
    runs
        The recorded runs; signals in any unit.
    mapping
        Signal -> variable of the FMU, where the names differ.
    model
        The FMU's variables.
    ids
        How effects are called.

    Raises
    ------
    UnitError
        A signal's unit cannot be converted to the variable's.
    """
    runs = list(runs)
    step = min(float(np.median(np.diff(run.time))) for run in runs)
    ports, regimes, effects = [], [], []
    for name, causality in dict.fromkeys((n, s.causality) for run in runs for n, s in run.signals.items()):
        variable = model[mapping.get(name, name)]
        signals = [run.signals[name] for run in runs if name in run.signals]
        values = np.concatenate([conversion(s.unit, variable.unit)(s.values) for s in signals])
        size = float(np.nanmax(values) - np.nanmin(values)) or float(np.nanmax(np.abs(values)))
        if size == 0.0:
            continue
        own, unit = (variable.name if causality == "input" else name), variable.unit or "1"
        ports += [
            f"[ports.{toml_text(own)}]",
            f"description = {toml_text(variable.description or f'{causality} {own}')}",
        ]
        if causality == "output":
            ports += [f"output = {toml_text(own)}", f"magnitude = {0.01 * size:.2g}"]
            regimes += [
                f"[regimes.{toml_text(own)}]",
                f"variable = {toml_text(variable.name)}",
                f"unit = {toml_text(unit)}",
                "",
            ]
        ports += [f"unit = {toml_text(unit)}", ""]
        late = _Sizes((step, 5 * step), (0.0, 0.0, 50 * step, step / 10), "s")
        sizes = {
            "gain": _Sizes((1.02, 1.1), (1.0, 0.5, 2.0, 2e-3), "1"),
            "offset": _Sizes((0.01 * size, 0.05 * size), (0.0, -size, size, 1e-3 * size), unit),
            "lag": late,
            "delay": late,
        }
        for (kind, prop), (description, source) in _WORDS.items():
            if kind == causality:
                name = ids.format(signal=own, law=prop)
                effects += _effect(name, own, prop, description.format(own), source, sizes[prop])
    note = ["# ---- regimes: variables of the model; a gap is looked at along them, and over time ----", ""]
    return "\n".join([_HEAD, *ports, *note, *regimes, *effects])


class _Sizes(NamedTuple):
    """Of a property of a signal: trial values, then neutral, lower, upper and step, all in `unit`."""

    trials: tuple[float, ...]
    limits: tuple[float, float, float, float]
    unit: str


def _effect(id: str, signal: str, prop: str, description: str, source: str, sizes: _Sizes) -> list[str]:
    name, table = toml_text(f"{signal}.{prop}"), f"[effects.{toml_text(id)}"
    neutral, lower, upper, step = (f"{x:.4g}" for x in sizes.limits)
    return [
        f"{table}]",
        f"description = {toml_text(description)}",
        f"source = {toml_text(source)}",
        f"port = {toml_text(signal)}",
        *(["two_sided = true"] if prop in ("gain", "offset") else []),
        f"trials = [{', '.join(f'{{ {name} = {x:.4g} }}' for x in sizes.trials)}]",
        f"{table}.parameters]",
        f"{name} = {{ neutral = {neutral}, lower = {lower}, upper = {upper}, step = {step}, "
        f"unit = {toml_text(sizes.unit)} }}",
        "",
    ]
