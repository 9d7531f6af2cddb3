"""Timing of signals: which convention a log follows, rows that it lost, and what campaign.toml says about it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fmu_build import build
from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.core.errors import CampaignError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.data.measurements import write_measurements
from fmuid.identification.problem.cases import from_campaign
from fmuid.init.seen_run import SeenRun
from fmuid.init.timing import chosen, lost_rows, timing_conventions
from fmuid.simulation.fmu import Fmu, load_fmu
from fmuid.simulation.runners import in_process
from fmuid.simulation.simulator import Task

MODEL = """
model Boiler "A heater, whose current answers at once, and the water that it warms"
  parameter Real R = 20;
  parameter Real C = 50;
  parameter Real G = 1;
  input Real u;
  output Real i = u/R;
  output Real v = u - 0.1*i;
  output Real x(start = 0, fixed = true);
equation
  C*der(x) = u*i - G*x;
end Boiler;
"""
TIME = np.arange(0.0, 200.0, 1.0)
OUTPUTS = ("i", "v", "x")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Fmu:
    folder = tmp_path_factory.mktemp("boiler")
    (folder / "Boiler.mo").write_text(MODEL)
    return load_fmu(build(folder / "Boiler.mo", "Boiler", folder, "2"))


def command() -> np.ndarray:
    levels = np.random.default_rng(2).uniform(2.0, 24.0, 25)
    return np.repeat(levels, 8)


def noisy(y: np.ndarray, share: float = 0.01) -> np.ndarray:
    sigma = share * np.ptp(y, axis=1, keepdims=True)
    return np.asarray(y + sigma * np.random.default_rng(5).normal(size=y.shape))


def plant(model: Fmu, u: np.ndarray, **how) -> np.ndarray:
    """A heater with other values, that also loses heat in a way that the model lacks."""
    y = model.simulate(Task(TIME, {"u": u}, OUTPUTS, **how), {"R": 22.0, "C": 45.0, "G": 0.8})
    y[2] /= 1 + 0.002 * y[2]
    return y


@pytest.mark.parametrize(
    ("how", "timing", "signals"),
    [
        ({}, "held", {}),
        ({"interpolation": "linear"}, "linear", {}),
        ({"after": OUTPUTS}, "held-read-after", {}),
        ({"after": ("i",)}, "held-read-after", {"v": "held"}),
    ],
)
def test_the_convention_of_a_log_is_recognised(model: Fmu, how, timing, signals) -> None:
    u = command()
    task = Task(TIME, {"u": u}, OUTPUTS)
    seen = [SeenRun(model, task, noisy(plant(model, u, **how)), in_process)]
    convention = chosen(timing_conventions(seen, [model.variables[n] for n in ("R", "C", "G")]))
    assert (convention.timing, dict(convention.signals)) == (timing, signals)


@pytest.mark.parametrize("share", [0.3, 0.7, 0.9])
def test_the_time_from_inputs_to_readings_is_fitted(model: Fmu, share: float) -> None:
    seen = [
        SeenRun(model, Task(TIME, {"u": u}, OUTPUTS), noisy(plant(model, u, read_after=share), 0.002), in_process)
        for u in (command(), command()[::-1].copy())
    ]
    convention = chosen(timing_conventions(seen, [model.variables[n] for n in ("R", "C", "G")]))
    assert convention.timing == "held"
    assert convention.read_after == pytest.approx(share, abs=0.1)


@pytest.mark.parametrize("size", [0.08, 0.24])
def test_a_law_that_the_model_lacks_is_no_time_of_reading(model: Fmu, size: float) -> None:
    """What acts with the sign of the speed leads by more than a step, and its errors change slowly."""
    u = command()
    x = model.simulate(Task(TIME, {"u": u}, ("x",)), {"R": 22.0, "C": 45.0, "G": 0.8})
    y = noisy(x + size * np.ptp(x) * np.tanh(100.0 * np.gradient(x[0]) / np.ptp(x)), 1e-4)
    seen = [SeenRun(model, Task(TIME, {"u": u}, ("x",)), y, in_process)]
    assert not any(
        c.read_after for c in timing_conventions(seen, [model.variables[n] for n in ("R", "C", "G")]) if c.explains
    )


@pytest.mark.parametrize(("interpolation", "timing"), [("hold", "held"), ("linear", "linear")])
def test_the_convention_of_a_noisy_log_is_seen_from_sample_to_sample(model: Fmu, interpolation, timing) -> None:
    u = command()
    noise = noisy(plant(model, u, interpolation=interpolation), 0.25)
    seen = [SeenRun(model, Task(TIME, {"u": u}, OUTPUTS), noise, in_process)]
    conventions = timing_conventions(seen, [model.variables[n] for n in ("R", "C", "G")])
    assert max(c.worse for c in conventions) < 1.25  # the noise exceeds what the timing does
    assert chosen(conventions).timing == timing


@pytest.mark.parametrize("lost", [57, None])
def test_a_row_that_a_log_has_lost_is_reported(model: Fmu, lost) -> None:
    ramp = 12.0 + 10.0 * np.sin(0.03 * TIME)
    y = plant(model, ramp, interpolation="linear")
    y += 1e-4 * np.ptp(y, axis=1, keepdims=True) * np.random.default_rng(5).normal(size=y.shape)
    keep = np.arange(TIME.size) != lost
    count = int(keep.sum())
    task = Task(TIME[:count], {"u": ramp[keep]}, OUTPUTS, interpolation="linear")
    seen = SeenRun(model, task, y[:, keep], in_process)
    rows = lost_rows([seen.refitted([model.variables[n] for n in ("R", "C", "G")])], ["log"])
    assert [row.sample for row in rows] == ([lost] if lost else [])


TOML = """
[campaign]
name = "b"
[models.bench]
fmu = "{fmu}"
{timing}
[parameters.R]
start = 20.0
lower = 2.0
upper = 200.0
[stages.all]
{signals}
"""


def campaign(model: Fmu, folder: Path, timing: str, signals: str = "") -> Path:
    u = command()
    y = plant(model, u)
    signal = {n: Signal(n, row, "1", "output") for n, row in zip(OUTPUTS, y, strict=True)}
    run = Experiment("run", "bench", TIME, {"u": Signal("u", u, "1", "input"), **signal})
    write_measurements(Measurements({"run": run}), folder / "measurements.h5")
    (folder / "campaign.toml").write_text(TOML.format(fmu=model.path, timing=timing, signals=signals))
    return folder


def test_a_campaign_states_the_timing_of_a_model_and_of_single_signals(model: Fmu, tmp_path: Path) -> None:
    signals = '[signals.v]\ntiming = "held"\n[signals.x]\nshift = 0.25\n'
    loaded = load_campaign(campaign(model, tmp_path, 'timing = "held-read-after"', signals))
    (case,) = from_campaign(loaded, list(loaded.measurements), (), {"bench": model})
    assert case.task.after == ("i", "x")
    assert case.task.interpolation == "hold"
    x = loaded.measurements["run"].signals["x"]
    np.testing.assert_allclose(x.values[1:], np.interp(TIME[1:] - 0.25, TIME, plant(model, command())[2]))
    assert np.isnan(x.values[0])
    assert x.resampled == "shifted by 0.25 s"
    linear = load_campaign(campaign(model, tmp_path, 'timing = "held"', '[signals.u]\ntiming = "linear"\n'))
    (case,) = from_campaign(linear, list(linear.measurements), (), {"bench": model})
    assert (case.task.interpolation, case.task.linear, case.task.after) == ("hold", ("u",), ())
    smooth = load_campaign(campaign(model, tmp_path, 'timing = "band-limited"'))
    (case,) = from_campaign(smooth, list(smooth.measurements), (), {"bench": model})
    assert (case.task.interpolation, case.task.band_limited) == ("band-limited", ())
    mixed = load_campaign(campaign(model, tmp_path, 'timing = "held"', '[signals.u]\ntiming = "band-limited"\n'))
    (case,) = from_campaign(mixed, list(mixed.measurements), (), {"bench": model})
    assert (case.task.interpolation, case.task.band_limited) == ("hold", ("u",))
    later = load_campaign(campaign(model, tmp_path, 'timing = "held"\nread_after = 0.4'))
    (case,) = from_campaign(later, list(later.measurements), (), {"bench": model})
    assert (case.task.interpolation, case.task.read_after) == ("hold", 0.4)
    old = load_campaign(campaign(model, tmp_path, 'interpolation = "linear"'))
    assert old.models["bench"].timing == "linear"


@pytest.mark.parametrize(
    ("timing", "signals", "line"),
    [
        ('timing = "held"\ninterpolation = "hold"', "", "has timing and interpolation; remove interpolation"),
        (
            "",
            '[signals.u]\ntiming = "held-read-after"',
            "which inputs cannot have; choose held, linear or band-limited",
        ),
        ('timing = "held"\nread_after = -0.1', "", "read_after is -0.1; write a positive number"),
        ('timing = "preceding"\nread_after = 0.1', "", "read_after beside timing 'preceding'; remove one of them"),
        ("", '[signals.i]\ntiming = "linear"', "which outputs cannot have; choose held or held-read-after"),
        ("", "[signals.i]\nshift = 500", "shift is 500 s, longer than the run in run 'run'; write seconds"),
    ],
)
def test_timings_that_make_no_sense(model: Fmu, tmp_path: Path, timing: str, signals: str, line: str) -> None:
    with pytest.raises(CampaignError, match=line):
        load_campaign(campaign(model, tmp_path, timing, signals))


def test_a_fit_far_from_the_start_value_reaches_the_guessed_bounds(model: Fmu) -> None:
    u, free = command(), [model.variables[n] for n in ("R", "C", "G")]
    y = model.simulate(Task(TIME, {"u": u}, OUTPUTS), {"R": 19.0, "C": 900.0, "G": 1.2})
    fitted = SeenRun(model, Task(TIME, {"u": u}, OUTPUTS), y, in_process).refitted(free)
    assert [fitted.at_bound(v) for v in free] == [False, True, False]


def test_a_refit_keeps_the_values_of_parameters_that_are_not_free(model: Fmu) -> None:
    u, values = command(), {"R": 19.0, "C": 900.0, "G": 1.2}
    y = model.simulate(Task(TIME, {"u": u}, OUTPUTS), values)
    run = SeenRun(model, Task(TIME, {"u": u}, OUTPUTS), y, in_process, values={**values, "R": 21.0})
    assert run.refitted([model.variables["R"]]).left < 1e-6 * run.left
