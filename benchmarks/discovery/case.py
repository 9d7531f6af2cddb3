"""One case: logs of a plant with a law of its own, and a campaign made of them and of the plain model."""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.discovery.laws import course, late, law, oscillator
from benchmarks.rigs.logs import Recording, drawn_factors, write_logs
from benchmarks.rigs.plant import Extra, Rig
from benchmarks.rigs.rigs import FOUND_ON
from benchmarks.rigs.shaker import SHAKER
from fmuid.cli.app import run

_LISTS = [Path(__file__).parent / name for name in ("cases.toml", "shaker.toml", "unseen.toml")]
_RIGS = {rig.name: rig for rig in (*FOUND_ON, SHAKER)}


@dataclass(frozen=True)
class Case:
    """A plant: its number, which is its seed as well, and its table in the list."""

    number: int
    expressible: bool
    table: Mapping[str, Any]

    @property
    def rig(self) -> Rig:
        return _RIGS[self.table["rig"]]

    @property
    def name(self) -> str:
        return f"{self.number:02}-{self.rig.model}-{'law' if self.expressible else 'none'}"

    def extra(self, experiment: int) -> Extra:
        """Return the law of the plant in a run."""
        table, place = self.table, self.table["place"]
        if self.expressible:
            return law(place, table["terms"], table.get("hidden"))
        if "course" in table:
            return course(place, **table["course"], seed=1000 * self.number + experiment)
        if "oscillator" in table:
            return oscillator(place, **table["oscillator"])
        return late(place, **table["late"])


def cases(first: int | None = None) -> tuple[Case, ...]:
    """Return the frozen lists, or their `first` expressible cases and a third as many of the others."""
    lists = [tomllib.loads(file.read_text()) for file in _LISTS]
    found = [
        (kind == "expressible", t)
        for each in lists
        for kind in ("expressible", "inexpressible")
        for t in each.get(kind, ())
    ]
    every = [Case(k, expressible, table) for k, (expressible, table) in enumerate(found)]
    parts = [c for c in every if c.expressible], [c for c in every if not c.expressible]
    most = (first, None if first is None else -(-first // 3))
    return tuple(c for part, count in zip(parts, most, strict=True) for c in part[:count])


def make_campaign(case: Case, folder: Path, *, repeats: int = 3) -> Path:
    """Write the logs of a plant into a folder, and the campaign of them and the plain model."""
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    rig = case.rig
    extras = {name: case.extra(k) for k, name in enumerate(rig.inputs)}
    rng = np.random.default_rng(case.number)
    logs = write_logs(rig, drawn_factors(rig, rng), {}, folder, Recording(repeats), rng, extras=extras)
    campaign = folder / "campaign"
    model = ["--model", str(rig.file), "--class", rig.model]
    code = run(["init", *map(str, logs), *model, "--out", str(campaign), "--workers", "0", "--quiet"])
    if code != 0:
        raise RuntimeError(f"{case.name}: fmuid init ends with {code}")
    return campaign
