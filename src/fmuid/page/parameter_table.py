"""The table of parameters: start, bounds, and whether each is free."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from fmuid.core.errors import FmuidError
from fmuid.page.elements import Choice, Field, Notes, element, errors_shown, header, set_text, text
from fmuid.page.placed_messages import Kind, Message
from fmuid.page.workspace import ParameterRow, Workspace
from fmuid.report.plots.figure_data import pretty_unit

_STATES = {"free": "free", "fixed": "fixed", "known": "known"}
_KEYS = ("start", "lower", "upper")


class ParameterTable:
    """Parameters to look at and change.

    Parameters
    ----------
    label
        Label of the table, for screen readers.
    rows
        The parameters.
    workspace
        Has the campaign.
    act
        Calls a change and shows what follows from it.
    """

    def __init__(
        self,
        label: str,
        rows: Sequence[ParameterRow],
        workspace: Workspace,
        act: Callable[[Callable[[], object]], None],
    ) -> None:
        self._work = workspace
        self._act = act
        self._updates: list[
            Callable[[Mapping[tuple[Kind, str], list[Message]], Mapping[str, ParameterRow]], None]
        ] = []
        with element("table", "rows", aria_label=label):
            header("Parameter", "State", "Start", "Lower", "Upper", "Unit", "Reason")
            with element("tbody"):
                for row in rows:
                    self._row(row)

    def show(self, messages: Mapping[tuple[Kind, str], list[Message]]) -> None:
        """Bring the rows up to date."""
        rows = {row.name: row for row in self._work.parameters()}
        for update in self._updates:
            update(messages, rows)

    def _row(self, row: ParameterRow) -> None:
        name = row.name
        fields: dict[str, Field] = {}
        with element("tr"):
            with element("th", "name wide", scope="row"):
                text("span", name)
                if row.description:
                    text("div", row.description, "soft")
                notes = Notes()
            with element("td", "wide"):
                state = Choice(
                    f"{name} is",
                    _STATES,
                    row.state,
                    lambda key: self._act(lambda: self._work.set_state(name, key)),
                )
            for key in _KEYS:
                with element("td", data_label=key.capitalize()):
                    fields[key] = Field(
                        f"{key.capitalize()} of {name}",
                        _shown(getattr(row, key)),
                        lambda typed, key=key: self._number(name, key, typed),  # type: ignore[misc]
                        "6.5em",
                    )
                    fields[key].enable(row.in_file)
            text("td", pretty_unit(row.unit), data_label="Unit")
            reason = text("td", row.reason, "soft wide", data_label="Reason")

        def update(messages: Mapping[tuple[Kind, str], list[Message]], rows: Mapping[str, ParameterRow]) -> None:
            now = rows.get(name, row)
            state.show(now.state)
            for key, field in fields.items():
                field.show(_shown(getattr(now, key)))
            set_text(reason, now.reason)
            notes.show(messages.get(("parameter", name), []))

        self._updates.append(update)

    def _number(self, name: str, key: str, typed: str) -> None:
        with errors_shown():
            try:
                value = float(typed.replace("−", "-")) if typed.strip() else None
            except ValueError:
                self._work.version += 1  # shows the file's value again
                what = f"'{typed}' is not a number"
                raise FmuidError(what, where=f"{key} of {name}", fix="write it as in 1e-3") from None
            if value is not None and not math.isfinite(value):
                value = None
            self._act(lambda: self._work.edit(lambda f: f.set(("parameters", name, key), value)))


def _shown(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"
