"""Effects of signals as parameters of a model: what the diagnosis names can be identified and validated."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from fmuid import load_fmu
from fmuid.core.campaign import ModelSpec
from fmuid.core.errors import FmuError
from fmuid.simulation.coupled.loading import load_simulator
from fmuid.simulation.signal_model import SignalModel
from fmuid.simulation.simulator import Task

TIME = 1e-3 * np.arange(400)
INPUT = np.sin(TIME / 17e-3)
NAMES = ("u.gain", "u.offset", "u.delay", "y.gain", "y.offset", "y.lag")


@pytest.fixture(scope="module")
def plain(build):
    return load_fmu(build(2))


def task(u=INPUT, **starts):
    return Task(TIME, {"u": u}, ("y",), starts)


def test_neutral_it_is_the_model_itself(plain):
    model = SignalModel(plain, NAMES)
    assert np.array_equal(model.simulate(task(), {"c": 120.0}), plain.simulate(task(), {"c": 120.0}))
    assert model.variables["u.gain"].start == 1.0
    assert (model.variables["u.offset"].unit, model.variables["y.lag"].unit) == ("N", "s")


def test_inputs_and_outputs_are_scaled_and_shifted_as_parameters_say(plain):
    model = SignalModel(plain, NAMES)
    at = {"u.gain": 1.3, "u.offset": 0.2, "y.gain": 2.0, "y.offset": 0.5, "d": 0.7}
    expected = 2.0 * plain.simulate(task(1.3 * INPUT + 0.2), {"d": 0.7}) + 0.5
    assert model.simulate(task(), at) == pytest.approx(expected, abs=1e-12)
    assert model.simulate(task(**{"u.gain": 1.3, "u.offset": 0.2}), {"d": 0.7}) == pytest.approx(
        (expected - 0.5) / 2.0, abs=1e-12
    )


def test_a_delay_of_the_input_delays_the_answer(plain):
    late = SignalModel(plain, NAMES).simulate(task(), {"u.delay": 20e-3})
    moved = np.concatenate([np.full(20, INPUT[0]), INPUT[:-20]])
    assert late == pytest.approx(plain.simulate(task(moved), {}), abs=1e-9)


def test_a_model_s_run_is_prepared_once_while_its_parameters_and_sensors_move(plain, monkeypatch):
    model, run, seen = SignalModel(plain, NAMES), task(), []
    monkeypatch.setattr(plain, "simulate", lambda task, at: seen.append(task) or np.zeros((1, task.time.size)))
    for at in ({"d": 0.7}, {"d": 0.8}, {"d": 0.8, "y.offset": 0.1}):
        model.simulate(run, {"u.delay": 2.5e-3} | at)
    model.simulate(run, {"y.offset": 0.1, "y.gain": 2.0})
    assert seen[0] is seen[1] is seen[2] is not run
    assert seen[3] is run


def test_a_worker_gets_the_same_model_and_others_are_told_apart(plain):
    model = SignalModel(plain, NAMES)
    again = pickle.loads(pickle.dumps(model))
    assert again.token == model.token != SignalModel(plain, ("u.gain",)).token
    assert np.array_equal(again.simulate(task(), {"y.lag": 2e-3}), model.simulate(task(), {"y.lag": 2e-3}))


def test_a_setup_names_them_and_what_is_no_signal_is_refused(plain):
    spec = ModelSpec("bench", plain.path, {"reading": "gradient(y)"}, signal_effects=("u.gain",))
    assert "u.gain" in load_simulator(spec).variables
    assert load_simulator(spec) is load_simulator(spec)
    with pytest.raises(FmuError, match=r"'u.gian' is not an effect of an input or output.*did you mean 'gain'"):
        SignalModel(plain, ("u.gian",))
    with pytest.raises(FmuError, match=r"'d\.gain' is not an effect"):
        SignalModel(plain, ("d.gain",))
    with pytest.raises(FmuError, match="'y' is differentiated after its offset"):
        SignalModel(plain, ("y.offset",), {"y"})
