"""One style for print and screen: colour-blind safe colours by Okabe and Ito, one look per role."""

from __future__ import annotations

from dataclasses import dataclass

from fmuid.report.plots.figure_data import Role, Series

ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
BLUE = "#0072B2"
VERMILLION = "#D55E00"
PURPLE = "#CC79A7"
GREY = "#9A9A9A"
INK = "#222222"

ORDERED = "cividis"
"""Colour map of lines by cost: even in lightness, safe for the colour-blind, and in both libraries."""
SEQUENTIAL = ((0.0, "#F4F7FA"), (0.35, SKY), (0.7, BLUE), (1.0, "#00263D"))
"""Colour map of magnitudes: pale for nothing, dark for much, also on a grey printer."""
DIVERGING = ((0.0, BLUE), (0.5, "#F7F7F7"), (1.0, VERMILLION))


@dataclass(frozen=True, slots=True)
class Look:
    """Style of a role: colour, line width in points, dashes ("solid", "dash", "dot"), marker, order."""

    colour: str
    width: float
    dash: str = "solid"
    marker: str = "circle"
    order: int = 2
    alpha: float = 1.0


LOOKS: dict[Role, Look] = {
    # The measurement is wide and pale, so that it stays visible under a prediction that agrees with it.
    "measurement": Look("#A6A6A6", 2.4, order=1),
    "start": Look(ORANGE, 1.3, dash="dash", marker="square", order=3),
    "iterate": Look(SKY, 0.8, order=2, alpha=0.75),
    "final": Look(BLUE, 1.2, order=4),
    "reference": Look(GREEN, 1.3, dash="dot", marker="diamond", order=5),
    "before": Look(ORANGE, 0.8, order=2),
    "after": Look(BLUE, 0.8, order=3),
    "floor": Look("#444444", 0.9, dash="dash", order=5),
    "alternative": Look(PURPLE, 1.2, dash="dash", marker="triangle", order=3),
}


def legend(series: Series) -> str:
    """Return the legend's text for a line; the iterates of a search share one."""
    return "intermediate iterates" if series.role == "iterate" and not series.points else series.label


def bar_colour(role: Role) -> str:
    """Return the fill of a bar; the dark grey of lines would be too heavy here."""
    return GREY if role == "floor" else LOOKS[role].colour
