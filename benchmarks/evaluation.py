"""What an evaluation costs around its simulations, what derivatives cost, what workers gain, what memory grows."""

from __future__ import annotations

import ctypes
import gc
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import chain
import numpy as np
from identification_speed import ROOT
from integrator import prbs
from stepping import with_c, with_fmuid
from timing import Times, in_turn

import fmuid
from fmu_build import build
from fmu_build.front.standard_folders import standard_folders
from fmuid.core.errors import FmuidError
from fmuid.identification.problem.derivatives import Differences, NoiseFloor
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.pool.worker_process import resident_memory
from fmuid.simulation.pool.workers import WorkerPool
from fmuid.simulation.predictor import Predictor
from fmuid.simulation.runners import Job, Runner, in_process
from fmuid.simulation.simulator import Simulator, Task

_FMUID = ("-c", "import sys; from fmuid.cli import main; sys.exit(main())")
_LONG = 600  # masses of a chain whose run takes some 50 ms
TRAIN = """model Train
  import Modelica.Mechanics.Rotational.*;
  Modelica.Blocks.Sources.Sine sine(f = 1, amplitude = 10);
  Sources.Torque torque;
  Components.Inertia J[9](each J = 0.1, each phi(fixed = true), each w(fixed = true));
  Components.SpringDamper s[8](each c = 1e3, each d = 1);
  Components.BearingFriction bearing(tau_pos = [0, 0.5; 1, 1]);
equation
  connect(sine.y, torque.tau); connect(torque.flange, J[1].flange_a); connect(J[9].flange_b, bearing.flange_a);
  connect(J[1:8].flange_b, s.flange_a); connect(s.flange_b, J[2:9].flange_a);
end Train;
"""
CAMPAIGN = ROOT / "campaigns" / "force_feedback"


def linear_stage() -> Problem:
    """Return the problem of the stage on the step runs of the shipped campaign."""
    campaign = fmuid.load_campaign(CAMPAIGN)
    simulators = {name: load_fmu(model.fmu) for name, model in campaign.models.items()}
    return Problem.of_stage(campaign, campaign.stages["linear_step"], simulators)


@dataclass(frozen=True)
class Cost:
    """Times of a measurement and of its reference, in s."""

    what: str
    ours: Times
    bare: Times

    @property
    def ratio(self) -> float:
        return self.ours.median / self.bare.median


def prbs_run(folder: Path, repeats: int) -> Cost:
    """The 0.5 s PRBS run at 1 kHz: by fmuid, and by a loop in C written for this FMU."""
    path = folder / "FixedShaft.fmu"
    path.write_bytes((ROOT / "build" / "fmus" / path.name).read_bytes())
    task = Task(1e-3 * np.arange(501), {"i_cmd": prbs(501, 0.8)}, ("tau_sensor", "w_motor"))
    times = in_turn({"ours": with_fmuid(path, task), "bare": with_c(path, task)}, repeats)
    return Cost("0.5 s PRBS run at 1 kHz, actuator", times["ours"], times["bare"])


def stage_evaluation(repeats: int) -> list[Cost]:
    """A whole evaluation of the stage, compared with the simulations it needs, and with one for every run."""
    problem = linear_stage()
    rng = np.random.default_rng(0)
    values = problem.space.to_model(problem.space.start)
    once = [(c.simulator, c.task, c.start_values(values)) for c in problem.cases]
    every = [job for c, job in zip(problem.cases, once, strict=True) for _ in c.experiments]

    start = problem.space.start

    def evaluate() -> None:  # at another point each time: nothing may be remembered
        x = start * (1.0 + 1e-6 * rng.standard_normal(len(start)))
        assert problem.evaluate(x).ok

    times = in_turn(
        {
            "ours": evaluate,
            "every": lambda: [s.simulate(t, v) for s, t, v in every],
            "once": lambda: [s.simulate(t, v) for s, t, v in once],
        },
        repeats,
    )
    what = f"evaluation of the linear stage, {len(every)} runs"
    return [
        Cost(f"{what}; one simulation for each", times["ours"], times["every"]),
        Cost(f"{what}; one for each of the {len(once)} different ones", times["ours"], times["once"]),
    ]


@dataclass(frozen=True)
class DerivativeCost:
    """Times of a Jacobian, in evaluations without one."""

    what: str
    parameters: int
    exact: float
    forward: float
    central: float


def derivatives(repeats: int) -> list[DerivativeCost]:
    """The Jacobian of the linear stage by sensitivities and by differences, with few and many parameters."""
    problem = linear_stage()
    costs = []
    for n in (len(problem.space), 12):
        larger = problem if n == len(problem.space) else _with_more(problem, n)
        here = larger.evaluate(larger.space.start)
        floor = NoiseFloor(0.0, 1.0, ())
        both = {central: Differences(larger, floor, central=central) for central in (False, True)}

        def differences(central: bool, larger: Problem = larger, both: dict = both, here=here) -> None:  # type: ignore
            larger._predictor = Predictor()
            points = [p for i in range(len(here.x)) for p in both[central]._moved(here.x, i, 1e-4, central)]
            larger.evaluate_many(points)

        def plain(larger: Problem = larger, here=here) -> None:  # type: ignore
            larger._predictor = Predictor()
            larger.evaluate(here.x)

        runs: dict[str, Callable[[], object]] = {
            "run": plain,
            "exact": lambda larger=larger, here=here: larger.exact.simulate([(here.x, here.parameters)]),  # type: ignore
            "forward": lambda: differences(False),
            "central": lambda: differences(True),
        }
        times = in_turn(runs, repeats)
        unit = times["run"].median
        ratios = (times[k].median / unit for k in ("exact", "forward", "central"))
        costs.append(DerivativeCost("the linear stage", n, *ratios))
    return costs


def derivatives_of_runs(folder: Path, repeats: int) -> list[DerivativeCost]:
    """The same for single runs: by the entries of a fine loss table, and of the actuator in two coupled parts.

    Differences take a run for each parameter, or two.
    """
    time = np.linspace(0, 10, 1001)
    speed = 30 * np.sin(2 * np.pi * time / 3)
    rows = [(w, 0.97, 0.96, 0.08 + 0.02 * np.exp(-w / 5), 0.08) for w in [*np.linspace(0, 60, 48), 100, 300]]
    (folder / "Fine.mo").write_text(
        "model Fine\n  extends Drives.Setups.EccentricLoad(lossTable = ["
        + ";\n".join(", ".join(f"{v:.6g}" for v in row) for row in rows)
        + "]);\nend Fine;\n"
    )
    modelica = ROOT / "modelica"
    fine = load_fmu(build(folder / "Fine.mo", "Fine", folder, roots=[modelica]))
    entries = {f"lossTable[{k},{j}]": row[j - 1] for k, row in enumerate(rows, 1) for j in range(2, 6)}
    parts = {
        name: build(modelica / "Drives" / f"{place}.mo", f"Drives.{place.replace('/', '.')}", folder)
        for name, place in {"plant": "Setups/EccentricLoadPlant", "controller": "Signals/SpeedController"}.items()
    }
    wires = {"plant.i": "controller.i", "controller.w": "plant.w_motor"}
    coupled = fmuid.couple(parts, wires, fmuid.Master(1e-3, extrapolation="linear"))
    models: list[tuple[str, Simulator, str, tuple[str, ...], Mapping[str, float]]] = [
        ("a loss table of 50 speeds", fine, "w_ref", ("w_motor", "tau_sensor"), entries),
        (
            "the actuator in two coupled FMUs",
            coupled,
            "controller.w_ref",
            ("plant.w_motor", "plant.tau_sensor"),
            {"controller.kp": 0.02, "plant.mgr": 20.0},
        ),
    ]
    costs = []
    for what, model, reference, outputs, values in models:
        plain = Task(time, {reference: speed}, outputs, {}, "linear")
        exact = replace(plain, along=tuple({name: 1.0} for name in values))

        times = in_turn(
            {
                "run": lambda model=model, plain=plain, values=values: model.simulate(plain, values),  # type: ignore
                "exact": lambda model=model, exact=exact, values=values: model.simulate(exact, values),  # type: ignore
            },
            repeats,
        )
        ratio = times["exact"].median / times["run"].median
        costs.append(DerivativeCost(what, len(values), ratio, len(values), 2 * len(values)))
    return costs


def _with_more(problem: Problem, n: int) -> Problem:
    """Return the problem with further parameters of the actuator free."""
    free = [replace(s, free=True) for s in problem.space.free]
    names = {s.name for s in free}
    variables = problem.cases[0].simulator.variables
    more = [
        fmuid.ParameterSpec(v.name, v.start, 0.5 * v.start, 2.0 * v.start)
        for v in variables.values()
        if v.causality == "parameter" and v.type == "Real" and v.start and v.start > 0 and v.name not in names
    ][: n - len(free)]
    unit = next(iter(problem.cases[0].setting.values()))[1]
    same = type(unit)()
    cases = [replace(c, setting={**c.setting, **{s.name: (s.name, same) for s in more}}) for c in problem.cases]
    return Problem(cases, [*free, *more])


@dataclass(frozen=True)
class Parallel:
    """Times in s of the same jobs, how long one of them takes, and how much faster than one worker they are."""

    what: str
    times: Times
    run: float
    gain: float


def parallel(repeats: int, *, dask: bool = True) -> tuple[list[Parallel], str]:
    """Simulate short runs of the actuator in worker processes, and long ones of a chain on Dask clusters.

    Returns
    -------
    list, str
        The times, and why Dask is missing, if it is.
    """
    fmu = load_fmu(ROOT / "build" / "fmus" / "EccentricLoad.fmu")
    t = 5e-3 * np.arange(6001)
    task = Task(t, {"w_ref": 20.0 * np.minimum(1.0, t)}, ("i_motor", "tau_sensor"))
    short: list[Job] = [(fmu, task, {"d_S": 2.0 + 1e-3 * k}) for k in range(400)]
    run = in_turn({"": lambda: in_process(short)}, repeats, time.perf_counter)[""]
    alone = run.median / len(short)
    measured: dict[str, Times] = {}
    for workers in (1, 2):
        with WorkerPool(workers) as pool:
            pool.run(short[:20])  # the workers start
            measured[f"{workers} worker{'s' * (workers > 1)}"] = in_turn(
                {"": lambda: pool.run(short)}, repeats, time.perf_counter
            )[""]
    one = measured["1 worker"].median
    rows = [Parallel("this process", run, alone, one / run.median)]
    rows += [Parallel(what, times, alone, one / times.median) for what, times in measured.items()]
    missing = ""
    if dask:
        try:
            rows += _on_dask(repeats)
        except (ImportError, FmuidError, OSError) as error:
            missing = f"{type(error).__name__}: {error}"
    return [*rows, _ceiling(repeats)], missing


def _ceiling(repeats: int) -> Parallel:
    """Speed of two processes that share nothing on this machine, relative to one of them alone."""
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        times = in_turn(
            {n: lambda n=n: pool.map(_loop, range(n), 1) for n in (1, 2)},  # type: ignore[misc]
            repeats,
            time.perf_counter,
        )
    gain = 2.0 * times[1].median / times[2].median
    return Parallel("two bare loops, relative to one", times[2], times[1].median, gain)


def _loop(_: int) -> int:
    return sum(k * k for k in range(400_000))


def _on_dask(repeats: int) -> list[Parallel]:
    from distributed import LocalCluster

    from fmuid.simulation.pool.remote import dask_executor, on_executor

    measured: list[Times] = []
    with tempfile.TemporaryDirectory() as folder:
        fmu, _ = chain.build(_LONG, Path(folder))
        task = Task(chain.TIME, {"u": chain.force()}, ("y",))
        long: list[Job] = [(fmu, task, {"d": 0.5 + 1e-3 * k}) for k in range(40)]
        alone = in_turn({"": lambda: in_process(long[:5])}, 3, time.perf_counter)[""].median / 5
        for workers in (1, 2):
            with (
                LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster,
                dask_executor(cluster.scheduler_address) as executor,
            ):
                run: Runner = on_executor(executor)
                for _ in range(3):  # the workers start their processes, and it is seen how long a run takes
                    run(long[:10])
                measured.append(in_turn({"": lambda run=run: run(long)}, repeats, time.perf_counter)[""])  # type: ignore[misc]
    names = ("Dask, 1 local worker", "Dask, 2 local workers")
    return [Parallel(n, t, alone, measured[0].median / t.median) for n, t in zip(names, measured, strict=True)]


def memory(evaluations: int) -> tuple[int, float]:
    """Return how many evaluations were made, and by how many MB the resident memory grew after the first 500.

    In a new process: in this one they would fill what other benchmarks have left.
    """
    alone = [sys.executable, "-c", f"import evaluation; print(evaluation.grown({evaluations}))"]
    told = subprocess.run(alone, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    return evaluations, float(told.stdout)


def grown(evaluations: int) -> float:
    """Evaluate a run of the stage again and again; see `memory`."""
    problem = linear_stage()
    case = min(problem.cases, key=lambda c: len(c.task.time))
    free = [replace(s, free=True) for s in problem.space.free]
    small = Problem([case], free)
    rng = np.random.default_rng(0)
    begun = 0
    for k in range(evaluations):
        small.evaluate(small.space.start * (1.0 + 1e-3 * rng.standard_normal(len(free))))
        if k == min(500, evaluations // 2):
            gc.collect()
            with suppress(AttributeError):  # what setting up has left would be filled first
                ctypes.CDLL(None).malloc_trim(0)
            begun = resident_memory(os.getpid())
    gc.collect()
    return (resident_memory(os.getpid()) - begun) / 2**20


def _python(*arguments: str | Path) -> Callable[[], object]:
    return lambda: subprocess.run([sys.executable, *arguments], capture_output=True, check=True)


def imports(repeats: int) -> dict[str, float]:
    """Return seconds of `import fmuid` and `fmuid --help` in a new interpreter, beyond the bare one."""
    runs = {"": ("-c", "pass"), "import fmuid": ("-c", "import fmuid"), "fmuid --help": (*_FMUID, "--help")}
    times = in_turn({what: _python(*command) for what, command in runs.items()}, repeats, time.perf_counter)
    bare = times.pop("").median
    return {name: measured.median - bare for name, measured in times.items()}


def builds(folder: Path, repeats: int) -> dict[str, float]:
    """Return seconds of processor time, compilers included, in which a command builds the FMU of a new model."""
    setups = ROOT / "modelica" / "Drives" / "Setups"
    models = {f"Drives.Setups.{n}": setups / f"{n}.mo" for n in ("FixedShaft", "FreeShaft", "EccentricLoad")}
    if standard_folders():
        models["Train"] = folder / "Train.mo"
        models["Train"].write_text(TRAIN)

    def build_new(name: str) -> None:
        with tempfile.TemporaryDirectory() as out:
            _python(*_FMUID, "build", models[name], name, "--out", out)()

    runs = {name: partial(build_new, name) for name in models}
    times = in_turn(runs, repeats, lambda: sum(os.times()[2:4]))
    return {name: measured.median for name, measured in times.items()}


def grows(sizes: tuple[int, ...], make: Callable[[int], Callable[[], object]], budget: float) -> dict[int, float]:
    """Return the least time in s by size, until a size would take longer than the budget."""
    seconds: dict[int, float] = {}
    for size in sizes:
        run = make(size)
        begun = time.process_time()
        run()
        first = time.process_time() - begun
        again = 0 if first > 2.0 else 2
        seconds[size] = min([first, *(_timed(run) for _ in range(again))])
        if seconds[size] * 10 > budget:
            break
    return seconds


def _timed(run: Callable[[], object]) -> float:
    begun = time.process_time()
    run()
    return time.process_time() - begun


def scaling(sizes: tuple[int, ...], budget: float) -> dict[str, dict[int, float]]:
    """Return times in s by multiples of the paper's campaign: samples and runs."""
    problem = linear_stage()
    case, space = problem.cases[0], problem.space
    rng = np.random.default_rng(0)

    def point() -> np.ndarray:
        return np.asarray(space.start * (1.0 + 1e-6 * rng.standard_normal(len(space))))

    def runs(times: int) -> Callable[[], object]:
        cases = [replace(c, id=f"{c.id}_{k}") for k in range(times) for c in problem.cases]
        many = Problem(cases, space)
        return lambda: many.evaluate(point())

    def samples(times: int) -> Callable[[], object]:
        h = case.task.time[1] - case.task.time[0]
        longer = replace(
            case.task,
            time=h * np.arange(len(case.task.time) * times),
            inputs={k: np.tile(u, times) for k, u in case.task.inputs.items()},
        )
        values = case.start_values(space.to_model(space.start))
        return lambda: case.simulator.simulate(longer, values)

    return {"samples": grows(sizes, samples, budget), "runs": grows(sizes, runs, budget)}
