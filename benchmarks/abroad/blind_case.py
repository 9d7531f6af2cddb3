"""`python -m benchmarks.abroad.blind_case FOLDER`: the diagnosing process of the check abroad.

It knows logs, plain models and how to call ``fmuid init``, and nothing of the labels.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.study_command import ended
from fmuid.core.errors import FmuidError
from fmuid.core.files import write_atomically

ORDER = "order.json"


def campaign_of(order: Path) -> Path:
    """Return the campaign that ``fmuid init`` makes of a case's logs and model; made at the first time."""
    from fmuid.cli.app import run

    folder = order.parent / "campaign"
    if not (folder / "campaign.toml").is_file():
        given = json.loads(order.read_text())
        logs = [str(order.parent / name) for name in given["logs"]]
        sigmas = [word for name, value in given["sigmas"].items() for word in ("--sigma", f"{name}={value!r}")]
        model = ["--model", str(order.parent / given["model"]), "--class", given["class"]]
        code = run(["init", *logs, *model, *sigmas, "--out", str(folder), "--workers", "0", "--quiet"])
        if code != 0:
            raise FmuidError(f"fmuid init ended with {code}", where=order.parent, fix="see above")
    return folder


def diagnose_blind(_: Path | None, order: Path, target: Path) -> str:
    """Diagnose one case as ``fmuid init`` and ``fmuid diagnose`` would; write it, return the verdict in words."""
    from benchmarks.sealed import verdict_in_words
    from fmuid.campaigns.campaign_toml import load_campaign
    from fmuid.diagnosis_pipeline import answer_of, diagnose

    begin = _seconds()
    try:
        campaign = load_campaign(campaign_of(order))
        answer = answer_of(diagnose(campaign, workers=0, law=False))
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:  # the program's fault
        said = f"{type(error).__name__}: {error}"
        raise FmuidError(said, where=order.parent, fix="mend the program; the case has no answer") from error
    free = [name for name, p in campaign.parameters.items() if p.free]
    whole = {**answer, "free": free, "seconds": _seconds() - begin}
    write_atomically(target, json.dumps(whole, indent=1, allow_nan=False) + "\n")
    return verdict_in_words(answer)


def _seconds() -> float:
    """Return the processor time spent so far, that of compilers included."""
    return sum(os.times()[:4])


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose every case that has no answer yet; return the exit code."""
    from benchmarks.sealed import diagnose_folder

    parser = argparse.ArgumentParser(prog="python -m benchmarks.abroad.blind_case", description=__doc__)
    parser.add_argument("folder", type=Path, help=f"holds NAME/{ORDER}")
    parser.add_argument("--out", type=Path, required=True, help="for NAME.json")
    parser.add_argument("--workers", type=int)
    given = parser.parse_args(arguments)
    return ended(
        lambda: diagnose_folder(
            given.folder, None, given.out, workers=given.workers, diagnose=diagnose_blind, file=ORDER
        ),
        resumes=True,
    )


if __name__ == "__main__":
    sys.exit(main())
