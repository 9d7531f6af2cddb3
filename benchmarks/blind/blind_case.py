"""`python -m benchmarks.blind.blind_case FOLDER`: the diagnosing process of the blind check.

It knows the campaigns and nothing of the labels: not where they are, nor the seed that made them.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.study_command import ended
from fmuid.core.files import write_atomically


def diagnose_blind(template: Path | None, measurements: Path, target: Path) -> str:
    """Diagnose one measurement file by the campaign `template`, with baselines; write it, return the verdict."""
    from benchmarks.blind.baselines import baseline_answers
    from benchmarks.sealed import verdict_in_words
    from fmuid.campaigns.campaign_toml import load_campaign
    from fmuid.diagnosis.made_catalogue import with_catalogue
    from fmuid.diagnosis_pipeline import answer_of, diagnose
    from fmuid.simulation.coupled.loading import load_simulator

    campaign = load_campaign(template or measurements.parent, measurements=measurements)
    campaign = with_catalogue(campaign, load_simulator)
    assert campaign.effects is not None
    write_atomically(target.with_suffix(".toml"), campaign.effects.file.read_text())
    found = diagnose(campaign, workers=0, law=False)
    baselines = {name: list(effects) for name, effects in baseline_answers(found).items()}
    answer = {**answer_of(found), "baselines": baselines}
    write_atomically(target, json.dumps(answer, indent=1, allow_nan=False) + "\n")
    return verdict_in_words(answer)


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose every case that has no result yet; return the exit code."""
    from benchmarks.sealed import diagnose_folder

    parser = argparse.ArgumentParser(prog="python -m benchmarks.blind.blind_case", description=__doc__)
    parser.add_argument("folder", type=Path, help="holds NAME/measurements.h5")
    parser.add_argument("--campaign", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True, help="for NAME.json")
    parser.add_argument("--workers", type=int)
    given = parser.parse_args(arguments)
    return ended(
        lambda: diagnose_folder(
            given.folder, given.campaign, given.out, workers=given.workers, diagnose=diagnose_blind
        )
    )


if __name__ == "__main__":
    sys.exit(main())
