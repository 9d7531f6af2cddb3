"""Numbers of a diagnosis that were set by hand, from the constants in the code and the comments behind them."""

from __future__ import annotations

import ast
import re
from pathlib import Path

_SOURCE = Path(__file__).parents[1] / "src" / "fmuid"
MODULES = [
    *(path for name in ("diagnosis", "effects", "discovery") for path in sorted((_SOURCE / name).glob("*.py"))),
    _SOURCE / "simulation" / "linear_response.py",
    _SOURCE / "diagnosis_pipeline.py",
]


def numbers(path: Path) -> dict[str, str]:
    """Return the constants of a module that are numbers, with their values, and the reason of each."""
    text = path.read_text()
    lines, reasons = text.splitlines(), {}
    for node in ast.parse(text).body:
        value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
        parts = [] if value is None else list(ast.walk(value))
        texts = any(isinstance(n, ast.Constant) and isinstance(n.value, str) for n in parts)
        if value is None or texts or not any(isinstance(n, ast.Constant) for n in parts):
            continue
        target = ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target).strip("()")
        if target.isupper() and not re.fullmatch("_?[A-Z]", target):
            shown = ast.unparse(value)[1:-1] if isinstance(value, ast.Tuple) else ast.unparse(value)
            reasons[f"{target} = {shown}"] = lines[(node.end_lineno or node.lineno) - 1].partition("  # ")[2]
    return reasons


def table() -> str:
    """Return all of them as a table in Markdown."""
    rows = ["| number | where | reason |", "|---|---|---|"]
    for path in MODULES:
        rows += [f"| `{number}` | `{path.stem}` | {reason} |" for number, reason in numbers(path).items()]
    return "\n".join(rows)
