"""`fmuid compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fmuid.cli.output import Json, Printer, Quiet
from fmuid.errors import FmuidError


def compare(
    result: Annotated[Path, typer.Argument(help="CSV file to judge, `time` first.")],
    reference: Annotated[Path, typer.Argument(help="CSV file with the reference result.")],
    variables: Annotated[
        list[str] | None, typer.Option("--variable", "-v", help="Compare this one only (repeat for more).")
    ] = None,
    tolerance: Annotated[float, typer.Option(min=0.0, help="Largest NRMSE that is within tolerance.")] = 1e-3,
    funnel: Annotated[
        float | None,
        typer.Option(min=0.0, help="Judge by a funnel of this half-width, as a fraction of the range."),
    ] = None,
    funnel_time: Annotated[float, typer.Option(min=0.0, help="Half-width of the funnel in time, s.")] = 0.0,
    out: Annotated[Path | None, typer.Option(help="Write the table as CSV.")] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Compare a RESULT with a REFERENCE, variable by variable; exit code 1 if one is out of tolerance.

    NRMSE is the root mean square error at the reference's times over the reference's range.

    Example: fmuid compare FixedShaft.csv references/FixedShaft.csv --tolerance 1e-4
    """
    from fmuid.compare import compare_tables
    from fmuid.crosscheck_csv import read_csv
    from fmuid.files import write_atomically

    if funnel_time and funnel is None:
        raise FmuidError("--funnel-time without --funnel", fix="give the funnel's half-width too: --funnel 0.01")
    try:
        found = compare_tables(
            read_csv(result),
            read_csv(reference),
            tolerance=tolerance,
            funnel=None if funnel is None else (funnel, funnel_time),
            names=variables or (),
        )
    except FmuidError as error:
        if error.where is not None:
            raise
        raise type(error)(error.what, where=f"{result} against {reference}", fix=error.fix) from None
    header = ("variable", "NRMSE", "max error", "at s", "outside", "within")
    rows = [
        (c.name, c.nrmse, c.max_error, c.max_error_time, c.outside, "yes" if c.within else "NO") for c in found
    ]
    printer = Printer(quiet, json)
    printer.table(header, rows)
    bad = [c.name for c in found if not c.within]
    limit = f"NRMSE {tolerance:g}" if funnel is None else f"funnel {funnel:g} of the range, {funnel_time:g} s"
    printer.say(f"{len(bad)} of {len(found)} out of tolerance ({limit})" if bad else f"all within {limit}")
    if out is not None:
        lines = [",".join(f'"{h}"' for h in header)]
        lines += [
            ",".join("" if v is None else f'"{v}"' if isinstance(v, str) else repr(v) for v in r) for r in rows
        ]
        write_atomically(out, "\n".join(lines) + "\n")
    printer.write(
        {
            "result": result,
            "reference": reference,
            "tolerance": tolerance,
            "funnel": None if funnel is None else {"value": funnel, "time": funnel_time},
            "within": not bad,
            "variables": [
                {
                    "name": c.name,
                    "nrmse": c.nrmse,
                    "max_error": c.max_error,
                    "max_error_time": c.max_error_time,
                    "outside": c.outside,
                    "within": c.within,
                }
                for c in found
            ],
        }
    )
    return 1 if bad else 0
