"""Wrong inputs of every kind, and the command that meets them. `docs/errors.md` has the line each one gives."""

from __future__ import annotations

import fcntl
import os
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from scipy.io import savemat

from fmuid.core.journal import Journal
from fmuid.identification.history import History, Row, _packed
from fmuid.simulation.recorded import _MAGIC

CAMPAIGN = Path("bench/campaign.toml")
MEASUREMENTS = Path("bench/measurements.h5")
CHECK = "check bench"


@dataclass(frozen=True)
class Case:
    """What is wrong, how it comes about in a folder with a campaign that is right, and who notices."""

    group: str
    what: str
    make: Callable[[], object]
    command: str


def nothing() -> None:
    """The command alone is wrong."""


def toml(old: str, new: str) -> Callable[[], object]:
    def edit() -> None:
        text = CAMPAIGN.read_text()
        assert old in text, old
        CAMPAIGN.write_text(text.replace(old, new))

    return edit


def stage(line: str) -> Callable[[], object]:
    return toml("[stages.all]\n", f"[stages.all]\n{line}\n")


def write(name: str, content: str | bytes) -> Callable[[], object]:
    return lambda: Path(name).write_bytes(content.encode() if isinstance(content, str) else content)


def hdf5(edit: Callable[[h5py.File], object]) -> Callable[[], object]:
    def change() -> None:
        with h5py.File(MEASUREMENTS, "r+") as file:
            edit(file)

    return change


def sample(place: str, index: int, value: float) -> Callable[[], object]:
    return hdf5(lambda file: file[f"experiments/step/{place}"].__setitem__(index, value))


def attribute(place: str, name: str, value: object) -> Callable[[], object]:
    return hdf5(lambda file: file[place].attrs.__setitem__(name, value))


def instead(place: str, **what: object) -> Callable[[], object]:
    def change(file: h5py.File) -> None:
        del file[place]
        if "link" in what:
            file[place] = what["link"]
        else:
            dataset = file.create_dataset(place, **what)
            dataset.attrs.update(unit="mm", causality="output")

    return hdf5(change)


def two_rates() -> None:
    with h5py.File("run.h5", "w") as file:
        for group, rate in (("drive", 1000), ("oil", 10)):
            file[f"{group}/time"] = np.arange(0, 1, 1 / rate)
            file[f"{group}/x"] = np.arange(0, 1, 1 / rate)


def archive(*members: tuple[str, str]) -> Callable[[], object]:
    def make() -> None:
        with zipfile.ZipFile("Oscillator.fmu", "w") as file:
            for name, content in members:
                file.writestr(name, content)

    return make


def description(variables: str, version: str = "2.0", more: str = "") -> Callable[[], object]:
    """An FMU that nobody can run, with these variables."""
    identity = "instantiationToken" if version == "3.0" else "guid"
    text = (
        f'<fmiModelDescription fmiVersion="{version}" modelName="M" {identity}="1"><CoSimulation modelIdentifier="M"/>'
        f"{more}<ModelVariables>{variables}</ModelVariables><ModelStructure/></fmiModelDescription>"
    )
    return archive(("modelDescription.xml", text))


def bomb() -> None:
    archive(("modelDescription.xml", "x"))()
    content = bytearray(Path("Oscillator.fmu").read_bytes())
    place = content.rindex(b"PK\x01\x02") + 24
    content[place : place + 4] = (0xFFFFFFF0).to_bytes(4, "little")  # the size that it claims
    Path("Oscillator.fmu").write_bytes(content)


def without_binary() -> None:
    with zipfile.ZipFile("Oscillator.fmu") as old:
        members = [(n, old.read(n)) for n in old.namelist() if not n.startswith(("binaries", "sources"))]
    with zipfile.ZipFile("Oscillator.fmu", "w") as new:
        for name, content in members:
            new.writestr(name, content)


def taken() -> None:
    """Another process writes into the folder, until this one ends."""
    folder = Path("runs/bench")
    folder.mkdir(parents=True)
    (folder / ".lock").write_text("'fmuid identify' (process 4711 on rig, since 2026-05-01 12:00:00)\n")
    fcntl.flock(os.open(folder / ".lock", os.O_RDWR), fcntl.LOCK_EX)


def interrupted_diagnosis() -> None:
    folder = Path("runs/bench-diagnosis")
    journal = Journal(folder / "diagnosis.journal", _MAGIC)
    journal.append((b"key", (1, 2), bytes(16)))
    journal.close()


def interrupted() -> None:
    """What a run leaves that was killed in its first stage."""
    Path("runs/bench").mkdir(parents=True)
    named = dict.fromkeys(("parameters", "criteria", "cases", "signals"), ())
    row = Row(np.zeros(1), {}, np.zeros(0), np.zeros(0), 1.0, None, "search", 0.1, True)
    with History(Path("runs/bench")) as history:
        history._append("stage", {"stage": "all", "fingerprint": "", "begun": b"", **named})
        history._append("row", {"stage": "all", **_packed(row)})


def shared_parameter() -> None:
    toml("[settings]", '[effects]\ncatalogue = "effects.toml"\nnominal = ["m"]\n[settings]')()
    effect = '[effects.{}]\ndescription = ""\nport = "friction"\ntrials = [{{ d = 1 }}]\n[effects.{}.parameters]\n'
    parameter = "d = { neutral = 0, lower = 0, upper = 9, step = 1e-3 }\n"
    effects = "".join(effect.format(name, name) + parameter for name in ("rubbing", "drag"))
    Path("bench/effects.toml").write_text(f'format = "fmuid-effects"\nversion = 1\n[ports.friction]\n{effects}')


def coupled(connections: str, more: str = "") -> Callable[[], object]:
    """The campaign's model is two oscillators and two wires."""
    fmus = '{ a = "../Oscillator.fmu", b = "../Oscillator.fmu", c = "../Turning.fmu", d = "../Turning.fmu" }'
    names = '{ position = "a.x", u = "a.u", m = "a.m", d = "a.d", c = "a.c" }'

    def edit() -> None:
        toml('fmu = "../Oscillator.fmu"', f"fmus = {fmus}\nconnections = {{ {connections} }}\n{more}")()
        toml('map = { position = "x" }', f"map = {names}")()

    return edit


def system(elements: str, connections: str = "") -> Callable[[], object]:
    """An SSP file."""
    names = " ".join(
        f'xmlns:{n}="http://ssp-standard.org/SSP1/{long}"'
        for n, long in (("ssd", "SystemStructureDescription"), ("ssc", "SystemStructureCommon"))
    )

    def make() -> None:
        with zipfile.ZipFile("drive.ssp", "w") as file:
            file.write("Oscillator.fmu", "resources/Oscillator.fmu")
            file.writestr(
                "SystemStructure.ssd",
                f'<ssd:SystemStructureDescription {names} name="drive" version="1.0"><ssd:System name="drive">'
                f"<ssd:Elements>{elements}</ssd:Elements><ssd:Connections>{connections}</ssd:Connections>"
                "</ssd:System></ssd:SystemStructureDescription>",
            )

    return make


def part(source: str = "resources/Oscillator.fmu", kind: str = "application/x-fmu-sharedlibrary") -> str:
    connectors = '<ssd:Connector name="u" kind="input"/><ssd:Connector name="x" kind="output"/>'
    return (
        f'<ssd:Component name="a" type="{kind}" source="{source}"><ssd:Connectors>{connectors}</ssd:Connectors>'
        "</ssd:Component>"
    )


def modelica(body: str) -> Callable[[], object]:
    return write("M.mo", f"model M\n  {body}\nend M;\n")


def csv(rows: str, header: str = "time,u [N],x [m]") -> Callable[[], object]:
    return write("run.csv", f"{header}\n{rows}")


GOOD = "0,1,2\n1,2,3\n"
IMPORT = "import run.csv --setup oscillator --input u --out new.h5"
INIT = "init run.csv --fmu Oscillator.fmu"
BUILD = "build M.mo M --out ."
DESCRIPTION = '<fmiModelDescription fmiVersion="{}" modelName="M" guid="1"><ModelVariables/></fmiModelDescription>'

CASES = [
    Case(*row)
    for row in [
        ("Files", "a missing campaign", nothing, "check nowhere"),
        ("Files", "a folder without a `campaign.toml`", lambda: Path("empty").mkdir(), "check empty"),
        ("Files", "missing measurements", MEASUREMENTS.unlink, CHECK),
        ("Files", "a folder that is not a run", nothing, "validate bench"),
        ("Files", "a damaged `result.json`", write("bench/result.json", '{"campaign": '), "report bench"),
        ("Files", "an output that cannot be written", write("taken", ""), "export bench/measurements.h5 --out taken"),
        ("Files", "an import over an existing file", csv(GOOD), "import run.csv --setup a --input u --out bench/measurements.h5"),
        ("Files", "a run whose name is taken", write("step.csv", "time,u [N]\n0,1\n1,2\n"), "import step.csv --setup a --input u --out bench/measurements.h5 --append"),
        ("Files", "a campaign started in the folder of another", write("run.csv", "time,u,x\n" + GOOD), "init run.csv --fmu Oscillator.fmu --out bench"),
        ("Files", "a demo into an existing folder", nothing, "demo --out bench"),
        ("Files", "a campaign started without a model", write("run.csv", "time,u,x\n" + GOOD), "init run.csv"),
        ("Files", "a catalogue written without runs", nothing, "effects Oscillator.mo --out effects.toml"),
        ("Files", "a file that is not a campaign", nothing, "check Oscillator.fmu"),
        ("Files", "a campaign into a file", lambda: (write("run.csv", "time,u,x\n" + GOOD)(), write("taken", "")()), "init run.csv --fmu Oscillator.fmu --out taken/new"),
        ("Files", "a JSON file in a file", write("taken", ""), "check bench --json taken/found.json"),
        ("Files", "a run folder that is a file", write("taken", ""), "identify bench --out taken"),
        ("Files", "a run folder that another process writes into", taken, "identify bench"),
        ("Files", "a diagnosis into such a folder", lambda: (toml("[settings]", '[effects]\ncatalogue = "effects.toml"\n[settings]')(), taken()), "diagnose bench --out runs/bench"),
        ("Files", "an interrupted run, started again", interrupted, "identify bench"),
        ("Files", "an interrupted run of another campaign", interrupted, "identify bench --resume"),
        ("Files", "an interrupted diagnosis, started again", interrupted_diagnosis, "diagnose bench"),
        ("Files", "an FMU into a file", lambda: (modelica("Real x = 1;")(), write("taken", "")()), "build M.mo M --out taken"),
        ("campaign.toml", "text that is not TOML", toml("[settings]", "[settings"), CHECK),
        ("campaign.toml", "a file in another encoding", lambda: CAMPAIGN.write_bytes("# Prüfstand\n".encode("latin-1")), CHECK),
        ("campaign.toml", "a misspelt key", toml("start = 1.0", "strat = 1.0"), CHECK),
        ("campaign.toml", "a misspelt table", toml("[roles]", "[rolls]"), CHECK),
        ("campaign.toml", "text for a number", toml("lower = 0.5", 'lower = "half"'), CHECK),
        ("campaign.toml", "a start value outside its bounds", toml("start = 1.0", "start = 3.0"), CHECK),
        ("campaign.toml", "start values of machines for a parameter that they share", toml("start = 1.0", "start = 1.0\nstarts = { A = 1.1 }"), CHECK),
        ("campaign.toml", "a start value of one run outside the bounds", toml("start = 1.0", 'start = 1.0\nper = "experiment"\nstarts = { step = 3.0 }'), CHECK),
        ("campaign.toml", "a start value of an unknown run", toml("start = 1.0", 'start = 1.0\nper = "experiment"\nstarts = { stp = 1.1 }'), CHECK),
        ("campaign.toml", "bounds in the wrong order", toml("lower = 0.5", "lower = 5"), CHECK),
        ("campaign.toml", "a logarithmic scale down to 0", toml("lower = 0.5", 'lower = 0\nscale = "log"'), CHECK),
        ("campaign.toml", "a run that is not in the measurements", toml('"sine"', '"sin"'), CHECK),
        ("campaign.toml", "a run to identify and to validate", toml('validation = ["pulse"]', 'validation = ["step"]'), CHECK),
        ("campaign.toml", "a setup without a model", toml("[models.oscillator]", "[models.pendulum]"), CHECK),
        ("campaign.toml", "a stage that frees an unknown parameter", stage('free = ["mass"]'), CHECK),
        ("campaign.toml", "a `tie` to an unknown name", stage('tie = { d = "2*k" }'), CHECK),
        ("campaign.toml", "a `tie` that calls something", stage("tie = { d = \"__import__('os')\" }"), CHECK),
        ("campaign.toml", "an unknown solver", stage('solver = "bobiqa"'), CHECK),
        ("campaign.toml", "an unknown solver in a chain", stage('solver = "crs2 > bobiqa"'), CHECK),
        ("campaign.toml", "an option that a solver does not have", stage('solver = { name = "bobyqa", tolerances = 1e-3 }'), CHECK),
        ("campaign.toml", "an option that is not a number", stage('solver = { name = "trf", tolerance = "small" }'), CHECK),
        ("campaign.toml", "a first step of zero", stage('solver = { name = "dfols", initial_step = 0 }'), CHECK),
        ("campaign.toml", "far too many starts", stage('solver = { name = "trf", starts = 1_000_000_000 }'), CHECK),
        ("campaign.toml", "far too many draws", stage("monte_carlo = 1_000_000_000"), CHECK),
        ("campaign.toml", "far too many points of a front", stage("pareto = { points = 1_000_000 }"), CHECK),
        ("campaign.toml", "a stage named like a path", toml("[stages.all]", '[stages."a/b"]'), CHECK),
        ("campaign.toml", "a stage named like a folder", toml("[stages.all]", '[stages."."]'), CHECK),
        ("campaign.toml", "a null character in a name", toml('name = "bench"', 'name = "ben\\u0000ch"'), CHECK),
        ("campaign.toml", "a null character in a key", toml("[parameters.d]", '[parameters."d\\u0000"]'), CHECK),
        ("campaign.toml", "a file that is much too large", write("bench/campaign.toml", "#" * 10_000_001), CHECK),
        ("campaign.toml", "a seed that is not a whole number", stage('solver = { name = "trf", seed = 1.5 }'), CHECK),
        ("campaign.toml", "options that belong to no link of the chain", stage('solver = { name = "crs2 > bobyqa", evaluations = 100 }'), CHECK),
        ("campaign.toml", "no local solver for MLSL", stage('solver = { name = "mlsl", local = "crs2" }'), CHECK),
        ("campaign.toml", "a global solver without bounds", lambda: (toml("lower = 0.5\nupper = 2\n", "")(), stage('solver = "crs2"')()), CHECK),
        ("campaign.toml", "several starts without bounds", lambda: (toml("lower = 0.5\nupper = 2\n", "")(), stage('solver = { name = "trf", starts = 4 }')()), CHECK),
        ("campaign.toml", "a solver that does not support bounds", stage('solver = "lm"'), CHECK),
        ("campaign.toml", "least squares with a constraint", stage('solver = "trf"\nconstraints = [{ expression = "m - d", max = 1.0 }]'), CHECK),
        ("campaign.toml", "a constraint on an unknown name", stage('constraints = [{ expression = "m - k", max = 1.0 }]'), CHECK),
        ("campaign.toml", "a constraint without a limit", stage('constraints = [{ expression = "m - d" }]'), CHECK),
        ("campaign.toml", "a limit that is not a number", stage('constraints = [{ expression = "m - d", max = "1" }]'), CHECK),
        ("campaign.toml", "a constraint on an unknown criterion", stage('constraints = [{ criterion = "speed", max = 1.0 }]'), CHECK),
        ("campaign.toml", "a front with one objective", stage('pareto = { objectives = ["*position*"] }'), CHECK),
        ("campaign.toml", "an unknown criterion", stage('criteria = [{ signal = "position", kind = "least_square" }]'), CHECK),
        ("campaign.toml", "code that the campaign chose", stage('criteria = [{ signal = "position", kind = "user", options = { function = "os:system" } }]'), CHECK),
        ("campaign.toml", "a missing function", stage('criteria = [{ signal = "position", kind = "user", options = { function = "nowhere:f" } }]'), "check bench --trust"),
        ("campaign.toml", "a criterion on an unknown signal", stage('criteria = [{ signal = "force" }]'), CHECK),
        ("campaign.toml", "a budget of zero", toml("evaluations = 100", "evaluations = 0"), CHECK),
        ("campaign.toml", "a budget that is not a table", toml("budget = { evaluations = 100 }", "budget = 100"), CHECK),
        ("campaign.toml", "an invalid start value", toml("start = 1.0", "start = nan"), CHECK),
        ("campaign.toml", "a name that leads out of the run folder", toml('name = "bench"', 'name = "../other"'), CHECK),
        ("campaign.toml", "no run to identify with", toml('identification = ["step", "sine"]', "identification = []"), CHECK),
        ("campaign.toml", "a stage on a run that is kept for validation", stage('experiments = ["pulse"]'), CHECK),
        ("campaign.toml", "segments without length", stage("segments = 0"), CHECK),
        ("campaign.toml", "segments given as a word", stage('segments = "short"'), CHECK),
        ("campaign.toml", "a stage that frees nothing", stage("free = []"), CHECK),
        ("campaign.toml", "a stage that starts outside the bounds", stage("start = { m = 10 }"), CHECK),
        ("campaign.toml", "circular `tie`s", stage('tie = { d = "2*d" }'), CHECK),
        ("campaign.toml", "a criterion outside the run", stage('criteria = [{ signal = "position", from = 2 }]'), CHECK),
        ("campaign.toml", "an option that a criterion does not have", stage('criteria = [{ signal = "position", options = { sigm = 1 } }]'), CHECK),
        ("campaign.toml", "an unknown combination", stage('combine = "p_norm(x)"'), CHECK),
        ("campaign.toml", "a solver with zero starts", stage('solver = { name = "trf", starts = 0 }'), CHECK),
        ("campaign.toml", "a solver without its name", stage("solver = { starts = 3 }"), CHECK),
        ("campaign.toml", "a setting that is a parameter too", toml("c = 90", "m = 90"), CHECK),
        ("campaign.toml", "a `map` for an unknown name", toml("map = { position", "map = { positio"), CHECK),
        ("campaign.toml", "an unknown interface", toml("map = {", 'interface = "modelexchange"\nmap = {'), CHECK),
        ("campaign.toml", "a name with a dot and no quotes", toml("[parameters.d]", "[parameters.damper.d]"), CHECK),
        ("campaign.toml", "a class without its source", toml("map = {", 'class = "Drive"\nmap = {'), CHECK),
        ("campaign.toml", "a model without its source file", toml('fmu = "../Oscillator.fmu"', 'source = "Drive.mo"'), CHECK),
        ("campaign.toml", "an effect of an unknown signal", toml("[parameters.m]", 'signal_effects = ["u.gian"]\n\n[parameters.m]'), CHECK),
        ("campaign.toml", "effects of a model without source", toml("[parameters.m]", 'effects = "effects.toml"\n\n[parameters.m]'), CHECK),
        ("campaign.toml", "libraries of a model without source", toml("[parameters.m]", 'roots = ["libraries"]\n\n[parameters.m]'), CHECK),
        ("campaign.toml", "a missing catalogue", toml("[settings]", '[effects]\ncatalogue = "effects.toml"\nnominal = ["m"]\n[settings]'), "diagnose bench"),
        ("campaign.toml", "a validation run to diagnose with", toml("[settings]", '[effects]\ncatalogue = "effects.toml"\nexperiments = ["pulse"]\n[settings]'), "diagnose bench"),
        ("campaign.toml", "a parameter that two effects have", shared_parameter, "diagnose bench"),
        ("campaign.toml", "limits in the wrong order", toml("[settings]", "[limits]\nu = { min = 1, max = -1 }\n[settings]"), CHECK),
        ("campaign.toml", "a run without duration", toml("[settings]", "[limits]\nduration = 0\n[settings]"), CHECK),
        ("campaign.toml", "a limit that is a number", toml("[settings]", "[limits]\nu = 5\n[settings]"), CHECK),
        ("campaign.toml", "an unknown excitation", toml("[settings]", '[design]\nfamilies = ["sweep"]\n[settings]'), CHECK),
        ("campaign.toml", "a limit for an unknown variable", toml("[settings]", "[limits]\nuu = { min = -1, max = 1 }\n[settings]"), "design bench --for parameters"),
        ("campaign.toml", "a rate of an output", toml("[settings]", "[limits]\nu = { min = -1, max = 1 }\ny = { max = 1, rate = 1 }\n[settings]"), "design bench --for parameters"),
        ("campaign.toml", "an input with one limit", toml("[settings]", "[limits]\nu = { min = -1 }\n[settings]"), "design bench --for parameters"),
        ("campaign.toml", "limits that no run can keep", toml("[settings]", "[limits]\nu = { min = -1, max = 1 }\nposition = { min = 5, max = 6 }\n[settings]"), "design bench --for parameters --evaluations 8"),
        ("campaign.toml", "a parameter to draw without a range", toml("upper = 5\n", ""), "sensitivity bench --samples 8"),
        ("campaign.toml", "sensitivity without a run", lambda: MEASUREMENTS.unlink(), "sensitivity bench"),
        ("campaign.toml", "a run to design before any was recorded, without its noise", lambda: (MEASUREMENTS.unlink(), toml("[settings]", "[limits]\nduration = 1\nu = { min = -1, max = 1 }\n[settings]")()), "design bench --for parameters"),
        ("measurements.h5", "a file that is not HDF5", write("bench/measurements.h5", "time,x\n0,1\n"), CHECK),
        ("measurements.h5", "HDF5 of another kind", attribute("/", "format", "other"), CHECK),
        ("measurements.h5", "a future version", attribute("/", "version", 2), CHECK),
        ("measurements.h5", "no runs", hdf5(lambda f: [f["experiments"].__delitem__(n) for n in list(f["experiments"])]), CHECK),
        ("measurements.h5", "times that do not increase", sample("time", 4, 0.0), CHECK),
        ("measurements.h5", "a time that is missing", sample("time", 4, np.nan), CHECK),
        ("measurements.h5", "a missing sample of an input", sample("signals/u", 7, np.nan), CHECK),
        ("measurements.h5", "an infinite sample", sample("signals/position", 7, np.inf), CHECK),
        ("measurements.h5", "a signal of another length", instead("experiments/step/signals/position", data=np.zeros(10)), CHECK),
        ("measurements.h5", "integers", instead("experiments/step/signals/position", data=np.zeros(201, int)), CHECK),
        ("measurements.h5", "a size that exceeds memory", instead("experiments/step/signals/position", shape=(10**12,), dtype="f8", chunks=(1000,)), CHECK),
        ("measurements.h5", "an unknown causality", attribute("experiments/step/signals/u", "causality", "in"), CHECK),
        ("measurements.h5", "a noise of 0", attribute("experiments/step/signals/position", "sigma", 0.0), CHECK),
        ("measurements.h5", "a repeat of a missing run", attribute("experiments/step", "repeat_of", "stp"), CHECK),
        ("measurements.h5", "a repeat with other inputs", attribute("experiments/step", "repeat_of", "sine"), CHECK),
        ("measurements.h5", "a link to another file", instead("experiments/step/signals/position", link=h5py.ExternalLink("/etc/passwd", "/")), CHECK),
        ("measurements.h5", "a link within the file", instead("experiments/step/signals/position", link=h5py.SoftLink("/experiments/sine/time")), CHECK),
        ("measurements.h5", "data kept in another file", instead("experiments/step/signals/position", shape=(201,), dtype="f8", external="/etc/passwd"), CHECK),
        ("Recorded runs", "no column of times", csv(GOOD, "x [m],u [N],s"), IMPORT),
        ("Recorded runs", "a rate for a file with times", csv(GOOD), f"{IMPORT} --rate 100"),
        ("Recorded runs", "a file without a header", write("run.csv", GOOD), IMPORT),
        ("Recorded runs", "a chosen column that is missing", csv(GOOD), f"{IMPORT} --columns 'time=1,u [N]=7'"),
        ("Recorded runs", "a column without a unit", csv(GOOD, "time,u [N],x"), IMPORT),
        ("Recorded runs", "more columns than a run has", csv("0" + ",1" * 200_000 + "\n", "time" + "".join(f",c{i} [m]" for i in range(200_000))), IMPORT),
        ("Recorded runs", "a duplicate column", csv(GOOD, "time,u [N],u [N]"), IMPORT),
        ("Recorded runs", "a cell that is not a number", csv("0,1,2\n1,off,3\n"), IMPORT),
        ("Recorded runs", "decimal commas where commas separate", csv("0,1,2\n0,5,2,5,3\n"), IMPORT),
        ("Recorded runs", "time that goes backwards", csv("0,1,2\n2,2,3\n1,2,3\n"), IMPORT),
        ("Recorded runs", "time in newtons", csv(GOOD, "time [N],u [N],x [m]"), IMPORT),
        ("Recorded runs", "only a header", csv(""), IMPORT),
        ("Recorded runs", "an input that is not a column", csv(GOOD, "time,i [A],x [m]"), IMPORT),
        ("Recorded runs", "several time bases", two_rates, "import run.h5 --setup a --input oil.x"),
        ("Recorded runs", "MATLAB data without time", lambda: savemat("run.mat", {"x": np.zeros(3)}), "import run.mat --setup a --input x"),
        ("Recorded runs", "a file that is not MF4", write("run.mf4", "time,x\n"), "import run.mf4 --setup a --input x"),
        ("Recorded runs", "columns that match no variable of the FMU", csv(GOOD, "time,a,b"), "init run.csv --fmu Oscillator.fmu"),
        ("Recorded runs", "two rows at one time", csv("0,1,2\n0,2,3\n1,2,3\n"), INIT),
        ("Recorded runs", "a gap in an input", csv("0,,2\n1,2,3\n"), INIT),
        ("Recorded runs", "a column without a value", csv("0,1,\n1,2,\n"), INIT),
        ("Recorded runs", "a column in a unit of another quantity", csv(GOOD, "time,u [N],x [kg]"), INIT),
        ("Recorded runs", "dates and other times", csv("2026-05-01 12:00:00,1,2\n1,2,3\n"), INIT),
        ("Recorded runs", "noise of a signal that is not used", csv(GOOD), f"{INIT} --sigma xx=0.1"),
        ("Recorded runs", "the same run twice", csv(GOOD), "init run.csv run.csv --fmu Oscillator.fmu"),
        ("Units", "an unknown unit", csv(GOOD, "time,u [Nwt],x [m]"), IMPORT),
        ("Units", "a signal in a unit of another quantity", attribute("experiments/step/signals/position", "unit", "N.m"), CHECK),
        ("Units", "a parameter in a unit of another quantity", toml('unit = "kg"', 'unit = "N"'), CHECK),
        ("Units", "hertz for rad/s", csv("0,0\n1,1\n", "time,turns [Hz]"), "simulate Turning.fmu --input run.csv"),
        ("FMUs", "a missing FMU", toml("Oscillator.fmu", "Oscilator.fmu"), CHECK),
        ("FMUs", "a file that is not an archive", write("Oscillator.fmu", "MZ"), CHECK),
        ("FMUs", "an archive without a description", archive(("readme.txt", "")), CHECK),
        ("FMUs", "a description that is not XML", archive(("modelDescription.xml", "<fmi")), CHECK),
        ("FMUs", "a description in an unknown encoding", archive(("modelDescription.xml", '<?xml version="1.0" encoding="UTF-18"?><fmi/>')), CHECK),
        ("FMUs", "FMI 1.0", archive(("modelDescription.xml", DESCRIPTION.format("1.0"))), CHECK),
        ("FMUs", "an archive that climbs out of its folder", archive(("../../.bashrc", "true")), CHECK),
        ("FMUs", "a value reference outside of FMI's", description('<ScalarVariable name="x" valueReference="4294967296"><Real/></ScalarVariable>'), CHECK),
        ("FMUs", "an experiment without duration", description("", more='<DefaultExperiment stopTime="1e 6"/>'), CHECK),
        ("FMUs", "more variables than a model has", description('<ScalarVariable name="x" valueReference="1"/>' * 300_000), CHECK),
        ("FMUs", "an array with more elements than memory holds", description('<Float64 name="x" valueReference="1"><Dimension start="1000000000"/></Float64>', "3.0"), CHECK),
        ("FMUs", "an archive that would fill the disk", bomb, CHECK),
        ("FMUs", "no binary for this machine", without_binary, "simulate Oscillator.fmu"),
        ("FMUs", "a parameter that the model does not have", toml("[parameters.d]", "[parameters.D]"), CHECK),
        ("FMUs", "an output that the model does not have", toml('position = "x"', 'position = "xx"'), CHECK),
        ("FMUs", "a measured input that is the model's output", toml("map = {", 'map = { u = "y",'), CHECK),
        ("FMUs", "a setting of a variable that cannot be set", toml("c = 90", "y = 90"), CHECK),
        ("FMUs", "an FMU that is a folder", toml("../Oscillator.fmu", ".."), CHECK),
        ("FMUs", "a fraction for a whole number", nothing, "simulate Oscillator.fmu --set mode=1.5"),
        ("FMUs", "a value at which the model fails", nothing, "simulate Oscillator.fmu --set m=0"),
        ("Coupled FMUs", "a missing component", coupled('"b.u" = "e.y"'), CHECK),
        ("Coupled FMUs", "an unknown input", coupled('"b.uu" = "a.y"'), CHECK),
        ("Coupled FMUs", "a name without its component", coupled('"u" = "a.y"'), CHECK),
        ("Coupled FMUs", "an output that follows something", coupled('"b.x" = "a.x"'), CHECK),
        ("Coupled FMUs", "a wire from an input", coupled('"b.u" = "a.u"'), CHECK),
        ("Coupled FMUs", "a wire between different units", coupled('"b.u" = "a.x"'), CHECK),
        ("Coupled FMUs", "a wire that is not text", coupled('"b.u" = 3'), CHECK),
        ("Coupled FMUs", "an algebraic loop", coupled('"c.turns" = "d.w", "d.turns" = "c.w"'), CHECK),
        ("Coupled FMUs", "a step of zero", coupled("", "step = 0.0"), CHECK),
        ("Coupled FMUs", "a step backwards", nothing, "simulate Oscillator.fmu --master step=-1"),
        ("Coupled FMUs", "an unknown algorithm", coupled("", 'algorithm = "gauss"'), CHECK),
        ("Coupled FMUs", "an unknown extrapolation", coupled("", 'extrapolation = "quadratic"'), CHECK),
        ("Coupled FMUs", "an extrapolation for an unknown component", coupled("", 'extrapolation = { e = "linear" }'), CHECK),
        ("Coupled FMUs", "an unknown main component", coupled("", 'main = "e"'), CHECK),
        ("Coupled FMUs", "one FMU and several", toml('fmu = "../Oscillator.fmu"', 'fmu = "../Oscillator.fmu"\nfmus = { a = "../Turning.fmu" }'), CHECK),
        ("Coupled FMUs", "connections with one FMU", toml("map = {", 'connections = { "a.u" = "b.y" }\nmap = {'), CHECK),
        ("Coupled FMUs", "a communication step of one FMU", toml("map = {", "step = 1e-3\nmap = {"), CHECK),
        ("Coupled FMUs", "a missing FMU among several", lambda: (coupled("")(), Path("Turning.fmu").unlink()), CHECK),
        ("Coupled FMUs", "a missing SSP file", nothing, "simulate drive.ssp"),
        ("Coupled FMUs", "a file that is not an SSP file", write("drive.ssp", "MZ"), "simulate drive.ssp"),
        ("Coupled FMUs", "an SSP file without a system", lambda: Path("Oscillator.fmu").rename("drive.ssp"), "simulate drive.ssp"),
        ("Coupled FMUs", "an SSP file without its FMU", system(part("resources/Plant.fmu")), "simulate drive.ssp"),
        ("Coupled FMUs", "a component that is not an FMU", system(part(kind="application/x-modelica")), "simulate drive.ssp"),
        ("Coupled FMUs", "a component that is a file elsewhere", system(part("../../Oscillator.fmu")), "simulate drive.ssp"),
        ("Coupled FMUs", "an SSP connection that leads nowhere", system(part(), '<ssd:Connection startElement="a" startConnector="x" endElement="b" endConnector="u"/>'), "simulate drive.ssp"),
        ("Coupled FMUs", "an unknown key for the master", system(part()), "simulate drive.ssp --master stp=1e-3"),
        ("Modelica", "a missing source", nothing, "build Nowhere.mo Nowhere"),
        ("Modelica", "text that is not Modelica", modelica("Real x; equation x = ;"), BUILD),
        ("Modelica", "a class that the file does not contain", modelica("Real x = 1;"), "build M.mo N --out ."),
        ("Modelica", "a class without its package", write("M.mo", "package P\n  model M\n    Real x = 1;\n  end M;\nend P;\n"), BUILD),
        ("Modelica", "a missing library", modelica("Real x = 1;"), f"{BUILD} --root nowhere"),
        ("Modelica", "an unknown name", modelica("Real x = y;"), BUILD),
        ("Modelica", "too few equations", modelica("Real x; Real y; equation x = y;"), BUILD),
        ("Modelica", "redundant equations", modelica("Real x; Real y; equation x + y = time; 2*x + 2*y = 1;"), BUILD),
        ("Modelica", "C code", modelica('function f input Real u; output Real y; external "C" y = g(u); end f; Real x = f(time);'), BUILD),
        ("Modelica", "a feature outside the subset", modelica("Real x = previous(time);"), BUILD),
        ("Comparison", "a result without a variable of the reference", lambda: (write("a.csv", "time,x\n0,1\n1,2\n")(), write("b.csv", "time,y\n0,1\n1,2\n")()), "compare a.csv b.csv"),
        ("Comparison", "a result that ends too early", lambda: (write("a.csv", "time,x\n0,1\n1,2\n")(), write("b.csv", "time,x\n0,1\n2,2\n")()), "compare a.csv b.csv"),
        ("Comparison", "a folder without references", lambda: Path("references").mkdir(), "compare Oscillator.fmu references"),
        ("Comparison", "a reference of another model", write("b.csv", "time,z\n0,1\n1,2\n"), "compare Oscillator.fmu b.csv"),
        ("Comparison", "the FMU in the second place", write("b.csv", "time,x\n0,1\n1,2\n"), "compare b.csv Oscillator.fmu"),
        ("Comparison", "a variable that the reference does not have", lambda: (write("a.csv", "time,x\n0,1\n1,2\n")(), write("b.csv", "time,x\n0,1\n1,2\n")()), "compare a.csv b.csv -v y"),
        ("Options", "an unknown command", nothing, "chek bench"),
        ("Options", "an unknown option", nothing, "identify bench --worker 2"),
        ("Options", "an argument that is missing", nothing, "check"),
        ("Options", "a value of the wrong kind", nothing, "identify bench --evaluations many"),
        ("Options", "a setting without a value", nothing, "simulate bench --set m"),
        ("Options", "an unknown stage", nothing, "identify bench --stage al"),
        ("Options", "a design that continues from no diagnosis", nothing, "design bench --for diagnosis"),
        ("Options", "a sample size that is not a power of two", nothing, "sensitivity bench --samples 100"),
        ("Options", "the inputs of a planned run that the model does not have", write("plan.csv", "time,wing\n0,1\n1,1\n"), "sensitivity bench --input plan.csv"),
        ("Options", "a criterion of a planned run", write("plan.csv", "time,u\n0,1\n1,1\n"), "sensitivity bench --input plan.csv --of criterion"),
        ("Options", "an unknown run", nothing, "simulate bench -e stp"),
        ("Options", "a stop before the start", nothing, "simulate Oscillator.fmu --stop -1"),
        ("Options", "a value that is not a number", nothing, "simulate Oscillator.fmu --set m=heavy"),
        ("Options", "a negative number of workers", nothing, "identify bench --workers -1"),
        ("Options", "the start value of an unknown parameter", nothing, "simulate bench --set mm=3"),
        ("Options", "options that belong to something else", nothing, "simulate bench --stop 1"),
        ("Options", "half of a funnel", nothing, "compare a.csv b.csv --funnel-time 1"),
        ("Options", "an unknown figure format", nothing, "report bench --format gif"),
        ("Options", "two time bases", nothing, "import run.csv --setup a --input u --out new.h5 --resample 10 --align u"),
        ("Options", "an unknown resampling method", nothing, "import run.csv --setup a --input u --out new.h5 --resample 10 --method spline"),
    ]
]  # fmt: skip
