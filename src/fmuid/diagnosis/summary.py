"""A diagnosis as text: place, cause and size of the gap, and the likeliest effects as a table."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from fmuid.core.formatting import Fact, interval_text, range_text
from fmuid.diagnosis.decide import CLOSURE_THAT_NAMES, SIGNIFICANCE

_ROWS = 6  # of a table in the terminal
_LISTED = 3  # alternatives in a sentence that would leave out at least two others


def summary(diagnosis: Mapping[str, Any]) -> list[str]:
    """Return the verdict, the place of the gap and its reduction, one line each."""
    lines = [f"{fact.label}: {fact.value}" for fact in facts(diagnosis)]
    lines += indistinct(diagnosis)
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
    if diagnosis["verdict"]["kind"] == "ambiguous" and not (following or sensor):
        lines.append("Next experiment: fmuid design --for diagnosis searches for a run that separates them")
    if diagnosis["verdict"]["kind"] == "complete" and diagnosis.get("power"):
        lines.append(f"Smallest effects that would have been seen: {_smallest(diagnosis['power'])}")
    lines += machine_lines(diagnosis)
    return lines + [f"Note: {note}" for note in diagnosis.get("notes", ())]


def indistinct(diagnosis: Mapping[str, Any]) -> list[str]:
    """Return a line for each reason why effects would not be separated, or not be seen."""
    alike = [_some(names, " or ") for names in diagnosis["alias_classes"] if len(names) > 1]
    hidden = diagnosis.get("hidden") or {}
    groups = {
        "These runs and sensors cannot tell apart": "; ".join(alike),
        "No sensor would show": _some(hidden.get("unseen", ()), ", "),
        "The fitted parameters would hide": _some(hidden.get("imitated", ()), ", "),
    }
    return [f"{what}: {names}" for what, names in groups.items() if names]


def machine_lines(diagnosis: Mapping[str, Any]) -> list[str]:
    """Return a line for each parameter that differs between machines, or one that says that none does."""
    machines = diagnosis.get("machines")
    if not machines:
        return []
    lines = []
    unnamed = [name for name in machines["effects"] if name not in named(diagnosis["verdict"])]
    beside = f" with {_listed(unnamed, 'and')} in the model" if unnamed else ""
    for p in (p for p in machines["parameters"] if p["differs"]):
        sure = "p < 0.001" if p["p_value"] < 1e-3 else f"p = {p['p_value']:.2g}"
        each = ", ".join(f"{_with_error(e)} on {machine}" for machine, e in p["machines"].items())
        last = f"; next machine, 95 %: {interval_text(*p['next_machine'])}" if p["next_machine"] else ""
        lines.append(f"Differs between machines{beside}: {p['name']} ({sure}): {each}{last}")
    if lines and machines["gap"] is not None:
        common = diagnosis["gap"]["corrected"]
        lines.append(
            f"Gap, in noise floors: {common:.3g} → {machines['gap']:.3g} with each machine's own values{beside}"
        )
    if not lines and machines["parameters"]:
        names = ", ".join(p["name"] for p in machines["parameters"])
        lines.append(f"Between machines: none of {names} differs beyond its uncertainty{beside}")
    if machines["left_out"]:
        lines.append(
            f"Not compared between machines, as their runs do not determine it: {', '.join(machines['left_out'])}"
        )
    if machines["failed"]:
        lines.append(
            f"Not compared with the others, as its runs cannot be refitted: {', '.join(machines['failed'])}"
        )
    return lines


def facts(diagnosis: Mapping[str, Any]) -> tuple[Fact, ...]:
    """Return verdict, place and size of the gap: what a reader needs within a minute."""
    gap, verdict = diagnosis["gap"], diagnosis["verdict"]
    sure = verdict["kind"] in ("complete", "effect") and probability(diagnosis) > 0.5
    lines = [Fact("Verdict", verdict_text(diagnosis), "good" if sure else "warn")]
    meant = {e["id"]: e.get("description", "") for e in diagnosis["effects"]}
    described = [n for n in named(verdict) if meant.get(n)]
    if described:
        names = [f"{in_words(n)}: " if len(described) > 1 else "" for n in described]
        lines.append(
            Fact("In words", "; ".join(n + _lowered(meant[i], i) for n, i in zip(names, described, strict=True)))
        )
    where = sorted(diagnosis["where"], key=lambda w: -w["share"])
    if where and gap["present"]:
        top = where[0]
        place = f"{top['experiment']}, {top['signal']}, {regime_text(top)}"
        lines.append(Fact("Where most of it lies", f"{place} ({100 * top['share']:.0f} %)"))
    p_value = "p < 0.001" if gap["p_value"] < 1e-3 else f"p = {gap['p_value']:.2g}"
    lines.append(Fact("Is there a gap", f"{_gap_text(gap)} ({p_value})"))
    corrected = f" → {gap['corrected']:.3g} corrected" if named(verdict) or diagnosis.get("refinements") else ""
    sizes = f"{gap['nominal']:.3g} → {gap['nominal_refit']:.3g} refitted{corrected}"
    lines.append(Fact("Gap, in noise floors", sizes))
    for answer in diagnosis["answers"] if named(verdict) else ():
        if answer.get("closure"):
            effects = " + ".join(answer["effects"])
            lines.append(Fact(f"Closed on held-out data by {effects}", closure_text(answer["closure"])))
    if verdict.get("rest"):
        lines.append(Fact("What is left", _rest_text(verdict["rest"])))
    if verdict.get("stable") is False:
        lines.append(
            Fact("Stable", "no: without one of the experiments, another answer would be preferred", "warn")
        )
    lines += _errors(diagnosis.get("tolerated") or ())
    if verdict["kind"] in ("unknown", "insufficient", "complete") and gap["present"]:
        lines += _closest(diagnosis)
    lines += _law_found(diagnosis)
    lines += _tables(diagnosis)
    if verdict.get("provisional"):
        lines.append(Fact("How sure", _provisional(diagnosis), "warn"))
    if verdict["kind"] == "insufficient":
        lines.append(Fact("What to do", _more_data(diagnosis)))
    return tuple(lines)


def sentences(diagnosis: Mapping[str, Any]) -> list[str]:
    """Return the verdict in one to three sentences."""
    verdict = diagnosis["verdict"]
    lines = [f"{verdict_text(diagnosis)}.", *_from_where_on(diagnosis)]
    best = next((a for a in diagnosis["answers"] if a.get("closure")), None)
    if named(verdict) and best is not None:
        with_what = "With it" if len(best["effects"]) == 1 else "With them"
        if verdict["kind"] == "ambiguous":
            with_what = f"With {_listed(best['effects'], 'and')}"
        lines.append(f"{with_what}, {_reduction(best['closure'])}.")
    tables = diagnosis.get("refinements") or ()
    lines += [_of_table(table, diagnosis["best"], best) for table in tables]
    if not (named(verdict) and best is not None) and diagnosis.get("best") and not tables:
        explained = diagnosis["best"]
        lines.append(
            f"The best explanation is {_listed(explained['effects'], 'with')}: with it,"
            f" {_reduction(explained['closure'])}."
        )
    if diagnosis.get("tolerated"):
        lines.append(f"After the refit, {_tolerated(diagnosis['tolerated'])}.")
    if verdict.get("provisional"):
        lines.append(_provisional(diagnosis))
    if verdict.get("rest"):
        lines.append(f"What is left: {_rest_text(verdict['rest'])}.")
    if verdict["kind"] == "insufficient":
        lines.append(f"{_more_data(diagnosis).capitalize()}.")
    law = diagnosis.get("law_found") or {}
    if law.get("formula"):
        low, high = law["closure"]["interval"]
        lines.append(
            f"A law found at {law['port']}{_beside(law)} explains it: a flow of {law['formula']}. With it,"
            f" {law['closure']['held_out']:.2f} of the gap is closed on held-out runs"
            f" ({low:.2f} to {high:.2f})."
        )
    return lines


def _from_where_on(diagnosis: Mapping[str, Any]) -> Iterator[str]:
    """Yield a sentence on each named effect that acts beyond a threshold only, as its description says."""
    by_id = {e["id"]: e for e in diagnosis["effects"]}
    for name in named(diagnosis["verdict"]):
        effect = by_id.get(name, {})
        _, beyond, value = effect.get("description", "").partition(" beyond ")
        if beyond and any(p.endswith("_threshold") for p in effect.get("parameters", ())):
            yield f"{_capital(in_words(name))} acts only beyond {value}."


def _of_table(table: Mapping[str, Any], best: Mapping[str, Any], told: Mapping[str, Any] | None) -> str:
    """Return a sentence on a table and on what it closes, unless the sentence on the answer has that."""
    over, reduction = table["variable"], _reduction(best["closure"])
    monotone = f"{way} " if (way := table["table"].get("monotone")) else ""
    if not table["learned"]:
        other = f"The plant's law has another shape than {in_words(table['law'])}"
        if told is not None and told["closure"] == best["closure"]:
            return f"{other}, so a {monotone}table over {over} refines it."
        return f"{other}: with a {monotone}table over {over} that refines it, {reduction}."
    others = [name for name in best["effects"] if name != table["id"]]
    beside = f" beside {_listed(others, 'and')}" if others else ""
    where = f"{table['port']} over {over}{beside}"
    return f"A {monotone}table learned at {where} predicts it, which is no law: with it, {reduction}."


def _reduction(closure: Mapping[str, Any]) -> str:
    """Return by how much an error falls on left-out data, in the signal's unit, and the share of the gap."""
    low, high = closure["interval"]
    share = f"{closure['held_out']:.2f} of the gap is closed ({low:.2f} to {high:.2f})"
    errors = closure.get("physical") or {}
    shown = {n: e for n, e in errors.items() if e["floor"] > 0.0}
    if not shown:
        return f"{share} on data that were not used"
    name = max(shown, key=lambda n: shown[n]["before"] / shown[n]["floor"])
    error = shown[name]
    unit = f" {error['unit']}" if error["unit"] else ""
    return (
        f"the error of {name} falls from {error['before']:.3g} to {error['after']:.3g}{unit} on data that were not"
        f" used; {share}"
    )


def _provisional(diagnosis: Mapping[str, Any]) -> str:
    """Return why a verdict is not certain."""
    if diagnosis["gap"].get("bounded"):
        return "This is provisional: no run was repeated, so slow noise is not excluded."
    return "This is provisional: something that the catalogue does not contain may explain the gap as well."


def named(verdict: Mapping[str, Any]) -> list[str]:
    """Return every effect that a verdict names, first those that all answers have."""
    return list(dict.fromkeys([*verdict["effects"], *(n for names in verdict["one_of"] for n in names)]))


def in_words(effect: str) -> str:
    """Return an effect's id in words: its law, and the port or parameter if the id has one."""
    law, _, port = effect.partition("@")
    if law == "value":
        return f"another value of {port}"
    return law.replace("_", " ") + (f" at {port}" if port else "")


def closure_text(closure: Mapping[str, Any]) -> str:
    """Return a closure on held-out data with its interval."""
    low, high = closure.get("interval") or (None, None)
    interval = "" if low is None or high is None else f" ({low:.2f} to {high:.2f})"
    return f"{closure['held_out']:.2f}{interval}"


def _rest_text(rest: Mapping[str, Any]) -> str:
    return f"{rest['gap']:.2g} times the noise" + (f", most of it {rest['where']}" if rest["where"] else "")


def _errors(tolerated: Sequence[Mapping[str, Any]]) -> tuple[Fact, ...]:
    return (Fact("Errors and tolerances", _tolerated(tolerated)),) if tolerated else ()


def _tolerated(errors: Sequence[Mapping[str, Any]]) -> str:
    """Return the errors of the refitted model beyond the noise, with what is tolerated."""
    lines = []
    for e in errors:
        unit = f" {e['unit']}" if e["unit"] else ""
        limit = "no tolerance stated" if e["tolerance"] is None else f"{e['tolerance']:.3g}{unit} tolerated"
        lines.append(f"{e['signal']} is off by {e['error']:.2g}{unit} beyond the noise ({limit})")
    return "; ".join(lines)


def _listed(names: Sequence[str], last: str) -> str:
    words = [in_words(n) for n in names]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}"


def _gap_text(gap: Mapping[str, Any]) -> str:
    if gap["present"]:
        return "a gap beyond the noise"
    return (
        "a gap beyond the noise, too small to matter"
        if gap["p_value"] < SIGNIFICANCE
        else "no gap beyond the noise"
    )


def _more_data(diagnosis: Mapping[str, Any]) -> str:
    """Return the runs to record if the data cannot decide: see `powerless` in `diagnose_subject`."""
    if diagnosis["gap"]["present"] and diagnosis["gap"].get("bounded"):
        return (
            "repeat a run as it is, and record one with a different input; what is left may be slow noise,"
            " which only repeats show"
        )
    if diagnosis["gap"]["present"] or diagnosis.get("power"):
        return (
            "record a run with a different input; a single experiment as short as this cannot be cross-validated"
        )
    return "record runs with different or larger inputs, and more repeats; the data would show no plausible effect"


def _law_found(diagnosis: Mapping[str, Any]) -> tuple[Fact, ...]:
    """Return the equation that was found, or why there is none."""
    law = diagnosis.get("law_found")
    if not law:
        return ()
    if not law["formula"]:
        return (Fact("Law found", f"none: {law['reason']}", "warn"),)
    left = "no more than noise" if law["p_value"] >= SIGNIFICANCE else f"{law['gap']:.2g} times the noise"
    return (
        Fact(f"Law found at {law['port']}{_beside(law)}", f"a flow of {law['formula']}", "good"),
        Fact("Closed on held-out data by the law found", f"{closure_text(law['closure'])}; {left} is left"),
    )


def _tables(diagnosis: Mapping[str, Any]) -> list[Fact]:
    """Return the tables of the best explanation, and what it closes with them."""
    tables = diagnosis.get("refinements") or ()
    lines = []
    for table in tables:
        sizes = np.abs(np.array(table["table"]["values"]))
        reached = " and ".join(
            f"{a['variable']} from {a['knots'][0]:.4g} to {a['knots'][-1]:.4g} {a['unit']}"
            for a in table["table"]["axes"]
        )
        label = "Learned table" if table["learned"] else f"Table that refines {in_words(table['law'])}"
        relative = table["effect"]["acts"] == "parameter"
        unit = f"% of {table['port']}" if relative else f"{table['table']['unit']} at {table['port']}"
        most = f"{(100.0 if relative else 1.0) * sizes.max():.3g} {unit}"
        monotone = f" {way}" if (way := table["table"].get("monotone")) else ""
        lines.append(Fact(label, f"{sizes.size}{monotone} values up to {most}, for {reached}"))
    if tables:
        lines.append(Fact("Closed on held-out data with the table", closure_text(diagnosis["best"]["closure"])))
    return lines


def _beside(law: Mapping[str, Any]) -> str:
    return f" beside {_listed(law['beside'], 'and')}" if law.get("beside") else ""


def _closest(diagnosis: Mapping[str, Any]) -> tuple[Fact, ...]:
    """Return the closest explanation if none is named."""
    best, parts = diagnosis.get("best"), []
    if diagnosis.get("refinements"):
        closing = [e | {"effects": [e["id"]]} for e in diagnosis["effects"] if e.get("closure")]
        closing += [a for a in diagnosis["answers"] if a.get("closure")]
        best = max(closing, key=lambda e: float(e["closure"]["held_out"]), default=None)
    if best is None or best["closure"]["held_out"] <= 0.0:
        parts.append("nothing in the catalogue closes a part of it on left-out data")
    else:
        too_little = best["closure"]["held_out"] < CLOSURE_THAT_NAMES
        least = f", too little to be named (it takes {CLOSURE_THAT_NAMES:g})" if too_little else ""
        names = " + ".join(best["effects"])
        parts.append(f"{names} closes {closure_text(best['closure'])} on held-out data{least}")
    ports = diagnosis.get("port_closures") or {}
    if ports:
        port = max(ports, key=lambda name: ports[name])
        parts.append(f"an arbitrary course over time at {port} {ports[port]:.2f}")
    return (Fact("What comes closest", "; ".join(parts)),) if parts else ()


def verdict_text(diagnosis: Mapping[str, Any]) -> str:
    """Return the verdict as one line, with the probability that it is true."""
    verdict = diagnosis["verdict"]
    effects, ports = list(verdict["effects"]), list(verdict["ports"])
    sure = f" ({100 * probability(diagnosis):.0f} %)"
    are = "is" if len(effects) == 1 else "are"
    missing = f"{_listed(effects, 'and')} {are} missing" if effects else ""
    likely = ("most likely, " if probability(diagnosis) > 0.5 else "possibly, ") * bool(verdict.get("provisional"))
    # Ids of generated catalogues already contain the port.
    at = f" at {', '.join(ports)}" if len(ports) == 1 and not any("@" in n for n in named(verdict)) else ""
    match verdict["kind"]:
        case "complete" if verdict.get("within_tolerance"):
            return f"Complete to within the tolerance{sure}"
        case "complete":
            return f"Complete{sure}: nothing is missing that these experiments could show"
        case "effect":
            return _capital(f"{likely}{missing}{at}{sure}")
        case "partial":
            return _capital(f"{likely}{missing}{at}{sure}, and something else that no effect explains")
        case "ambiguous":
            others = [_listed(names, "with") for names in verdict["one_of"]]
            if len(others) > _LISTED + 1:  # the table of answers has them all
                others = [*others[:_LISTED], f"one of {len(others) - _LISTED} others"]
            either = " or ".join(others)
            either = f"{missing}, and either {either}" if effects else f"{either} is missing"
            return _capital(f"{likely}{either}{at}{sure}: these sensors and experiments cannot tell them apart")
        case "unknown":
            at = f" at {' or '.join(ports)}" if ports else ""
            return f"Unknown effect{at}{sure}: no effect in the catalogue explains it"
        case _:
            return "Not enough data to say"


def probability(diagnosis: Mapping[str, Any]) -> float:
    """Return the probability of the verdict: that one of the answers it leaves open is true."""
    wanted = {"complete": ["none"], "unknown": ["unknown"]}.get(diagnosis["verdict"]["kind"])
    special = (["none"], ["unknown"])
    return sum(
        float(a["probability"])
        for a in diagnosis["answers"]
        if (a["effects"] == wanted if wanted else a["effects"] not in special)
    )


def _capital(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]


def _lowered(sentence: str, effect: str) -> str:
    """Return a sentence that goes on after a colon; names of the model stay as they are.

    A name is what comes before a colon of its own, the port or parameter of the effect, or a word with a capital
    or digit inside.
    """
    first = sentence.partition(" ")[0].strip("',.")
    effect = effect.partition("(")[0]
    words = {*re.split(r"[@.]", effect), effect.partition("@")[2]}
    named_ = first.endswith(":") or first in words or (first != "A" and not first[1:].islower())
    return sentence if named_ else sentence[:1].lower() + sentence[1:]


def likeliest(diagnosis: Mapping[str, Any]) -> list[list[str]]:
    """Return the table of the likeliest answers, then of other effects, with its header first."""
    header = ["answer", "probability", "closure (held out)", "90 % interval", "parameters"]
    by_id = {e["id"]: e for e in diagnosis["effects"]}
    rows, shown = [], set()
    for answer in diagnosis["answers"]:
        effects = [by_id[n] for n in answer["effects"] if n in by_id]
        parameters = {name: p for e in effects for name, p in e.get("parameters", {}).items()}
        rows.append(_row(" + ".join(answer["effects"]), answer, parameters))
        shown |= set(answer["effects"])
    others = [e for e in ranked(diagnosis["effects"]) if e["id"] not in shown and e.get("closure")]
    rows += [_row(e["id"], e, e.get("parameters", {})) for e in others[: max(0, _ROWS - len(rows))]]
    return [header, *rows]


def ranked(effects: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the effects, the likeliest first; equally likely ones by how much they close."""

    def place(effect: Mapping[str, Any]) -> tuple[float, float]:
        held_out = (effect.get("closure") or {}).get("held_out")
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
    return _some(
        [f"{e} ({', '.join(f'{n} = {v:.4g}' for n, v in sizes.items())})" for e, sizes in seen.items()], "; "
    )


def _some(names: Sequence[str], between: str) -> str:
    """Return the names, joined; of many, the first ones and how many more there are."""
    more = len(names) - _ROWS
    return between.join(names) if more <= 1 else between.join([*names[:_ROWS], f"{more} more"])


def _row(name: str, judged: Mapping[str, Any], estimates: Mapping[str, Any]) -> list[str]:
    closure = judged.get("closure") or {}
    interval = "{:.2f} to {:.2f}".format(*closure["interval"]) if closure else ""
    parameters = ", ".join(f"{n} = {_with_error(p)}" for n, p in estimates.items())
    held_out = f"{closure['held_out']:.3f}" if closure else ""
    return [name, f"{judged['probability']:.3f}", held_out, interval, parameters]


def _with_error(estimate: Mapping[str, Any]) -> str:
    error = estimate["standard_error"]
    return f"{estimate['value']:.4g}" + ("" if error is None else f" ± {error:.2g}")
