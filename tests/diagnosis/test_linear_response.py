"""The linear response to parameters that vary, compared with simulations of the model that has them."""

import zipfile
from pathlib import Path

import numpy as np
import pytest

from fmu_build import compile_flat, load
from fmu_build.instrument import Added, Term, instrument
from fmu_build.packaging import package
from fmuid import load_fmu
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.linear_response import Linearised, LinearisedFmu, LinearResponse
from fmuid.simulation.simulator import Task

RIGS = Path(__file__).parents[1] / "fmu_build" / "models" / "Rigs.mo"


@pytest.mark.parametrize(
    ("rig", "parameter", "drive", "outputs"),
    [
        ("TwoMass", "shaft.c", {"tau": 0.3}, ("w_motor", "w_load")),
        ("TwoMass", "load.J", {"tau": 0.3}, ("w_motor", "w_load")),
        ("Circuit", "resistor.R", {"v": 5.0}, ("v_c",)),
    ],
)
def test_the_response_is_that_of_a_simulation(tmp_path, rig, parameter, drive, outputs):
    flat = load(RIGS, f"Rigs.{rig}")
    term = Term(parameter, "parameter", "p*(1 + course)")
    varied = instrument(flat, [term], [Added("course", input=True)])
    fmu = load_fmu(package(compile_flat(varied), tmp_path / "varied.fmu"))
    time = np.linspace(0.0, 2.0 if rig == "TwoMass" else 0.05, 801)
    inputs = {n: a * np.sign(np.sin(6.0 * time / time[-1])) for n, a in drive.items()}
    course = np.sin(9.0 * time / time[-1]) + 0.3
    model = Linearised(compile_flat(flat), [parameter])

    def simulated(size, names):
        return fmu.simulate(
            Task(time, {**inputs, "course": size * course}, tuple(names), interpolation="linear"), {}
        )

    names = model.needed
    courses = dict(zip(names, simulated(0.0, names), strict=True)) | inputs
    along = model.along(time, courses, {}, outputs)
    assert along.powers == pytest.approx([-1.0 if parameter == "load.J" else 1.0])
    response = along.to(0, course[None, :])[0]
    expected = (simulated(1e-3, outputs) - simulated(-1e-3, outputs)) / 2e-3
    size = np.abs(expected).max(axis=1, keepdims=True)
    assert np.abs(response - expected).max() < 0.05 * size.max()  # a few samples for each oscillation
    assert (size > 0.0).all()


@pytest.mark.parametrize("offered", [True, False])
@pytest.mark.parametrize(
    ("rig", "parameter", "drive", "outputs"),
    [
        ("TwoMass", "shaft.c", {"tau": 0.3}, ("w_motor", "w_load")),
        ("TwoMass", "load.J", {"tau": 0.3}, ("w_motor", "w_load")),
        ("Circuit", "resistor.R", {"v": 5.0}, ("v_c",)),
    ],
)
def test_an_fmu_without_source_has_the_same_response(tmp_path, rig, parameter, drive, outputs, offered):
    """By the FMU's directional derivatives, or by differences."""
    model = compile_flat(load(RIGS, f"Rigs.{rig}"))
    path = package(model, tmp_path / "plain.fmu")
    if not offered:
        with_text = {n: c.replace(b"providesDirectionalDerivative", b"x") for n, c in contents(path).items()}
        path = packed(tmp_path / "without.fmu", with_text)
    fmu = Fmu(path, "model exchange")
    assert fmu.description.model_exchange.directional == offered
    time = np.linspace(0.0, 2.0 if rig == "TwoMass" else 0.05, 201)
    inputs = {n: a * np.sign(np.sin(6.0 * time / time[-1])) for n, a in drive.items()}
    course = np.sin(9.0 * time / time[-1]) + 0.3
    ours, theirs = Linearised(model, [parameter]), LinearisedFmu(fmu, [parameter])
    names = list(dict.fromkeys([*ours.needed, *theirs.needed]))
    courses = dict(zip(names, fmu.simulate(Task(time, inputs, tuple(names)), {}), strict=True)) | inputs
    expected, response = (m.along(time, courses, {}, outputs).to(0, course[None, :]) for m in (ours, theirs))
    assert np.abs(response - expected).max() < 1e-6 * np.abs(expected).max()


def contents(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def packed(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


@pytest.mark.parametrize("steps", [1, 2, 8, 9, 23])
@pytest.mark.parametrize("n", [0, 1, 3])
def test_states_pass_on_from_knot_to_knot(steps, n):
    rng, outputs, parameters = np.random.default_rng(5), 2, 2
    time = np.linspace(0.0, 1.0, steps + 1)
    transition = rng.normal(scale=0.6, size=(steps, n, n))
    driven = rng.normal(size=(steps, n, parameters))
    observed = rng.normal(size=(steps + 1, outputs, n))
    direct = rng.normal(size=(steps + 1, outputs, parameters))
    rates = rng.normal(size=(steps + 1, n, parameters))
    response = LinearResponse(
        time, np.arange(steps + 1.0), transition, driven, observed, direct, rates, np.ones(parameters)
    )
    courses = rng.normal(size=(4, steps + 1))
    moved = response.to(1, courses)
    for course, of_one in zip(courses, moved, strict=True):
        state = np.zeros(n)
        for k in range(steps + 1):
            assert of_one[:, k] == pytest.approx(observed[k] @ state + direct[k, :, 1] * course[k], abs=1e-9)
            if k < steps:
                state = transition[k] @ state + driven[k, :, 1] * 0.5 * (course[k] + course[k + 1])
