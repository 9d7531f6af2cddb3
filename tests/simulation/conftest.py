from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from fmus import make_oscillator


@pytest.fixture(scope="session")
def build(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Build a test FMU, each kind once: see fmus.make_oscillator."""
    return functools.cache(functools.partial(make_oscillator, tmp_path_factory.mktemp("fmus")))
