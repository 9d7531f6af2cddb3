"""A file system that fails at the n-th operation, for every n: one line, and with `--resume` all is there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import c_compiler

HERE = Path(__file__).parent


@pytest.fixture(scope="session")
def failing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The library that makes operations on files fail."""
    library = tmp_path_factory.mktemp("failing") / "failing_writes.so"
    source = str(HERE / "failing_writes.c")
    subprocess.run([c_compiler(), "-shared", "-fPIC", "-O1", source, "-o", str(library), "-ldl"], check=True)
    return library


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="preloads a library")
@pytest.mark.parametrize("how", ["short", "full-once", "full", "broken"])
@pytest.mark.parametrize("command", ["identify", "diagnose"])
def test_whatever_operation_fails_it_is_one_line_and_nothing_is_lost(build, failing, tmp_path, command, how):
    """`make failing-writes` tries every n: a part written, a disk full once or for good, an error of the device."""
    step = os.environ.get("FMUID_EVERY", "23")
    done = subprocess.run(
        [sys.executable, str(HERE / "every_write.py"), str(build(2)), str(tmp_path), command, how, step],
        env={**os.environ, "LD_PRELOAD": str(failing), "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    whole, *runs = map(json.loads, done.stdout.splitlines())
    assert (whole["code"], whole["said"]) == (0, "")
    for run in runs:
        if run["code"] == 0:
            assert run["said"] == "", run["at"]
        else:
            assert (run["code"], run["again"]) == (2, 0), run["at"]
            assert run["said"].startswith("fmuid: "), run["at"]
            assert run["said"].count("\n") == 1, run["at"]
        assert run["found"] == whole["found"], run["at"]
    refused = sum(run["code"] == 2 for run in runs)
    print(f"\n{command}, {how}: {len(runs)} operations, {refused} ended in one line")
    assert (refused == 0) == (how == "short")
