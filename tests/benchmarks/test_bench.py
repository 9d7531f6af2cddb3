"""The page of benchmarks is what `make bench` writes, and everything in it runs."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))


def headings(page: str) -> list[str]:
    return re.findall(r"^## (.*)$", page, re.MULTILINE)


def tables_of(page: str) -> list[str]:
    return re.findall(r"(?:^\|.*\n)+", page, re.MULTILINE)


def test_the_committed_page_is_the_command_s():
    import bench

    page = (ROOT / "docs" / "benchmarks.md").read_text()
    assert headings(page) == headings(bench.PAGE)
    assert "quick mode" not in page
    assert "`make bench`" in page
    assert "benchmarks/bench.py" in (ROOT / "Makefile").read_text()
    for tool in ("AixCaliBuHA", "ModestPy", "FMPy", "CVODES", "CMA-ES", "Dask"):
        assert tool in page
    for rows in tables_of(page):
        assert len({line.count("|") for line in rows.splitlines()}) == 1
        assert len(rows.splitlines()) >= 3
    assert (ROOT / "docs" / bench.FIGURE).is_file()


def test_a_missing_peer_is_said_to_be_missing(tmp_path, monkeypatch):
    import identification_speed as identification

    monkeypatch.setattr(identification, "ENVIRONMENTS", ROOT / "build" / "nowhere")
    (tmp_path / "job.json").write_text("{}")
    absent = identification.with_peer(("Tool 1.0", "tool", "race.py", ()), tmp_path / "job.json", 1.0)
    script = tmp_path / "broken.py"
    script.write_text("raise ImportError('no module named tool')")
    broken = identification.with_peer(("Tool 2.0", None, str(script), ()), tmp_path / "job.json", 1.0)
    page = identification.page({"a run": [identification.Finish("fmuid", 1.0, 10, 0.1, True), absent, broken]})
    assert "| a run | Tool 1.0 | missing |  | no environment in build/nowhere/tool |" in page
    assert "| Tool 2.0 | missing |  | failed: ImportError: no module named tool |" in page


def test_times_are_taken_in_turn():
    from timing import in_turn

    calls = []
    times = in_turn({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, 3)
    assert "".join(calls) == "ab" * 4
    assert all(len(t.all) == 3 and t.least <= t.median for t in times.values())


def test_what_is_measured_is_compiled_as_users_do():
    asked = "import evaluation, os; print(os.environ.get('FMU_BUILD_CFLAGS'), os.environ.get('MODELICAPATH'))"
    environment = {k: v for k, v in os.environ.items() if k not in ("FMU_BUILD_CFLAGS", "PYTHONPATH")}
    done = subprocess.run(
        [sys.executable, "-c", asked],
        cwd=ROOT / "benchmarks",
        env=environment | {"MODELICAPATH": "libraries"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "None libraries\n"


@pytest.mark.slow
def test_everything_runs(tmp_path, fmus):
    subprocess.run(
        [
            sys.executable,
            "-W",
            "error::DeprecationWarning:benchmarks",
            str(ROOT / "benchmarks" / "bench.py"),
            "--quick",
            "--out",
            str(tmp_path / "benchmarks.md"),
        ],
        check=True,
        capture_output=True,
    )
    page = (tmp_path / "benchmarks.md").read_text()
    assert "quick mode" in page
    assert (tmp_path / "figures" / "benchmarks-scaling.png").stat().st_size > 5000
    tables = tables_of(page)
    assert len(tables) == len(tables_of((ROOT / "docs" / "benchmarks.md").read_text()))
    assert all(len(rows.splitlines()) >= 3 for rows in tables), page
    assert not re.search(r"\bnan\b", page)
