"""The source line of what the front end has a message but no place for."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

BLANKED = re.compile(r'"(?:\\.|[^"\\])*"|//[^\n]*|/\*.*?\*/', re.DOTALL)
_KINDS = r"(?:model|block|class|record|connector|package|function|type)"
# What a message is about, where the name in it is not the construct: words of the message, and what to look for.
_CONSTRUCTS = (
    ("statement without a checked DAE owner", r"\bwhile\b"),
    ("derivative expression", r"\bder\s*\((?!\s*\w+\s*\))"),
    ("continuous state", r"\bder\s*\("),
    ("initial algorithm", r"\binitial\s+algorithm\b"),
    ("algorithm", r"\balgorithm\b"),
    ("When statements", r"\balgorithm\b"),
    ("for-equation range", r"\bfor\b"),
    ("if-equation", r"\bif\b"),
    ("cannot extend", r"\bextends\b"),
)
_NAMED = re.compile(r"[`'‘]([A-Za-z_][\w.]*)(?:\[[^\]]*\])?[`'’]|\b([A-Za-z_]\w*)\(")
_NO_NAMES = {"size", "array", "type", "expected"}


def blanked(text: str) -> str:
    """Return Modelica text with comments and strings blanked, its lines as they were."""
    return BLANKED.sub(lambda m: re.sub(r"[^\n]", " ", m.group(0)), text)


def declared(files: Sequence[Path]) -> list[str]:
    """Return the qualified names of all models and blocks that are written out in some files."""
    found = []
    for path in files:
        text = blanked(path.read_text(encoding="utf-8", errors="replace"))
        within = re.search(r"\bwithin\s+([\w.]+)\s*;", text)
        outer = [within.group(1)] if within else []
        for begin in re.finditer(rf"\b({_KINDS})\s+(\w+)(?!\w|\s*=)|\bend\s+(\w+)\s*;", text):
            kind, name, end = begin.groups()
            if name and kind != "type":
                outer.append(name)
                if kind in ("model", "block", "class"):
                    found.append(".".join(outer))
            elif end and outer and outer[-1] == end:
                outer.pop()
    return found


def locate(message: str, class_name: str, files: Sequence[Path]) -> str | None:
    """Place of a front end's message as ``file:line``.

    The first mention, in the class (or the function) that the message is about, of what it names; else where that
    class begins; None if its source is not among the files.
    """
    named = [a or b for a, b in _NAMED.findall(message)]
    for path, text, start, end in _bodies(class_name, files):
        for name in dict.fromkeys(n.rpartition(".")[2] for n in named):
            function = re.search(rf"\bfunction\s+{re.escape(name)}\b", text)
            if function:
                close = re.search(rf"\bend\s+{re.escape(name)}\b", text[function.start() :])
                start, end = function.start(), function.start() + close.start() if close else end
                break
        for words, pattern in _CONSTRUCTS:
            found = re.search(pattern, text[start:end]) if words in message else None
            if found:
                return _line(path, text, start + found.start())
        for name in named:
            last = re.escape(name.rpartition(".")[2])
            dotted = r"\s*\.\s*".join(map(re.escape, name.split(".")))
            for pattern in (rf"\bredeclare\b[^;]*?\b{last}\b", rf"(?<![\w.]){dotted}\b", rf"\b{last}\b"):
                found = re.search(pattern, text[start:end]) if name not in _NO_NAMES else None
                if found and not re.fullmatch(class_name.rpartition(".")[2], name.rpartition(".")[2]):
                    return _line(path, text, start + found.start())
        return _line(path, text, start)
    return None


def _bodies(class_name: str, files: Sequence[Path]) -> Iterator[tuple[Path, str, int, int]]:
    """Yield where a class is declared: path, blanked text, its begin and end; files named like it first."""
    package, _, last = class_name.rpartition(".")
    for path in sorted(files, key=lambda p: p.stem != last):
        text = path.read_text(encoding="utf-8", errors="replace")
        if not re.search(rf"\b{re.escape(last)}\b", text):
            continue
        text = blanked(text)
        within = re.search(r"\bwithin\s+([\w.]+)\s*;", text)
        if within and not f"{package}.".startswith(f"{within.group(1)}."):
            continue
        begin = re.search(rf"\b{_KINDS}\s+{re.escape(last)}\b", text)
        if begin:
            ends = [m.start() for m in re.finditer(rf"\bend\s+{re.escape(last)}\b", text)]
            yield path, text, begin.start(), ends[-1] if ends else len(text)


def _line(path: Path, text: str, position: int) -> str:
    return f"{path.name}:{text.count(chr(10), 0, position) + 1}"
