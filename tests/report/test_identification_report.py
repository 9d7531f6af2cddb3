import csv
from itertools import pairwise
from typing import ClassVar

import numpy as np
import pytest
from printed_pages import filled
from report_page import Page

from fmuid.core.campaign import (
    AnalysisSpec,
    Campaign,
    CriterionSpec,
    ModelSpec,
    ParameterSpec,
    ParetoSpec,
    StageSpec,
)
from fmuid.core.errors import FmuidError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.identification.identify import identify
from fmuid.report import write_report
from fmuid.report.friction_figures import free_rotation, loss_table, no_load_torque, plateaus
from fmuid.simulation.simulator import Simulator, Variable

TIME = np.linspace(0, 2, 201)


class Lag(Simulator):
    """First-order lag: T der(y) + y = K u after a step of size u at t = 0."""

    variables: ClassVar = {
        "u": Variable("u", "input", unit="A"),
        "y": Variable("y", "output", unit="N.m"),
        "K": Variable("K", "parameter", unit="N.m/A", start=1.0),
        "T": Variable("T", "parameter", unit="s", start=1.0),
    }

    def simulate(self, task, parameters):
        u = task.inputs["u"]
        return (parameters["K"] * u * (1 - np.exp(-task.time / parameters["T"])))[None, :]


def run(name, u, seed, repeat_of=None):
    y = 2.0 * u * (1 - np.exp(-TIME / 0.3)) + np.random.default_rng(seed).normal(0, 0.01, TIME.size)
    signals = {
        "u": Signal("u", np.full(TIME.size, u), "A", "input"),
        "y": Signal("y", y, "N.m", "output", 0.01),
    }
    return Experiment(name, "bench", TIME, signals, repeat_of=repeat_of, description=f"step to {u} A")


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    runs = [run("low", 1.0, 1), run("low_2", 1.0, 2, "low"), run("high", 3.0, 3), run("check", 2.0, 4)]
    return Campaign(
        name="lag",
        title="A lag <on> the bench",
        folder=tmp_path_factory.mktemp("campaign"),
        measurements=Measurements({e.id: e for e in runs}),
        models={"bench": ModelSpec("bench", tmp_path_factory.mktemp("fmus") / "lag.fmu")},
        parameters={
            "K": ParameterSpec("K", 1.0, 0.1, 10.0, "N.m/A", truth=2.0, description="gain"),
            "T": ParameterSpec("T", 1.0, 0.01, 10.0, "s", "log", truth=0.3),
        },
        settings={},
        stages={
            "gain": StageSpec("gain", ("low",), ("K",)),
            "both": StageSpec(
                "both",
                ("low*", "high"),
                ("K", "T"),
                criteria=(CriterionSpec("y", demand=0.02),),
                analyses=AnalysisSpec(profiles=True, monte_carlo=30, pareto=ParetoSpec(("low:*", "high:*"), 4)),
            ),
        },
        identification=("low", "low_2", "high"),
        validation=("check",),
        published={"earlier work": {"K": 1.97, "force error in %": 4.08}},
    )


@pytest.fixture(scope="module")
def written(campaign, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    identify(campaign, out=folder, simulators={"bench": Lag()})
    return write_report(folder, campaign=campaign, simulators={"bench": Lag()})


def read(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_report_has_what_the_paper_shows(written):
    names = {p.stem for p in (written.parent / "figures").iterdir()}
    assert {"before-after", "history-both", "validation-bench-y", "nrmse-validation"} <= names
    assert {"cost", "parallel-both", "parallel-criteria-both", "correlation-both", "deviations"} <= names


def test_no_page_on_paper_is_half_empty(written):
    *pages, _ = filled(written)
    assert min(pages) > 0.55, pages


def test_history_starts_at_the_start_and_ends_at_the_best(written):
    data = written.parent / "data"
    path = next(p for p in data.glob("history-both-*.csv") if "high" in p.name and "residual" not in p.name)
    header = path.read_text().splitlines()[0].split(",")
    values = np.loadtxt(path, delimiter=",", skiprows=1)
    assert header[:3] == ["time [s]", "measurement: y [N.m]", "start: y [N.m]"]
    assert header[-1] == "final: y [N.m]"
    assert len(header) > 4  # some iterates between
    error = np.abs(values[:, 2:] - values[:, [1]]).mean(axis=0)
    assert error[-1] < 0.02 < error[0]


def test_residual_is_prediction_minus_measurement(written):
    fit, residual = (
        np.loadtxt(written.parent / "data" / f"{name}.csv", delimiter=",", skiprows=1)
        for name in ("validation-bench-y", "validation-bench-y-residual")
    )
    np.testing.assert_allclose(residual[:, 1], fit[:, 2] - fit[:, 1], atol=1e-8)
    np.testing.assert_allclose(residual[:, 2:], [[-0.02, 0.02]] * TIME.size)  # two standard deviations


def test_the_page_opens_with_start_and_end_of_the_worst_run(written):
    data = np.loadtxt(written.parent / "data" / "before-after.csv", delimiter=",", skiprows=1)
    errors = np.abs(data[:, 2:] - data[:, [1]]).mean(axis=0)
    assert errors[1] < 0.02 < errors[0]
    text = Page(written.read_text()).text
    assert "errors up to" in " ".join(text.split())
    assert text.index("Worst run") < text.index("Parameters") < text.index("NRMSE of every run")


def test_estimates_stand_beside_truth_and_published_values(written):
    rows = {row["parameter"]: row for row in read(written.parent / "data" / "estimates.csv")}
    assert float(rows["K"]["estimate"]) == pytest.approx(2.0, rel=0.01)
    assert float(rows["K"]["truth"]) == 2.0
    assert float(rows["K"]["earlier work"]) == 1.97
    assert rows["K"]["stage"] == "both"
    text = Page(written.read_text()).text
    assert "force error in %" in text
    assert "4.08" in text


def test_fit_of_every_run_is_given_with_its_noise_floor(written):
    (values,) = read(written.parent / "data" / "fit-validation.csv")
    assert values["run"] == "check"
    assert float(values["RMSE"]) == pytest.approx(0.01, rel=0.2)
    assert float(values["noise floor"]) == pytest.approx(0.01)
    assert float(values["NRMSE, %"]) < 1.5


def test_validation_runs_are_compared_with_the_intervals_of_their_predictions(written):
    (values,) = read(written.parent / "data" / "fit-validation.csv")
    assert 0.01 < float(values["95 % interval, ±"]) < 0.04  # t-distribution, two runs with noise of 0.01
    assert 90.0 <= float(values["within, %"]) <= 100.0
    assert "intervals contain at least 85 % of the samples of 1 of 1 new run" in " ".join(
        Page(written.read_text()).text.split()
    )
    fitted = read(written.parent / "data" / "fit-identification.csv")
    assert fitted
    assert all("within, %" not in row for row in fitted)


def test_what_was_found_about_the_estimate_is_shown(written):
    names = {p.stem for p in (written.parent / "figures").iterdir()}
    assert {"profiles-both", "front-both"} <= names
    data = written.parent / "data"
    gain = next(row for row in read(data / "profiles-both-intervals.csv") if row["parameter"] == "K")
    assert 1.99 < float(gain["profile from"]) < 2.0 < float(gain["to"]) < 2.01
    assert float(gain["profile from"]) == pytest.approx(float(gain["standard error from"]), abs=1e-3)
    front = read(data / "front-both-points.csv")
    assert len(front) >= 3
    for earlier, later in pairwise(front):
        assert float(earlier["low:*"]) < float(later["low:*"])
        assert float(earlier["high:*"]) > float(later["high:*"])
    for row in read(data / "spread-both.csv"):
        assert float(row["estimate"]) < float(row["95 % below"]) <= float(row["worst"])


def test_page_says_how_it_went_and_what_it_rests_on(written):
    page = Page(written.read_text())
    text = " ".join(page.text.split())
    for words in (
        "converged",
        "Largest deviation from the truth",
        "A lag <on> the bench",
        "measurements (SHA-256)",
        "version of nlopt",
    ):
        assert words in text, words
    for link in page.links:
        assert link.startswith("#") or (written.parent / link).is_file(), link


def test_a_folder_without_a_run_is_one_line(tmp_path):
    with pytest.raises(FmuidError, match="no such file"):
        write_report(tmp_path)


def test_free_rotation_gives_the_torque_of_the_loss_table():
    table = loss_table(
        {
            f"lossTable[{i},{j}]": v
            for i, row in enumerate([[0, 0.98, 1, 0.12, 0.1], [100, 0.85, 1, 0.17, 0.1]], 1)
            for j, v in enumerate(row, 1)
        }
    )
    runs = []
    for repeat in range(3):
        reference = np.repeat([0.0, -100.0, 50.0], 100)
        current = no_load_torque(table, reference) / 0.7 + np.random.default_rng(repeat).normal(0, 1e-3, 300)
        current[100:120] = 5.0  # the start-up of the plateau does not count
        signals = {
            "w_ref": Signal("w_ref", reference, "rad/s", "input"),
            "i_motor": Signal("i_motor", current, "A", "output"),
        }
        runs.append(Experiment(f"r{repeat}", "free_shaft", np.arange(300) * 0.01, signals))
    points = free_rotation(runs, 0.7)
    assert points.x.tolist() == [-100.0, 50.0]
    np.testing.assert_allclose(points.y, [-0.17 / 0.85, 0.145 / 0.915], rtol=5e-3)
    assert np.all(points.error < 1e-3)


def test_ramps_and_short_steps_are_no_plateaus():
    reference = np.concatenate([np.linspace(0, 1, 50), np.ones(60), np.zeros(20)])
    assert plateaus(np.arange(130) * 0.01, reference) == [(49, 110)]


def test_an_incomplete_loss_table_is_none():
    assert loss_table({"lossTable[1,1]": 0.0, "lossTable[1,2]": 1.0}) is None
