"""Designs that tell the answers of a diagnosis apart, played on the plant that they were designed for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from fmuid.core.campaign import Campaign, DesignSpec, Limit, ModelSpec
from fmuid.core.experiments import Measurements
from fmuid.design.rivals import SETTLED, DiagnosisDesign, design_for_diagnosis
from fmuid.diagnosis import decide
from fmuid.diagnosis.candidates import Fitted, fit_effects
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.subject import Subject
from fmuid.identification.problem.cases import measured_case
from tests.diagnosis.plants import DT, EFFECTS, SIGMA, TWIN, Mass, plant

LIMITS = {"u": Limit("u", -4.0, 4.0, rate=60.0), "x": Limit("x", -2.0, 2.0)}
DESIGN = DesignSpec(limits=LIMITS, duration=2.0, families=("multisine", "steps"))


def campaign(design: DesignSpec = DESIGN) -> Campaign:
    models = {"bench": ModelSpec("bench", Path("Mass.fmu"))}
    return Campaign("mass", "Mass", Path(), Measurements({}), models, {}, {}, {}, (), (), design=design)


def fitted(subject: Subject, *names: str) -> list[Fitted]:
    by_id = {e.id: e for e in subject.effects}
    found = [fit_effects(subject, [by_id[n]], [dict(trial) for trial in by_id[n].trials]) for n in names]
    return [f for f in found if f is not None]


def played(subject: Subject, designed: DiagnosisDesign, truth: Mapping[str, float], seed: int) -> Subject:
    """Add the designed run, as the plant answers to it."""
    rng = np.random.default_rng(seed)
    task = replace(designed.planned.driven_case(designed.excitation.samples).task, tolerance=None)
    values = Mass().simulate(task, truth) + SIGMA * np.array([[0.2], [1.0]]) * rng.standard_normal(
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
