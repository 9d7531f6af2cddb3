"""Results as sentences and tables: text for a terminal, HTML for a notebook."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

Rows = Sequence[Sequence[str]]
"""Cells of a table, header first."""


@dataclass(frozen=True, slots=True)
class Fact:
    """One line of a summary: a short label, the value in words, and whether it is good news."""

    label: str
    value: str
    tone: str = "plain"  # plain | good | warn


def text_table(rows: Rows) -> str:
    """Return rows as lines with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows)
    return "\n".join(lines)


def html_table(rows: Rows) -> str:
    """Return rows as an HTML table."""
    header, *others = rows
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(c)}</td>" for c in row) + "</tr>" for row in others)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def html_lines(lines: Sequence[str]) -> str:
    """Return lines as paragraphs."""
    return "".join(f"<p>{html.escape(line)}</p>" for line in lines)


def range_text(low: float, high: float, span: float | None = None) -> str:
    """Return "low … high" to three digits; an end negligible compared with `span` (high - low) becomes zero."""
    span = high - low if span is None else span
    ends = [0.0 if abs(end) < 1e-3 * span < math.inf else float(f"{end:.3g}") for end in (low, high)]
    return " … ".join(f"{end:g}".replace("-", "−") for end in ends)


def interval_text(low: float, high: float) -> str:
    """Return "low .. high" with enough digits to show its width to two digits."""
    digits = interval_digits(low, high)
    return f"{low:.{digits}g} .. {high:.{digits}g}"


def interval_digits(low: float, high: float) -> int:
    """Return the number of significant digits that shows the ends of an interval to two digits of its width."""
    width, size = high - low, max(abs(low), abs(high))
    if not (0.0 < width < math.inf and size > 0.0):
        return 5
    return max(5, min(17, math.ceil(math.log10(size / width)) + 2))


def once_each(notes: Sequence[tuple[str, str]]) -> list[str]:
    """Return each note on files once, with the first file it applies to and the number of others."""
    files: dict[str, list[str]] = {}
    for file, note in notes:
        files.setdefault(note, []).append(file)
    return [f"{on[0]}{f' and {len(on) - 1} more' if len(on) > 1 else ''}: {note}" for note, on in files.items()]


def shortened(text: str, most: int = 160) -> str:
    """Return `text` with its middle left out if it is longer than `most` characters."""
    half = (most - 5) // 2
    return text if len(text) <= most else f"{text[:half]} ... {text[-half:]}"
