"""Sensitivity before an identification: what the experiments can show about the parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmuid.core.campaign import Campaign
from fmuid.core.errors import SimulationError
from fmuid.core.experiments import Experiment
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.derivatives import Differences, NoiseFloor, noise_floor
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.uncertainty.identifiability import Identifiability, identifiability

_STANDSTILL = 0.02  # share of the largest speed below which a sample counts as standstill
_LOADED = 0.1  # share of the largest load below which a sample counts as unloaded
_SPEEDS = ("rad/s", "m/s", "rpm", "deg/s", "1/min")
_LOADS = ("N.m", "Nm", "N", "A")


@dataclass(frozen=True, slots=True, eq=False)
class Sensitivity:
    """Effects of small parameter changes around one point.

    Parameters
    ----------
    names, labels
        The parameters and the criteria.
    effect
        (n_parameters, n_criteria): root mean square change of a criterion's residuals (in sigmas) for a 1 %
        change of a parameter.
    steps
        (n_parameters,) relative finite-difference steps, chosen from the noise floor.
    floor
        The simulator's noise floor.
    identifiability
        Identifiability, to first order.
    """

    names: tuple[str, ...]
    labels: tuple[str, ...]
    effect: FloatArray
    steps: FloatArray
    floor: NoiseFloor
    identifiability: Identifiability

    @property
    def dead(self) -> tuple[str, ...]:
        """Parameters that affect no output by more than the simulator's own noise."""
        silent = np.max(self.effect, axis=1) <= max(self.floor.residual, 1e-12)
        return tuple(name for name, dead in zip(self.names, silent, strict=True) if dead)

    def __str__(self) -> str:
        """Return the strongest effect of each parameter, and the findings."""
        lines = [
            f"{name}: a change of 1 % moves '{self.labels[int(np.argmax(row))]}' by {np.max(row):.3g} sigma"
            for name, row in zip(self.names, self.effect, strict=True)
        ]
        lines.append(f"noise floor of the simulator: {self.floor.residual:.2g} sigma")
        return "\n".join([*lines, str(self.identifiability)])


def sensitivity_of(problem: Problem, x: FloatArray | None = None) -> Sensitivity:
    """Return the sensitivity of a problem at a search point.

    Parameters
    ----------
    problem
        A problem with n free parameters.
    x
        (n,) in search space; the start by default.

    Raises
    ------
    SimulationError
        The point or its neighbourhood cannot be simulated.
    """
    x = problem.space.start if x is None else x
    here = problem.evaluate(x)
    if here.failure is not None:
        raise SimulationError(here.failure, fix="choose other start values")
    floor = noise_floor(problem, x)
    differences = Differences(problem, floor, central=True)
    j = differences.jacobian(problem.evaluate_many, here)
    step = np.array(differences.steps)
    log = np.array([spec.scale == "log" for spec in problem.space.free])
    scale = np.where(log | (x == 0.0), 1.0, np.abs(x))
    effect = np.array([np.sqrt(np.mean((0.01 * scale * j[rows]) ** 2, axis=0)) for rows in problem.slices]).T
    separable = identifiability(problem, x, j, differences.column_scale(j), tolerance=differences.tolerance)
    return Sensitivity(problem.space.names, problem.labels, effect, step / scale, floor, separable)


def excitation(campaign: Campaign) -> tuple[str, ...]:
    """Return sentences on missing excitation in the identification runs; empty if nothing is missing.

    The judgement uses measured signals: speeds (rad/s, m/s) and loads (N.m, N, A).
    """
    runs = [campaign.measurements[i] for i in campaign.identification]
    findings = []
    speeds = {(e.id, s.name): s.values for e in runs for s in e.signals.values() if s.unit in _SPEEDS}
    if speeds:
        if not any(_reverses(v) for v in speeds.values()):
            findings.append("no run reverses direction: friction cannot be distinguished from an offset")
        elif not any(_reverses_loaded(e) for e in runs):
            findings.append(
                "no run reverses direction under load: load-dependent friction near standstill is not excited"
            )
        if not any(_varies(v) for v in speeds.values()):
            findings.append(
                "every run has a constant speed: inertia is not excited, and viscous and Coulomb friction"
                " cannot be distinguished within a run"
            )
    for e in runs:
        for name, signal in e.inputs.items():
            if len(e.time) > 1 and np.ptp(signal.values) == 0.0 and e.repeat_of is None:
                findings.append(f"input '{name}' of '{e.id}' is constant")
    return tuple(dict.fromkeys(findings))


def _reverses(speed: FloatArray) -> bool:
    speed = speed[np.isfinite(speed)]
    level = _STANDSTILL * np.max(np.abs(speed), initial=0.0)
    signs = np.sign(speed[np.abs(speed) > level])
    return bool(np.any(np.diff(signs) != 0)) if level > 0.0 else False


def _reverses_loaded(experiment: Experiment) -> bool:
    signals = experiment.signals.values()
    loads = [s.values for s in signals if s.unit in _LOADS]
    for speed in (s.values for s in signals if s.unit in _SPEEDS):
        filled = np.nan_to_num(speed)
        level = _STANDSTILL * np.max(np.abs(filled), initial=0.0)
        moving = np.flatnonzero(np.abs(filled) > level)
        turns = moving[1:][np.diff(np.sign(filled[moving])) != 0]
        for load in loads:
            size = np.abs(np.nan_to_num(load))
            if np.any(size[turns] > _LOADED * np.max(size, initial=0.0)):
                return True
    return False


def _varies(speed: FloatArray) -> bool:
    known: FloatArray = np.abs(speed[np.isfinite(speed)])
    return bool(np.ptp(known) > 0.1 * np.max(known, initial=0.0)) if len(known) else False
