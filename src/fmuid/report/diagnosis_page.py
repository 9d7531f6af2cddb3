"""The report of a diagnosis: where the gap lies, what causes it, how far it shrinks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from fmuid.diagnosis.summary import facts, in_words, indistinct, machine_lines, sentences
from fmuid.report import diagnosis_figures as pictures_of
from fmuid.report.diagnosis_figures import DiagnosisPictures
from fmuid.report.document import Document, Drawing, Section, present, write_document
from fmuid.report.plots import Format
from fmuid.report.provenance_table import provenance_table

_NOTHING = DiagnosisPictures()


def write_diagnosis_report(
    diagnosis: Mapping[str, Any],
    out: str | Path,
    *,
    campaign: str,
    pictures: DiagnosisPictures = _NOTHING,
    model: Drawing | None = None,
    provenance: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    formats: tuple[Format, ...] = ("png",),
) -> Path:
    """Write the report of a diagnosis and return the path of its ``index.html``.

    Parameters
    ----------
    diagnosis
        The value of the diagnosis' JSON (``fmuid-diagnosis``, version 2).
    out
        Folder for ``index.html``, ``figures/`` and ``data/``.
    campaign
        Title of the campaign.
    pictures
        The arrays behind the pictures.
    model
        The model's components, with the place marked.
    provenance
        Names and values of everything that the result depends on: hashes, versions, commands.
    units
        Units of the parameters of the campaign and of effects, by name.
    formats
        File formats of the figures.

    Raises
    ------
    FmuidError
        The folder cannot be written.
    """
    places = present(model, pictures_of.where_table(diagnosis))
    sections = (
        Section(
            "Before and after",
            present(
                pictures_of.before_and_after(pictures.overlays),
                pictures_of.gap_figure(diagnosis, pictures.steps),
                pictures_of.parameters_table(diagnosis, units),
            ),
            abreast=bool(pictures.overlays),
        ),
        Section(
            "Where", (*places, *present(pictures_of.excess_figure(pictures.excess))), abreast=len(places) == 2
        ),
        Section(
            "What",
            present(
                pictures_of.effects_figure(diagnosis),
                pictures_of.missing_figure(pictures.missing),
                pictures_of.ports_figure(diagnosis),
                pictures_of.effects_table(diagnosis, refitted=True, units=units),
            ),
            " ".join(f"{line}." for line in indistinct(diagnosis)),
            present(
                pictures_of.effects_table(diagnosis, refitted=False), pictures_of.seen_table(diagnosis, units)
            ),
            "Effects with scores too low for a refit"
            + ("" if diagnosis["gap"]["present"] else ", and sizes that would have been seen"),
        ),
        Section(
            "A law found",
            present(pictures_of.law_figure(diagnosis), pictures_of.law_table(diagnosis)),
            _law(diagnosis),
        ),
        Section("A table", present(pictures_of.tables_figure(diagnosis)), " ".join(_tables(diagnosis))),
        Section("Between machines", present(pictures_of.machines_table(diagnosis)), _machines(diagnosis)),
        Section("Next experiment", (), f"{_next_experiment(diagnosis)} {_added_sensor(diagnosis)}".strip()),
        Section("Notes", (), " ".join(diagnosis.get("notes", ()))),
        Section("Provenance", (provenance_table(provenance or {}),)),
    )
    document = Document(
        f"Diagnosis: {campaign}",
        diagnosis["verdict"].get("text") or " ".join(sentences(diagnosis)),
        facts(diagnosis),
        tuple(s for s in sections if s.items or s.text),
    )
    return write_document(document, Path(out), formats)


def _law(diagnosis: Mapping[str, Any]) -> str:
    law = diagnosis.get("law_found")
    if not law:
        return ""
    if not law["formula"]:
        return f"None: {law['reason']}."
    return f"In Modelica, a flow at {law['port']}: {law['modelica']}."


def _tables(diagnosis: Mapping[str, Any]) -> Iterator[str]:
    for table in diagnosis.get("refinements") or ():
        what = "Learned" if table["learned"] else f"A refinement of {in_words(table['law'])}"
        yield f"{what}; in the corrected model, it is `{table['id']}`."


def _machines(diagnosis: Mapping[str, Any]) -> str:
    return " ".join(f"{line}." for line in machine_lines(diagnosis))


def _next_experiment(diagnosis: Mapping[str, Any]) -> str:
    proposal = diagnosis.get("next_experiment")
    if not proposal:
        ambiguous = diagnosis["verdict"]["kind"] == "ambiguous"
        return "`fmuid design --for diagnosis` searches for a run that settles it." if ambiguous else ""
    between = " from ".join(proposal.get("between", ()))
    text = f"{proposal.get('description', '')} (setup {proposal.get('setup', '?')})"
    if between:
        text += f" would separate {between}"
    if proposal.get("separation_sigma") is not None:
        text += f" by {proposal['separation_sigma']:.3g} standard deviations"
    return text + ". `fmuid design --for diagnosis` searches for a better one within the rig's limits."


def _added_sensor(diagnosis: Mapping[str, Any]) -> str:
    sensor = diagnosis.get("added_sensor")
    if not sensor:
        return ""
    separated = f"{' from '.join(sensor['between'])} by {sensor['separation_sigma']:.3g} standard deviations"
    return f"With an additional sensor ({sensor['description']}), the existing runs would separate {separated}."
