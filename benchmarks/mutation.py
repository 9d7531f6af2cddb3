"""Mutants of the numerical core: ``make mutation`` writes ``build/mutation/survivors.md``.

Cosmic Ray changes one place of a module at a time, in a copy of the repository, and runs the tests that should
notice. What none of them noticed is listed as a difference, to be judged by a reader: an equivalent program, or a
test that is missing.

    python benchmarks/mutation.py              every module below
    python benchmarks/mutation.py features     those whose path has "features" in it

Tests run in forks of a process that has imported what no mutant of the module changes: libraries, and the modules
that do not depend on it. That is most of their time.
"""

from __future__ import annotations

import argparse
import ast
import gc
import importlib
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

ROOT = Path(__file__).parents[1]
OUT = ROOT / "build" / "mutation"
LIMIT = 60  # s of processor time for the tests of one mutant: an endless loop is noticed, too
WAIT = 3600.0  # s for the answer on a busy machine
UNCHANGED = (
    "numpy",
    "scipy.linalg",
    "scipy.optimize",
    "scipy.signal",
    "scipy.stats",
    "h5py",
    "casadi",
    "pytest",
    "hypothesis",
)
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
timeout = {wait}
excluded-modules = []
test-command = "{python} -E {script} --ask {place} {tests}"

[cosmic-ray.distributor]
name = "local"

[cosmic-ray.filters.operators-filter]
exclude-operators = [
  "core/ReplaceBinaryOperator_(?!Add_Sub|Sub_Add|Mul_Div|Div_Mul|Pow_Mul)",
  "core/ReplaceComparisonOperator_(?!Lt_LtE|LtE_Lt|Gt_GtE|GtE_Gt|Eq_NotEq|NotEq_Eq)",
  "core/ReplaceUnaryOperator_(?!USub_UAdd)",
]
"""


def survivors(module: str, tests: Sequence[str], copy: Path, place: str) -> tuple[int, list[str]]:
    """Return the number of mutants of `module` and the differences of those that no test noticed."""
    from cosmic_ray.work_db import WorkDB, use_db
    from cosmic_ray.work_item import TestOutcome

    stem = module.replace("/", ".").removesuffix(".py")
    config, session = OUT / f"{stem}.toml", OUT / f"{stem}.sqlite"
    config.write_text(
        CONFIG.format(
            module=module, wait=WAIT, python=sys.executable, script=__file__, place=place, tests=" ".join(tests)
        ),
        encoding="utf-8",
    )
    for command in (
        ["cosmic-ray", "baseline", config],
        ["cosmic-ray", "init", config, session],
        ["cr-filter-operators", session, config],
        ["cosmic-ray", "exec", config, session],
    ):
        program = Path(sys.executable).with_name(str(command[0]))
        subprocess.run([program, *command[1:]], cwd=copy, check=True)
    with use_db(session, WorkDB.Mode.open) as database:
        results = [result for _, result in database.results if result.test_outcome is not None]
    return len(results), [str(r.diff) for r in results if r.test_outcome == TestOutcome.SURVIVED]


def independent(changed: str, source: Path) -> list[str]:
    """Return the modules of fmuid below `source` that do not depend on the module `changed`."""
    needs: dict[str, set[str]] = {}
    for file in source.rglob("fmuid/**/*.py"):
        name = ".".join(file.relative_to(source).with_suffix("").parts).removesuffix(".__init__")
        imported = {name.rpartition(".")[0]}
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                imported |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
            elif isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
        needs[name] = imported
    del needs["fmuid"]  # which imports nothing before it is asked for
    reached = {changed}
    while further := {name for name, of in needs.items() if name not in reached and of & reached}:
        reached |= further
    return sorted(name for name in needs if name not in reached and not name.endswith("__main__"))


def serve(listener: socket.socket, copy: Path, module: str) -> None:
    """Answer each request for tests of `module` with their exit code, until the listener is closed."""
    os.chdir(copy)
    sys.path[:0] = [str(copy / "src"), str(copy)]  # before the package that the environment has
    changed = "fmuid." + module.replace("/", ".").removesuffix(".py")
    for name in (*UNCHANGED, *independent(changed, copy / "src")):
        with suppress(ImportError):  # of a library that is not installed
            importlib.import_module(name)
    if changed in sys.modules:
        raise RuntimeError(f"{changed} has been imported already: no mutant of it would be seen")
    _in_a_fork("--collect-only", *CORE[module])  # leaves bytecode
    sys.dont_write_bytecode = True  # a mutant's would outlive it
    gc.collect()
    gc.freeze()
    while True:
        asking, _ = listener.accept()
        with asking:
            tests = asking.recv(65536).decode().split()
            asking.sendall(b"0" if _in_a_fork(*tests) == 0 else b"1")


@contextmanager
def serving(copy: Path, module: str) -> Iterator[str]:
    """Serve tests of `module` in another process; yield its address."""
    with (
        tempfile.TemporaryDirectory(prefix="mutation", dir="/tmp") as folder,
        socket.socket(socket.AF_UNIX) as listener,
    ):
        place = f"{folder}/tests"
        listener.bind(place)
        listener.listen()
        server = os.fork()
        if server == 0:
            serve(listener, copy, module)
        try:
            yield place
        finally:
            os.kill(server, signal.SIGTERM)
            os.waitpid(server, 0)


def _in_a_fork(*arguments: str) -> int:
    child = os.fork()
    if child == 0:
        spent = sum(os.times()[:2])
        resource.setrlimit(resource.RLIMIT_CPU, (int(spent) + LIMIT, int(spent) + LIMIT))
        os._exit(_passed(arguments))
    return os.waitpid(child, 0)[1]


def _passed(tests: Sequence[str]) -> int:
    """Return the exit code of tests, silently."""
    import pytest

    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)
    try:
        options = ["-x", "-q", "--assert=plain", "-p", "no:cacheprovider", "-p", "no:xdist", "-m", "not slow"]
        return int(pytest.main([*options, *tests]))
    except BaseException:
        return 1


def ask(place: str, tests: Sequence[str]) -> int:
    """Return the exit code of tests in a fork of the process that listens."""
    with socket.socket(socket.AF_UNIX) as asking:
        asking.connect(place)
        asking.sendall(" ".join(tests).encode())
        return 0 if asking.recv(1) == b"0" else 1


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", nargs="?", default="", help="of a module's path")
    parser.add_argument("--ask", nargs="+", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.ask:
        return ask(options.ask[0], options.ask[1:])
    part = options.part
    shutil.rmtree(OUT, ignore_errors=True)
    copy = OUT / "copy"
    shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*_IGNORED))
    page = ["# Surviving mutants", ""]
    for module, tests in CORE.items():
        if part in module:
            with serving(copy, module) as place:
                number, differences = survivors(module, tests, copy, place)
            page += [f"## {module}: {len(differences)} of {number}", ""]
            page += [f"```diff\n{difference.strip()}\n```\n" for difference in differences]
            (OUT / "survivors.md").write_text("\n".join(page), encoding="utf-8")
    print(f"written: {OUT / 'survivors.md'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
