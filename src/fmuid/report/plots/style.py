"""One look for print and screen: colours by Okabe and Ito, safe for the colour-blind, one look a role."""

from __future__ import annotations

from dataclasses import dataclass

from fmuid.report.plots.figure_data import Role, Series

BLACK = "#000000"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
YELLOW = "#F0E442"
BLUE = "#0072B2"
VERMILLION = "#D55E00"
PURPLE = "#CC79A7"
GREY = "#9A9A9A"
LIGHT = "#D9D9D9"
INK = "#222222"

ORDERED = "cividis"
"""Colour map of lines by cost, even in lightness and for colour-blind eyes; both libraries have it."""
SEQUENTIAL = ((0.0, "#F4F7FA"), (0.35, SKY), (0.7, BLUE), (1.0, "#00263D"))
"""Magnitudes: nothing is pale, much is dark, also on a grey printer."""
DIVERGING = ((0.0, BLUE), (0.5, "#F7F7F7"), (1.0, VERMILLION))


@dataclass(frozen=True, slots=True)
class Look:
    """How a role is drawn: colour, line width in points, dashes ("solid", "dash", "dot"), marker, order."""

    colour: str
    width: float
    dash: str = "solid"
    marker: str = "circle"
    order: int = 2
    alpha: float = 1.0


LOOKS: dict[Role, Look] = {
    # The measurement is wide and pale so that a prediction on top of it stays visible where they agree.
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
    """Return the fill of a bar; a line's dark grey would be heavy here."""
    return GREY if role == "floor" else LOOKS[role].colour
