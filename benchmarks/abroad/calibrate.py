"""`python -m benchmarks.abroad.calibrate OUT LABELS ...`: calibrate probabilities by rehearsals.

Each rehearsal (`make rehearse-abroad`) is given by its folder of answers and that of its labels. The curves that
are shipped are continued by those that map the probabilities of its verdicts to how often they were right, and the
file is written in their place.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import fmuid.diagnosis
from benchmarks.abroad.score import scored, sizeable
from benchmarks.study_command import ended
from fmuid.core.files import write_atomically
from fmuid.diagnosis.calibration import Calibration, Trial, fit_curves, shipped
from fmuid.diagnosis.summary import probability

FILE = Path(fmuid.diagnosis.__file__).with_name("calibration.json")


def trials_of(answers: Path, labels: Path) -> Iterator[Trial]:
    """Yield what each verdict claimed and whether it held; of twins, only the first.

    Cases with an effect that is not sizeable are left out, as they are in the score.
    """
    for file in sorted(labels.glob("*.json")):
        label = json.loads(file.read_text())
        found = answers / file.name
        if label["twin"] is None and found.is_file():
            answer = json.loads(found.read_text())
            case = scored(label, answer)
            if not sizeable(case):
                continue
            kind = answer["verdict"]["kind"]
            none = next(float(a["probability"]) for a in answer["answers"] if a["effects"] == ["none"])
            claimed = none if kind == "insufficient" else probability(answer)
            yield Trial(kind, claimed, case.holds)


def continued(before: Calibration, trials: Sequence[Trial]) -> Calibration:
    """Return the calibration that applies `before` and then the curves of trials made with it."""
    after = fit_curves(trials, before.source)
    curves = dict(before.curves)
    for kind, (offset, slope) in after.curves.items():
        first, steep = before.curves.get(kind, (0.0, 1.0))
        curves[kind] = (offset + slope * first, slope * steep)
    return Calibration(curves, before.trials + len(trials), before.source)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.abroad.calibrate", description=__doc__)
    parser.add_argument("folders", type=Path, nargs="+", help="pairs of folders: answers and labels of the cases")
    given = parser.parse_args(arguments)
    if len(given.folders) % 2:
        parser.error("name pairs of folders")

    def work() -> Sequence[str]:
        pairs = zip(given.folders[::2], given.folders[1::2], strict=True)
        trials = [trial for answers, labels in pairs for trial in trials_of(answers, labels)]
        calibration = continued(shipped(), trials)
        write_atomically(FILE, json.dumps(calibration.to_dict(), indent=1) + "\n")
        for kind, curve in calibration.curves.items():
            own = [t for t in trials if t.kind == kind]
            print(f"{kind:12} {len(own):4} trials, {sum(t.right for t in own)} right; curve {curve}")
        return []

    return ended(work)


if __name__ == "__main__":
    sys.exit(main())
