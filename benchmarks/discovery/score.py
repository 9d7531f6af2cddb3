"""Whether a law found is the plant's: both along the plant's trajectory in a held-out run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.discovery.case import Case
from benchmarks.rigs.plant import Floats
from fmuid.discovery.terms import evaluated, names_in

RIGHT = 0.05  # of the true law: root mean square difference
SAME = 0.01  # the same with coefficients fitted anew: the terms are the same
_ROOM = 293.15
Course = Mapping[str, Floats]
"""``place.quantity`` -> samples; ``time``."""

# What a law at a port of the model sees in the plant, and the sign of its flow at the plant's place.
_PORTS: Mapping[tuple[str, str], tuple[str, float, Callable[[Course], Course]]] = {
    ("ThermalBlock", "body"): ("body", 1.0, lambda c: {"p": c["body.p"] + _ROOM}),
    ("ThermalBlock", "casing"): ("casing", 1.0, lambda c: {"p": c["casing.p"] + _ROOM}),
    ("ThermalBlock", "air"): ("casing", -1.0, lambda c: {"p": -c["casing.p"]}),
    ("ThermalBlock", "wall"): ("wall", 1.0, lambda c: {"p": c["wall.p"]}),
    ("Tanks", "upper"): ("upper", 1.0, lambda c: {"p": c["upper.p"]}),
    ("Tanks", "lower"): ("lower", 1.0, lambda c: {"p": c["lower.p"]}),
    ("Tanks", "second"): ("lower", -1.0, lambda c: {"p": -c["lower.p"]}),
    ("Tanks", "first"): ("first", 1.0, lambda c: {"p": c["first.p"]}),
    ("Circuit", "inductor.n"): ("capacitor", 1.0, lambda c: {"p": c["capacitor.p"]}),
    ("Circuit", "capacitor"): ("capacitor", -1.0, lambda c: {"p": -c["capacitor.p"]}),
    ("BeltAxis", "carriage"): ("carriage", 1.0, lambda c: {"p": c["carriage.p"], "rate": c["carriage.rate"]}),
    ("BeltAxis", "rotor"): ("rotor", 1.0, lambda c: {"p": c["rotor.p"], "rate": c["rotor.rate"]}),
    ("BeltAxis", "pulley.rim"): ("carriage", 1.0, lambda c: {"p": c["carriage.p"], "rate": c["carriage.rate"]}),
    ("BeltAxis", "belt"): ("belt", 1.0, lambda c: {"p": c["belt.p"], "rate": c["belt.rate"]}),
    ("Shaker", "table"): ("table", 1.0, lambda c: {"p": c["table.p"], "rate": c["table.rate"]}),
    ("Shaker", "suspension"): ("table", 1.0, lambda c: {"p": c["table.p"], "rate": c["table.rate"]}),
    ("Shaker", "specimen"): ("specimen", 1.0, lambda c: {"p": c["specimen.p"], "rate": c["specimen.rate"]}),
    ("Shaker", "mount"): ("mount", 1.0, lambda c: {"p": c["mount.p"], "rate": c["mount.rate"]}),
}

# Places with a stiff part between them, which no run tells apart: what a flow at one does at the other.
_RIGID: Mapping[tuple[str, str, str], Callable[[Course], float]] = {
    ("BeltAxis", "rotor", "carriage"): lambda c: 1.0 / _along(c["rotor.rate"], c["carriage.rate"]),
    ("BeltAxis", "carriage", "rotor"): lambda c: _along(c["rotor.rate"], c["carriage.rate"]),
}

# What the nominal parameters do at a place: a law is found but for it.
_NOMINAL: Mapping[tuple[str, str], Callable[[Course], list[Floats]]] = {
    ("ThermalBlock", "body"): lambda c: [_rate(c, "body.p"), c["wall.p"]],
    ("ThermalBlock", "casing"): lambda c: [_rate(c, "casing.p"), c["wall.p"], c["casing.p"], 0 * c["time"] + 1.0],
    ("ThermalBlock", "wall"): lambda c: [c["wall.p"]],
    ("Tanks", "upper"): lambda c: [_rate(c, "upper.p"), np.sqrt(np.maximum(c["upper.p"], 0.0)), c["upper.u"]],
    ("Tanks", "lower"): lambda c: [
        _rate(c, "lower.p"),
        np.sqrt(np.maximum(c["upper.p"], 0.0)),
        np.sqrt(np.maximum(c["lower.p"], 0.0)),
    ],
    ("Tanks", "first"): lambda c: [np.sqrt(np.maximum(c["upper.p"], 0.0))],
    ("Circuit", "capacitor"): lambda c: [_rate(c, "capacitor.p")],
    ("BeltAxis", "carriage"): lambda c: [
        _rate(c, "carriage.rate"),
        c["carriage.rate"],
        np.tanh(c["carriage.rate"] / 0.005),
    ],
    ("BeltAxis", "rotor"): lambda c: [_rate(c, "rotor.rate"), c["rotor.i"]],
    ("BeltAxis", "belt"): lambda c: [c["belt.p"], c["belt.rate"]],
    ("Shaker", "table"): lambda c: [_rate(c, "table.rate"), c["table.p"], c["table.rate"], c["table.i"]],
    ("Shaker", "specimen"): lambda c: [_rate(c, "specimen.rate")],
    ("Shaker", "mount"): lambda c: [c["mount.p"], c["mount.rate"]],
}


# No run determines the scale that all flows and sections have in common: `fmuid init` holds this parameter.
_COMMON_SCALE: Mapping[str, str] = {"Tanks": "lower", "Shaker": "d"}


def _along(x: Floats, y: Floats) -> float:
    """Return the factor of y by x."""
    return float(x @ y / (x @ x))


def _rate(c: Course, name: str) -> Floats:
    return np.gradient(c[name], c["time"])


def true_course(case: Case, experiment: str, factors: Mapping[str, float]) -> tuple[Course, Floats]:
    """Return the quantities of every place of the plant in a run, and the true flow in the model's scale."""
    rig = case.rig
    rows: dict[float, tuple[dict[str, float], float]] = {}

    def heard(t: float, places: Mapping[str, Mapping[str, float]], flow: float) -> None:
        values = {f"{place}.{n}": float(v) for place, own in places.items() for n, v in own.items()}
        rows.setdefault(round(t, 12), (values, flow))  # the first of a step: at its begin

    index = list(rig.inputs).index(experiment)
    extra = replace(case.extra(index), heard=heard)
    rig.simulate(factors, {}, rig.time, rig.inputs[experiment], extra)
    kept = [rows[t] for t in (round(float(t), 12) for t in rig.time[:-1]) if t in rows]
    course = {n: np.array([values[n] for values, _ in kept]) for n in kept[0][0]}
    scale = factors[_COMMON_SCALE[rig.model]] if rig.model in _COMMON_SCALE else 1.0
    return course | {"time": rig.time[: len(kept)]}, np.array([flow / scale for _, flow in kept])


def difference(
    case: Case, law: Mapping[str, Any], course: Course, flow: Floats
) -> tuple[float, float] | tuple[None, None]:
    """Return how far a law is from the true one, relative to it, but for what nominal parameters do at the place.

    As it was found, and with its coefficients fitted to the true one. None if it acts at another place, or depends
    on what the score does not know.
    """
    known, there = _PORTS.get((case.rig.model, law["port"])), case.table["place"]
    if known is None:
        return None, None
    place, sign, quantities = known
    if place != there:
        rigid = _RIGID.get((case.rig.model, place, there))
        if rigid is None:
            return None, None
        sign *= rigid(course)
    inputs = {n.partition(".")[2]: v for n, v in course.items() if n.startswith(f"{place}.")}
    columns = {**inputs, **quantities(course), "time": course["time"]}
    columns |= {n: np.full(len(flow), p["value"]) for n, p in law["parameters"].items()}
    effect = law["effect"]
    states = effect.get("states", {})
    used = {
        n for text in (effect["expression"], *(s["derivative"] for s in states.values())) for n in names_in(text)
    }
    if not used <= columns.keys() | states.keys():
        return None, None
    for name, state in states.items():
        columns[name] = _state(state["derivative"], name, columns)
    own = np.stack(_NOMINAL[case.rig.model, there](course), axis=1)
    sizes = [n for n in law["parameters"] if "size" in n]
    off = {n: np.zeros(len(flow)) for n in sizes}
    terms = [sign * evaluated(effect["expression"], {**columns, **off, n: columns[n]}) for n in sizes]
    true = _beyond(own, flow)
    left = _beyond(own, flow - np.sum(terms, axis=0)), _beyond(np.column_stack([own, *terms]), flow)
    as_found, fitted = (float(np.linalg.norm(x) / np.linalg.norm(true)) for x in left)
    return as_found, fitted


def _beyond(own: Floats, values: Floats) -> Floats:
    """Return the values minus their projection on the columns."""
    own = own[:, np.any(own != 0.0, axis=0)]  # a term may be at rest in a run
    scaled = own / np.linalg.norm(own, axis=0)
    return values - scaled @ np.linalg.lstsq(scaled, values, rcond=None)[0]


def _state(rate: str, name: str, columns: Mapping[str, Floats]) -> Floats:
    """Return a state from zero, whose derivative is ``f - a*state``, by exact steps."""
    time = columns["time"]
    f, with_one = (evaluated(rate, {**columns, name: np.full(len(time), x)}) for x in (0.0, 1.0))
    decay = max(float(np.mean(f - with_one)), 1e-12)
    out = [0.0]
    for k, step in enumerate(np.diff(time)):
        keep = float(np.exp(-decay * step))
        out.append(keep * out[-1] + (1.0 - keep) / decay * 0.5 * float(f[k] + f[k + 1]))
    return np.array(out)
