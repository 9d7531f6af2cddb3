"""A diagnosis in words: where, what, how much, and the likeliest effects as a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_ROWS = 6


def told(diagnosis: Mapping[str, Any]) -> list[str]:
    """Return the verdict, where the gap lies and how far it shrinks, one line each."""
    from fmuid.report.diagnosis import facts

    lines = [f"{fact.label}: {fact.value}" for fact in facts(diagnosis)]
    for names in diagnosis["alias_classes"]:
        lines.append(f"Cannot be told apart with these sensors and experiments: {', '.join(names)}")
    following = diagnosis.get("next_experiment")
    if following:
        lines.append(
            f"Next experiment: {following['setup']}, {following['description']}"
            f" ({following['separation_sigma']:.3g} standard deviations)"
        )
    sensor = diagnosis.get("added_sensor")
    if sensor:
        lines.append(
            f"Or add a sensor: {sensor['description']} ({sensor['separation_sigma']:.3g} standard deviations)"
        )
    if diagnosis["verdict"]["kind"] == "complete" and diagnosis.get("smallest_seen"):
        lines.append(f"Would have been seen, at least this large: {_smallest(diagnosis['smallest_seen'])}")
    return lines + [f"Note: {note}" for note in diagnosis.get("notes", ())]


def likeliest(diagnosis: Mapping[str, Any]) -> list[list[str]]:
    """Return the table of the likeliest effects, its header first."""
    from fmuid.report.diagnosis_figures import ranked

    header = ["effect", "probability", "closure (held out)", "90 % interval", "parameters"]
    return [header, *(_row(e) for e in ranked(diagnosis["effects"])[:_ROWS])]


def _smallest(seen: Mapping[str, Mapping[str, float]]) -> str:
    return "; ".join(f"{e} ({', '.join(f'{n} = {v:.4g}' for n, v in own.items())})" for e, own in seen.items())


def _row(effect: Mapping[str, Any]) -> list[str]:
    closure = effect.get("closure", {})
    interval = "{:.2f} to {:.2f}".format(*closure["interval"]) if closure else ""
    parameters = ", ".join(f"{n} = {_with_error(p)}" for n, p in effect.get("parameters", {}).items())
    held_out = f"{closure['held_out']:.3f}" if closure else ""
    return [effect["id"], f"{effect['probability']:.3f}", held_out, interval, parameters]


def _with_error(estimate: Mapping[str, Any]) -> str:
    error = estimate["standard_error"]
    return f"{estimate['value']:.4g}" + ("" if error is None else f" ± {error:.2g}")
