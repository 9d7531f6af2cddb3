"""`python -m benchmarks.sealed_score LABELS ANSWERS`: score sealed campaigns once their labels are published.

LABELS is a JSON file: by case, ``effects`` (ids as a diagnosis writes them; empty for a complete model,
``["unknown"]`` for an effect outside the catalogue) and optionally ``same`` (by id, ids that the sensors cannot
separate) and ``places``. ANSWERS is the folder with the answers, `sealed` or `sealed/abroad`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.blind.score import Scored, in_words, share
from benchmarks.study_command import run_module


def scored(labels: Mapping[str, Mapping[str, Any]], answers: Path) -> list[Scored]:
    """Return every labelled case with its answer; a case without an answer is not right."""
    cases = []
    for number, (name, given) in enumerate(sorted(labels.items())):
        effects = list(given["effects"])
        stratum = "unknown" if effects == ["unknown"] else {0: "none", 1: "one"}.get(len(effects), "two")
        label = {
            "case": name, "seed": 0, "rig": number, "stratum": stratum, "effects": effects,
            "same": given.get("same", {}), "places": given.get("places", [e.partition("@")[2] for e in effects]),
            "background_effects": given.get("background", []), "background_same": [], "as_well": {}, "gap": np.inf,
        }  # fmt: skip
        file = answers / f"{name}.json"
        cases.append(Scored(label, {"answer": json.loads(file.read_text())} if file.is_file() else {}))
    return cases


def main(arguments: Sequence[str]) -> None:
    """Print every case and the shares."""
    cases = scored(json.loads(Path(arguments[0]).read_text()), Path(arguments[1]))
    for case in cases:
        truth = " and ".join(case.label["effects"]) or "none"
        verdict = in_words(case.answer) if case.answer else "no answer"
        print(
            f"{case.label['case']}: {'right' if case.right else case.reason}; truth: {truth}; verdict: {verdict}"
        )
    for name, figure in (
        ("right", share("", cases, lambda c: c.right)),
        ("wrong name", share("", cases, lambda c: c.wrong)),
        ("place right", share("", [c for c in cases if c.label["effects"]], lambda c: c.placed)),
    ):
        if figure.value is not None and figure.interval is not None:
            low, high = figure.interval
            print(f"{name}: {figure.value:.2f} ({low:.2f} to {high:.2f}), {figure.cases} cases")


if __name__ == "__main__":
    sys.exit(run_module("benchmarks.sealed_score LABELS ANSWERS", sys.argv[1:], main))
