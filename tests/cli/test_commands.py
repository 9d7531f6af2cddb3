"""The other commands: what they print and write, and how they end."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time as clock
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.io import savemat

from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.cli import completion
from fmuid.core.experiments import Measurements
from fmuid.core.folder_lock import claim
from fmuid.data.crosscheck_csv import Table, read_csv, write_csv
from fmuid.data.measurements import read_measurements
from fmuid.data.recordings.conversion import table_from_experiment
from fmuid.identification.result import Result

Command = Callable[..., tuple[int, str, str]]
COMMANDS = [
    "init",
    "build",
    "check",
    "simulate",
    "identify",
    "validate",
    "effects",
    "diagnose",
    "sensitivity",
    "study",
    "design",
    "compare",
    "import",
    "export",
    "report",
]
FMUID = [sys.executable, "-c", "from fmuid.cli import main; main()"]


# ---- the program itself


def test_code_in_a_campaign_needs_the_word_of_the_user(
    folder: Path, fmuid: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(folder))
    (folder / "own_criteria.py").write_text(
        "from pathlib import Path\nPath('was_run').touch()\ndef f(t, p, m): return (p - m) / 1e-4\n"
    )
    text = (folder / "campaign.toml").read_text()
    criterion = '{ signal = "position", kind = "user", options = { function = "own_criteria:f" } }'
    (folder / "campaign.toml").write_text(text.replace("[stages.all]", f"[stages.all]\ncriteria = [{criterion}]"))
    for command in ("check", "identify"):
        code, _, err = fmuid(command, "bench")
        assert (code, err.count("\n")) == (2, 1)
        assert "calls 'own_criteria:f', code that the campaign chose" in err
    for command in ("simulate", "export"):  # they call nothing
        assert (
            fmuid(command, "bench" if command == "simulate" else "bench/measurements.h5", "--out", "out")[0] == 0
        )
    assert not Path("was_run").exists()
    assert fmuid("identify", "bench", "--trust", "--out", "run", "--no-report", "--workers", "0")[0] == 0
    assert Path("was_run").exists()
    assert Result.from_json("run").parameters["m"] == pytest.approx(1.2, rel=5e-3)
    assert fmuid("report", "run")[0] == 2
    assert load_campaign("bench", trust=True).trusted


@pytest.mark.parametrize("after", [0.05, 0.1, 0.2, 0.4, 0.8, 1.6])
def test_ctrl_c_while_modules_are_loaded_is_one_line(folder: Path, after: float) -> None:
    script = "import sys; from fmuid.cli import main; print(flush=True); main()"
    run = subprocess.Popen(
        [sys.executable, "-c", script, "check", "bench"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert run.stdout is not None
    run.stdout.readline()
    clock.sleep(after)
    run.send_signal(signal.SIGINT)
    _, err = run.communicate(timeout=600)
    assert (run.returncode, err) == (130, "fmuid: interrupted\n") or run.returncode == 0


@pytest.mark.parametrize("context", ["raise RuntimeError from error", "raise RuntimeError", "raise error"])
def test_an_error_that_an_interruption_causes_is_one(context: str) -> None:
    # As Python raises one where a class is being made, and `threading` where a thread is being started.
    script = f"""
import signal
from fmuid.cli import main, app
def run():
    try: signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt as error: {context}
app.run = run
main()
"""
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (130, "fmuid: interrupted\n")


def test_ctrl_c_when_everything_is_done_changes_nothing() -> None:
    script = """
import atexit, signal
from fmuid.cli import main, app
def run():
    atexit.register(signal.raise_signal, signal.SIGINT)
    return 3
app.run = run
main()
"""
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (3, "")


def test_other_errors_are_shown_whole() -> None:
    script = "from fmuid.cli import main, app; app.run = lambda: 1 / 0; main()"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert "ZeroDivisionError" in run.stderr


def test_what_would_crash_while_python_is_taken_down_does_not_after_ctrl_c(folder: Path) -> None:
    # As extension modules do of which an interruption has left half.
    script = """
import os, signal, sys
from fmuid.cli import main, app
class HalfLoaded:
    def __del__(self, crash=os.abort): crash()
half_loaded = HalfLoaded()
app.run = lambda: signal.raise_signal(signal.SIGINT)
main()
"""
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (130, "fmuid: interrupted\n")


@pytest.mark.parametrize(
    ("within", "went_on"),
    [
        # Code of the import system holds locks; an exception there would leave them held.
        ("exec(compile('kill(); went_on.append(1)', '<frozen importlib._bootstrap>', 'exec'))", [1]),
        # What a finalizer raises is ignored.
        ("class A: pass\na = A()\nref = weakref.ref(a, lambda _: [kill(), went_on.append(1)])\ndel a", []),
    ],
)
def test_ctrl_c_is_not_lost_where_nothing_can_be_raised(within: str, went_on: list[int]) -> None:
    script = f"""
import functools, os, signal, time, weakref
from fmuid.cli.interruption import Interruption
Interruption()
went_on, kill = [], functools.partial(os.kill, os.getpid(), signal.SIGINT)
try:
    exec({within!r})
    time.sleep(60)
except KeyboardInterrupt:
    print("interrupted", went_on)
"""
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=600)
    assert (run.stdout, run.stderr) == (f"interrupted {went_on}\n", "")


@pytest.mark.parametrize("call", ["fmuid.identify('bench', workers=2)", "fmuid.diagnose('made', workers=2)"])
def test_a_script_without_a_main_guard_is_told_in_one_line(
    folder: Path, oscillator: Path, fmuid: Command, call: str
) -> None:
    """Each worker imports the script; none of them does its work again or prints a traceback of its own."""
    Path("run.csv").write_text(
        "time,u,x\n" + "".join(f"{k / 100},{k % 20 // 10},{k % 7 / 1e4}\n" for k in range(101))
    )
    assert fmuid("init", "run.csv", "--fmu", oscillator, "--out", "made")[0] == 0
    Path("script.py").write_text(f"import fmuid\n{call}\n")
    done = subprocess.run([sys.executable, "script.py"], capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) < 100  # of this script alone
    assert done.stderr.splitlines()[-1] == (
        "fmuid.core.errors.FmuidError: worker pool: worker processes do not start; "
        'save the script in a file, with its work under `if __name__ == "__main__":`'
    )


def test_output_that_cannot_be_written_is_one_line(folder: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*FMUID, "check", "bench"], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    message = "fmuid: the output: cannot be read or written (No space left on device)\n"
    assert (done.returncode, done.stderr) == (2, message)


@pytest.mark.parametrize("closed", ["1", "12", "012"])
def test_standard_streams_may_be_closed(folder: Path, closed: str) -> None:
    def close() -> None:
        for descriptor in closed:
            os.close(int(descriptor))

    done = subprocess.run([*FMUID, "check", "bench", "--json", "found.json"], preexec_fn=close, check=False)
    assert done.returncode == 0
    assert json.loads(Path("found.json").read_text())  # and nothing that was printed is in it


def test_help_lists_the_commands_without_loading_a_library() -> None:
    script = "import sys, fmuid.cli.app; print(*sorted(m for m in ('numpy', 'h5py', 'fmpy', 'pint', 'casadi', 'scipy', 'matplotlib') if m in sys.modules))"
    loaded = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=600
    )
    assert loaded.stdout.strip() == ""
    shown = subprocess.run([*FMUID, "--help"], capture_output=True, text=True, check=True, timeout=600)
    for name in COMMANDS:
        assert name in shown.stdout


@pytest.mark.parametrize(("typed", "completed"), [("fmuid ide", "identify"), ("fmuid identify --st", "--stage")])
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion(shell: str, typed: str, completed: str) -> None:
    typed_so_far = {"COMP_WORDS": typed, "COMP_CWORD": str(typed.count(" ")), "_TYPER_COMPLETE_ARGS": typed}
    asked = {"_FMUID_COMPLETE": f"complete_{shell}", "_TYPER_COMPLETE_FISH_ACTION": "get-args"}
    program = Path(sys.executable).with_name("fmuid")
    shown = subprocess.run(
        [program], env=os.environ | typed_so_far | asked, capture_output=True, text=True, check=True, timeout=600
    )
    assert completed in shown.stdout


def test_colours_and_progress_on_a_terminal_only(folder: Path) -> None:
    shown = subprocess.run([*FMUID, "check", "bench"], capture_output=True, text=True, timeout=600)
    assert shown.returncode == 0
    assert "\x1b" not in shown.stdout + shown.stderr
    on_terminal = "import pty, sys; sys.exit(pty.spawn(sys.argv[1:]) >> 8)"
    seen = subprocess.run(
        [sys.executable, "-c", on_terminal, *FMUID, "check", "bench"],
        env=os.environ | {"TERM": "xterm-256color"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert "varying the parameters one by one" in seen.stdout


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_out_json_and_quiet(name: str, fmuid: Command) -> None:
    code, out, err = fmuid(name, "--help")
    assert (code, err) == (0, "")
    assert f"Example: fmuid {name} " in " ".join(out.split())
    assert "--json" in out
    assert "--quiet" in out
    assert name == "check" or "--out" in out
    assert "``" not in out  # names in square brackets vanish as markup


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["frobnicate"], "No such command 'frobnicate'; see fmuid --help"),
        (["chek", "x"], "No such command 'chek'. Did you mean 'check'?; see fmuid --help"),
        (["check"], "Missing argument 'CAMPAIGN'; see fmuid --help"),
        (["check", "x", "--xyz"], "No such option: --xyz; see fmuid --help"),
        (["build", "A.mo", "A", "--fmi", "2.0"], "Invalid value for '--fmi': '2.0' is not one of '2', '3'; see fmuid --help"),
        (["compare", "a", "b", "--tolerance", "-1"], "Invalid value for '--tolerance': -1.0 is not in the range x>=0.0; see fmuid --help"),
        (["check", "nowhere"], "nowhere: no such file; give a folder with a campaign.toml, or make one with: fmuid init"),
        (["identify", "nowhere"], "nowhere: no such file; give a folder with a campaign.toml, or make one with: fmuid init"),
        (["validate", "nowhere"], "nowhere: no such file; give a folder written by fmuid identify"),
        (["report", "nowhere"], "nowhere: no such file; give a folder written by fmuid identify"),
        (["report", "nowhere", "--format", "gif"], "--format: no format 'gif'; known: png, svg, pdf"),
        (["build", "nowhere.mo", "A.B"], "nowhere.mo: no such Modelica file; check the path, or choose an included package: Drives, Pendulum"),
        (["compare", "a.csv", "b.csv"], "a.csv: no such file; check the path"),
        (["compare", "a.csv", "b.csv", "--funnel-time", "1"], "--funnel-time without --funnel; also give the funnel's half-width: --funnel 0.01"),
        (["simulate", "no.fmu"], "no.fmu: cannot be read (No such file or directory); check the path"),
        (["simulate", "no.fmu", "--set", "d_S"], "--set: 'd_S' is not NAME=VALUE; write it as in --set d_S=2.66"),
        (["simulate", "no.fmu", "--set", "d_S=big"], "no.fmu: cannot be read (No such file or directory); check the path"),
        (["simulate", "no.fmu", "-e", "step"], "--experiment applies to campaigns only; leave it out for an FMU"),
        (["simulate", "bench", "--stop", "1"], "--input, --stop, --step and --output apply to FMUs only; leave them out for a campaign"),
        (["import", "no.csv", "--setup", "a", "--input", "u"], "no.csv: no such file; check the path"),
        (["export", "no.h5"], "no.h5: no such file; check the path"),
        (["init", "no.csv", "--fmu", "no.fmu"], "no.fmu: cannot be read (No such file or directory); check the path"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: list[str], line: str, tmp_path: Path, fmuid: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert fmuid(*arguments) == (2, "", f"fmuid: {line}\n")
    assert list(tmp_path.iterdir()) == []


def test_json_that_cannot_be_written(folder: Path, fmuid: Command) -> None:
    Path("found.json").mkdir()  # which nobody can write as a file, not even a superuser
    code, _, err = fmuid("check", folder, "--no-simulate", "--json", "found.json")
    assert code == 2
    assert err.startswith("fmuid: found.json: cannot be written (")
    assert err.count("\n") == 1


# ---- compare


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    time = np.linspace(0.0, 1.0, 101)
    late = np.linspace(0.0, 1.0, 77)
    write_csv(Table(time, {"x": np.sin(9 * time), "y": 2 + 0 * time}, {}), "reference.csv")
    write_csv(Table(late, {"x": np.sin(9 * late), "y": 2 + 0 * late, "z": late}, {}), "result.csv")
    write_csv(Table(late, {"x": np.sin(9 * np.maximum(late - 0.01, 0)), "y": 2.1 + 0 * late}, {}), "drifted.csv")
    return tmp_path


def test_compare_within(results: Path, fmuid: Command) -> None:
    code, out, err = fmuid("compare", "result.csv", "reference.csv", "--json", "c.json")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0].split() == ["variable", "NRMSE", "max", "error", "at", "s", "outside", "within"]
    assert lines[-1] == "all within NRMSE 0.001"
    answer = json.loads(Path("c.json").read_text())
    assert answer["within"] is True
    (only,) = answer["references"]
    assert [v["name"] for v in only["variables"]] == ["x", "y"]
    assert 0 < only["variables"][0]["nrmse"] < 1e-3


def test_compare_out_of_tolerance(results: Path, fmuid: Command) -> None:
    code, out, err = fmuid("compare", "drifted.csv", "reference.csv", "--out", "table.csv", "--json", "c.json")
    assert (code, err) == (1, "")
    assert out.splitlines()[-1] == "2 of 2 out of tolerance (NRMSE 0.001)"
    assert (
        Path("table.csv").read_text().startswith('"variable","NRMSE","max error","at s","outside","within"\n"x",')
    )
    time = np.linspace(0.0, 1.0, 101)
    x, y = json.loads(Path("c.json").read_text())["references"][0]["variables"]
    expected = np.sqrt(np.mean((np.sin(9 * np.maximum(time - 0.01, 0)) - np.sin(9 * time)) ** 2)) / np.ptp(
        np.sin(9 * time)
    )
    assert x["nrmse"] == pytest.approx(expected, rel=0.02)  # the result is interpolated
    assert y["nrmse"] == pytest.approx(0.05)  # of the constant's own size
    assert y["max_error"] == pytest.approx(0.1)


def test_a_funnel_forgives_a_delay(results: Path, fmuid: Command) -> None:
    arguments = ["compare", "drifted.csv", "reference.csv", "--variable", "x", "--funnel", "0.005"]
    assert fmuid(*arguments)[0] == 1
    code, out, _ = fmuid(*arguments, "--funnel-time", "0.011")
    assert code == 0
    assert out.splitlines()[-1] == "all within funnel 0.005 of the range, 0.011 s"


def test_compare_what_cannot_be_compared(results: Path, fmuid: Command) -> None:
    assert fmuid("compare", "reference.csv", "result.csv") == (
        2, "", "fmuid: reference.csv against result.csv: the result has no variable 'z'; known: x, y\n"
    )  # fmt: skip
    write_csv(Table(np.array([0.0, 0.5]), {"x": np.zeros(2), "y": np.zeros(2)}, {}), "short.csv")
    assert fmuid("compare", "short.csv", "reference.csv")[2] == (
        "fmuid: short.csv against reference.csv: the result covers 0 to 0.5 s, the reference 0 to 1 s; simulate as long as the reference\n"
    )


def test_an_fmu_that_drifts_from_its_references(
    folder: Path, oscillator: Path, measurements: Measurements, fmuid: Command
) -> None:
    Path("references").mkdir()
    for run in (measurements["pulse"], measurements["step"]):
        write_csv(Table(run.time, {"u": run.inputs["u"].values / 1e3}, {"u": "kN"}), "u.csv")
        assert fmuid("simulate", oscillator, "--input", "u.csv", "--out", f"references/{run.id}.csv")[0] == 0
    funnel = ["--funnel", "0.01", "--funnel-time", "0.002"]
    code, out, err = fmuid("compare", oscillator, "references", *funnel)
    assert (code, err) == (0, "")
    assert out.splitlines()[0].split()[:2] == ["reference", "variable"]
    assert out.splitlines()[-1] == "all within funnel 0.01 of the range, 0.002 s"

    # The pulse is over at 0.1 s: a model with more damping leaves its funnel after that, not before.
    code, out, _ = fmuid(
        "compare", oscillator, "references", *funnel, "--set", "d=0.7", "--out", "drift", "--json", "c.json"
    )
    assert code == 1
    pulse = json.loads(Path("c.json").read_text())["references"][0]
    assert (pulse["name"], pulse["within"]) == ("pulse", False)
    x = pulse["variables"][0]
    assert 0.1 < x["spans"][0][0] < x["spans"][0][1] < x["max_error_time"] <= 1.0
    report = Path("drift/report.md").read_text()
    assert f"Outside: {x['spans'][0][0]:g} to {x['spans'][0][1]:g} s" in report
    for name in re.findall(r"\(figures/(.*?)\.png\)", report):
        assert {p.suffix for p in Path("drift/figures").glob(f"{name}.*")} == {".png", ".svg", ".pdf"}
    data = next(Path("drift/data").glob("pulse-x-01*.csv")).read_text()
    assert all(f"\n{line}," in data for line in ("reference", "result", "funnel"))

    write_csv(Table(np.array([0.0, 1.0]), {"u": np.zeros(2), "z": np.zeros(2)}, {}), "other.csv")
    assert fmuid("compare", oscillator, "other.csv")[2] == (
        f"fmuid: {oscillator} against other.csv: the FMU has no variable 'z'; known: m, d, c, gain, spare, mode, u, wind, x, y, v, der(x) and 1 more\n"
    )


# ---- simulate


def test_simulate_an_fmu(folder: Path, oscillator: Path, measurements: Measurements, fmuid: Command) -> None:
    step = measurements["step"]
    write_csv(Table(step.time, {"u": step.inputs["u"].values}, {"u": "N"}), "u.csv")
    arguments = ["--set", "m=1.2", "--set", "d=0.8", "--set", "c=90", "--output", "x"]
    code, out, err = fmuid("simulate", oscillator, "--input", "u.csv", *arguments, "--out", "r.csv")
    assert (code, out, err) == (0, "r.csv: 201 samples of u, x\n", "")
    result = read_csv("r.csv")
    assert result.units == {"u": "N", "x": "m"}
    np.testing.assert_allclose(result.columns["x"], 1e-3 * step.signals["position"].values, atol=6e-4)


def test_simulate_converts_units_of_inputs(folder: Path, oscillator: Path, fmuid: Command) -> None:
    time = np.linspace(0, 1, 11)
    write_csv(Table(time, {"u": np.sin(time)}, {"u": "kN"}), "kilo.csv")
    write_csv(Table(time, {"u": 1e3 * np.sin(time)}, {}), "plain.csv")
    for name in ("kilo", "plain"):
        assert fmuid("simulate", oscillator, "--input", f"{name}.csv", "--out", f"{name}_r.csv")[0] == 0
    np.testing.assert_allclose(
        read_csv("kilo_r.csv").columns["y"], read_csv("plain_r.csv").columns["y"], rtol=1e-12
    )
    write_csv(Table(time, {"u": time}, {"u": "m"}), "metres.csv")
    assert fmuid("simulate", oscillator, "--input", "metres.csv")[2] == (
        "fmuid: metres.csv: 'u': 'm' cannot be converted to 'N'; they measure different things ([length] and [mass] * [length] / [time] ** 2)\n"
    )


def test_simulate_without_input(folder: Path, oscillator: Path, fmuid: Command) -> None:
    code, out, _ = fmuid("simulate", oscillator, "--stop", "0.5", "--step", "0.1", "--output", "x", "--quiet")
    assert (code, out) == (0, "")
    np.testing.assert_allclose(read_csv("Oscillator.csv").time, np.linspace(0, 0.5, 6))
    assert (
        fmuid("simulate", oscillator, "--output", "X")[2]
        == "fmuid: Oscillator.fmu has no variable 'X'; did you mean 'x'?\n"
    )
    assert (
        fmuid("simulate", oscillator, "--stop", "-1")[2]
        == "fmuid: stop time -1 s is not after 0 s; give a later --stop\n"
    )
    assert (
        fmuid("simulate", oscillator, "--step", "0")[2]
        == "fmuid: step 0 s does not fit into 1 s; give another --step\n"
    )


def test_simulate_a_campaign(folder: Path, fmuid: Command) -> None:
    code, _, err = fmuid(
        "simulate", folder, "-e", "s*", "--set", "m=1.2", "--set", "d=0.8", "--out", "sim", "--json", "s.json"
    )
    assert (code, err) == (0, "")
    assert sorted(p.name for p in Path("sim").iterdir()) == ["sine.csv", "step.csv"]
    result = read_csv("sim/step.csv")
    assert result.units["position"] == "m"  # the model's unit
    answer = json.loads(Path("s.json").read_text())
    assert all(row["nrmse"] < 0.01 for row in answer["nrmse"])
    assert fmuid("simulate", folder, "--set", "k=1")[2] == "fmuid: --set: unknown parameter 'k'; known: m, d\n"
    assert (
        fmuid("simulate", folder, "-e", "stp")[2]
        == "fmuid: --experiment: 'stp' is not an experiment; did you mean 'step'?\n"
    )


# ---- import, export


def test_import_and_export(folder: Path, measurements: Measurements, fmuid: Command) -> None:
    for run in measurements:
        write_csv(table_from_experiment(run), f"{run.id}.csv")
    write_csv(table_from_experiment(measurements["step"]), "step_again.csv")
    arguments = [
        "--setup",
        "oscillator",
        "--input",
        "u",
        "--sigma",
        "position=0.1",
        "--setting",
        "gain=2",
        "--repeats",
    ]
    code, out, err = fmuid(
        "import", "step.csv", "sine.csv", "step_again.csv", *arguments, "--out", "m.h5", "--title", "T"
    )
    assert (code, err) == (0, "")
    assert out.splitlines()[-1] == "m.h5: 3 runs"
    read = read_measurements("m.h5")
    assert read.title == "T"
    assert read["step_again"].repeat_of == "step"
    assert (read["step"].setup, read["step"].settings) == ("oscillator", {"gain": 2.0})
    position = read["step"].signals["position"]
    assert (position.unit, position.causality, position.sigma) == ("mm", "output", 0.1)
    np.testing.assert_array_equal(position.values, measurements["step"].signals["position"].values)

    assert fmuid("import", "pulse.csv", *arguments, "--out", "m.h5", "--append")[0] == 0
    assert list(read_measurements("m.h5").experiments) == ["step", "sine", "step_again", "pulse"]
    assert fmuid("export", "m.h5", "--out", "csv", "-e", "pulse")[0] == 0
    assert Path("csv/pulse.csv").read_text() == Path("pulse.csv").read_text()


@pytest.mark.parametrize(
    ("header", "arguments", "line"),
    [
        ("time,u [N],x", [], "run.csv: column 'x' has no unit; write it in the header as \"x [N.m]\", or give --unit x=N.m (1 for none)"),
        ("time,u [N],x [m]", ["--input", "v"], "run.csv: no column 'v' (input); known: u, x"),
        ("time,u [N],x [m]", ["--unit", "y=m"], "run.csv: no column 'y' (unit); known: u, x"),
        ("time [N],u [N],x [m]", [], "run.csv: time is in 'N', which is not a unit of time ('N' cannot be converted to 's'); correct its unit"),
        ("time,u [N],x [Nwt]", [], "run.csv: column 'x': unit 'Nwt' is unknown; write it as in 'N.m' or 'kg.m2/s'"),
        ("time,u [N],x [m]", ["--signal", "u", "--signal", "y"], "run.csv: has no signal 'y'; known: u, x"),
        ("time,u [N],x [m]", ["--resample", "10", "--align", "u"], "--resample and --align are two time bases; leave one out"),
        ("time,u [N],x [m]", ["--resample", "0"], "--resample: rate 0 is none; give samples a second, such as 1000"),
        ("time,u [N],x [m]", ["--resample", "0.1"], "run.csv: 1 s at 0.1 Hz yields 1 sample; give another rate"),
        ("time,u [N],x [m]", ["--resample", "10", "--method", "spline"], "--method: no method 'spline'; known: linear, hold, mean"),
        ("time,u [N],x [m]", ["--method", "hold"], "--method without a time base; also give --resample RATE or --align SIGNAL"),
        ("time,u [N],x [m]", ["--align", "X"], "run.csv: has no signal 'X'; did you mean 'x'?"),
        ("time,u [N],u [m]", [], "run.csv: column 'u' appears twice; rename one of the two"),
        ("time,u [N],", [], "run.csv: column 3 has no name; name every column"),
        ("time;u [N];x [m]", [], "run.csv line 2: has 1 cell, the header has 3; write one cell per column"),
        ("time,u [N]", [], "run.csv line 2: has 3 cells, the header has 2; write one cell per column"),
    ],
)  # fmt: skip
def test_import_refuses(
    header: str, arguments: list[str], line: str, tmp_path: Path, fmuid: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("run.csv").write_text(f"{header}\n0,1,2\n1,2,3\n")
    assert fmuid("import", "run.csv", "--setup", "s", "--input", "u", *arguments) == (2, "", f"fmuid: {line}\n")
    assert not Path("measurements.h5").exists()


@pytest.mark.parametrize(
    ("row", "line"),
    [
        ("1,,3", "measurements.h5: experiment 'run', signal 'u': sample 1 of an input is NaN (1 in total); an input needs every sample: cut the run or fill the gap"),
        ("1,a,3", "run.csv line 3: 'a' in column 'u' is not a number; write a number"),
        ("0,1,3", "run.csv: 2 of 2 rows have the time of another row; write times with more digits, or choose the other columns (--columns) and give --rate"),
        ("-1,1,3", "run.csv: time goes back from 0 s to -1 s in sample 1; sort the rows by time"),
        ('1,"1,3', "run.csv line 3: is not CSV (unexpected end of data); correct the quotes"),
        ("", "run.csv: has 1 row of values; a run has at least 2 samples"),
    ],
)  # fmt: skip
def test_import_refuses_rows(
    row: str, line: str, tmp_path: Path, fmuid: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("run.csv").write_text(f"time,u [N],x [m]\n0,1,2\n{row}\n")
    assert fmuid("import", "run.csv", "--setup", "s", "--input", "u") == (2, "", f"fmuid: {line}\n")
    assert not Path("measurements.h5").exists()


def test_import_other_csv(tmp_path: Path, fmuid: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("run.csv").write_text('\ufefft;tau[N.m];"x y (rad)";\tlossTable[1,2]\n0;1;;3\n\n1;2;5;4\n')
    arguments = ["--setup", "s", "--input", "tau", "--unit", "lossTable[1,2]=1"]
    code, out, err = fmuid("import", "run.csv", *arguments)
    assert (code, err) == (0, "")
    assert out.startswith("run.csv: cells are separated by semicolons\nexperiment")
    run = read_measurements("measurements.h5")["run"]
    assert {n: s.unit for n, s in run.signals.items()} == {"tau": "N.m", "x y": "rad", "lossTable[1,2]": "1"}
    np.testing.assert_array_equal(run.signals["x y"].values, [np.nan, 5.0])
    assert fmuid("import", "run.csv", *arguments)[2] == (
        "fmuid: measurements.h5: already exists; give --append to add to it, or another --out\n"
    )


def test_import_matlab(tmp_path: Path, fmuid: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    time = np.arange(5.0)[:, None]
    savemat("run.mat", {"t": time, "vir": 2 * time, "qm": time**2, "kp": 160.18, "note": "slow"})
    arguments = ["--setup", "axis", "--input", "vir", "--unit", "vir=V"]
    assert fmuid("import", "run.mat", *arguments)[2] == (
        "fmuid: run.mat: column 'qm' has no unit; write it in the header as \"qm [N.m]\", or give --unit qm=N.m (1 for none)\n"
    )
    code, out, err = fmuid("import", "run.mat", *arguments, "--unit", "qm=m")
    assert (code, err) == (0, "")
    assert out.startswith(
        "run.mat: not used (not numeric): note\nrun.mat: not used (not vectors as long as 't'): kp\n"
    )
    run = read_measurements("measurements.h5")["run"]
    np.testing.assert_array_equal(run.signals["qm"].values, np.arange(5.0) ** 2)


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (None, "run.mat: no such file; check the path"),
        (b"no matlab" * 30, "run.mat: is not a readable MATLAB file; save it with: save -v7"),
        ({"x": np.arange(3.0)}, "run.mat: has no column 'time' or 't'; save one, choose one (--columns 'time=NAME,...') or give --rate HZ; known: x"),
        ({"t": np.arange(3.0), "x": 1.0}, "run.mat: has no vector as long as 't' (3); save the signals, N by 1"),
    ],
)  # fmt: skip
def test_import_refuses_matlab(
    content: object, line: str, tmp_path: Path, fmuid: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if isinstance(content, bytes):
        Path("run.mat").write_bytes(content)
    elif content is not None:
        savemat("run.mat", content)
    assert fmuid("import", "run.mat", "--setup", "s", "--input", "u") == (2, "", f"fmuid: {line}\n")


# ---- from start to end


def test_identify_validate_report(folder: Path, fmuid: Command) -> None:
    code, out, err = fmuid("identify", folder, "--out", "run", "--json", "i.json")
    assert (code, "Traceback" in err) == (0, False)
    answer = json.loads(Path("i.json").read_text())
    assert answer["result"]["parameters"]["m"] == pytest.approx(1.2, rel=2e-3)
    assert answer["result"]["parameters"]["d"] == pytest.approx(0.8, rel=2e-2)
    assert [v["experiment"] for v in answer["validation"]] == ["pulse"]
    assert Path("run/report/index.html").is_file()
    assert "pulse" in out

    code, _, err = fmuid("validate", "run", "--out", "csv", "-e", "s*")
    assert (code, err) == (0, "")
    assert sorted(p.name for p in Path("csv").iterdir()) == ["sine.csv", "step.csv"]


def endless(folder: Path) -> None:
    """Have the campaign search for a minute."""
    text = (folder / "campaign.toml").read_text()
    (folder / "campaign.toml").write_text(
        text.replace("[stages.all]", '[stages.all]\nsolver = "isres"').replace(
            "evaluations = 100", "seconds = 3600"
        )
    )


def under_way(out: Path) -> None:
    """Wait until a run has recorded something."""
    deadline, journal = clock.monotonic() + 300, out / "history.journal"
    while not (journal.exists() and journal.stat().st_size > 10_000) and clock.monotonic() < deadline:
        clock.sleep(0.05)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_whatever_stops_a_run_it_ends_with_130_and_says_how_it_goes_on(folder: Path, name: str) -> None:
    endless(folder)
    command = [*FMUID, "identify", "bench", "--out", "run", "--seed", "3"]
    run = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),  # tests may run under nohup
    )
    under_way(Path("run"))
    os.killpg(run.pid, getattr(signal, name))  # batch systems tell every process of a job
    out, err = run.communicate(timeout=600)
    assert run.returncode == 130, err
    assert "Traceback" not in err
    assert "continue with: fmuid identify bench --out run --seed 3 --resume" in out
    assert "fmuid: interrupted" in err
    result = json.loads(Path("run/result.json").read_text())
    assert result["parameters"]["m"] > 0
    assert result["stages"][0]["failures"] == 0  # no worker was taken for one that crashed


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_second_signal_ends_at_once_in_one_line(folder: Path, name: str) -> None:
    endless(folder)
    run = subprocess.Popen([*FMUID, "identify", "bench", "--out", "run"], stderr=subprocess.PIPE, text=True)
    under_way(Path("run"))
    for _ in range(50):
        run.send_signal(getattr(signal, name))
    _, err = run.communicate(timeout=600)
    assert run.returncode == 130, err
    assert err.splitlines()[-1] in ("fmuid: stopped at once", "fmuid: interrupted")
    assert "Traceback" not in err
    assert Result.from_json("run").parameters["m"] > 0
    with claim(Path("run")):  # a lock goes with its process
        pass


STUCK = """
import ctypes
from fmuid.cli.interruption import Interruption

Interruption()
ctypes.CDLL(None).system(b"echo begun; read line")  # compiled code that does not return, as in a simulation
"""


@pytest.mark.parametrize(("signals", "message"), [(1, "did not return within 5 s"), (2, "stopped at once")])
def test_signals_end_a_simulation_that_does_not_return(signals: int, message: str) -> None:
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", STUCK], stdin=pipe, stdout=pipe, stderr=pipe, text=True) as run:
        assert run.stdout is not None
        assert run.stdin is not None
        assert run.stderr is not None
        assert run.stdout.readline() == "begun\n"
        for _ in range(signals):
            run.send_signal(signal.SIGTERM)
            clock.sleep(0.2)
        assert run.wait(600) == 130
        run.stdin.close()  # ends the shell
        assert message in run.stderr.read()


def test_build_finds_the_packages_that_are_shipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fmuid: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    assert fmuid("build", "Pendulum", "Pendulum.Setups.TorqueDriven", "--out", ".") == (
        0,
        "TorqueDriven.fmu\n",
        "",
    )
    Path("Servo.mo").write_text("model Servo\n  extends Pendulum.Setups.TorqueDriven;\nend Servo;\n")
    assert fmuid("build", "Servo.mo", "Servo", "--root", "modelica", "--out", ".") == (0, "Servo.fmu\n", "")


def test_a_shell_completes_solvers_and_stages(folder: Path) -> None:
    context = SimpleNamespace(params={"campaign": str(folder)}, args=[])
    assert completion.stages(context, "a") == ["all"]
    assert completion.stages(SimpleNamespace(params={"campaign": "nowhere"}, args=[]), "") == []
    typed = f"fmuid identify {folder} --stage a"
    asked = {"_FMUID_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": "4"}
    program = Path(sys.executable).with_name("fmuid")
    shown = subprocess.run([program], env=os.environ | asked, capture_output=True, text=True, timeout=600)
    assert shown.stdout.split() == ["all"]
    assert completion.solvers("bob") == ["bobyqa"]
    assert completion.solvers("crs2 > bob") == ["crs2 > bobyqa"]


@pytest.mark.parametrize("command", ["--help", "identify --help", "check nowhere"])
def test_without_colours_nothing_is_bold_or_dim_either(command):
    environment = os.environ | {"FORCE_COLOR": "1", "NO_COLOR": "1", "TERM": "xterm-256color"}
    line = [str(Path(sys.executable).parent / "fmuid"), *command.split()]
    done = subprocess.run(line, env=environment, capture_output=True, text=True)
    assert "\x1b" not in done.stdout + done.stderr


@pytest.mark.parametrize(
    "command", ["identify", "validate", "diagnose", "report", "design", "simulate", "compare"]
)
def test_a_place_for_results_that_cannot_be_written_is_refused_before_anything_else(tmp_path, command):
    (tmp_path / "file").write_text("")
    line = [str(Path(sys.executable).parent / "fmuid"), command, "nowhere", "--out", str(tmp_path / "file" / "x")]
    done = subprocess.run(line, capture_output=True, text=True)
    assert done.returncode == 2
    assert "is not a usable folder" in done.stderr
