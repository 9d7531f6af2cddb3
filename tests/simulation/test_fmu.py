"""Simulation of co-simulation FMUs: inputs, outputs and error messages."""

from __future__ import annotations

import gc
import pickle
import shutil
import zipfile

import fmpy
import numpy as np
import pytest
from fmus import FAULTS

from fmuid.core.errors import FmuError, SimulationError
from fmuid.simulation import fmu as fmu_module
from fmuid.simulation import fmu_plan
from fmuid.simulation.fmu import Fmu, load_fmu
from fmuid.simulation.simulator import Simulator, Task

TIME = np.arange(501) * 1e-3
U = np.sign(np.sin(50 * TIME))
BOTH = pytest.mark.parametrize("fmi", [2, 3])


def task(**changes: object) -> Task:
    values = {"time": TIME, "inputs": {"u": U}, "outputs": ("x", "v"), **changes}
    return Task(**values)  # type: ignore[arg-type]


def oscillator(u, m=1.0, d=0.5, c=100.0, x=0.1, v=0.0, slope=False):
    """The FMU's own midpoint steps, input sample k acting on [t_k, t_k+1)."""
    rows = [(x, v)]
    for k, h in enumerate(np.diff(TIME)):
        middle = u[k] + (u[k + 1] - u[k]) / 2 if slope else u[k]
        a = (u[k] - d * v - c * x) / m
        xm, vm = x + h / 2 * v, v + h / 2 * a
        x, v = x + h * vm, v + h * ((middle - d * vm - c * xm) / m)
        rows.append((x, v))
    return np.array(rows).T


@BOTH
def test_outputs_follow_the_stepping_convention(build, fmi):
    fmu = Fmu(build(fmi))
    y = fmu.simulate(task(), {"m": 2.0, "c": 300.0})
    assert y.shape == (2, 501)
    assert y[:, 0] == pytest.approx([0.1, 0.0])  # right after initialisation
    np.testing.assert_allclose(y, oscillator(U, m=2, c=300), rtol=1e-12, atol=1e-15)


def test_same_as_fmpy(build):
    path = build(2)
    signals = np.zeros(len(TIME), dtype=[("time", float), ("u", float), ("flip", bool)])
    signals["time"], signals["u"] = TIME, np.sin(20 * TIME)
    signals["flip"] = TIME > 0.25
    theirs = fmpy.simulate_fmu(
        str(path), start_time=0, stop_time=0.5, output_interval=1e-3, input=signals, output=["y", "x"],
        start_values={"d": 2.0, "bias": 1.0},
    )  # fmt: skip
    inputs = {"u": signals["u"], "flip": signals["flip"].astype(float)}
    ours = Fmu(path).simulate(task(inputs=inputs, outputs=("y", "x")), {"d": 2.0, "bias": 1.0})
    np.testing.assert_allclose(ours, [theirs["y"], theirs["x"]], rtol=1e-9, atol=1e-12)


@BOTH
def test_variables_say_what_the_description_says(build, fmi):
    fmu = Fmu(build(fmi))
    assert isinstance(fmu, Simulator)
    m = fmu.variables["m"]
    assert (m.causality, m.variability, m.unit, m.start, m.min, m.description) == (
        "parameter", "fixed", "kg", 1.0, 0.0, "mass",
    )  # fmt: skip
    assert fmu.variables["flip"].type == "Boolean"
    assert fmu.variables["x"].start == 0.1
    assert fmu.default_experiment == {"start": 0.0, "stop": 1.0, "tolerance": 1e-7}
    assert fmu.interface == "co-simulation"
    if fmi == 3:
        assert [fmu.variables[f"table[2,{i}]"].start for i in (1, 2, 3)] == [3, 4, 5]


@BOTH
def test_values_are_set_by_their_type(build, fmi):
    fmu = Fmu(build(fmi))
    inputs = {"u": U, "flip": (TIME >= 0.2).astype(float)}
    y, x = fmu.simulate(task(inputs=inputs, outputs=("y", "x")), {"mode": 2, "gain": 10.0})
    # The switch set at t = 0.2 s is seen at the end of the next step: Boolean input, enumeration parameter.
    np.testing.assert_allclose(y - 10 * x, np.where(TIME >= 0.2005, 4.0, 1.0), atol=1e-12)


def test_an_array_is_set_element_by_element(build):
    fmu = Fmu(build(3))
    outputs = ("sum", "table[2,1]")
    y = fmu.simulate(task(outputs=outputs), {"table[1,2]": 10.0, "table[2,1]": -1.0})
    assert y[0, 0] == np.dot([1, 2, 3, 4, 5, 6], [0, 10, 2, -1, 4, 5])
    assert (y[1] == -1).all()
    assert fmu.simulate(task(outputs=outputs), {})[0, -1] == np.dot([1, 2, 3, 4, 5, 6], range(6))


@BOTH
def test_start_values_of_states_and_of_the_task(build, fmi):
    fmu = Fmu(build(fmi))
    y = fmu.simulate(task(start_values={"x": 0.3, "d": 9.0}), {"v": -1.0, "d": 2.0})
    np.testing.assert_allclose(y, oscillator(U, d=2, x=0.3, v=-1), rtol=1e-12, atol=1e-15)


@BOTH
def test_inputs_without_a_signal_hold_their_start_value(build, fmi):
    fmu = Fmu(build(fmi))
    free = fmu.simulate(task(inputs={}), {})
    np.testing.assert_allclose(free, oscillator(0 * U), rtol=1e-12, atol=1e-15)
    pushed = fmu.simulate(task(inputs={}), {"u": 5.0})
    np.testing.assert_allclose(pushed, oscillator(0 * U + 5), rtol=1e-12, atol=1e-15)
    assert np.array_equal(fmu.simulate(task(inputs={}), {}), free)


def test_input_slopes_are_handed_to_an_fmu_that_interpolates(build):
    smooth = np.sin(20 * TIME)
    linear = task(inputs={"u": smooth}, interpolation="linear")
    y = Fmu(build(2, interpolates=True)).simulate(linear, {})
    np.testing.assert_allclose(y, oscillator(smooth, slope=True), rtol=1e-12, atol=1e-15)
    with pytest.raises(FmuError, match="cannot interpolate its inputs"):
        Fmu(build(2)).simulate(linear, {})


@pytest.mark.parametrize(
    ("changes", "parameters", "message"),
    [
        ({}, {"gian": 1.0}, "no variable 'gian'; did you mean 'gain'"),
        ({}, {"zero": 1.0}, "'zero' is a calculatedParameter"),
        ({}, {"y": 1.0}, "'y' is an output that the FMU calculates"),
        ({}, {"time": 1.0}, "'time' is the independent variable"),
        ({}, {"mode": 1.5}, "'mode' takes whole numbers only"),
        ({}, {"fault": 2.0**31}, "'fault' takes -2147483648 to 2147483647 only"),
        ({"start_values": {"mode": -(2.0**31) - 1}}, {}, "'mode' takes -2147483648 to 2147483647 only"),
        ({}, {"d": np.nan}, "'d' cannot be set to nan"),
        ({"outputs": ("tau",)}, {}, "no variable 'tau'"),
        ({"inputs": {"m": U}}, {}, "'m' is not an input"),
        ({"inputs": {"u": U[1:]}}, {}, "input 'u' must have 501 finite samples"),
        ({"inputs": {"u": U * np.nan}}, {}, "input 'u' must have 501 finite samples"),
        ({"inputs": {"flip": U / 3}}, {}, "'flip' takes whole numbers only"),
        ({"inputs": {"flip": 2 + 0 * U}}, {}, "'flip' takes 0 to 1 only"),
        ({}, {"u": 1.0}, "'u' has both a signal and a start value"),
        ({"time": TIME[::-1]}, {}, "strictly increasing"),
    ],
)
def test_what_is_wrong_is_named(build, changes, parameters, message):
    with pytest.raises(FmuError, match=message):
        Fmu(build(2)).simulate(task(**changes), parameters)


@BOTH
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("nan", r"output 'y' is not finite at t = 0\.1 s"),
        ("fails", r"DoStep returned fmi\dError at t = 0\.1 s: the bearing has melted.*with c = 200, fault = "),
        ("fatal", r"DoStep returned fmi\dFatal at t = 0\.1 s: everything is lost"),
        ("ends", r"the FMU ended the simulation at t = 0\.1 s"),
    ],
)
def test_a_failed_simulation_is_an_error_and_leaves_no_trace(build, fmi, fault, message):
    fmu = Fmu(build(fmi))
    before = fmu.simulate(task(outputs=("y",)), {"c": 200.0})
    with pytest.raises(SimulationError, match=message):
        fmu.simulate(task(outputs=("y",)), {"c": 200.0, "fault": FAULTS[fault]})
    assert np.array_equal(fmu.simulate(task(outputs=("y",)), {"c": 200.0}), before)


def test_an_error_in_initialisation_says_so(build):
    with pytest.raises(
        SimulationError, match=r"ExitInitializationMode returned fmi2Error in initialisation: m must"
    ):
        Fmu(build(2)).simulate(task(), {"m": -1.0})


@BOTH
@pytest.mark.parametrize(
    "defines", [("RESET_FAILS",), ("RESET_FORGETS_STATE",), ("RESET_FORGETS_PARAMETERS",), ()]
)
def test_predictions_do_not_depend_on_what_was_simulated_before(build, fmi, defines):
    fmu, fresh = Fmu(build(fmi, defines=defines)), Fmu(build(fmi))
    one, two = task(), task(outputs=("y",), start_values={"bias": 1.0})
    for _ in range(2):
        for this, parameters in ((one, {"c": 50.0}), (one, {}), (two, {"d": 3.0, "gain": 2.0}), (two, {})):
            assert np.array_equal(fmu.simulate(this, parameters), fresh.simulate(this, parameters))
    expected = "instantiate" if defines in {("RESET_FAILS",), ("RESET_FORGETS_STATE",)} else "reset"
    assert fmu.renewal == expected


def test_an_fmu_that_cannot_be_instantiated_twice_is_reset(build):
    fmu = Fmu(build(2, defines=("ONCE",)))
    results = [fmu.simulate(task(), {"c": c}) for c in (50.0, 60.0, 50.0)]
    assert np.array_equal(results[0], results[2])
    assert not np.array_equal(results[0], results[1])


def test_an_fmu_that_can_do_neither_says_so(build):
    fmu = Fmu(build(2, defines=("ONCE", "RESET_FAILS")))
    assert fmu.simulate(task(), {}).shape == (2, 501)
    with pytest.raises(SimulationError, match=r"neither be reset nor be instantiated again.*worker processes"):
        fmu.simulate(task(), {})


def test_uneven_steps_are_refused_where_the_fmu_cannot(build):
    uneven = np.cumsum(np.random.default_rng(1).uniform(1e-3, 2e-3, 501))
    assert Fmu(build(2)).simulate(task(time=uneven), {}).shape == (2, 501)
    with pytest.raises(FmuError, match="cannot handle a variable communication step size"):
        Fmu(build(2, even_steps=True)).simulate(task(time=uneven), {})
    Fmu(build(2, even_steps=True)).simulate(task(), {})


@BOTH
def test_a_declared_fixed_step_is_taken_several_times_between_samples(build, fmi):
    fmu = Fmu(build(fmi, defines=("STEP=0.001",), even_steps=0.001))
    every = fmu.simulate(task(), {})
    rare = np.array([0, 5, 10, 30, 500])  # uneven, as the data may be
    held = np.repeat(U[rare[:-1]], np.diff(rare))
    times = TIME[rare] + [0, 1e-7, -1e-7, 0, 0]  # rounded
    y = fmu.simulate(task(time=times, inputs={"u": U[rare]}), {})
    assert np.array_equal(y, fmu.simulate(task(inputs={"u": np.append(held, 0)}), {})[:, rare])
    np.testing.assert_allclose(every, oscillator(U), rtol=1e-12, atol=1e-15)
    for wrong in (TIME * 1.5, TIME / 2):
        with pytest.raises(
            FmuError, match=r"declares a fixed communication step size of 0\.001 s.*multiples of 0\.001"
        ):
            fmu.simulate(task(time=wrong), {})


def test_inputs_are_interpolated_over_the_fixed_steps_between_samples(build):
    rare, smooth = np.arange(0, 501, 10), np.sin(20 * TIME)
    fmu = Fmu(build(2, defines=("STEP=0.001",), even_steps=0.001, interpolates=True))
    y = fmu.simulate(task(time=TIME[rare], inputs={"u": smooth[rare]}, interpolation="linear"), {})
    between = np.interp(TIME, TIME[rare], smooth[rare])
    np.testing.assert_allclose(y, oscillator(between, slope=True)[:, rare], rtol=1e-10, atol=1e-13)


def test_one_object_a_process_and_none_after_a_change(build, tmp_path):
    path = tmp_path / "copy.fmu"
    shutil.copy(build(2), path)
    first = load_fmu(path)
    assert load_fmu(path) is first
    assert pickle.loads(pickle.dumps(first)) is first
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("resources/more.txt", "more")
    assert load_fmu(path) is not first


def test_extracted_files_are_removed(build, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with Fmu(build(2)) as fmu:
        fmu.simulate(task(), {})
        assert list(tmp_path.glob("*/*"))
    assert not list(tmp_path.glob("*/*"))
    fmu.simulate(task(), {})
    del fmu
    gc.collect()
    assert not list(tmp_path.glob("*/*"))


def test_an_archive_of_very_many_files_is_refused(build, tmp_path, monkeypatch):
    monkeypatch.setattr(fmu_module, "MAX_FILES", 3)
    path = tmp_path / "many.fmu"
    shutil.copy(build(2), path)
    Fmu(path)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("resources/empty", "")
    with pytest.raises(FmuError, match="contains more than 3 files"):
        Fmu(path)


@pytest.mark.parametrize(
    "name", ["../evil.txt", "/evil.txt", "resources/../../evil.txt", "c:/evil.txt", "a\\..\\evil"]
)
def test_an_archive_that_climbs_out_is_refused(build, tmp_path, name):
    path = tmp_path / "evil.fmu"
    shutil.copy(build(2), path)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(zipfile.ZipInfo(name), "evil")
    with pytest.raises(FmuError, match="which points outside the archive"):
        Fmu(path)
    assert not (tmp_path.parent / "evil.txt").exists()


def test_files_that_are_no_fmu(tmp_path, build):
    (tmp_path / "text.fmu").write_text("no archive")
    with pytest.raises(FmuError, match="is not a readable FMU"):
        Fmu(tmp_path / "text.fmu")
    with pytest.raises(FmuError, match="No such file"):
        load_fmu(tmp_path / "missing.fmu")
    with zipfile.ZipFile(tmp_path / "other.fmu", "w") as archive, zipfile.ZipFile(build(2)) as good:
        archive.writestr("modelDescription.xml", good.read("modelDescription.xml"))
        archive.writestr("binaries/vax/oscillator.so", "")
    with pytest.raises(FmuError, match=r"has no library for .* \(it has: vax\)"):
        Fmu(tmp_path / "other.fmu").simulate(task(), {})
    with pytest.raises(FmuError, match="offers co-simulation, not model exchange"):
        Fmu(build(2), "model exchange")


def test_clocks_and_binaries_of_fmi_3(build):
    """What is no number is left alone; clocks, which co-simulation ticks itself, are refused in model exchange."""
    path = build(3, ("CoSimulation", "ModelExchange"), clock=True)
    y = Fmu(path).simulate(task(), {"m": 2.0})
    np.testing.assert_allclose(y, oscillator(U, m=2), rtol=1e-12, atol=1e-15)
    with pytest.raises(FmuError, match="'picture' is a Binary, not a number"):
        Fmu(path).simulate(task(outputs=("picture",)), {})
    with pytest.raises(
        FmuError, match="has the input clock 'tick', and clocks are not supported in model exchange"
    ):
        Fmu(path, "model exchange")
    with pytest.raises(FmuError, match="'tick' is a Clock, not a number"):
        Fmu(path).simulate(task(inputs={"tick": U}), {})


def test_fmi_1_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "old.fmu", "w") as archive:
        archive.writestr(
            "modelDescription.xml",
            '<fmiModelDescription fmiVersion="1.0" modelName="Old" modelIdentifier="Old" guid="0" '
            'numberOfContinuousStates="0" numberOfEventIndicators="0"><ModelVariables/></fmiModelDescription>',
        )
    with pytest.raises(FmuError, match=r"old\.fmu: has FMI version 1\.0; 2\.0 and 3\.0 are supported"):
        Fmu(tmp_path / "old.fmu")


def test_tasks_are_laid_out_once_and_forgotten_when_they_are_too_many(build, monkeypatch):
    monkeypatch.setattr(fmu_plan, "_MAX_PREPARED", 100_000)
    fmu = Fmu(build(2))
    for _ in range(50):
        fmu.simulate(task(), {})
    assert len(fmu._prepared._kept) <= 9  # 8 bytes, 501 samples, 3 columns each


def test_an_fmu_that_needs_its_tool_reports_that(build, tmp_path):
    """One with another token is refused by its library; the description states that it needs its tool."""
    needing = tmp_path / "Needing.fmu"
    with zipfile.ZipFile(build(2)) as old, zipfile.ZipFile(needing, "w") as new:
        for name in old.namelist():
            content = old.read(name).replace(b"<CoSimulation ", b'<CoSimulation needsExecutionTool="true" ')
            new.writestr(name, content.replace(b'guid="oscillator"', b'guid="another"'))
    with pytest.raises(FmuError, match="needsExecutionTool"):
        Fmu(needing).simulate(Task(np.array([0.0, 0.1]), {}, ("y",)), {})
