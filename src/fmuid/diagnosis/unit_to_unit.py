"""Differences between machines in a diagnosis: which parameters of its answer differ from machine to machine.

The effects of the answer and the nominal parameters are refitted to the runs of each machine separately, even if
they are shared in the diagnosis; the estimates are then compared given their standard errors (Cochran's test).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fmuid.core.campaign import SEPARATOR, without_owner
from fmuid.core.immutable import FloatArray
from fmuid.diagnosis.candidates import Fitted, estimates, fit_effects
from fmuid.diagnosis.observed import excesses
from fmuid.diagnosis.subject import Subject
from fmuid.diagnosis.verdict import BetweenMachines, Estimate, MachineParameter
from fmuid.identification.uncertainty.between_machines import machine_spread

LEVEL = 0.05  # significance level of a difference in any of the parameters


def between_machines(subject: Subject, answer: Fitted) -> BetweenMachines | None:
    """Return which parameters of an answer differ between machines; None unless there are several machines.

    Parameters of single experiments are refitted as well, but not compared.
    """
    machines = tuple(dict.fromkeys(case.machine for case in subject.model.cases))
    if len(machines) < 2:
        return None
    found: dict[str, dict[str, Estimate]] = {}
    failed: list[str] = []
    beyond: list[tuple[FloatArray, FloatArray]] = []  # remaining squared gaps, and numbers of components averaged
    for machine in machines:
        own = of_machine(subject, machine)
        fitted = fit_effects(own, [e for e in own.effects if e.id in answer.effects], [answer.fit.values])
        if fitted is None:
            failed.append(machine)
            continue
        beyond.append(excesses(fitted.fit.residuals, own.observed))
        singles = {f"{SEPARATOR}{case.id}" for case in own.model.cases} - {f"{SEPARATOR}{machine}"}
        for name, estimate in estimates(fitted, own).items():
            if not any(name.endswith(single) for single in singles):
                found.setdefault(without_owner(name), {})[machine] = estimate
    compared = {name: own for name, own in found.items() if sum(1 for e in own.values() if e.standard_error) > 1}
    parameters = [_compared(name, own, len(compared)) for name, own in compared.items()]
    parameters.sort(key=lambda p: (not p.differs, p.p_value))
    left_out = tuple(name for name in found if name not in compared)
    gap = None
    if not failed:
        squares, sizes = (np.concatenate(parts) for parts in zip(*beyond, strict=True))
        gap = float(np.sqrt(max(0.0, float(np.average(squares, weights=sizes)))))
    return BetweenMachines(machines, answer.effects, tuple(parameters), gap, left_out, tuple(failed))


def of_machine(subject: Subject, machine: str) -> Subject:
    """Return the subject with the runs of one machine alone, and the nominal parameters of these runs."""
    cases = tuple(case for case in subject.model.cases if case.machine == machine)
    owners = {machine, *(case.id for case in cases)}
    parts = [u.name.partition(SEPARATOR) for u in subject.nominal]
    nominal = tuple(
        u for u, (_, of_one, owner) in zip(subject.nominal, parts, strict=True) if not of_one or owner in owners
    )
    observed = subject.observed.select([case.id for case in cases])
    return replace(subject, model=replace(subject.model, cases=cases), observed=observed, nominal=nominal)


def _compared(name: str, own: Mapping[str, Estimate], count: int) -> MachineParameter:
    known = {machine: e for machine, e in own.items() if e.standard_error}
    errors = [e.standard_error for e in known.values() if e.standard_error]
    spread = machine_spread(name, list(known), [e.value for e in known.values()], errors)
    return MachineParameter(
        name,
        spread.p_value * count < LEVEL,
        spread.p_value,
        spread.mean,
        spread.spread,
        spread.next_machine,
        own,
    )
