"""A search is started, paused, steered and looked at, by the page alone."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("nicegui", reason="needs the extra [page]")
expect = pytest.importorskip("playwright.sync_api", reason="needs the package playwright").expect
pytestmark = pytest.mark.browser

Opened = Callable[..., str]
Spoken = Callable[[Any], str]
_LONG = 'solver = "esch"\nbudget = { evaluations = 100000 }'


def campaign_of(folder: Path) -> dict[str, Any]:
    return tomllib.loads((folder / "campaign" / "campaign.toml").read_text())


def test_a_search_is_steered_and_its_result_moved(
    tank: Path, opened: Opened, browser: Any, spoken: Spoken
) -> None:
    address = opened(*sorted(tank.glob("*.csv")), "--model", "Tank.mo", cwd=tank)
    page = browser.new_page()
    page.goto(address)
    page.get_by_role("tab", name="Run").press("Enter")
    status = page.get_by_role("tabpanel", name="Run").get_by_role("status").first  # of the search
    status.get_by_text("Not started").wait_for()
    page.get_by_role("button", name="Start").click()
    status.get_by_text(re.compile("Done: stage all")).wait_for()
    page.get_by_role("img", name="Cost over evaluations").wait_for()
    page.get_by_role("img", name=re.compile("probe")).first.wait_for()

    assert 'img "Cost over evaluations"' in spoken(page)

    # Steering: a bound that excludes the best point; the search continues there, within the bound.
    best = json.loads((tank / "runs" / "campaign" / "result.json").read_text())["parameters"]
    assert best["G"] == pytest.approx(8.0, rel=0.02)
    page.get_by_text("Steer:").click()
    bound = page.get_by_role("tabpanel", name="Run").get_by_label("Upper of G")
    bound.fill("7")
    bound.press("Enter")
    page.wait_for_function("document.querySelector('textarea.file').value.includes('upper = 7.0')")
    page.get_by_role("button", name="Continue from the best point").click()
    page.get_by_text(re.compile("runs/campaign-2")).wait_for()
    status.get_by_text(re.compile("Done: stage all")).wait_for()
    assert campaign_of(tank)["parameters"]["G"]["start"] == 7.0
    assert campaign_of(tank)["parameters"]["C"]["start"] == pytest.approx(best["C"])
    steered = json.loads((tank / "runs" / "campaign-2" / "result.json").read_text())["parameters"]
    assert steered["G"] <= 7.0

    # A phone: all of it fits; what is wider scrolls in itself.
    page.get_by_text("Parallel coordinates of").first.click()
    page.set_viewport_size({"width": 400, "height": 800})
    page.get_by_role("img", name="Parallel coordinates: all").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= 400
    page.set_viewport_size({"width": 1400, "height": 900})

    # Look: the sentence has the parameters, and a slider simulates.
    page.get_by_role("button", name="Look at the result").click()
    look = page.get_by_role("tabpanel", name="Look")
    look.get_by_text(re.compile("G = ")).wait_for()
    residual_rms = look.get_by_text(re.compile("RMS of the residual"))
    expect(residual_rms).to_have_text(re.compile("probe: [0-9.]+ degC"))
    assert 'slider "C"' in spoken(page)
    before = residual_rms.inner_text()
    slider = look.get_by_role("slider", name="C", exact=True)
    slider.focus()
    for _ in range(5):
        page.keyboard.press("PageUp")
    page.wait_for_function(
        "(before) => [...document.querySelectorAll('[role=status]')].some("
        "(e) => e.textContent.startsWith('RMS') && e.textContent !== before)",
        arg=before,
    )
    rms = [float(m) for m in re.findall(r"probe: ([\d.e-]+) degC", before + residual_rms.inner_text())]
    assert rms[1] > rms[0]


def test_a_search_that_a_command_makes_is_followed(tank: Path, opened: Opened, browser: Any) -> None:
    start = "from fmuid.cli import main; main()"
    logs = map(str, sorted(tank.glob("*.csv")))
    subprocess.run([sys.executable, "-c", start, "init", *logs, "--model", "Tank.mo", "-q"], cwd=tank, check=True)
    address = opened("campaign", cwd=tank)
    page = browser.new_page()
    page.goto(address)
    page.get_by_role("tab", name="Run").click()
    status = page.get_by_role("tabpanel", name="Run").get_by_role("status").first  # of the search
    status.get_by_text("Not started").wait_for()
    identify = [sys.executable, "-c", start, "identify", "campaign", "--no-report", "-q"]
    subprocess.run(identify, cwd=tank, check=True)
    status.get_by_text(re.compile("Done: stage all")).wait_for()
    page.get_by_role("img", name="Cost over evaluations").wait_for()


def test_a_running_search_is_paused_resumed_and_steered(tank: Path, opened: Opened, browser: Any) -> None:
    address = opened(*sorted(tank.glob("*.csv")), "--model", "Tank.mo", cwd=tank)
    file = tank / "campaign" / "campaign.toml"
    text = file.read_text()
    assert "budget = { evaluations = 500 }" in text
    file.write_text(text.replace("budget = { evaluations = 500 }", _LONG))
    page = browser.new_page()
    page.goto(address)
    page.get_by_role("tab", name="Run").click()
    status = page.get_by_role("tabpanel", name="Run").get_by_role("status").first  # of the search

    def evaluations() -> int:
        count = re.search(r"(\d+) evaluations", status.inner_text())
        return int(count[1]) if count else 0

    page.get_by_role("button", name="Start").click()
    status.get_by_text(re.compile("Running: stage all")).wait_for()
    page.get_by_role("button", name="Pause").first.click()
    status.get_by_text(re.compile("Paused: stage all")).wait_for()
    at_rest = evaluations()
    page.reload()  # what is on the disk
    page.get_by_role("tab", name="Run").click()
    status.get_by_text(f", {at_rest} evaluations").wait_for()
    page.get_by_role("button", name="Resume").click()
    status.get_by_text(re.compile("Running: stage all")).wait_for()
    page.wait_for_function(
        "(n) => [...document.querySelectorAll('[role=status]')].some("
        "(e) => +(/(\\d+) evaluations/.exec(e.textContent) || [0, 0])[1] > n)",
        arg=at_rest,
    )
    # Another solver and one parameter less, from the best point of the search that runs.
    file.write_text(file.read_text().replace(_LONG, "budget = { evaluations = 500 }"))
    page.get_by_text("Steer:").click()
    choice = page.get_by_role("tabpanel", name="Run").get_by_label("T_room is")
    choice.select_option("fixed")
    page.get_by_role("button", name="Continue from the best point").click()
    page.get_by_text(re.compile("runs/campaign-2")).wait_for()
    status.get_by_text(re.compile("Done: stage all")).wait_for()
    (stage,) = json.loads((tank / "runs" / "campaign-2" / "result.json").read_text())["stages"]
    assert "T_room" not in [estimate["name"] for estimate in stage["estimates"]]
    assert campaign_of(tank)["parameters"]["T_room"]["free"] is False
