"""The figures of a diagnosis, built from plain arrays and the diagnosis' JSON value.

`DiagnosisPictures` are the arrays that the diagnosis computes in addition to its JSON. Every part may be empty
(too little data, no effect found); its figure is then left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from fmuid.core.formatting import range_text
from fmuid.core.immutable import FloatArray
from fmuid.diagnosis.summary import named, ranked, regime_text
from fmuid.report.figures import Overlay, overlay_figure
from fmuid.report.plots.figure_data import (
    Axis,
    Bar,
    BarFigure,
    Cell,
    LineFigure,
    MapFigure,
    Panel,
    Role,
    Series,
    Table,
    pretty_unit,
)

_IMPOSSIBLE = 0.001  # smaller probabilities are not told apart
_LEAST_ERROR = 0.5  # noise floors: where the logarithmic axis of errors begins


@dataclass(frozen=True, slots=True, eq=False)
class RegimeBins:
    """The bins of one regime variable (time, speed, load torque, angle, frequency ...): B + 1 edges."""

    variable: Axis
    edges: FloatArray

    @property
    def labels(self) -> tuple[str, ...]:
        """One label per bin."""
        span = float(np.ptp(self.edges))
        return tuple(range_text(a, b, span) for a, b in pairwise(self.edges.tolist()))


@dataclass(frozen=True, slots=True, eq=False)
class ExcessEnergy:
    """Share of the residual energy above the noise floor: `share` is (rows, all bins), NaN where not visited.

    `rows` are (experiment, signal); within a regime variable the shares of all rows and bins sum to 1.
    """

    rows: tuple[tuple[str, str], ...]
    regimes: tuple[RegimeBins, ...]
    share: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Branch:
    """The missing quantity over one variable, in one direction of motion if that matters.

    Parameters
    ----------
    x, y, standard_error
        (n,) estimates at the knots of the variable, and their standard errors (None if unknown).
    laws
        (label, x, y) of models with effects, as lines; the first is the corrected model.
    direction
        ``forward``, ``backward`` or empty.
    """

    x: FloatArray
    y: FloatArray
    standard_error: FloatArray | None = None
    laws: tuple[tuple[str, FloatArray, FloatArray], ...] = ()
    direction: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class MissingQuantity:
    """The estimated quantity missing at the winning port, over one variable, with the winning law.

    Parameters
    ----------
    variable
        Speed, angle or load.
    quantity
        For example ``Axis("missing gear friction torque", "N.m")``.
    branches
        One branch, or one per direction of motion.
    explained
        Share of the residual's energy that such a function of `variable` explains, if known.
    """

    variable: Axis
    quantity: Axis
    branches: tuple[Branch, ...]
    explained: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class DiagnosisPictures:
    """Everything the report draws that is not in the diagnosis' JSON.

    `overlays` are the worst signal of each setup: measured, with the nominal parameters refitted, corrected.
    `steps` are the gaps that part of the verdict's effects leave, by their names.
    """

    overlays: tuple[Overlay, ...] = ()
    excess: ExcessEnergy | None = None
    missing: tuple[MissingQuantity, ...] = ()
    steps: Mapping[str, float] = field(default_factory=dict)


def before_and_after(overlays: Sequence[Overlay]) -> LineFigure | None:
    """Return the worst signal of each setup: measured, before and after the correction."""
    if not overlays:
        return None
    caption = (
        "The signal with the largest gap"
        + (" of each setup" if len(overlays) > 1 else "")
        + ", repeats averaged. "
        "Below: residual of the best of these models, prediction minus measurement."
    )
    return overlay_figure("before-after", "Before and after", overlays, caption)


def parameters_table(diagnosis: Mapping[str, Any], units: Mapping[str, str] | None = None) -> Table | None:
    """Return every parameter, refitted without and with the missing effects, and its change; `units` by name."""
    if not named(diagnosis["verdict"]):
        return None
    before, after = diagnosis.get("nominal", {}).get("parameters", {}), diagnosis["model"]["parameters"]
    known = {**(units or {}), **diagnosis["model"].get("units", {})}
    errors = dict(diagnosis["model"].get("standard_errors", {}))
    for effect in diagnosis["effects"]:
        for name, parameter in effect.get("parameters", {}).items():
            known.setdefault(name, parameter.get("unit"))
            if effect["id"] in named(diagnosis["verdict"]):
                errors.setdefault(name, parameter.get("standard_error"))
    rows: list[tuple[Cell, ...]] = []
    for name, value in after.items():
        old = before.get(name)
        change = None if not old else 100 * (value - old) / abs(old)
        rows.append((name, pretty_unit(known.get(name) or ""), old, value, errors.get(name), change))
    header = ("parameter", "unit", "nominal, refitted", "corrected", "standard error", "change, %")
    caption = "Missing effects bias the nominal parameters. A dash: unknown, or a parameter of the effect itself."
    return Table(header, tuple(rows), "corrected-model", "Parameters that changed", caption, (5, 5, 5, 5, 2, 2))


def machines_table(diagnosis: Mapping[str, Any]) -> Table | None:
    """Return every parameter as estimated from the runs of each machine, with an interval for the next machine."""
    machines = diagnosis.get("machines")
    if not machines:
        return None
    rows: list[tuple[Cell, ...]] = []
    for p in machines["parameters"]:
        low, high = p["next_machine"] or (None, None)
        of_parameters = [p["machines"].get(name, {}) for name in machines["names"]]
        each = [cell for e in of_parameters for cell in (e.get("value"), e.get("standard_error"))]
        rows.append((p["name"], *each, p["p_value"], "yes" if p["differs"] else "no", low, high))
    heads = [head for name in machines["names"] for head in (name, f"± {name}")]
    header = ("parameter", *heads, "p", "differs", "next machine, 95 %: from", "to")
    caption = (
        "Refitted to the runs of each machine separately, with standard errors. No interval: too few machines."
    )
    digits = (4, *(n for _ in machines["names"] for n in (4, 2)), 2, 2, 3, 3)
    return Table(header, tuple(rows), "machines", "Parameters of each machine", caption, digits)


def excess_figure(excess: ExcessEnergy | None) -> MapFigure | None:
    """Return the map of excess energy: experiment and signal down, bins of the regime variables across."""
    if excess is None:
        return None
    largest = float(np.nanmax(excess.share)) if np.isfinite(excess.share).any() else 0.0
    return MapFigure(
        "excess-energy",
        "Where the gap lies",
        tuple(f"{experiment} · {signal}" for experiment, signal in excess.rows),
        tuple(label for r in excess.regimes for label in r.labels),
        excess.share,
        Axis("share of excess"),
        (0.0, max(largest, 1e-6)),
        tuple((r.variable.label, len(r.labels)) for r in excess.regimes),
        "Energy of the residual above the noise; each block splits the same energy by another variable. "
        "Empty: not visited.",
    )


_LAWS: tuple[Role, ...] = ("final", "alternative", "reference")


def missing_figure(missing: Sequence[MissingQuantity]) -> LineFigure | None:
    """Return the missing torque (or deflection) over speed, angle and load, with the winning law over it."""
    if not missing:
        return None
    panels = []
    for m in missing:
        series = []
        for branch in m.branches:
            backward = branch.direction == "backward"
            label = "estimated, backward" if backward else "estimated"
            dots: Role = "before" if backward else "measurement"
            if len(branch.x):
                series.append(Series(label, branch.x, branch.y, dots, branch.standard_error, points=True))
            for k, (name, x, y) in enumerate(branch.laws):
                series.append(Series(name, x, y, _LAWS[min(k, len(_LAWS) - 1)]))
        panels.append(Panel(f"over {m.variable.name}", m.variable, m.quantity, tuple(series)))
    shares = ", ".join(
        f"{100 * m.explained:.0f} % by {m.variable.name}" for m in missing if m.explained is not None
    )
    directions = ", in each direction of motion," if any(len(m.branches) > 1 for m in missing) else ""
    turns = "; angles are within one turn" if any(m.variable.unit == "rad" for m in missing) else ""
    caption = (
        f"Points: contribution that a function of one variable{directions} must make at the port of the verdict, "
        f"with standard errors{turns}. Lines: contribution of the effects."
    ) + (f" Share of the residual's energy that it explains: {shares}." if shares else "")
    if not any(len(branch.x) for m in missing for branch in m.branches):
        caption = "Lines: the coefficient over what it depends on, in the range that the runs reach."
    return LineFigure("missing", "What is missing at the port", tuple(panels), caption, min(len(panels), 3))


def effects_figure(diagnosis: Mapping[str, Any], most: int = 12) -> BarFigure | None:
    """Return the answers, then the other effects, with held-out closure and its interval."""
    answer_names = named(diagnosis["verdict"])
    entries = {" + ".join(a["effects"]): a for a in diagnosis["answers"] if a.get("closure")}
    shown = {n for a in diagnosis["answers"] for n in a["effects"]}
    others = (e for e in ranked(diagnosis["effects"]) if e["id"] not in shown and e.get("closure"))
    entries |= {e["id"]: e for e in others}
    bars = {}
    for name, entry in list(entries.items())[:most]:
        interval = entry["closure"].get("interval")
        bars[name] = Bar(
            name,
            entry["closure"]["held_out"],
            "final"
            if answer_names and set(entry.get("effects", ())) <= {*answer_names} and "effects" in entry
            else "floor",
            None if interval is None else (interval[0], interval[1]),
            _probability(entry["probability"]),
        )
    if not bars:
        return None
    low = min(0.0, *(b.interval[0] if b.interval else b.value for b in bars.values()))
    return BarFigure(
        "effects",
        "Effects, ranked",
        tuple(bars.values()),
        Axis("closure of the gap on held-out data"),
        ((1.0, "all of the gap"),),
        "Share of the gap that each effect closes on runs not used for its fit, beyond refitting the nominal "
        "parameters; lines are its bootstrap interval. Blue: the verdict.",
        limits=(max(-1.0, low), 1.25),
    )


def _probability(value: float) -> str:
    return f"probability {value:.2g}" if value >= _IMPOSSIBLE else f"probability below {_IMPOSSIBLE:g}"


def ports_figure(diagnosis: Mapping[str, Any]) -> BarFigure | None:
    """Return the share of the gap that an unknown flow or error at each port would close, if it was computed."""
    ports = diagnosis.get("port_closures") or {}
    if not ports:
        return None
    bars = tuple(
        Bar(name, share, "final" if name in diagnosis["verdict"]["ports"] else "floor", note=f"{share:.2f}")
        for name, share in sorted(ports.items(), key=lambda p: -p[1])
    )
    return BarFigure(
        "ports",
        "Which port could explain it",
        bars,
        Axis("closure of the gap"),
        ((1.0, "all of the gap"),),
        "An arbitrary course over time at each port, in each run separately. Blue: the ports of the verdict.",
        limits=(min(0.0, max(-1.0, *(b.value for b in bars))), 1.25),
    )


def gap_figure(diagnosis: Mapping[str, Any], steps: Mapping[str, float] | None = None) -> BarFigure:
    """Return the error, step by step, down to the noise; `steps` are gaps that some of the effects leave.

    A gap is an error beyond the noise. Drawn is the whole error, which is never below the noise.
    """
    gap = diagnosis["gap"]
    bars = [
        Bar("nominal model", gap["nominal"], "start"),
        Bar("nominal parameters refitted", gap["nominal_refit"], "before"),
    ]
    if named(diagnosis["verdict"]) or diagnosis.get("refinements"):
        bars += [Bar(f"with {names}", left, "alternative") for names, left in (steps or {}).items()]
        bars.append(Bar("corrected", gap["corrected"], "final"))
    bars.append(Bar("noise alone", 0.0, "floor"))
    errors = [math.hypot(1.0, b.value) for b in bars]
    return BarFigure(
        "gap",
        "From the gap to the noise floor",
        tuple(replace(b, value=e, note=f"{e:.3g}") for b, e in zip(bars, errors, strict=True)),
        Axis("error, in noise floors", log=True),
        caption="Root mean square of the whitened residual over the signals' bandwidth. With a gap g beyond the"
        f" noise, it is the root of 1 + g². {_floors(diagnosis)}".rstrip(),
        limits=(_LEAST_ERROR, 2.0 * max(errors)),
    )


def _floors(diagnosis: Mapping[str, Any]) -> str:
    floors = diagnosis["gap"]["floor_units"]
    if not floors:
        return ""
    text = "Noise floor: " + ", ".join(f"{name} {value:.3g}" for name, value in floors.items()) + "."
    if not diagnosis["gap"].get("calibrated", True):
        text += " Not calibrated: some experiments have fewer than five repeats."
    return text


def law_figure(diagnosis: Mapping[str, Any]) -> LineFigure | None:
    """Return the law found over the quantity that it depends on."""
    law = diagnosis.get("law_found") or {}
    curve = law.get("curve")
    if not curve:
        return None
    at = f" with {curve['held']}" if curve["held"] else ""
    line = Series(law["id"], np.array(curve["x"]), np.array(curve["y"]), "final")
    quantity = Axis(f"flow at {law['port']}", curve["flow_unit"])
    panel = Panel(law["port"], Axis(f"{curve['variable']} at {law['port']}{at}", curve["unit"]), quantity, (line,))
    caption = f"A flow of {law['formula']}, over the range that these runs reached{at}."
    return LineFigure("law-found", "The law found", (panel,), caption)


def tables_figure(diagnosis: Mapping[str, Any]) -> LineFigure | None:
    """Return the tables of the best explanation over their first variable, a line for each value of the second."""
    panels = []
    for one in diagnosis.get("refinements") or ():
        (x, *others), values = one["table"]["axes"], np.array(one["table"]["values"])
        rows = values.T if others else [values]
        texts = [f"{o['variable']} = {at:.4g} {pretty_unit(o['unit'])}" for o in others for at in o["knots"]]
        labels = [text.strip() for text in texts] or [one["id"]]
        lines = [
            Series(label, np.array(x["knots"]), row, _LAWS[min(k, len(_LAWS) - 1)])
            for k, (label, row) in enumerate(zip(labels, rows, strict=True))
        ]
        monotone = f", only {way}" if (way := one["table"].get("monotone")) else ""
        what = "learned at" if one["learned"] else "added at"
        what = "relative change of" if one["effect"]["acts"] == "parameter" else what
        quantity = Axis(f"{what} {one['port']}{monotone}", one["table"]["unit"])
        panels.append(Panel(one["id"], Axis(x["variable"], x["unit"]), quantity, tuple(lines)))
    if not panels:
        return None
    caption = "What the table adds at its place. It holds only between its knots, where the runs were."
    return LineFigure("tables", "The table", tuple(panels), caption)


def law_table(diagnosis: Mapping[str, Any]) -> Table | None:
    """Return the parameters of the law found."""
    law = diagnosis.get("law_found") or {}
    rows = tuple(
        (name, p["value"], p["unit"], p["standard_error"], *(p["interval"] or (None, None)))
        for name, p in law.get("parameters", {}).items()
    )
    header = ("parameter", "value", "unit", "standard error", "95 % from", "to")
    return Table(header, rows, "law-found-parameters", "Its parameters") if rows else None


def effects_table(
    diagnosis: Mapping[str, Any], *, refitted: bool, units: Mapping[str, str] | None = None
) -> Table:
    """Return the candidates with probability, score and closures: those that were refitted, or the others."""
    rows: list[tuple[Cell, ...]] = []
    for effect in ranked(diagnosis["effects"]):
        closure = effect.get("closure") or {}
        if bool(closure) is not refitted:
            continue
        if not refitted:
            rows.append((effect["id"], effect.get("score")))
            continue
        closures = (closure.get("train"), closure.get("held_out"), *(closure.get("interval") or (None, None)))
        parameters = ", ".join(
            f"{name} = {p['value']:.4g}"
            + ("" if p.get("standard_error") is None else f" ± {p['standard_error']:.2g}")
            + (f" {pretty_unit(unit)}" if (unit := (units or {}).get(name)) and unit != "1" else "")
            for name, p in effect.get("parameters", {}).items()
        )
        rows.append((effect["id"], effect["probability"], effect.get("score"), *closures, parameters))
    if not refitted:
        return Table(("effect", "score"), tuple(rows), "effects-not-refitted", digits=(5, 3))
    names = ("closure, fitted", "closure, held out", "90 % from", "to")
    header = ("effect", "probability", "score", *names, "parameters ± standard error")
    digits = (5, 2, 3, 2, 2, 2, 2, 5)
    return Table(header, tuple(rows), "effects-table", "Effects that were refitted", digits=digits)


def seen_table(diagnosis: Mapping[str, Any], units: Mapping[str, str] | None = None) -> Table | None:
    """Return the size from which each effect would have been seen, where none was."""
    if diagnosis["gap"]["present"]:
        return None
    rows = tuple(
        (effect, parameter, value, pretty_unit((units or {}).get(parameter, "")))
        for effect, powers in diagnosis.get("power", {}).items()
        for parameter, value in powers.items()
    )
    header = ("effect", "parameter", "smallest size", "unit")
    return Table(header, rows, "seen", "Effects that would have been seen from this size on", digits=(5, 5, 4, 5))


def where_table(diagnosis: Mapping[str, Any]) -> Table:
    """Return where the gap lies, largest share first."""
    rows = []
    for place in sorted(diagnosis["where"], key=lambda w: -w["share"]):
        rows.append((place["experiment"], place["signal"], regime_text(place), 100 * place["share"]))
    header = ("experiment", "signal", "regime", "share of the excess, %")
    return Table(header, tuple(rows), "where", "Largest parts", digits=(5, 5, 5, 3))
