"""Check that this clone is ready for a release of the version in pyproject.toml, and print that version.

`make release` runs this first. The changelog needs a section for the version, with Added, Changed and Fixed and at
most 25 lines, and nothing under Unreleased. CITATION.cff and docs/upgrade.md have to be about the same version.
The pages have at most 290 kB.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LINES = 25
KILOBYTES = 290
HEADINGS = ("Added", "Changed", "Fixed")


def sections(changelog: str) -> dict[str, str]:
    """Return the text of each version, by its name without the date."""
    parts = re.split(r"^## (.*)$", changelog, flags=re.MULTILINE)[1:]
    return {name.split(" ")[0]: text for name, text in zip(parts[::2], parts[1::2], strict=True)}


def problems(root: Path) -> list[str]:
    """Return the corrections that the files need before a release."""
    version = version_of(root)
    wrong = []
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        wrong.append(f"pyproject.toml: version {version} is not MAJOR.MINOR.PATCH")
    if f"\nversion: {version}\n" not in (root / "CITATION.cff").read_text():
        wrong.append(f"CITATION.cff: has another version; write version: {version}")
    texts = sections((root / "CHANGELOG.md").read_text())
    if texts.get("Unreleased", "").strip():
        wrong.append(f"CHANGELOG.md: has changes under Unreleased; move them to ## {version}")
    if version not in texts:
        wrong.append(f"CHANGELOG.md: has no section ## {version}")
    else:
        lines = [line for line in texts[version].splitlines() if line.strip() and not line.startswith("### ")]
        if len(lines) > LINES:
            wrong.append(
                f"CHANGELOG.md: {version} has {len(lines)} lines; at most {LINES}, results belong on pages"
            )
        others = set(re.findall(r"^### (.*)$", texts[version], re.MULTILINE)) - set(HEADINGS)
        if others:
            wrong.append(
                f"CHANGELOG.md: {version} has headings other than {', '.join(HEADINGS)}: {sorted(others)}"
            )
    minor = version.rpartition(".")[0]
    if version.endswith(".0") and f" to {minor}\n" not in (root / "docs" / "upgrade.md").read_text():
        wrong.append(f"docs/upgrade.md: has no section on the upgrade to {minor}")
    size = sum(page.stat().st_size for page in (root / "docs").rglob("*.md")) / 1000
    if size > KILOBYTES:
        wrong.append(f"docs: the pages have {size:.1f} kB; at most {KILOBYTES}, shorten them")
    return wrong


def version_of(root: Path) -> str:
    """Return the version in pyproject.toml."""
    return str(tomllib.loads((root / "pyproject.toml").read_text())["project"]["version"])


def git(*arguments: str) -> str:
    """Return the output of a git command in the clone."""
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def main() -> int:
    """Print the version, or what has to be corrected; return the exit code."""
    version = version_of(ROOT)
    wrong = problems(ROOT)
    if git("status", "--porcelain", "--untracked-files=no"):
        wrong.append("the clone has changes that are not committed")
    if git("tag", "--list", f"v{version}"):
        wrong.append(f"v{version} is already tagged; raise the version in pyproject.toml and CITATION.cff")
    print("\n".join(wrong) if wrong else version, file=sys.stderr if wrong else sys.stdout)
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
