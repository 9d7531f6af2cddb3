"""The public Modelica-Compliance suite: what should be translated is, and what should be refused is refused.

    python -m benchmarks.compliance SUITE [--root FOLDER] [--page docs/modelica_compliance.md]

`SUITE` is a clone of https://github.com/modelica/Modelica-Compliance. A test with ``shouldPass = true`` passes if
it is translated and its assertions hold at the start (without states, also at the end); one with
``shouldPass = false`` if it is refused, or an assertion fails. Only the translation is tried: no test is compiled
to an FMU.
"""

from __future__ import annotations

import argparse
import csv
import re
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fmu_build import compile_modelica
from fmu_build.errors import ModelicaError
from fmu_build.model import CompiledModel

LIMIT = 60  # seconds for a test
# Chapters of tests that are about what an FMU made from Modelica alone cannot have.
OUTSIDE = ("Functions.External", "Functions.ExternalObjects")


class Case(NamedTuple):
    """A test of the suite."""

    name: str
    file: Path
    should_pass: bool


class Outcome(NamedTuple):
    """What became of a test, and why."""

    case: Case
    passed: bool
    why: str

    @property
    def is_right(self) -> bool:
        return self.passed == self.case.should_pass


def cases(suite: Path) -> Iterator[Case]:
    """Yield the tests in the order of their names."""
    folder = suite / "ModelicaCompliance"
    for file in sorted(folder.rglob("*.mo")):
        stated = re.search(r"shouldPass\s*=\s*(true|false)", file.read_text(encoding="latin-1"))
        if stated and file.name not in ("package.mo", "Template.mo"):
            yield Case(".".join(file.relative_to(folder).with_suffix("").parts), file, stated[1] == "true")


def judge(case: Case, roots: Sequence[Path]) -> Outcome:
    """Translate a test and evaluate its assertions at the start."""
    signal.signal(signal.SIGALRM, _late)
    signal.alarm(LIMIT)
    try:
        model = compile_modelica(case.file, f"ModelicaCompliance.{case.name}", roots)
        failed = _failed_assertion(model)
    except ModelicaError as error:
        return Outcome(case, False, str(error))
    except Exception as error:  # an error of the translation itself
        return Outcome(case, not case.should_pass, f"{type(error).__name__}: {error}")
    finally:
        signal.alarm(0)
    return Outcome(case, not failed, "an assertion fails" if failed else "it is translated")


def _late(*_: object) -> None:
    raise TimeoutError(f"took longer than {LIMIT} s")


def _failed_assertion(model: CompiledModel) -> bool:
    """Whether an assertion fails at the start, where values settle."""
    from tests.fmu_build.simulate import Instance, values

    if not model.n_assert:
        return False
    instance = Instance.of(model)
    env = instance.env(0.0, instance.start())
    for time in (0.0, model.experiment.stop or 1.0) if model.n_x == 0 else (0.0,):
        env[0] = time
        z, m, x = instance.settle(env, 0.0 if time else 1.0)
        env[1], env[5], env[6], env[7] = x, z, z, m
        results = model.functions["asserts"](*env)
        failed = values(results[0] if isinstance(results, tuple) else results) == 0
        if np.any(failed & ~_warnings(model)):
            return True
    return False


def _warnings(model: CompiledModel) -> np.ndarray:
    """Which assertions only warn."""
    flags = re.search(r"MODEL_ASSERT_WARNING\[\] = \{([^}]*)\}", model.c_header)
    assert flags is not None
    return np.array([int(flag) == 1 for flag in flags[1].split(",")][: model.n_assert])


def page(outcomes: Sequence[Outcome]) -> str:
    """Make the page of the docs."""
    lines = [
        "# Modelica-Compliance", "",
        "How much of the [Modelica-Compliance suite](https://github.com/modelica/Modelica-Compliance) is right:",
        "tests that should be translated are, and their assertions hold at the start (without states, also at the",
        "end); tests that should be refused are, or an assertion fails. Tests of external functions are",
        "left out, because an FMU made from Modelica alone has none.",
        "`make compliance SUITE=FOLDER` makes this page.", "",
        "| chapter | should pass | right | should be refused | right |", "|---|---|---|---|---|",
    ]  # fmt: skip
    chapters = sorted({o.case.name.partition(".")[0] for o in outcomes})
    for chapter in (*chapters, ""):
        of_chapter = [o for o in outcomes if o.case.name.startswith(chapter)]
        cells = []
        for should_pass in (True, False):
            these = [o for o in of_chapter if o.case.should_pass == should_pass]
            cells += [str(len(these)), str(sum(o.is_right for o in these))]
        lines.append(f"| {chapter or 'all'} | {' | '.join(cells)} |")
    lines += ["", "[The other tests](modelica_compliance.csv), with what happens to each.", ""]
    lines += ["Next: [Modelica](modelica.md), or [how good it is](quality.md).", ""]
    return "\n".join(lines)


def write_misses(outcomes: Sequence[Outcome], file: Path) -> None:
    """Write the tests that are not right as CSV."""
    with file.open("w", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["test", "should", "what happens"])
        for o in outcomes:
            if not o.is_right:
                writer.writerow([o.case.name, "pass" if o.case.should_pass else "be refused", o.why[:160]])


def main() -> None:
    """Judge all tests."""
    parser = argparse.ArgumentParser()
    parser.add_argument("suite", type=Path)
    parser.add_argument("--root", type=Path, action="append", default=[])
    parser.add_argument("--page", type=Path)
    options = parser.parse_args()
    wanted = [c for c in cases(options.suite) if not c.name.startswith(OUTSIDE)]
    with ProcessPoolExecutor() as pool:
        outcomes = list(pool.map(partial(judge, roots=[options.suite, *options.root]), wanted, chunksize=8))
    for should_pass, what in ((True, "should pass"), (False, "should be refused")):
        of_kind = [o for o in outcomes if o.case.should_pass == should_pass]
        print(f"{what}: {sum(o.is_right for o in of_kind)} of {len(of_kind)} are right")
    if options.page:
        options.page.write_text(page(outcomes))
        write_misses(outcomes, options.page.with_suffix(".csv"))


if __name__ == "__main__":
    main()
