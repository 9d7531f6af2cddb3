"""SSP files: read as the standard has them, or refused in one line."""

from __future__ import annotations

import shutil
import zipfile

import numpy as np
import pytest
from systems import (
    NAMESPACES,
    bindings,
    component,
    connection,
    connections,
    connector,
    connectors,
    elements,
    inline,
    parameter_set,
    split,
    write_ssp,
)

from fmuid.cli.app import run
from fmuid.core.coupling import Master
from fmuid.core.errors import FmuError, UnitError
from fmuid.simulation.coupled.loading import load_model, load_system
from fmuid.simulation.pool.workers import WorkerPool
from fmuid.simulation.simulator import Task

TIME = np.linspace(0, 0.5, 51)
SPEED = 30 * np.sin(4 * np.pi * TIME)
STEP = Master(1e-3, extrapolation="linear")
PARTS = elements(component("plant", "plant.fmu"), component("controller", "controller.fmu"))
GAINS = elements(component("a", "gain.fmu"), component("b", "gain.fmu"))
WIRES = (connection("controller.i", "plant.i"), connection("plant.w_motor", "controller.w"))
SPLIT = PARTS + connections(*WIRES)


def real(value, unit=""):
    return f'<ssv:Real value="{value}"' + (f' unit="{unit}"/>' if unit else "/>")


def linear(factor, offset):
    return f'<ssc:LinearTransformation factor="{factor}" offset="{offset}"/>'


@pytest.fixture
def ssp(drive, tmp_path):
    """Write an SSP file of the split actuator."""

    def write(system=SPLIT, more=None, **options):
        files = {"plant.fmu": drive["plant"], "controller.fmu": drive["controller"], **(more or {})}
        return write_ssp(tmp_path / "drive.ssp", system, files, **options)

    return write


@pytest.fixture
def gains(made, tmp_path):
    """Write an SSP file of gains a and b, with more in the system."""

    def write(system, elements_=GAINS, **options):
        return write_ssp(tmp_path / "gains.ssp", system + elements_, {"gain.fmu": made("Gain")}, **options)

    return write


def table(drive, **parameters):
    """Simulate the same by a table of connections."""
    task = Task(TIME, {"controller.w_ref": SPEED}, ("plant.w_motor", "plant.tau_sensor"), {}, "linear", 1e-8)
    return split(drive, step=1e-3, extrapolation="linear").simulate(task, parameters)


@pytest.mark.parametrize("version", ["1.0", "2.0"])
def test_an_ssp_is_the_same_as_a_table(ssp, drive, version):
    model = load_system(ssp(version=version, rest='<ssd:DefaultExperiment startTime="0" stopTime="3"/>'), STEP)
    task = Task(TIME, {"controller.w_ref": SPEED}, ("plant.w_motor", "plant.tau_sensor"), {}, "linear", 1e-8)
    assert np.array_equal(model.simulate(task, {"plant.mgr": 20.0}), table(drive, **{"plant.mgr": 20.0}))
    assert model.default_experiment["stop"] == 3.0
    assert load_model(model.path).path == model.path
    with WorkerPool(1) as pool:
        assert np.array_equal(pool.run([(model, task, {})])[0], table(drive))


def test_nested_systems_ports_transformations_units_and_direction(ssp, drive):
    """A connection may be written from either end; mA and rpm are converted at the systems' borders."""
    inner = (
        connectors(connector("current", "input", "mA"), connector("w", "output", "rpm"))
        + elements(component("plant", "plant.fmu", connectors(connector("i", "input", "A"))))
        + connections(connection("plant.i", "current"), connection("plant.w_motor", "w"))
    )
    system = (
        connectors(
            connector("speed", "input", "rpm"), connector("gain", "parameter"), connector("twice", "output", "N.m")
        )
        + elements(f'<ssd:System name="drive">{inner}</ssd:System>', component("controller", "controller.fmu"))
        + connections(
            connection("speed", "controller.w_ref", startElement=""),  # as some tools write it
            connection("gain", "controller.kp", linear(0.001, 0)),
            connection("drive.current", "controller.i"),
            connection("drive.w", "controller.w"),
        )
    )
    outward = connection("drive.plant.tau_sensor", "twice", linear(2, 1))
    with pytest.raises(FmuError, match=r"connection to 'drive.plant.tau_sensor': no element 'drive.plant'"):
        load_system(ssp(system.replace("</ssd:Connections>", outward + "</ssd:Connections>", 2)))
    inner_out = inner.replace(
        connector("w", "output", "rpm"), connector("w", "output", "rpm") + connector("tau", "output")
    )
    inner_out = inner_out.replace(
        connection("plant.w_motor", "w"), connection("plant.w_motor", "w") + connection("plant.tau_sensor", "tau")
    )
    system = system.replace(inner, inner_out).replace(
        connection("drive.w", "controller.w"),
        connection("drive.w", "controller.w") + connection("drive.tau", "twice", linear(2, 1)),
    )
    model = load_system(ssp(system), STEP)
    assert {n for n, v in model.variables.items() if v.causality == "input"} == {"speed"}
    assert model.variables["speed"].unit == "rpm"
    task = Task(TIME, {"speed": SPEED * 30 / np.pi}, ("drive.plant.w_motor", "twice", "gain"), {}, "linear", 1e-8)
    w, twice, gain = model.simulate(task, {"gain": 30.0, "drive.plant.mgr": 20.0})
    expected = table(drive, **{"controller.kp": 0.03, "plant.mgr": 20.0})
    np.testing.assert_allclose(w, expected[0], atol=1e-4)
    np.testing.assert_allclose(twice, 2 * expected[1] + 1, atol=1e-2)
    np.testing.assert_allclose(gain, 30.0)
    with pytest.raises(FmuError, match=r"'controller.kp' follows 'gain'; set 'gain'"):
        model.simulate(task, {"controller.kp": 0.03})


def test_parameter_bindings_outer_before_inner_later_before_earlier(ssp):
    """Inline and in files, with units, prefixes and mappings; what is bound is where the variables start."""
    mapping = '<ssd:ParameterMapping><ssm:ParameterMapping version="1.0">{}</ssm:ParameterMapping></ssd:ParameterMapping>'
    entries = f'<ssm:MappingEntry source="stiff" target="controller.ki">{linear(2, 0.1)}</ssm:MappingEntry>'
    plant = bindings(
        inline({"mgr": real(1), "J_L": real(0.1), "c_S": real(1e5)}), inline({"c_S": real(9e4), "d_S": real(0.9)})
    )
    system = (
        bindings(
            '<ssd:ParameterBinding source="resources/set%201.ssv" prefix="plant."/>',
            inline({"stiff": real(0.2), "unmapped": real(1), "controller.kp": real(9)}, mapping.format(entries)),
            inline({"plant.J_L": real(400, "[kg.m2]"), "elsewhere.x": real(1)}),
        )
        + elements(component("plant", "plant.fmu", plant), component("controller", "controller.fmu"))
        + connections(*WIRES)
    )
    values = parameter_set({"mgr": real(20000, "N.mm"), "J_L": real(7)}, NAMESPACES)
    model = load_system(ssp(system, {"set 1.ssv": values}))
    starts = {
        n: model.variables[n].start for n in ("plant.mgr", "plant.J_L", "plant.c_S", "plant.d_S", "controller.ki")
    }
    assert starts == pytest.approx(
        {"plant.mgr": 20.0, "plant.J_L": 400.0, "plant.c_S": 9e4, "plant.d_S": 0.9, "controller.ki": 0.5}
    )
    assert model.variables["controller.kp"].start == 0.02  # not mapped, so not applied
    task = Task(TIME, {}, tuple(starts), {"plant.mgr": 10.0})
    y = model.simulate(task, {"plant.d_S": 1.1})[:, -1]
    assert y == pytest.approx([10.0, 400.0, 9e4, 1.1, 0.5])  # the task wins, and the run's parameters over it
    assert model.simulate(task, {"plant.d_S": 1.1})[:, -1] == pytest.approx(y)


def test_bound_connectors_set_what_they_lead_to(gains):
    system = (
        connectors(connector("k", "parameter"), connector("u", "input"))
        + bindings(inline({"k": real(3), "u": real(2)}))
        + connections(
            connection("k", "a.k"),
            connection("k", "b.k", linear(10, 0)),
            connection("u", "a.u"),
            connection("a.y", "b.u"),
        )
    )
    model = load_system(gains(system))
    assert (model.variables["k"].start, model.variables["u"].start) == (3.0, 2.0)
    assert model.simulate(Task(TIME, {}, ("b.y",)), {})[0, -1] == 2 * 3 * 30
    assert model.simulate(Task(TIME, {"u": 1.0 + 0 * TIME}, ("b.y",)), {"k": 2.0})[0, -1] == 1 * 2 * 20


def test_simulate_on_the_command_line(ssp, drive, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = ssp()
    words = [
        "--master",
        "step=1e-3",
        "--master",
        'extrapolation={"plant": "linear"}',
        "--master",
        "algorithm=jacobi",
    ]
    arguments = ["simulate", str(path), "--set", "controller.integral_start=0.5", "--stop", "0.1", *words]
    assert run([*arguments, "--output", "plant.w_motor", "--out", "out.csv"]) == 0
    rows = np.genfromtxt(tmp_path / "out.csv", delimiter=",", names=True)
    assert abs(rows["plantw_motor_rads"][-1]) > 0.1
    for wrong, message in (
        (["--master", "algorithm=jacob"], "--master: 'algorithm' is 'jacob'; did you mean 'jacobi'?"),
        (["--master", "stp=1"], "--master: unknown key 'stp'; did you mean 'step'?"),
        (["--set", "plant.mgrr=1"], "drive.ssp has no variable 'plant.mgrr'; did you mean 'plant.mgr'?"),
    ):
        assert run([*arguments, *wrong]) == 2
        assert message in capsys.readouterr().err
    assert run(["simulate", str(drive["whole"]), "--master", "step=1"]) == 2
    assert "--master applies to .ssp files only" in capsys.readouterr().err


AB = connections(connection("a.y", "b.u"))


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (connections(connection("a.y", "c.u")), "connection to 'c.u': no element 'c'"),
        (connections(connection("a.z", "b.u")), "component 'a' has no variable 'z'; known: u, y"),
        (connections(connection("a.u", "b.u")), "'a.u' and 'b.u' are connected but both take a value (input, input)"),
        (connections(connection("a.y", "b.y")), "'a.y' and 'b.y' are connected but both give a value"),
        (connections(connection("a.y", "b.k")), "a.y -> b.k: 'b.k' is a parameter, not an input; known: u"),
        (connections(connection("a.y", "b.u"), connection("b.u", "a.y")), "'b.u' follows both 'a.y' and 'a.y'"),
        (connections(connection("a.y", "b.u"), connection("b.y", "a.u")), "algebraic loop: a.y -> b.u -> b.y -> a.u -> a.y"),
        (connections(connection("nothing", "b.u")), "connection to 'nothing': no such connector"),
        (connectors(connector("u", "input")) + connections(connection("u", "b.u"), connection("a.y", "b.u")), "'b.u' follows both 'u' and 'a.y'"),
        (connections(connection("a.y", "b.u", "<ssc:BooleanMappingTransformation/>")), "a BooleanMappingTransformation, which is not supported"),
        (connections(connection("a.y", "b.u", startIndices="1")), "connections of array elements by index"),
        (connections(connection("a.y", "b.u", linear("many", 0))), "'factor' of a LinearTransformation is 'many'; write a number"),
        (connectors(connector("u", "input"), connector("y", "output")) + connections(connection("u", "y")), "'y' passes 'u' on"),
        (bindings(inline({"a.kk": real(1)})), "none of the parameters bound to 'the system' exists; did you mean 'a.k'"),
        (bindings(inline({"a.k": '<ssv:String value="x"/>'})), "parameter 'a.k' for 'a.k' is the String 'x', not one number"),
        (bindings('<ssd:ParameterBinding source="resources/none.ssv"/>'), "a parameter binding of 'root' has the source 'resources/none.ssv', which is missing"),
        (bindings('<ssd:ParameterBinding source="../../secret.ssv"/>'), "'../../secret.ssv', which is not a file of the archive"),
        (bindings('<ssd:ParameterBinding source="resources/gain.fmu"/>'), "a parameter binding of 'root' is not XML"),
        (bindings('<ssd:ParameterBinding sourceBase="component" source="x.ssv"/>'), "a parameter binding of 'root' is inside a component"),
        (bindings("<ssd:ParameterBinding/>"), "a parameter binding of 'root' has no ParameterSet"),
    ],
)  # fmt: skip
def test_what_a_system_may_not_say(gains, system, message):
    with pytest.raises(FmuError) as refusal:
        load_system(gains(system))
    assert message in str(refusal.value)
    assert "gains.ssp: " in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("items", "message"),
    [
        ([], "gains.ssp: has no component; export it with its FMUs"),
        ([component("a", "none.fmu")], "component 'a' has the source 'resources/none.fmu', which is missing"),
        ([component("a", "../../../etc/passwd")], "which is not a file of the archive"),
        ([component("a", "%2e%2e/%2e%2e/x.fmu")], "which is not a file of the archive"),
        ([component("a", "", source="/etc/passwd")], "'/etc/passwd', which is not a file of the archive"),
        ([component("a", "", source="https://example.org/x.fmu")], "which is not a file of the archive"),
        (['<ssd:Component name="a"/>'], "component 'a' has no source"),
        (['<ssd:Component source="resources/gain.fmu"/>'], "a Component has no 'name'"),
        ([component("a", "gain.fmu", type="application/x-ssp-package")], "is of type application/x-ssp-package, not an FMU"),
        ([component("a", "gain.fmu", implementation="ScheduledExecution")], "component 'a' asks for ScheduledExecution"),
        ([component("a", "gain.fmu")] * 2, "two elements are named 'a'"),
        (['<ssd:SignalDictionaryReference name="d"/>'], "a SignalDictionaryReference is not supported"),
        ([component("a", "gain.fmu", connectors(connector("y", "input")))], "connector 'a.y' is of kind input, but its variable has causality output"),
        ([component("a", "gain.fmu", connectors(connector("z", "input")))], "component 'a' has no variable 'z'"),
        (['<ssd:System name="s"><ssd:Elements>' * 60 + "</ssd:Elements></ssd:System>" * 60], "nested more than 50 deep"),
    ],
)  # fmt: skip
def test_what_an_element_may_not_be(gains, items, message):
    with pytest.raises(FmuError) as refusal:
        load_system(gains("", elements(*items)))
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_units_have_to_fit_unless_conversion_is_suppressed(made, tmp_path):
    files = {"lag.fmu": made("Lag"), "gain.fmu": made("Gain")}
    parts = elements(component("lag", "lag.fmu"), component("gain", "gain.fmu"))
    port = connectors(connector("speed", "input", "rad/s"))
    wire = connection("speed", "lag.u")
    with pytest.raises(UnitError, match=r"speed -> lag.u: 'rad/s' cannot be converted to 'N.m'"):
        load_system(write_ssp(tmp_path / "a.ssp", port + parts + connections(wire), files))
    wire = connection("speed", "lag.u", linear(2, 0), suppressUnitConversion="true")
    model = load_system(write_ssp(tmp_path / "b.ssp", port + parts + connections(wire), files))
    y = model.simulate(Task(TIME, {"speed": 1.5 + 0 * TIME}, ("lag.y",)), {"lag.d": 1.0, "lag.x_start": 3.0})
    np.testing.assert_allclose(y, 6.0, rtol=1e-6)


def test_files_that_are_no_ssp(tmp_path, gains):
    (tmp_path / "text.ssp").write_text("no archive")
    with pytest.raises(FmuError, match=r"text.ssp: cannot be extracted \(File is not a zip file\)"):
        load_system(tmp_path / "text.ssp")
    with pytest.raises(FmuError, match=r"missing.ssp: cannot be read"):
        load_system(tmp_path / "missing.ssp")
    with zipfile.ZipFile(tmp_path / "empty.ssp", "w") as archive:
        archive.writestr("folder/SystemStructure.ssd", "")
    with pytest.raises(
        FmuError,
        match=r"empty.ssp: has no SystemStructure.ssd; it may not be an SSP file, or its content may be packed in a subfolder",
    ):
        load_system(tmp_path / "empty.ssp")
    with zipfile.ZipFile(tmp_path / "broken.ssp", "w") as archive:
        archive.writestr("SystemStructure.ssd", "<ssd:System>")
    with pytest.raises(FmuError, match=r"SystemStructure.ssd is not XML \(unbound prefix"):
        load_system(tmp_path / "broken.ssp")
    with pytest.raises(FmuError, match=r"has version 'Draft20170606', not SSP 1.0 or 2.0"):
        load_system(gains(AB, version="Draft20170606"))


@pytest.mark.parametrize("name", ["../evil.txt", "/evil.txt", "resources/../../evil.txt", "c:/evil.txt"])
def test_an_archive_that_climbs_out_is_refused(gains, tmp_path, name):
    path = gains(AB)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(zipfile.ZipInfo(name), "evil")
    with pytest.raises(FmuError, match=r"which points outside the archive"):
        load_system(path)
    assert not (tmp_path.parent / "evil.txt").exists()


def test_entities_do_not_expand_without_end(gains, tmp_path):
    laughs = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12))
    with zipfile.ZipFile(tmp_path / "laughs.ssp", "w") as archive:
        archive.writestr("SystemStructure.ssd", f'<!DOCTYPE x [<!ENTITY a0 "ha">{laughs}]><x>&a11;</x>')
    with pytest.raises(FmuError, match=r"SystemStructure.ssd is not XML"):
        load_system(tmp_path / "laughs.ssp")


def test_extracted_files_are_removed(gains, tmp_path, monkeypatch):
    import gc

    from fmuid.simulation.coupled import loading

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    path = gains(AB)
    model = load_system(path)
    model.simulate(Task(TIME, {}, ("b.y",)), {})
    assert list(tmp_path.glob("fmuid-*/*"))
    loading._models.clear()
    del model
    gc.collect()
    assert not list(tmp_path.glob("fmuid-*/*"))


def test_a_campaign_is_started_and_a_model_compared_from_an_ssp(made, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parts = elements(component("lag", "lag.fmu"), component("gain", "gain.fmu"))
    wires = connections(connection("push", "gain.u"), connection("gain.y", "lag.u"))
    ports = connectors(connector("push", "input", "N.m"))
    write_ssp(tmp_path / "lag.ssp", ports + parts + wires, {"lag.fmu": made("Lag"), "gain.fmu": made("Gain")})
    rows = [f"{t:g},{np.sin(5 * t):g}" for t in np.arange(0, 1, 0.01)]
    (tmp_path / "push.csv").write_text("\n".join(['"time","push [N.m]"', *rows]))
    assert run(["simulate", "lag.ssp", "--input", "push.csv", "--out", "run.csv", "--output", "lag.x"]) == 0
    assert run(["init", "run.csv", "--fmu", "lag.ssp", "--out", "campaign"]) == 0
    assert run(["check", "campaign"]) == 0
    (tmp_path / "references").mkdir()
    shutil.copy("run.csv", "references")
    assert run(["compare", "lag.ssp", "references"]) == 0
