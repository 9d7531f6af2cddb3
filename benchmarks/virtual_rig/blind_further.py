"""The run that a diagnosis suggested, made on the blind case that it was suggested for."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from benchmarks.virtual_rig.blind_cases import Truth, record_case
from benchmarks.virtual_rig.blind_experiments import sealed_experiments
from fmuid.core.errors import FmuidError
from fmuid.core.experiments import Measurements
from fmuid.data.measurements import read_measurements, write_measurements

_SUGGESTION = re.compile(r"as (?P<id>\S+), with its input times (?P<scale>\S+)")


def add_suggested_run(truth: Truth, description: str, campaign: Path, target: Path) -> None:
    """Write the runs of the file `campaign` and, repeated as often as those, the suggested one.

    Raises
    ------
    FmuidError
        The suggestion is none of a variation of one of the campaign's experiments.
    """
    found = _SUGGESTION.fullmatch(description)
    planned = {e.id: e for e in sealed_experiments()}.get(found["id"]) if found else None
    if found is None or planned is None:
        raise FmuidError(
            f"'{description}' cannot be made on the virtual rig",
            where=truth.case.name,
            fix="suggest a variation of an experiment",
        )
    further = replace(planned, id=f"{planned.id}_further", inputs=float(found["scale"]) * planned.inputs)
    made = record_case(truth, (further,), "further")
    before = read_measurements(campaign)
    both = Measurements({**before.experiments, **made.experiments}, title=before.title, rig=before.rig)
    target.parent.mkdir(parents=True, exist_ok=True)
    write_measurements(both, target)
