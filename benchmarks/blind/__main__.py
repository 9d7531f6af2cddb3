"""`python -m benchmarks.blind`: draw, diagnose, publish and verify the blind check (``docs/blind.md``).

run SEED      draw cases, diagnose each in a process of its own that knows nothing of its label; continues
publish SEED  write what is committed of a seed: `benchmarks/blind/published/<seed>/`
page          write docs/blind.md, and a page on every case of a seed, from what is published
calibrate SEED ...  fit the shipped calibration to the published cases of seeds
agreement SEED  compare random rigs with their models, before any diagnosis
verify        recompute the page from what is committed, and logs and labels of some cases from their seeds
"""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

from scipy.special import expit, logit

from benchmarks.blind.agreement import disagreements
from benchmarks.blind.plants.cases import CHECK, REHEARSAL, STRATA, draw_case, measured, numbers, write_case
from benchmarks.blind.plants.grammar import VERSION
from benchmarks.blind.plants.network import DivergedError
from benchmarks.blind.score import in_words
from benchmarks.study_command import ended

PUBLISHED = Path(__file__).with_name("published")
_SAME_GAP = 0.02  # of a gap: how far refits may end apart on other processors
PAGE = Path(__file__).parents[2] / "docs" / "blind.md"


def answered(seed: int, number: int, work: Path, labels: Path, limit: float) -> str:
    """Draw a case, diagnose it unless that was done, and return a line on it."""
    name = f"c{number:04d}"
    folder, out, label = work / "cases" / name, work / "answers" / name, labels / f"{name}.json"
    if not label.is_file():
        case = draw_case(seed, number)
        hashes = write_case(case, folder)
        _write(label, {**case.label, "sha256": hashes})
    record = out / "record.json"
    if not record.is_file():
        shutil.rmtree(out, ignore_errors=True)  # of a diagnosis that was interrupted
        out.mkdir(parents=True)
        command = [sys.executable, "-m", "benchmarks.blind.diagnose", str(folder), str(out), f"{limit:.0f}"]
        begun = time.monotonic()
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if not record.is_file():
            late = done.returncode in (-signal.SIGXCPU, -signal.SIGKILL)
            message = f"no answer in {limit:g} s of processor time" if late else done.stderr.strip()[-600:]
            _write(record, {"diagnose": done.returncode, "said": message, "elapsed": time.monotonic() - begun})
    answer = json.loads(record.read_text())
    return f"{name}: {_words(answer)}  ({answer.get('seconds', answer['elapsed']):.0f} s)"


def _words(record: dict[str, Any]) -> str:
    return in_words(record["answer"]) if "answer" in record else f"no answer: {record.get('said', '')[-160:]}"


def _write(file: Path, value: Any) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    scratch = file.with_suffix(".part")
    scratch.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
    scratch.replace(file)


def _lines(values: Iterable[Any]) -> str:
    return "".join(json.dumps(v, separators=(",", ":")) + "\n" for v in values)


def publish(seed: int, work: Path, labels: Path) -> Path:
    """Write what is published of a seed, up to the first case that was not diagnosed, and return the folder."""
    target = PUBLISHED / str(seed)
    target.mkdir(parents=True, exist_ok=True)
    made, records = [], []
    for file in sorted(labels.glob("c*.json")):
        record = work / "answers" / file.stem / "record.json"
        if not record.is_file():
            break
        made.append(json.loads(file.read_text()))
        records.append({"case": file.stem, **json.loads(record.read_text())})
    command, file = ["git", "rev-parse", "HEAD"], target / "seed.json"
    commit = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    hashes = [
        f"{digest}  {label['case']}/{name}" for label in made for name, digest in label.pop("sha256").items()
    ]
    (target / "labels.jsonl").write_text(_lines(made), encoding="utf-8")
    (target / "answers.jsonl").write_text(_lines(records), encoding="utf-8")
    (target / "logs.sha256").write_text("\n".join(hashes) + "\n", encoding="utf-8")
    _measure(target, made)
    before = json.loads(file.read_text()) if file.is_file() else {}  # how many labels may be read stays
    told = {"seed": seed, "grammar": VERSION, "commit": commit, "cases": len(made), "answers": len(records)}
    file.write_text(json.dumps(before | told, indent=1) + "\n", encoding="utf-8")
    return target


def _measure(target: Path, labels: Iterable[Mapping[str, Any]]) -> None:
    """Write what real refits leave of every case (`measured`), one line at a time; continue where that ended."""
    file = target / "measured.jsonl"
    known = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    done = {json.loads(line)["case"] for line in known}
    with file.open("a", encoding="utf-8") as lines:
        for label in (one for one in labels if one["case"] not in done):
            with suppress(DivergedError):  # of an effect without the others: the label stays as it was drawn
                case = draw_case(label["seed"], label["number"], named=False)
                lines.write(_lines([{"case": label["case"], **measured(case)}]))
            lines.flush()


def calibrate(seeds: Sequence[int]) -> None:
    """Write the shipped calibration: curves for all published cases of seeds, without those of their commits."""
    import fmuid.diagnosis
    from benchmarks.blind.page import read_published
    from fmuid.diagnosis.calibration import Calibration, Trial, fit_curves

    file = Path(fmuid.diagnosis.__file__).with_name("calibration.json")
    trials = []
    for chosen in (s for s in read_published(PUBLISHED) if s.seed in seeds):
        shown = f"{chosen.told['commit']}:src/fmuid/diagnosis/calibration.json"
        then = json.loads(subprocess.run(["git", "show", shown], capture_output=True, check=True).stdout)
        curves = Calibration(then["curves"])
        for case in (c for c in chosen.cases(0, REHEARSAL + CHECK) if c.answer and not c.label["twin_of"]):
            claimed, holds = case.claim
            several = any(len(names) > 1 for names in case.sets)
            offset, slope = curves.curve(case.kind, several=several) or (0.0, 1.0)
            weight = expit((logit(claimed) - offset) / slope) if 0.0 < claimed < 1.0 else claimed
            trials.append(Trial(case.kind, float(weight), holds, several))
    file.write_text(json.dumps(fit_curves(trials, "").to_dict(), indent=1) + "\n", encoding="utf-8")


def pages() -> dict[Path, str]:
    """Return the pages about what is published, by file."""
    from benchmarks.blind.page import CASES, case_by_case, page, read_published

    seeds = read_published(PUBLISHED)
    return {PAGE: page(seeds), **{PUBLISHED / str(s.seed) / CASES: case_by_case(s) for s in seeds}}


def write_pages() -> None:
    """Write the pages about what is published."""
    for file, text in pages().items():
        file.write_text(text, encoding="utf-8")


def _coarse(label: Mapping[str, Any]) -> Any:
    """Return a label with numbers to three digits, of which processors may differ in the last ones."""
    return json.loads(json.dumps(label), parse_float=lambda digits: f"{float(digits):.3g}")


def verify(count: int) -> list[str]:
    """Recompute the committed page, and logs and labels of some cases; return one line for each difference."""
    import tempfile

    from benchmarks.blind.page import read_published

    wrong = [
        f"{file} is not what the published labels and answers give"
        for file, text in pages().items()
        if not file.is_file() or file.read_text(encoding="utf-8") != text
    ]
    for seed in read_published(PUBLISHED):
        if seed.told["grammar"] != VERSION:
            print(f"seed {seed.seed}: drawn by grammar {seed.told['grammar']}, at commit {seed.told['commit']}")
            continue
        hashes: dict[str, dict[str, str]] = {}
        for line in (PUBLISHED / str(seed.seed) / "logs.sha256").read_text().split("\n")[:-1]:
            digest, _, path = line.partition("  ")
            case, _, name = path.partition("/")
            hashes.setdefault(case, {})[name] = digest
        labels = {label["case"]: label for label in seed.labels}
        chosen = sorted(hashes)[:: max(len(hashes) // count, 1)][:count] if count else []
        for name in chosen:
            with tempfile.TemporaryDirectory() as folder:
                case = draw_case(seed.seed, int(name[1:]))
                if write_case(case, Path(folder)) != hashes[name]:
                    wrong.append(
                        f"seed {seed.seed}: the logs of {name} are not those that its hashes were published of"
                    )
                if _coarse(case.label) != _coarse({k: labels[name][k] for k in case.label}):
                    wrong.append(f"seed {seed.seed}: the label of {name} is not what the seed gives")
                if abs(measured(case)["gap"] / seed.measured[name]["gap"] - 1.0) > _SAME_GAP:
                    wrong.append(f"seed {seed.seed}: the gap of {name} is not what the seed gives")
        print(
            f"seed {seed.seed}: {len(seed.labels)} cases, logs and labels of {len(chosen)} made again", flush=True
        )
    return wrong


def main() -> int:
    """Run the command; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.blind",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("run", "publish"):
        one = commands.add_parser(name)
        one.add_argument("seed", type=int)
        one.add_argument("--work", type=Path, help="default: runs/blind/<seed>")
        one.add_argument("--labels", type=Path, required=True, help="folder of the labels, elsewhere")
        if name == "run":
            one.add_argument("--first", type=int, default=0)
            one.add_argument("--count", type=int, default=REHEARSAL + CHECK)
            one.add_argument("--only", metavar="STRATUM", choices=STRATA, help="count only cases of one stratum")
            one.add_argument("--workers", type=int, default=1)
            one.add_argument("--time-limit", type=float, default=300.0, help="processor time of a case, s")
    commands.add_parser("page")
    commands.add_parser("calibrate").add_argument("seed", type=int, nargs="+")
    agreement = commands.add_parser("agreement")
    agreement.add_argument("seed", type=int)
    agreement.add_argument("--count", type=int, default=50)
    commands.add_parser("verify").add_argument("--regenerate", type=int, default=5, help="cases of each seed")
    given = parser.parse_args()

    def work() -> list[str]:
        if given.command == "page":
            write_pages()
            return []
        if given.command == "calibrate":
            calibrate(given.seed)
            return []
        if given.command == "verify":
            return verify(given.regenerate)
        if given.command == "agreement":
            return disagreements(given.seed, given.count)
        folder = given.work or Path("runs/blind") / str(given.seed)
        labels = given.labels / str(given.seed)
        if given.command == "publish":
            print(publish(given.seed, folder, labels))
            return []
        failed = []

        def one(number: int) -> None:
            try:
                print(answered(given.seed, number, folder, labels, given.time_limit), flush=True)
            except DivergedError as error:
                failed.append(f"c{number:04d}: {error}")

        with ThreadPoolExecutor(given.workers) as pool:
            list(pool.map(one, numbers(given.seed, given.first, given.count, given.only)))
        return failed

    return ended(work, resumes=True)


if __name__ == "__main__":
    sys.exit(main())
