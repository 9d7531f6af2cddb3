"""Analytic models with known parameters, so that what an identification should find is known."""

import sys
from pathlib import Path

import numpy as np
import pytest

from fmuid import ParameterSpec, Problem, Simulator, Task, Variable, measured_case
from fmuid.core.errors import SimulationError

sys.path.insert(0, str(Path(__file__).parent))


class Analytic(Simulator):
    """A model from a function (time, inputs, parameters) -> {output: samples}; counts its simulations."""

    variables = None

    def __init__(self, function, parameters, outputs=("y",), units=None):
        self.function = function
        self.count = 0
        units = units or {}
        self.variables = {n: Variable(n, "parameter", unit=units.get(n)) for n in parameters}
        self.variables |= {n: Variable(n, "output", unit=units.get(n)) for n in outputs}
        self.variables |= {"u": Variable("u", "input", unit=units.get("u"))}

    def simulate(self, task, parameters):
        self.count += 1
        known = dict(task.start_values) | dict(parameters)
        with np.errstate(all="ignore"):
            outputs = self.function(task.time, task.inputs, known)
        if outputs is None:
            raise SimulationError("the integrator gave up")
        return np.array([np.broadcast_to(outputs[name], task.time.shape) for name in task.outputs])


def step_response(time, inputs, p):
    """Mass, damper and spring under a unit force."""
    decay, w = p["d"] / (2 * p["m"]), np.sqrt(p["k"] / p["m"] - (p["d"] / (2 * p["m"])) ** 2 + 0j)
    return {"y": np.real(1 - np.exp(-decay * time) * (np.cos(w * time) + decay / w * np.sin(w * time))) / p["k"]}


MSD_TRUTH = {"m": 1.2, "d": 0.7, "k": 30.0}


def msd_problem(seed=0, sigma=1e-4, repeats=3, noise=None, model=None, **options):
    """A mass-spring-damper that is to be found again from noisy step responses."""
    model = model or Analytic(step_response, MSD_TRUTH)
    time = np.linspace(0.0, 5.0, 301)
    exact = step_response(time, {}, MSD_TRUTH)["y"]
    if noise is None:
        noise = sigma * np.random.default_rng(seed).standard_normal((repeats, time.size))
    case = measured_case("step", model, Task(time, {}, ("y",)), {"y": exact + noise}, sigma={"y": sigma})
    specs = [
        ParameterSpec("m", 1.0, 0.1, 5.0),
        ParameterSpec("d", 0.3, 0.01, 5.0, scale="log"),
        ParameterSpec("k", 20.0, 1.0, 100.0),
    ]
    return Problem([case], specs, name="msd", **options)


@pytest.fixture
def analytic():
    return Analytic


@pytest.fixture
def msd():
    return msd_problem


@pytest.fixture
def msd_truth():
    return dict(MSD_TRUTH)


@pytest.fixture
def coloured():
    def noise(generator, runs, n=400, colour=0.95, shift=0.0):
        """(runs, n) first-order autoregressions of unit innovations, each run shifted as a whole."""
        white = generator.standard_normal((runs, n + 100))
        noise = np.zeros_like(white)
        for k in range(1, white.shape[1]):
            noise[:, k] = colour * noise[:, k - 1] + white[:, k]
        return noise[:, 100:] + shift * generator.standard_normal((runs, 1))

    return noise
