"""Screenshots of reports for the documentation: ``make screenshots``.

What is shown is run first: `fmuid demo`, and the blocks of two pages.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from docs.pictures import open_page
from docs.pictures.screenshots import browser

DOCS = Path(__file__).parents[1]
BLOCK = re.compile(r"(?:^<!-- file: (\S+) -->\n)?^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
# Page, width of the window, height of what is shown (all of it if none).
REPORTS = {
    "report-identify-1400": ("demo/identified/report/index.html", 1400, None),
    "report-identify-400": ("demo/identified/report/index.html", 400, None),
    "report-diagnose-1400": ("demo/diagnosis/index.html", 1400, None),
    "report-diagnose-400": ("demo/diagnosis/index.html", 400, None),
    "report-oven": ("oven/runs/campaign-diagnosis/index.html", 1080, 1000),
} | {
    f"diagnosis-{kind}": (f"runs/{kind}/index.html", 1080, 1000)
    for kind in ("right", "ambiguous", "unknown", "insufficient")
}


def main() -> None:
    """Run what the documentation shows and take its pictures."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "docs").symlink_to(DOCS)
        run(["bash", "-e", "-c", "fmuid demo --no-open --out demo; fmuid report demo/identified"], folder)
        for page in ("tutorials/three-rigs.md", "how-to/read-diagnosis.md"):
            run_page(DOCS / page, folder)
        page = "fmuid identify demo/campaign --no-report --quiet; fmuid diagnose runs/campaign --quiet"
        run(["bash", "-e", "-c", page], folder)
        open_page.take(folder, "demo/campaign", DOCS / "figures")
        with browser() as window:
            for picture, (report, width, height) in REPORTS.items():
                whole = window.open(folder / report, width)
                (DOCS / "figures" / f"{picture}.png").write_bytes(window.picture(width, height or whole))


def run_page(page: Path, folder: Path) -> None:
    """Run the blocks of a page in their order, as its reader would."""
    for name, language, text in BLOCK.findall(page.read_text()):
        if name:
            (folder / name).write_text(text)
        elif language in ("python", "sh"):
            run([sys.executable, "-c", text] if language == "python" else ["bash", "-e", "-c", text], folder)


def run(command: list[str], folder: Path) -> None:
    """Run a command of a reader with this environment's programs."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    subprocess.run(command, cwd=folder, env=os.environ | {"PATH": path}, check=True)


if __name__ == "__main__":
    main()
