"""`python -m benchmarks.virtual_rig.blind OUT --labels FOLDER`: sealed campaigns for the blind check.

The labels are found first and go to a folder that the diagnosing process must not be able to read, together with
held-out runs for the score; only their SHA-256 is published with the campaigns, before the first one is written.
Every case is a function of seed and index, so an interrupted run goes on where it stopped. The seed would give the
labels away, so unless one is named it is drawn and kept among the labels.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import secrets
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks.virtual_rig.blind_cases import (
    Case,
    Truth,
    find_truth,
    label,
    plain_actuator,
    plan_cases,
    record_case,
)
from benchmarks.virtual_rig.blind_effects import BLIND_EFFECTS, DrawnEffect
from benchmarks.virtual_rig.blind_experiments import held_out_experiments, sealed_experiments
from fmu_build.errors import UserError
from fmuid.core.files import write_atomically
from fmuid.data.measurements import write_measurements

LABELS, DIGEST = "labels.json", "labels.sha256"


def make_blind_campaigns(
    out: Path,
    labels: Path,
    *,
    count: int = 200,
    seed: int,
    cases: Iterable[int] | None = None,
    workers: int = 2,
    say: Callable[[str], object] = print,
) -> str:
    """Make the blind check's campaigns and return the SHA-256 of their labels.

    Parameters
    ----------
    out
        Gets ``labels.sha256`` and ``cNNN/measurements.h5``.
    labels
        Gets ``labels.json`` and, for the score, ``cNNN/held_out.h5``. What is found there is used again.
    count, seed
        The grid: the same two numbers give the same cases.
    cases
        Indices of the cases to make; None: all. The labels are those of these cases.
    workers
        Threads (the rig computes outside Python's lock).
    say
        Called with every finished case.
    """
    planned = plan_cases(count, seed)
    chosen = planned if cases is None else tuple(planned[i] for i in cases)

    with ThreadPoolExecutor(workers) as pool:
        truths = list(pool.map(lambda case: truth_of(case, labels, say), chosen))
        text = json.dumps([label(t) for t in truths], indent=1, sort_keys=True) + "\n"
        write_atomically(labels / LABELS, text)
        digest = hashlib.sha256(text.encode()).hexdigest()
        write_atomically(out / DIGEST, f"{digest}  {LABELS}\n")
        list(pool.map(lambda truth: _write(truth, out, labels, say), truths))
    return digest


def truth_of(case: Case, labels: Path, say: Callable[[str], object] = print) -> Truth:
    """Return the case's truth, from its label in `labels` if it was found before."""
    file = labels / case.name / "label.json"
    key = f"{case!r}"
    if file.exists():
        stored = json.loads(file.read_text())
        if stored["key"] == key:
            return _from_label(case, stored["label"])
    truth = find_truth(case)
    write_atomically(file, json.dumps({"key": key, "label": label(truth)}))
    say(f"{case.name}: label found")
    return truth


def _from_label(case: Case, found: dict[str, Any]) -> Truth:
    drawn = tuple(
        DrawnEffect(BLIND_EFFECTS[name], magnitude, shape)
        for name, magnitude, shape in zip(found["effects"], found["magnitudes"], found["shapes"], strict=True)
    )
    return Truth(case, plain_actuator(case), drawn, tuple(found["gaps"]), found["gap"])


def _write(truth: Truth, out: Path, labels: Path, say: Callable[[str], object]) -> None:
    name = truth.case.name
    for folder, file, experiments in (
        (labels, "held_out.h5", held_out_experiments()),
        (out, "measurements.h5", sealed_experiments()),
    ):
        path = folder / name / file
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_measurements(record_case(truth, experiments, file), path)
    say(f"{name}: recorded")


def kept_seed(labels: Path) -> int:
    """Return the seed kept among the labels; drawn at the first time."""
    file = labels / "seed.txt"
    if not file.exists():
        write_atomically(file, f"{secrets.randbits(63)}\n")
    return int(file.read_text())


def main(arguments: list[str]) -> int:
    """Run the command; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.virtual_rig.blind", description=__doc__)
    parser.add_argument("out", type=Path, help="folder of the campaigns")
    parser.add_argument("--labels", type=Path, required=True, help="folder of the labels, elsewhere")
    parser.add_argument("--count", type=int, default=200, help="cases in the grid")
    parser.add_argument("--seed", type=int, default=None, help="default: drawn, and kept with the labels")
    parser.add_argument("--first", type=int, default=None, help="make only the first so many cases of the grid")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args(arguments)
    if given.labels.resolve().is_relative_to(given.out.resolve()):
        print("error: the labels would lie among the campaigns; choose another folder", file=sys.stderr)
        return 2
    try:
        digest = make_blind_campaigns(
            given.out,
            given.labels,
            count=given.count,
            seed=kept_seed(given.labels) if given.seed is None else given.seed,
            cases=None if given.first is None else range(given.first),
            workers=given.workers,
            say=lambda line: print(line, flush=True),
        )
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"SHA-256 of the labels: {digest}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
