"""The command line `fmuid`. Heavy imports happen inside the commands, so that `--help` is quick."""

from __future__ import annotations

import sys

from fmuid.cli.interruption import INTERRUPTED, Interruption

__all__ = ["main"]


def main() -> None:
    """Entry point of the console script."""
    interruption = Interruption()
    try:
        from fmuid.cli.app import no_escapes_without_colour, run, warn_in_one_line

        warn_in_one_line()
        no_escapes_without_colour()
        code = run()
    except KeyboardInterrupt:  # while modules are loaded
        print("fmuid: interrupted", file=sys.stderr)
        code = INTERRUPTED
    interruption.end()
    sys.exit(code)
