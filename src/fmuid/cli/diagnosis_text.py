"""Print a diagnosis: where, what, how much."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from fmuid.cli.output import Printer

if TYPE_CHECKING:
    from fmuid.diagnosis.corrected import DiagnosisValidation


def print_diagnosis(diagnosis: Mapping[str, Any], printer: Printer) -> None:
    """Print the verdict, where the gap lies and how far it shrinks, then the likeliest effects as a table."""
    from fmuid.diagnosis.summary import likeliest, summary

    for line in summary(diagnosis):
        printer.say(line)
    header, *rows = likeliest(diagnosis)
    printer.say("")
    printer.table(header, rows)
    if diagnosis.get("rehearsal"):
        _print_rehearsal(diagnosis["rehearsal"], printer)


def _print_rehearsal(rehearsal: Sequence[Mapping[str, Any]], printer: Printer) -> None:
    """Print which known effects were found in simulated plants with logs like the campaign's."""
    right = sum(trial["right"] for trial in rehearsal)
    printer.say(f"\nrehearsal: {right} of {len(rehearsal)} simulated plants with logs like yours diagnosed right")
    header = ["effect of the plant", "gap, floors", "verdict", "named", "right"]
    rows = [
        [
            " and ".join(trial["truth"]),
            f"{trial['gap']:.1f}",
            trial["verdict"],
            ", ".join(trial["named"]),
            "yes" if trial["right"] else "no",
        ]
        for trial in sorted(rehearsal, key=lambda t: (t["truth"], t["gap"]))
    ]
    printer.table(header, rows)


def print_validation(validation: DiagnosisValidation, answer: Mapping[str, Any], printer: Printer) -> None:
    """Print the correction, the runs that test it, errors by run and signal, and gaps by run."""
    from fmuid.diagnosis.corrected import law_of
    from fmuid.diagnosis.cross_validation import share_closed

    verdict, law = answer["verdict"], law_of(answer)
    if law is not None:
        printer.say(f"corrected: with {law['id']}, a flow of {law['formula']}")
    elif verdict["one_of"]:
        named = [*verdict["effects"], *verdict["one_of"][0]]
        printer.say(f"corrected: with {' and '.join(named)}, one of {len(verdict['one_of'])} possible answers")
    elif verdict["effects"]:
        printer.say(f"corrected: with {' and '.join(verdict['effects'])}")
    else:
        printer.say(
            "corrected: nothing, because the diagnosis names no effect; both columns are the refitted nominal"
            " model"
        )
    if validation.used is None:
        printer.say("the diagnosis does not record its runs; those below may be among them")
    elif validation.used:
        printer.say(f"used for the diagnosis, so not a test of it: {', '.join(validation.used)}")
    else:
        printer.say(f"not used for the diagnosis: {', '.join(validation.runs)}")
    for note in validation.notes:
        printer.say(note)
    rows = [
        [
            c.experiment,
            c.signal,
            c.unit or "",
            c.noise,
            c.rmse_nominal,
            c.rmse_corrected,
            f"{100 * c.nrmse_nominal:.3g} %",
            f"{100 * c.nrmse_corrected:.3g} %",
            f"{100 * share_closed(c.rmse_nominal, c.rmse_corrected):.3g} %",
        ]
        for c in validation.comparisons
    ]
    errors = ["RMSE refitted", "corrected", "NRMSE refitted", "corrected", "closed"]
    printer.table(["run", "signal", "unit", "noise", *errors], rows)
    printer.say("")
    if not validation.gaps:
        printer.say("no gap in noise floors: the runs were not repeated")
        return
    gaps = validation.to_dict()["gaps"]
    printer.table(
        ["gap, in noise floors", "refitted", "corrected", "closure"],
        [[name, g["nominal"], g["corrected"], round(g["closure"], 3)] for name, g in gaps.items()],
    )
    if validation.interval is not None:
        low, high = validation.interval
        printer.say(f"closed on these runs: {gaps['all']['closure']:.2f} ({low:.2f} to {high:.2f}, 90 %)")
