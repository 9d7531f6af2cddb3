"""The command line `fmuid`. Heavy imports happen inside the commands, so that `--help` is quick."""

from fmuid.cli.app import app, main

__all__ = ["app", "main"]
