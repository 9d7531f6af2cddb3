"""Constructs that the front end drops without a word, found in the source text and refused.

rumoca 0.10.2 loses the modifiers of a class redeclared inside a modification (``M(redeclare model L = X(k = 3))``)
and of a short class that is declared replaceable and then redeclared, and modifiers with a dotted name
(``M(part.k = 3)``). The flat result shows no trace of them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from fmuid.errors import ModelicaError

_BLANKED = re.compile(r'"(?:\\.|[^"\\])*"|//[^\n]*|/\*.*?\*/', re.DOTALL)
_KINDS = r"(?:model|block|class|record|connector|package|function|type)"
_REDECLARED = re.compile(rf"\bredeclare\s+(?:replaceable\s+)?{_KINDS}\s+\w+\s*=\s*[\w.]+\s*\(")
_REDECLARED_NAME = re.compile(rf"\bredeclare\s+(?:replaceable\s+)?{_KINDS}\s+(\w+)\s*=")
_REPLACEABLE = re.compile(rf"\breplaceable\s+{_KINDS}\s+(\w+)\s*=\s*[\w.]+\s*\(")
_DOTTED = re.compile(r"[(,]\s*(?:(?:each|final)\s+)*\w+(?:\s*\.\s*\w+)+\s*=(?!=)")


def check(paths: Iterable[Path]) -> None:
    """Refuse source files with such a construct.

    Raises
    ------
    ModelicaError
        With file and line.
    """
    texts = {path: _BLANKED.sub(_blank, path.read_text(encoding="utf-8")) for path in paths}
    redeclared = {name for text in texts.values() for name in _REDECLARED_NAME.findall(text)}
    for path, text in texts.items():
        for match in _REDECLARED.finditer(text):
            if text.count("(", 0, match.start()) > text.count(")", 0, match.start()):
                what = "modifiers of a class redeclared in a modification"
                fix = "declare a class with these modifiers and redeclare to it"
                raise _refusal(path, text, match.start(), what, fix)
        for match in _REPLACEABLE.finditer(text):
            if match.group(1) in redeclared:
                what = "modifiers of a replaceable short class that is redeclared"
                fix = "declare a class with these modifiers and make it the default"
                raise _refusal(path, text, match.start(), what, fix)
        for match in _DOTTED.finditer(text):
            raise _refusal(
                path, text, match.end() - 1, "a modifier with a dotted name", "write a.b = x as a(b = x)"
            )


def _blank(match: re.Match[str]) -> str:
    return re.sub(r"[^\n]", " ", match.group(0))


def _refusal(path: Path, text: str, position: int, what: str, fix: str) -> ModelicaError:
    line = text.count("\n", 0, position) + 1
    what = f"{what} is not supported (the front end would drop it)"
    return ModelicaError(what, where=f"{path.name}:{line}", fix=fix)
