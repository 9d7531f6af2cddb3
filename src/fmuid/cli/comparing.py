"""`fmuid compare`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from fmuid.cli.output import Json, Printer, Quiet, numbers, writable
from fmuid.cli.supervised import MemoryLimit, TimeLimit, Workers, supervised
from fmuid.core.errors import FmuidError

if TYPE_CHECKING:
    from fmuid.comparison.drift import Drift

_HEADER = ("variable", "NRMSE", "max error", "at s", "outside", "within")


def compare(
    result: Annotated[Path, typer.Argument(help="FMU, CSV file, or folder of CSV files to compare.")],
    reference: Annotated[
        Path,
        typer.Argument(
            help="CSV file of the reference (`time` first), or a folder; for an FMU, including its inputs."
        ),
    ],
    variables: Annotated[
        list[str] | None, typer.Option("--variable", "-v", help="Compare this variable only (repeat for more).")
    ] = None,
    tolerance: Annotated[float, typer.Option(min=0.0, help="Largest acceptable NRMSE.")] = 1e-3,
    funnel: Annotated[
        float | None,
        typer.Option(min=0.0, help="Judge by a funnel of this half-width, as a fraction of the range."),
    ] = None,
    funnel_time: Annotated[float, typer.Option(min=0.0, help="Half-width of the funnel in time, s.")] = 0.0,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Set a parameter of the FMU (repeat).")
    ] = None,
    interpolation: Annotated[
        Literal["hold", "linear", "band-limited"],
        typer.Option(help="Interpolation of the FMU's inputs between samples of the reference."),
    ] = "hold",
    out: Annotated[
        Path | None,
        typer.Option(
            help="Write the table as CSV; for a folder, a report with figures of the variables out of tolerance.",
            callback=writable,
        ),
    ] = None,
    workers: Workers = None,
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Compare a RESULT with a REFERENCE, variable by variable; exit code 1 if one is out of tolerance.

    NRMSE is the root mean square error at the reference's times, divided by the reference's range. An FMU is
    simulated with the inputs of each reference.

    Example: fmuid compare FixedShaft.csv references/FixedShaft.csv --tolerance 1e-4

    Example: fmuid compare Drive.fmu references --funnel 0.01 --funnel-time 0.002 --out drift
    """
    from fmuid.comparison.drift import drift_of, write_drift_report
    from fmuid.core.files import write_atomically

    if funnel_time and funnel is None:
        raise FmuidError("--funnel-time without --funnel", fix="also give the funnel's half-width: --funnel 0.01")
    printer = Printer(quiet, json)
    with printer.working(f"comparing {result}"), supervised(workers, time_limit, memory_limit) as runner:
        drifts = drift_of(
            result,
            reference,
            tolerance=tolerance,
            funnel=None if funnel is None else (funnel, funnel_time),
            names=variables or (),
            parameters=numbers(set_ or [], "--set"),
            interpolation=interpolation,
            runner=runner,
        )
    several = len(drifts) > 1
    header = ("reference", *_HEADER) if several else _HEADER
    rows = _rows(drifts, several)
    printer.table(header, rows)
    bad = [(d, c) for d in drifts for c in d.comparisons if not c.within]
    limit = f"NRMSE {tolerance:g}" if funnel is None else f"funnel {funnel:g} of the range, {funnel_time:g} s"
    for drift, c in bad:
        spans = ", ".join(f"{a:g} to {b:g} s" for a, b in c.spans[:4]) + (" ..." if len(c.spans) > 4 else "")
        printer.say(f"{drift.name}: {c.name} is outside from {spans}")
    printer.say(f"{len(bad)} of {len(rows)} out of tolerance ({limit})" if bad else f"all within {limit}")
    if out is not None and out.suffix == ".csv":
        lines = [",".join(f'"{h}"' for h in header)]
        lines += [
            ",".join("" if v is None else f'"{v}"' if isinstance(v, str) else repr(v) for v in r) for r in rows
        ]
        write_atomically(out, "\n".join(lines) + "\n")
    elif out is not None:
        printer.say(f"report: {write_drift_report(drifts, out, f'{result.name} against {reference}, {limit}')}")
    printer.write(
        {
            "result": result,
            "reference": reference,
            "tolerance": tolerance,
            "funnel": None if funnel is None else {"value": funnel, "time": funnel_time},
            "within": not bad,
            "references": [d.to_dict() for d in drifts],
        }
    )
    return 1 if bad else 0


def _rows(drifts: Sequence[Drift], several: bool) -> list[tuple[object, ...]]:
    return [
        (
            *([d.name] if several else []),
            c.name,
            c.nrmse,
            c.max_error,
            c.max_error_time,
            c.outside,
            "yes" if c.within else "NO",
        )
        for d in drifts
        for c in d.comparisons
    ]
