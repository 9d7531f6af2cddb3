"""`fmuid open`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fmuid.cli.importing import Columns, Rate, Sigmas, Units
from fmuid.cli.libraries import Roots
from fmuid.cli.output import Printer, Trust
from fmuid.cli.supervised import Workers, supervised
from fmuid.core.errors import FmuidError


def open_(
    what: Annotated[
        list[Path],
        typer.Argument(
            metavar="CAMPAIGN|RUN|LOG...", help="A campaign, a run folder, or logs with --model or --fmu."
        ),
    ],
    model: Annotated[Path | None, typer.Option(help="Modelica file of the model, for logs.")] = None,
    fmu: Annotated[Path | None, typer.Option(help="FMU of the model, for logs.")] = None,
    class_name: Annotated[str | None, typer.Option("--class", help="Class name (default: file name).")] = None,
    root: Roots = None,
    out: Annotated[Path, typer.Option(help="Folder of the new campaign, for logs.")] = Path("campaign"),
    unit: Units = None,
    sigma: Sigmas = None,
    columns: Columns = None,
    rate: Rate = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 chooses a free one.")] = 0,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True,
    workers: Workers = None,
    trust: Trust = False,
) -> None:
    """Open a page to prepare a campaign, follow and steer its identification, and look at the result.

    The page is served to this machine only, at an address with a secret token.

    Example: fmuid open campaigns/force_feedback
    Example: fmuid open logs/step.csv logs/prbs.csv --model MyDrive.mo
    """
    import importlib.util

    if importlib.util.find_spec("nicegui") is None or importlib.util.find_spec("tomlkit") is None:
        raise FmuidError("the page needs further packages", fix="install them with: pip install 'fmuid[page]'")
    from fmuid.page.opened import NewFrom, open_page

    new = None
    if model is not None or fmu is not None:
        from fmuid.cli.importing import given_of, layout_of
        from fmuid.cli.output import numbers, pairs

        new = NewFrom(
            given_of(fmu, model, class_name, root or []),
            out,
            units=pairs(unit or [], "--unit"),
            sigmas=numbers(sigma or [], "--sigma"),
            layout=layout_of(columns, rate),
        )
    printer = Printer()
    with supervised(workers) as runner:
        open_page(what, new, runner=runner, port=port, browser=browser, trust=trust, say=printer.say)
