"""What a file does to the process that reads it does not reach the one that asked."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from fmuid.core.errors import MeasurementsError
from fmuid.core.experiments import Measurements
from fmuid.data import isolated_reader
from fmuid.data.isolated_reader import read_isolated
from fmuid.data.measurements import read_measurements


def hang(path: Path) -> None:
    time.sleep(60)


def crash(path: Path) -> None:
    os.abort()


def die(path: Path) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def refuse(path: Path) -> None:
    raise MeasurementsError("is odd", where=path, fix="even it")


def whose(path: Path) -> int:
    return os.getpid()


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reading process finds the functions above by this module's name."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    for function in (hang, crash, die, refuse, whose, raises_from_a_library):
        monkeypatch.setattr(function, "__module__", "test_apart")
    monkeypatch.setitem(__import__("sys").modules, "test_apart", __import__("sys").modules[__name__])
    isolated_reader._end()  # one that knows the path


def test_a_file_that_hangs_or_crashes_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isolated_reader, "_WAITING", 2.0)
    with pytest.raises(MeasurementsError) as error:
        read_isolated(hang, Path("m.h5"), limit=0.5)
    assert str(error.value) == "m.h5: cannot be read in 0 s; write it again: it may be damaged"
    with pytest.raises(MeasurementsError) as error:
        read_isolated(crash, Path("m.h5"))
    assert str(error.value) == "m.h5: crashes the library that reads it; write it again: it may be damaged"
    with pytest.raises(MeasurementsError) as error:
        read_isolated(die, Path("m.h5"))
    assert str(error.value) == "m.h5: the process that reads it was killed (SIGKILL); free memory, then try again"
    with pytest.raises(MeasurementsError) as error:
        read_isolated(refuse, Path("m.h5"))
    assert str(error.value) == "m.h5: is odd; even it"


def test_one_process_serves_all() -> None:
    first = read_isolated(whose, Path("m.h5"))
    assert first != os.getpid()
    assert read_isolated(whose, Path("n.h5")) == first


def test_values_stay_read_only(folder: Path, measurements: Measurements) -> None:
    kept = read_measurements(folder / "measurements.h5")
    for run in kept:
        assert not run.time.flags.writeable
        assert not any(s.values.flags.writeable for s in run.signals.values())
        np.testing.assert_array_equal(run.time, measurements[run.id].time)


def test_a_module_in_the_current_folder_is_not_taken_for_a_library(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.delenv("PYTHONPATH")
    Path("h5py.py").write_text("raise SystemExit('taken')")
    assert len(read_measurements("measurements.h5")) > 0


class OfALibraryError(Exception):
    """One that pickles, but that nothing can make again from its text."""

    def __init__(self, length: int, limit: int) -> None:
        super().__init__(f"{length} is more than {limit}")


def raises_from_a_library(path: Path) -> None:
    """Fail as libraries do where another one has taught errors to take along what they came from."""
    from tblib import pickling_support

    pickling_support.install(MeasurementsError)
    try:
        raise OfALibraryError(9, 3)
    except OfALibraryError as error:
        raise MeasurementsError(f"cannot be read ({error})", where=path) from None


def test_an_error_comes_over_without_what_it_came_from(tmp_path: Path) -> None:
    with pytest.raises(MeasurementsError, match=r"cannot be read \(9 is more than 3\)"):
        read_isolated(raises_from_a_library, tmp_path)
