"""One case: logs of a plant, a campaign made of them and of the plain model, and what its diagnosis says."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from fmuid.cli.app import run
from tests.known_rigs.logs import Recording, drawn_factors, write_logs
from tests.known_rigs.plant import Rig


@dataclass(frozen=True)
class Outcome:
    """What a diagnosis said of a plant.

    Attributes
    ----------
    truth
        The id of what the plant has beyond its model, ``none`` for a complete model.
    kind, named
        Of the verdict.
    listed
        Whether the truth is among the candidates.
    right
        Whether the truth alone was named, or a class that no sensor tells from it.
    closure
        On held-out runs, of the first effect named.
    candidates, seconds
        How many there are, and processor time of the diagnosis.
    """

    rig: str
    truth: str
    seed: int
    kind: str
    named: tuple[str, ...]
    listed: bool
    right: bool
    closure: float | None
    candidates: int
    seconds: float
    error: str = ""

    def to_dict(self) -> dict[str, object]:
        """Return it as JSON."""
        return asdict(self)


def diagnose(rig: Rig, truth: str, folder: Path, *, seed: int = 0, repeats: int = 3) -> Outcome:
    """Make a case in a folder and diagnose it, with nothing but the logs and the plain model."""
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    effect = rig.effects.get(truth, {})
    logs = write_logs(rig, drawn_factors(rig, rng), effect, folder, Recording(repeats), rng)
    campaign, out = folder / "campaign", folder / "diagnosis"
    begin = time.process_time()
    model = ["--model", str(rig.file), "--class", rig.model]
    code = run(["init", *map(str, logs), *model, "--out", str(campaign), "--workers", "0", "--quiet"])
    if code == 0:
        code = run(["diagnose", str(campaign), "--out", str(out), "--workers", "0", "--quiet"])
    seconds = time.process_time() - begin
    if code != 0:
        return Outcome(rig.name, truth, seed, "error", (), False, False, None, 0, seconds, f"exit code {code}")
    answer = json.loads((out / "diagnosis.json").read_text())
    return outcome(rig, truth, seed, answer, seconds)


def outcome(rig: Rig, truth: str, seed: int, answer: Mapping[str, object], seconds: float) -> Outcome:
    """Hold a diagnosis against the truth."""
    verdict, effects = answer["verdict"], answer["effects"]
    assert isinstance(verdict, dict)
    assert isinstance(effects, list)
    kind = str(verdict["kind"])
    named = tuple(dict.fromkeys([*verdict["effects"], *(n for one in verdict["one_of"] for n in one)]))
    alike = {truth, *rig.same.get(truth, ())}
    listed = truth == "none" or any(e["id"] in alike for e in effects)
    only = bool(named) and kind in ("effect", "ambiguous") and set(named) <= alike
    right = kind == "complete" if truth == "none" else only
    closure = next(
        (e["closure"]["held_out"] for e in effects if named and e["id"] == named[0] and e.get("closure")), None
    )
    return Outcome(rig.name, truth, seed, kind, named, listed, right, closure, len(effects), seconds)
