"""Designs that tell the answers of a diagnosis apart, played on the plant that they were designed for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from fmuid.core.campaign import Campaign, DesignSpec, Limit, ModelSpec
from fmuid.core.experiments import Measurements
from fmuid.design.excitation_search import Excitation, Judged
from fmuid.design.planned import planned_run
from fmuid.design.rivals import SETTLED, Apart, DiagnosisDesign, design_for_diagnosis
from fmuid.diagnosis import decide
from fmuid.diagnosis.candidates import Fitted, fit_effects
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.next_experiment import chances, rival_of
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.subject import Subject
from fmuid.effects.effect import Catalogue, Effect, Unknown
from fmuid.identification.problem.cases import measured_case
from fmuid.simulation.simulator import Simulator, Task, Variable
from tests.diagnosis.plants import DT, EFFECTS, SIGMA, TWIN, Mass, plant

LIMITS = {"u": Limit("u", -4.0, 4.0, rate=60.0), "x": Limit("x", -2.0, 2.0)}
DESIGN = DesignSpec(limits=LIMITS, duration=2.0, families=("multisine", "steps"))


def campaign(design: DesignSpec = DESIGN) -> Campaign:
    models = {"bench": ModelSpec("bench", Path("Mass.fmu"))}
    return Campaign("mass", "Mass", Path(), Measurements({}), models, {}, {}, {}, (), (), design=design)


def fitted(subject: Subject, *names: str) -> list[Fitted]:
    by_id = {e.id: e for e in subject.effects}
    answers = [fit_effects(subject, [by_id[n]], [dict(trial) for trial in by_id[n].trials]) for n in names]
    return [f for f in answers if f is not None]


def played(
    subject: Subject, designed: DiagnosisDesign, truth: Mapping[str, float], seed: int, noise: float = 1.0
) -> Subject:
    """Add the designed run, as the plant answers to it."""
    rng = np.random.default_rng(seed)
    task = replace(designed.planned.driven_case(designed.excitation.samples).task, tolerance=None)
    values = Mass().simulate(task, truth) + noise * SIGMA * np.array([[0.2], [1.0]]) * rng.standard_normal(
        (2, len(task.time))
    )
    case = replace(measured_case("designed", Mass(), task, {"x": values[0], "v": values[1]}), setup="bench")
    model = replace(subject.model, cases=(*subject.model.cases, case))
    return replace(subject, model=model, observed=Observed(model.runs, subject.observed.noise))


def test_the_designed_run_settles_what_weak_runs_left_open() -> None:
    truth = {"square": 0.05}
    subject = plant(truth, experiments=("sine", "ramp"), repeats=2, noise=4.0)
    answers = fitted(subject, "quadratic", "asymmetry", "tilt")
    before = [decide.separation(answers[0], other, subject.observed) for other in answers[1:]]
    designed = design_for_diagnosis(campaign(), subject, answers[:2], evaluations=40)
    (u,) = designed.excitation.samples
    assert np.max(np.abs(u)) <= 4.0
    assert np.max(np.abs(np.diff(u))) <= 60.0 * DT * (1 + 1e-9)
    x = Mass().simulate(designed.planned.driven_case(designed.excitation.samples).task, truth)[0]
    assert np.max(np.abs(x)) <= 2.0
    assert min(before) < designed.least
    after = played(subject, designed, truth, seed=1)
    right, wrong = fitted(after, "quadratic", "asymmetry")
    assert decide.separation(right, wrong, after.observed) > designed.least - 1.0


def test_what_no_run_tells_apart_is_said_to_be_so() -> None:
    subject = plant({"tilt": 0.1}, effects={**EFFECTS, "cable": TWIN}, experiments=("sine", "ramp"), repeats=2)
    designed = design_for_diagnosis(campaign(), subject, fitted(subject, "tilt", "cable"), evaluations=16)
    assert designed.least < 0.1 < SETTLED
    assert not designed.beyond  # neither a sensor nor more of the input would help


def test_where_no_run_settles_it_a_sensor_is_named_and_how_quiet_it_must_be() -> None:
    subject = plant({"square": 0.3}, experiments=("sine", "ramp"), repeats=2, noise=4.0)
    cases = [
        replace(
            measured_case(c.id, c.simulator, replace(c.task, outputs=("x",)), {"x": c.channels[0].repeats}),
            setup="bench",
        )
        for c in subject.model.cases
    ]
    model = replace(subject.model, cases=tuple(cases))
    subject = replace(subject, model=model, observed=Observed.from_runs(model.runs))
    narrow = replace(DESIGN, limits={"u": Limit("u", -2.0, 2.0)})
    designed = design_for_diagnosis(
        campaign(narrow), subject, fitted(subject, "quadratic", "asymmetry"), evaluations=12
    )
    assert designed.settled_for == []
    (sensor,) = (b for b in designed.beyond if b.kind == "sensor")
    assert sensor.what.startswith("a sensor of v with a noise below ")
    quiet = float(sensor.what.split()[-1])
    assert 1e-5 < quiet < 0.1  # m/s
    given = replace(narrow, sigma={"v": 0.5 * quiet})  # the user has such a sensor
    (sensor,) = (
        b
        for b in design_for_diagnosis(
            campaign(given), subject, fitted(subject, "quadratic", "asymmetry"), evaluations=12
        ).beyond
        if b.kind == "sensor"
    )
    assert sensor.separation > SETTLED


class Kink(Simulator):
    """y = u + a max(0, |u| - 0.5) sign u + k max(0, |u| - c) sign u."""

    variables: ClassVar = {
        **{n: Variable(n, "parameter", "fixed", start=v) for n, v in {"a": 0.0, "k": 0.0, "c": 0.05}.items()},
        "u": Variable("u", "input"),
        "y": Variable("y", "output"),
    }

    def simulate(self, task: Task, parameters: Mapping[str, float]) -> np.ndarray:
        p, u = {"a": 0.0, "k": 0.0, "c": 0.05, **parameters}, task.inputs["u"]
        size = p["a"] * np.maximum(0.0, np.abs(u) - 0.5) + p["k"] * np.maximum(0.0, np.abs(u) - p["c"])
        return (u + np.sign(u) * size)[None]


def test_an_answer_that_can_follow_when_it_is_refitted_is_not_far_away() -> None:
    """Seen from a kink at 0.05, one at 0.5 is far away, but nothing says that it is not at 0.5."""
    kink, rng = Kink(), np.random.default_rng(5)
    task = Task(DT * np.arange(60), {"u": 0.04 * np.sin(np.arange(60) / 9.0)}, ("y",))  # a parameter costs little
    runs = kink.simulate(task, {}) + 1e-3 * rng.standard_normal((3, 60))
    model = CampaignModel((replace(measured_case("weak", kink, task, {"y": runs}), setup="bench"),))
    known = Effect("known", "known", "law", (Unknown("a", 0.0, 0.0, 9.0, 1e-3),), {"a": 0.0}, ({"a": 1.0},))
    place = (Unknown("k", 0.0, 0.0, 9.0, 1e-3), Unknown("c", 0.05, 0.0, 1.0, 1e-3))
    moving = Effect("moving", "moving", "law", place, {"k": 0.0, "c": 0.05}, ({"k": 1.0, "c": 0.05},))
    effects = {e.id: e for e in (known, moving)}
    observed = Observed.from_runs(model.runs)
    subject = Subject(model, observed, (), Catalogue(effects, {}, {}), tuple(effects.values()))
    design = DesignSpec(limits={"u": Limit("u", -1.0, 1.0)}, duration=1.0, families=("steps",))
    designed = design_for_diagnosis(campaign(design), subject, fitted(subject, "known", "moving"), evaluations=8)
    linear = Apart(designed.planned, designed.rivals).distances(designed.excitation.samples)
    assert linear[0].min(axis=0)[1] > 20.0
    assert designed.separations[0, 1] == 0.0
    assert designed.chances[0] < 0.1


def test_an_answer_is_left_alone_as_often_as_was_said() -> None:
    kept, promised = [], []
    for seed in range(40):
        truth = {"square": float(np.random.default_rng(seed).uniform(-0.2, 0.2))}
        subject = plant(truth, experiments=("sine", "ramp"), repeats=2, noise=4.0, seed=seed)
        answers = fitted(subject, "quadratic", "tilt")
        case, noise = subject.model.cases[0], subject.observed.noise["bench"]
        planned = planned_run(campaign(), subject.model, case, noise)
        u = 2.0 * np.sign(np.sin(5.0 * planned.time))[None]
        rivals = tuple(rival_of(f, subject.observed, draws=3, seed=seed) for f in answers)
        apart = Apart(planned, rivals, subject).distances(u)
        promised.append(chances(apart, rivals)[0])
        designed = DiagnosisDesign(planned, Excitation(u, Judged(0.0), "", 1), rivals, apart)
        after = played(subject, designed, truth, seed=100 + seed, noise=4.0)
        right, wrong = fitted(after, "quadratic", "tilt")
        kept.append(decide.log_odds(right, wrong, after.observed) > np.log(decide.OPEN))
    likely = np.array(promised) > 0.5
    assert 10 < likely.sum() < 30
    assert abs(np.mean(promised) - np.mean(kept)) < 0.15
    assert np.mean(np.array(kept)[likely]) > np.mean(np.array(kept)[~likely]) + 0.4
