"""Losses of the gear in the FMUs (Figs. 8 and 9, Table 1 of the paper), and friction of the output bearing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from benchmarks.paper_reproduced.recorded import CAMPAIGN, ROOT
from fmuid.core.campaign import Campaign, ModelSource
from fmuid.core.immutable import FloatArray
from fmuid.report.plots.figure_data import Axis, LineFigure, Panel, Series
from fmuid.simulation.coupled.loading import load_simulator
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.model_source import built_model
from fmuid.simulation.simulator import Simulator, Task

_NAMES = ("gear.w", "gear.W.tau", "gear.friction", *(f"gear.losses[{k}]" for k in range(1, 5)))
_LOAD = 35.5  # N.m, the largest of the paper
_STUCK = 0.02  # rad/s
_INPUT = Axis("input torque", "N.m")
_FRICTION = Axis("friction torque", "N.m")


@dataclass(frozen=True, slots=True, eq=False)
class Sliding:
    """Steady turning under the eccentric load: (N,) speed, input torque and friction, and (4, N) losses."""

    w: FloatArray
    tau: FloatArray
    friction: FloatArray
    losses: FloatArray

    def law(self) -> FloatArray:
        """Return the friction by Table 1 of the paper."""
        eta1, eta2, bf1, bf2 = self.losses
        sign = np.where(self.w > 0, 1.0, -1.0)
        driving = (1 - eta1) * self.tau + sign * bf1
        return np.where(self.w * self.tau >= 0, driving, (1 - 1 / eta2) * self.tau + sign * bf2)


def sliding(campaign: Campaign, values: Mapping[str, float], speed: float) -> Sliding:
    """Simulate both directions of turning at a speed of the rotor, rad/s."""
    simulator = load_simulator(campaign.models["eccentric_load"])
    known = {n: v for n, v in values.items() if n in simulator.variables} | {"mgr": _LOAD}
    time = 0.01 * np.arange(int(30.0 * 10.0 / speed) * 100 + 1)
    parts = []
    for sign in (1.0, -1.0):
        reference = sign * speed * np.minimum(time / 0.5, 1.0)
        rows = simulator.simulate(Task(time, {"w_ref": reference}, _NAMES), known)
        parts.append(rows[:, time > 1.0])
    w, tau, friction, *losses = np.hstack(parts)
    return Sliding(w, tau, friction, np.array(losses))


def _stuck(values: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
    """Return input torque and friction while the gear holds: shaft fixed, current slowly up and down."""
    with Fmu(built_model(_shipped("FixedShaft"))) as simulator:
        known = {n: v for n, v in values.items() if n in simulator.variables and n.startswith("lossTable")}
        time = 1e-3 * np.arange(10001)
        current = 0.6 * np.interp(time, [0, 2, 4, 6, 8, 10], [0, 1, 0, -1, 0, 0.5])
        w, tau, friction = simulator.simulate(Task(time, {"i_cmd": current}, _NAMES[:3]), known)
    still = np.abs(w) < _STUCK
    return tau[still], friction[still]


def law_figures(campaign: Campaign, values: Mapping[str, float]) -> list[LineFigure]:
    """Return Fig. 8, friction over input torque while sliding and stuck, and Fig. 9, friction over speed."""
    at_ten, (held, holds) = sliding(campaign, values, 10.0), _stuck(values)
    series = [
        Series(label, at_ten.tau[chosen], at_ten.friction[chosen], role, points=True)
        for label, chosen, role in (
            ("sliding forward, 10 rad/s", at_ten.w > 0, "final"),
            ("sliding backward, −10 rad/s", at_ten.w < 0, "start"),
        )
    ]
    series.append(Series("stuck, at 0 rad/s", held, holds, "measurement", points=True))
    eight = LineFigure("paper-fig8", "", (Panel("", _INPUT, _FRICTION, tuple(series)),), "", 1)
    runs = [sliding(campaign, values, speed) for speed in (1.0, 3.0, 6.0, 10.0, 15.0, 20.0, 30.0)]
    lines = []
    for torque, role in ((-0.4, "start"), (0.0, "measurement"), (0.4, "final")):
        points = [
            (one.w[k], one.friction[k]) for one in runs for d in (1, -1) if (k := _nearest(one, torque, d)) >= 0
        ]
        w, friction = np.array(sorted(points)).T
        lines.append(Series(f"{torque:g} N.m of input torque".replace("-", "−"), w, friction, role))
    nine = LineFigure("paper-fig9", "", (Panel("", Axis("speed", "rad/s"), _FRICTION, tuple(lines)),), "", 1)
    return [eight, nine]


def _nearest(run: Sliding, torque: float, direction: int) -> int:
    """Return the sample in a direction of turning with the input torque nearest to one."""
    away = np.where(direction * run.w > 0, np.abs(run.tau - torque), np.inf)
    return int(np.argmin(away))


def output_bearing(values: Mapping[str, float], speed: float = 10.0) -> list[tuple[str, str, str]]:
    """Return friction of the output bearing, mean sensor torque and motor torque in free rotation, N.m."""
    source = ModelSource(CAMPAIGN / "OutputBearing.mo", "OutputBearing", roots=(ROOT / "modelica",))
    rows = []
    with Fmu(built_model(source)) as simulator:
        known = {n: v for n, v in values.items() if n in simulator.variables}
        time = 2e-3 * np.arange(2001)
        task = Task(time, {"w_ref": speed * np.minimum(time / 0.5, 1.0)}, ("tau_sensor", "i_motor"))
        for friction in (0.0, 1.0, 2.0, 4.0):
            sensor, current = _steady(simulator, task, known | {"tau_out": friction})
            rows.append((f"{friction:g}", f"{abs(sensor):.3f}", f"{0.7 * current:.4f}"))
    return rows


def _steady(simulator: Simulator, task: Task, values: Mapping[str, float]) -> tuple[float, float]:
    sensor, current = simulator.simulate(task, values)[:, task.time > 2.0].mean(axis=1)
    return float(sensor), float(current)


def _shipped(name: str) -> ModelSource:
    return ModelSource(ROOT / "modelica" / "Drives" / "Setups" / f"{name}.mo", f"Drives.Setups.{name}")
