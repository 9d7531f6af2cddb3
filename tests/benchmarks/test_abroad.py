"""Rigs other than actuators: a diagnosis from logs and a plain model alone."""

from __future__ import annotations

import pytest

from tests.known_rigs.case import diagnose
from tests.known_rigs.rigs import FOUND_ON

BY_NAME = {rig.name: rig for rig in FOUND_ON}


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.mark.slow
def test_what_a_plain_model_lacks_is_named_from_logs_alone(tmp_path):
    scored = diagnose(BY_NAME["thermal block"], "radiation@casing", tmp_path / "case", repeats=2)
    assert scored.right, scored
    assert scored.closure is not None
    assert scored.closure > 0.8
