"""A diagnosis on a terminal: where, what, how much."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from fmuid.cli.output import Printer

if TYPE_CHECKING:
    from fmuid.diagnosis.validation import DiagnosisValidation

_ROWS = 6


def print_diagnosis(diagnosis: Mapping[str, Any], printer: Printer) -> None:
    """Print the verdict, where the gap lies and how far it shrinks, then the likeliest effects as a table."""
    from fmuid.report.diagnosis import facts

    for fact in facts(diagnosis):
        printer.say(f"{fact.label}: {fact.value}")
    for names in diagnosis["alias_classes"]:
        printer.say(f"Cannot be told apart with these sensors and experiments: {', '.join(names)}")
    following = diagnosis.get("next_experiment")
    if following:
        printer.say(
            f"Next experiment: {following['setup']}, {following['description']}"
            f" ({following['separation_sigma']:.3g} standard deviations)"
        )
    if diagnosis["verdict"]["kind"] == "complete" and diagnosis.get("smallest_seen"):
        printer.say(f"Would have been seen, at least this large: {_smallest(diagnosis['smallest_seen'])}")
    for note in diagnosis.get("notes", ()):
        printer.say(f"Note: {note}")
    rows = [_row(e) for e in diagnosis["effects"][:_ROWS]]
    printer.say("")
    printer.table(["effect", "probability", "closure (held out)", "90 % interval", "parameters"], rows)


def _smallest(seen: Mapping[str, Mapping[str, float]]) -> str:
    return "; ".join(f"{e} ({', '.join(f'{n} = {v:.2g}' for n, v in own.items())})" for e, own in seen.items())


def _row(effect: Mapping[str, Any]) -> list[object]:
    closure = effect.get("closure", {})
    interval = "{:.2f} to {:.2f}".format(*closure["interval"]) if closure else ""
    parameters = ", ".join(f"{n} = {_with_error(p)}" for n, p in effect.get("parameters", {}).items())
    held_out = round(closure["held_out"], 3) if closure else None
    return [effect["id"], round(effect["probability"], 3), held_out, interval, parameters]


def _with_error(estimate: Mapping[str, Any]) -> str:
    error = estimate["standard_error"]
    return f"{estimate['value']:.4g}" + ("" if error is None else f" ± {error:.2g}")


def print_validation(found: DiagnosisValidation, printer: Printer) -> None:
    """Print errors by run and signal, then gaps by run."""
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
        ]
        for c in found.comparisons
    ]
    errors = ["RMSE refitted", "corrected", "NRMSE refitted", "corrected"]
    printer.table(["run", "signal", "unit", "noise", *errors], rows)
    printer.say("")
    if not found.gaps:
        printer.say("no gap in noise floors: the runs were not repeated")
        return
    gaps = found.to_dict()["gaps"]
    printer.table(
        ["gap, in noise floors", "refitted", "corrected", "closure"],
        [[name, g["nominal"], g["corrected"], round(g["closure"], 3)] for name, g in gaps.items()],
    )
