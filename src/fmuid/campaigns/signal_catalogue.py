"""A first catalogue of effects for `fmuid diagnose`: errors between any FMU and its signals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fmuid.core.campaign import ModelSpec
from fmuid.core.experiments import Experiment
from fmuid.core.toml_tables import toml_text
from fmuid.core.units import conversion
from fmuid.simulation.simulator import Variable

HEAD = """\
format = "fmuid-effects"
version = 1
"""
_WORDS = {
    ("input", "gain"): ("'{}' acts with a wrong scale", "Calibration of the actuator"),
    ("input", "offset"): ("'{}' acts with a constant added", "Zero of the actuator"),
    ("input", "lag"): ("'{}' acts with a first-order lag", "Bandwidth of the actuator"),
    ("input", "delay"): (
        "'{}' acts late",
        "Communication and sampling; about half a sample: `timing` in campaign.toml",
    ),
    ("input", "saturation"): (
        "'{}' acts less and less as it grows",
        "Limit of the amplifier, magnetic saturation",
    ),
    ("input", "dead_zone"): ("'{}' acts only beyond a threshold", "Overlap of a valve, threshold of an amplifier"),
    ("input", "play"): ("'{}' acts with play", "Linkages and gears between actuator and valve"),
    ("input", "rate_limit"): ("'{}' acts with a limited rate", "Motors that move valves; ramps in a controller"),
    ("input", "crosstalk"): ("'{}' acts with a share of other inputs", "Coupling between channels"),
    ("output", "gain"): ("'{}' is read with a wrong scale", "Calibration of the sensor"),
    ("output", "offset"): ("'{}' is read with a constant added", "Zero of the sensor"),
    ("output", "lag"): ("'{}' is read with a first-order lag", "Filter of the sensor"),
    ("output", "delay"): ("'{}' is read late", "Communication and sampling"),
    ("output", "saturation"): ("'{}' is read less and less as it grows", "Range of the sensor"),
    ("output", "rectification"): (
        "'{}' is read without its sign",
        "Frequency counters, rectifiers, encoders of one channel",
    ),
    ("output", "play"): ("'{}' is read with play", "Hysteresis of the transducer; gears before an encoder"),
    ("output", "drift"): ("'{}' is read with a zero that drifts over a run", "Warming of the sensor"),
    ("output", "crosstalk"): (
        "'{}' is read with a share of other signals",
        "Coupling between channels, cross-axis sensitivity",
    ),
}
_HARD = 100.0  # a practically abrupt limit
_ONE_SIGN = 0.05  # of its range: a signal that goes no further below zero never changes its sign
OF_VALUE = ("saturation", "dead_zone")
"""Laws by which an input acts as a function of its value, not in proportion to it."""
_UNUSUAL = ("crosstalk", "play", "rate_limit")
_REMOVE_NOISE = ("play", "rate_limit")  # a log of a measured input has noise that the plant did not get
_TWO_SIDED = ("gain", "offset", "drift", "crosstalk")


class RecordedSetup(NamedTuple):
    """The recorded runs of a setup, and its model with the variables of its FMU."""

    runs: Sequence[Experiment]
    model: ModelSpec
    variables: Mapping[str, Variable]


def signal_catalogue(setups: Sequence[RecordedSetup]) -> str:
    """Return the text of a catalogue with effects for every signal that is not always zero.

    Trials are 2 and 10 % of scale, 1 and 5 % of the range, and one to twenty-five sample times. Only a sensor that
    never reads less than zero may have lost the sign. Inputs that are measured, with noise, have no play and no
    limited rate, which would remove that noise.

    Raises
    ------
    UnitError
        A signal's unit cannot be converted to the variable's.
    """
    runs = [run for setup in setups for run in setup.runs]
    step = min(float(np.median(np.diff(run.time))) for run in runs)
    duration = max(float(run.time[-1] - run.time[0]) for run in runs)
    noisy = any(r.repeat_of_reference or any(s.sigma for s in r.inputs.values()) for r in runs)
    recorded = [_signals(*setup) for setup in setups]
    signals: dict[str, _Signal] = {}
    for name, s in (item for of_setup in recorded for item in of_setup.items()):
        same = signals.get(name, s)
        signals[name] = s._replace(
            range=max(s.range, same.range), largest=max(s.largest, same.largest), least=min(s.least, same.least)
        )
    ports, regimes, effects = [], [], []
    for s in signals.values():
        ports += [
            f"[ports.{toml_text(s.name)}]",
            f"description = {toml_text(s.variable.description or f'{s.causality} {s.name}')}",
        ]
        if s.causality == "output":
            ports += [f"output = {toml_text(s.name)}", f"magnitude = {0.01 * s.range:.2g}"]
            regimes += [
                f"[regimes.{toml_text(s.name)}]",
                f"variable = {toml_text(s.variable.name)}",
                f"unit = {toml_text(s.unit)}",
                "",
            ]
        ports += [f"unit = {toml_text(s.unit)}", ""]
        others = [
            o
            for o in signals.values()
            if o is not s
            and (s.causality == "output" or o.causality == "input")
            and any({o.name, s.name} <= of_setup.keys() for of_setup in recorded)
        ]
        for (kind, law), (description, source) in _WORDS.items():
            if kind != s.causality or (kind == "input" and noisy and law in _REMOVE_NOISE):
                continue
            if sizes := _sizes(law, s, others, step, duration):
                effects += _effect(s.name, law, description.format(s.name), source, sizes)
    note = ["# ---- regimes: variables of the model along which a gap is examined, in addition to time ----", ""]
    return "\n".join([HEAD, *ports, *note, *regimes, *effects])


class _Signal(NamedTuple):
    """A signal, named as in the FMU if it is an input, with its range and extremes in `unit`."""

    name: str
    causality: str
    variable: Variable
    unit: str
    range: float
    largest: float
    least: float


def _signals(
    runs: Sequence[Experiment], model: ModelSpec, variables: Mapping[str, Variable]
) -> dict[str, _Signal]:
    signals = {}
    for name, causality in dict.fromkeys((n, s.causality) for run in runs for n, s in run.signals.items()):
        variable = variables[model.variable(name)]
        unit = model.unit(name, variable.unit)
        recorded = [run.signals[name] for run in runs if name in run.signals]
        values = np.concatenate([conversion(s.unit, unit)(s.values) for s in recorded])
        largest = float(np.nanmax(np.abs(values)))
        size = float(np.nanmax(values) - np.nanmin(values)) or largest
        label = variable.name if causality == "input" else name
        if size > 0.0:
            least = float(np.nanmin(values))
            signals[label] = _Signal(label, causality, variable, unit or "1", size, largest, least)
    return signals


class _Size(NamedTuple):
    """Sizes of a parameter: trials, then neutral, lower, upper and step, in `unit`; a shape if it has a start.

    The law itself ends at the bounds of a `natural` one. Trials in other shapes have a value, the name of the
    shape's parameter and its value.
    """

    name: str
    trials: tuple[float, ...]
    limits: tuple[float, float, float, float]
    unit: str
    shape: bool = False
    natural: bool = False
    in_shapes: tuple[tuple[float, str, float], ...] = ()


def _sizes(law: str, s: _Signal, others: Iterable[_Signal], step: float, duration: float) -> list[_Size]:
    """Return the parameters of a law at a signal."""
    size, most, per = s.range, s.largest, f"1/({s.unit})"
    longest = duration if law == "lag" else 0.1 * duration
    late = _Size(law, (step, 5 * step, 25 * step), (0.0, 0.0, max(50 * step, longest), step / 10), "s")
    if law == "crosstalk":
        shares = [(o.name, size / o.range, f"{s.unit}/({o.unit})") for o in others]
        return [_Size(f"crosstalk[{n}]", (0.05 * r,), (0.0, -r, r, 1e-3 * r), unit) for n, r, unit in shares]
    if law == "rectification":
        return [_Size(law, (1.0,), (0.0, 0.0, 1.0, 2e-3), "1")] if s.least > -_ONE_SIGN * s.range else []
    known = {
        "gain": [_Size(law, (1.02, 1.1), (1.0, 0.5, 2.0, 2e-3), "1")],
        "offset": [_Size(law, (0.01 * size, 0.05 * size), (0.0, -size, size, 1e-3 * size), s.unit)],
        "drift": [
            _Size(
                law,
                (0.01 * size / duration, 0.05 * size / duration),
                (0.0, -size / duration, size / duration, 1e-3 * size / duration),
                f"{s.unit}/s",
            ),
            # A drift that settles within a third of a run is an offset.
            _Size("drift_settling", (), (0.0, -3 / duration, 3 / duration, 0.03 / duration), "1/s", shape=True),
        ],
        "lag": [late, _Size("lag_split", (), (0.0, 0.0, 0.45, 0.01), "1", shape=True, natural=True)],
        "delay": [late],
        "saturation": [
            # An abrupt limit is as plausible as a soft one.
            _Size(
                "compression",
                (0.3 / most, 1 / most, 1.5 / most),
                (0.0, 0.0, 20 / most, 0.02 / most),
                per,
                in_shapes=((1 / most, "hardness", _HARD), (1.5 / most, "hardness", _HARD)),
            ),
            _Size("hardness", (), (4.0, 1.0, _HARD, 0.1), "1", shape=True),
        ],
        "play": [_Size(law, (0.01 * size, 0.05 * size, 0.2 * size), (0.0, 0.0, size, 1e-3 * size), s.unit)],
        "rate_limit": [
            _Size(
                "slowness",
                (2.0 * step / size, 10.0 * step / size, 0.05 * duration / size),
                (0.0, 0.0, duration / size, 2e-3 * step / size),
                f"s/({s.unit})",
            )
        ],
        "dead_zone": [
            # One that is wider on one side also acts as an offset does.
            _Size(
                law,
                (0.01 * most, 0.05 * most),
                (0.0, 0.0, most, 1e-3 * most),
                s.unit,
                in_shapes=tuple((0.05 * most, "dead_zone_skew", skew) for skew in (-0.5, 0.5)),
            ),
            _Size("dead_zone_skew", (), (0.0, -1.0, 1.0, 0.01), "1", shape=True, natural=True),
        ],
    }  # fmt: skip
    return known[law]


def _effect(signal: str, law: str, description: str, source: str, sizes: Iterable[_Size]) -> list[str]:
    table = f"[effects.{toml_text(f'{law}@{signal}')}"
    rows, trials = [], []
    for size in sizes:
        name = toml_text(f"{signal}.{size.name}")
        first, lower, upper, step = (f"{x:.4g}" for x in size.limits)
        kind = "start" if size.shape else "neutral"
        trials += [f"{{ {name} = {x:.4g} }}" for x in size.trials]
        for x, shape, value in size.in_shapes:
            trials.append(f"{{ {name} = {x:.4g}, {toml_text(f'{signal}.{shape}')} = {value:g} }}")
        rows.append(
            f"{name} = {{ {kind} = {first}, lower = {lower}, upper = {upper}, step = {step}, "
            f"unit = {toml_text(size.unit)}{', natural = true' * size.natural} }}"
        )
    return [
        f"{table}]",
        f"description = {toml_text(description)}",
        f"source = {toml_text(source)}",
        f"port = {toml_text(signal)}",
        *(["two_sided = true"] if law in _TWO_SIDED else []),
        *(["usual = false"] if law in _UNUSUAL else []),
        f"trials = [{', '.join(trials)}]",
        f"{table}.parameters]",
        *rows,
        "",
    ]
