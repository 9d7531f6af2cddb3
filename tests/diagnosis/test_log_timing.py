"""A lag or delay below a sample, or crosstalk, is not reported if the timing of the log explains it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from fmu_build import build
from fmuid import diagnosis_pipeline
from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.data.measurements import write_measurements
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis_pipeline import (
    _begin_as_modelled,
    _looked_again,
    with_starts_of_runs,
    with_timing_of_log,
)
from fmuid.identification.problem.cases import from_campaign
from fmuid.identification.problem.segments import segmented
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.runners import in_process
from fmuid.simulation.segmented import Segmented
from fmuid.simulation.simulator import Task

MODEL = """
model Heater
  parameter Real R = 20;
  parameter Real C = 50;
  parameter Real k = 0;
  input Real u;
  output Real i = u/R;
  output Real x(start = 0, fixed = true);
equation
  C*der(x) = u*i - x - k*x^2;
end Heater;
"""
TOML = """
[models.bench]
fmu = "Heater.fmu"
timing = "linear"
[parameters]
R = { start = 20.0, lower = 2.0, upper = 200.0 }
C = { start = 50.0, lower = 5.0, upper = 500.0 }
"""
TIME = np.arange(0.0, 200.0, 1.0)


def retimed(
    tmp_path: Path,
    answer: dict[str, float],
    timing: str,
    after: tuple[str, ...] = (),
    *,
    outputs: tuple[str, ...] = ("i", "x"),
    read_after: float = 0.0,
    offset: float = 0.0,
    start: float = 0.0,
    loss: float = 0.0,
    gap: float = 0.0,
    kind: str = "effect",
):
    """What is made of the timing of a log that was written in some way, where a diagnosis has an answer.

    With a `start`, runs begin there and not as the model does, and their start states are fitted. `loss` is that of
    a law that the model lacks, of size `k` in the answer.
    """
    (tmp_path / "Heater.mo").write_text(MODEL)
    model = load_fmu(build(tmp_path / "Heater.mo", "Heater", tmp_path, "2"))
    random = np.random.default_rng(4)
    u = np.repeat(random.uniform(2.0, 24.0, 25), 8)
    task = Task(TIME, {"u": u}, outputs, after=after, read_after=read_after)
    y = model.simulate(task, {"R": 22.0, "C": 45.0, "k": loss, **({"x": start} if start else {})})
    y += 0.01 * np.ptp(y, axis=1, keepdims=True) * random.normal(size=y.shape)
    y[-1] += offset
    signals = {n: Signal(n, row, "1", "output") for n, row in zip(outputs, y, strict=True)}
    run = Experiment("run", "bench", TIME, {"u": Signal("u", u, "1", "input"), **signals})
    write_measurements(Measurements({"run": run}), tmp_path / "measurements.h5")
    (tmp_path / "campaign.toml").write_text(TOML.replace('"linear"', timing))
    campaign = load_campaign(tmp_path)
    cases = from_campaign(campaign, list(campaign.measurements), (), {"bench": model})
    if start:
        cases = [segmented(case, math.inf, {"R": 20.0, "C": 50.0}) for case in cases]
    nominal = [SimpleNamespace(name=n, start=campaign.parameters[n].start) for n in ("R", "C")]
    laws = [SimpleNamespace(name=n) for n in answer if n == "k"]
    diagnosed = SimpleNamespace(
        subject=SimpleNamespace(model=CampaignModel(tuple(cases)), nominal=nominal),
        corrected=SimpleNamespace(fit=SimpleNamespace(values={"R": 22.0, **answer}, unknowns=laws), gap=gap),
        diagnosis=SimpleNamespace(verdict=SimpleNamespace(kind=kind)),
    )
    return with_timing_of_log(campaign, diagnosed, in_process)


@pytest.mark.parametrize(
    ("effect", "value", "timing"),
    [
        ("x.delay", 0.4, "held-read-after"),
        ("x.delay", 1.6, None),
        ("x.delay", 0.0, None),
        ("x.crosstalk[u]", 0.1, "held-read-after"),
        ("x.crosstalk[i]", 0.1, None),
    ],
)
def test_what_the_timing_of_the_log_explains(
    effect: str, value: float, timing: str | None, tmp_path: Path
) -> None:
    changed = retimed(tmp_path, {effect: value}, '"linear"', after=("i", "x"))
    if timing is None:
        assert changed is None
    else:
        assert changed is not None
        assert changed[0].models["bench"].timing == timing
        assert '\'bench\' was diagnosed with timing = "held-read-after" instead of "linear"' in changed[1]


@pytest.mark.parametrize(
    ("gap", "kind", "changes"), [(1.0, "unknown", True), (1.0, "complete", False), (0.2, "effect", False)]
)
def test_the_timing_of_the_log_may_be_what_is_left_beside_the_answer(gap, kind, changes, tmp_path: Path) -> None:
    changed = retimed(tmp_path, {}, '"held"', after=("i", "x"), gap=gap, kind=kind)
    assert (changed is not None) is changes
    if changed is not None:
        assert changed[0].models["bench"].timing == "held-read-after"


@pytest.mark.parametrize("timing", ["held-read-after", "linear"])
def test_a_timing_stays_where_nothing_on_signals_speaks_against_it_and_none_is_clearly_better(
    timing: str, tmp_path: Path
) -> None:
    assert retimed(tmp_path, {}, f'"{timing}"', after=("i", "x"), gap=1.0) is None


def test_the_timing_of_a_log_that_begins_elsewhere_is_judged_with_its_start_states(tmp_path: Path) -> None:
    campaign, _ = retimed(tmp_path, {"x.delay": 0.4}, '"linear"', after=("i", "x"), start=15.0)
    assert campaign.models["bench"].timing == "held-read-after"


def test_the_laws_of_the_answer_are_refitted_with_every_timing(tmp_path: Path) -> None:
    answer = {"x.crosstalk[u]": 0.1, "k": 0.5}
    campaign, _ = retimed(tmp_path, answer, '"held"', outputs=("x",), read_after=0.6, loss=0.2)
    assert campaign.models["bench"].read_after == pytest.approx(0.6, abs=0.05)


def test_the_timing_of_the_log_is_judged_beside_other_effects(tmp_path: Path) -> None:
    """A sensor that shows too much leaves far more than the timing does."""
    answer = {"x.delay": 0.4, "x.offset": 50.0}
    campaign, _ = retimed(tmp_path, answer, '"linear"', after=("i", "x"), offset=50.0)
    assert campaign.models["bench"].timing == "held-read-after"


def test_a_time_of_reading_that_a_delay_undoes_is_none(tmp_path: Path) -> None:
    campaign, note = retimed(tmp_path, {"x.delay": 0.4}, '"held"\nread_after = 0.4')
    assert (campaign.models["bench"].timing, campaign.models["bench"].read_after) == ("held", 0.0)
    assert note == "'bench' was diagnosed without read_after: laws explain what it did; remove it in campaign.toml"


def test_each_look_at_the_log_is_repeated_with_the_new_answer_and_keeps_its_last_note():
    """A campaign is a number here, and its diagnosis has it as the only note."""

    @dataclass(frozen=True)
    class Noted:
        notes: tuple[str, ...]

    @dataclass(frozen=True)
    class Outcome:
        diagnosis: Noted

    def diagnosed(campaign):
        return campaign, Outcome(Noted((f"{campaign}",)))

    def to_two(campaign, outcome):
        assert outcome.diagnosis.notes == (f"{campaign}",)
        return (campaign + 1, f"timing {campaign + 1}") if campaign < 2 else None

    def for_ever(campaign, _):
        return campaign + 10, f"starts {campaign + 10}"

    campaign, outcome = _looked_again(*diagnosed(0), (to_two, for_ever), diagnosed)
    assert campaign == 32
    assert outcome.diagnosis.notes == ("timing 2", "starts 32", "32")


def test_start_states_are_not_tried_through_sensors_with_a_model():
    outcome = SimpleNamespace(
        corrected=None,
        nominal=None,
        diagnosis=SimpleNamespace(
            verdict=SimpleNamespace(kind="unknown", provisional=False), gap=SimpleNamespace(present=True)
        ),
        subject=SimpleNamespace(
            observed=SimpleNamespace(nuisances=()),
            model=SimpleNamespace(cases=[SimpleNamespace(channels=[SimpleNamespace(plain=False)])]),
        ),
    )
    campaign = SimpleNamespace(stages={"all": SimpleNamespace(segments=0.5, observer=None)})
    assert with_starts_of_runs(campaign, outcome, None) is None


@dataclass(frozen=True)
class Stage:
    segments: float | None = None
    observer: None = None


@dataclass(frozen=True)
class Staged:
    stages: dict[str, Stage]


@pytest.mark.parametrize(("gains", "noted"), [("offset@u", " with offset@u,"), ("none", None)])
def test_start_states_are_tried_beside_every_answer_that_is_open(gains, noted, monkeypatch):
    def fitted(*effects):
        return SimpleNamespace(effects=effects, gap=4.0, fit=SimpleNamespace(values={}, residuals=effects))

    nominal, first, second = fitted(), fitted("asymmetry@w"), fitted("offset@u")
    observed = SimpleNamespace(nuisances=("w",), runs=())
    freed = SimpleNamespace(observed=observed, by_id={"asymmetry@w": "asymmetry@w", "offset@u": "offset@u"})
    outcome = SimpleNamespace(
        corrected=first,
        nominal=nominal,
        surviving=(first, second),
        diagnosis=SimpleNamespace(
            verdict=SimpleNamespace(kind="ambiguous", provisional=True), gap=SimpleNamespace(present=True)
        ),
        subject=SimpleNamespace(
            observed=SimpleNamespace(nuisances=()), model=SimpleNamespace(cases=[SimpleNamespace(channels=())])
        ),
    )
    replaced = {
        "holds": lambda *_: False,
        "exact_enough": lambda *_: False,
        "_begin_as_modelled": lambda *_: False,
        "_started": lambda *_: freed,
        "refit_only": lambda _, effects, starts: SimpleNamespace(residuals=tuple(effects)),
        "gap": lambda effects, _: 1.0 if gains in effects else 4.0,
        "odds_of_starts": lambda fit, *_: 5.0 if gains in fit.residuals else -5.0,
    }
    for name, function in replaced.items():
        monkeypatch.setattr(diagnosis_pipeline, name, function)
    changed = with_starts_of_runs(Staged({"all": Stage()}), outcome, lambda _: freed)
    assert changed is None if noted is None else noted in changed[1]


@pytest.mark.parametrize(
    ("first", "states", "as_modelled"), [(0.02, ("w",), True), (0.5, ("w",), False), (0.02, ("w", "T"), False)]
)
def test_start_states_are_not_tried_where_the_log_shows_that_each_begins_as_modelled(first, states, as_modelled):
    begun = object.__new__(Segmented)
    begun._states = states
    case = SimpleNamespace(setup="bench", simulator=begun, channels=[SimpleNamespace(variable="w")])
    run = SimpleNamespace(setup="bench", n_repeats=1, mean=first + np.zeros((1, 9)))
    noise = {"bench": SimpleNamespace(of_mean=lambda _: np.array([0.01]))}
    model = SimpleNamespace(cases=[case], predict=lambda points: [(np.zeros((1, 9)),)])
    outcome = SimpleNamespace(
        nominal=SimpleNamespace(fit=SimpleNamespace(values={})),
        subject=SimpleNamespace(model=model, observed=SimpleNamespace(runs=[run], noise=noise)),
    )
    assert _begin_as_modelled(outcome, SimpleNamespace(model=model)) is as_modelled
