"""`python -m benchmarks.virtual_rig CAMPAIGN`: carry out the campaign's `rig.toml` into its `measurements.h5`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.study_command import run_module, write_campaign
from benchmarks.virtual_rig.rig_plan import carry_out, load_plan


def main(arguments: Sequence[str]) -> int:
    """Make the measurements of one campaign folder; return the exit code."""

    def command(given: Sequence[str]) -> None:
        write_campaign(given[0], carry_out(load_plan(Path(given[0]))))

    return run_module("benchmarks.virtual_rig CAMPAIGN", arguments, command)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
