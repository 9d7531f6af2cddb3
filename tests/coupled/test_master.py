"""Coupled FMUs: they agree with the single model as the step shrinks, whatever they are made of."""

from __future__ import annotations

import math
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
from systems import coupled, split

from fmuid.core.errors import FmuError, SimulationError
from fmuid.identification.parameter_set import parameter_set
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.pool.parcels import packed, unpacked
from fmuid.simulation.pool.workers import WorkerPool
from fmuid.simulation.simulator import Simulator, Task

TIME = np.linspace(0, 1, 101)
SPEED = 30 * np.sin(2 * np.pi * TIME)
SIGNALS = ("plant.w_motor", "plant.tau_sensor", "plant.phi_load", "controller.i")
TASK = Task(TIME, {"controller.w_ref": SPEED}, SIGNALS, {}, "linear", 1e-8)


@pytest.fixture(scope="module")
def single(drive):
    names = ("w_motor", "tau_sensor", "phi_load", "i_motor")
    task = Task(TIME, {"w_ref": SPEED}, names, {}, "linear", 1e-8)
    return load_fmu(drive["whole"]).simulate(task, {})


def error(y, reference):
    return np.sqrt(np.mean((y - reference) ** 2, axis=1) / np.mean(reference**2, axis=1))


@pytest.mark.parametrize("algorithm", ["jacobi", "gauss_seidel"])
@pytest.mark.parametrize(("extrapolation", "order", "largest"), [("constant", 1, 1.2e-2), ("linear", 2, 6e-4)])
def test_the_split_actuator_converges_to_the_single_fmu(drive, single, algorithm, extrapolation, order, largest):
    errors = [
        error(split(drive, step=h, algorithm=algorithm, extrapolation=extrapolation).simulate(TASK, {}), single)
        for h in (1e-3, 5e-4, 2.5e-4)
    ]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders[:, [0, 2]], order, atol=0.15)  # speed and angle: smooth
    assert orders[-1].min() > order - 0.3  # torque and current have the friction's corners
    assert errors[0][:3].max() < largest


def test_gauss_seidel_is_closer_than_jacobi(drive, single):
    jacobi, seidel = (
        error(split(drive, step=1e-3, algorithm=a).simulate(TASK, {}), single) for a in ("jacobi", "gauss_seidel")
    )
    assert (seidel < jacobi).all()


def exact_lag(x0, target, rate):
    return target + (x0 - target) * np.exp(-rate * TIME)


@pytest.mark.parametrize(
    "interfaces", [("co-simulation", 2), ("co-simulation", 3), ("model exchange", 2), ("model exchange", 3)]
)
def test_fmi_2_and_3_and_model_exchange_can_be_mixed(made, interfaces):
    from fmuid.core.coupling import Connection, Linear, Master, Place
    from fmuid.simulation.coupled.coupled_model import CoupledModel
    from fmuid.simulation.fmu import Fmu

    interface, fmi = interfaces
    components = {"lag": Fmu(made("Lag", fmi), interface), "gain": Fmu(made("Gain", 5 - fmi))}
    wires = [
        Connection(Place("lag", "x"), Place("gain", "u"), Linear()),
        Connection(Place("gain", "y"), Place("lag", "u"), Linear(2.0, 0.5)),
    ]
    errors = []
    for step in (2e-3, 1e-3):
        model = CoupledModel("mixed", components, wires, master=Master(step))
        (x,) = model.simulate(Task(TIME, {}, ("lag.x",), {}, "hold", 1e-9), {"gain.k": -1.0, "gain.b": 0.25})
        # T x' = 2 (b - x) + 0.5 - x
        errors.append(np.abs(x - exact_lag(1.0, 1.0 / 3.0, 3 / 0.1)).max())
    assert errors[0] < 0.02
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.2)


def test_a_controller_of_another_tool(drive, single, python_pi):
    """Which does not say what its output depends on: no loop, since the plant does."""
    model = split({**drive, "controller": python_pi}, step=5e-4)
    y = model.simulate(Task(TIME, {"controller.w_ref": SPEED}, SIGNALS, {}, "hold", 1e-8), {})
    assert error(y, single)[:3].max() < 0.1  # the reference is held over 10 ms, 5 ms late on average
    finer = np.linspace(0, 1, 2001)
    task = Task(finer, {"controller.w_ref": 30 * np.sin(2 * np.pi * finer)}, SIGNALS, {}, "hold", 1e-8)
    assert error(model.simulate(task, {})[:, ::20], single)[:3].max() < 1e-2
    with pytest.raises(FmuError, match=r"system, component 'controller': this FMU cannot interpolate its inputs"):
        model.simulate(TASK, {})
    linear_plant = split({**drive, "controller": python_pi}, step=5e-4, extrapolation={"plant": "linear"})
    assert error(linear_plant.simulate(task, {})[:, ::20], single)[0] < 6e-3


def test_a_held_jump_is_seen_by_all_in_the_step_that_begins_with_it(made):
    model = coupled({"a": made("Gain"), "b": made("Gain")}, {"b.u": "a.y"})
    jump = (TIME >= 0.5).astype(float)
    a, b = model.simulate(Task(TIME, {"a.u": jump}, ("a.y", "b.y")), {"a.k": 2.0, "b.k": 3.0})
    # Outputs at a sample are those of the step that ends there, as for one FMU.
    np.testing.assert_array_equal(a[1:], 2 * jump[:-1])
    np.testing.assert_array_equal(b[1:], 6 * jump[:-1])
    assert (a[0], b[0]) == (0.0, 0.0)


def test_initial_values_run_through_all_components_in_any_order(made):
    """Outputs at the first sample belong to the inputs there, however long the chain."""
    chain = {name: made("Gain") for name in "abcd"}
    wires = {"a.u": ("b.y", 1.0, 0.5), "b.u": "c.y", "c.u": "d.y"}
    for algorithm in ("jacobi", "gauss_seidel"):
        model = coupled(chain, wires, algorithm=algorithm)
        gains = {f"{name}.k": 2.0 for name in chain}
        y = model.simulate(Task(TIME, {"d.u": np.full(101, 1.5)}, ("a.y", "b.y", "d.y")), gains)
        np.testing.assert_allclose(y[:, 0], [2 * (8 * 1.5 + 0.5), 8 * 1.5, 3.0])
        np.testing.assert_allclose(y[:, 0], y[:, -1])


def test_whole_numbers_and_truth_values_are_passed_on(made):
    model = coupled({"a": made("Counter"), "b": made("Counter")}, {"b.n": "a.twice", "b.on": "a.off"})
    n, on = np.repeat([1.0, 3.0], [50, 51]), np.repeat([1.0, 0.0], [50, 51])
    task = Task(TIME, {"a.n": n, "a.on": on}, ("b.twice", "b.off", "a.twice"))
    twice, off, real = model.simulate(task, {})
    assert (twice[0], twice[-1], real[-1]) == (4.0, 12.0, 6.0)
    assert np.array_equal(off[1:], on[:-1])
    assert (
        coupled({"a": made("Counter"), "g": made("Gain")}, {"g.u": "a.twice"}).simulate(
            Task(TIME, {"a.n": n}, ("g.y",)), {}
        )[0, -1]
        == 6.0
    )


def test_the_protocol_of_a_simulator(drive):
    model = split(drive, step=1e-3)
    assert isinstance(model, Simulator)
    assert model.variables["plant.mgr"].start == 25.0
    assert model.variables["plant.i"].causality == "local"
    assert model.variables["controller.w_ref"].causality == "input"
    assert model.default_experiment["stop"] == 50.0
    assert list(model.components) == ["plant", "controller"]
    assert pickle.loads(pickle.dumps(model)) is model
    assert split(drive, step=1e-3) is model
    assert split(drive, step=2e-3).token != model.token


def test_runs_do_not_depend_on_what_ran_before_nor_on_where(drive):
    model = split(drive, step=1e-3)
    task = Task(TIME, {"controller.w_ref": SPEED}, SIGNALS)
    jobs = [(model, task, {"plant.mgr": m, "controller.kp": 0.03}) for m in (10.0, 20.0)] + [(model, task, {})]
    here = [model.simulate(*job[1:]) for job in jobs]
    assert np.array_equal(model.simulate(task, {}), here[2])
    assert not np.array_equal(here[0], here[1])
    with WorkerPool(1) as pool:
        for there, expected in zip(pool.run(jobs), here, strict=True):
            assert np.array_equal(there, expected)


def test_a_communication_step_never_steps_over_a_sample(made):
    """Uneven samples: the largest step is kept to, and every sample is a communication point."""
    time = np.array([0.0, 0.01, 0.1, 0.15, 1.0])
    (x,) = coupled(
        {"lag": made("Lag"), "gain": made("Gain")}, {"gain.u": "lag.x", "lag.u": "gain.y"}, step=1e-3
    ).simulate(Task(time, {}, ("lag.x",), {}, "hold", 1e-9), {"gain.k": -1.0})
    np.testing.assert_allclose(x, np.exp(-20 * time), atol=4e-3)


def test_what_goes_wrong_in_a_component_is_said_of_it(drive):
    model = split(drive, step=1e-3)
    with pytest.raises(SimulationError, match=r"system, component 'plant': .*J_R = 0"):
        model.simulate(TASK, {"plant.J_R": 0.0})
    assert np.isfinite(model.simulate(TASK, {})).all()


@pytest.mark.parametrize(
    ("task", "parameters", "message"),
    [
        ({"inputs": {"plant.i": SPEED}}, {}, "'plant.i' is not an input of the system but has causality local"),
        ({"inputs": {"controller.w_rex": SPEED}}, {}, "no variable 'controller.w_rex'; did you mean 'controller.w_ref'"),
        ({}, {"plant.mgrr": 1.0}, "no variable 'plant.mgrr'; did you mean 'plant.mgr'"),
        ({}, {"controller.w": 1.0}, "'controller.w' follows 'plant.w_motor': its start value cannot be set"),
        ({}, {"controller.w_ref": 1.0}, "'controller.w_ref' has both a signal and a start value"),
        ({}, {"plant.w_motor": 1.0}, "component 'plant': 'w_motor' is an output that the FMU calculates"),
        ({"outputs": ("plant.x",)}, {}, "no variable 'plant.x'"),
        ({"inputs": {"controller.w_ref": SPEED[1:]}}, {}, "input 'controller.w_ref' must have 101 finite samples"),
        ({"time": TIME[::-1]}, {}, "strictly increasing"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_task_is_named(drive, task, parameters, message):
    inputs = {"controller.w_ref": SPEED}
    values = {"time": TIME, "inputs": inputs, "outputs": ("plant.w_motor",), **task}
    with pytest.raises(FmuError, match=message):
        split(drive).simulate(Task(**values), parameters)


def test_inputs_that_nothing_drives_hold_what_they_start_with(made):
    model = coupled({"a": made("Gain"), "b": made("Gain")}, {"b.u": "a.y"})
    task = Task(TIME, {}, ("b.y",))
    assert (model.simulate(task, {"a.u": 2.0, "a.k": 3.0}) == 6.0).all()
    assert (model.simulate(task, {}) == 0.0).all()
    assert math.isclose(model.simulate(task, {"a.b": 0.5})[0, -1], 0.5)


def test_variables_of_the_main_component_go_by_their_own_names(drive):
    from fmuid.core.coupling import Coupling, Linear, Master
    from fmuid.simulation.coupled.loading import load_coupling

    files = {name: drive[name] for name in ("plant", "controller")}
    wires = {"plant.i": ("controller.i", Linear()), "controller.w": ("plant.w_motor", Linear())}
    model = load_coupling(Coupling(Master(1e-3), files, wires, main="plant"))
    task = Task(TIME, {"controller.w_ref": SPEED}, ("w_motor", "controller.i"))
    expected = split(drive, step=1e-3).simulate(
        Task(TIME, {"controller.w_ref": SPEED}, ("plant.w_motor", "controller.i")), {"plant.mgr": 20.0}
    )
    assert np.array_equal(model.simulate(task, {"mgr": 20.0}), expected)
    assert b'name="plant.mgr"' in parameter_set("found", {"bench": {"mgr": 20.0}}, {"bench": model})
    with pytest.raises(FmuError, match=r"no variable 'plant.mgr'; did you mean 'mgr'"):
        model.simulate(task, {"plant.mgr": 20.0})
    with pytest.raises(FmuError, match=r"'i' follows 'controller.i'"):
        model.simulate(task, {"i": 1.0})


def test_a_parcel_for_another_machine_has_the_fmus_in_it(drive, tmp_path):
    files = {name: shutil.copy(drive[name], tmp_path) for name in ("plant", "controller")}
    model, task = split(files, step=1e-3), Task(TIME[:5], {"controller.w_ref": SPEED[:5]}, SIGNALS)
    expected, content = model.simulate(task, {}), packed(model).content
    for file in files.values():
        Path(file).unlink()
    there = unpacked(content)
    assert there is not model
    assert np.array_equal(there.simulate(task, {}), expected)


def test_a_run_that_pauses_for_ctrl_c_goes_on_where_it_was(made, monkeypatch):
    model = coupled({"lag": made("Lag"), "gain": made("Gain")}, {"gain.u": "lag.x", "lag.u": "gain.y"}, step=2e-3)
    task = Task(TIME[:40], {}, ("lag.x", "gain.y"))
    whole = model.simulate(task, {"gain.k": -1.0})
    monkeypatch.setattr("fmuid.simulation.stepper._SLICE", 0.0)
    assert np.array_equal(model.simulate(task, {"gain.k": -1.0}), whole)
