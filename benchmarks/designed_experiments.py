"""Does a designed run settle what it says it will? ``python -m benchmarks.designed_experiments FOLDER``.

Plants of the rigs that rules are found on have an effect that another one resembles, and are driven weakly.
Where their diagnosis ends with "A or B", `fmuid design` looks for the run that settles it within the rig's
full range; the case's own plant plays it once, and the campaign with that run is diagnosed again. Where the
design says that no run settles it, one of the rig's own runs at full size is also tried. Left out are
cases that a diagnosis settles at once, and those whose answers are the same by physics.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.rigs.case import diagnose
from benchmarks.rigs.gap import SizedPlant
from benchmarks.rigs.logs import Recording, drawn_factors, write_logs
from benchmarks.rigs.plant import Floats, Rig
from benchmarks.rigs.rehearsal_rigs import REHEARSED_ON
from fmuid.cli.app import run

_WEAK = 0.3  # of the rig's own inputs, in the runs that are diagnosed first
_GAPS = (0.7, 3.0)  # noise floors that the effect leaves there
REPEATS = 2
_MARGIN = 0.3  # of what the rig's outputs do at full size: how far a designed run may go beyond


def main() -> None:
    """Make and judge cases until there are enough; what is in the folder already is not made again."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cases", type=int, default=40, help="ambiguous ones")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(20)))
    parser.add_argument("--workers", type=int, help="cases at the same time; one per processor by default")
    given = parser.parse_args()
    found: list[dict[str, Any]] = []
    with ProcessPoolExecutor(given.workers) as pool:
        for judged in pool.map(_judged, draws(given.seeds), repeat(given.folder)):
            if judged is not None:
                found.append(judged)
                print(line(judged), flush=True)
            if len(found) == given.cases:
                pool.shutdown(wait=False, cancel_futures=True)
                break
    print("\n".join(summary(found)))


def draws(seeds: list[int]) -> Iterator[tuple[str, str, int]]:
    """Yield rig, effect and seed of every case that may be ambiguous: the effect has rivals."""
    for seed in seeds:
        for rig in REHEARSED_ON:
            for truth in rig.near:
                yield rig.name, truth, seed


def _judged(drawn: tuple[str, str, int], folder: Path) -> dict[str, Any] | None:
    name, truth, seed = drawn
    return case(next(rig for rig in REHEARSED_ON if rig.name == name), truth, seed, folder)


def _sized(rig: Rig, truth: str, seed: int) -> tuple[Rig, dict[str, Floats]]:
    """Return the rig with the effect at the size of the case, and the inputs of the weak runs."""
    names = list(rig.inputs)
    weak = {n: _WEAK * rig.inputs[n] for n in (names[(seed + i) % len(names)] for i in (0, 1))}
    factors = drawn_factors(rig, np.random.default_rng(seed))  # as `diagnose` draws them
    gap = float(np.exp(np.random.default_rng([seed, 2]).uniform(*np.log(_GAPS))))
    effect, _ = SizedPlant(replace(rig, inputs=weak), factors).sized(rig.effects[truth], gap)
    return replace(rig, effects={truth: effect}), weak


def case(rig: Rig, truth: str, seed: int, folder: Path) -> dict[str, Any] | None:
    """Return the outcome of a case; None if its first diagnosis is not ambiguous."""
    place = folder / f"{rig.model}-{truth.replace('@', '-at-')}-{seed}"
    rig, weak = _sized(rig, truth, seed)
    first = place / "outcome.json"
    if not first.is_file():
        outcome = diagnose(replace(rig, inputs=weak), truth, place, seed=seed, repeats=REPEATS)
        first.write_text(json.dumps(outcome.to_dict()))
    if json.loads(first.read_text())["kind"] != "ambiguous":
        return None
    before = json.loads((place / "diagnosis" / "diagnosis.json").read_text())["verdict"]
    answers = [(*before["effects"], *others) for others in before["one_of"]]
    alike = {truth, *rig.same.get(truth, ())}
    if {n for names in answers for n in names} <= alike:
        return None
    _limit(rig, place / "campaign" / "campaign.toml")
    design = ["design", str(place / "diagnosis"), "--for", "diagnosis", "--out", str(place / "design")]
    made = (place / "design" / "design.json").is_file()
    if not made and run([*design, "--evaluations", "100", "--workers", "0", "--quiet"]) != 0:
        return None
    answer = json.loads((place / "design" / "design.json").read_text())
    time, u = np.loadtxt(place / "design" / "input.csv", delimiter=",", skiprows=1, unpack=True)
    after = _again(rig, truth, seed, place, "designed", time, u)
    pairs = [
        {
            "between": pair["between"],
            "predicted": pair["separation_sigma"],
            "apart": _apart(after, *map(set, pair["between"])),
        }
        for pair in answer["pairs"]
    ]
    right = [a for a in answers if set(a) & alike]
    others = {}
    if answer["hopeless"]:
        name = next(n for n in rig.inputs if not list(place.glob(f"{n}_*.csv")))
        full = np.array(rig.inputs[name])
        full[[0, -1]] = u[0]  # from rest and back, as designed ones
        own = _again(rig, truth, seed, place, "at_full_size", rig.time, full)
        others = {"by": name, "verdict": own["verdict"], "settled": _one_left(own, answers)}
    return {
        "rig": rig.name,
        "truth": truth,
        "seed": seed,
        "answers": answers,
        "holds_truth": bool(right),
        "predicted": answer["separation_sigma"],
        "settles": answer["settled"],
        "hopeless": answer["hopeless"],
        "chance": max((c["alone"] for c in answer["chances"] if set(c["right"]) & alike), default=None),
        "pairs": pairs,
        "after": after["verdict"]["kind"],
        "named": _named(after),
        "settled": _one_left(after, answers),
        "alone": len(_named(after)) == 1,
        "truth_kept": any(set(a) & alike for a in _named(after)),
        "own_run": others,
    }


def _limit(rig: Rig, campaign: Path) -> None:
    """Write the rig's full range into the campaign."""
    name, *outputs = rig.signals
    full = np.stack(list(rig.inputs.values()))
    seen = np.concatenate(
        [rig.simulate(dict.fromkeys(rig.parameters, 1.0), {}, rig.time, u) for u in full], axis=1
    )
    lines = ["[limits]", f"duration = {float(rig.time[-1])!r}"]
    lines.append(f"{name} = {{ min = {float(full.min())!r}, max = {float(full.max())!r} }}")
    for output, y in zip(outputs, seen, strict=True):
        margin = _MARGIN * float(np.ptp(y))
        lines.append(f"{output} = {{ min = {float(y.min()) - margin!r}, max = {float(y.max()) + margin!r} }}")
    text = campaign.read_text()
    if "[limits]" not in text:
        campaign.write_text("\n".join([text, *lines, ""]))


def _again(rig: Rig, truth: str, seed: int, place: Path, name: str, time: Floats, u: Floats) -> dict[str, Any]:
    """Have the case's plant play a run, and diagnose the campaign with it."""
    folder = place / name
    found = folder / "diagnosis" / "diagnosis.json"
    if found.is_file():
        known: dict[str, Any] = json.loads(found.read_text())
        return known
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    factors = drawn_factors(rig, np.random.default_rng(seed))  # as `diagnose` draws them
    played = replace(rig, inputs={name: u}, time=time)
    noise = np.random.default_rng([seed, 1])
    made = write_logs(played, factors, rig.effects.get(truth, {}), folder, Recording(1), noise)
    logs = [*sorted(place.glob("*.csv")), *made]
    model = ["--model", str(rig.file), "--class", rig.model, "--workers", "0", "--quiet"]
    run(["init", *map(str, logs), *model, "--out", str(folder / "campaign")])
    toml = folder / "campaign" / "campaign.toml"
    text = re.sub(r"(?m)^identification = .*$", 'identification = ["*"]', toml.read_text())
    toml.write_text(re.sub(r"(?m)^validation = .*$", "validation = []", text))
    run(
        ["diagnose", str(folder / "campaign"), "--out", str(found.parent), "--no-law", "--workers", "0", "--quiet"]
    )
    answer: dict[str, Any] = json.loads(found.read_text())
    return answer


def _named(answer: Mapping[str, Any]) -> list[list[str]]:
    """Return the answers that a diagnosis leaves open."""
    verdict = answer["verdict"]
    if verdict["kind"] == "ambiguous":
        return [[*verdict["effects"], *others] for others in verdict["one_of"]]
    return [verdict["effects"]] if verdict["effects"] else []


def _one_left(answer: Mapping[str, Any], before: Sequence[Sequence[str]]) -> bool:
    """Return whether a diagnosis has one answer alone, or one of those `before`, and tells it from the others.

    A run that shows more may raise another question than the one that it was designed for.
    """
    named = [set(n) for n in _named(answer)]
    kept = named if len(named) == 1 else [set(b) for b in before if any(set(b) <= n for n in named)]
    if len(kept) != 1 or not all(kept[0] <= n for n in named):
        return False
    others = {n for names in before for n in names} - kept[0]
    return not any(set(c) & kept[0] and set(c) & others for c in answer["alias_classes"])


def _apart(answer: Mapping[str, Any], a: set[str], b: set[str]) -> bool:
    """Return whether a diagnosis no longer has both of two answers."""
    named = [set(n) for n in _named(answer)]
    return not (any(a <= n for n in named) and any(b <= n for n in named))


def line(judged: Mapping[str, Any]) -> str:
    """Return a row of the table."""
    if judged["hopeless"]:
        says = "no run settles"
    elif judged["settles"]:
        says = f"{judged['predicted']:6.2f} sigma"
    else:
        says = "chance " + ("of others" if judged["chance"] is None else f"{judged['chance']:.2f}")
    end = "settled" if judged["settled"] else judged["after"]
    kept = "truth kept" if judged["truth_kept"] else "truth lost" if judged["holds_truth"] else "truth not among"
    own = f", own run {'settles' if judged['own_run']['settled'] else 'neither'}" if judged["own_run"] else ""
    case = f"{judged['rig']:14} {judged['truth']:22} {judged['seed']:2}"
    return f"{case} {says:14} {end:10} {kept}{own}"


def summary(found: list[dict[str, Any]]) -> list[str]:
    """Return a summary of the cases."""
    rows = [f"{len(found)} ambiguous cases, the truth among the answers of {sum(f['holds_truth'] for f in found)}"]
    perhaps = [f for f in found if not f["settles"] and not f["hopeless"] and f["chance"] is not None]
    for words, own in (
        ("settled whichever answer is right", [f for f in found if f["settles"]]),
        ("settled with a probability of at least 0.9", [f for f in perhaps if f["chance"] >= 0.9]),
        ("settled with a lower probability", [f for f in perhaps if f["chance"] < 0.9]),
    ):
        settled = [f for f in own if f["settled"]]
        kept = sum(f["truth_kept"] for f in settled)
        alone = sum(f["alone"] for f in settled)
        expected = f"{sum(f['chance'] or 0.0 for f in own):.1f} expected, "
        rows.append(
            f"predicted to be {words}: {len(own)}; {expected}settled {len(settled)}, with the truth left {kept}; "
            f"no other question left {alone}"
        )
    hopeless = [f for f in found if f["hopeless"]]
    right = sum(not f["settled"] and not f["own_run"]["settled"] for f in hopeless)
    rows.append(f"no run settles {len(hopeless)} by the design: right in {right}")
    return rows


if __name__ == "__main__":
    main()
