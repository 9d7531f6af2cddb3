"""The commands put together, and how they end."""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress

import typer

from fmu_build.errors import UserError
from fmuid.cli import (
    building,
    cataloguing,
    checking,
    comparing,
    demonstrating,
    designing,
    importing,
    opening,
    ranking,
    simulating,
    studying,
)
from fmuid.cli import identifying as identification
from fmuid.cli.interruption import INTERRUPTED
from fmuid.core.errors import AT_A_SHELL, FmuidError

DONE, NO, BAD_INPUT = 0, 1, 2

app = typer.Typer(
    name="fmuid",
    no_args_is_help=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Identify the parameters of FMUs from measurement campaigns, and diagnose what the model misses.",
    epilog="Exit code: 0 success, 1 check failed, 2 bad input, 130 interrupted.",
)
app.command("demo")(demonstrating.demo)
app.command("init")(importing.init)
app.command("build")(building.build)
app.command("check")(checking.check)
app.command("simulate")(simulating.simulate)
app.command("identify")(identification.identify)
app.command("validate")(identification.validate)
app.command("effects")(cataloguing.effects)
app.command("diagnose")(identification.diagnose)
app.command("sensitivity")(ranking.sensitivity)
app.command("study")(studying.study)
app.command("design")(designing.design)
app.command("compare")(comparing.compare)
app.command("import")(importing.import_)
app.command("export")(importing.export)
app.command("report")(identification.report)
app.command("open")(opening.open_)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: bool = typer.Option(False, "--version", help="Print the version and exit."),
) -> None:
    if version:
        from importlib.metadata import version as installed

        typer.echo(installed("fmuid"))
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; every user error is one line on stderr."""
    token = AT_A_SHELL.set(True)
    try:
        return _run(arguments)
    finally:
        AT_A_SHELL.reset(token)


def _run(arguments: Sequence[str] | None) -> int:
    try:
        code = app(arguments, standalone_mode=False)
        sys.stdout.flush()  # reports a full disk here, not when Python ends
    except (FmuidError, UserError) as error:
        return _complain(str(error))
    except typer.TyperException as error:  # unknown option, missing argument, value of the wrong type
        return _complain(_plain(error.format_message().rstrip(".")) + "; see fmuid --help")
    except (typer.Abort, KeyboardInterrupt):
        return _complain("interrupted", INTERRUPTED)
    except BrokenPipeError:  # the reader (head, less) has closed the pipe
        _drop_output()
        return NO
    except OSError as error:  # a disk that is full or gone, a terminal that was closed
        _drop_output()
        place = error.filename or "the output"
        return _complain(f"{place}: cannot be read or written ({error.strerror or error})")
    except MemoryError:
        return _complain("not enough memory; use fewer workers, or less data")
    if code == INTERRUPTED:  # Typer has caught the Ctrl-C
        return _complain("interrupted", INTERRUPTED)
    return code if isinstance(code, int) else DONE


def no_escapes_without_colour() -> None:
    """Leave out bold and dim text in help pages if NO_COLOR is set."""
    if os.environ.get("NO_COLOR"):
        from typer import rich_utils

        rich_utils.COLOR_SYSTEM = None


def warn_in_one_line() -> None:
    """Print warnings in the format of errors."""
    warnings.formatwarning = _warning


def _plain(message: str) -> str:
    """Return a message of Typer with plain English names of types."""
    for name, words in (("int", "whole number"), ("float", "number")):
        message = re.sub(rf"a valid {name}( range)?\b", f"a {words}", message)
    return message


def _warning(message: Warning | str, *_where: object, **_line: object) -> str:
    return f"fmuid: warning: {message}\n"


def _complain(message: str, code: int = BAD_INPUT) -> int:
    with suppress(OSError):  # the terminal is gone
        print(f"fmuid: {' '.join(message.split())}", file=sys.stderr)
    return code


def _drop_output() -> None:
    """Discard standard output from now on, including what is in its buffer."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
