"""Provenance of a result: hashes of its files and of everything that determines the course of a stage."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from fmuid.core.campaign import Campaign
from fmuid.core.errors import SimulationError
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.solvers import Solver


def fingerprint(problem: Problem, solver: Solver, options: Mapping[str, Any], seed: int) -> str:
    """Return a hash of everything that determines the course of a search, except the budget."""
    digest = hashlib.sha256()
    space = problem.space
    ties = {name: expression.text for name, expression in space.ties.items()}
    posed = (problem.labels, problem.combination, problem.constraints, space.free, dict(space.fixed), ties)
    digest.update(repr((solver.name, sorted(options.items()), seed, *posed)).encode())
    for case in problem.cases:
        simulator = case.simulator
        digest.update(simulator.token.encode())
        task = case.task
        how = (task.interpolation, task.linear, task.band_limited, task.after, task.read_after)
        digest.update(repr((case.id, task.outputs, dict(task.start_values), *how)).encode())
        for array in (task.time, *task.inputs.values(), *(c.repeats for c in case.channels)):
            digest.update(np.ascontiguousarray(array).tobytes())
        means = {channel.signal: np.nan_to_num(channel.mean) for channel in case.channels}
        for criterion in case.criteria:
            digest.update(repr((criterion.kind, criterion.demand, criterion.weight)).encode())
            # Its options show in its result for some prediction; a user's function may be undefined there.
            with np.errstate(all="ignore"), suppress(SimulationError):
                digest.update(criterion.residuals(1.1 * means[criterion.signal]).tobytes())
    return digest.hexdigest()


def hashes_of(campaign: Campaign) -> dict[str, str]:
    """Return SHA-256 hashes of the measurements and of the FMUs."""
    digest = hashlib.sha256()
    for experiment in campaign.measurements:
        digest.update(experiment.id.encode() + experiment.time.tobytes())
        for name, signal in experiment.signals.items():
            digest.update(name.encode() + signal.values.tobytes())
    hashes = {"measurements": digest.hexdigest()}
    for model in campaign.models.values():
        for file in model.files:
            if file.is_file():
                hashes[file.name] = hashlib.sha256(file.read_bytes()).hexdigest()
    return hashes


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Return the versions of those `packages` that are installed."""
    versions = {}
    for package in packages:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions
