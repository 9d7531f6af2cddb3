"""A diagnosis in words: where, what, how much, and the likeliest effects as a table."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from fmuid.core.formatting import Fact, range_text
from fmuid.diagnosis.decide import CLOSURE_THAT_NAMES, SIGNIFICANCE

_ROWS = 6


def summary(diagnosis: Mapping[str, Any]) -> list[str]:
    """Return the verdict, where the gap lies and how far it shrinks, one line each."""
    lines = [f"{fact.label}: {fact.value}" for fact in facts(diagnosis)]
    for names in diagnosis["alias_classes"]:
        lines.append(f"Cannot be distinguished with these sensors and experiments: {', '.join(names)}")
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


def facts(diagnosis: Mapping[str, Any]) -> tuple[Fact, ...]:
    """Return verdict, place and size of the gap: what a reader needs within a minute."""
    gap, named = diagnosis["gap"], diagnosis["verdict"]["effects"]
    sure = diagnosis["verdict"]["kind"] in ("complete", "effect") and _probability(diagnosis) > 0.5
    found = [Fact("Verdict", verdict_text(diagnosis), "good" if sure else "warn")]
    if diagnosis["verdict"]["kind"] == "insufficient":
        found.append(Fact("What to do", _more_data(diagnosis)))
    meant = {e["id"]: e.get("description", "") for e in diagnosis["effects"]}
    if any(meant.get(n) for n in named):
        names = [f"{n}: " if len(named) > 1 else "" for n in named]
        words = [n + _lowered(meant[i]) for n, i in zip(names, named, strict=True) if meant.get(i)]
        found.append(Fact("In words", "; ".join(words)))
    where = sorted(diagnosis["where"], key=lambda w: -w["share"])
    if where and gap["present"]:
        top = where[0]
        place = f"{top['experiment']}, {top['signal']}, {regime_text(top)}"
        found.append(Fact("Where most of it lies", f"{place} ({100 * top['share']:.0f} %)"))
    p_value = "p < 0.001" if gap["p_value"] < 1e-3 else f"p = {gap['p_value']:.2g}"
    found.append(Fact("Is there a gap", f"{_gap_text(gap)} ({p_value})"))
    corrected = f" → {gap['corrected']:.3g} corrected" if named else ""
    sizes = f"{gap['nominal']:.3g} → {gap['nominal_refit']:.3g} refitted{corrected}"
    found.append(Fact("Gap, in noise floors", sizes))
    for value, names in _closures(diagnosis, named).items():
        found.append(Fact(f"Closed on held-out data by {' + '.join(names)}", value))
    if diagnosis["verdict"]["kind"] == "unknown":
        found += _closest(diagnosis)
    return tuple(found)


def _gap_text(gap: Mapping[str, Any]) -> str:
    if gap["present"]:
        return "a gap beyond the noise"
    return (
        "a gap beyond the noise, too small to matter"
        if gap["p_value"] < SIGNIFICANCE
        else "no gap beyond the noise"
    )


def _more_data(diagnosis: Mapping[str, Any]) -> str:
    """Return what to record where the data cannot tell: see `powerless` in `diagnose_subject`."""
    if diagnosis["gap"]["present"] or diagnosis.get("smallest_seen"):
        return "record a run with another input; a single one, even repeated, leaves nothing to judge on"
    return "record runs with other or larger inputs, and more repeats; no effect of a plausible size would be seen"


def _closures(diagnosis: Mapping[str, Any], names: Sequence[str]) -> dict[str, list[str]]:
    """Return what effects close on held-out data, in words; effects that were fitted together share one."""
    by_id = {e["id"]: e.get("closure", {}) for e in diagnosis["effects"]}
    closures: dict[str, list[str]] = {}
    for name in names:
        closure = by_id.get(name, {})
        if closure.get("held_out") is not None:
            low, high = closure.get("interval") or (None, None)
            interval = "" if low is None or high is None else f" ({low:.2f} to {high:.2f})"
            closures.setdefault(f"{closure['held_out']:.2f}{interval}", []).append(name)
    return closures


def _closest(diagnosis: Mapping[str, Any]) -> tuple[Fact, ...]:
    """Return what comes closest to an explanation where nothing explains it."""
    judged = [e for e in diagnosis["effects"] if e.get("closure", {}).get("held_out") is not None]
    closing = sorted(judged, key=lambda e: -e["closure"]["held_out"])
    found = []
    for value, names in list(_closures(diagnosis, [e["id"] for e in closing]).items())[:1]:
        too_little = closing[0]["closure"]["held_out"] < CLOSURE_THAT_NAMES
        least = f", too little for a name (from {CLOSURE_THAT_NAMES:g} on)" if too_little else ""
        found.append(f"{' + '.join(names)} closes {value} on held-out data{least}")
    ports = diagnosis.get("ports") or {}
    if ports:
        port = max(ports, key=lambda name: ports[name])
        found.append(f"a free function at {port} {ports[port]:.2f}")
    return (Fact("What comes closest", "; ".join(found)),) if found else ()


def verdict_text(diagnosis: Mapping[str, Any]) -> str:
    """Return the verdict as one line, with the probability that what it says is true."""
    verdict = diagnosis["verdict"]
    names, port = list(verdict["effects"]), verdict["port"]
    sure = f" ({100 * _probability(diagnosis):.0f} %)"
    at = f" at {port}" if port else ""
    match verdict["kind"]:
        case "complete":
            return f"Complete{sure}: nothing is missing that these experiments could show"
        case "effect":
            return " and ".join(names) + at + sure
        case "ambiguous":
            return " or ".join(names) + f"{at}{sure}: these sensors and experiments cannot tell them apart"
        case "unknown":
            return f"Unknown effect{at}{sure}: none of the catalogue explains it"
        case _:
            return "Not enough data to say"


def _probability(diagnosis: Mapping[str, Any]) -> float:
    """Return the probability of what the verdict says."""
    verdict = diagnosis["verdict"]
    said = verdict["effects"] or [{"complete": "none"}.get(verdict["kind"], "unknown")]
    return sum(float(e["probability"]) for e in diagnosis["effects"] if e["id"] in said)


def _lowered(sentence: str) -> str:
    return sentence[:1].lower() + sentence[1:]


def likeliest(diagnosis: Mapping[str, Any]) -> list[list[str]]:
    """Return the table of the likeliest effects, its header first."""
    header = ["effect", "probability", "closure (held out)", "90 % interval", "parameters"]
    return [header, *(_row(e) for e in ranked(diagnosis["effects"])[:_ROWS])]


def ranked(effects: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the effects, the likeliest first; of equally likely ones those that close most."""

    def place(effect: Mapping[str, Any]) -> tuple[float, float]:
        held_out = effect.get("closure", {}).get("held_out")
        return -round(effect["probability"], 3), math.inf if held_out is None else -held_out

    return sorted(effects, key=place)


def regime_text(place: Mapping[str, Any]) -> str:
    """Return a regime of the JSON in words."""
    regime = place.get("regime")
    if not regime:
        return "whole run"
    low, high = regime.get("from", -math.inf), regime.get("to", math.inf)
    return f"{regime.get('variable', '')} {range_text(low, high)} {regime.get('unit', '')}".strip()


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
