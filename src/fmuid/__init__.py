"""Identify the parameters of FMUs from measurement campaigns, and diagnose what the model misses.

::

    campaign = fmuid.load_campaign("campaigns/force_feedback")
    result = fmuid.identify(campaign, out="runs/force_feedback")
    print(result)
    print(fmuid.validate(result))
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fmuid.campaigns.campaign_toml import load_campaign as load_campaign
    from fmuid.core.campaign import AnalysisSpec as AnalysisSpec
    from fmuid.core.campaign import Campaign as Campaign
    from fmuid.core.campaign import CriterionSpec as CriterionSpec
    from fmuid.core.campaign import ParameterSpec as ParameterSpec
    from fmuid.core.campaign import ParetoSpec as ParetoSpec
    from fmuid.core.campaign import StageSpec as StageSpec
    from fmuid.core.coupling import Master as Master
    from fmuid.core.errors import FmuidError as FmuidError
    from fmuid.core.experiments import Experiment as Experiment
    from fmuid.core.experiments import Measurements as Measurements
    from fmuid.core.experiments import Signal as Signal
    from fmuid.data.measurements import read_measurements as read_measurements
    from fmuid.data.measurements import write_measurements as write_measurements
    from fmuid.design_pipeline import Designed as Designed
    from fmuid.design_pipeline import design_experiment as design_experiment
    from fmuid.diagnosis.diagnose import Found as Found
    from fmuid.diagnosis_pipeline import diagnose as diagnose
    from fmuid.identification.history import StageHistory as StageHistory
    from fmuid.identification.history import read_history as read_history
    from fmuid.identification.identify import identify as identify
    from fmuid.identification.observer import Observer as Observer
    from fmuid.identification.problem.cases import Case as Case
    from fmuid.identification.problem.cases import measured_case as measured_case
    from fmuid.identification.problem.estimation_problem import Problem as Problem
    from fmuid.identification.result import Result as Result
    from fmuid.identification.result import StageResult as StageResult
    from fmuid.identification.solvers import Status as Status
    from fmuid.identification.solvers import StopRules as StopRules
    from fmuid.identification.terminal_progress import TerminalProgress as TerminalProgress
    from fmuid.identification.uncertainty.confidence import Uncertainty as Uncertainty
    from fmuid.identification.uncertainty.confidence import uncertainty_of as uncertainty_of
    from fmuid.identification.uncertainty.profiles import Profile as Profile
    from fmuid.identification.uncertainty.profiles import profile_of as profile_of
    from fmuid.identification.uncertainty.propagation import Propagated as Propagated
    from fmuid.identification.uncertainty.propagation import propagate as propagate
    from fmuid.identification.uncertainty.sensitivity import Sensitivity as Sensitivity
    from fmuid.identification.uncertainty.sensitivity import sensitivity_of as sensitivity_of
    from fmuid.identification.uncertainty.sobol_morris import GlobalSensitivity as GlobalSensitivity
    from fmuid.identification.uncertainty.sobol_morris import global_sensitivity_of as global_sensitivity_of
    from fmuid.identification.validate import Validation as Validation
    from fmuid.identification.validate import validate as validate
    from fmuid.init.starting import start as start
    from fmuid.sensitivity_pipeline import global_sensitivity as global_sensitivity
    from fmuid.simulation.coupled.coupled_model import CoupledModel as CoupledModel
    from fmuid.simulation.coupled.loading import couple as couple
    from fmuid.simulation.coupled.loading import load_model as load_model
    from fmuid.simulation.fmu import Fmu as Fmu
    from fmuid.simulation.fmu import load_fmu as load_fmu
    from fmuid.simulation.pool.workers import WorkerPool as WorkerPool
    from fmuid.simulation.simulator import Simulator as Simulator
    from fmuid.simulation.simulator import Task as Task
    from fmuid.simulation.simulator import Variable as Variable

# Public name -> module, loaded on first use, so that `import fmuid` stays quick. No module has the name of a
# function.

_PUBLIC = {
    "AnalysisSpec": "core.campaign",
    "Campaign": "core.campaign",
    "Case": "identification.problem.cases",
    "CoupledModel": "simulation.coupled.coupled_model",
    "CriterionSpec": "core.campaign",
    "Designed": "design_pipeline",
    "Experiment": "core.experiments",
    "Fmu": "simulation.fmu",
    "FmuidError": "core.errors",
    "Found": "diagnosis.diagnose",
    "GlobalSensitivity": "identification.uncertainty.sobol_morris",
    "Master": "core.coupling",
    "Measurements": "core.experiments",
    "Observer": "identification.observer",
    "ParameterSpec": "core.campaign",
    "ParetoSpec": "core.campaign",
    "Problem": "identification.problem.estimation_problem",
    "Profile": "identification.uncertainty.profiles",
    "Propagated": "identification.uncertainty.propagation",
    "Result": "identification.result",
    "Sensitivity": "identification.uncertainty.sensitivity",
    "Signal": "core.experiments",
    "Simulator": "simulation.simulator",
    "StageHistory": "identification.history",
    "StageResult": "identification.result",
    "StageSpec": "core.campaign",
    "Status": "identification.solvers",
    "StopRules": "identification.solvers",
    "Task": "simulation.simulator",
    "TerminalProgress": "identification.terminal_progress",
    "Uncertainty": "identification.uncertainty.confidence",
    "Validation": "identification.validate",
    "Variable": "simulation.simulator",
    "WorkerPool": "simulation.pool.workers",
    "couple": "simulation.coupled.loading",
    "design_experiment": "design_pipeline",
    "diagnose": "diagnosis_pipeline",
    "global_sensitivity": "sensitivity_pipeline",
    "global_sensitivity_of": "identification.uncertainty.sobol_morris",
    "identify": "identification.identify",
    "load_campaign": "campaigns.campaign_toml",
    "load_fmu": "simulation.fmu",
    "load_model": "simulation.coupled.loading",
    "measured_case": "identification.problem.cases",
    "profile_of": "identification.uncertainty.profiles",
    "propagate": "identification.uncertainty.propagation",
    "read_history": "identification.history",
    "read_measurements": "data.measurements",
    "sensitivity_of": "identification.uncertainty.sensitivity",
    "start": "init.starting",
    "uncertainty_of": "identification.uncertainty.confidence",
    "validate": "identification.validate",
    "write_measurements": "data.measurements",
}
__all__ = list(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'fmuid' has no attribute '{name}'")
    return getattr(importlib.import_module(f"fmuid.{_PUBLIC[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_PUBLIC)


def _as_html(shown: Any) -> str:
    from fmuid.report.notebook import as_html

    return as_html(shown)


def _show_pictures_in_notebooks() -> None:
    """Make IPython kernels show results with pictures; the results themselves know nothing of plots."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    if shell is not None:
        formatter = shell.display_formatter.formatters["text/html"]
        formatter.for_type_by_name("fmuid.identification.result", "Result", _as_html)
        formatter.for_type_by_name("fmuid.identification.validate", "Validation", _as_html)
        formatter.for_type_by_name("fmuid.diagnosis.diagnose", "Found", _as_html)


_show_pictures_in_notebooks()
