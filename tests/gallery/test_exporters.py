"""FMUs from other exporters: init, identify and diagnose, also where the FMU lacks a law that the machine has."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fmuid.cli.app import run
from fmuid.data.crosscheck_csv import Table, write_csv
from tests.simulation.test_other_tools import INDEPENDENT, MODEL, built


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def stairs(time: np.ndarray, k: int, every: float) -> np.ndarray:
    """A random staircase between -1 and 1."""
    levels = np.random.default_rng(k).uniform(-1, 1, 2 + int(time[-1] / every))
    return levels[(time / every + 1e-9).astype(int)]


def integrated(slope: Callable, start: list[float], time: np.ndarray, u: np.ndarray) -> np.ndarray:
    """States of a plant whose input is held, by SciPy."""
    rows = [np.array(start, dtype=float)]
    for k in range(time.size - 1):
        solution = solve_ivp(
            lambda t, x, k=k: slope(x, u[k]), time[k : k + 2], rows[-1], "LSODA", rtol=1e-8, atol=1e-10
        )
        rows.append(solution.y[:, -1])
    return np.array(rows).T


def logs_of(
    plant: Callable[[np.ndarray, np.ndarray], np.ndarray],
    folder: Path,
    *,
    input: str,
    output: str,
    size: float,
    noise: float,
    duration: float,
    samples: int = 301,
) -> list[Path]:
    """Write three runs, each repeated; `input` and `output` are headers."""
    time, random = np.linspace(0.0, duration, samples), np.random.default_rng(3)
    folder.mkdir()
    for k in range(3):
        u = size * stairs(time, k, duration / 20)
        y = plant(time, u)
        for again in range(2):
            columns = {input: u, output: y + noise * random.standard_normal(y.size)}
            names, units = zip(*(header[:-1].split(" [") for header in columns), strict=True)
            table = Table(
                time, dict(zip(names, columns.values(), strict=True)), dict(zip(names, units, strict=True))
            )
            write_csv(table, folder / f"run{k}_{again}.csv")
    return sorted(folder.glob("*.csv"))


ALONE = ["--workers", "0", "--quiet"]


def identified(fmu: Path, logs: list[Path], folder: Path) -> dict[str, float]:
    """Run init and identify and return the identified values."""
    campaign = folder / "campaign"
    assert run(["init", *map(str, logs), "--fmu", str(fmu), "--out", str(campaign), *ALONE]) == 0
    assert run(["identify", str(campaign), "--out", str(folder / "run"), *ALONE]) == 0
    return json.loads((folder / "run" / "result.json").read_text())["parameters"]


def answers(fmu: Path, logs: list[Path], folder: Path) -> tuple[dict[str, float], dict]:
    """Run init, identify and diagnose and return the identified values and the verdict."""
    values = identified(fmu, logs, folder)
    assert run(["diagnose", str(folder / "campaign"), "--out", str(folder / "diagnosis"), *ALONE]) == 0
    return values, json.loads((folder / "diagnosis" / "diagnosis.json").read_text())["verdict"]


@pytest.mark.parametrize(
    ("package", "fmi", "real"), [("pythonfmu", "Fmi2", "Real"), ("pythonfmu3", "Fmi3", "Float64")]
)
def test_co_simulation_by_python_exporters(tmp_path, package, fmi, real):
    pytest.importorskip(package)
    builder = importlib.import_module(f"{package}.builder").FmuBuilder
    source = MODEL.format(package=package, fmi=fmi, real=real, independent=INDEPENDENT if fmi == "Fmi3" else "")
    fmu = built(builder, "lag", source.replace("(Base)", f"({fmi}Slave)"), tmp_path)

    def plant(time: np.ndarray, u: np.ndarray) -> np.ndarray:
        return integrated(lambda x, u: (u - x) / 0.15, [0.0], time, u)[0]

    logs = logs_of(plant, tmp_path / "logs", input="u [1]", output="y [1]", size=1.0, noise=0.01, duration=6.0)
    values, verdict = answers(fmu, logs, tmp_path)
    assert values["tau"] == pytest.approx(0.15, rel=0.03)
    assert verdict["kind"] == "complete"


CART = """
    from pythonfmu3 import Fmi3Causality, Fmi3Initial, Fmi3SlaveBase, Fmi3Variability, Float64, ModelExchange, Unit

    class Cart(Fmi3SlaveBase, ModelExchange):
        def __init__(self, **keywords):
            super().__init__(**keywords)
            self.time, self.f, self.s, self.v, self.ds, self.dv, self.m, self.c = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 50.0
            continuous, exact, fixed = Fmi3Variability.continuous, Fmi3Initial.exact, Fmi3Variability.fixed
            add, local, output = self.register_variable, Fmi3Causality.local, Fmi3Causality.output
            self.register_units([Unit(name=unit) for unit in ("m", "m/s", "N")])
            add(Float64("time", causality=Fmi3Causality.independent, variability=continuous))
            add(Float64("f", causality=Fmi3Causality.input, variability=continuous, start=0, unit="N"))
            add(Float64("s", causality=output, start=0, variability=continuous, initial=exact, unit="m"))
            add(Float64("ds", causality=local, variability=continuous, derivative=2))
            add(Float64("v", causality=output, start=0, variability=continuous, initial=exact, unit="m/s"))
            add(Float64("dv", causality=local, variability=continuous, derivative=4))
            add(Float64("m", causality=Fmi3Causality.parameter, variability=fixed, start=2))
            add(Float64("c", causality=Fmi3Causality.parameter, variability=fixed, start=50))

        def get_continuous_state_derivatives(self):
            self.ds, self.dv = self.v, (self.f - self.c * self.s) / self.m
            return [self.ds, self.dv]
"""


@pytest.mark.slow
def test_a_law_is_found_in_model_exchange_by_pythonfmu3(tmp_path):
    builder = pytest.importorskip("pythonfmu3.builder").FmuBuilder
    fmu = built(builder, "cart", CART, tmp_path)

    def plant(time: np.ndarray, u: np.ndarray) -> np.ndarray:
        slope = lambda x, f: [x[1], (f - 45 * x[0] - 3 * x[1] * abs(x[1])) / 2.2]  # noqa: E731
        return integrated(slope, [0.0, 0.0], time, u)[0]

    logs = logs_of(
        plant, tmp_path / "logs", input="f [N]", output="s [m]", size=20.0, noise=5e-4, duration=4.0, samples=101
    )
    values, verdict = answers(fmu, logs, tmp_path)
    assert set(values) <= {"m", "c"}
    assert verdict["effects"] == ["quadratic@der(v)"]


def mass_and_damper(folder: Path, drag: float, samples: int) -> tuple[Path, list[Path]]:
    """A mass on a spring and a damper, exported by OpenModelica 1.19, and logs of a machine that may have drag."""
    spec = importlib.util.find_spec("gemseo_fmu")  # its dependencies are not needed
    if spec is None or spec.origin is None:
        pytest.skip("needs the FMUs in gemseo-fmu; pip install --no-deps gemseo-fmu")
    fmu = folder / "Mass_Damper.fmu"
    shutil.copy(Path(spec.origin).parent / "problems" / "fmu_files" / "linux" / fmu.name, fmu)

    def plant(time: np.ndarray, u: np.ndarray) -> np.ndarray:
        def slope(x: np.ndarray, f: float) -> list[float]:
            return [x[1], (f - 9000 * (x[0] + 0.5) - 12 * x[1] - drag * x[1] * abs(x[1])) / 1.1]

        return integrated(slope, [0.0, 0.0], time, u)[0]

    logs = logs_of(
        plant,
        folder / "logs",
        input="f [N]",
        output="y [m]",
        size=1500.0,
        noise=1e-3,
        duration=3.0,
        samples=samples,
    )
    return fmu, logs


def test_model_exchange_by_openmodelica_is_identified(tmp_path):
    values = identified(*mass_and_damper(tmp_path, 0.0, 101), tmp_path)
    assert values["damper.d"] / values["mass.m"] == pytest.approx(12 / 1.1, rel=0.05)


@pytest.mark.slow
def test_a_law_is_found_in_model_exchange_by_openmodelica(tmp_path):
    values, verdict = answers(*mass_and_damper(tmp_path, 5.0, 301), tmp_path)
    assert "damper.d" in values
    assert verdict["effects"] == ["quadratic@der(damper.v_rel)"]


def reference_fmu(name: str, fmi: int) -> Path:
    """Return one of the published Reference-FMUs, which the environment names."""
    folder = os.environ.get("REFERENCE_FMUS")
    if folder is None:
        pytest.skip(
            "set REFERENCE_FMUS to the folder of an unpacked release of github.com/modelica/Reference-FMUs"
        )
    return Path(folder) / f"{fmi}.0" / f"{name}.fmu"


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
def test_the_drag_of_a_bouncing_ball_is_found_in_a_reference_fmu(tmp_path, fmi):
    """A ball of the Reference-FMUs, that has no drag, with the events of its impacts."""
    fmu = reference_fmu("BouncingBall", fmi)
    time, random = np.linspace(0.0, 3.0, 301), np.random.default_rng(2)
    heights, x, t = [1.0], np.array([1.0, 0.0]), 0.0

    def slope(_: float, x: np.ndarray) -> list[float]:
        return [x[1], -9.81 - 0.25 * x[1] * abs(x[1])]

    def impact(_: float, x: np.ndarray) -> float:
        return x[0]

    impact.terminal, impact.direction = True, -1.0
    for end in time[1:]:
        while t < end:
            solution = solve_ivp(slope, (t, end), x, rtol=1e-9, atol=1e-11, events=impact)
            t, x = solution.t[-1], solution.y[:, -1]
            if solution.status == 1:
                x = np.array([0.0, -0.75 * x[1]])
                if x[1] < 0.1:
                    t, x = end, np.zeros(2)
        heights.append(x[0])
    for k in range(3):
        noisy = np.array(heights) + 1e-3 * random.standard_normal(time.size)
        write_csv(Table(time, {"h": noisy}, {"h": "m"}), tmp_path / f"run{k}.csv")
    values, verdict = answers(fmu, [tmp_path / f"run{k}.csv" for k in range(3)], tmp_path)
    assert "e" in values
    assert verdict["effects"] == ["quadratic@der(v)"]
