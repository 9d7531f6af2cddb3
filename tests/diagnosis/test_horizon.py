"""Growing horizons: a search over beginnings of the runs ends where one over whole runs does not get to."""

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest

from fmuid.diagnosis.candidates import approached, beginning, drifts, early, fit_effects, over_horizons
from fmuid.diagnosis.diagnose import _settled
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.refit import refit
from fmuid.diagnosis.subject import Subject
from fmuid.effects.effect import Catalogue, Unknown
from fmuid.identification.problem.cases import measured_case
from fmuid.simulation.simulator import Simulator, Task, Variable

TRUE = {"w": 1.3, "more": 0.25}
TIME = 0.05 * np.arange(1200)


class Swing(Simulator):
    """A swing of angular frequency w + more, which `more` also pushes to one side."""

    variables: ClassVar = {
        **{n: Variable(n, "parameter", "fixed", start=0.0) for n in TRUE},
        "u": Variable("u", "input"),
        "y": Variable("y", "output"),
    }

    def simulate(self, task, parameters):
        w, more = parameters["w"], parameters["more"]
        return (np.sin((w + more) * task.time) + more * task.inputs["u"])[None]


class Forgetful(Swing):
    """A plant that forgets: a lever, on which friction acts that `w` and `more` do not express."""

    def simulate(self, task, parameters):
        u = task.inputs["u"]
        return (parameters["w"] * u + parameters["more"] * np.roll(u, 5))[None]


def subject_of(plant, y):
    task = Task(TIME, {"u": np.sign(np.sin(0.3 * TIME))}, ("y",))
    noise = 0.01 * np.random.default_rng(3).standard_normal((3, TIME.size))
    case = measured_case("free", plant, task, {"y": y(task) + noise})
    model = CampaignModel((replace(case, setup="swing", columns={"T_air": ("degC", TIME)}),))
    unknowns = tuple(Unknown(n, start, 0.0, 3.0, 1e-3) for n, start in (("w", 1.0), ("more", 0.0)))
    return Subject(model, Observed.from_runs(model.runs), unknowns, Catalogue({}, {}, {}), ())


@pytest.fixture
def swing():
    return subject_of(Swing(), lambda task: Swing().simulate(task, TRUE))


def test_growing_horizons_lead_to_what_whole_runs_hide(swing):
    predict, observed = swing.model.predict, swing.observed
    whole = refit(predict, observed, swing.nominal)
    assert whole.values["w"] != pytest.approx(TRUE["w"], abs=0.05)
    near = approached(swing, swing.nominal, {"w": 1.0, "more": 0.0}, [{"more": 1.0}])
    assert near == pytest.approx(TRUE, abs=0.01)
    end = refit(predict, observed, swing.nominal, starts=[near])
    assert end.values == pytest.approx(TRUE, abs=1e-3)
    assert end.cost < 0.1 * whole.cost


def test_a_beginning_is_the_same_runs_and_noise_for_a_shorter_time(swing):
    part = beginning(swing, 0.25)
    (run,), (whole,) = part.observed.runs, swing.observed.runs
    np.testing.assert_array_equal(run.values, whole.values[..., :300])
    np.testing.assert_array_equal(part.model.cases[0].columns["T_air"][1], TIME[:300])
    (short,), (long,) = (s.model.predict([TRUE]) for s in (part, swing))
    np.testing.assert_array_equal(short[0], long[0][:, :300])
    residual = part.observed.residuals(short)[0]
    assert np.mean(residual**2) == pytest.approx(1 / 3, rel=0.2)  # of the mean of three runs
    assert early(swing).observed.runs[0].time.size == 300


def test_a_nominal_model_that_fits_badly_is_approached_over_growing_horizons(swing):
    nearer = replace(swing, nominal=(replace(swing.nominal[0], start=1.4), swing.nominal[1]))
    stuck = fit_effects(nearer, (), [{}])
    assert stuck.fit.values["w"] != pytest.approx(TRUE["w"], abs=0.05)
    _, nominal = _settled(nearer, stuck)
    assert nominal.fit.values == pytest.approx(TRUE, abs=1e-3)


def test_only_models_that_drift_are_approached_over_growing_horizons(swing, monkeypatch):
    forgetful = subject_of(Forgetful(), lambda task: Forgetful().simulate(task, TRUE) + 0.2 * np.sin(TIME))
    stuck = fit_effects(forgetful, (), [{}])
    assert stuck.gap > 1.0
    monkeypatch.setattr("fmuid.diagnosis.candidates.approached", None)
    assert over_horizons(forgetful, (), stuck, forgetful.starts) is stuck
    assert drifts(swing, fit_effects(swing, (), [{}]))


@pytest.mark.parametrize(("samples", "quarter"), [(100, None), (200, None), (300, 75)])
def test_no_beginning_is_shorter_than_a_spectrum_allows(swing, samples, quarter):
    short = beginning(swing, samples / TIME.size)
    part = early(short)
    assert (part and part.observed.runs[0].time.size) == quarter
    assert (approached(short, short.nominal, short.starts, []) is None) is (samples < 128)
