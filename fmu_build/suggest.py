"""Suggestions for unknown names: 'did you mean ...?'."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(name: str, known: Iterable[str]) -> str | None:
    """Return ``did you mean 'x'?`` for the known name nearest to `name`, or None if none is near.

    The nearest name has the largest difflib ratio (Ratcliff and Obershelp), ignoring case.
    """
    by_folded = {k.casefold(): k for k in known}
    near = difflib.get_close_matches(name.casefold(), by_folded, n=1, cutoff=0.6)
    return f"did you mean '{by_folded[near[0]]}'?" if near else None


def known_names(known: Iterable[str], limit: int = 12) -> str:
    """Return the known names as a list for a message, cut at `limit`."""
    names = list(known)
    if not names:
        return "there is none"
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return f"known: {', '.join(names[:limit])}{more}"


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return a suggestion for `name`, or the names that are known."""
    names = list(known)
    return did_you_mean(name, names) or known_names(names)
