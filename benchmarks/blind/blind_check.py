"""`python -m benchmarks.blind.blind_check`: make sealed campaigns, diagnose them blind, score, write the page.

Everything goes on where it was interrupted. The diagnoses are made by another process, `blind_case`, that is told
the campaigns' folder only and cannot open the folder of the labels, not even if it is a superuser's; their SHA-256
has been written beside the campaigns before.
"""

from __future__ import annotations

import argparse
import ctypes
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.blind.blind_score import Outcome
from benchmarks.blind.made import PLACES, scored
from benchmarks.study_command import ended
from benchmarks.virtual_rig.blind import DIGEST, LABELS, kept_seed, make_blind_campaigns, truth_of
from benchmarks.virtual_rig.blind_cases import plan_cases
from benchmarks.virtual_rig.blind_further import add_suggested_run
from fmuid.core.errors import FmuidError
from fmuid.core.files import write_atomically
from fmuid.core.formatting import counted
from fmuid.simulation.pool.workers import WorkerPool

_DROP_FROM_BOUNDING_SET = 24  # of prctl(2)
_PASS_OVER_MODES = (1, 2)  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH of capabilities(7)


@dataclass(frozen=True, slots=True)
class Check:
    """A blind check: its grid and its folders.

    Attributes
    ----------
    out
        Campaigns, answers and what they are worth; nothing in it tells a label.
    labels
        Labels and held-out runs.
    template
        Campaign that the cases are held against.
    only
        Indices of the cases to make, of the grid of `count`; None: all.
    seed
        None: drawn, and kept with the labels.
    """

    out: Path
    labels: Path
    template: Path
    count: int = 200
    only: tuple[int, ...] | None = None
    seed: int | None = None
    workers: int | None = None

    def run(self) -> Outcome:
        """Carry it out."""
        self._make()
        return self.score(closed=self._diagnose(self.out / "campaigns", self.out / "answers"))

    def score(self, *, closed: bool | None = None) -> Outcome:
        """Score the cases that have an answer; `closed`: whether the labels were, None if that is to be tried."""
        if closed is None:
            with out_of_reach(self.labels) as closed:
                pass
        labels = checked_labels(self.labels, self.out / "campaigns" / DIGEST)
        answers = {n: json.loads(p.read_text()) for n in labels if (p := self._answer(n)).is_file()}
        closures = self._closures(answers)
        second = self._second_round({n: a for n, a in answers.items() if a.get("next_experiment")})
        cases = tuple(scored(labels[n], a, closures.get(n), second.get(n)) for n, a in answers.items())
        digest = (self.out / "campaigns" / DIGEST).read_text().split()[0]
        return Outcome(cases, tuple(PLACES), len(labels), self.count, self._seed, digest, closed)

    def _answer(self, name: str, folder: str = "answers") -> Path:
        return self.out / folder / f"{name}.json"

    @property
    def _seed(self) -> int:
        return kept_seed(self.labels) if self.seed is None else self.seed

    def _make(self) -> None:
        if self.labels.is_dir():
            self.labels.chmod(0o700)  # an interrupted diagnosis may have left it closed
        make_blind_campaigns(
            self.out / "campaigns",
            self.labels,
            count=self.count,
            seed=self._seed,
            cases=self.only,
            workers=self.workers or os.cpu_count() or 1,
            say=lambda line: print(line, flush=True),
        )

    def _diagnose(self, campaigns: Path, answers: Path) -> bool:
        command = [sys.executable, "-m", "benchmarks.blind.blind_case", str(campaigns)]
        command += ["--campaign", str(self.template), "--out", str(answers)]
        command += [] if self.workers is None else ["--workers", str(self.workers)]
        return diagnosed_apart(command, self.labels)

    def _closures(self, answers: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
        """Measure on held-out runs what every answer that names an effect closes."""
        from fmuid.campaigns.campaign_toml import load_campaign
        from fmuid.diagnosis.cross_validation import share_closed
        from fmuid.diagnosis.summary import named
        from fmuid.diagnosis.validation import validate_diagnosis

        closures = {}
        with WorkerPool(self.workers) as pool:
            for name, answer in answers.items():
                if not named(answer["verdict"]):
                    continue
                kept = self._answer(name, "held_out")
                if not kept.is_file():
                    campaign = load_campaign(self.template, measurements=self.labels / name / "held_out.h5")
                    assert campaign.effects is not None
                    made = replace(campaign.effects, catalogue=self._answer(name).with_suffix(".toml"))
                    campaign = replace(campaign, effects=made)
                    gaps = validate_diagnosis(answer, campaign, runner=pool.run).gaps
                    write_atomically(kept, json.dumps(gaps) + "\n")
                closures[name] = share_closed(*json.loads(kept.read_text())["all"])
        return closures

    def _second_round(self, answers: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
        """Make what was suggested where an answer was open, and diagnose again with it."""
        if not answers:
            return {}
        cases = {case.name: case for case in plan_cases(self.count, self._seed)}
        campaigns = self.out / "second_campaigns"
        for name, answer in answers.items():
            target = campaigns / name / "measurements.h5"
            if not target.is_file():
                before = self.out / "campaigns" / name / "measurements.h5"
                truth = truth_of(cases[name], self.labels)
                add_suggested_run(truth, answer["next_experiment"]["description"], before, target)
        self._diagnose(campaigns, self.out / "second_answers")
        found = {n: self._answer(n, "second_answers") for n in answers}
        return {n: json.loads(p.read_text()) for n, p in found.items() if p.is_file()}


def checked_labels(labels: Path, digest: Path) -> dict[str, Mapping[str, Any]]:
    """Return the labels by case, once their hash is found to be the one written before the diagnoses."""
    text = (labels / LABELS).read_bytes()
    if hashlib.sha256(text).hexdigest() != digest.read_text().split()[0]:
        raise FmuidError(f"is not the hash of {LABELS}", where=digest, fix="start again in empty folders")
    return {label["case"]: label for label in json.loads(text)}


def diagnosed_apart(command: Sequence[str], labels: Path) -> bool:
    """Run the diagnosing process while the labels are out of reach; return whether that keeps its user out."""
    with out_of_reach(labels) as closed:
        done = subprocess.run(command, env=_environment(labels), check=False, preexec_fn=_keep_out)
    if done.returncode not in (0, 1):  # 1: some cases failed and have no answer
        raise FmuidError(f"the diagnosing process ended with {done.returncode}", where=command[2], fix="see above")
    return closed


def _keep_out() -> None:
    """Give up a superuser's right to pass over file modes, for what this process becomes (Linux; else nothing)."""
    if sys.platform == "linux" and os.geteuid() == 0:
        prctl = ctypes.CDLL(None).prctl
        for capability in _PASS_OVER_MODES:
            prctl(_DROP_FROM_BOUNDING_SET, capability, 0, 0, 0)


@contextmanager
def out_of_reach(folder: Path) -> Iterator[bool]:
    """Take every permission from `folder` for a while; yields whether that keeps the diagnosing user out."""
    folder.chmod(0)
    try:
        probe = [sys.executable, "-c", "import os, sys; os.listdir(sys.argv[1])", str(folder.resolve())]
        opened = subprocess.run(probe, check=False, capture_output=True, preexec_fn=_keep_out)
        yield opened.returncode != 0 and b"PermissionError" in opened.stderr
    finally:
        folder.chmod(0o700)


def _environment(labels: Path) -> dict[str, str]:
    """Return this environment without the labels' folder and the seed, which `make` hands on in many ways."""
    return {
        k: v
        for k, v in os.environ.items()
        if k not in ("LABELS", "SEED", "MFLAGS") and "MAKE" not in k and labels.name not in v
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code."""
    from benchmarks.blind.blind_page import page

    parser = argparse.ArgumentParser(prog="python -m benchmarks.blind.blind_check", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/blind"), help="campaigns and answers")
    parser.add_argument("--labels", type=Path, required=True, help="folder of the labels, elsewhere")
    parser.add_argument("--campaign", type=Path, default=Path("campaigns/sealed"))
    parser.add_argument("--count", type=int, default=200, help="cases in the grid")
    parser.add_argument("--score", action="store_true", help="only score the cases that have an answer")
    parser.add_argument("--first", type=int, help="only the first so many of them")
    parser.add_argument("--seed", type=int, help="default: drawn, and kept with the labels")
    parser.add_argument("--workers", type=int, help="cases at the same time; one per processor by default")
    parser.add_argument("--page", type=Path, help="Markdown page to write")
    parser.add_argument("--notes", type=Path, help="Markdown sections to put on the page as they are")
    parser.add_argument("--command", default="make blind", help="what the page says it was made by")
    given = parser.parse_args(arguments)
    if given.labels.resolve().is_relative_to(Path.cwd()):
        print("error: the labels would lie where the diagnosis works; name a folder elsewhere", file=sys.stderr)
        return 2
    only = None if given.first is None else tuple(range(given.first))
    check = Check(given.out, given.labels, given.campaign, given.count, only, given.seed, given.workers)

    def work() -> Sequence[str]:
        found = check.score() if given.score else check.run()
        notes = "" if given.notes is None else given.notes.read_text(encoding="utf-8")
        text = page(found, given.command, notes)
        print(text)
        if given.page is not None:
            write_atomically(given.page, text)
        unanswered = found.made - len(found.cases)
        return [f"{counted(unanswered, 'case')} without an answer"] if unanswered else []

    return ended(work, resumes=True)


if __name__ == "__main__":
    sys.exit(main())
