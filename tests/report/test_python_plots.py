"""`.plot()` of campaigns, results, validations and diagnoses, and a campaign in a notebook."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from fmuid.core.campaign import Campaign, ParameterSpec
from fmuid.core.errors import FmuidError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.identification.result import Result
from fmuid.identification.validate import Validation


@pytest.fixture
def campaign() -> Campaign:
    time = np.linspace(0.0, 1.0, 50)
    signals = {"u": Signal("u", np.sin(time), "N", "input"), "x": Signal("x", time**2, "mm", "output")}
    runs = Measurements({"step": Experiment("step", "rig", time, signals)})
    mass = ParameterSpec("m", 1.0, 0.5, 2.0, "kg")
    return Campaign("bench", "A bench", Path(), runs, {}, {"m": mass}, {}, {}, ("step",), ())


def test_a_campaign_is_shown_by_its_parameters_and_plotted(campaign: Campaign) -> None:
    shown = campaign._repr_html_()
    assert "A bench" in shown
    assert "kg" in shown
    assert len(shown) < 1000
    figure = campaign.plot()
    assert [axes.get_title(loc="left") or axes.get_title() for axes in figure.axes] == ["step: u", "step: x"]


def test_a_plot_that_there_is_not_is_an_error_with_the_known_ones(campaign: Campaign) -> None:
    with pytest.raises(FmuidError, match="measurements"):
        campaign.plot("measurement")
    with pytest.raises(FmuidError, match="no values for the plot 'profile'"):
        Result("bench", "", "", (), {}).plot("profile")
    with pytest.raises(FmuidError):
        Validation(()).plot("overlay")


def test_a_result_shows_its_parameters_with_intervals() -> None:
    stage = {
        "name": "all", "status": "converged", "message": "", "solver": "trf", "why": "", "experiments": [],
        "estimates": [{"name": "m", "value": 2.0, "start": 1.0, "unit": "kg", "interval": [1.9, 2.1]}],
        "criteria": [], "start_cost": 1.0, "cost": 0.1, "evaluations": 3, "failures": 0, "seconds": 0.1,
    }  # fmt: skip
    text = json.dumps({"campaign": "c", "title": "", "source": "", "stages": [stage], "parameters": {"m": 2.0}})
    figure = msgspec.json.decode(text, type=Result).plot()
    assert "relative to the estimate" in figure.axes[0].get_xlabel()
