"""The ``experiment`` annotation of a class, read from its source (the flat result has no annotations)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from fmu_build.model import Experiment

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


def experiment(class_name: str, files: Sequence[Path]) -> Experiment:
    """Start and stop time, tolerance and interval that the class itself states."""
    text = _class_text(class_name, files)
    found = re.search(r"\bexperiment\s*\(([^()]*)\)", text)
    values: dict[str, float] = {}
    for name in ("StartTime", "StopTime", "Tolerance", "Interval"):
        match = re.search(rf"\b{name}\s*=\s*({_NUMBER})", found.group(1)) if found else None
        if match:
            values[name] = float(match.group(1))
    return Experiment(
        values.get("StartTime"), values.get("StopTime"), values.get("Tolerance"), values.get("Interval")
    )


def _class_text(class_name: str, files: Sequence[Path]) -> str:
    *packages, name = class_name.split(".")
    best, best_score = "", -1
    for path in files:
        text = re.sub(r"//[^\n]*|/\*.*?\*/", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
        match = re.search(
            rf"\b(?:model|block|class)\s+{re.escape(name)}\b.*?\bend\s+{re.escape(name)}\s*;", text, re.DOTALL
        )
        if match is None:
            continue
        within = re.search(r"\bwithin\s+([\w.]*)\s*;", text)
        inside = (within.group(1).split(".") if within and within.group(1) else []) + re.findall(
            r"\bpackage\s+(\w+)", text[: match.start()]
        )
        score = sum(p in inside for p in packages)
        if score > best_score:
            best, best_score = match.group(0), score
    return best
