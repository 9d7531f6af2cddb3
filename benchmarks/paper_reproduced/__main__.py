"""The paper of 2003 reproduced: ``make paper``.

``measurements`` records `campaigns/paper` on the virtual rig; ``page DIRECT LEAST_SQUARES`` writes
`docs/tutorials/paper.md` and its figures from the campaign's two identifications.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.paper_reproduced.page import write_page
from benchmarks.paper_reproduced.recorded import CAMPAIGN, measured
from benchmarks.study_command import run_module, write_campaign


def main(arguments: Sequence[str]) -> int:
    """Record, or write the page; return the exit code."""
    if arguments[:1] == ["measurements"]:
        usage = "benchmarks.paper_reproduced measurements"
        return run_module(usage, arguments, lambda _: write_campaign(str(CAMPAIGN), measured()))
    usage = "benchmarks.paper_reproduced page DIRECT LEAST_SQUARES"
    return run_module(usage, arguments, lambda given: write_page(Path(given[1]), Path(given[2])))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
