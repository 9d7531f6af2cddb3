"""The style check of `make lint` sees prose, not code, and says where."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import plain_english


@pytest.mark.parametrize(
    ("name", "text", "lines"),
    [
        ("page.md", "# A\n\nReturn what it is.\n", [3]),
        ("page.md", "```text\nReturn what it is.\n```\n`kept back`\n\nIt is kept back.\n", [6]),
        ("page.md", "Choose another folder. This applies to rigs other than actuators.\n", []),
        ("module.py", '"""Return what it is."""\nkept = "back"  # held against the truth\n', [1, 2]),
        ("module.py", "def returns(what):\n    return what\n", []),
        ("tests/test_module.py", "for value in ():\n    found = value\n    value.found = 1\n", [2]),
    ],
)
def test_habits_are_reported_with_their_line(
    name: str, text: str, lines: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plain_english, "ROOT", tmp_path)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(text)
    assert [fault.split(": ")[0] for fault in plain_english.faults(tmp_path / name)] == [
        f"{name}:{k}" for k in lines
    ]
