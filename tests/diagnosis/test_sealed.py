"""The page about a folder of sealed campaigns, and that finished cases are not diagnosed again."""

import json
from pathlib import Path

import pytest

from benchmarks import sealed
from fmuid.core.errors import FmuidError

ANSWER = {
    "verdict": {
        "kind": "ambiguous",
        "effects": [],
        "one_of": [["viscous"], ["stribeck"]],
        "ports": ["gear_friction"],
    },
    "gap": {"nominal_refit": 2.5, "corrected": 0.2},
    "answers": [
        {
            "effects": ["viscous"],
            "probability": 0.5,
            "closure": {"train": 0.9, "held_out": 0.9, "interval": [0.8, 0.95]},
        },
        {"effects": ["stribeck"], "probability": 0.45},
        {"effects": ["none"], "probability": 0.05},
    ],
    "next_experiment": {
        "setup": "free_shaft",
        "description": "as free_20, with its input times 0.25",
        "separation_sigma": 12.0,
        "between": ["viscous", "stribeck"],
    },
}


def test_the_page_says_verdict_probability_port_and_closure():
    complete = {
        "verdict": {"kind": "complete", "effects": [], "one_of": [], "ports": []},
        "gap": {"nominal_refit": 0.1, "corrected": 0.1},
        "answers": [{"effects": ["none"], "probability": 0.97}],
    }
    text = sealed.page({"s01": ANSWER}, {"s02": complete})
    assert (
        "| s01 | ambiguous: viscous or stribeck | 0.95 | gear_friction | 2.50 | 0.20 | 0.90 | 0.80 … 0.95 |"
        in text
    )
    assert "| s02 | complete | 0.97 |  | 0.10 | 0.10 |  |  |" in text
    assert text.index("## At home") < text.index("| s01") < text.index("## Abroad") < text.index("| s02")
    assert "- s01: free_shaft, as free_20, with its input times 0.25: 12 standard deviations" in text


def test_finished_cases_are_kept(tmp_path: Path, capsys):
    (tmp_path / "s01").mkdir()
    (tmp_path / "s01" / "measurements.h5").write_bytes(b"")
    out = tmp_path / "out"
    out.mkdir()
    (out / "s01.json").write_text(json.dumps(ANSWER))
    arguments = [str(tmp_path), "--out", str(out), "--page", str(tmp_path / "page.md"), "--workers", "1"]
    assert sealed.main(arguments) == 0
    assert "1 cases, 1 of them done before" in capsys.readouterr().out
    assert "viscous or stribeck" in (tmp_path / "page.md").read_text()


def test_a_folder_without_cases_is_refused(tmp_path: Path):
    with pytest.raises(FmuidError, match=r"no \*/measurements.h5"):
        sealed.diagnose_folder(tmp_path, tmp_path, tmp_path)


def test_a_case_that_fails_does_not_stop_the_others(tmp_path: Path, capsys):
    for name in ("s01", "s02"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "measurements.h5").write_bytes(b"no HDF5")
    assert sealed.main([str(tmp_path), "--out", str(tmp_path / "out"), "--workers", "1"]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert [line[:4] for line in lines] == ["s01:", "s02:"]


CHANGE = {"cases": "s01, s02", "from": "unknown", "to": "complete", "date": "2026-11-25", "reason": "a new law"}


def test_the_page_lists_changed_verdicts_with_their_reasons():
    text = sealed.page({"s01": ANSWER}, {}, [CHANGE])
    assert "| cases | from | to | date | reason |" in text
    assert "| s01, s02 | unknown | complete | 2026-11-25 | a new law |" in text


def test_a_changed_verdict_without_a_reason_keeps_the_page(tmp_path: Path, capsys):
    (tmp_path / "s01").mkdir()
    (tmp_path / "s01" / "measurements.h5").write_bytes(b"")
    (tmp_path / "s01.json").write_text(json.dumps(ANSWER))
    page = tmp_path / "page.md"
    before = sealed.page(
        {"s01": {**ANSWER, "verdict": {**ANSWER["verdict"], "kind": "unknown", "one_of": []}}}, {}
    )
    page.write_text(before)
    arguments = [str(tmp_path), "--out", str(tmp_path), "--page", str(page), "--workers", "1"]
    assert sealed.main(arguments) == 1
    assert "s01: from unknown to ambiguous: viscous or stribeck: add the reason to" in capsys.readouterr().err
    assert page.read_text() == before
    row = 's01,unknown,ambiguous: viscous or stribeck,2026-11-25,"a law, wider"'
    (tmp_path / "changes.csv").write_text(f"cases,from,to,date,reason\n{row}\n")
    assert sealed.main(arguments) == 0
    assert "a law, wider" in page.read_text()


def test_the_page_in_the_docs_has_the_reasons_and_todays_verdicts():
    root = Path(__file__).parents[2]
    folders = (root / "sealed", root / "sealed" / "abroad")
    home, abroad = ({p.stem: json.loads(p.read_text()) for p in sorted(f.glob("*.json"))} for f in folders)
    changes = sealed.changes_of(root / "sealed")
    assert (root / "docs" / "sealed.md").read_text() == sealed.page(home, abroad, changes)
