"""`fmuid demo`."""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from fmuid.cli.output import Json, Printer, Quiet


def demo(
    context: typer.Context,
    out: Annotated[Path, typer.Option(help="New folder for the demo.")] = Path("fmuid-demo"),
    show: Annotated[
        bool | None,
        typer.Option("--open/--no-open", help="Open the report in a browser (default: if there is a display)."),
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> None:
    """Show every step on a small drive, from logs and a model to the missing effect, in about a minute.

    The logs contain an effect that the model lacks. The commands are the same for your own model and logs.

    Example: fmuid demo
    """
    from fmuid.demo.drive import make_rig

    printer = Printer(quiet, json)
    with printer.working("simulating the logs of a rig"):
        rig = make_rig(out)
    campaign, run, diagnosis = out / "campaign", out / "identified", out / "diagnosis"
    printer.say(f"A drive: its model, and {len(rig.logs)} logs of a rig with an effect that the model lacks.")
    commands = [
        ["init", *map(str, rig.logs), *rig.model, "--out", str(campaign)],
        ["identify", str(campaign), "--out", str(run), "--no-report"],
        ["diagnose", str(campaign), "--out", str(diagnosis)],
    ]
    for command in commands:
        shown = [word for word in command if word not in map(str, rig.logs[1:])]
        printer.say(f"\n$ fmuid {shlex.join(shown).replace(str(rig.logs[0]), str(out / 'logs' / '*.csv'))}")
        _run(context, [*command, *(["--quiet"] if quiet else [])])
    page = diagnosis / "index.html"
    printer.say(f"\nThe answer that fmuid did not know: the rig has {rig.lacking}.")
    printer.say(f"Report: {page}")
    printer.next("fmuid init LOG... --model MODEL.mo", "or --fmu MODEL.fmu: the same with your own model and logs")
    printer.write({"out": out, "report": page, "lacking": str(rig.lacking)})
    if _has_display() if show is None else show:
        import webbrowser

        webbrowser.open(page.resolve().as_uri())


def _run(context: typer.Context, command: list[str]) -> None:
    """Run one of fmuid's commands."""
    program: Any = context.find_root().command
    program.main(command, prog_name="fmuid", standalone_mode=False)


def _has_display() -> bool:
    """Return whether there is a screen to open a browser on: a terminal with a window system, and no ssh."""
    if not sys.stdout.isatty() or "SSH_CONNECTION" in os.environ:
        return False
    return sys.platform in ("win32", "darwin") or not {"DISPLAY", "WAYLAND_DISPLAY"}.isdisjoint(os.environ)
