"""Worker processes: no FMU stops a search, and their number changes no result."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import textwrap
import threading
import time
from concurrent.futures import Executor
from pathlib import Path

import numpy as np
import pytest
from fmus import FAULTS

from fmuid.core.errors import FmuError, FmuidError, SimulationError
from fmuid.core.scratch import Scratch
from fmuid.simulation.fmu import Fmu, load_fmu
from fmuid.simulation.pool import worker_process
from fmuid.simulation.pool.remote import on_executor
from fmuid.simulation.pool.workers import WorkerPool
from fmuid.simulation.runners import in_process
from fmuid.simulation.simulator import Simulator, Task

TASK = Task(np.arange(301) * 1e-3, {"u": np.sin(np.arange(301) / 9)}, ("y", "x"))


@pytest.fixture(scope="module")
def pool():
    with WorkerPool(2, time_limit=5.0, memory_limit=200 * 2**20) as pool:
        yield pool


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("crash", r"crashed \(SIGABRT\) \(with c = 100, fault = 1\)"),
        ("segfault", r"crashed \(SIGSEGV\)"),
        ("leaves", r"crashed \(exit code 0\)"),
        ("hang", r"took longer than the time limit of 5 s"),
        ("devours", r"took more memory than the limit of 200 MB"),
        ("fatal", r"returned fmi2Fatal"),
        ("nan", r"is not finite"),
    ],
)
def test_a_bad_evaluation_costs_itself_only(build, pool, fault, message):
    fmu = load_fmu(build(2))
    good = [(fmu, TASK, {"c": 100.0 + i, "fault": 0}) for i in range(8)]
    bad = (fmu, TASK, {"c": 100.0, "fault": FAULTS[fault]})
    outcomes = pool.run([*good[:4], bad, *good[4:]])
    failed = outcomes.pop(4)
    assert isinstance(failed, SimulationError)
    assert failed.where == Path(build(2)).name
    assert re.search(message, str(failed)), failed
    for outcome, expected in zip(outcomes, in_process(good), strict=True):
        assert np.array_equal(outcome, expected)


def test_mistakes_are_raised(build, pool):
    with pytest.raises(FmuError, match="no variable 'cc'"):
        pool.run([(load_fmu(build(2)), TASK, {"cc": 1.0})])


def test_results_do_not_depend_on_the_number_of_workers(build, pool):
    # The FMU brings its process down at the 5th instantiation; a crash that is not the point's fault is tried again.
    fmu = load_fmu(build(2, defines=("TIRES=5", "RESET_FAILS")))
    jobs = [(fmu, TASK, {"c": 100.0 + i}) for i in range(12)]
    expected = in_process([(load_fmu(build(2)), *job[1:]) for job in jobs])
    for outcome, reference in zip(pool.run(jobs), expected, strict=True):
        assert np.array_equal(outcome, reference)


def test_a_reset_that_crashes_costs_no_evaluation(build):
    fmu = load_fmu(build(2, defines=("RESET_CRASHES",)))
    jobs = [(fmu, TASK, {"c": 100.0 + i}) for i in range(6)]
    expected = [Fmu(build(2)).simulate(*job[1:]) for job in jobs]
    with WorkerPool(2) as pool:
        for _ in range(2):
            for outcome, reference in zip(pool.run(jobs), expected, strict=True):
                assert np.array_equal(outcome, reference)
        (failed,) = pool.run([(fmu, TASK, {"fault": FAULTS["crash"]})])
        assert isinstance(failed, SimulationError)


def test_an_fmu_for_one_simulation_a_process(build):
    fmu = load_fmu(build(2, defines=("ONCE", "RESET_FAILS")))
    jobs = [(fmu, TASK, {"c": 100.0 + i}) for i in range(5)]
    expected = in_process([(load_fmu(build(2)), *job[1:]) for job in jobs])
    with WorkerPool(2) as pool:
        for outcome, reference in zip(pool.run(jobs), expected, strict=True):
            assert np.array_equal(outcome, reference)


def test_a_leaking_fmu_is_recycled(build):
    fmu = load_fmu(build(2))
    with WorkerPool(1, recycle_growth=20 * 2**20) as pool:  # 6 MB leak in each run
        pids = set()
        for _ in range(10):
            outcomes = pool.run([(fmu, TASK, {"fault": FAULTS["leaks"]})])
            assert isinstance(outcomes[0], np.ndarray)
            pids.add(pool.submit(os.getpid).result())
    assert len(pids) >= 2


def test_an_executor_like_any_other(build, pool):
    assert isinstance(pool, Executor)
    assert list(pool.map(pow, [2, 3], [5, 2])) == [32, 9]
    with pytest.raises(ZeroDivisionError):
        pool.submit(divmod, 1, 0).result()
    with pytest.raises(SimulationError, match=r"_exit: crashed \(exit code 3\)"):
        pool.submit(os._exit, 3).result()
    with pytest.raises(FmuidError, match="cannot be sent to a worker process"):
        pool.submit(lambda: 1)
    fmu = load_fmu(build(2))
    jobs = [(fmu, TASK, {"c": 100.0 + i}) for i in range(3)]
    for outcome, expected in zip(on_executor(pool)(jobs), in_process(jobs), strict=True):
        assert np.array_equal(outcome, expected)


def test_arrays_come_back_as_they_were_made(pool):
    for shape, order in (((3, 700_001), "C"), ((2000, 300), "F"), ((0, 4), "C"), ((), "C")):
        made = np.random.default_rng(1).random(shape).copy(order)
        both = pool.submit(tuple, (made, made[..., ::2] if made.ndim else made)).result()
        for there, here in zip(both, (made, made[..., ::2] if made.ndim else made), strict=True):
            assert np.array_equal(there, here)
            assert there.flags.writeable


class Member(Simulator):
    """Waits until all `members` simulate, and predicts its process, and where that keeps what it is made of."""

    def __init__(self, name, folder, members, inner):
        self.name, self.folder, self.members, self.inner = name, folder, members, inner

    @property
    def variables(self):
        return {}

    @property
    def affinity(self):
        return self.name

    def simulate(self, task, parameters):
        (self.folder / self.name).touch()
        while not all((self.folder / name).exists() for name in self.members):
            time.sleep(0.001)
        return np.array([os.getpid(), id(self.inner)])


def test_what_one_process_remembers_is_simulated_there_again(tmp_path):
    """What models share is sent there once."""
    seen = []
    with WorkerPool(2, time_limit=60.0) as pool:
        inner = Member("inner", tmp_path, "", None)
        for k, order in enumerate(("ab", "ba", "ab", "ba")):
            folder = tmp_path / str(k)
            folder.mkdir()
            jobs = [(Member(name, folder, order, inner), TASK, {}) for name in order]
            seen.append({name: tuple(out) for name, out in zip(order, pool.run(jobs), strict=True)})
    assert all(one == seen[0] for one in seen)
    assert seen[0]["a"][0] != seen[0]["b"][0]


@pytest.mark.skipif("OMP_NUM_THREADS" in os.environ, reason="what the user sets stays")
def test_linear_algebra_of_a_worker_runs_in_one_thread(pool):
    assert pool.submit(os.getenv, "OMP_NUM_THREADS").result() == "1"
    assert "OMP_NUM_THREADS" not in os.environ


def test_what_exceeds_the_time_limit_is_not_tried_again(tmp_path):
    """Not even in a worker that has done others before, as what crashes one is."""
    tried = tmp_path / "tried"
    source = f"open({str(tried)!r}, 'a').write('x')\n"
    with WorkerPool(1, time_limit=5.0) as pool:
        for end, message, times in (
            ("while True: pass", "time limit", 1),
            ("import os; os._exit(3)", "crashed", 2),
        ):
            assert pool.submit(pow, 2, 3).result() == 8
            tried.write_text("")
            with pytest.raises(SimulationError, match=message):
                pool.submit(exec, source + end).result()
            assert tried.read_text() == "x" * times


def test_recycled_after_so_many(build):
    with WorkerPool(1, recycle_after=3) as pool:
        pids = [f.result() for f in [pool.submit(os.getpid) for _ in range(9)]]
    assert [len(set(pids[i : i + 3])) for i in (0, 3, 6)] == [1, 1, 1]
    assert len(set(pids)) == 3


def test_nothing_is_left_behind(build, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with WorkerPool(2, time_limit=5.0) as pool:
        pool.run([(load_fmu(build(2)), TASK, {"fault": f}) for f in (0, FAULTS["hang"], FAULTS["crash"], 0)])
        pid = pool.submit(os.getpid).result()
    assert not [p for p in tmp_path.iterdir() if p.name.startswith("fmuid-workers")]
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    with pytest.raises(FmuidError, match="has been shut down"):
        pool.submit(os.getpid)


def test_what_killed_owners_left_is_cleared_up(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    here = Scratch("fmuid-workers-")
    for name in ("fmuid-workers-old", "fmuid-workers-new", "else"):
        (tmp_path / name / "w").mkdir(parents=True)
    for folder in (here.path, tmp_path / "fmuid-workers-old", tmp_path / "else"):
        os.utime(folder, (0, 0))
    with WorkerPool(1) as pool:
        pool.submit(os.getpid).result()
    left = {p.name for p in tmp_path.iterdir() if not p.name.startswith("fmuid-sockets-")}  # till the end
    assert left == {here.path.name, "fmuid-workers-new", "else"}
    here.remove()


def test_an_fmu_that_a_killed_run_unpacked_is_cleared_up_by_the_next(build, tmp_path):
    source = (
        "import os, sys\nfrom fmuid.simulation.fmu import load_fmu\nfrom fmuid.simulation.simulator import Task\n"
        "load_fmu(sys.argv[1]).simulate(Task([0.0, 1.0], {}, ('y',)), {})\n"
        "if sys.argv[2:]:\n    os.kill(os.getpid(), 9)\n"
    )
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    for arguments in (["killed"], []):
        subprocess.run([sys.executable, "-c", source, str(build(2)), *arguments], env=environment, timeout=600)
        left = list(tmp_path.glob("fmuid-*"))
        assert len(left) == len(arguments)
        for folder in left:
            os.utime(folder, (0, 0))


def test_a_pool_that_nobody_closed_ends_with_the_interpreter(tmp_path):
    script = tmp_path / "open.py"
    script.write_text(
        "from fmuid.simulation.pool.workers import WorkerPool\n"
        "if __name__ == '__main__':\n    pool = WorkerPool(1)\n    print(pool.submit(pow, 2, 3).result())\n"
    )
    (tmp_path / "tmp").mkdir()
    environment = {**os.environ, "TMPDIR": str(tmp_path / "tmp")}
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=600, env=environment)
    assert (done.returncode, done.stdout, done.stderr) == (0, "8\n", "")
    assert not list((tmp_path / "tmp").glob("fmuid-workers-*"))


LONG_BOTH_WAYS = """
import socket, time
import numpy as np
from fmuid.simulation.pool import worker_supervision
from fmuid.simulation.pool.workers import WorkerPool
from fmuid.simulation.simulator import Simulator, Task
class Model(Simulator):
    variables = {}
    def simulate(self, task, parameters):
        end = time.perf_counter() + 3e-4
        while time.perf_counter() < end:
            pass
        return np.zeros((1, 5000))
made = worker_supervision.channels
def narrow():
    ends = made()
    for end in ends:
        end._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 16384)
    return ends
if __name__ == "__main__":
    worker_supervision.channels = narrow
    model, task = Model(), Task(np.arange(3.0), {}, ("y",))
    with WorkerPool(1) as pool:
        found = pool.run([(model, task, {f"parameter_{k}": float(i) for k in range(600)}) for i in range(400)])
    print(len(found), {y.shape for y in found})
"""


def test_long_messages_and_long_answers_never_wait_for_each_other(tmp_path):
    (tmp_path / "long.py").write_text(LONG_BOTH_WAYS)
    command = [sys.executable, tmp_path / "long.py"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "400 {(1, 5000)}\n", "")


POWERS = """
import os, signal, sys
from fmuid.simulation.pool import start_method
from fmuid.simulation.pool.workers import WorkerPool
if __name__ == "__main__":
    if "nowhere" in sys.argv:
        start_method._folders = lambda: ()
    with WorkerPool(1) as pool:
        print(*pool.map(pow, [2, 3], [3, 2]), start_method.start_method())
    if "killed" in sys.argv:
        os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize(("argument", "method"), [("", "forkserver"), ("nowhere", "spawn")])
def test_the_folder_for_temporary_files_may_have_a_long_path(tmp_path, argument, method):
    """A socket's path may not: it is put elsewhere, or done without."""
    long = tmp_path / ("a" * 120)
    long.mkdir()
    (tmp_path / "powers.py").write_text(POWERS)
    command, environment = [sys.executable, tmp_path / "powers.py", argument], {**os.environ, "TMPDIR": str(long)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, env=environment)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"8 9 {method}\n", "")
    assert list(long.iterdir()) == []


def test_the_socket_of_a_killed_run_is_cleared_up_by_the_next(tmp_path):
    script = tmp_path / "powers.py"
    script.write_text(POWERS)
    with tempfile.TemporaryDirectory(dir="/tmp") as short:
        environment = {**os.environ, "TMPDIR": short}
        for arguments in (["killed"], []):
            subprocess.run([sys.executable, script, *arguments], timeout=600, env=environment, check=not arguments)
            left = list(Path(short).iterdir())
            assert len(left) == len(arguments)
            for folder in left:
                os.utime(folder, (0, 0))


def test_what_the_machine_lacks_for_a_worker_is_not_blamed_on_the_script(monkeypatch):
    def full(*_):
        raise OSError(24, "Too many open files")

    with WorkerPool(1) as pool:
        monkeypatch.setattr(pool._supervisor._context.Process, "start", full)
        with pytest.raises(FmuidError, match=r"Too many open files\); free open files, processes or memory"):
            pool.submit(pow, 2, 3).result()


def test_a_killed_helper_process_is_replaced_or_reported_as_killed(monkeypatch):
    with WorkerPool(1) as pool:
        start, tries = pool._supervisor._context.Process.start, []

        def once_without_the_process_that_forks(process):
            tries.append(process)
            if len(tries) == 1:
                raise EOFError
            start(process)

        monkeypatch.setattr(pool._supervisor._context.Process, "start", once_without_the_process_that_forks)
        assert pool.submit(pow, 2, 3).result() == 8
        with pytest.raises(SimulationError, match=r"was killed \(SIGKILL\)"):
            pool.submit(killed).result()
    with WorkerPool(1) as pool:
        monkeypatch.setattr(worker_process, "main", killed)
        with pytest.raises(
            FmuidError, match=r"starting workers end \(SIGKILL\); free open files, processes or memory"
        ):
            pool.submit(pow, 2, 3).result()


def killed(*_):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_script_without_a_guard_is_told_so(tmp_path):
    script = tmp_path / "unguarded.py"
    script.write_text(
        "from fmuid.simulation.pool.workers import WorkerPool\nwith WorkerPool(1) as pool:\n    pool.submit(pow, 2, 3).result()\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=600)
    assert done.returncode == 1
    assert 'its work under `if __name__ == "__main__":`' in done.stderr.splitlines()[-1]


def script(build) -> subprocess.Popen[str]:
    source = f"""
        import os
        import numpy as np
        from fmuid.simulation.fmu import load_fmu
        from fmuid.simulation.simulator import Task
        from fmuid.simulation.pool.choice import runner_on
        fmu = load_fmu({str(build(2))!r})
        task = Task(np.arange(301) * 1e-3, {{}}, ("y",))
        if __name__ == "__main__":
            with runner_on(2, time_limit=3000) as run:
                try:
                    print(run.func.__self__.submit(os.getpid).result(), flush=True)
                    run([(fmu, task, {{"fault": {FAULTS["hang"]}}})] * 4)
                except KeyboardInterrupt:
                    print("interrupted")
    """
    return subprocess.Popen([sys.executable, "-c", textwrap.dedent(source)], stdout=subprocess.PIPE, text=True)


def processor_time(pid: int) -> float:
    """Seconds that a process has computed."""
    spent = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return sum(map(int, spent)) / os.sysconf("SC_CLK_TCK")


def gone(pid: int) -> bool:
    for _ in range(6000):
        try:
            state = Path(f"/proc/{pid}/stat").read_text().split()[2]
        except FileNotFoundError:
            return True
        if state == "Z":
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_workers_go_when_the_search_is_interrupted_or_killed(build, how):
    process = script(build)
    assert process.stdout is not None
    pid = int(process.stdout.readline())
    begun = processor_time(pid)
    while processor_time(pid) < begun + 0.3:  # it spins in the FMU
        time.sleep(0.01)
    os.kill(process.pid, how)
    out, _ = process.communicate(timeout=600)  # of the 3000 s that a simulation may take
    assert out == ("interrupted\n" if how == signal.SIGINT else "")
    assert gone(pid)


def test_workers_of_a_killed_search_say_nothing(tmp_path):
    source = tmp_path / "busy.py"
    source.write_text(
        "from fmuid.simulation.pool.workers import WorkerPool\nif __name__ == '__main__':\n    with WorkerPool(2) as pool:\n"
        "        while True:\n            print(len(list(pool.map(bytes, [300_000] * 20))), flush=True)\n"
    )
    command = [sys.executable, str(source)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for _ in range(10):
            process.stdout.readline()
        process.kill()  # in the midst of answers
        _, errors = process.communicate(timeout=600)
    assert errors == ""


def test_a_pool_whose_last_calls_were_cancelled_ends():
    """The supervisor learns of the shutdown and of the cancelled calls in the same turn."""
    for _ in range(5):
        pool = WorkerPool(1)
        assert pool.submit(int).result(60) == 0
        running = pool.submit(time.sleep, 0.2)
        queued = [pool.submit(int) for _ in range(200)]
        for future in queued:
            future.cancel()
        ended = threading.Thread(target=pool.shutdown, daemon=True)
        ended.start()
        ended.join(30.0)
        assert not ended.is_alive()
        assert running.result() is None
