"""The report of a diagnosis: where the gap lies, what causes it, how far it shrinks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fmuid.plots import Format
from fmuid.plots.data import Figure, Table
from fmuid.report import diagnosis_figures as pictures_of
from fmuid.report.diagnosis_figures import DiagnosisPictures
from fmuid.report.document import Document, Fact, Section, write_document
from fmuid.report.provenance import provenance_table

_NOTHING = DiagnosisPictures()


def write_diagnosis_report(
    diagnosis: Mapping[str, Any],
    out: str | Path,
    *,
    campaign: str,
    pictures: DiagnosisPictures = _NOTHING,
    provenance: Mapping[str, str] | None = None,
    formats: tuple[Format, ...] = ("png",),
) -> Path:
    """Write the report of a diagnosis and return the path of its ``index.html``.

    Parameters
    ----------
    diagnosis
        The value of the diagnosis' JSON (``fmuid-diagnosis``, version 1).
    out
        Folder for ``index.html``, ``figures/`` and ``data/``.
    campaign
        Title of the campaign.
    pictures
        The arrays behind the pictures.
    provenance
        Name and value of what the result depends on: hashes, versions, commands.
    formats
        File formats of the figures.

    Raises
    ------
    FmuidError
        The folder cannot be written.
    """
    sections = (
        Section("Where", _present(_excess(pictures), pictures_of.where_table(diagnosis))),
        Section(
            "What",
            _present(
                pictures_of.effects_figure(diagnosis),
                pictures_of.missing_figure(pictures.missing),
                pictures_of.ports_figure(diagnosis),
                pictures_of.effects_table(diagnosis),
            ),
            _aliases(diagnosis),
        ),
        Section(
            "How much",
            _present(
                pictures_of.gap_figure(diagnosis, pictures.steps),
                pictures_of.residuals_figure(pictures.residuals),
            ),
            _floors(diagnosis),
            _present(_model_table(diagnosis)),
            "The corrected model",
        ),
        Section("Next experiment", (), f"{_next_experiment(diagnosis)} {_added_sensor(diagnosis)}".strip()),
        Section("Notes", (), " ".join(diagnosis.get("notes", ()))),
        Section("Provenance", (provenance_table(provenance or {}),)),
    )
    document = Document(
        f"Diagnosis: {campaign}",
        "Where simulation and measurement part, which effect causes it, and how far the gap shrinks with it.",
        facts(diagnosis),
        tuple(s for s in sections if s.items or s.text),
    )
    return write_document(document, Path(out), formats)


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
        place = f"{top['experiment']}, {top['signal']}, {pictures_of.regime_text(top)}"
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
    from fmuid.diagnosis.decide import SIGNIFICANCE

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
    from fmuid.diagnosis.decide import CLOSURE_THAT_NAMES

    judged = [e for e in diagnosis["effects"] if e.get("closure", {}).get("held_out") is not None]
    ranked = sorted(judged, key=lambda e: -e["closure"]["held_out"])
    found = []
    for value, names in list(_closures(diagnosis, [e["id"] for e in ranked]).items())[:1]:
        too_little = ranked[0]["closure"]["held_out"] < CLOSURE_THAT_NAMES
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


def _present(*items: Figure | Table | None) -> tuple[Figure | Table, ...]:
    return tuple(i for i in items if i is not None and not (isinstance(i, Table) and not i.rows))


def _excess(pictures: DiagnosisPictures) -> Figure | None:
    return pictures_of.excess_figure(pictures.excess)


def _aliases(diagnosis: Mapping[str, Any]) -> str:
    classes = [" = ".join(c) for c in diagnosis["alias_classes"] if len(c) > 1]
    return (
        ""
        if not classes
        else "Cannot be told apart with these sensors and experiments: " + "; ".join(classes) + "."
    )


def _floors(diagnosis: Mapping[str, Any]) -> str:
    floors = diagnosis["gap"]["floor_units"]
    if not floors:
        return ""
    text = "Noise floor: " + ", ".join(f"{name} {value:.3g}" for name, value in floors.items()) + "."
    if not diagnosis["gap"].get("calibrated", True):
        text += " Uncalibrated: fewer than five repeats of some experiments."
    return text


def _model_table(diagnosis: Mapping[str, Any]) -> Table:
    rows = tuple(diagnosis["model"]["parameters"].items())
    return Table(("parameter", "value"), rows, "corrected-model", "The corrected model")


def _next_experiment(diagnosis: Mapping[str, Any]) -> str:
    proposal = diagnosis.get("next_experiment")
    if not proposal:
        return ""
    between = " from ".join(proposal.get("between", ()))
    text = f"{proposal.get('description', '')} (setup {proposal.get('setup', '?')})"
    if between:
        text += f" would separate {between}"
    if proposal.get("separation_sigma") is not None:
        text += f" by {proposal['separation_sigma']:.3g} standard deviations"
    return text + "."


def _added_sensor(diagnosis: Mapping[str, Any]) -> str:
    sensor = diagnosis.get("added_sensor")
    if not sensor:
        return ""
    separated = f"{' from '.join(sensor['between'])} by {sensor['separation_sigma']:.3g} standard deviations"
    return (
        f"With a further sensor ({sensor['description']}) the experiments as they are would separate {separated}."
    )
