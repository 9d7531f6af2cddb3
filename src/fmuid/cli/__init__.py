"""The command line `fmuid`. Heavy imports happen inside the commands, so that `--help` is quick."""

from __future__ import annotations

import os
import sys

from fmuid.cli.interruption import INTERRUPTED, Interruption

__all__ = ["main"]


def main() -> None:
    """Entry point of the console script."""
    _open_what_is_closed()
    interruption = Interruption()
    try:
        from fmuid.cli.app import no_escapes_without_colour, run, warn_in_one_line

        warn_in_one_line()
        no_escapes_without_colour()
        code = run()
    except (KeyboardInterrupt, Exception) as error:  # while modules are loaded
        if not _follows_interruption(error):
            raise
        print("fmuid: interrupted", file=sys.stderr)
        code = INTERRUPTED
    interruption.end(code)
    sys.exit(code)


def _follows_interruption(error: BaseException | None) -> bool:
    """Return whether an error is an interruption, or Python or a library raised it because of one."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _open_what_is_closed() -> None:
    """Redirect closed standard streams to the null device; otherwise the next opened file gets their text."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, os.O_RDWR)
            if descriptor != number:
                os.dup2(descriptor, number)
                os.close(descriptor)
            os.set_inheritable(number, True)
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))  # noqa: SIM115
