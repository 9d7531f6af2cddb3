"""How runs end that are stopped, or that cannot succeed: `docs/errors.md` has the line of each."""

from __future__ import annotations

import os
import re
import shlex
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from endings import ENDINGS, FMUID, Ending, run, shown

PAGE = Path(__file__).parents[2] / "docs" / "errors.md"
HEAD = """
## Runs that are stopped, or cannot succeed

These are also reported in one line, but there is a result, or something to continue from ([nothing is lost](nothing_lost.md)).

| what happens | to | exit code | the line |
|---|---|---|---|
"""


@pytest.mark.parametrize(
    "ending",
    [pytest.param(e, marks=() if k in (0, 8, 11) else pytest.mark.slow, id=e.what) for k, e in enumerate(ENDINGS)],
)
def test_how_a_run_ends(ending: Ending, folder: Path) -> None:
    ending.make()
    done = (ending.end or run)([*FMUID, *shlex.split(ending.command)])
    assert "Traceback" not in done.stderr or ending.program == "python"  # of the user's own script
    assert done.returncode == ending.code, done.stderr
    lines = [line for line in (done.stderr + done.stdout).splitlines() if re.search(ending.line, line)]
    line = shown(lines[-1].strip().removeprefix("! "))
    mark = "``" if "`" in line else "`"
    row = f"| {ending.what} | `{ending.program} {ending.command}` | {ending.code} | {mark}{line}{mark} |"
    if "FMUID_WRITE_ERRORS" in os.environ:
        before, _, after = PAGE.read_text().partition(HEAD)
        rows, end = after[: after.index("\n\n")], after[after.index("\n\n") :]
        PAGE.write_text(f"{before}{HEAD}{'' if ending is ENDINGS[0] else rows + chr(10)}{row}{end}")
    assert row in PAGE.read_text().splitlines()


def test_the_page_has_no_other_endings() -> None:
    _, _, section = PAGE.read_text().partition(HEAD)
    assert len(section.partition("\n\n")[0].splitlines()) == len(ENDINGS)
