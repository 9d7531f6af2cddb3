"""Designed runs on the actuator: ``python -m benchmarks.designed_actuator``.

First, the linear parameters with the shaft fixed: each of the paper's inputs is compared with a run designed
within the same amplitude and duration, by the sum of squared relative standard errors that one run alone
leaves, and with the bound that no input can pass, since the model is linear in it. Second, the paper's future
work: friction at standstill, from a run that is designed before anything is measured. The virtual rig plays it.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.study_command import run_module
from benchmarks.virtual_rig.rig_plan import PlannedExperiment, carry_out, load_plan
from fmuid.core.campaign import Campaign, DesignSpec, Limit, ModelSpec, ParameterSpec, StageSpec
from fmuid.core.experiments import Measurements
from fmuid.core.immutable import FloatArray
from fmuid.design.binary import relaxed
from fmuid.design.parameters import ParameterDesign, design_for_parameters
from fmuid.identification.identify import identify
from fmuid.simulation.coupled.loading import load_simulator
from fmuid.simulation.runners import in_process

ROOT = Path(__file__).parents[1]
INPUTS = ("step_0p5", "step_1p0", "sine_0p5_5", "sine_0p75_10", "prbs_0p5", "prbs_0p8")
TOGETHER = ("step_0p5", "sine_0p5_5", "prbs_0p5")
_ROWS = range(1, 8)
_FRICTIONLESS = {f"lossTable[{r},{c}]": 1.0 if c < 4 else 0.0 for r in _ROWS for c in range(2, 6)}


def linear() -> dict[str, ParameterSpec]:
    """The paper's linear parameters, where it ended."""
    return {
        "d_S": ParameterSpec("d_S", 2.66, 0.05, 20.0, scale="log"),
        "J_S": ParameterSpec("J_S", 0.003039, 0.001, 0.01, scale="log"),
        "d_G": ParameterSpec("d_G", 70.625, 5.0, 300.0, scale="log"),
    }


def campaign(
    parameters: Mapping[str, ParameterSpec],
    settings: Mapping[str, float],
    *,
    amplitude: float,
    duration: float,
    initial: Mapping[str, float],
    repeats: int = 1,
) -> Campaign:
    """Return a campaign of the actuator with its shaft fixed, of which nothing is measured."""
    models = {"fixed_shaft": ModelSpec("fixed_shaft", ROOT / "build/fmus/FixedShaft.fmu", initial=dict(initial))}
    design = DesignSpec(
        limits={"i_cmd": Limit("i_cmd", -amplitude, amplitude)},
        duration=duration,
        sample_time=5e-4,
        sigma={"tau_sensor": load_plan(ROOT / "campaigns/force_feedback").sensors.torque_sigma()},
        repeats=repeats,
    )
    nothing = Measurements({})
    return Campaign("actuator", "Actuator", ROOT, nothing, models, parameters, settings, {}, (), (), design=design)


def designed(what: Campaign, *, evaluations: int = 300) -> ParameterDesign:
    """Design for the sum of squared relative standard errors."""
    return design_for_parameters(what, load_simulator, in_process, optimality="A", evaluations=evaluations)


def told(design: ParameterDesign, samples: FloatArray) -> FloatArray:
    """Return the information of one run with these samples, relative to the parameters' values."""
    values = np.array(list(design.values.values()))
    return design.criterion.information(samples, design.values) * np.outer(values, values)


def least(design: ParameterDesign) -> float:
    """Return a sum of squared relative standard errors that no input of this range and duration can pass."""
    planned = design.planned
    bounds = tuple(d.bounds for d in planned.driven)
    posed = relaxed(design.criterion.response(design.values), bounds, planned.time, iterations=3000)
    assert posed is not None
    return posed.bound


def squares(information: FloatArray) -> float:
    """Return the sum of squared relative standard errors that this information leaves."""
    return float(np.trace(np.linalg.inv(information)))


def against_the_paper() -> list[float]:
    """Print each of the paper's inputs with a designed run, and return by how much the errors shrink."""
    plan = {e.id: e for e in load_plan(ROOT / "campaigns/force_feedback").experiments}
    gains, papers = [], dict[str, FloatArray]()
    print("input of the paper         A     s   sum of squares: paper     designed    ratio  at most")
    for names in (*((name,) for name in INPUTS), TOGETHER):
        inputs = [plan[name].inputs for name in names]
        amplitude = max(float(np.max(np.abs(u))) for u in inputs)
        duration = sum(plan[name].interval * (len(u) - 1) for name, u in zip(names, inputs, strict=True))
        posed = campaign(linear(), _FRICTIONLESS, amplitude=amplitude, duration=duration, initial={"phi_s": 2e-6})
        design = designed(posed)
        if len(names) == 1:
            papers[names[0]] = told(design, inputs[0][None])
        paper = squares(sum((papers[name] for name in names), np.zeros((3, 3))))
        designed_volume = squares(told(design, design.excitation.samples))
        gains.append(paper / designed_volume)
        print(
            f"{' + '.join(n.split('_')[0] for n in names):24} {amplitude:5.2f} {duration:5.2f}"
            f" {paper:18.4g} {designed_volume:12.4g} {gains[-1]:8.2f} {paper / least(design):8.2f}  "
            f"{design.excitation.description}",
            flush=True,
        )
    return gains


def at_standstill() -> None:
    """Print the friction at standstill identified from one designed run, and from the campaign's own ones."""
    plan = load_plan(ROOT / "campaigns/force_feedback")
    table = {
        f"lossTable[{r},{c}]": float(plan.rig.loss_table[r - 1, c - 1]) for r in _ROWS[1:] for c in range(2, 6)
    }
    known = table | {n: plan.rig.parameters[n] for n in ("d_S", "J_S", "d_G")}
    truth = dict(zip(("2", "3", "4", "5"), plan.rig.loss_table[0, 1:].tolist(), strict=True))
    start = {"2": 1.0, "3": 1.0, "4": 0.09, "5": 0.09}
    free = {
        f"lossTable[1,{c}]": ParameterSpec(
            f"lossTable[1,{c}]", start[c], *((0.5, 1.0) if c in "23" else (0.005, 0.4)), truth=truth[c]
        )
        for c in truth
    }
    what = campaign(free, known, amplitude=0.5, duration=0.9, initial={"phi_s": 2e-6}, repeats=plan.repeats)
    design = designed(what)
    run = PlannedExperiment("designed", "fixed_shaft", 5e-4, design.excitation.samples[0])
    recorded = tuple(e for e in plan.experiments if e.id in ("step_0p5", "prbs_0p5", "step_1p0"))
    print(
        f"\nfriction at standstill: {design.excitation.description}, {len(run.inputs) * 5e-4:.2g} s, "
        f"{plan.repeats} times"
    )
    for label, runs in (("designed run", (run,)), ("the campaign's own", recorded)):
        measured = carry_out(replace(plan, experiments=runs))
        ids = tuple(measured.experiments)
        stage = StageSpec("standstill", ids, tuple(free))
        posed = replace(what, measurements=measured, stages={"standstill": stage}, identification=ids)
        estimates = identify(posed).stages[0].estimates
        print(label)
        for e in estimates:
            off = (e.value - e.truth) / e.standard_error if e.truth is not None and e.standard_error else np.nan
            print(
                f"  {e.name}  {e.value:.5f} +- {e.standard_error or np.nan:.5f}  truth {e.truth}"
                f"  ({off:+.1f} sigma)"
            )


def study(_: Sequence[str]) -> None:
    """Run both parts."""
    gains = against_the_paper()
    print(f"smallest ratio {min(gains):.1f}; of the three together {gains[-1]:.1f} (aim: 4)")
    at_standstill()


if __name__ == "__main__":
    sys.exit(run_module("benchmarks.designed_actuator", sys.argv[1:], study))
