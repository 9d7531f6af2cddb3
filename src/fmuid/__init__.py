"""Identify the parameters of FMUs from measurement campaigns, and diagnose what the model misses.

::

    campaign = fmuid.load_campaign("campaigns/force_feedback")
    result = fmuid.identify(campaign, out="runs/force_feedback")
    print(result)
    print(fmuid.validate(result))
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fmuid.campaign import AnalysisSpec as AnalysisSpec
    from fmuid.campaign import Campaign as Campaign
    from fmuid.campaign import CriterionSpec as CriterionSpec
    from fmuid.campaign import Experiment as Experiment
    from fmuid.campaign import Measurements as Measurements
    from fmuid.campaign import ParameterSpec as ParameterSpec
    from fmuid.campaign import ParetoSpec as ParetoSpec
    from fmuid.campaign import Signal as Signal
    from fmuid.campaign import StageSpec as StageSpec
    from fmuid.campaigns.campaign_toml import load_campaign as load_campaign
    from fmuid.coupled.loading import couple as couple
    from fmuid.coupled.loading import load_model as load_model
    from fmuid.coupled.structure import Master as Master
    from fmuid.data.measurements import read_measurements as read_measurements
    from fmuid.data.measurements import write_measurements as write_measurements
    from fmuid.diagnosis.of_campaign import diagnose as diagnose
    from fmuid.errors import FmuidError as FmuidError
    from fmuid.history import read_history as read_history
    from fmuid.identification import identify as identify
    from fmuid.observer import Observer as Observer
    from fmuid.problems.cases import measured_case as measured_case
    from fmuid.problems.problem import Problem as Problem
    from fmuid.progress import TerminalProgress as TerminalProgress
    from fmuid.result import Result as Result
    from fmuid.running.workers import WorkerPool as WorkerPool
    from fmuid.simulators.fmu import load_fmu as load_fmu
    from fmuid.simulators.simulation import Simulator as Simulator
    from fmuid.simulators.simulation import Task as Task
    from fmuid.simulators.simulation import Variable as Variable
    from fmuid.solvers import Status as Status
    from fmuid.solvers import StopRules as StopRules
    from fmuid.statistics.profiles import profile_of as profile_of
    from fmuid.statistics.propagation import propagate as propagate
    from fmuid.statistics.sensitivity import sensitivity_of as sensitivity_of
    from fmuid.statistics.uncertainty import uncertainty_of as uncertainty_of
    from fmuid.validation import validate as validate

# Public name -> module, loaded on first use: `import fmuid` stays quick. No module has the name of a function.

_PUBLIC = {
    "AnalysisSpec": "campaign",
    "Campaign": "campaign",
    "CriterionSpec": "campaign",
    "Experiment": "campaign",
    "FmuidError": "errors",
    "Master": "coupled.structure",
    "Measurements": "campaign",
    "Observer": "observer",
    "ParameterSpec": "campaign",
    "ParetoSpec": "campaign",
    "Problem": "problems.problem",
    "Result": "result",
    "Signal": "campaign",
    "Simulator": "simulators.simulation",
    "StageSpec": "campaign",
    "Status": "solvers",
    "StopRules": "solvers",
    "Task": "simulators.simulation",
    "TerminalProgress": "progress",
    "Variable": "simulators.simulation",
    "WorkerPool": "running.workers",
    "couple": "coupled.loading",
    "diagnose": "diagnosis.of_campaign",
    "identify": "identification",
    "load_campaign": "campaigns.campaign_toml",
    "load_fmu": "simulators.fmu",
    "load_model": "coupled.loading",
    "measured_case": "problems.cases",
    "profile_of": "statistics.profiles",
    "propagate": "statistics.propagation",
    "read_history": "history",
    "read_measurements": "data.measurements",
    "sensitivity_of": "statistics.sensitivity",
    "uncertainty_of": "statistics.uncertainty",
    "validate": "validation",
    "write_measurements": "data.measurements",
}
__all__ = list(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'fmuid' has no attribute '{name}'")
    return getattr(importlib.import_module(f"fmuid.{_PUBLIC[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_PUBLIC)
