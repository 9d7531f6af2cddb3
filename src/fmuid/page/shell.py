"""The page's frame: title and tabs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from nicegui import ui
from nicegui.element import Element

from fmuid.page.elements import element, text
from fmuid.page.look_view import LookView
from fmuid.page.prepare_view import PrepareView
from fmuid.page.run_view import RunView
from fmuid.page.workspace import Workspace

_STYLE = Path(__file__).with_name("style.css")
_ARROWS = """(event) => {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (!step) return;
  const tabs = [...event.target.parentElement.querySelectorAll("[role=tab]")];
  const next = tabs[(tabs.indexOf(event.target) + step + tabs.length) % tabs.length];
  next.focus(); next.click();
}"""


class Shell:
    """The whole page for one visitor.

    Parameters
    ----------
    workspace
        What the page works on.
    run_folder
        The folder of the run to follow and to look at.
    diagnosis
        The folder of the diagnosis to look at, if any.
    first
        The tab that is open first.
    """

    def __init__(
        self, workspace: Workspace, run_folder: Path, *, diagnosis: Path | None = None, first: str = "Prepare"
    ) -> None:
        ui.add_css(_STYLE)
        self._work = workspace
        self._views: dict[str, Callable[[], object]] = {
            "Prepare": lambda: PrepareView(workspace),
            "Run": lambda: RunView(workspace, run_folder, lambda folder: self.open("Look", folder)),
            "Look": lambda: LookView(workspace, run_folder, diagnosis),
        }
        self._tabs: dict[str, Element] = {}
        self._panels: dict[str, Element] = {}
        self._made: dict[str, Any] = {}
        with element("div", "page"):  # NiceGUI puts it into the landmark `main`
            with element("header", "top"):
                text("h1", self._title())
                text("span", str(workspace.folder), "soft name")
            with element("div", role="tablist", aria_label="Steps"):
                for name in self._views:
                    tab = text("button", name, type="button", role="tab", id=f"tab-{name}")
                    tab.props["aria-controls"] = f"panel-{name}"
                    tab.on("click", lambda _, name=name: self.open(name))
                    tab.on("keydown", js_handler=_ARROWS)
                    self._tabs[name] = tab
            for name in self._views:
                panel = element("section", id=f"panel-{name}")
                panel.props["role"] = "tabpanel"
                panel.props["aria-labelledby"] = f"tab-{name}"
                self._panels[name] = panel
        self.open(first)

    def open(self, name: str, *shown: Path) -> None:
        """Open a tab, which may show a folder; it is built when it is opened first."""
        for other, panel in self._panels.items():
            panel.set_visibility(other == name)
            if other in self._tabs:
                self._tabs[other].props["aria-selected"] = "true" if other == name else "false"
                self._tabs[other].update()
        if name not in self._made:
            with self._panels[name]:
                self._made[name] = self._views[name]()
        if hasattr(self._made[name], "opened"):
            self._made[name].opened(*shown)

    def _title(self) -> str:
        head = self._work.file.tables.get("campaign", {})
        return str(head.get("title") or head.get("name") or self._work.folder.resolve().name)
