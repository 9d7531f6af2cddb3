"""Plain HTML elements with labels: keyboard and screen reader work as everywhere in the browser."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from nicegui import ui
from nicegui.element import Element
from nicegui.elements.mixins.text_element import TextElement

from fmuid.core.errors import FmuidError
from fmuid.core.immutable import FloatArray
from fmuid.page.placed_messages import Message
from fmuid.report.interactive import specification
from fmuid.report.plots.figure_data import Figure
from fmuid.report.thinning import kept_samples

_SIZE = (180, 44)  # of a small curve, px


def text(tag: str, content: str, classes: str = "", **attributes: str) -> TextElement:
    """Return an element with text."""
    made = TextElement(tag=tag, text=content)
    _set(made, classes, attributes)
    return made


def set_text(made: TextElement, content: str) -> None:
    """Replace the text of an element that `text` returned."""
    if made.text != content:
        made.set_text(content)


def element(tag: str, classes: str = "", **attributes: str | bool) -> Element:
    """Return an element; an underscore in the name of an attribute stands for a dash."""
    made = ui.element(tag)
    _set(made, classes, attributes)
    return made


def captioned(caption: str) -> Element:
    """Return an element for a list to choose from, with a caption that stays next to it."""
    made = element("span", "captioned")
    with made:
        text("span", caption)
    return made


def _set(made: Element, classes: str, attributes: Mapping[str, str | bool]) -> None:
    if classes:
        made.classes(classes)
    for name, value in attributes.items():
        made.props[name.rstrip("_").replace("_", "-")] = value


class Input:
    """An element whose value the user and the page change.

    The browser gets a value only when it changed: an update of the page never replaces what is being typed.

    Parameters
    ----------
    tag
        ``input``, ``select`` or ``textarea``.
    label
        Its name for screen readers.
    value
        The first value.
    changed
        Called with the value that the user gave.
    event
        The event of the browser: ``change`` when the user has finished, ``input`` with each change.
    throttle
        Least time between two calls in seconds.
    **attributes
        Attributes of the element.
    """

    def __init__(
        self,
        tag: str,
        label: str,
        value: str,
        changed: Callable[[str], object],
        *,
        event: str = "change",
        throttle: float = 0.0,
        **attributes: str,
    ) -> None:
        self.element = element(tag, aria_label=label, **attributes)
        self.element.props[".value"] = self.value = value

        def heard(event: Any) -> None:
            if str(event.args) != self.value:
                self.value = str(event.args)
                changed(self.value)

        self.element.on(event, heard, js_handler="(event) => emit(event.target.value)", throttle=throttle)

    def show(self, value: str) -> None:
        """Show a value that changed elsewhere."""
        if value == self.value:
            return
        self.value = value
        self.element.props[".value"] = value
        self.element.update()
        # The update alone would not take back what the user has typed since the last one.
        self.element.client.run_javascript(f"getHtmlElement({self.element.id}).value = {json.dumps(value)}")

    def enable(self, usable: bool) -> None:
        """Make the element usable or not."""
        if self.element.props.get("disabled", False) == usable:
            self.element.props["disabled"] = not usable
            self.element.update()


class Field(Input):
    """A text field; `changed` is called with the text when the user leaves it or presses Enter."""

    def __init__(self, label: str, value: str, changed: Callable[[str], object], width: str = "7em") -> None:
        super().__init__("input", label, value, changed, type="text", spellcheck="false")
        self.element.style(f"width: {width}")


class Slider:
    """A slider between two ends; `moved` is called with each value, at most every 50 ms."""

    STEPS = 1000

    def __init__(
        self,
        label: str,
        value: float,
        ends: tuple[float, float],
        moved: Callable[[float], object],
        *,
        unit: str = "",
        log: bool = False,
    ) -> None:
        self._ends = ends
        self._log = log
        self._unit = unit
        with element("div", "slider"):
            with element("span", "name"):
                text("span", label)
                text("span", f" [{unit}]" if unit else "", "soft")
            self._number = Field(
                f"Value of {label}", f"{value:.5g}", lambda typed: self._typed(typed, moved), "7em"
            )
            self._range = Input(
                "input",
                label,
                str(self._place(value)),
                lambda place: self._dragged(place, moved),
                event="input",
                throttle=0.05,
                type="range",
                min="0",
                max=str(self.STEPS),
                aria_valuetext=self._words(value),
            )

    def show(self, value: float) -> None:
        """Show another value."""
        self._number.show(f"{value:.5g}")
        self._say(value)
        self._range.show(str(self._place(value)))

    def _dragged(self, place: str, moved: Callable[[float], object]) -> None:
        value = self._value(float(place))
        self._number.show(f"{value:.5g}")
        self._say(value)
        moved(value)

    def _say(self, value: float) -> None:
        self._range.element.props["aria-valuetext"] = self._words(value)
        self._range.element.update()

    def _typed(self, typed: str, moved: Callable[[float], object]) -> None:
        with errors_shown():
            try:
                value = float(typed.replace("−", "-"))
            except ValueError:
                raise FmuidError(f"'{typed}' is not a number", fix="write it as in 1e-3") from None
            self.show(value)
            moved(value)

    def _words(self, value: float) -> str:
        return f"{value:.4g} {self._unit}".strip()

    def _place(self, value: float) -> int:
        low, high = self._ends
        share = (
            math.log(value / low) / math.log(high / low)
            if self._log and value > 0
            else (value - low) / (high - low)
        )
        return round(self.STEPS * min(max(share, 0.0), 1.0))

    def _value(self, place: float) -> float:
        low, high = self._ends
        share = place / self.STEPS
        return float(low * (high / low) ** share if self._log else low + share * (high - low))


class Choice(Input):
    """A list to choose from; `changed` is called with the key of the choice."""

    def __init__(
        self, label: str, options: Mapping[str, str], value: str, changed: Callable[[str], object]
    ) -> None:
        super().__init__("select", label, value, changed)
        with self.element:
            for key, words in options.items():
                text("option", words, value=key)


def button(words: str, pressed: Callable[[], object], classes: str = "", **attributes: str) -> TextElement:
    """Return a button."""
    made = text("button", words, classes, type="button", **attributes)
    made.on("click", lambda _: pressed())
    return made


def enable(made: Element, usable: bool) -> None:
    """Make a button usable or not."""
    if made.props.get("disabled", False) == usable:
        made.props["disabled"] = not usable
        made.update()


def header(*names: str) -> None:
    """Make the header of a table."""
    with element("thead"), element("tr"):
        for name in names:
            text("th", name, scope="col")


def drawn(figure: Figure) -> dict[str, Any]:
    """Return a figure as the page's plot element takes it."""
    spec = specification(figure)
    for trace in spec["data"]:
        if isinstance(trace.get("x"), int):
            trace["x"] = spec["shared"][trace["x"]]
    layout = spec["layout"] | {"uirevision": "kept"}  # keeps the zoom when values change
    config = {"responsive": True, "displayModeBar": False}
    return {"data": spec["data"], "layout": layout, "config": config, "narrow": spec["narrow"]}


class Plot:
    """A figure that can change."""

    def __init__(self, figure: Figure) -> None:
        spec = drawn(figure)
        with element("figure", role="img", aria_label=figure.title):
            height, least = spec["layout"]["height"], spec["narrow"].get("width") or 0
            self._plot = ui.plotly(spec).classes("plot").style(f"height: {height}px; min-width: {least}px")

    def show(self, figure: Figure) -> None:
        """Show another figure in its place."""
        self._plot.update_figure(drawn(figure))


class Charts:
    """Figures side by side, each under its title."""

    def __init__(self) -> None:
        self._root = element("div", "figures")
        self._plots: dict[str, Plot] = {}

    def show(self, shown: Sequence[Figure]) -> None:
        """Show figures; those of the same names are changed in place."""
        if self._plots.keys() == {figure.name for figure in shown}:
            for figure in shown:
                self._plots[figure.name].show(figure)
            return
        self._root.clear()
        with self._root:
            self._plots = {}
            for figure in shown:
                with element("div"):
                    text("h3", figure.title)
                    self._plots[figure.name] = Plot(figure)


@contextmanager
def errors_shown() -> Iterator[None]:
    """Show an error of the block as a notification."""
    try:
        yield
    except FmuidError as error:
        ui.notify(str(error), type="negative", multi_line=True, timeout=10_000, close_button="Close")


class Notes:
    """The messages about one part of the campaign."""

    def __init__(self, messages: Sequence[Message] = ()) -> None:
        self.element = element("div", "notes")
        self._shown: tuple[Message, ...] = ()
        self.show(messages)

    def show(self, messages: Sequence[Message]) -> None:
        """Replace the messages."""
        if self._shown == tuple(messages):
            return
        self._shown = tuple(messages)
        self.element.clear()
        with self.element:
            for message in messages:
                text("p", f"{message.level}: {message}", f"note {message.level}")


def curve(label: str, lines: Sequence[tuple[str, FloatArray, FloatArray]], size: tuple[int, int] = _SIZE) -> str:
    """Return a small picture of lines, (class, time, values) each, as SVG."""
    width, height = size
    finite = [y[np.isfinite(y)] for _, _, y in lines]
    every = np.concatenate([y for y in finite if y.size] or [np.zeros(1)])
    times = [t for _, t, _ in lines if t.size]
    begin, end = (min(float(t[0]) for t in times), max(float(t[-1]) for t in times)) if times else (0.0, 1.0)
    low, high = float(every.min()), float(every.max())
    if not high > low:
        low, high = low - 1.0, high + 1.0
    paths = []
    for kind, time, values in lines:
        keep = kept_samples([values], 300)
        x = 2 + (time[keep] - begin) / max(end - begin, 1e-300) * (width - 4)
        y = height - 3 - (values[keep] - low) / (high - low) * (height - 6)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True) if math.isfinite(b))
        paths.append(f'<polyline class="{kind}" points="{points}" fill="none"/>')
    return (
        f'<svg class="curve" role="img" aria-label="{html.escape(label)}, {low:.4g} to {high:.4g}" '
        f'viewBox="0 0 {width} {height}" width="{width}" height="{height}">{"".join(paths)}</svg>'
    )
