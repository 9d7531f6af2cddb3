"""Diagnose plants of rigs that are no actuator, from plain models and logs: ``python -m benchmarks.abroad``."""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

from benchmarks.abroad.case import Outcome, diagnose
from benchmarks.abroad.rigs import FOUND_ON


def main() -> None:
    """Print a table, and write it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rig", action="append", help="name of a rig, all by default")
    parser.add_argument("--effect", action="append", help="id of an effect or 'none', all by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, help="folder for the cases; a temporary one by default")
    parser.add_argument("--json", type=Path, help="write the outcomes here")
    given = parser.parse_args()
    found: list[Outcome] = []
    with tempfile.TemporaryDirectory() as scratch:
        for rig in (r for r in FOUND_ON if not given.rig or r.name in given.rig):
            for truth in (t for t in ("none", *rig.effects) if not given.effect or t in given.effect):
                folder = (given.out or Path(scratch)) / f"{rig.model}-{truth.replace('@', '-at-')}-{given.seed}"
                found.append(diagnose(rig, truth, folder, seed=given.seed, repeats=given.repeats))
                print(line(found[-1]), flush=True)
    known = [o for o in found if o.truth != "none"]
    print(f"candidate in {sum(o.listed for o in known)}, named in {sum(o.right for o in known)} of {len(known)}")
    if given.json is not None:
        given.json.write_text(json.dumps([o.to_dict() for o in found], indent=2) + "\n")


def line(o: Outcome) -> str:
    """Return a row of the table."""
    closure = "    " if o.closure is None else f"{o.closure:4.2f}"
    mark = "right" if o.right else "listed" if o.listed else "absent"
    said = f"{o.kind}: {', '.join(o.named)}"
    return f"{o.rig:14} {o.truth:22} {mark:6} {closure} {o.candidates:4} {o.seconds:5.1f} s  {said}"


if __name__ == "__main__":
    main()
