"""docs/numbers.md has every number set by hand in a diagnosis, with its reason. FMUID_WRITE_NUMBERS=1 writes its table."""

from __future__ import annotations

import ast
import os
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "numbers.md"
SOURCES = [
    *sorted((ROOT / "src" / "fmuid" / "diagnosis").glob("*.py")),
    *sorted((ROOT / "src" / "fmuid" / "effects").glob("*.py")),
    *sorted((ROOT / "src" / "fmuid" / "discovery").glob("*.py")),
    ROOT / "src" / "fmuid" / "simulation" / "linear_response.py",
    ROOT / "src" / "fmuid" / "diagnosis_pipeline.py",
]
_TABLE = re.compile(r"(?<=<!-- numbers -->\n).*(?=<!-- end -->)", re.DOTALL)


def numbers(path: Path) -> dict[str, str]:
    """Constants of a module that are numbers, with their values, and the comment that gives their reason."""
    text = path.read_text()
    lines, found = text.splitlines(), {}
    for node in ast.parse(text).body:
        value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
        held = [] if value is None else list(ast.walk(value))
        texts = any(isinstance(n, ast.Constant) and isinstance(n.value, str) for n in held)
        if value is None or texts or not any(isinstance(n, ast.Constant) for n in held):
            continue
        target = ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target).strip("()")
        if target.isupper() and not re.fullmatch("_?[A-Z]", target):
            reason = lines[node.end_lineno - 1].partition("  # ")[2]
            found[f"{target} = {shown(value)}"] = reason
    return found


def shown(value: ast.expr) -> str:
    return ast.unparse(value).strip("()") if isinstance(value, ast.Tuple) else ast.unparse(value)


def table() -> str:
    rows = ["| number | where | reason |", "|---|---|---|"]
    for path in SOURCES:
        rows += [f"| `{number}` | `{path.stem}` | {reason} |" for number, reason in numbers(path).items()]
    return "\n".join([*rows, ""])


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.stem)
def test_every_number_has_a_reason(path: Path) -> None:
    assert [number for number, reason in numbers(path).items() if not reason] == []


def test_the_page_has_every_number() -> None:
    text = PAGE.read_text()
    if os.environ.get("FMUID_WRITE_NUMBERS"):
        PAGE.write_text(_TABLE.sub(lambda _: table(), text))
        text = PAGE.read_text()
    (found,) = _TABLE.findall(text)
    assert found == table()
