"""What the studies and converters run by `python -m` share: usage, the one line of error, the exit code."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from fmu_build.errors import UserError, counted
from fmuid.core.errors import FmuidError
from fmuid.core.experiments import Measurements
from fmuid.data.measurements import write_measurements


def run_module(usage: str, arguments: Sequence[str], command: Callable[[Sequence[str]], None]) -> int:
    """Run `command` with the arguments; return the exit code, 2 for a mistake of the user's.

    `usage` names module and arguments, as in ``campaigns.go1.convert CAMPAIGN [FOLDER]``: in brackets what may be
    missing, with dots what may be many.
    """
    words = usage.split()[1:]
    least = sum(not w.startswith("[") for w in words)
    most = float("inf") if usage.endswith("...]") else len(words)
    if not least <= len(arguments) <= most or any(a.startswith("-") for a in arguments[:1]):
        print(f"usage: python -m {usage}", file=sys.stderr)
        return 2

    def work() -> Sequence[str]:
        command(arguments)
        return ()

    return ended(work)


def ended(work: Callable[[], Sequence[str]], *, resumes: bool = False) -> int:
    """Do the work, which returns a line for all that failed, and return the exit code; 130 after Ctrl-C.

    `resumes` says that the same command then goes on where it was.
    """
    try:
        failures = work()
    except (FmuidError, UserError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted" + "; the same command continues" * resumes, file=sys.stderr)
        return 130
    for line in failures:
        print(line, file=sys.stderr)
    return int(bool(failures))


def named_folder(variable: str, default: Path) -> Path:
    """Return the folder that a variable of the environment names, or the default."""
    return Path(os.environ.get(variable) or default)


def convert(usage: str, arguments: Sequence[str], read: Callable[..., Measurements]) -> int:
    """Write what `read` returns of a folder to the campaign that the arguments name; return the exit code."""
    return run_module(usage, arguments, lambda given: write_campaign(given[0], read(*given[1:])))


def write_campaign(campaign: str, measurements: Measurements) -> None:
    """Write the `measurements.h5` of a campaign, named by its folder or its file, and say so."""
    path = Path(campaign)
    target = (path.parent if path.suffix == ".toml" else path) / "measurements.h5"
    write_measurements(measurements, target)
    print(f"{target}: {counted(len(measurements), 'run')}")
