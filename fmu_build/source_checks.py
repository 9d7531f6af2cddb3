"""Constructs that the front end drops without a word, found in the source text and refused.

rumoca 0.10.2 loses the modifiers of a class redeclared inside a modification (``M(redeclare model L = X(k = 3))``)
and of a short class that is declared replaceable and then redeclared, redeclarations below the first level of a
modification (``M(part(redeclare model L = X))``) and of a component that the extended class itself inherits,
modifiers with a dotted name (``M(part.k = 3)``) and ``break``. The flat result shows no trace of them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from fmu_build.errors import ModelicaError
from fmu_build.source_locations import blanked

_KINDS = r"(?:model|block|class|record|connector|package|function|type)"
_REDECLARED = re.compile(rf"\bredeclare\s+(?:replaceable\s+)?{_KINDS}\s+\w+\s*=\s*[\w.]+\s*\(")
_REDECLARED_NAME = re.compile(rf"\bredeclare\s+(?:replaceable\s+)?{_KINDS}\s+(\w+)\s*=")
_REPLACEABLE = re.compile(rf"\breplaceable\s+{_KINDS}\s+(\w+)\s*=\s*[\w.]+\s*\(")
_DOTTED = re.compile(r"[(,]\s*(?:(?:each|final)\s+)*\w+(?:\s*\.\s*\w+)+\s*=(?!=)")
_BREAK = re.compile(r"=\s*break\b")
_EXTENDED_CLASS = re.compile(r"\bredeclare\s+(?:replaceable\s+)?\w+\s+extends\b")
_REDECLARE = re.compile(r"\bredeclare\b")
_EXTENDS = re.compile(r"\bextends\s+([\w.]+)\s*\(")
_COMPONENT = re.compile(rf"\bredeclare\s+(?:replaceable\s+)?(?!{_KINDS}\b)[\w.]+\s+(\w+)")
_BASES = re.compile(rf"\bextends\s+([\w.]+)|\b{_KINDS}\s+\w+\s*=\s*([\w.]+)")


def check(used: Iterable[Path], files: Sequence[Path]) -> None:
    """Refuse such a construct in the files that a class comes from, and in those of the classes they extend.

    Parameters
    ----------
    used
        Files that something in the flat result comes from.
    files
        All files that may declare a base class.

    Raises
    ------
    ModelicaError
        With file and line.
    """
    texts = _texts(used, files)
    redeclared = {name for text in texts.values() for name in _REDECLARED_NAME.findall(text)}
    for path, text in texts.items():
        for position, what, fix in _dropped(text, redeclared, texts.values()):
            line = text.count("\n", 0, position) + 1
            what = f"{what} is not supported (the front end would drop it)"
            raise ModelicaError(what, where=f"{path.name}:{line}", fix=fix)


def _texts(used: Iterable[Path], files: Sequence[Path]) -> dict[Path, str]:
    """Blanked text of each file concerned; a class that only extends leaves no trace in the flat result."""
    by_stem: dict[str, list[Path]] = {}
    for path in files:
        by_stem.setdefault(path.stem, []).append(path)
    texts: dict[Path, str] = {}
    left = [path.resolve() for path in used]
    while left:
        path = left.pop()
        if path not in texts:
            texts[path] = blanked(path.read_text(encoding="utf-8"))
            bases = [(a or b).rpartition(".")[2] for a, b in _BASES.findall(texts[path])]
            left += [base for name in bases for base in by_stem.get(name, ())]
    return dict(sorted(texts.items()))


def _dropped(text: str, redeclared: set[str], texts: Iterable[str]) -> Iterator[tuple[int, str, str | None]]:
    """Yield position, what it is, and what to do, of every construct that would be dropped."""
    for match in _REDECLARED.finditer(text):
        if _depth(text, match.start()) > 0:
            what = "modifiers of a class redeclared in a modification"
            yield match.start(), what, "declare a class with these modifiers and redeclare to it"
    for match in _REPLACEABLE.finditer(text):
        if match.group(1) in redeclared:
            what = "modifiers of a replaceable short class that is redeclared"
            yield match.start(), what, "declare a class with these modifiers and make it the default"
    for match in _REDECLARE.finditer(text):
        if _depth(text, match.start()) > 1:
            what = "a redeclaration below the first level of a modification"
            yield match.start(), what, "declare a class with it, or make the inner class replaceable one level up"
    for match in _EXTENDS.finditer(text):
        inside = text[match.end() : _close(text, match.end())]
        base = match.group(1).rpartition(".")[2]
        for component in _COMPONENT.finditer(inside):
            if not any(_declares(other, base, component.group(1)) for other in texts):
                what = f"a redeclaration of '{component.group(1)}', which '{base}' itself inherits,"
                yield match.end() + component.start(), what, f"redeclare it where '{base}' extends its class"
    for match in _EXTENDED_CLASS.finditer(text):
        yield match.start(), "'redeclare ... extends'", "declare a class that extends and redeclare to it"
    for match in _BREAK.finditer(text):
        yield match.start(), "'break' in a modification", None
    for match in _DOTTED.finditer(text):
        yield match.end() - 1, "a modifier with a dotted name", "write a.b = x as a(b = x)"


def _depth(text: str, position: int) -> int:
    return text.count("(", 0, position) - text.count(")", 0, position)


def _close(text: str, begin: int) -> int:
    """Where the parenthesis that is open at `begin` closes."""
    depth = 1
    for match in re.compile(r"[()]").finditer(text, begin):
        depth += 1 if match.group() == "(" else -1
        if depth == 0:
            return match.start()
    return len(text)


def _declares(text: str, class_name: str, component: str) -> bool:
    """Whether a class of this name in the text itself declares a replaceable component of that name."""
    name = re.escape(class_name)
    bodies = re.finditer(rf"\b{_KINDS}\s+{name}\b(?!\s*=).*?\bend\s+{name}\b", text, re.DOTALL)
    wanted = re.compile(rf"\breplaceable\s+[\w.]+\s+{re.escape(component)}\b")
    return any(wanted.search(body.group()) for body in bodies)
