"""Examples of the Modelica Standard Library against its published reference results.

    python benchmarks/standard_library.py LIBRARY REFERENCE [PACKAGE ...] [--page docs/standard_library.md]

`LIBRARY` is the folder that has the library's ``Modelica`` folder, `REFERENCE` a folder of the Modelica
Association's reference results. For each example: is it translated and built, is its FMU valid (fmpy), and do all
signals that the reference compares lie in a tube around it: 0.2 % of the signal's range up and down, 0.2 % of the
duration left and right.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

PACKAGES = (
    "Modelica.Mechanics.Rotational.Examples",
    "Modelica.Mechanics.Translational.Examples",
    "Modelica.Electrical.Analog.Examples",
    "Modelica.Thermal.HeatTransfer.Examples",
    "Modelica.Blocks.Examples",
)
TUBE = 2e-3
# What is known of those that do not match.
NOTES = {
    "Modelica.Mechanics.Rotational.Examples.LossyGearDemo2": "gear and bearing are stuck together at the start and"
    " coupled rigidly: how they share the torque has no unique solution",
    "Modelica.Mechanics.Translational.Examples.HeatLosses": "at the impact on the stop the reference keeps the"
    " relative speed of the damper as a state, so that the mass next to it stops at once; here that mass keeps its"
    " speed, which the damper takes up within milliseconds",
    "Modelica.Blocks.Examples.Noise.ImpureGenerator": "its numbers come from a hidden state",
}
STAGES = ("refused", "built", "valid", "matches")


def examples(reference: Path, package: str) -> list[str]:
    """Classes of a package that have reference results."""
    folder = reference.joinpath(*package.split("."))
    folders = {p.parent for p in folder.rglob("*.csv")}
    return sorted(".".join(p.relative_to(reference).parts) for p in folders)


def read(file: Path) -> dict[str, np.ndarray]:
    """Read a table of reference results."""
    with file.open(newline="") as stream:
        rows = csv.reader(stream)
        names = [name.strip() for name in next(rows)]
        table = np.array([[float(x) for x in row] for row in rows if row])
    return {"time": table[:, 0]} | {name: table[:, k] for k, name in enumerate(names) if k}


def outside(t: np.ndarray, y: np.ndarray, reference_t: np.ndarray, reference_y: np.ndarray) -> float:
    """Largest distance of a signal from the tube, as a share of the signal's range; 0 if it lies inside."""
    span = max(np.ptp(reference_y), 1e-3 * np.abs(reference_y).max(), 1e-12)
    width = TUBE * (reference_t[-1] - reference_t[0])
    first = np.searchsorted(reference_t, t - width, side="left")
    last = np.searchsorted(reference_t, t + width, side="right")
    left = np.interp(t - width, reference_t, reference_y)
    right = np.interp(t + width, reference_t, reference_y)
    worst = 0.0
    for k in range(len(t)):
        inside = reference_y[first[k] : last[k]]
        low = min(left[k], right[k], inside.min(initial=np.inf))
        high = max(left[k], right[k], inside.max(initial=-np.inf))
        worst = max(worst, (low - y[k]) / span - TUBE, (y[k] - high) / span - TUBE)
    return worst


def judge(library: Path, reference: Path, name: str) -> dict[str, Any]:
    """Build, validate and simulate one example."""
    import fmpy
    from fmpy.validation import validate_fmu

    from fmu_build import build
    from fmu_build.errors import BuildError, ModelicaError

    folder = reference.joinpath(*name.split("."))
    with tempfile.TemporaryDirectory() as out:
        try:
            fmu = build(library / "Modelica" / "package.mo", name, out, roots=[library])
        except (ModelicaError, BuildError) as error:
            return {"stage": "refused", "why": str(error)}
        problems = validate_fmu(str(fmu))
        if problems:
            return {"stage": "built", "why": " ".join(problems[0].split())}
        wanted = read(folder / f"{folder.name}.csv")
        listed = folder / "comparisonSignals.txt"
        names = [n.strip() for n in listed.read_text().splitlines()] if listed.is_file() else list(wanted)
        known = {v.name for v in fmpy.read_model_description(str(fmu)).modelVariables}
        signals = [n for n in dict.fromkeys(names) if n != "time" and n in wanted]
        shown = [n for n in signals if n in known]
        lacking = [n for n in signals if n not in known]
        start, stop = float(wanted["time"][0]), float(wanted["time"][-1])
        messages: list[str] = []
        try:
            result = fmpy.simulate_fmu(
                str(fmu), start_time=start, stop_time=stop, output_interval=(stop - start) / 2000, output=shown,
                relative_tolerance=1e-6, fmi_type="CoSimulation",
                logger=lambda *message: messages.append(message[-1].decode()),
            )  # fmt: skip
        except Exception as error:  # whatever the run ends with is its result
            return {"stage": "valid", "why": " ".join((messages or [str(error)])[0].split())}
    worst = {n: outside(result["time"], result[n].astype(float), wanted["time"], wanted[n]) for n in shown}
    if lacking:
        return {"stage": "valid", "why": f"no variable {lacking[0]}"}
    bad = max(worst, key=lambda n: worst[n], default=None)
    if bad is not None and not worst[bad] <= 0.0:
        return {"stage": "valid", "why": f"{bad} is {100 * worst[bad]:.2g} % of its range outside the tube"}
    return {"stage": "matches", "why": ""}


def in_a_process(command: Sequence[str], limit: float) -> dict[str, Any]:
    """Judge a model in a process of its own: what its last line says, or why there is none."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit, check=False)
    except subprocess.TimeoutExpired:
        return {"stage": "refused", "why": f"took longer than {limit:g} s"}
    try:
        return json.loads(done.stdout.splitlines()[-1])  # type: ignore[no-any-return]
    except (IndexError, json.JSONDecodeError):
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        return {"stage": "refused", "why": f"traceback: {last}"}


def page(results: dict[str, dict[str, Any]]) -> str:
    """Make the page of the docs."""
    lines = [
        "# Modelica Standard Library", "",
        "How much of the Modelica Standard Library `fmuid build` translates, and how much of it matches the"
        " reference results.",
        "",
        "Examples of the Modelica Standard Library 4.1.0 that have published reference results: translated and",
        "built, valid (fmpy), and with all compared signals inside a tube of 0.2 % around the reference.",
        "`make standard-library ROOT=FOLDER REFERENCE=FOLDER` makes this page.", "",
        "| package | examples | built | valid | match |", "|---|---|---|---|---|",
    ]  # fmt: skip
    for package in PACKAGES:
        of_package = [r for n, r in results.items() if n.startswith(f"{package}.")]
        if of_package:
            counts = Counter(r["stage"] for r in of_package)
            total = [sum(counts[s] for s in STAGES[k:]) for k in (1, 2, 3)]
            lines.append(f"| `{package}` | {len(of_package)} | {total[0]} | {total[1]} | {total[2]} |")
    total = Counter(r["stage"] for r in results.values())
    lines += ["", f"{total['matches']} of {len(results)} match."]
    lines += ["", "## What does not match", "", "| example | reached | why |", "|---|---|---|"]
    for name, result in results.items():
        if result["stage"] != "matches":
            why = result["why"].replace("|", "\\|")[:200]
            note = f"; {NOTES[name]}" if name in NOTES else ""
            lines.append(f"| `{name.removeprefix('Modelica.')}` | {result['stage']} | {why}{note} |")
    lines += ["", "Next: [Modelica](modelica.md), or [how good it is](quality.md)."]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Judge all examples of some packages."""
    parser = argparse.ArgumentParser()
    parser.add_argument("library", type=Path)
    parser.add_argument("reference", type=Path)
    parser.add_argument("packages", nargs="*", default=PACKAGES)
    parser.add_argument("--one")
    parser.add_argument("--limit", type=float, default=600.0)
    parser.add_argument("--page", type=Path)
    parser.add_argument("--results", type=Path, help="JSON file that results are added to, and taken from")
    options = parser.parse_args()
    if options.one:
        print(json.dumps(judge(options.library, options.reference, options.one)))
        return
    results: dict[str, dict[str, Any]] = {}
    if options.results and options.results.is_file():
        results = json.loads(options.results.read_text())
    for package in options.packages:
        for name in examples(options.reference, package):
            if name in results:
                continue
            command = [sys.executable, __file__, str(options.library), str(options.reference), "--one", name]
            results[name] = in_a_process(command, options.limit)
            print(name, *results[name].values(), flush=True)
            if options.results:
                options.results.write_text(json.dumps(results, indent=1))
    if options.page:
        options.page.write_text(page(results))


if __name__ == "__main__":
    main()
