"""Look: sliders for parameters and effects, with the simulation over the measurements as they move."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import perf_counter

import numpy as np
from nicegui import run, ui

from fmuid.core.campaign import ParameterSpec
from fmuid.core.errors import FmuidError
from fmuid.core.immutable import FloatArray
from fmuid.diagnosis_pipeline import FILE_NAME as DIAGNOSIS
from fmuid.identification.problem.cases import Case
from fmuid.identification.result import FILE as RESULT
from fmuid.identification.validate import predicted
from fmuid.page.elements import Charts, Choice, Slider, button, captioned, element, errors_shown, set_text, text
from fmuid.page.outcome import Outcome, in_log_units, of_corrected, outcome_at
from fmuid.page.proposed_run import NextExperiment
from fmuid.page.workspace import Workspace
from fmuid.report.figures import Overlay, overlay_figure
from fmuid.report.plots.figure_data import pretty_unit
from fmuid.report.predicted import overlays

_SPAN = 3.0  # factor from the value to the ends of a slider without bounds


class LookView:
    """The last tab of the page.

    Parameters
    ----------
    workspace
        Has the campaign.
    run
        The run folder to look at.
    diagnosis
        The folder of the diagnosis to look at instead, if any.
    """

    def __init__(self, workspace: Workspace, run: Path, diagnosis: Path | None = None) -> None:
        self._campaign_of = workspace
        self._work = workspace  # of the model that is simulated: after a diagnosis, the corrected one
        self._run_folder, self._diagnosis = run, diagnosis
        self._built: object = None
        self._root = element("div")
        self._busy = False

    def opened(self, folder: Path | None = None) -> None:
        """Show the present result, or that in another folder."""
        if folder is not None and (folder / DIAGNOSIS).is_file():
            self._diagnosis = folder
        elif folder is not None:
            self._run_folder, self._diagnosis = folder, None
        state = self._state()
        if state == self._built:  # everything is as the user left it
            return
        self._built = state
        self._root.clear()
        with errors_shown():
            if self._diagnosis is None:
                self._work = self._campaign_of
            else:
                self._work = of_corrected(self._diagnosis, self._campaign_of)
            with self._root:
                self._build()

    def _state(self) -> object:
        """Return the folder, the campaign and the results that the tab shows."""
        folder = self._diagnosis or self._run_folder
        files = [folder / name for name in (DIAGNOSIS, RESULT)]
        return folder, self._campaign_of.version, [file.stat().st_mtime for file in files if file.is_file()]

    def _build(self) -> None:
        work = self._work
        campaign = work.campaign
        if campaign is None:
            text("p", "The campaign has errors; see Prepare.", "headline", role="status")
            return
        self._outcome = outcome_at(self._diagnosis or self._run_folder, campaign) or Outcome(
            "Not identified yet: these are the start values.", {"start": campaign.start_values}
        )
        self._names = list(self._outcome.values)
        self._values: dict[str, float] = dict(self._outcome.values[self._names[0]])
        runs = [r.id for r in work.runs if not r.repeats_another]
        self._run = next((r for r in (*campaign.validation, *campaign.identification) if r in runs), runs[0])
        self._cases: tuple[Case, ...] = ()
        text("p", self._outcome.headline, "headline", role="status")
        with element("div", "buttons"):
            with captioned("Show run"):
                Choice("Run to look at", {r: r for r in runs}, self._run, self._choose)
            if len(self._names) > 1:
                names = {name: name for name in self._names}
                with captioned("Values"):
                    self._set = Choice("Set of values", names, self._names[0], self._take)
            if self._outcome.effects:
                self._switch = button("Correction", self._toggle, role="switch", aria_checked="true")
            button("Use as start values", self._keep)
        self._said = text("p", "", "soft", role="status")
        with element("div", "beside"):
            self._charts = Charts()
            with element("section", "side", aria_label="Sliders"):
                self._sliders: dict[str, Slider] = {}
                effects = [s for s in campaign.parameters.values() if s.name in self._outcome.effects]
                rest = [s for s in campaign.parameters.values() if s.name not in self._outcome.effects]
                self._group("Size of each effect", effects)
                self._group("Parameters", [s for s in rest if s.free])
                self._group("Fixed parameters", [s for s in rest if not s.free])
        run = self._run_folder if (self._run_folder / RESULT).is_file() else None
        design = self._run_folder.with_name(f"{self._run_folder.name}-design")
        NextExperiment(self._campaign_of, run, self._diagnosis, design)
        self._choose(self._run)

    def _group(self, title: str, specs: list[ParameterSpec]) -> None:
        if not specs:
            return
        text("h2", title)
        with element("div", "sliders"):
            for spec in specs:
                for name in [n for n in self._values if n == spec.name or n.startswith(f"{spec.name}@")]:
                    self._sliders[name] = Slider(
                        name,
                        self._values[name],
                        _ends(spec, self._values[name]),
                        lambda value, name=name: self._moved({name: value}),  # type: ignore[misc]
                        unit=pretty_unit(spec.unit or ""),
                        log=spec.scale == "log",
                    )

    def _choose(self, run: str) -> None:
        self._run = run
        with errors_shown():
            self._cases = self._work.cases([run])
            self._moved({})

    def _take(self, name: str) -> None:
        """Show a set of values."""
        self._moved(self._outcome.values[name])
        for parameter, slider in self._sliders.items():
            slider.show(self._values[parameter])
        if self._outcome.effects:
            self._switch.props["aria-checked"] = "true" if name == self._names[0] else "false"
            self._switch.update()

    def _toggle(self) -> None:
        """Switch the correction on or off."""
        on = self._switch.props["aria-checked"] != "true"
        name = self._names[0 if on else 1]
        self._set.show(name)
        self._take(name)

    def _keep(self) -> None:
        with errors_shown():
            self._campaign_of.start_from(self._values)
            ui.notify("campaign.toml now starts from these values; Undo is in Prepare")

    def _moved(self, values: Mapping[str, float]) -> None:
        self._values |= values
        if not self._busy:
            self._busy = True
            ui.timer(0.0, self._simulate, once=True)

    async def _simulate(self) -> None:
        """Simulate until the newest values are shown."""
        try:
            shown: object = None
            while shown != (self._cases, self._values):
                cases, values = shown = self._cases, dict(self._values)
                begin = perf_counter()
                outcomes = await run.io_bound(predicted, cases, values, self._work.runner)
                self._draw(cases, outcomes or [], 1e3 * (perf_counter() - begin))
        except FmuidError as error:
            set_text(self._said, str(error))
        finally:
            self._busy = False

    def _draw(
        self, cases: Sequence[Case], outcomes: Sequence[FloatArray | FmuidError], milliseconds: float
    ) -> None:
        drawn: list[Overlay] = []
        words = []
        for case, outcome in zip(cases, outcomes, strict=True):
            if isinstance(outcome, FmuidError):
                words.append(str(outcome))
                continue
            signals = self._work.measurements[case.experiments[0]].signals
            for overlay in overlays(None, case, [("simulation", "final", outcome)]):
                shown = in_log_units(overlay, signals[overlay.signal].unit)
                drawn.append(shown)
                words.append(f"{shown.signal}: {_rms(shown)}")
        set_text(self._said, f"RMS of the residual: {', '.join(words)}. Simulated in {milliseconds:.0f} ms.")
        figures = [overlay_figure(f"look-{k}", f"{o.experiment}: {o.signal}", [o]) for k, o in enumerate(drawn)]
        self._charts.show(figures)


def _rms(overlay: Overlay) -> str:
    residual = overlay.predictions[-1][2] - overlay.measurement
    residual = residual[np.isfinite(residual)]
    text = f"{float(np.sqrt(np.mean(residual**2))) if residual.size else math.nan:.3g} {pretty_unit(overlay.unit)}"
    if overlay.sigma is None:
        return text
    sigma = np.asarray(overlay.sigma, dtype=np.float64)
    return f"{text} (noise {float(np.sqrt(np.nanmean(sigma[np.isfinite(sigma)] ** 2))):.2g})"


def _ends(spec: ParameterSpec, value: float) -> tuple[float, float]:
    """Return the ends of a parameter's slider: its bounds, or values around its own."""
    low, high = spec.lower, spec.upper
    if spec.scale == "log":
        low, high = max(low, value / 10), min(high, value * 10)
    else:
        reach = _SPAN * abs(value) or 1.0
        low, high = max(low, value - reach), min(high, value + reach)
    return (low, high) if low < high else (low - 1.0, high + 1.0)
