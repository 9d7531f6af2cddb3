"""A command whose n-th operation on a file fails: one line of JSON for each n.

`LD_PRELOAD=failing_writes.so python every_write.py FMU FOLDER identify|diagnose short|full-once|full|broken STEP`:
every so many n. The first line is of the run that nothing happens to.
"""

import ctypes
import io
import json
import os
import pickle
import shutil
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).parent))
import test_survival

from fmuid.cli.app import run
from fmuid.report.plots import draw
from fmuid.report.plots.figure_data import Figure

HOW = {"short": 1, "full-once": 2, "full": 3, "broken": 4}


def ended(arguments: Sequence[str], log: Path, below: Path, at: int, how: str) -> int:
    """Run a command in a process of its own, and return its exit code; `said` gets what it says."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    with log.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    arm = ctypes.CDLL(None).failing_writes_arm
    arm.argtypes, arm.restype = (ctypes.c_char_p, ctypes.c_long, ctypes.c_int), ctypes.c_long
    arm(str(below).encode(), at, HOW[how])
    code = run(arguments)
    sys.stdout.flush()
    sys.stderr.flush()
    log.with_suffix(".count").write_text(str(arm(b"", 0, 0)))
    os._exit(code)


def every(
    kind: type[test_survival.Identification | test_survival.Diagnosis], bench: Path, how: str, step: int
) -> None:
    """Run the command unharmed, then with every so many operations failing, each in a process of its own."""
    log, out = bench.parent / "said.txt", bench / "run"
    last, at = 0, 0
    while at <= last:
        code = ended(kind.arguments(bench), log, out, at, how)
        line = {"at": at, "code": code, "said": log.read_text()}
        if at == 0:
            last = int(log.with_suffix(".count").read_text())
        if code:
            again = ended([*kind.arguments(bench), "--resume"], log, out, 0, how)
            line["again"] = 0 if "the run is complete" in log.read_text() else again
        line["found"] = [sorted(kind.outcome(bench)[0]), kind.outcome(bench)[1]]
        print(json.dumps(line), flush=True)
        shutil.rmtree(out)
        at += 1 if at == 0 else step


def drawn_once() -> Callable[[Figure, str], bytes]:
    """Return a drawing of figures that remembers them."""
    known: dict[bytes, bytes] = {}
    draw_anew = draw.drawn

    def drawn(figure: Figure, format: str) -> bytes:
        key = pickle.dumps((figure, format))
        if key not in known:
            known[key] = draw_anew(figure, format)
        return known[key]

    return drawn


def main() -> None:
    fmu, folder, how, step = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[4], int(sys.argv[5])
    kind = {"identify": test_survival.Identification, "diagnose": test_survival.Diagnosis}[sys.argv[3]]
    bench = kind.campaign(fmu, folder / "bench")
    # What is imported and drawn here is not imported and drawn by each child: this is about files.
    with mock.patch.object(draw, "drawn", drawn_once()):
        with redirect_stdout(io.StringIO()):
            run(kind.arguments(bench))
        shutil.rmtree(bench / "run")
        every(kind, bench, how, step)


if __name__ == "__main__":
    main()
