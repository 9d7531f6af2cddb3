"""`python -m fmuid.virtual_rig CAMPAIGN`: carry out the campaign's `rig.toml` into its `measurements.h5`."""

from __future__ import annotations

import sys
from pathlib import Path

from fmuid.errors import FmuidError
from fmuid.measurements import write_measurements
from fmuid.virtual_rig.plan import carry_out, load_plan


def main(arguments: list[str]) -> int:
    """Make the measurements of one campaign folder; return the exit code."""
    if len(arguments) != 1 or arguments[0].startswith("-"):
        print("usage: python -m fmuid.virtual_rig CAMPAIGN", file=sys.stderr)
        return 2
    folder = Path(arguments[0])
    target = (folder if folder.is_dir() else folder.parent) / "measurements.h5"
    try:
        measurements = carry_out(load_plan(folder))
        write_measurements(measurements, target)
    except FmuidError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{target}: {len(measurements)} runs")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
