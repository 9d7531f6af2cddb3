"""From logs to a campaign that is ready to run, by the page alone."""

from __future__ import annotations

import re
import tomllib
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("nicegui", reason="needs the extra [page]")
expect = pytest.importorskip("playwright.sync_api", reason="needs the package playwright").expect
pytestmark = pytest.mark.browser

Opened = Callable[..., str]
Spoken = Callable[[Any], str]


def status_of(address: str, **headers: str) -> int:
    try:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers)) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code


def table(folder: Path) -> dict[str, Any]:
    return tomllib.loads((folder / "campaign" / "campaign.toml").read_text())


def test_a_campaign_is_made_corrected_and_undone_in_the_page(
    tank: Path, opened: Opened, browser: Any, spoken: Spoken
) -> None:
    address = opened(*sorted(tank.glob("*.csv")), "--model", "Tank.mo", cwd=tank)
    assert status_of(address) == 200
    assert status_of(re.sub(r"/[^/]+/$", "/wrong/", address)) == 403
    assert status_of(re.sub(r"/[^/]+/$", "/", address)) == 403
    assert status_of(address, Host="evil.example:80") == 403

    page = browser.new_page()
    page.goto(address)
    page.get_by_role("status").get_by_text("Ready to run").wait_for()
    before = (tank / "campaign" / "campaign.toml").read_text()

    # A screen reader gets the table, its rows with what they show, and the state of every choice.
    page.get_by_role("img", name=re.compile("probe over time, measured and simulated")).first.wait_for()
    tree = spoken(page)
    assert 'tab "Prepare" [selected]' in tree
    assert 'row "probe [degC] probe over time, measured and simulated' in tree
    assert 'option "T [K], output" [selected]' in tree
    assert 'textbox "Lower of C": "400"' in tree

    # A column is connected with nothing, and the message about it is in its row.
    variable = page.get_by_label("Variable for probe")
    assert variable.input_value() == "T"
    variable.select_option("")
    row = page.get_by_role("row").filter(has=variable)
    page.get_by_role("status").get_by_text("1 to correct").wait_for()
    assert (
        "map" not in (tank / "campaign" / "campaign.toml").read_text()
        or "probe" not in table(tank)["models"]["Tank"]["map"]
    )

    # An unused column of the log is dragged onto the free variable; its unit does not fit.
    page.get_by_role("row").filter(has_text="spare").drag_to(page.get_by_text("output T [K]"))
    page.get_by_text("'V' cannot be converted").first.wait_for()
    page.get_by_role("row").filter(has=variable).drag_to(page.get_by_text("output T [K]"))
    page.get_by_role("status").get_by_text("Ready to run").wait_for()
    assert table(tank)["models"]["Tank"]["map"] == {"heater": "P", "probe": "T"}
    expect(row.locator("svg .simulated")).to_have_count(1)

    # Another start value, another curve.
    simulated = row.locator("svg .simulated")
    before_edit = str(simulated.get_attribute("points"))
    start = page.get_by_label("Start of C", exact=True)
    start.fill("8000")
    start.press("Tab")
    expect(simulated).not_to_have_attribute("points", before_edit)
    page.get_by_role("button", name="Undo").click()
    expect(start).to_have_value("4000")
    expect(simulated).to_have_attribute("points", before_edit)

    # A bound below the start is an error in the parameter's row; the keyboard's focus stays.
    lower = page.get_by_label("Lower of C")
    lower.fill("9000")
    lower.press("Tab")
    parameter = page.get_by_role("row").filter(has=lower)
    parameter.get_by_text("start 4000 is outside").wait_for()
    expect(page.get_by_label("Upper of C")).to_be_focused()
    page.get_by_role("button", name="Undo").click()
    page.get_by_role("status").get_by_text("Ready to run").wait_for()
    expect(lower).to_have_value("400")

    # Fixed, known, free again: comments stay.
    page.get_by_label("T_room is").select_option("known")
    page.wait_for_function("document.querySelector('textarea.file').value.includes('known = true')")
    assert table(tank)["parameters"]["T_room"]["known"] is True
    assert "# Runs for the fit" in (tank / "campaign" / "campaign.toml").read_text()
    shown = page.get_by_role("textbox", name="Text of campaign.toml")
    for _ in range(3):  # known, the variable that was dropped, the one that was removed
        text = shown.input_value()
        page.get_by_role("button", name="Undo").click()
        page.wait_for_function("(text) => document.querySelector('textarea.file').value !== text", arg=text)
    expect(page.get_by_role("button", name="Undo")).to_be_disabled()
    assert (tank / "campaign" / "campaign.toml").read_text() == before


def test_the_text_can_be_edited_and_another_program_too(
    tank: Path, opened: Opened, browser: Any, spoken: Spoken
) -> None:
    address = opened(*sorted(tank.glob("*.csv")), "--model", "Tank.mo", cwd=tank)
    page = browser.new_page()
    page.set_viewport_size({"width": 400, "height": 800})
    page.goto(address)
    page.get_by_role("status").get_by_text("Ready to run").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= 400
    sizes = page.evaluate(
        "[...document.querySelectorAll('main *')].filter((e) => e.textContent.trim() && e.offsetParent)"
        ".map((e) => parseFloat(getComputedStyle(e).fontSize))"
    )
    assert min(sizes) >= 12
    assert 'rowheader "probe [degC]"' in spoken(page)

    file = tank / "campaign" / "campaign.toml"
    file.write_text(file.read_text().replace("start = 4000.0", "start = 4321.0"))
    page.wait_for_function("document.querySelector('[aria-label=\"Start of C\"]').value === '4321'")
    text = page.get_by_role("textbox", name="Text of campaign.toml")
    text.fill(file.read_text().replace("start = 4321.0", "start = 4444.0"))
    text.blur()
    page.wait_for_function("document.querySelector('[aria-label=\"Start of C\"]').value === '4444'")
    text.fill("[campaign\n")
    text.blur()
    page.get_by_text("is not TOML").wait_for()
    assert "4444" in file.read_text()


def test_what_is_being_typed_stays_when_the_page_changes(tank: Path, opened: Opened, browser: Any) -> None:
    page = browser.new_page()
    page.goto(opened(*sorted(tank.glob("*.csv")), "--model", "Tank.mo", cwd=tank))
    page.get_by_role("status").get_by_text("Ready to run").wait_for()
    file = tank / "campaign" / "campaign.toml"
    page.get_by_label("Lower of C").fill("12")
    file.write_text(file.read_text().replace("start = 4000.0", "start = 4321.0"))
    page.wait_for_function("document.querySelector('[aria-label=\"Start of C\"]').value === '4321'")
    assert page.get_by_label("Lower of C").input_value() == "12"
    page.get_by_label("Lower of C").press("Tab")
    page.wait_for_function("document.querySelector('textarea.file').value.includes('lower = 12.0')")
    # A number that is none is taken back.
    page.get_by_label("Lower of C").fill("twelve")
    page.get_by_label("Lower of C").press("Tab")
    page.get_by_text("'twelve' is not a number").wait_for()
    expect(page.get_by_label("Lower of C")).to_have_value("12")


def test_a_message_about_a_part_that_is_not_shown_is_at_the_top(tank: Path, opened: Opened, browser: Any) -> None:
    page = browser.new_page()
    page.goto(opened(*sorted(tank.glob("*.csv")), "--model", "Tank.mo", cwd=tank))
    page.get_by_role("status").get_by_text("Ready to run").wait_for()
    file = tank / "campaign" / "campaign.toml"
    file.write_text(file.read_text() + "\n[signals.valve]\nfilter = 2.0\n")
    page.get_by_role("status").get_by_text("1 to correct").wait_for()
    page.get_by_text("valve").first.wait_for()


def test_two_windows_show_each_message_once(tank: Path, opened: Opened, browser: Any) -> None:
    logs = sorted(tank.glob("*.csv"))
    step = tank / "step.csv"
    step.write_text(re.sub(r"(?m)^(\d+),\d+,", r"\1,900,", step.read_text()))  # a constant input
    address = opened(*logs, "--model", "Tank.mo", cwd=tank)
    windows = [browser.new_page(), browser.new_page()]
    for page in windows:
        page.goto(address)
    for page in windows:  # also with what the simulations show
        expect(page.get_by_role("status").filter(has_text="Ready to run")).to_have_attribute("aria-busy", "false")
        row = page.get_by_role("row").filter(has=page.get_by_label("Variable for heater"))
        expect(row.get_by_text("is constant")).to_have_count(1)
