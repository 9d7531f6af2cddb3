"""docs/laws.md has every law as the library has it. FMUID_WRITE_LAWS=1 writes its table."""

from __future__ import annotations

import os
import re
from pathlib import Path

from fmuid.effects.laws import laws

PAGE = Path(__file__).parents[2] / "docs" / "laws.md"
_TABLE = re.compile(r"(?<=<!-- laws -->\n).*(?=<!-- end -->)", re.DOTALL)


def table() -> str:
    rows = ["| law | what it is | formula | where it comes from |", "|---|---|---|---|"]
    for name, law in laws().items():
        given = law.expression
        formula = given if isinstance(given, str) else "; ".join(f"{d}: {e}" for d, e in given.items())
        formula += f"; flow {law.flow}" if law.flow else ""
        formula += "".join(f"; der({s}) = {v.derivative}" for s, v in law.states.items())
        rows.append(f"| `{name}` | {law.words} | `{formula}` | {law.origin} |")
    return "\n".join([*rows, ""])


def test_the_page_has_every_law() -> None:
    text = PAGE.read_text()
    if os.environ.get("FMUID_WRITE_LAWS"):
        PAGE.write_text(_TABLE.sub(lambda _: table(), text))
        text = PAGE.read_text()
    (rows,) = _TABLE.findall(text)
    assert rows == table()
    named = set(re.findall(r"`([a-z_]+)`", text.partition("## All laws")[0]))
    assert named - {"value"} <= {*laws(), "delay", "crosstalk"}
