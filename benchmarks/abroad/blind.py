"""`python -m benchmarks.abroad.blind`: make the grid of the check abroad, diagnose it blind, score it.

Seed and code decide every case: the SHA-256 of the seed, that of the list of effects outside every catalogue and
the commit of the code go into a file that is committed (``--freeze`` ends there). Then labels are found and
hashed, logs are written, and another process diagnoses them while nobody can open the labels. Everything goes on
where it was interrupted.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.abroad.blind_case import ORDER, campaign_of
from benchmarks.abroad.check_rigs import CHECKED_ON, OUTSIDE
from benchmarks.abroad.grid import COUNT, Case, label, plan
from benchmarks.abroad.logs import UNITS, write_logs
from benchmarks.abroad.plant import Rig
from benchmarks.abroad.rehearsal_rigs import REHEARSED_ON
from benchmarks.abroad.score import Abroad, scored
from benchmarks.blind.blind_check import checked_labels, diagnosed_apart, out_of_reach
from benchmarks.study_command import ended
from benchmarks.virtual_rig.blind import DIGEST, LABELS, kept_seed
from fmuid.core.errors import FmuidError, SimulationError
from fmuid.core.files import write_atomically
from fmuid.core.formatting import counted

FROZEN = Path(__file__).with_name("frozen.json")
_SPARE = """
model {model}WithSpare "Two stores at rest that nothing else touches"
  extends {model};
  connector SparePort
    Real T(unit="K");
    flow Real Q(unit="W");
  end SparePort;
  model SpareStore
    SparePort port;
    parameter Real C(unit="J/K", min=0) = 500;
    Real T(unit="K", start=300, fixed=true);
  equation
    T = port.T;
    C*der(T) = port.Q;
  end SpareStore;
  model SpareWall
    SparePort a, b;
    parameter Real G(unit="W/K", min=0) = 2;
  equation
    a.Q = G*(a.T - b.T);
    b.Q = -a.Q;
  end SpareWall;
  SpareStore spare; SpareWall between; SpareStore other;
equation
  connect(spare.port, between.a);
  connect(between.b, other.port);
end {model}WithSpare;
"""


@dataclass(frozen=True, slots=True)
class Check:
    """A check abroad: its grid and its folders.

    Attributes
    ----------
    out
        Logs, campaigns, answers and what they are worth; nothing in it tells a label.
    labels
        Labels of the whole grid, and the seed.
    frozen
        File that tells what was frozen, to be committed.
    cases
        How many of the grid to make, twins among them.
    """

    out: Path
    labels: Path
    frozen: Path = FROZEN
    cases: int | None = None
    count: int = COUNT
    seed: int | None = None
    workers: int | None = None
    rigs: Sequence[Rig] = CHECKED_ON

    @property
    def _seed(self) -> int:
        return kept_seed(self.labels) if self.seed is None else self.seed

    def _plan(self) -> tuple[Case, ...]:
        planned = plan(self._seed, self.count, self.rigs)
        return planned if self.cases is None else planned[: self.cases]

    def freeze(self) -> None:
        """Write down what is frozen; what is written already has to agree."""
        if self.labels.is_dir():
            self.labels.chmod(0o700)  # an interrupted diagnosis may have left it closed
        seed = hashlib.sha256(f"{self._seed}\n".encode()).hexdigest()
        if not self.frozen.is_file():
            frozen = {"seed": seed, "outside": _sha(OUTSIDE), "rules": _commit()}
            write_atomically(self.frozen, json.dumps(frozen, indent=1) + "\n")
        if json.loads(self.frozen.read_text())["seed"] != seed:
            raise FmuidError(
                "the seed is another than the one that was frozen",
                where=self.labels,
                fix=f"name its folder, or remove {self.frozen} to freeze a new one",
            )

    def _label(self) -> None:
        """Find the labels, keep each, and write the hash of all of them."""
        found = []
        with ThreadPoolExecutor(2) as pool:  # the plants compute outside Python's lock
            for one in pool.map(self._kept_label, self._plan()):
                found.append(one)
                if len(found) % 50 == 0:
                    print(f"{len(found)} labels", flush=True)
        write_atomically(self.labels / LABELS, json.dumps(found, indent=1, sort_keys=True) + "\n")
        write_atomically(self.out / DIGEST, f"{_sha(self.labels / LABELS)}  {LABELS}\n")

    def _kept_label(self, case: Case) -> dict[str, Any]:
        file = self.labels / "cases" / f"{case.name}.json"
        if not file.is_file():
            write_atomically(file, json.dumps(label(case, self._seed)))
        kept: dict[str, Any] = json.loads(file.read_text())
        return kept

    def run(self) -> Abroad:
        """Carry it out."""
        self.freeze()
        self._label()
        labels = checked_labels(self.labels, self.out / DIGEST)
        for case in self._plan():
            if not (self.out / "cases" / case.name / ORDER).is_file():
                try:
                    write_case(case, labels[case.name], self.out / "cases" / case.name, seed=self._seed)
                except SimulationError as error:  # in the run for validation, which did not count for its size
                    print(f"{case.name}: left out, its plant cannot be recorded: {error}", flush=True)
        answers = self.out / "answers"
        command = [sys.executable, "-m", "benchmarks.abroad.blind_case", str(self.out / "cases")]
        command += ["--out", str(answers)] + ([] if self.workers is None else ["--workers", str(self.workers)])
        return self.score(closed=diagnosed_apart(command, self.labels))

    def score(self, *, closed: bool | None = None) -> Abroad:
        """Score what has been answered; whether the labels can be closed is tried anew where that is not told."""
        if closed is None:
            with out_of_reach(self.labels) as closed:
                pass
        labels = checked_labels(self.labels, self.out / DIGEST)
        cases = {}
        for name, truth in labels.items():
            file = self.out / "answers" / f"{name}.json"
            if file.is_file():
                answer = json.loads(file.read_text())
                case = scored(truth, answer)
                if case.right and case.named and truth["twin"] is None:
                    case = scored(truth, answer, self._closure(name, answer))
                cases[name] = case
        frozen = json.loads(self.frozen.read_text())
        rules = {
            "SHA-256 of the seed": frozen["seed"],
            "SHA-256 of the list of what is outside": frozen["outside"],
            "commit of the rules": frozen["rules"],
        }
        digest = (self.out / DIGEST).read_text().split()[0]
        made = len(list((self.out / "cases").glob(f"*/{ORDER}")))
        pairs = [(labels[n]["twin_of"], n) for n in cases if labels[n]["twin"]]
        return Abroad(
            tuple(c for n, c in cases.items() if labels[n]["twin"] is None),
            tuple((cases[a], cases[b]) for a, b in pairs if a in cases),
            made, len(plan(self._seed, self.count, self.rigs)), digest, rules, closed,
        )  # fmt: skip

    def _closure(self, name: str, answer: Mapping[str, Any]) -> float | None:
        """Return what the answer's model closes of the gap on the run that the diagnosis did not see.

        None if that run shows no gap.
        """
        from fmuid.campaigns.campaign_toml import load_campaign
        from fmuid.diagnosis.cross_validation import share_closed
        from fmuid.diagnosis.observed import GAP_THAT_MATTERS
        from fmuid.diagnosis.validation import validate_diagnosis

        kept = self.out / "held_out" / f"{name}.json"
        if not kept.is_file():
            campaign = load_campaign(campaign_of(self.out / "cases" / name / ORDER))
            gaps = validate_diagnosis(answer, campaign).gaps
            write_atomically(kept, json.dumps({n: list(g) for n, g in gaps.items()}) + "\n")
        before, after = json.loads(kept.read_text())["all"]
        return share_closed(before, after) if before > GAP_THAT_MATTERS else None


def write_case(case: Case, truth: Mapping[str, Any], folder: Path, *, seed: int) -> None:
    """Write logs, model and how to call ``fmuid init``: what a user would have, and no more."""
    folder.mkdir(parents=True, exist_ok=True)
    rig, how = case.rig, case.recording
    rng = np.random.default_rng([seed, case.drawn, 1])  # a twin has the noise of its case
    logs = write_logs(rig, truth["factors"], truth["sizes"], folder, how, rng)
    idle = case.twin == "idle"
    text = rig.file.read_text() + (_SPARE.format(model=rig.model) if idle else "")
    write_atomically(folder / rig.file.name, text)
    outputs = list(rig.signals)[len(rig.signals) - len(rig.noise) :]
    scale = {n: UNITS.get(rig.signals[n], ("", 1.0))[1] if how.other_units else 1.0 for n in outputs}
    sigmas = {n: s * scale[n] / how.quieter for n, s in zip(outputs, rig.noise, strict=True)} if case.sigma else {}
    order = {
        "logs": [log.name for log in logs], "model": rig.file.name,
        "class": rig.model + "WithSpare" * idle, "sigmas": sigmas,
    }  # fmt: skip
    write_atomically(folder / ORDER, json.dumps(order, indent=1) + "\n")


def _sha(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _commit() -> str:
    """Return the commit of this code, and whether files differ from it."""
    git = ["git", "-C", str(FROZEN.parent)]
    head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    changed = subprocess.run(
        [*git, "status", "--porcelain", "--", ".", "../../src", f":!{FROZEN.name}"],
        capture_output=True,
        text=True,
        check=False,
    )
    if head.returncode != 0:
        return "unknown"
    return head.stdout.strip() + (" with changes" if changed.stdout.strip() else "")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code."""
    from benchmarks.abroad.page import page

    parser = argparse.ArgumentParser(prog="python -m benchmarks.abroad.blind", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/blind_abroad"), help="logs and answers")
    parser.add_argument("--labels", type=Path, required=True, help="folder of the labels, elsewhere")
    parser.add_argument("--frozen", type=Path, default=FROZEN, help="what was frozen, as JSON")
    parser.add_argument("--cases", type=int, help="only the first so many of the grid")
    parser.add_argument("--count", type=int, default=COUNT, help="cases in the grid, without twins")
    parser.add_argument("--seed", type=int, help="default: drawn, and kept with the labels")
    parser.add_argument("--workers", type=int, help="cases at the same time; one per processor by default")
    parser.add_argument("--freeze", action="store_true", help="draw the seed, write down what is frozen, and end")
    parser.add_argument("--rehearse", action="store_true", help="on the rigs that rules are found on")
    parser.add_argument("--score", action="store_true", help="score what has been answered, diagnose nothing")
    parser.add_argument("--page", type=Path, help="Markdown page to write")
    parser.add_argument("--notes", type=Path, help="Markdown sections to put on the page as they are")
    parser.add_argument("--command", default="make blind-abroad", help="what the page says it was made by")
    given = parser.parse_args(arguments)
    if given.labels.resolve().is_relative_to(Path.cwd()):
        print("error: the labels would lie where the diagnosis works; name a folder elsewhere", file=sys.stderr)
        return 2
    rigs = REHEARSED_ON if given.rehearse else CHECKED_ON
    frozen = given.out / FROZEN.name if given.rehearse else given.frozen
    check = Check(given.out, given.labels, frozen, given.cases, given.count, given.seed, given.workers, rigs)

    def work() -> Sequence[str]:
        if given.freeze:
            check.freeze()
            return []
        found = check.score() if given.score else check.run()
        notes = "" if given.notes is None or not given.notes.is_file() else given.notes.read_text(encoding="utf-8")
        text = page(found, given.command, notes)
        print(text)
        if given.page is not None:
            write_atomically(given.page, text)
        unanswered = found.made - len(found.cases) - len(found.pairs)
        return [f"{counted(unanswered, 'case')} without an answer"] if unanswered else []

    return ended(work, resumes=True)


if __name__ == "__main__":
    sys.exit(main())
