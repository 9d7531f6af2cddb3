"""Diagnoses of a folder of campaigns, one JSON file each, and a page about them.

`make sealed`: case ``NAME`` is the measurement file ``NAME/measurements.h5``; the reference is a
campaign whose own measurements it replaces. `make sealed-abroad`: every case is a campaign of its own, with its
plain model.
A case whose JSON exists is not diagnosed again. `sealed/changes.csv` has changed verdicts with the reasons.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import as_completed
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.blind.score import in_words
from benchmarks.study_command import ended
from benchmarks.timing import table
from fmuid.core.errors import FmuidError
from fmuid.core.files import write_atomically
from fmuid.diagnosis.summary import named, probability
from fmuid.simulation.pool.workers import WorkerPool

_CHANGES = "changes.csv"
_CHANGED = "## Changed verdicts"
_REASONS = "Every change since the first version of this page, with its reason."
_INTRODUCTION = """# Diagnoses of the sealed campaigns

Verdicts of fmuid on campaigns whose answers are withheld, case by case, as given; some have
[changed](#changed-verdicts).

Gaps are in noise floors: with the base model's parameters refitted, and with the verdict's effects.
The expected closure is for a new experiment, beyond what refitting closes; *unknown* and *complete*
promise none. [How to read a diagnosis](diagnosis.md);
[what was known beforehand](quality.md#what-was-known-beforehand)."""
_HOME = """Campaigns from a foreign rig of the actuator's kind. Made by `make sealed`; each whole answer is in\
 `sealed/`. Probabilities of all but s12 and s15 were calibrated before 29 November."""
_ABROAD = """Rigs of other kinds, each with a plain Modelica model that the catalogue is made from. Made by\
 `make sealed-abroad`; each whole answer is in `sealed/abroad/`."""
_COLUMNS = [
    "case",
    "verdict",
    "probability",
    "port",
    "gap, refitted",
    "gap, corrected",
    "expected closure",
    "90 %",
]


def diagnose_case(template: Path | None, measurements: Path, target: Path) -> str:
    """Diagnose one measurement file by the campaign `template`, write `target`, return the verdict in words.

    Without a template, by the campaign next to it.
    """
    from fmuid.campaigns.campaign_toml import load_campaign
    from fmuid.diagnosis_pipeline import FILE_NAME, diagnose

    with TemporaryDirectory() as out:
        diagnose(load_campaign(template or measurements.parent, measurements=measurements), workers=0, out=out)
        answer = json.loads(Path(out, FILE_NAME).read_text())
    del answer["campaign"]
    write_atomically(target, json.dumps(answer, indent=2, allow_nan=False) + "\n")
    return in_words(answer)


def diagnose_folder(
    folder: Path,
    template: Path | None,
    out: Path,
    *,
    workers: int | None = None,
    diagnose: Callable[[Path | None, Path, Path], str] = diagnose_case,
    file: str = "measurements.h5",
) -> list[str]:
    """Diagnose every case of `folder`, which has `file`, without a result in `out` yet; cases run side by side.

    Returns
    -------
    list
        What failed, one line a case.
    """
    cases = sorted(p.parent for p in folder.glob(f"*/{file}"))
    if not cases:
        raise FmuidError(f"no */{file}", where=folder, fix="give the folder of the sealed campaigns")
    waiting = [c for c in cases if not (out / f"{c.name}.json").is_file()]
    print(f"{len(cases)} cases, {len(cases) - len(waiting)} of them done before", flush=True)
    failures, begun = [], time.monotonic()
    with WorkerPool(workers, time_limit=None) as pool:
        jobs = {pool.submit(diagnose, template, c / file, out / f"{c.name}.json"): c for c in waiting}
        for done, job in enumerate(as_completed(jobs), 1):
            name = jobs[job].name
            try:
                answer = job.result()
            except FmuidError as error:
                failures.append(f"{name}: {error}")
                answer = f"failed: {error}"
            spent = time.monotonic() - begun
            left = spent / done * (len(waiting) - done)
            print(f"{name}: {answer}  ({spent:.0f} s, about {left:.0f} s left)", flush=True)
    return failures


def page(
    home: Mapping[str, Mapping[str, Any]],
    abroad: Mapping[str, Mapping[str, Any]],
    changes: Sequence[Mapping[str, str]] = (),
) -> str:
    """Return the Markdown page about diagnoses by case name, of both kinds of campaigns, and their `changes`."""
    lines = [_INTRODUCTION, *_section("At home", home, _HOME), *_section("Abroad", abroad, _ABROAD)]
    if changes:
        lines += ["", _CHANGED, "", _REASONS, "", table([*changes[0]], [[*change.values()] for change in changes])]
    lines += ["", "Next: [how good it is](quality.md)."]
    return "\n".join(lines) + "\n"


def changes_of(folder: Path) -> list[dict[str, str]]:
    """Return the changes of verdicts that `folder` lists: cases, from, to, date, commit and reason."""
    file = folder / _CHANGES
    return list(csv.DictReader(file.read_text().splitlines())) if file.is_file() else []


def unexplained(before: str, after: str, changes: Sequence[Mapping[str, str]]) -> list[str]:
    """Return the changes of verdicts between two versions of the page that are not among `changes`."""
    results = (text.partition(_CHANGED)[0] for text in (before, after))
    old, new = (dict(re.findall(r"^\| (\w\d+) \| (.*?) \|", text, re.MULTILINE)) for text in results)
    told = {(case, change["to"]) for change in changes for case in change["cases"].split(", ")}
    return [
        f"{case}: from {old[case]} to {verdict}"
        for case, verdict in new.items()
        if verdict != old.get(case, verdict) and (case, verdict) not in told
    ]


def _section(title: str, results: Mapping[str, Mapping[str, Any]], introduction: str) -> list[str]:
    if not results:
        return []
    rows = [_row(name, answer) for name, answer in results.items()]
    lines = ["", f"## {title}", "", introduction, "", table(_COLUMNS, rows)]
    open_ = [(n, a) for n, a in results.items() if a.get("next_experiment")]
    if open_:
        lines += ["", "What would settle the open ones:", ""]
        for name, answer in open_:
            e = answer["next_experiment"]
            sigma = f"{e['separation_sigma']:.3g} standard deviations between {' and '.join(e['between'])}"
            lines.append(f"- {name}: {e['setup']}, {e['description']}: {sigma}")
    return lines


def _row(name: str, answer: Mapping[str, Any]) -> list[str]:
    verdict, gap = answer["verdict"], answer["gap"]
    closure, interval = "", ""
    entry = next((a["closure"] for a in answer["answers"] if named(verdict) and a.get("closure")), None)
    if entry:
        closure, interval = f"{entry['held_out']:.2f}", "{:.2f} … {:.2f}".format(*entry["interval"])
    gaps = [f"{gap[k]:.2f}" for k in ("nominal_refit", "corrected")]
    sure = f"{probability(answer):.2f}"
    verdict_in_words = in_words(answer).removeprefix("provisional ").removeprefix("effect: ")
    return [name, verdict_in_words, sure, ", ".join(verdict["ports"]), *gaps, closure, interval]


def main(arguments: Sequence[str] | None = None) -> int:
    """`python -m benchmarks.sealed FOLDER`: diagnose every case and write the page; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sealed", description=__doc__)
    parser.add_argument("folder", type=Path, help="holds NAME/measurements.h5")
    parser.add_argument("--campaign", type=Path, default=Path("campaigns/sealed"))
    parser.add_argument("--abroad", action="store_true", help="every case is a campaign of its own")
    parser.add_argument("--out", type=Path, default=Path("sealed"), help="for NAME.json, or abroad/NAME.json")
    parser.add_argument("--page", type=Path, help="Markdown page to write")
    parser.add_argument("--workers", type=int, help="cases at the same time; one per processor by default")
    given = parser.parse_args(arguments)

    def work() -> Sequence[str]:
        out, template = (given.out / "abroad", None) if given.abroad else (given.out, given.campaign)
        failures = diagnose_folder(given.folder, template, out, workers=given.workers)
        if given.page is not None:
            folders = (given.out, given.out / "abroad")
            home, abroad = ({p.stem: json.loads(p.read_text()) for p in sorted(f.glob("*.json"))} for f in folders)
            changes = changes_of(given.out)
            text = page(home, abroad, changes)
            before = given.page.read_text() if given.page.is_file() else ""
            missing = unexplained(before, text, changes)
            if not missing:
                write_atomically(given.page, text)
            failures += [
                f"{change}: add the reason to {given.out / _CHANGES}; the page is as before" for change in missing
            ]
        return failures

    return ended(work, resumes=True)


if __name__ == "__main__":
    sys.exit(main())
