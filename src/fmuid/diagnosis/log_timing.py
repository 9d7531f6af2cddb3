"""Lags and delays of less than a sample that are the timing of the log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fmuid.core.campaign import Campaign, without_owner
from fmuid.diagnosis.diagnose import Found
from fmuid.init.timing import chosen, conventions_of
from fmuid.simulation.runners import Runner
from fmuid.simulation.signal_effects import signal_and_property


def with_timing_of_log(campaign: Campaign, found: Found, runner: Runner) -> tuple[Campaign, str] | None:
    """Return the campaign with the timing that explains a lag or delay of less than a sample, and a note.

    None if the diagnosis has no such lag or delay, or if no other timing explains it.
    """
    setups = {}
    for setup in dict.fromkeys(case.setup for case in found.subject.model.cases):
        cases = [case for case in found.subject.model.cases if case.setup == setup]
        if not _is_late(found, min(float(np.median(np.diff(case.time))) for case in cases)):
            continue
        values = {**found.subject.model.fixed, **{u.name: u.start for u in found.subject.nominal}}
        names = {without_owner(u.name) for u in found.subject.nominal}
        convention = chosen(conventions_of(cases, values, names, runner))
        if convention.explains and convention.timing != campaign.models[setup].timing:
            setups[setup] = convention
    if not setups:
        return None
    models = {s: replace(m, timing=setups[s].timing) if s in setups else m for s, m in campaign.models.items()}
    timings = dict(campaign.timings)
    for setup, convention in setups.items():
        names_of = {campaign.models[setup].variable(n): n for e in campaign.measurements for n in e.outputs}
        timings |= {names_of.get(variable, variable): t for variable, t in convention.signals.items()}
    note = "; ".join(
        f'\'{setup}\' was diagnosed with timing = "{c.timing}" instead of "{campaign.models[setup].timing}", which'
        f" explains the runs {c.worse:.2g} times better than held signals; write it in campaign.toml"
        for setup, c in setups.items()
    )
    return replace(campaign, models=models, timings=timings), note


def _is_late(found: Found, step: float) -> bool:
    """Return whether the best answer has a lag or delay of a signal that is shorter than a sample."""
    for name, value in found.corrected.fit.values.items():
        signal = signal_and_property(name)
        if signal is not None and signal[1] in ("lag", "delay") and 0.0 < value < step:
            return True
    return False
