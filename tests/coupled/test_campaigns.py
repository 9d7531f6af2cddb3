"""Campaigns whose model is coupled FMUs: everything works on them as on one FMU."""

from __future__ import annotations

import os
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path

import fmpy
import numpy as np
import pytest
from lxml import etree
from systems import BUILT, DRIVES, component, connection, connections, elements, write_ssp

from fmuid import diagnose, identify, load_campaign, validate
from fmuid.cli.app import run
from fmuid.core.campaign import ModelSource
from fmuid.core.coupling import Master
from fmuid.core.errors import FmuidError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.data.measurements import write_measurements
from fmuid.diagnosis.variants import carrier
from fmuid.identification.check import check_effects, load_models, match_models
from fmuid.identification.identified_models import write_identified
from fmuid.simulation.coupled.loading import load_system
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.model_source import flat_model
from fmuid.simulation.simulator import Task
from tests.every_law import every_law

TIME = np.linspace(0, 1, 101)
TRUTH = {"mgr": 21.0, "kp": 0.026, "ki": 0.52}
NOISE = {"w": 0.02, "tau": 0.02}

CAMPAIGN = """
[campaign]
name = "split"

[models.bench]
{model}
map = {{ w_ref = "controller.w_ref", w = "plant.w_motor", tau = "plant.tau_sensor", mgr = "plant.mgr", kp = "controller.kp", ki = "controller.ki" }}
initial = {{ "plant.w_motor_start" = 1.0 }}
interpolation = "linear"

[parameters.mgr]
start = 25
lower = 5
upper = 60
unit = "N.m"

[parameters.kp]
start = 0.02
lower = 0.005
upper = 0.1
scale = "log"

[parameters.ki]
start = 0.4
lower = 0.1
upper = 2
free = false

[settings]
"plant.J_L" = 0.45

[roles]
validation = ["slow"]

[stages.all]
free = ["mgr", "kp"]
tie = {{ ki = "20*kp" }}
"""
TABLE = """
fmus = {{ plant = "{plant}", controller = "{controller}" }}
connections = {{ "plant.i" = "controller.i", controller.w = {{ from = "plant.w_motor", factor = 1.0 }} }}
step = {step}
algorithm = "gauss_seidel"
extrapolation = "{extrapolation}"
"""


def write_campaign(
    folder: Path, drive: Mapping[str, Path], model: str, starts: tuple[float, float] = (1.0, 1.0)
) -> Path:
    """Write a campaign with runs of the single FMU at the truth, each from its own speed."""
    rng = np.random.default_rng(3)
    whole = load_fmu(drive["whole"])
    runs = {}
    for name, frequency, start in (("fast", 1.0, starts[0]), ("slow", 0.5, starts[1])):
        reference = 30 * np.sin(2 * np.pi * frequency * TIME)
        task = Task(
            TIME, {"w_ref": reference}, ("w_motor", "tau_sensor"), {"J_L": 0.45, "w_motor_start": start}, "linear"
        )
        predicted = whole.simulate(task, TRUTH)
        signals = {"w_ref": Signal("w_ref", reference, "rad/s", "input")}
        for key, unit, y in zip(("w", "tau"), ("rad/s", "N.m"), predicted, strict=True):
            signals[key] = Signal(key, y + rng.normal(0, NOISE[key], 101), unit, "output", NOISE[key])
        runs[name] = Experiment(name, "bench", TIME, signals)
    write_measurements(Measurements(runs), folder / "measurements.h5")
    (folder / "campaign.toml").write_text(CAMPAIGN.format(model=model))
    return folder


@pytest.fixture(scope="module", params=["table", "ssp"])
def campaign_folder(request, drive, tmp_path_factory):
    folder = tmp_path_factory.mktemp("campaign")
    if request.param == "table":
        files = {n: os.path.relpath(p, folder) for n, p in drive.items()}
        return write_campaign(folder, drive, TABLE.format(step=1e-3, extrapolation="linear", **files))
    parts = elements(component("plant", "plant.fmu"), component("controller", "controller.fmu"))
    wires = connections(connection("controller.i", "plant.i"), connection("plant.w_motor", "controller.w"))
    write_ssp(folder / "drive.ssp", parts + wires, {f"{n}.fmu": drive[n] for n in ("plant", "controller")})
    return write_campaign(folder, drive, 'fmu = "drive.ssp"\nstep = 1e-3\nextrapolation = "linear"')


def test_a_campaign_with_coupled_fmus_recovers_the_truth(campaign_folder, tmp_path):
    campaign = load_campaign(campaign_folder)
    assert load_models(campaign)["bench"].differentiates({"plant.mgr", "controller.kp"})
    result = identify(campaign, out=tmp_path / "run", workers=1)
    for name in ("mgr", "kp"):
        error = result[name].standard_error
        assert abs(result.parameters[name] - TRUTH[name]) < 4 * error + 1e-3 * TRUTH[name], name
    scores = validate(result, campaign)
    assert scores["slow", "w"].rmse == pytest.approx(NOISE["w"], rel=0.2)


def test_every_run_may_start_from_a_speed_of_its_own(drive, tmp_path):
    files = {n: os.path.relpath(p, tmp_path) for n, p in drive.items()}
    write_campaign(tmp_path, drive, TABLE.format(step=1e-3, extrapolation="linear", **files), (2.0, -3.0))
    text = (tmp_path / "campaign.toml").read_text()
    text = text.replace('initial = { "plant.w_motor_start" = 1.0 }\n', "").replace(
        "map = { ", 'map = { w_start = "plant.w_motor_start", '
    )
    text = text.replace('validation = ["slow"]', "").replace(
        'free = ["mgr", "kp"]', 'free = ["mgr", "kp", "w_start"]'
    )
    text += '[parameters.w_start]\nstart = 0\nlower = -10\nupper = 10\nunit = "rad/s"\nper = "experiment"\n'
    (tmp_path / "campaign.toml").write_text(text)
    stage = identify(tmp_path).stages[0]
    for name, value in {"w_start@fast": 2.0, "w_start@slow": -3.0, "mgr": 21.0, "kp": 0.026}.items():
        error = stage[name].standard_error
        assert abs(stage[name].value - value) < 4 * error + 1e-3 * abs(value), name
    assert stage["w_start@fast"].standard_error < 0.1


def test_check_finds_what_is_wrong_and_what_moves(campaign_folder, capsys):
    campaign = load_campaign(campaign_folder)
    models = load_models(campaign)
    assert match_models(campaign, models) == ()
    _, effects = check_effects(campaign, models)
    assert {e.parameter for e in effects} == {"mgr", "kp"}
    assert run(["check", str(campaign_folder)]) == 0
    assert (
        run(["simulate", str(campaign_folder), "--set", "mgr=21", "--out", str(campaign_folder / "simulated")])
        == 0
    )


def test_check_warns_of_a_communication_step_that_is_too_long(drive, tmp_path):
    for step, warned in ((1e-2, True), (2e-4, False)):
        files = {n: os.path.relpath(p, tmp_path) for n, p in drive.items()}
        write_campaign(tmp_path, drive, TABLE.format(step=step, extrapolation="linear", **files))
        campaign = load_campaign(tmp_path)
        findings, _ = check_effects(campaign, load_models(campaign))
        warnings = [str(f) for f in findings if "halving the communication step changes 'fast: " in f.what]
        assert bool(warnings) == warned, findings


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ('fmu = "a.fmu"\nfmus = { a = "a.fmu" }', "[models.bench]: names both 'fmu' and 'fmus'"),
        ("", "[models.bench]: has no 'fmu'"),
        ('fmu = "a.fmu"\nstep = 1e-3', "'step' applies to coupled FMUs only; leave it out for one FMU"),
        ('fmu = "a.ssp"\nconnections = { "a.u" = "b.y" }', "has connections but only one FMU; name several FMUs in 'fmus'"),
        ('fmus = { "a.b" = "a.fmu" }', "fmus: 'a.b' is not a valid name; use a name without dots"),
        ('fmu = "a.ssp"\nstep = 0', "'step' is 0; write a positive number"),
        ('fmu = "a.ssp"\nalgorithm = "jacobian"', "'algorithm' is 'jacobian'; did you mean 'jacobi'?"),
        ('fmu = "a.ssp"\nextrapolation = { a = "cubic" }', "'extrapolation' is 'cubic'; known: constant, linear"),
        ('fmu = "a.ssp"\nloops = "iterated"', "'loops' is 'iterated'; did you mean 'iterate'?"),
        ('fmu = "a.fmu"\nmain = "a"', "'main' applies to coupled FMUs only"),
        ('fmus = { plant = "PLANT" }\nmain = "plnt"', "[models.bench]: the main component 'plnt' does not exist; did you mean 'plant'?"),
        ('fmu = "a.ssp"\nloop_iterations = 0', "'loop_iterations' is 0; write a positive number"),
        ('fmus = { a = "a.fmu" }\nconnections = { "a.u" = 1 }', "connections: 'a.u' is not an output"),
        ('fmus = { a = "a.fmu" }\nconnections = { "a.u" = { from = "b.y", gain = 1 } }', "unknown key 'gain'"),
        ('fmus = { a = "none.fmu" }', "none.fmu: no such file; build it"),
        ('fmus = { plant = "PLANT" }\nconnections = { "plant.i" = "controller.i" }', "[models.bench]: no component 'controller' for 'controller.i'; known: plant"),
        ('fmus = { plant = "PLANT" }\nconnections = { "i" = "plant.w_motor" }', "'i' is not a variable of a component; write it as component.variable"),
        ('fmus = { plant = "PLANT" }\nconnections = { "plant.i" = "plant.w_moto" }', "component 'plant' has no variable 'w_moto'; did you mean 'w_motor'?"),
        ('fmus = { plant = "PLANT" }\nconnections = { "plant.i" = "plant.mgr" }', "plant.mgr -> plant.i: 'plant.mgr' is a parameter, not an output"),
        ('fmus = { plant = "PLANT" }\nconnections = { "plant.i" = "plant.w_motor" }', "plant.w_motor -> plant.i: 'rad/s' cannot be converted to 'A'"),
        ('fmus = { plant = "PLANT" }\nextrapolation = { plnt = "linear" }', "no component 'plnt'; did you mean 'plant'?"),
    ],
)  # fmt: skip
def test_a_wrong_table_is_one_clear_line(drive, tmp_path, model, message):
    model = model.replace("PLANT", os.path.relpath(drive["plant"], tmp_path))
    folder = write_campaign(tmp_path, drive, model.replace("{", "{{").replace("}", "}}").format())
    with pytest.raises(FmuidError) as refusal:
        load_models(load_campaign(folder))
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_what_was_identified_is_written_back_as_an_ssp(campaign_folder, tmp_path):
    """With the parameters, settings and initial values as a set that outranks all others."""
    campaign = load_campaign(campaign_folder)
    result = identify(campaign, out=tmp_path / "run", workers=0)
    written = write_identified(result, campaign, tmp_path / "identified")
    copy = load_system(written.fmus["bench"], Master(1e-3, extrapolation="linear"))
    parameters = result.parameters
    expected = {
        "plant.mgr": parameters["mgr"],
        "controller.kp": parameters["kp"],
        "controller.ki": parameters["ki"],
        "plant.J_L": 0.45,
    }
    assert {n: copy.variables[n].start for n in expected} == pytest.approx(expected, rel=1e-15)
    task = Task(TIME, {}, ("plant.w_motor", "plant.tau_sensor"))
    (model,) = load_models(campaign).values()
    same = model.simulate(task, expected | {"plant.w_motor_start": 1.0})
    assert np.array_equal(copy.simulate(task, {}), same)
    schemas = Path(fmpy.__file__).parent / "ssp" / "schema"
    with zipfile.ZipFile(written.fmus["bench"]) as archive:
        description = etree.fromstring(archive.read("SystemStructure.ssd"))
    etree.XMLSchema(etree.parse(schemas / "SystemStructureDescription.xsd")).assertValid(description)


CATALOGUE = """
format = "fmuid-effects"
version = 1
[models]
EccentricLoadPlant = "EccentricLoadPlantWithLaws"

[ports.motor]
input = "motor.added_flow"
magnitude = 0.01
unit = "N.m"

[effects.viscous]
description = "friction of the motor's bearing"
source = "lubricant"
port = "motor"
trials = [{ "motor.viscous" = 1e-3 }]
[effects.viscous.parameters]
"motor.viscous" = { neutral = 0, lower = 0, upper = 0.05, step = 1e-5, unit = "N.m.s/rad" }

[effects.imbalance]
description = "another mass away from the axis"
source = "construction"
port = "motor"
two_sided = true
trials = [{ "load.imbalance_cosine" = 1.0 }]
[effects.imbalance.parameters]
"load.imbalance_cosine" = { neutral = 0, lower = -20, upper = 20, step = 0.01, unit = "N.m" }
"""
DIAGNOSED = """
map = { w_ref = "controller.w_ref", w = "w_motor", tau = "tau_sensor" }
interpolation = "linear"

[parameters.mgr]
start = 25
lower = 5
upper = 60

[effects]
catalogue = "effects.toml"
nominal = ["mgr"]
"""


def write_diagnosed(folder: Path, rig: Path, truth: Mapping[str, float]) -> Path:
    """Write repeated runs of the single FMU with a law, for the split one with a catalogue of two."""
    rng = np.random.default_rng(5)
    runs = {}
    for name, frequency in (("fast", 1.0), ("slow", 0.5), ("medium", 0.7)):
        reference = 30 * np.sin(2 * np.pi * frequency * TIME)
        task = Task(TIME, {"w_ref": reference}, ("w_motor", "tau_sensor"), {"mgr": 22.0}, "linear")
        predicted = load_fmu(rig).simulate(task, truth)
        for repeat in range(3):
            signals = {"w_ref": Signal("w_ref", reference, "rad/s", "input")}
            for key, unit, y in zip(("w", "tau"), ("rad/s", "N.m"), predicted, strict=True):
                signals[key] = Signal(key, y + rng.normal(0, NOISE[key], 101), unit, "output", NOISE[key])
            id = f"{name}{repeat}"
            runs[id] = Experiment(id, "bench", TIME, signals, repeat_of=f"{name}0" if repeat else None)
    write_measurements(Measurements(runs), folder / "measurements.h5")
    (folder / "effects.toml").write_text(CATALOGUE)
    source = ModelSource(DRIVES / "Setups" / "EccentricLoadPlant.mo", "Drives.Setups.EccentricLoadPlant")
    (folder / "laws").mkdir()
    with_laws = carrier(source, every_law(flat_model(source), folder / "laws"))
    shutil.copy(with_laws, folder / "EccentricLoadPlantWithLaws.fmu")
    shutil.copy(BUILT / "EccentricLoadPlant.fmu", folder)
    table = TABLE.format(
        step=1e-3,
        extrapolation="linear",
        plant=folder / "EccentricLoadPlant.fmu",
        controller=BUILT / "SpeedController.fmu",
    )
    (folder / "campaign.toml").write_text(
        f'[campaign]\nname = "split"\n[models.bench]\n{table}\nmain = "plant"\n{DIAGNOSED}'
    )
    return folder


@pytest.mark.slow
def test_a_coupled_model_is_diagnosed(drive, effect_fmus, tmp_path, monkeypatch):
    """The plant's counterpart with laws takes its place; the law of the rig is named and measured."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    diagnosed = diagnose(
        write_diagnosed(tmp_path, effect_fmus["EccentricLoad"], {"motor.viscous": 2e-3}), workers=0
    )
    answer = diagnosed.diagnosis.to_dict()
    assert answer["verdict"]["effects"] == ["viscous"]
    assert answer["effects"][0]["parameters"]["motor.viscous"]["value"] == pytest.approx(2e-3, rel=0.02)
    assert answer["model"]["parameters"]["mgr"] == pytest.approx(22.0, rel=0.01)
