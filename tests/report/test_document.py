import json
import os
import shutil
import subprocess
import tempfile

import pytest
import report_samples as samples
from report_page import Page

from fmuid.core.errors import FmuidError
from fmuid.core.formatting import Fact
from fmuid.report.document import Document, Section, _json, shown, write_document
from fmuid.report.plots.figure_data import Table

HOSTILE = "</script><script>alert(1)</script>"


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    out = tmp_path_factory.mktemp("report")
    table = Table(("parameter", "estimate"), ((HOSTILE, 2.66), ("J_S", None)), "estimates", "Estimates")
    sections = (Section("Estimates", (table,), "Hello"), Section("Figures", tuple(f() for f in samples.ALL)))
    document = Document(f"Identification {HOSTILE}", "Subtitle", (Fact("Best", "d_S = 2.66", "good"),), sections)
    return write_document(document, out)


def test_page_is_complete_in_itself(written):
    page = Page(written.read_text())
    assert not [link for link in page.links if "//" in link]
    policy = next(a["content"] for t, a in page.tags if a.get("http-equiv") == "Content-Security-Policy")
    assert "default-src 'none'" in policy
    assert "http" not in policy
    assert written.read_text().count("Copyright 2012-") == 1  # plotly.js, once


def test_every_link_leads_somewhere(written):
    page = Page(written.read_text())
    anchors = {a["id"] for _, a in page.tags if "id" in a}
    for link in page.links:
        assert link[1:] in anchors if link.startswith("#") else (written.parent / link).is_file(), link


def test_every_figure_is_in_the_page_with_its_data_and_picture(written):
    page = Page(written.read_text())
    assert len(page.plots) == len(samples.ALL)
    assert {p.stem for p in (written.parent / "figures").iterdir()} == {f().name for f in samples.ALL}
    assert (written.parent / "data" / "estimates.csv").read_text().splitlines()[0] == "parameter,estimate"


def test_names_in_a_campaign_cannot_become_script(written):
    page = Page(written.read_text())
    assert HOSTILE in page.text
    assert "<script>alert" not in written.read_text()


def test_nothing_in_a_figure_can_close_its_script():
    assert "<" not in _json({"title": HOSTILE})
    assert json.loads(_json({"title": HOSTILE})) == {"title": HOSTILE}


def test_nothing_is_sent_to_a_server(written):
    text = written.read_text()
    assert 'modeBarButtonsToRemove: ["sendChartToCloud"' in text


def test_page_draws_in_a_browser(written):
    """In a headless browser where there is one; elsewhere the figures must at least be readable JSON."""
    browser = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chrome")
    if browser is None:
        assert all({"data", "layout"} <= plot.keys() for plot in Page(written.read_text()).plots)
        return
    # A profile of its own: a browser that is running already would take the page over and print nothing.
    command = [
        browser,
        "--headless=new",
        "--no-sandbox",
        "--enable-unsafe-swiftshader",
        "--enable-logging=stderr",
        "--host-resolver-rules=MAP * ~NOTFOUND",
        "--window-size=1100,9000",
        "--dump-dom",
    ]
    for patience in (20, 60, 180):  # s that the page sees pass; a busy machine does less in them
        with tempfile.TemporaryDirectory(dir="/tmp") as short:  # a socket goes there
            budget = f"--virtual-time-budget={1000 * patience}"
            patient = [*command, f"--user-data-dir={short}", budget, written.as_uri()]
            environment = {**os.environ, "TMPDIR": short}
            done = subprocess.run(
                patient, capture_output=True, text=True, timeout=600, check=False, env=environment
            )
        if f'data-drawn="{len(samples.ALL)}"' in done.stdout:
            break
    assert f'data-drawn="{len(samples.ALL)}"' in done.stdout, done.stderr[-2000:]
    drawn = Page(done.stdout.replace("<script", "<!--").replace("</script>", "-->"))
    canvases = [a for t, a in drawn.tags if t == "svg" and "main-svg" in a.get("class", "")]
    assert len(canvases) >= len(samples.ALL)
    errors = [line for line in done.stderr.splitlines() if "CONSOLE" in line and "GL Driver" not in line]
    assert not errors


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(FmuidError, match="is not a usable folder"):
        write_document(Document("t", "s", (), (Section("a", (samples.history(),)),)), tmp_path / "file")


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        (2.6599999, "2.66"),
        (3.039e-3, "0.003039"),
        (-1.5e-9, "−1.5·10⁻⁹"),
        (None, "–"),
        ("a", "a"),
        (24841, "24841"),
    ],
)
def test_numbers_as_a_reader_wants_them(cell, text):
    assert shown(cell) == text
