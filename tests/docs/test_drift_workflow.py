"""The workflow of `docs/examples/drift`, step by step as a runner would: right, and after somebody changed the model."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "drift"
STEPS = yaml.safe_load((EXAMPLE / "drift.yml").read_text())["jobs"]["drift"]["steps"]


def runs(folder: Path) -> tuple[bool, str]:
    """Run the job in a fresh copy of the example; return whether it succeeded, and its summary."""
    scripts = str(Path(sys.executable).parent)
    summary = folder / "summary.md"
    summary.touch()
    environment = os.environ | {
        "PATH": os.pathsep.join([scripts, os.environ["PATH"]]),
        "GITHUB_STEP_SUMMARY": str(summary),
    }
    good = True
    for step in STEPS:
        if good == (step.get("if") == "failure()"):
            continue
        if "run" not in step:
            if "upload-artifact" in step["uses"]:
                assert any((folder / step["with"]["path"]).glob("figures/*.png"))
        elif not step["run"].startswith("pip install"):
            command = ["bash", "-e", "-c", step["run"]]
            good &= subprocess.run(command, cwd=folder, env=environment, capture_output=True).returncode == 0
    return good, summary.read_text()


@pytest.mark.slow
def test_the_job_fails_when_the_model_drifts_and_says_where(tmp_path: Path) -> None:
    assert [s["run"] for s in STEPS if "run" in s and "if" not in s] == ['pip install "$FMUID"', "./check.sh"]
    shutil.copytree(EXAMPLE, tmp_path / "right")
    assert runs(tmp_path / "right") == (True, "")
    shutil.copytree(EXAMPLE, tmp_path / "changed")
    model = tmp_path / "changed" / "MyDrive.mo"
    text = model.read_text()
    model.write_text(text.replace("= 0.05", "= 0.045", 1))
    assert model.read_text() != text
    good, summary = runs(tmp_path / "changed")
    assert not good
    assert "| chirp | w |" in summary
    assert "**no**" in summary
