"""A short identification whose n-th operation on a file is its last, or fails: one line of JSON for each n.

`python broken_disk.py FOLDER killed|full STEP [interrupted]`: every so many n, and each of the last dozen. The first
line is of the run that nothing happens to.
"""

import errno
import json
import os
import sys
from contextlib import suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from conftest import msd_problem

from fmuid import FmuidError, Observer, Result, identify
from fmuid.identification.history import JOURNAL

NAMES = ("write", "fsync", "replace", "unlink")
KILLED = 9


class Stop(Observer):
    """Presses Ctrl-C at an evaluation."""

    def evaluated(self, progress):
        if progress.evaluations == 7:
            raise KeyboardInterrupt


def breaking(at, kind):
    """Have the n-th operation kill the process, or find the disk full after half of what it has to write.

    Returns how often there was one.
    """
    numbers = [0]

    def broken(operation, name):
        def call(*arguments, **options):
            numbers[0] += 1
            if numbers[0] < at:
                return operation(*arguments, **options)
            if kind == "killed":
                os._exit(KILLED)
            if name == "write":
                operation(arguments[0], arguments[1][: len(arguments[1]) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        return call

    for name in NAMES:
        setattr(os, name, broken(getattr(os, name), name))
    return numbers


def run(folder, at, kind, stopped):
    """Do it in a process of its own; return how that ended."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    numbers, code = breaking(at, kind), 0
    try:
        identify(msd_problem(), solver="trf", out=folder, observer=Stop() if stopped else None)
        Path(f"{folder}.line").write_text(str(numbers[0]))
    except FmuidError as error:
        Path(f"{folder}.line").write_text(str(error))
        code = 2
    except BaseException as error:
        Path(f"{folder}.line").write_text(repr(error))
        code = 3
    os._exit(code)


def read(folder):
    """What can be read of the run, but for the time it took."""
    with suppress(FmuidError):
        stage = Result.from_json(folder).stages[0]
        return {"parameters": stage.parameters, "cost": stage.cost, "evaluations": stage.evaluations}
    return None


def main():
    folder, kind, step, stopped = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), "interrupted" in sys.argv
    ends = [10**9]
    for at in ends:  # it grows by those of the first run
        out = folder / str(at)
        code = run(out, at, kind, stopped)
        line = Path(f"{out}.line")
        if len(ends) == 1:
            last = int(line.read_text())
            ends += sorted({*range(1, last, step), *range(max(1, last - 11), last + 1)})
        record = {"at": at, "code": code, "line": line.read_text() if line.exists() else "", "read": read(out)}
        if code or stopped:
            identify(msd_problem(), solver="trf", out=out, resume=(out / JOURNAL).exists())
        record["resumed"] = read(out)
        # A lock that nobody holds is none: the kernel's went with its process.
        record["left"] = [p.name for p in out.iterdir() if p.name not in ("result.json", "history.h5", ".lock")]
        print(json.dumps(record), flush=True)


main()
