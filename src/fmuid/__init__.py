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
    from fmuid.campaign_toml import load_campaign as load_campaign
    from fmuid.cases import measured_case as measured_case
    from fmuid.coupled.loading import couple as couple
    from fmuid.coupled.loading import load_model as load_model
    from fmuid.coupled.structure import Master as Master
    from fmuid.diagnosis.of_campaign import diagnose as diagnose
    from fmuid.errors import FmuidError as FmuidError
    from fmuid.fmu import load_fmu as load_fmu
    from fmuid.history import read_history as read_history
    from fmuid.identification import identify as identify
    from fmuid.measurements import read_measurements as read_measurements
    from fmuid.measurements import write_measurements as write_measurements
    from fmuid.observer import Observer as Observer
    from fmuid.problem import Problem as Problem
    from fmuid.profiles import profile_of as profile_of
    from fmuid.progress import TerminalProgress as TerminalProgress
    from fmuid.propagation import propagate as propagate
    from fmuid.result import Result as Result
    from fmuid.sensitivity import sensitivity_of as sensitivity_of
    from fmuid.simulation import Simulator as Simulator
    from fmuid.simulation import Task as Task
    from fmuid.simulation import Variable as Variable
    from fmuid.solvers import Status as Status
    from fmuid.solvers import StopRules as StopRules
    from fmuid.uncertainty import uncertainty_of as uncertainty_of
    from fmuid.validation import validate as validate
    from fmuid.workers import WorkerPool as WorkerPool

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
    "Problem": "problem",
    "Result": "result",
    "Signal": "campaign",
    "Simulator": "simulation",
    "StageSpec": "campaign",
    "Status": "solvers",
    "StopRules": "solvers",
    "Task": "simulation",
    "TerminalProgress": "progress",
    "Variable": "simulation",
    "WorkerPool": "workers",
    "couple": "coupled.loading",
    "diagnose": "diagnosis.of_campaign",
    "identify": "identification",
    "load_campaign": "campaign_toml",
    "load_fmu": "fmu",
    "load_model": "coupled.loading",
    "measured_case": "cases",
    "profile_of": "profiles",
    "propagate": "propagation",
    "read_history": "history",
    "read_measurements": "measurements",
    "sensitivity_of": "sensitivity",
    "uncertainty_of": "uncertainty",
    "validate": "validation",
    "write_measurements": "measurements",
}
__all__ = list(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'fmuid' has no attribute '{name}'")
    return getattr(importlib.import_module(f"fmuid.{_PUBLIC[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_PUBLIC)
