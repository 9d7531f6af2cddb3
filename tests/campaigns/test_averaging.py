"""Runs with more samples than their signals need are averaged before a diagnosis; others stay as they are."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmuid.core.campaign import Campaign, ModelSpec
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.data.averaging import averaged
from fmuid.data.filtering import first_order

STEP, LAG = 1e-3, 0.5


def lag(u, step):
    """The output of a first-order lag before each sample of a held input acts."""
    keep = np.exp(-step / LAG)
    return first_order((1.0 - keep) * np.append(0.0, u[:-1]), keep)


def campaign(samples=12_000, ripple=0.0, timing="held"):
    time = STEP * np.arange(samples)
    u = np.sign(np.sin(3.0 * time)) + 0.5 * np.random.default_rng(0).standard_normal(samples)
    y = lag(u, STEP) + ripple * np.sin(2 * np.pi * 300.0 * time)
    signals = {"u": Signal("u", u, "V", "input"), "y": Signal("y", y, "V", "output", 0.01)}
    run = Experiment("run", "bench", time, signals, unused={"T": Signal("T", time, "K", "input")})
    models = {"bench": ModelSpec("bench", Path("bench.fmu"), timing=timing)}
    return Campaign("bench", "", Path(), Measurements({"run": run}), models, {}, {}, {}, ("run",), ())


def test_averaged_inputs_lead_a_model_to_the_averaged_outputs():
    coarse, (note,) = averaged(campaign())
    (run,) = coarse.measurements
    assert len(run.time) == 1500
    assert run.time[1] == pytest.approx(8 * STEP)
    assert run.signals["y"].sigma == pytest.approx(0.01 / np.sqrt(8))
    assert len(run.unused["T"].values) == 1500
    y = run.signals["y"].values
    assert np.std(lag(run.signals["u"].values, 8 * STEP) - y) < 0.01 * np.std(y)
    assert "8 samples" in note


@pytest.mark.parametrize("given", [{"samples": 2900}, {"ripple": 0.05}, {"timing": "band-limited"}])
def test_runs_that_need_their_samples_keep_them(given):
    before = campaign(**given)
    assert averaged(before) == (before, ())


def test_missing_samples_are_not_averaged():
    before = campaign()
    run = before.measurements["run"]
    y = np.where(np.arange(len(run.time)) == 7, np.nan, run.signals["y"].values)
    holed = replace(run, signals={**run.signals, "y": replace(run.signals["y"], values=y)})
    holed = replace(before, measurements=Measurements({"run": holed}))
    assert averaged(holed)[0] is holed
