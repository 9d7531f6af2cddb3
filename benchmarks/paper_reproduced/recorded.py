"""The paper's experiments, on the virtual rig."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.virtual_rig.rig_plan import Plan, carry_out, load_plan
from fmuid.core.experiments import Measurements

ROOT = Path(__file__).parents[2]
CAMPAIGN = ROOT / "campaigns" / "paper"
FIRST_ROW = (10.0, 0.923, 0.864, 0.058, 0.058)  # what the paper found first, Fig. 13
_LOSSLESS = ((0.0, 1.0, 1.0, 0.0, 0.0),)


def plans() -> tuple[Plan, ...]:
    """Return the plans: with the shaft fixed a gear without losses, for all other runs one with the loss table.

    Runs named ``first_*`` are those of a gear with the paper's first row.
    """
    plan = load_plan(ROOT / "campaigns" / "force_feedback")
    fixed = [e for e in plan.experiments if e.setup == "fixed_shaft"]
    turning = [e for e in plan.experiments if e.setup != "fixed_shaft" and e.id != "shaker"]
    first = [replace(e, id=e.id.replace("row", "first")) for e in turning if e.id.startswith("row_10")]
    table = plan.rig.loss_table
    with_first = [FIRST_ROW if row[0] == FIRST_ROW[0] else row for row in table]
    parts = ((_LOSSLESS, fixed), (table, turning), (with_first, first))
    return tuple(
        replace(plan, rig=replace(plan.rig, loss_table=np.array(losses)), experiments=tuple(experiments))
        for losses, experiments in parts
    )


def measured() -> Measurements:
    """Return the recordings of the plans."""
    recorded = {run.id: run for plan in plans() for run in carry_out(plan)}
    return Measurements(recorded, title="The paper's experiments", rig="fmuid virtual rig", source="simulated")
