"""Mutants of the numerical core: ``make mutation`` writes ``build/mutation/survivors.md``.

Cosmic Ray changes one place of a module at a time, in a copy of the repository, and runs the tests that should
notice. What none of them noticed is listed as a difference, to be judged by a reader: an equivalent program, or a
test that is missing.

    python benchmarks/mutation.py              every module below
    python benchmarks/mutation.py features     those whose path has "features" in it
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
OUT = ROOT / "build" / "mutation"
_IGNORED = (".git", ".venv", "build", "runs", "*.egg-info", "__pycache__", ".*_cache", ".hypothesis")
CORE: Mapping[str, Sequence[str]] = {
    "identification/problem/features.py": (
        "tests/identification/test_features.py",
        "tests/identification/test_criteria.py",
    ),
    "identification/uncertainty/inherited.py": ("tests/identification/test_held.py",),
    "identification/uncertainty/earlier_stages.py": ("tests/identification/test_held.py",),
    "identification/uncertainty/confidence.py": (
        "tests/identification/test_confidence.py",
        "tests/identification/test_held.py",
        "tests/identification/test_uncertainty.py",
    ),
    "diagnosis/cross_validation.py": ("tests/diagnosis/test_cross_validation.py",),
    "diagnosis/decide.py": ("tests/diagnosis/test_decide.py",),
    "diagnosis/scores.py": ("tests/diagnosis/test_scores.py", "tests/diagnosis/test_parts.py"),
}
"""Modules below `src/fmuid`, and the tests that should notice."""
CONFIG = """[cosmic-ray]
module-path = "src/fmuid/{module}"
timeout = 300.0
excluded-modules = []
test-command = "{python} -m pytest -x -q --assert=plain -p no:cacheprovider -n 0 -m 'not slow' {tests}"

[cosmic-ray.distributor]
name = "local"

[cosmic-ray.filters.operators-filter]
exclude-operators = [
  "core/ReplaceBinaryOperator_(?!Add_Sub|Sub_Add|Mul_Div|Div_Mul|Pow_Mul)",
  "core/ReplaceComparisonOperator_(?!Lt_LtE|LtE_Lt|Gt_GtE|GtE_Gt|Eq_NotEq|NotEq_Eq)",
  "core/ReplaceUnaryOperator_(?!USub_UAdd)",
]
"""


def survivors(module: str, tests: Sequence[str], copy: Path) -> tuple[int, list[str]]:
    """Return the number of mutants of `module` and the differences of those that no test noticed."""
    from cosmic_ray.work_db import WorkDB, use_db
    from cosmic_ray.work_item import TestOutcome

    stem = module.replace("/", ".").removesuffix(".py")
    config, session = OUT / f"{stem}.toml", OUT / f"{stem}.sqlite"
    config.write_text(CONFIG.format(module=module, python=sys.executable, tests=" ".join(tests)), encoding="utf-8")
    # The copy comes before the package that the environment has; bytecode of a mutant would outlive it.
    environment = {**os.environ, "PYTHONPATH": f"{copy / 'src'}:{copy}", "PYTHONDONTWRITEBYTECODE": "1"}
    for command in (
        ["cosmic-ray", "baseline", config],
        ["cosmic-ray", "init", config, session],
        ["cr-filter-operators", session, config],
        ["cosmic-ray", "exec", config, session],
    ):
        program = Path(sys.executable).with_name(str(command[0]))
        subprocess.run([program, *command[1:]], cwd=copy, env=environment, check=True)
    with use_db(session, WorkDB.Mode.open) as database:
        results = [result for _, result in database.results if result.test_outcome is not None]
    return len(results), [str(r.diff) for r in results if r.test_outcome == TestOutcome.SURVIVED]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", nargs="?", default="", help="of a module's path")
    part = parser.parse_args(arguments).part
    shutil.rmtree(OUT, ignore_errors=True)
    copy = OUT / "copy"
    shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*_IGNORED))
    page = ["# Surviving mutants", ""]
    for module, tests in CORE.items():
        if part in module:
            number, differences = survivors(module, tests, copy)
            page += [f"## {module}: {len(differences)} of {number}", ""]
            page += [f"```diff\n{difference.strip()}\n```\n" for difference in differences]
            (OUT / "survivors.md").write_text("\n".join(page), encoding="utf-8")
    print(f"written: {OUT / 'survivors.md'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
