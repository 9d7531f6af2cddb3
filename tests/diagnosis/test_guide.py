"""The guide's own example: an effect added to an FMU by data alone, found on the command line."""

import json
import re
import shutil
from contextlib import nullcontext
from importlib.resources import files
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import fmuid
from fmuid import Result
from fmuid.cli.app import run
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.data.measurements import write_measurements
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.simulator import Task

SCHEMA = json.loads((files("fmuid.diagnosis") / "diagnosis.schema.json").read_text())
GUIDE = Path(__file__).parents[2] / "docs" / "diagnosis.md"
TIME = 5e-3 * np.arange(400)
INPUTS = {
    "sine": 1.5 * np.sin(2 * np.pi * TIME),
    "steps": np.repeat([1.5, -2.0, 2.5, -1.0], 100),
    "slow": 2.5 * np.sin(np.pi * TIME) ** 3,
}


@pytest.fixture(scope="module")
def trolley(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The guide's files, and the FMU it builds from them."""
    folder = tmp_path_factory.mktemp("trolley")
    for name, text in re.findall(r"<!-- file: (\S+) -->\n```\w+\n(.*?)```", GUIDE.read_text(), re.DOTALL):
        (folder / name).write_text(text)
    assert run(["build", str(folder / "Trolley.mo"), "Trolley", "--out", str(folder), "--quiet"]) == 0
    return folder


def record(folder: Path, repeats: int = 5, seed: int = 1, **truth: float) -> None:
    """Write runs of a trolley with `truth` and noise."""
    rng = np.random.default_rng(seed)
    fmu, runs = load_fmu(folder / "Trolley.fmu"), {}
    for name, u in INPUTS.items():
        (v,) = fmu.simulate(Task(TIME, {"u": u}, ("v",)), {"m": 1.0, "d": 0.8, **truth})
        for k in range(repeats):
            measured = v + 5e-3 * rng.standard_normal(len(v)) + 1e-3 * rng.standard_normal()
            signals = {"u": Signal("u", u, "N", "input"), "v": Signal("v", measured, "m/s", "output")}
            id_ = f"{name}_r{k}" if k else name
            runs[id_] = Experiment(id_, "bench", TIME, signals, repeat_of=name if k else None)
    write_measurements(Measurements(runs), folder / "measurements.h5")


def test_an_effect_of_one_s_own_is_found(trolley, tmp_path, capsys):
    record(trolley, drag=0.3)
    out = tmp_path / "diagnosis"
    assert run(["diagnose", str(trolley), "--out", str(out), "--workers", "0"]) == 0
    output = capsys.readouterr().out
    assert re.search(
        r"Verdict: Air drag is missing at friction \(9\d %\)\nIn words: friction grows with the square of speed\n",
        output,
    )
    assert "closure (held out)" in output
    answer = json.loads((out / "diagnosis.json").read_text())
    verdict = answer["verdict"]
    assert (verdict["kind"], verdict["effects"], verdict["port"]) == ("effect", ["air_drag"], "friction")
    assert verdict["text"].startswith("Air drag is missing at friction")
    jsonschema.Draft202012Validator(SCHEMA).validate(answer)
    assert answer["model"]["parameters"] == pytest.approx({"m": 1.0, "d": 0.8, "drag": 0.3}, rel=0.03)
    page = (out / "index.html").read_text()
    assert "air_drag" in page
    assert {"before-after", "missing", "excess-energy", "gap"} <= {p.stem for p in (out / "figures").iterdir()}

    # From the verdict to action: identify goes on from the corrected model, and nothing more is missing in it.
    corrected = out / "corrected"
    assert {p.name for p in corrected.iterdir()} == {"Trolley.fmu", "campaign.toml", "parameters.ssv"}
    assert f"next: fmuid diagnose {corrected}" in output
    assert load_fmu(corrected / "Trolley.fmu").variables["drag"].start == pytest.approx(0.3, rel=0.03)
    folder = tmp_path / "found"
    assert run(["identify", str(corrected), "--out", str(folder), "--no-report", "--quiet", "--workers", "0"]) == 0
    assert Result.from_json(folder)["drag"].value == pytest.approx(0.3, rel=0.03)
    again = tmp_path / "again"
    assert run(["diagnose", str(folder), "--out", str(again), "--workers", "0", "--quiet"]) == 0
    second = json.loads((again / "diagnosis.json").read_text())
    assert second["verdict"]["kind"] == "complete"
    assert second["nominal"]["parameters"]["drag"] == pytest.approx(0.3, rel=0.03)
    assert not (again / "corrected").exists()
    assert run(["diagnose", str(corrected), "--out", str(out), "--quiet"]) == 2
    assert "is the campaign's folder" in capsys.readouterr().err

    # On other data: the corrected and the nominal model.
    other = tmp_path / "other"
    shutil.copytree(trolley, other)
    record(other, seed=2, drag=0.3)
    capsys.readouterr()
    others = ["--measurements", str(other / "measurements.h5")]
    assert run(["validate", str(out / "diagnosis.json"), *others, "--json", str(tmp_path / "m.json")]) == 0
    validated = json.loads((tmp_path / "m.json").read_text())
    low, high = validated["closure_interval"]
    assert 0.5 < low < high <= 1.0

    # The same recordings as logs, in another unit.
    log_files = []
    for run_id in (recorded := fmuid.read_measurements(others[1])).experiments:
        log_files += ["--measurements", str(tmp_path / f"{run_id}.csv")]
        u, v = (recorded[run_id].signals[name].values for name in ("u", "v"))
        np.savetxt(
            log_files[-1],
            np.stack([TIME, u, 1e3 * v], axis=1),
            header="time,u,v [mm/s]",
            delimiter=",",
            comments="",
        )
    assert run(["validate", str(out), *log_files, "--json", str(tmp_path / "logs.json")]) == 0
    from_logs = json.loads((tmp_path / "logs.json").read_text())["gaps"]
    assert from_logs["all"] == pytest.approx(validated["gaps"]["all"], rel=1e-3)
    damaged = tmp_path / "damaged.csv"
    damaged.write_text("time [s],v [m/s]\n0,1\n1,2\n")
    capsys.readouterr()
    assert run(["validate", str(out), "--measurements", str(damaged)]) == 2
    assert "damaged.csv: has no input 'u'" in capsys.readouterr().err
    capsys.readouterr()
    assert run(["validate", str(out / "diagnosis.json"), str(other), "--json", str(tmp_path / "v.json")]) == 0
    gaps = json.loads((tmp_path / "v.json").read_text())["gaps"]
    output = capsys.readouterr().out
    assert "corrected: with air_drag" in output
    assert "not used for the diagnosis: sine, sine_r1" in output
    assert gaps["all"]["nominal"] > 0.5
    assert gaps["all"]["corrected"] < 0.25
    assert gaps["all"]["closure"] > 0.7

    # On the data of the diagnosis: only if they are named, and with a note.
    assert run(["validate", str(out / "diagnosis.json"), str(trolley), "--json", str(tmp_path / "v.json")]) == 2
    message = capsys.readouterr().err
    assert "every run was used for the diagnosis; record other runs" in message
    assert message.count("\n") == 1
    assert run(["validate", str(out / "diagnosis.json"), str(trolley), "-e", "slow"]) == 0
    assert "used for the diagnosis, so not a test of it: slow\n" in capsys.readouterr().out


def test_validation_runs_and_their_repeats_stay_out_of_a_diagnosis(trolley, tmp_path, capsys):
    shutil.copytree(trolley, tmp_path, dirs_exist_ok=True)
    text = (tmp_path / "campaign.toml").read_text()
    record(tmp_path)
    (tmp_path / "campaign.toml").write_text(f'[roles]\nvalidation = ["slow"]\n{text}')
    file = tmp_path / "diagnosis" / "diagnosis.json"
    assert run(["diagnose", str(tmp_path), "--out", str(file.parent), "--workers", "0", "--quiet"]) == 0
    answer = json.loads(file.read_text())
    jsonschema.Draft202012Validator(SCHEMA).validate(answer)
    ids = {recording["id"] for recording in answer["experiments"]}
    assert ids == {f"{name}{k}" for name in ("sine", "steps") for k in ("", "_r1", "_r2", "_r3", "_r4")}

    validated = tmp_path / "v.json"
    assert run(["validate", str(file), str(tmp_path), "--json", str(validated)]) == 0
    validation = json.loads(validated.read_text())
    assert {run.partition("_")[0] for run in validation["runs"]} == {"slow"}
    assert validation["used_for_the_diagnosis"] == []
    capsys.readouterr()

    # A diagnosis of an earlier version did not say what it was made from.
    del answer["experiments"]
    file.write_text(json.dumps(answer))
    assert run(["validate", str(file), str(tmp_path)]) == 0
    assert "does not record its runs" in capsys.readouterr().out
    (tmp_path / "campaign.toml").write_text(text)
    assert run(["validate", str(file), str(tmp_path)]) == 2
    assert "does not say which runs it was made from; diagnose again" in capsys.readouterr().err

    (tmp_path / "campaign.toml").write_text(
        f'[roles]\nvalidation = ["slow"]\n{text}'.replace("[effects]", '[effects]\nexperiments = ["slow"]')
    )
    assert run(["diagnose", str(tmp_path), "--workers", "0"]) == 2
    assert "[effects] experiments: 'slow' is kept for validation" in capsys.readouterr().err


def test_experiments_named_bring_their_repeats_and_quiet_is_quiet(trolley, tmp_path, capsys):
    record(trolley)
    arguments = ["diagnose", str(trolley), "--out", str(tmp_path), "--workers", "0", "-e", "s*", "--quiet"]
    assert run([*arguments, "--json", str(tmp_path / "answer.json")]) == 0
    assert capsys.readouterr().out == ""
    answer = json.loads((tmp_path / "answer.json").read_text())
    assert answer["gap"]["calibrated"] is True
    assert answer["verdict"]["kind"] == "complete"


HELD = "start = {}\nlower = -1\nupper = 500\nfree = false\n"


@pytest.mark.parametrize(
    ("name", "mapped", "more"),
    [
        ("drag", "", ""),
        pytest.param("c_w", 'map = { c_w = "drag" }\n', "", marks=pytest.mark.slow),
        ("drag", "", 'unit = "N.s2/cm2"\n'),
    ],
    ids=["same name", "another name", "another unit"],
)
def test_a_parameter_held_at_its_neutral_value_does_not_hide_an_effect(trolley, tmp_path, name, mapped, more):
    shutil.copytree(trolley, tmp_path, dirs_exist_ok=True)
    record(tmp_path, drag=0.3)
    text = (tmp_path / "campaign.toml").read_text().replace("[models.bench]\n", f"[models.bench]\n{mapped}")
    (tmp_path / "campaign.toml").write_text(f"{text}\n[parameters.{name}]\n{HELD.format(0.0)}{more}")
    file = tmp_path / "answer.json"
    assert run(["diagnose", str(tmp_path), "--out", str(tmp_path), "--workers", "0", "--json", str(file)]) == 0
    answer = json.loads(file.read_text())
    assert answer["verdict"]["effects"] == ["air_drag"]
    assert answer["model"]["parameters"]["drag"] == pytest.approx(0.3, rel=0.03)


def test_an_effect_that_the_campaign_puts_into_the_model_is_no_candidate_and_that_is_said(trolley, tmp_path):
    shutil.copytree(trolley, tmp_path, dirs_exist_ok=True)
    record(tmp_path, drag=0.3, pull=0.1)
    with (tmp_path / "campaign.toml").open("a") as campaign:
        campaign.write(f'\n[parameters.drag]\n{HELD.format(3e-5)}unit = "N.s2/cm2"\n')
    file = tmp_path / "answer.json"
    assert run(["diagnose", str(tmp_path), "--out", str(tmp_path), "--workers", "0", "--json", str(file)]) == 0
    answer = json.loads(file.read_text())
    assert answer["verdict"]["effects"] == ["cable"]
    assert "air_drag" not in {e["id"] for e in answer["effects"]}
    note = "Not looked for, because the campaign has it in the model: air_drag (drag = 0.3)."
    assert note in answer["notes"]


@pytest.mark.parametrize("free", ["false", "true"])
def test_a_sensor_of_the_criteria_has_its_parameter_whether_it_is_free_or_not(trolley, tmp_path, free):
    folder = tmp_path / "campaign"
    shutil.copytree(trolley, folder)
    record(folder, drag=0.3)
    held = f"[parameters.bias]\nstart = 0.0\nlower = -1.0\nupper = 1.0\nfree = {free}\n[effects]"
    nominal = ', "bias"]' if free == "true" else "]"
    text = (folder / "campaign.toml").read_text().replace("[effects]", held).replace('"d"]', '"d"' + nominal)
    text += '[[stages.all.criteria]]\nsignal = "v"\noptions = { sensor = { offset = "bias" } }\n'
    (folder / "campaign.toml").write_text(text)
    answer = fmuid.diagnose(folder).diagnosis
    assert answer.verdict.effects == ("air_drag",)
    assert ("bias" in answer.model) == (free == "true")


def test_noise_that_was_not_measured_is_said(trolley, tmp_path, capsys):
    record(trolley, repeats=1, drag=0.9)
    assert run(["diagnose", str(trolley), "--out", str(tmp_path), "--workers", "0"]) == 0
    output = capsys.readouterr().out
    assert "Note: Runs were not repeated" in output
    assert "Air drag" in output.splitlines()[0]
    assert "Not calibrated" in (tmp_path / "index.html").read_text()


@pytest.mark.slow
def test_calibrating_on_plants_of_one_s_own_is_kept_and_used(trolley, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    record(trolley, drag=0.3)
    file = tmp_path / "out" / "diagnosis.json"
    arguments = ["diagnose", str(trolley), "--out", str(file.parent), "--workers", "0"]
    probability = []
    for further in (["--rehearse", "2"], []):
        assert run([*arguments, *further]) == 0
        answer = json.loads(file.read_text())
        assert answer["verdict"]["effects"] == ["air_drag"]
        output = capsys.readouterr().out
        assert "2 simulated plants of this model, noise and set-up" in output
        assert ("simulated plants with logs like yours diagnosed right" in output) == bool(further)
        assert len(answer.get("rehearsal", [])) == (2 if further else 0)
        probability.append({e["id"]: e["probability"] for e in answer["effects"]})
    (kept,) = (tmp_path / "cache" / "fmuid").glob("calibration-*.json")
    assert json.loads(kept.read_text())["trials"] == 2
    assert probability[0] == probability[1]
    kept.unlink()
    assert run(arguments) == 0
    assert "of random rigs, the default" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ('[effects]\ncatalogue = "nowhere.toml"\n', "nowhere.toml"),
        ('[effects]\ncatalogue = "effects.toml"\nnominal = ["m", "D"]\n', "unknown parameter 'D'"),
        ('[effects]\ncatalogue = "effects.toml"\ntie = { "drg" = "d" }\n', "no FMU has 'drg'"),
    ],
)
def test_a_mistake_in_the_table_is_one_line(trolley, tmp_path, capsys, table, message):
    record(trolley)
    shutil.copytree(trolley, tmp_path, dirs_exist_ok=True)
    text = (tmp_path / "campaign.toml").read_text()
    (tmp_path / "campaign.toml").write_text(text[: text.index("[effects]")] + table)
    assert run(["diagnose", str(tmp_path), "--workers", "0"]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1


VALID = {
    "format": "fmuid-diagnosis",
    "version": 1,
    "verdict": {"kind": "effect", "effects": ["air_drag"]},
    "nominal": {"parameters": {"m": 1.0}},
    "model": {"parameters": {"m": 1.0, "drag": 0.1}},
    "experiments": [],
}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"format": "other"}, "is not a diagnosis"),
        ({"verdict": None}, "no verdict"),
        ({"experiments": ["slow"]}, "'experiments' has no hashes"),
        ({"nominal": {}}, "no parameter values in 'nominal'"),
        ({"model": {"parameters": {"m": "1"}}}, "no parameter values in 'model'"),
        ({"law_found": {"formula": "1 N * p", "model": {"parameters": {}}}}, "'law_found' has no effect"),
        ({"law_found": {"formula": "1 N * p", "id": "a", "effect": {}}}, "no parameter values in 'law_found'"),
        ({"model": {"parameters": {"gear.mesh_eta1": 0.9}}}, "trolley: neither the campaign"),
    ],
)
def test_a_diagnosis_that_is_none_or_of_another_model_is_refused_in_one_line(
    trolley, tmp_path, capsys, changed, message
):
    record(trolley)
    (tmp_path / "d.json").write_text(json.dumps(VALID | changed))
    assert run(["validate", str(tmp_path / "d.json"), str(trolley), "--workers", "0"]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1


def test_an_interrupted_diagnosis_goes_on_and_is_never_replaced(trolley, tmp_path, capsys, monkeypatch):
    def interrupted(*_arguments, **_options):
        raise KeyboardInterrupt

    record(trolley, drag=0.3)
    command = ["diagnose", str(trolley), "--out", str(tmp_path / "out"), "--workers", "0"]
    with monkeypatch.context() as stopping:
        stopping.setattr("fmuid.report.write_diagnosis_report", interrupted)
        assert run(command) == 130
    assert f"continue with: fmuid {' '.join(command[:4])} --resume\n" in capsys.readouterr().out
    before = (tmp_path / "out" / "diagnosis.json").read_text()
    assert (tmp_path / "out" / "diagnosis.journal").exists()
    assert run(command) == 2
    assert "contains an interrupted run; continue with --resume" in capsys.readouterr().err

    # Nothing is simulated a second time.
    monkeypatch.setattr("fmuid.diagnosis_pipeline.runner_on", lambda *_a, **_o: nullcontext(interrupted))
    assert run([*command, "--resume"]) == 0
    assert not (tmp_path / "out" / "diagnosis.journal").exists()
    assert (tmp_path / "out" / "diagnosis.json").read_text() == before
    assert (tmp_path / "out" / "corrected" / "campaign.toml").exists()
    assert run([*command, "--resume"]) == 2
    assert "the run is complete; leave out --resume" in capsys.readouterr().err
