"""Damaged input files of every kind: each is read, or refused in one line, never with a traceback.

Each file starts from one that is right; hypothesis replaces, repeats, drops and swaps some of its words. 200 inputs a
kind by default, `make fuzz` takes 10,000.
"""

from __future__ import annotations

import os
import re
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))
import cases

from fmu_build import load
from fmu_build.errors import UserError
from fmuid.campaigns import campaign_toml
from fmuid.core.errors import FmuidError
from fmuid.core.experiments import Measurements
from fmuid.data.crosscheck_csv import read_csv
from fmuid.effects.effects_file import load_catalogue
from fmuid.identification.check import check_signals, load_models, match_models
from fmuid.identification.identify import check_stages
from fmuid.simulation.coupled.loading import load_system
from fmuid.simulation.fmu import Fmu
from tests.cli.conftest import TOML
from tests.conftest import MODELICA
from tests.every_law import written

INPUTS = int(os.environ.get("FMUID_FUZZ", "200"))
NASTY = [
    *(
        "",
        " ",
        "\n",
        "\0",
        "\t",
        "\r",
        "-1",
        "0",
        "1",
        "1e999",
        "-1e-999",
        "nan",
        "inf",
        "true",
        "99999999999999999999",
    ),
    *(
        '"',
        '""',
        "'",
        "[",
        "]",
        "{",
        "}",
        "[[",
        "=",
        ",",
        ";",
        ".",
        "..",
        "/",
        "../..",
        "*",
        "@",
        "#",
        "<",
        ">",
        "&",
        "&#0;",
    ),
    *(
        "é",
        "\u2028",
        "\U0001f600",
        "[1, 2]",
        "{ a = 1 }",
        '["*"]',
        "1979-05-27",
        "a" * 300,
        "(" * 200,
        "x**9**9**9",
    ),
]
WORD = re.compile(r"\w+|\s+|[^\w\s]")
STAGES = """
[stages.more]
experiments = ["s*"]
free = ["m", "d"]
start = { m = 1.1 }
criteria = [
  { signal = "position", kind = "quantile", demand = 0.1, weight = 2, from = 0.1, to = 0.9, options = { q = 0.9 } },
  { signal = "position", options = { whiten = "sigma", sensor = { gain = "1 + 0*m" } } },
]
combine = "p_norm(4)"
solver = { name = "crs2 > bobyqa", starts = 2, crs2 = { evaluations = 20 } }
budget = { evaluations = 10, seconds = 2.0 }
constraints = [{ expression = "m - 2*d", max = 1.0 }, { criterion = "*quantile", max = 9.0 }]
profiles = true
monte_carlo = 3
pareto = { objectives = ["*quantile*", "*least*"], points = 3 }

[stages.tied]
free = ["m"]
tie = { d = "0.5*m + exp(-m)" }
"""
CSV = "time,u [N],x [m]\n" + "".join(f"{k / 10},{k % 3},{k * 0.25:.3f}\n" for k in range(12))


def damaged(text: str) -> st.SearchStrategy[str]:
    """Return texts that differ from `text` in up to six words."""
    words = WORD.findall(text)
    place = st.integers(0, len(words) - 1)
    other = st.one_of(st.sampled_from(NASTY), st.sampled_from(sorted(set(words))), st.text(max_size=8))
    edit = st.tuples(
        place, st.sampled_from(["replace", "insert", "drop", "repeat", "cut"]), other, st.integers(1, 40)
    )

    def edited(edits: list[tuple[int, str, str, int]]) -> str:
        changed = list(words)
        for at, how, word, length in edits:
            at = min(at, len(changed))
            match how:
                case "replace":
                    changed[at : at + 1] = [word]
                case "insert":
                    changed.insert(at, word)
                case "drop":
                    del changed[at : at + length]
                case "repeat":
                    changed[at:at] = changed[at : at + length]
                case "cut":
                    changed[at:] = changed[at:] if length > 3 else []
        return "".join(changed)

    return st.lists(edit, min_size=1, max_size=6).map(edited)


def refused_or_read(read: Callable[[], object]) -> None:
    """Check that an input is read, or refused in one line."""
    try:
        read()
    except (FmuidError, UserError) as error:
        line = str(error)
    else:
        line = "read"
    assert line
    assert "\n" not in line


def fuzzed(text: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Run a test with so many texts that differ a little from one."""

    def decorated(test: Callable[..., None]) -> Callable[..., None]:
        slow = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.data_too_large]
        limits = settings(
            max_examples=INPUTS, deadline=None, derandomize=True, database=None, suppress_health_check=slow
        )
        return limits(given(text=damaged(text))(test))

    return decorated


@pytest.fixture
def bench(tmp_path: Path, oscillator: Path, measurements: Measurements, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the FMU; measurements are read once."""
    monkeypatch.setattr(campaign_toml, "read_measurements", lambda *_, **__: measurements)
    (tmp_path / "Oscillator.fmu").write_bytes(oscillator.read_bytes())
    return tmp_path


@fuzzed(TOML.format(fmu="Oscillator.fmu") + STAGES)
def test_a_damaged_campaign(bench: Path, text: str) -> None:
    (bench / "campaign.toml").write_bytes(text.encode(errors="surrogatepass"))

    def check() -> None:
        campaign = campaign_toml.load_campaign(bench)
        models = load_models(campaign)
        findings = match_models(campaign, models) + check_signals(campaign)
        if not any(f.level == "error" for f in findings):
            check_stages(campaign, models)

    refused_or_read(check)


@fuzzed(CSV)
def test_a_damaged_recording(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.csv").write_bytes(text.encode(errors="surrogatepass"))
    refused_or_read(lambda: read_csv(tmp_path / "run.csv"))


def description(version: str) -> str:
    """The description of an FMU with each kind of variable."""
    if version == "2.0":
        variables = "".join(
            f'<ScalarVariable name="{n}" valueReference="{k}" causality="{c}" variability="{v}" initial="{i}">'
            f'<{kind} start="1" unit="N" min="0" max="2" declaredType="T"/></ScalarVariable>'
            for k, (n, c, v, i, kind) in enumerate(
                [
                    ("p", "parameter", "tunable", "exact", "Real"),
                    ("n", "parameter", "fixed", "exact", "Integer"),
                    ("u", "input", "continuous", "", "Real"),
                    ("x", "output", "continuous", "calculated", "Real"),
                ]
            )
        ).replace(' initial=""', "")
        identity, types = "guid", '<SimpleType name="T"><Real unit="N"/></SimpleType>'
        outputs = '<Outputs><Unknown index="4" dependencies="3"/></Outputs>'
    else:
        variables = (
            '<Float64 name="p" valueReference="1" causality="parameter" variability="fixed" start="1 2 3 4" unit="N">'
            '<Dimension start="2"/><Dimension start="2"/></Float64><Float64 name="u" valueReference="2" causality="input"'
            ' start="0"/><Float64 name="x" valueReference="3" causality="output" declaredType="T"/>'
        )
        identity, types = "instantiationToken", '<Float64Type name="T" unit="N"/>'
        outputs = '<Output valueReference="3" dependencies="2"/>'
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="{version}" modelName="M" {identity}="1">'
        '<ModelExchange modelIdentifier="M"/><CoSimulation modelIdentifier="M" canHandleVariableCommunicationStepSize="true"/>'
        f'<UnitDefinitions><Unit name="N"><BaseUnit kg="1" m="1" s="-2"/></Unit></UnitDefinitions>'
        f"<TypeDefinitions>{types}</TypeDefinitions>"
        '<DefaultExperiment startTime="0" stopTime="1" tolerance="1e-6"/>'
        f"<ModelVariables>{variables}</ModelVariables><ModelStructure>{outputs}</ModelStructure></fmiModelDescription>"
    )


def test_the_descriptions_are_right(tmp_path: Path) -> None:
    for version in ("2.0", "3.0"):
        assert "x" in of_description(tmp_path, description(version)).variables


def of_description(folder: Path, text: str) -> Fmu:
    with zipfile.ZipFile(folder / "M.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", text.encode(errors="surrogatepass"))
    return Fmu(folder / "M.fmu")


def described(folder: Path, text: str) -> None:
    fmu = of_description(folder, text)
    assert all(v.name == name for name, v in fmu.variables.items())
    assert fmu.default_experiment is not None


@fuzzed(description("2.0"))
def test_a_damaged_description_of_fmi_2(tmp_path: Path, text: str) -> None:
    refused_or_read(lambda: described(tmp_path, text))


@fuzzed(description("3.0"))
def test_a_damaged_description_of_fmi_3(tmp_path: Path, text: str) -> None:
    refused_or_read(lambda: described(tmp_path, text))


def structure() -> str:
    names = " ".join(
        f'xmlns:{n}="http://ssp-standard.org/SSP1/{long}"'
        for n, long in (
            ("ssd", "SystemStructureDescription"),
            ("ssc", "SystemStructureCommon"),
            ("ssv", "SystemStructureParameterValues"),
        )
    )
    parts = "".join(cases.part().replace('name="a"', f'name="{n}"') for n in "ab")
    wire = '<ssd:Connection startElement="a" startConnector="x" endElement="b" endConnector="u"><ssc:LinearTransformation'
    bindings = (
        '<ssd:ParameterBindings><ssd:ParameterBinding><ssd:ParameterValues><ssv:ParameterSet version="1.0" name="p">'
        '<ssv:Parameters><ssv:Parameter name="a.m"><ssv:Real value="1.5" unit="kg"/></ssv:Parameter></ssv:Parameters>'
        "</ssv:ParameterSet></ssd:ParameterValues></ssd:ParameterBinding></ssd:ParameterBindings>"
    )
    return (
        f'<ssd:SystemStructureDescription {names} name="drive" version="1.0"><ssd:System name="drive">'
        f'<ssd:Connectors><ssd:Connector name="y" kind="output"/></ssd:Connectors>{bindings}'
        f"<ssd:Elements>{parts}</ssd:Elements><ssd:Connections>"
        f'{wire} factor="2" offset="1"/></ssd:Connection></ssd:Connections></ssd:System>'
        '<ssd:DefaultExperiment startTime="0" stopTime="1"/></ssd:SystemStructureDescription>'
    )


@fuzzed(structure())
def test_a_damaged_system(bench: Path, text: str) -> None:
    with zipfile.ZipFile(bench / "drive.ssp", "w") as file:
        file.write(bench / "Oscillator.fmu", "resources/Oscillator.fmu")
        file.writestr("SystemStructure.ssd", text.encode(errors="surrogatepass"))
    refused_or_read(lambda: load_system(bench / "drive.ssp"))


@fuzzed(written(load(MODELICA / "Pendulum" / "Setups" / "TorqueDriven.mo", "Pendulum.Setups.TorqueDriven")))
def test_a_damaged_catalogue(tmp_path: Path, text: str) -> None:
    (tmp_path / "effects.toml").write_bytes(text.encode(errors="surrogatepass"))
    refused_or_read(lambda: load_catalogue(tmp_path / "effects.toml"))
