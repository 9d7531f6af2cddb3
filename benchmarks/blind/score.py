"""The score of the blind check."""

from __future__ import annotations

from typing import Any


def in_words(answer: dict[str, Any]) -> str:
    """Return the verdict of a diagnosis in a few words."""
    verdict = answer["verdict"]
    joined = " and ".join(verdict["effects"])
    if verdict["one_of"]:
        either = " or ".join(" and ".join(names) for names in verdict["one_of"])
        joined = f"{joined} and ({either})" if joined else either
    kind = ("provisional " if verdict.get("provisional") else "") + verdict["kind"]
    return f"{kind}: {joined}" if joined else kind
