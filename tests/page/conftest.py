"""The page in a browser: served as a user starts it, looked at with Debian's Chromium."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
CHROMIUM = next((p for n in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(n))), None)
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
NAMED = "button|combobox|option|textbox|slider|switch|tab|tabpanel|table|columnheader|rowheader|img|region|heading|link"
MODEL = """\
model Tank "A tank with a heater, losing heat to the room"
  parameter Real C(unit = "J/K") = 4000 "heat capacity";
  parameter Real G(unit = "W/K") = 5 "loss to the room";
  parameter Real T_room(unit = "K") = 293.15 "temperature of the room";
  input Real P(unit = "W") "heating power";
  output Real T(unit = "K", start = 293.15, fixed = true) "temperature";
equation
  C*der(T) = P - G*(T - T_room);
end Tank;
"""


@pytest.fixture
def tank(tmp_path: Path) -> Path:
    """A folder with a model and three logs of a tank with C = 5000 J/K and G = 8 W/K, in °C."""
    import numpy as np

    rng = np.random.default_rng(3)
    (tmp_path / "Tank.mo").write_text(MODEL)
    time = np.arange(0.0, 1200.0, 4.0)
    courses = {"step": 900.0 * (time > 40), "pulse": 1500.0 * (time < 300), "steps": 700.0 * (time % 400 > 150)}
    for name, power in courses.items():
        level, rows = 0.0, []
        for t, p in zip(time, power, strict=True):
            rows.append(f"{t:g},{p:g},{20 + level + 0.05 * rng.standard_normal():.4f},{t % 7:g}")
            level = p / 8.0 + (level - p / 8.0) * np.exp(-4.0 * 8.0 / 5000.0)
        (tmp_path / f"{name}.csv").write_text(
            "\n".join(["time [s],heater [W],probe [degC],spare [V]", *rows]) + "\n"
        )
    return tmp_path


@pytest.fixture
def opened() -> Iterator[Callable[..., str]]:
    """Start `fmuid open` and return the address that it prints."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: object, cwd: Path) -> str:
        command = [
            sys.executable,
            "-c",
            "from fmuid.cli import main; main()",
            "open",
            *map(str, arguments),
            "--no-browser",
            "--workers",
            "1",
        ]
        process = subprocess.Popen(
            command,
            cwd=cwd,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(ROOT)])},
        )
        started.append(process)
        assert process.stdout is not None
        lines = []
        for line in process.stdout:
            lines.append(line)
            if line.startswith("http://127.0.0.1:"):
                return line.strip()
        raise AssertionError("".join(lines))

    yield start
    for process in started:
        process.terminate()
        process.communicate(timeout=300)


@pytest.fixture
def browser() -> Iterator[Any]:
    """A browser; every request that does not go to this machine fails the test.

    The time limits are those of a page that hangs: no test depends on how fast the machine is.
    """
    if CHROMIUM is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    playwright = pytest.importorskip("playwright.sync_api", reason="needs the package playwright")
    playwright.expect.set_options(timeout=300_000)
    elsewhere: list[str] = []
    with playwright.sync_playwright() as driver:
        program = driver.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        context = program.new_context(viewport={"width": 1400, "height": 900})
        context.set_default_timeout(300_000)

        def noted(request: Any) -> None:
            if not request.url.startswith(("http://127.0.0.1:", "ws://127.0.0.1:", "data:", "blob:")):
                elsewhere.append(request.url)

        context.on("request", noted)
        yield context
        program.close()
    assert elsewhere == []


@pytest.fixture
def spoken() -> Callable[[Any], str]:
    """Return the text of a page for a screen reader, after checks that apply everywhere."""

    def tree(page: Any) -> str:
        text = str(page.locator("body").aria_snapshot())
        lines, inside_picture = [], 1000
        for line in text.splitlines():
            indent = len(line) - len(line.lstrip())
            if indent > inside_picture:
                continue  # a picture is read as its name
            inside_picture = indent if re.match(r"\s*- '?img \"", line) else 1000
            lines.append(line)
        assert [line.strip() for line in lines if re.match(rf"\s*- '?({NAMED})(?=$|:| \[)", line)] == []
        assert sum(line.strip() == "- main:" for line in lines) == 1
        return "\n".join(lines)

    return tree
