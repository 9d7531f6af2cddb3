"""`fmuid init`: a campaign from recorded runs and an FMU, and what it guesses."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.cli.app import run
from fmuid.core.experiments import Measurements
from fmuid.data.crosscheck_csv import Table, write_csv
from fmuid.identification.result import Result
from fmuid.identification.validate import validate
from fmuid.init.first_choice import independent_columns
from fmuid.init.known_values import is_drawn
from fmuid.init.new_campaign import match_columns
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.simulator import Task, Variable
from tests.known_rigs.logs import Recording, write_logs
from tests.known_rigs.rehearsal_rigs import REHEARSED_ON
from tests.known_rigs.shaker import SHAKER
from tests.simulation.fmus import FAULTS, make_oscillator

Command = Callable[..., tuple[int, str, str]]
WINDING = """\
model Winding "A motor whose current answers to the voltage at once"
  parameter Real R(unit = "Ohm", min = 1e-3) = 1 "Resistance";
  parameter Real k(unit = "N.m/A") = 0.1 "Torque constant";
  parameter Real J(unit = "kg.m2") = 1e-3 "Inertia";
  parameter Real d(unit = "N.m.s/rad") = 0 "Friction";
  parameter Real spare = 3 "Moves nothing";
  input Real u(unit = "V");
  output Real i(unit = "A") = (u - k*w)/R;
  output Real w(unit = "rad/s", start = 0, fixed = true);
equation
  J*der(w) = k*i - d*w;
end Winding;
"""


def test_init_makes_a_campaign_that_runs(
    folder: Path, oscillator: Path, measurements: Measurements, fmuid: Command
) -> None:
    for recorded_run in measurements:
        columns = {
            "U": recorded_run.inputs["u"].values,
            "position_lvdt": recorded_run.signals["position"].values,
            "oil": 20 + recorded_run.time,
        }
        write_csv(
            Table(recorded_run.time, columns, {"position_lvdt": "mm", "oil": "degC"}), f"{recorded_run.id}.csv"
        )
    code, out, err = fmuid("init", "step.csv", "sine.csv", "pulse.csv", "--fmu", oscillator, "--out", "drive")
    assert (code, err) == (0, "")
    assert "step.csv and 2 more: 'U' is input 'u', taken to be in N, as the FMU's" in out
    assert "step.csv and 2 more: 'position_lvdt' is output 'x', in mm" in out
    assert "step.csv and 2 more: columns that nothing uses: oil (no input or output of the model matches" in out
    assert sorted(p.name for p in Path("drive").iterdir()) == [
        "campaign.toml",
        "measurements.h5",
    ]
    campaign = load_campaign("drive")
    assert campaign.title == oscillator.stem
    assert set(campaign.parameters) == {"m", "d", "c"}  # `spare` and `gain` move no measured output
    assert '# [parameters."spare"]' in Path("drive/campaign.toml").read_text()
    assert (campaign.identification, campaign.validation) == (("step", "sine"), ("pulse",))
    assert fmuid("identify", "drive", "--out", "found", "--no-report", "--quiet")[0] == 0
    parameters = Result.from_json("found").parameters
    assert parameters == pytest.approx({"m": 1.2, "d": 0.8, "c": 90.0}, rel=0.02)
    score = validate(Result.from_json("found"), campaign)["pulse", "position_lvdt"]
    assert score.unit == "mm"  # as in the log; the model has m
    spread = np.std(campaign.measurements["pulse"].signals["position_lvdt"].values)
    assert score.rmse == pytest.approx(score.nrmse * spread)
    assert fmuid("init", "step.csv", "--fmu", oscillator, "--out", "drive")[2] == (
        "fmuid: drive/campaign.toml: already exists; choose another folder with --out\n"
    )


def test_init_without_a_fitting_column(folder: Path, oscillator: Path, fmuid: Command) -> None:
    Path("run.csv").write_text("time,a,b\n0,1,2\n1,2,3\n")
    assert fmuid("init", "run.csv", "--fmu", oscillator, "--out", "drive") == (
        2, "", "fmuid: run.csv: no column matches an output of Oscillator.fmu by name or unit; choose columns (--columns 'x [m]=COLUMN,...') or state their units (--unit); known: x [m], y [V]\n"
    )  # fmt: skip
    assert not Path("drive").exists()


@pytest.fixture(scope="module")
def winding(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("winding")
    (folder / "Winding.mo").write_text(WINDING)
    assert run(["build", str(folder / "Winding.mo"), "Winding", "--out", str(folder), "--quiet"]) == 0
    return folder / "Winding.fmu"


def recorded(u: np.ndarray, time: np.ndarray, *, at_once: bool) -> dict[str, np.ndarray]:
    """Return a winding with R = 1.2, J = 1.2e-3, its voltage held; `at_once`: sampled with what it does to the current."""
    w, rate = np.zeros_like(time), 0.1**2 / 1.2 / 1.2e-3
    for k, h in enumerate(np.diff(time)):
        w[k + 1] = u[k] / 0.1 + (w[k] - u[k] / 0.1) * np.exp(-rate * h)
    acts = u if at_once else np.r_[u[0], u[:-1]]
    return {"t": time, "u": u, "i": (acts - 0.1 * w) / 1.2, "speed": w * 60 / (2 * np.pi)}


@pytest.mark.parametrize(("at_once", "timing"), [(True, "held-read-after"), (False, "held")])
def test_init_sees_when_the_inputs_act(
    at_once: bool, timing: str, winding: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fmuid: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    time = np.arange(0, 2, 0.005)
    savemat("run.mat", recorded(5 * np.sin((3 + 8 * time) * time), time, at_once=at_once))
    code, out, err = fmuid(
        "init", "run.mat", "--fmu", winding, "--unit", "speed=rpm", "--sigma", "speed=0.5", "--sigma", "i=0.01"
    )
    assert (code, err) == (0, "")
    assert "run.mat: 'speed' is output 'w', in rpm" in out
    lines = out.splitlines()
    if at_once:
        assert any("outputs are read just after they act; held inputs explain the runs" in s for s in lines)
    else:
        assert "inputs are held between their samples" in lines
    assert load_campaign("campaign").models["Winding"].timing == timing
    signals = load_campaign("campaign").measurements["run"].signals
    assert (signals["speed"].sigma, signals["i"].sigma) == (0.5, 0.01)


def loudspeaker(u: np.ndarray, step: float, *, linear: bool, fine: int = 10) -> np.ndarray:
    """Current and excursion of a cone on a suspension that hardens; the voltage is held, or linear, between samples."""

    def slope(x: np.ndarray, voltage: float) -> np.ndarray:
        i, s, v = x
        force = 6.6 * i - 2350 * s * (1 + (s / 6e-3) ** 2) - 1.35 * v
        return np.array([(voltage - 5.6 * i - 6.6 * v) / 0.55e-3, v, force / 0.0215])

    x, rows, h = np.zeros(3), [np.zeros(3)], step / fine
    for before, after in pairwise(u):
        for k in range(fine):
            middle = before + (after - before) * (k + 0.5) / fine if linear else before
            a = slope(x, middle)
            b = slope(x + h / 2 * a, middle)
            c = slope(x + h / 2 * b, middle)
            x = x + h / 6 * (a + 2 * b + 2 * c + slope(x + h * c, middle))
        rows.append(x)
    return np.array(rows)[:, :2]


@pytest.mark.parametrize("linear", [True, False], ids=["linear", "held"])
def test_init_sees_it_through_parameters_that_are_off_and_a_law_that_is_missing(
    linear: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fmuid: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    model = Path(__file__).parents[1] / "fmu_build" / "models" / "Written.mo"
    step, random = 2e-4, np.random.default_rng(3)
    time = np.arange(2000) * step
    for name, tones in {"low": (17, 41, 73), "high": (55, 130, 260), "last": (30, 90, 170)}.items():
        u = sum(4 * np.sin(2 * np.pi * f * time + f) for f in tones)
        seen = loudspeaker(u, step, linear=linear) + random.normal(scale=(0.01, 2e-5), size=(time.size, 2))
        rows = np.column_stack([time, u, seen])
        np.savetxt(f"{name}.csv", rows, delimiter=",", comments="", header="time [s],u [V],i [A],x [m]")
    code, _, _ = fmuid(
        "init",
        "low.csv",
        "high.csv",
        "last.csv",
        "--model",
        model,
        "--class",
        "Written.Loudspeaker",
        "--workers",
        "0",
    )
    assert code == 0
    (spec,) = load_campaign("campaign").models.values()
    assert spec.timing == ("linear" if linear else "held")


@pytest.mark.parametrize(
    ("model", "factors", "missing"),
    [
        pytest.param("BeltAxis", {"motor.k": 0.82}, {}, id="an axis that drifts away from its plant"),
        pytest.param(
            "ThermalBlock",
            {"air.G": 1.054, "body.C": 1.19, "casing.C": 0.855, "wall.G": 0.892},
            {"capacity@body": 219.0, "capacity@body.shape": 1757.0},
            id="a store that reacts late, as if the heat acted earlier",
        ),
    ],
)
def test_init_does_not_take_what_is_wrong_with_a_model_for_linear_inputs(
    model: str, factors: dict[str, float], missing: dict[str, float], tmp_path: Path, fmuid: Command
) -> None:
    """Both plants hold their inputs. Linear ones fit better after a short search, and in the second case even after a long one."""
    (rig,) = (r for r in REHEARSED_ON if r.model == model)
    logs = write_logs(rig, factors, missing, tmp_path, Recording(1), np.random.default_rng(3))
    code, _, _ = fmuid(
        "init", *logs, "--model", rig.file, "--class", model, "--out", tmp_path / "out", "--workers", "0"
    )
    assert code == 0
    assert load_campaign(tmp_path / "out").models[model].timing == "held"


def test_init_says_what_it_holds_and_why(
    winding: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fmuid: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    time = np.arange(0, 2, 0.005)
    savemat("run.mat", {n: v for n, v in recorded(5 * np.sin(4 * time), time, at_once=False).items() if n != "i"})
    _, out, _ = fmuid("init", "run.mat", "--fmu", winding, "--unit", "speed=rpm")
    fixed = [line.removeprefix("fixed: ").removesuffix(")") for line in out.splitlines() if "fixed: " in line]
    by_reason = dict(line.split(" (", 1)[::-1] for line in fixed)
    free = next(line for line in out.splitlines() if line.startswith("free")).removeprefix("free parameters: ")
    # The speed is k u / (J R s + k^2): R and J are known as a product only.
    assert len(free.split(", ")) == 2
    redundant = by_reason.pop("redundant with the free parameters; if you know one of those, fix it instead")
    assert set(free.split(", ")) | {redundant} == {"R", "k", "J"}
    assert by_reason == {
        "does not affect any measured output": "spare",
        "starts at 0, so no bounds can be guessed": "d",
    }
    text = Path("campaign/campaign.toml").read_text()
    assert '# [parameters."d"] # Friction\n# start = 0.0\n# unit = "N.m.s/rad"\n\n' in text
    assert text.index("# Fixed: does not affect any measured output.") < text.index('# [parameters."spare"]')


def test_a_scale_that_all_parameters_share_is_held_although_the_model_resonates(
    folder: Path, fmuid: Command
) -> None:
    factors = dict.fromkeys(SHAKER.parameters, 1.0)
    logs = write_logs(SHAKER, factors, {}, folder, Recording(1), np.random.default_rng(0))
    code, _, _ = fmuid("init", *logs, "--model", SHAKER.file, "--class", "Shaker", "--workers", "0")
    assert code == 0
    free = set(load_campaign("campaign").parameters)
    # Forces, masses and stiffnesses twice as large do the same; the damping of the mount matters least.
    assert free == {"coil.k", "table.m", "specimen.m", "suspension.c", "suspension.d", "mount.c"}


def write_square_wave(file: str) -> None:
    time = np.linspace(0.0, 2.0, 201)
    signals = recorded(np.sign(np.sin(5 * time)), time, at_once=False)
    write_csv(Table(time, {n: signals[n] for n in ("u", "i")}, {}), file)


def test_a_model_may_use_a_library_in_another_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fmuid: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("libraries/Motors").mkdir(parents=True)
    Path("libraries/Motors/package.mo").write_text(
        f'package Motors\n{WINDING}annotation(version = "1.2"); end Motors;\n'
    )
    Path("Drive.mo").write_text("model Drive\n  extends Motors.Winding;\nend Drive;\n")
    write_square_wave("run.csv")

    lacking = "'Motors' is in no library; give its directory with --root (roots= in Python), or as `roots` of the model in campaign.toml"
    code, _, err = fmuid("init", "run.csv", "--model", "Drive.mo", "--workers", "0")
    assert (code, lacking in err) == (2, True), err
    model = ("--model", "Drive.mo", "--root", "libraries")
    assert fmuid("init", "run.csv", *model, "--workers", "0")[0] == 0
    written = Path("campaign/campaign.toml").read_text()
    assert 'roots = ["../libraries"]' in written
    assert 'libraries = { "Motors" = "1.2" }' in written
    assert fmuid("identify", "campaign", "--no-report", "--workers", "0")[0] == 0

    _, ports, _ = fmuid("effects", "Drive.mo", "--root", "libraries")
    assert "value" in ports
    code, _, err = fmuid("effects", "campaign", "--root", "libraries")
    assert (code, err) == (
        2,
        "fmuid: --root: the libraries of a campaign are in its campaign.toml; write them in campaign.toml, as `roots` of a model\n",
    )
    code, _, err = fmuid("init", "run.csv", "--fmu", "Drive.fmu", "--root", "libraries")
    assert (code, err) == (
        2,
        "fmuid: Drive.fmu: folders of libraries without a Modelica model; give the Modelica file (.mo) in its place\n",
    )


def test_a_campaign_records_the_versions_of_libraries_that_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fmuid: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MODELICAPATH", str(tmp_path / "libraries"))
    package = Path("libraries/Motors/package.mo")
    package.parent.mkdir(parents=True)
    package.write_text(f'package Motors\n{WINDING}annotation(version = "1.2.0"); end Motors;\n')
    Path("Drive.mo").write_text("model Drive\n  extends Motors.Winding;\nend Drive;\n")
    write_square_wave("run.csv")
    code, _, err = fmuid("init", "run.csv", "--model", "Drive.mo", "--workers", "0")
    assert (code, err) == (0, "")
    assert 'libraries = { "Motors" = "1.2.0" }' in Path("campaign/campaign.toml").read_text()

    package.write_text(package.read_text().replace("1.2.0", "1.3.0"))
    with pytest.warns(
        UserWarning, match=r"Drive\.mo: the campaign was made with Motors 1\.2\.0, but 1\.3\.0 is used"
    ):
        assert fmuid("check", "campaign", "--workers", "0")[0] == 0


def test_a_model_may_be_in_a_package_that_is_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fmuid: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("Motors").mkdir()
    Path("Motors/package.mo").write_text(f"package Motors\n{WINDING}end Motors;\n")
    _, in_folder, _ = fmuid("effects", "Motors", "Motors.Winding")
    assert in_folder == fmuid("effects", "Motors/package.mo", "Motors.Winding")[1] != ""
    code, _, err = fmuid("effects", "Motors")
    assert (code, err) == (2, "fmuid: package.mo:1: 'Motors' is a package, not a model\n")

    write_square_wave("run.csv")
    assert fmuid("init", "run.csv", "--model", "Motors", "--class", "Motors.Winding", "--workers", "0")[0] == 0
    assert 'source = "../Motors/package.mo"' in Path("campaign/campaign.toml").read_text()


@pytest.mark.parametrize("option", ["--unit", "--sigma"])
def test_init_knows_the_signals_that_options_name(
    option: str, winding: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fmuid: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("run.csv").write_text("time,u,w\n0,1,2\n1,2,3\n")
    given = fmuid("init", "run.csv", "--fmu", winding, option, "W=1")
    assert given == (2, "", f"fmuid: {option}: no signal 'W' is used; did you mean 'w'?\n")
    assert not Path("campaign").exists()


def test_init_takes_model_exchange_where_the_solver_inside_is_coarse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fmuid: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    both = ("CoSimulation", "ModelExchange")
    fine, coarse = make_oscillator(tmp_path, 2, both), make_oscillator(tmp_path, 2, both, ("COARSE",))
    time = np.arange(0, 2, 0.02)
    u = 5 * np.sin(4 * time)
    y = load_fmu(coarse, "model exchange").simulate(Task(time, {"u": u}, ("y",)), {"c": 90.0, "d": 0.8})[0]
    write_csv(Table(time, {"u": u, "y": y}, {"u": "N"}), "run.csv")
    assert fmuid("init", "run.csv", "--fmu", fine, "--out", "fine")[0] == 0
    assert load_campaign("fine").models[fine.stem].interface is None
    _, out, _ = fmuid("init", "run.csv", "--fmu", coarse, "--out", "drive")
    assert re.search(
        r"^model exchange: the solver inside .* is off by \d\S* % of an output's range$", out, re.MULTILINE
    )
    campaign = Path("drive/campaign.toml")
    for text, error in (
        (campaign.read_text(), 1e-3),
        (campaign.read_text().replace("model exch", "co-simul"), None),
    ):
        campaign.write_text(text.replace("co-simulange", "co-simulation"))
        assert fmuid("identify", "drive", "--out", "found", "--no-report", "--quiet")[0] == 0
        parameters = Result.from_json("found").parameters
        ratio = parameters["c"] / parameters.get("m", 1.0) / 90
        assert abs(ratio - 1) < error if error else abs(ratio - 1) > 5e-3


@pytest.mark.parametrize("truth", ["none", pytest.param("gain@position", marks=pytest.mark.slow), "delay@u"])
def test_what_is_wrong_with_a_signal_is_found_from_log_files_alone(
    truth: str, oscillator: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fmuid: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(5)
    time = np.linspace(0.0, 1.0, 201)
    plant = load_fmu(oscillator)
    for name, u in (("step", 5.0 * (time > 0.2)), ("chirp", 5 * np.sin((4 + 12 * time) * time))):
        acts = np.r_[[u[0]] * 3, u[:-3]] if truth == "delay@u" else u
        m = 1.0 if truth == "gain@position" else 1.02
        x = plant.simulate(Task(time, {"u": acts}, ("x",)), {"m": m, "d": 0.6, "c": 98.0})[0]
        for k in range(5):
            position = 1e3 * x * (1.1 if truth == "gain@position" else 1.0) + rng.normal(0, 0.2, time.size)
            write_csv(Table(time, {"u": u, "position": position}, {"u": "N", "position": "mm"}), f"{name}_{k}.csv")
    files = sorted(tmp_path.glob("*.csv"))
    assert fmuid("init", *files, "--fmu", oscillator, "--unit", "position=mm")[0] == 0
    if truth == "gain@position":  # which no other value of a known mass, stiffness or damping can do
        campaign = Path("campaign/campaign.toml")
        mass = '[parameters."m"] # mass\nstart = 1.0\n'
        known = campaign.read_text().replace(mass, f"{mass}free = false\nknown = true\n")
        campaign.write_text(known)
    code, out, err = fmuid("diagnose", "campaign", "--out", "found", "--workers", "0")
    assert (code, err) == (0, "")
    answer = json.loads(Path("found/diagnosis.json").read_text())
    if truth == "none":
        assert answer["verdict"]["kind"] == "complete", out
        assert {"gain@position", "delay@u"} <= set(answer["power"])
        return
    # Of a linear model with one output, no data tell an input that is late, or too small, from an output that is.
    verdict = answer["verdict"]
    named = [*verdict["effects"], *(name for one in verdict["one_of"] for name in one)]
    same = {name for group in answer["equal"] if [named[0]] in group for (name,) in group}
    assert truth in {named[0], *same}, out
    assert set(named) <= {truth, *same, "delay@position"}, out
    (effect,) = [e for e in answer["effects"] if e["id"] == named[0]]
    (estimate,) = effect["parameters"].values()
    assert estimate["value"] == pytest.approx({"gain@position": 1.1, "delay@u": 0.015}[truth], rel=0.03)


@pytest.mark.parametrize(
    ("fault", "limit", "message"),
    [
        pytest.param(
            "hang", ("--time-limit", "5"), "took longer than the time limit of 5 s", marks=pytest.mark.slow
        ),
        ("devours", ("--memory-limit", "200"), "took more memory than the limit of 200 MB"),
    ],
)
def test_a_diagnosis_holds_its_workers_to_the_limits(
    fault: str,
    limit: tuple[str, str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    fmuid: Command,
) -> None:
    monkeypatch.chdir(tmp_path)
    time = np.linspace(0.0, 1.0, 101)
    for k in range(3):
        y = np.sin(7 * time) + np.random.default_rng(k).normal(0, 0.01, time.size)
        write_csv(Table(time, {"u": np.sin(9 * time), "y": y}, {"u": "N"}), f"run_{k}.csv")
    assert fmuid("init", *sorted(tmp_path.glob("*.csv")), "--fmu", make_oscillator(tmp_path, 2))[0] == 0
    campaign = Path("campaign/campaign.toml")
    campaign.write_text(f"{campaign.read_text()}\n[settings]\nfault = {FAULTS[fault]}\n")
    code, _, err = fmuid("diagnose", "campaign", "--workers", "1", *limit)
    assert code == 2
    assert message in err


def test_what_a_drawing_tells_is_fixed_where_it_is_redundant():
    radius, mass, friction = np.eye(3)
    columns = {"radius": 9 * (mass + friction), "mass": mass, "friction": friction}
    assert independent_columns(columns, last={"radius"}) == ["mass", "friction"]
    assert independent_columns(columns)[0] == "radius"
    assert independent_columns(columns | {"radius": radius}, last={"radius"}) == ["mass", "friction", "radius"]
    many = {f"p{k}": column for k, column in enumerate(np.eye(12))}
    assert len(independent_columns(many)) == 12


def test_a_drawing_tells_dimensions_and_ratios_but_not_losses():
    def tells(name, unit=None):
        return is_drawn(Variable(name, "parameter", unit=unit, start=1.0))

    assert [tells("gear.ratio"), tells("pipe.d", "mm"), tells("tank.A", "m2")] == [True] * 3
    assert [tells("gear.lossTable[1,2]"), tells("load.J", "kg.m2"), tells("damper.d", "N.m.s/rad")] == [False] * 3


def test_a_unit_that_two_columns_have_does_not_say_which_one_is_meant():
    ports = {"level": Variable("level", "output", unit="m")}
    time = np.arange(3.0)
    one = Table(time, {"height": time}, {"height": "m"})
    two = Table(time, {"height": time, "depth": time}, {"height": "m", "depth": "m"})
    assert match_columns(one, ports) == {"height": "level"}
    assert match_columns(two, ports) == {}
