"""What `make release` checks before it builds and tags anything."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.release_check import problems

GOOD = {
    "pyproject.toml": '[project]\nversion = "1.2.0"\n',
    "CITATION.cff": "title: fmuid\nversion: 1.2.0\nlicense: BSD-3-Clause\n",
    "CHANGELOG.md": "# Changelog\n\n## Unreleased\n\n## 1.2.0 (2026-12-01)\n\n### Added\n\n- This.\n\n## 1.1.0\n\n- That.\n",
    "docs/upgrade.md": "# Upgrade\n\n## From 1.1 to 1.2\n\nNothing.\n",
}


@pytest.mark.parametrize(
    ("file", "old", "new", "problem"),
    [
        ("CHANGELOG.md", "", "", None),
        ("pyproject.toml", "1.2.0", "1.2", "is not MAJOR.MINOR.PATCH"),
        ("CITATION.cff", "1.2.0", "1.1.0", "has another version"),
        ("CHANGELOG.md", "## Unreleased\n", "## Unreleased\n\n- More.\n", "has changes under Unreleased"),
        ("CHANGELOG.md", "## 1.2.0", "## 1.3.0", "has no section ## 1.2.0"),
        ("CHANGELOG.md", "- This.\n", "- This.\n" * 26, "has 26 lines"),
        ("CHANGELOG.md", "### Added", "### News", "headings other than"),
        ("docs/upgrade.md", "to 1.2", "to 1.0", "no section on the upgrade to 1.2"),
        ("docs/upgrade.md", "Nothing.", "Nothing. " * 40_000, "the pages have 360.0 kB; at most 290"),
    ],
)
def test_what_keeps_a_release_from_being_made(
    file: str, old: str, new: str, problem: str | None, tmp_path: Path
) -> None:
    (tmp_path / "docs").mkdir()
    for name, text in GOOD.items():
        (tmp_path / name).write_text(text.replace(old, new) if name == file else text)
    lines = problems(tmp_path)
    if problem is None:
        assert lines == []
    else:
        assert any(problem in line for line in lines)
