"""Diagnose rigs whose models are FMUs without source, and score the answers.

``python -m tests.foreign_fmus OUT [--only PATTERN] [--fmi 2|3] [--source] [--seed N]`` writes an answer for each case
to ``OUT/answers.jsonl`` and continues where it was interrupted. The yardstick is `--source`: the same models in Modelica.
"""

from __future__ import annotations

import argparse
import fnmatch
import json
import re
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from fmuid.cli.app import run
from tests.foreign_fmus.gaps import GAPS
from tests.foreign_fmus.plants import plant_fmu, write_logs

SOURCE = Path(__file__).with_name("Plants.mo")
_RUNS, _REPEATS, _SAMPLES = 4, 3, 250


@dataclass(frozen=True)
class Answer:
    """What a diagnosis says of a rig; `place` and `law` say whether these are right, and nothing else is named."""

    rig: str
    truth: str
    kind: str
    named: tuple[str, ...]
    place: bool
    law: bool
    seconds: float


def diagnosed(rig: str, truth: str, folder: Path, fmi: int = 2, seed: int = 0, source: bool = False) -> Answer:
    """Record a rig, diagnose it with the FMU alone or with its source, and compare the answer with the truth."""
    logs = write_logs(rig, GAPS[rig][truth], folder / "logs", _RUNS, _REPEATS, _SAMPLES, seed)
    campaign, out = folder / "campaign", folder / "out"
    model = [str(SOURCE), "--class", f"Plants.{rig.title()}"] if source else [str(plant_fmu(rig, folder, fmi))]
    begun = time.process_time()
    alone = ["--workers", "0", "--quiet"]
    code = run(["init", *map(str, logs), "--model", *model, "--out", str(campaign), *alone])
    code = code or run(["diagnose", str(campaign), "--out", str(out), *alone])
    seconds = round(time.process_time() - begun, 1)
    if code:
        return Answer(rig, truth, "error", (), False, False, seconds)
    verdict = json.loads((out / "diagnosis.json").read_text())["verdict"]
    named = tuple(dict.fromkeys([*verdict["effects"], *(n for one in verdict["one_of"] for n in one)]))
    law, port = truth.split("@")
    if source:  # the balance of the equation whose state it is
        port = re.sub(r"der\((\w+)\)", r"\1.balance", port)
    places = {n.partition("@")[2] for n in named} if named else set(verdict["ports"])
    place = verdict["kind"] != "complete" and places == {port}
    return Answer(rig, truth, verdict["kind"], named, place, place and f"{law}@{port}" in named, seconds)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", default="*", help="pattern of rig/effect")
    parser.add_argument("--fmi", type=int, default=2, choices=(2, 3))
    parser.add_argument("--source", action="store_true", help="diagnose the models' Modelica source")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    file = given.out / "answers.jsonl"
    rows = [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []
    for rig, effects in GAPS.items():
        for truth in effects:
            known = any((row["rig"], row["truth"]) == (rig, truth) for row in rows)
            if known or not fnmatch.fnmatch(f"{rig}/{truth}", given.only):
                continue
            with tempfile.TemporaryDirectory(dir=given.out) as folder:
                rows.append(asdict(diagnosed(rig, truth, Path(folder), given.fmi, given.seed, given.source)))
            with file.open("a") as lines:
                lines.write(json.dumps(rows[-1]) + "\n")
            print(rows[-1], flush=True)
    for rig in (*GAPS, ""):
        of_rig = [row for row in rows if rig in ("", row["rig"])]
        if of_rig:
            place, law = (sum(row[what] for row in of_rig) / len(of_rig) for what in ("place", "law"))
            print(f"{rig or 'all'}: {len(of_rig)} cases, place {place:.2f}, law {law:.2f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
