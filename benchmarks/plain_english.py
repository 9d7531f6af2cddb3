"""Habits of style that this project avoids, found in pages, docstrings, messages and comments.

`make lint` runs this file. Each pattern is a habit, with what to write instead. Code blocks and inline code
of a page are skipped. So are names of variables, except those that name everything.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PLACES = (
    "*.md",
    "docs/**/*.md",
    "src/**/*.py",
    "fmu_build/**/*.py",
    "benchmarks/**/*.py",
    "campaigns/**/*.py",
    "tests/**/*.py",
)
HABITS = {
    r"\breturns? (what|who|whether what)\b": "name the value: 'Return the residuals'",
    r"(^|\. )(?-i:Of) (a|an|all|both|several|the|these|those|two) \w+[^.]{0,40}, ": "put the subject first",
    r"[,;]? too[.;:)]": "write 'also' before the verb",
    r"\b(is|are|was|were|be) (said|told)\b": "is reported, is stated, is called",
    r"\bbesides? (a|an|it|its|the|them|this|these|one|what|another)\b": "next to, in addition to, with",
    r"\b(held|holds|hold) against\b": "compared with",
    r"\bfor want of\b": "because there was no ...",
    r"\bat last\b": "finally",
    r"\bonce more\b": "again",
    r"\bpass(es|ed)? for\b": "be mistaken for",
    r"\bcalled like\b": "named after",
    r"\bkept back\b": "reserved for validation, held out",
    r"\bmade catalogues?\b": "generated catalogue",
    r"\bname (a|an|another|the) (folder|file|path)\b": "choose, give",
    r"\bunknown hands\b": "untrusted",
    r"\bone's own\b": "your own",
    r"\bwithout a word\b": "silently",
    r"\bgone astray\b": "is stuck in a local minimum",
    r"\b(who|what) it is that\b": "say who or what",
    r"\bled out of\b": "escape from",
    r"\bno actuators?\b": "other than actuators",
    r"\bis shipped\b|\bare shipped\b|\bnot shipped\b": "is included",
    r"\bto look through\b": "please review",
    r"\bdoes? the same as\b": "is equivalent to, behaves like",
}
NAMES = {"found", "own", "said"}  # of everything, so of nothing
_HABITS = {re.compile(pattern, re.IGNORECASE | re.MULTILINE): advice for pattern, advice in HABITS.items()}
_CODE = re.compile(r"^```.*?^```|`[^`\n]+`", re.MULTILINE | re.DOTALL)


def prose(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the texts of a file that people read, each with its first line."""
    text = path.read_text()
    if path.suffix == ".md":
        yield 1, _CODE.sub(lambda match: "\n" * match[0].count("\n") + "_", text)
        return
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in (tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", -1)):
            yield token.start[0], token.string


def faults(path: Path) -> list[str]:
    """Return one line for each habit that a file shows."""
    lines = []
    for line, text in prose(path):
        for habit, advice in _HABITS.items():
            for match in habit.finditer(text):
                place = f"{path.relative_to(ROOT)}:{line + text.count(chr(10), 0, match.start())}"
                lines.append(f"{place}: '{' '.join(match[0].split())}': {advice}")
    if path.suffix == ".py":
        for node in ast.walk(ast.parse(path.read_text())):
            stored = isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
            name = node.id if stored else node.arg if isinstance(node, ast.arg) else ""
            if name in NAMES:
                lines.append(f"{path.relative_to(ROOT)}:{node.lineno}: name '{name}': say what it is")
    return lines


def files() -> list[Path]:
    """Return the files that are checked."""
    every = {path.resolve() for place in PLACES for path in ROOT.glob(place)}
    return sorted(every - {Path(__file__).resolve(), ROOT / "tests" / "docs" / "test_plain_english.py"})


def main() -> int:
    """Print the habits found; return 1 if there are any."""
    lines = [line for path in files() for line in faults(path)]
    print("\n".join(lines), end="\n" if lines else "")
    return bool(lines)


if __name__ == "__main__":
    sys.exit(main())
