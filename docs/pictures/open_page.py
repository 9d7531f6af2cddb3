"""Screenshots of the page of `fmuid open` for the documentation; a part of ``make screenshots``."""

from __future__ import annotations

import io
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from PIL import Image

from docs.pictures.screenshots import program

# Picture, tab, width, height, dark.
PICTURES = (
    ("page-prepare", "Prepare", 1400, 900, False),
    ("page-run", "Run", 1400, 900, False),
    ("page-look", "Look", 1400, 900, False),
    ("page-prepare-400", "Prepare", 400, 800, True),
    ("page-run-400", "Run", 400, 800, True),
    ("page-look-400", "Look", 400, 800, True),
)
READY = {"Prepare": "Ready to run", "Run": "Done: ", "Look": "RMS of the residual: \\w"}


@contextmanager
def served(folder: Path, *arguments: str) -> Iterator[str]:
    """Serve the page in a folder and yield its address."""
    command = [sys.executable, "-c", "from fmuid.cli import main; main()", "open", *arguments, "--no-browser"]
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield next(line.strip() for line in process.stdout if line.startswith("http://"))
    finally:
        process.terminate()
        process.communicate(timeout=30)


def take(folder: Path, campaign: str, figures: Path) -> None:
    """Take the pictures of a campaign that was identified and diagnosed in `folder`."""
    from playwright.sync_api import sync_playwright

    with served(folder, campaign) as address, sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=program(), args=["--no-sandbox", "--disable-gpu"])
        for name, tab, width, height, dark in PICTURES:
            page = chromium.new_page(
                viewport={"width": width, "height": height}, color_scheme="dark" if dark else "light"
            )
            page.goto(address)
            _show(page, tab)
            picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
            picture.quantize(64, dither=Image.Dither.NONE).save(figures / f"{name}.png", optimize=True)
            page.close()
        chromium.close()


def _show(page: Any, tab: str) -> None:
    page.get_by_role("tab", name=tab).click()
    if tab == "Look":
        page.get_by_role("tab", name="Run").click()
        page.get_by_role("button", name="Look at the diagnosis").click()
    page.wait_for_function(
        "(words) => [...document.querySelectorAll('[role=status]')].some("
        "(e) => RegExp(words).test(e.textContent))",
        arg=READY[tab],
    )
    if tab != "Prepare":
        page.locator("figure .plot .main-svg:visible").first.wait_for()
    page.wait_for_timeout(4000)  # lines and curves are drawn
