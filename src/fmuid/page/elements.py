"""Plain HTML elements with labels: keyboard and screen reader work as everywhere in the browser."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from nicegui import ui
from nicegui.element import Element

from fmuid.core.errors import FmuidError
from fmuid.core.immutable import FloatArray
from fmuid.page.placed_messages import Message
from fmuid.report.thinning import kept_samples

_SIZE = (180, 44)  # of a small curve, px
_VALUE = "(event) => emit(event.target.value)"


def text(tag: str, content: str, classes: str = "", **attributes: str) -> Element:
    """Return an element with text."""
    made = element(tag, classes, **attributes)
    made.default_slot.children.clear()
    with made:
        ui.html(html.escape(content), sanitize=False, tag="span")
    return made


def set_text(made: Element, content: str) -> None:
    """Replace the text of an element that `text` returned."""
    inner = made.default_slot.children[0]
    assert isinstance(inner, ui.html)
    if inner.content != html.escape(content):
        inner.set_content(html.escape(content))


def element(tag: str, classes: str = "", **attributes: str | bool) -> Element:
    """Return an element; an underscore in the name of an attribute stands for a dash."""
    made = ui.element(tag)
    if classes:
        made.classes(classes)
    for name, value in attributes.items():
        made.props[name.rstrip("_").replace("_", "-")] = value
    return made


class Field:
    """A text field; `changed` is called with the text when the user leaves it or presses Enter."""

    def __init__(self, label: str, value: str, changed: Callable[[str], object], width: str = "7em") -> None:
        self.element = element("input", type="text", aria_label=label, value=value, spellcheck="false")
        self.element.style(f"width: {width}")
        self._value = value

        def heard(event: Any) -> None:
            if str(event.args) != self._value:
                self._value = str(event.args)
                changed(self._value)

        self.element.on("change", heard, js_handler=_VALUE)

    def show(self, value: str) -> None:
        """Show a value that changed elsewhere."""
        self._value = value
        self.element.props["value"] = value
        self.element.update()

    def enable(self, usable: bool) -> None:
        """Make the field usable or not."""
        self.element.props["disabled"] = not usable
        self.element.update()


class Choice:
    """A list to choose from; `changed` is called with the key of the choice."""

    def __init__(
        self, label: str, options: Mapping[str, str], value: str, changed: Callable[[str], object]
    ) -> None:
        self.element = element("select", aria_label=label, value=value)
        with self.element:
            for key, words in options.items():
                text("option", words, value=key)

        def heard(event: Any) -> None:
            self.element.props["value"] = str(event.args)
            changed(str(event.args))

        self.element.on("change", heard, js_handler=_VALUE)

    def show(self, value: str) -> None:
        """Show a value that changed elsewhere."""
        if self.element.props["value"] != value:
            self.element.props["value"] = value
            self.element.update()


def button(words: str, pressed: Callable[[], object], classes: str = "", **attributes: str | bool) -> Element:
    """Return a button."""
    made = text(
        "button", words, classes, type="button", **{k: v for k, v in attributes.items() if isinstance(v, str)}
    )
    made.on("click", lambda _: pressed())
    return made


def enable(made: Element, usable: bool) -> None:
    """Make a button usable or not."""
    made.props["disabled"] = not usable
    made.update()


@contextmanager
def told() -> Iterator[None]:
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
