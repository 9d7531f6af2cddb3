"""docs/formats.md: its blocks are run as they stand."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from fmuid.campaign_toml import load_campaign

GUIDE = (Path(__file__).parents[2] / "docs" / "formats.md").read_text()


def test_the_blocks_of_the_guide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (python,) = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)
    (toml,) = re.findall(r"```toml\n(.*?)```", GUIDE, re.DOTALL)
    exec(compile(python, "docs/formats.md", "exec"), {})
    Path("campaign.toml").write_text(toml)
    campaign = load_campaign(tmp_path)
    assert campaign.identification == ("step_0p5", "step_0p5_r1")
    assert campaign.validation == ("prbs_0p5",)
    assert campaign.stages["linear"].free == ("d_S", "lossTable[2,4]")
