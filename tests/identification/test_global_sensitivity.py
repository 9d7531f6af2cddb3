"""Sobol' indices and elementary effects whose values are known, through FMUs and through analytic models."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmuid import ParameterSpec, Problem, Task, global_sensitivity, global_sensitivity_of, measured_case
from fmuid.cli.app import run
from fmuid.core.campaign import Prior
from fmuid.core.errors import CampaignError, ProblemError, SimulationError

pytest.importorskip("SALib")
SOURCE = Path(__file__).parent / "models" / "Ishigami.mo"
TOML = f"""
[models.ishigami]
source = "{SOURCE.name}"
[parameters]
a = {{ start = 1, lower = {-math.pi}, upper = {math.pi} }}
b = {{ start = 1, lower = {-math.pi}, upper = {math.pi} }}
c = {{ start = 1, lower = {-math.pi}, upper = {math.pi} }}
idle = {{ start = 1, lower = 0, upper = 5 }}
[limits]
duration = 1.0
[design]
sample_time = 0.05
"""
TIME = np.linspace(0.0, 1.0, 11)


def ishigami():
    """First-order and total indices of a, b, c, idle."""
    a, b = 7.0, 0.1
    alone = [0.5 * (1 + b * math.pi**4 / 5) ** 2, a**2 / 8, 0.0, 0.0]
    together = b**2 * math.pi**8 * 8 / 225  # of a and c
    total = np.add(alone, [together, 0.0, together, 0.0])
    return np.array(alone) / (sum(alone) + together), total / (sum(alone) + together)


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    """A campaign of the static model, with nothing measured."""
    folder = tmp_path_factory.mktemp("ishigami")
    (folder / SOURCE.name).write_text(SOURCE.read_text())
    (folder / "campaign.toml").write_text(TOML)
    return folder


def values(indices, kind, output=0):
    return np.array([i.value for i in indices.outputs[output].indices[kind]])


def half_widths(indices, kind, output=0):
    return np.array([i.half_width for i in indices.outputs[output].indices[kind]])


def of_sum(analytic, specs, terms=lambda p: p["a"] + 3 * p["b"], sigma=0.5):
    """A problem whose output is constant in time."""
    model = analytic(
        lambda time, inputs, p: None if (y := terms(p)) is None else {"y": y}, [s.name for s in specs]
    )
    case = measured_case("run", model, Task(TIME, {}, ("y",)), {"y": np.zeros(TIME.size)}, sigma={"y": sigma})
    return Problem([case], specs)


TWO = [ParameterSpec("a", 0.0, -1, 1), ParameterSpec("b", 0.0, -1, 1)]


def test_indices_of_a_static_model_are_the_analytic_ones(planned):
    indices = global_sensitivity(planned, of="mean", samples=1024)
    first, total = ishigami()
    assert indices.names == ("a", "b", "c", "idle")
    assert [o.label for o in indices.outputs] == ["designed: y", "designed: still"]
    for kind, known in (("first", first), ("total", total)):
        assert values(indices, kind) == pytest.approx(known, abs=0.05)
        assert np.all(np.abs(values(indices, kind) - known) <= 1.5 * half_widths(indices, kind))
        assert np.all(half_widths(indices, kind) < 0.15)
    assert indices.negligible == ("idle",)
    assert indices.unmoved == ("designed: still",)
    assert len(indices.draws) == 1024 * 6


def test_the_change_is_in_standard_deviations_of_the_noise(analytic):
    """y = a + 3 b: the squared change has a variance that splits into known parts; its root has the same ranges."""
    indices = global_sensitivity_of(of_sum(analytic, TWO), samples=512)
    scalars = indices.outputs[0].scalars
    assert scalars == pytest.approx(np.abs(indices.draws @ [1.0, 3.0]) / 0.5)
    assert values(indices, "total")[1] > 0.8
    mean = global_sensitivity_of(of_sum(analytic, TWO), of="mean", samples=512)
    assert values(mean, "first") == pytest.approx([0.1, 0.9], abs=0.02)
    assert values(mean, "total") == pytest.approx([0.1, 0.9], abs=0.02)


def test_elementary_effects_of_a_line_are_its_slopes(analytic):
    indices = global_sensitivity_of(of_sum(analytic, TWO), "morris", of="final")
    assert values(indices, "mu_star") == pytest.approx([2.0, 6.0])
    assert values(indices, "mu") == pytest.approx([2.0, 6.0])
    assert values(indices, "sigma") == pytest.approx([0.0, 0.0], abs=1e-12)
    assert half_widths(indices, "mu_star") == pytest.approx([0.0, 0.0], abs=1e-12)
    assert len(indices.draws) == 20 * 3


def test_parameters_are_drawn_from_priors_and_on_their_scale(analytic):
    specs = [
        ParameterSpec("a", 5.0, 4.4, 9.0, prior=Prior(5.0, 0.2)),
        ParameterSpec("b", 1.0, 0.01, 100.0, scale="log"),
    ]
    indices = global_sensitivity_of(of_sum(analytic, specs, lambda p: p["a"] + np.log10(p["b"])), of="mean")
    a, b = indices.draws.T
    assert indices.ranges == ((4.4, pytest.approx(5.6)), (0.01, 100.0))
    assert np.mean(a) == pytest.approx(5.0, abs=0.01)
    assert np.std(a) == pytest.approx(0.2, rel=0.03)  # cut at three standard deviations
    assert np.median(b) == pytest.approx(1.0, rel=0.05)
    variances = np.array([0.2**2, 4**2 / 12])
    assert values(indices, "first") == pytest.approx(variances / variances.sum(), abs=0.05)


def test_failed_simulations_are_left_out_and_told(analytic):
    def half(p):
        return None if p["a"] > 0.99 else p["a"] + 3 * p["b"]

    indices = global_sensitivity_of(of_sum(analytic, TWO, half), of="mean", samples=512)
    bad = indices.draws[:, 0] > 0.99
    assert indices.failed == bad.sum() > 0
    assert np.array_equal(np.isnan(indices.outputs[0].scalars), bad)
    assert indices.samples == 512 - bad.reshape(512, 4).any(axis=1).sum()
    assert values(indices, "first") == pytest.approx([0.1, 0.9], abs=0.05)
    assert f"{indices.failed} draws of 2048 could not be simulated (run: the integrator gave up)" in str(indices)
    with pytest.raises(SimulationError, match="draws cannot be simulated"):
        global_sensitivity_of(of_sum(analytic, TWO, lambda p: None if p["a"] != 0 else 1.0), samples=16)


def test_a_seed_repeats_everything(analytic):
    def drawn(seed):
        return global_sensitivity_of(of_sum(analytic, TWO), samples=16, seed=seed).to_dict()

    assert drawn(0) == drawn(0)
    assert drawn(0)["outputs"] != drawn(1)["outputs"]


def test_an_interruption_leaves_what_was_reached(analytic):
    calls = 0

    def terms(p):
        nonlocal calls
        calls += 1
        if calls == 200:
            raise KeyboardInterrupt
        return p["a"] + 3 * p["b"]

    indices = global_sensitivity_of(of_sum(analytic, TWO, terms), of="mean", samples=256)
    assert indices.interrupted
    assert len(indices.draws) == 4 * indices.samples == 192
    assert "Interrupted after 192 draws" in str(indices)


@pytest.mark.parametrize(
    ("specs", "options", "message"),
    [
        ([TWO[0], ParameterSpec("b", 0.0, -1)], {}, "parameter 'b': has no range to be drawn from"),
        ([TWO[0], replace(TWO[1], start=0.5, lower=0.0, scale="log")], {}, "lower = 0 has no logarithm"),
        ([TWO[0], replace(TWO[1], prior=Prior(5.0, 0.1))], {}, "prior lies outside its bounds"),
        (TWO, {"samples": 100}, "100 samples; give a power of two"),
        (TWO, {"method": "morris", "samples": 2}, "2 samples; give a number of 8 or more"),
    ],
)
def test_what_cannot_be_drawn_is_refused(analytic, specs, options, message):
    with pytest.raises(ProblemError, match=message):
        global_sensitivity_of(of_sum(analytic, specs), **options)


def test_without_salib_one_line_says_what_to_install(analytic, monkeypatch):
    monkeypatch.setitem(sys.modules, "SALib.analyze", None)
    with pytest.raises(ProblemError, match=r"needs SALib; pip install 'fmuid\[sensitivity\]'"):
        global_sensitivity_of(of_sum(analytic, TWO))


def test_the_command_takes_the_inputs_of_a_planned_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("Lag.mo").write_text(
        'model Lag\n  parameter Real k = 2;\n  parameter Real T = 0.5;\n  input Real u(unit = "V");\n'
        '  output Real y(start = 0, fixed = true, unit = "V");\nequation\n  T*der(y) = k*u - y;\nend Lag;\n'
    )
    Path("campaign.toml").write_text(
        '[models.lag]\nsource = "Lag.mo"\n[parameters]\nk = { start = 2, lower = 1, upper = 3 }\n'
        "T = { start = 0.5, lower = 0.4, upper = 0.6 }\n"
    )
    assert run(["sensitivity", "campaign.toml", "--workers", "0"]) == 2
    assert "has no run; give the inputs of one with --input" in capsys.readouterr().err
    rows = "\n".join(f"{0.1 * k:.1f},1000" for k in range(101))
    Path("plan.csv").write_text(f"time,u [mV]\n{rows}\n")
    command = ["sensitivity", "campaign.toml", "--input", "plan.csv", "--of", "final", "--samples", "64"]
    assert run([*command, "--workers", "0", "--out", "found", "--json", "found.json"]) == 0
    printed = capsys.readouterr().out
    assert "next: fmuid design campaign.toml --for parameters" in printed
    answer = json.loads(Path("found.json").read_text())
    assert answer == json.loads(Path("found/sensitivity.json").read_text())
    (output,) = answer["outputs"]
    assert output["output"] == "plan: y"
    assert output["mean"] == pytest.approx(2.0, abs=0.02)  # 20 time constants after a step of 1 V: k alone
    assert output["parameters"]["k"]["total"]["value"] == pytest.approx(1.0, abs=0.05)
    assert output["parameters"]["T"]["total"]["value"] < 1e-3
    assert Path("found/index.html").stat().st_size > 10_000
    assert Path("found/figures/indices-plan-y.png").is_file()
    with pytest.raises(CampaignError, match="nothing is measured in a planned run"):
        global_sensitivity("campaign.toml", inputs="plan.csv", of="criterion")
