"""Messages of a check, each with the part of the campaign that it is about."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, Self

from fmuid.core.errors import FmuidError
from fmuid.identification.check import Finding, Level

Kind = Literal["parameter", "signal", "experiment", "stage", "model", "roles", "campaign"]

_TEXT = r"(?:\"([^\"]*)\"|'([^']*)'|([^\]]*))"
_PATTERNS: tuple[tuple[Kind, str], ...] = (
    ("parameter", rf"\[parameters\.{_TEXT}\]"),
    ("parameter", r"parameter '([^']*)'"),
    ("signal", r"signal '([^']*)'"),
    ("signal", rf"\[signals\.{_TEXT}\]"),
    ("experiment", r"experiment '([^']*)'"),
    ("stage", rf"\[stages\.{_TEXT}\]"),
    ("stage", r"stage '([^']*)'"),
    ("roles", r"\[roles\]|identification runs"),
    ("model", rf"\[models\.{_TEXT}\]"),
    ("model", r"setup '([^']*)'"),
)


@dataclass(frozen=True, slots=True)
class Message:
    """A message for the user.

    Parameters
    ----------
    level
        ``error``, ``warning`` or ``note``.
    kind, name
        The part of the campaign that it is about: a parameter, signal, experiment, stage or model and its name;
        ``roles``; or ``campaign`` for the rest, without a name.
    what, fix
        What is wrong, and what to do about it.
    """

    level: Level
    kind: Kind
    name: str
    what: str
    fix: str = ""

    def __str__(self) -> str:
        return f"{self.what}; {self.fix}" if self.fix else self.what

    @classmethod
    def of_finding(cls, finding: Finding) -> Self:
        """Return the message of a finding."""
        kind, name = place_of(finding.where)
        if kind in ("model", "experiment", "roles") and (
            named := re.match(r"(?:output|input) '([^']*)'", finding.what)
        ):
            kind, name = "signal", named[1]
        return cls(finding.level, kind, name, finding.what, finding.fix)

    @classmethod
    def of_error(cls, error: FmuidError) -> Self:
        """Return the message of an error."""
        kind, name = place_of(error.where or "")
        named = re.search(r"'([^']*)' is set by experiment", error.what)
        if kind == "campaign" and named:
            kind, name = "parameter", named[1]
        elif kind == "campaign" and error.where:
            return cls("error", kind, "", f"{error.where}: {error.what}", error.fix or "")
        return cls("error", kind, name, error.what, error.fix or "")


def place_of(where: str) -> tuple[Kind, str]:
    """Return the part of a campaign that the place of an error or finding names."""
    for kind, pattern in _PATTERNS:
        if match := re.search(pattern, where):
            return kind, next((g for g in match.groups() if g), "") if match.re.groups else ""
    return "campaign", ""


def by_place(messages: Iterable[Message]) -> Mapping[tuple[Kind, str], list[Message]]:
    """Return messages by the part of the campaign that they are about."""
    placed: dict[tuple[Kind, str], list[Message]] = {}
    for message in messages:
        placed.setdefault((message.kind, message.name), []).append(message)
    return placed
