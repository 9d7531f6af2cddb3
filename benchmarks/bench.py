"""All benchmarks in one go: ``python benchmarks/bench.py`` writes ``docs/benchmarks.md`` and its figure.

``--quick`` takes few repeats and small sizes, to see that everything runs; its numbers mean nothing.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import chain
import evaluation
import friction_laws
import identification_speed
import integrator
import stepping
from timing import machine, say, table

ROOT = Path(__file__).parents[1]
FIGURE = "figures/benchmarks-scaling.png"
PAGE = """# Benchmarks

How fast fmuid simulates, builds FMUs and identifies, compared with hand-written C and other tools on one machine.
`make bench` measures everything and writes this page.
Made {date} in {minutes:.0f} minutes{quick}.

Machine: {machine}.

Times are medians of repeats in turn (A B A B), ratios are of such medians; *noise* is the median over the least, 1
on a quiet machine. Where one process does the work it is its processor time, which other load hardly changes; for
tools side by side, workers and imports it is wall time. Peers run in environments of their own, pinned in
`benchmarks/peers/*.txt`; one that is missing or fails is listed as such.

## Stepping

One simulation of a light FMU (FMI 2.0 co-simulation, two outputs) by `fmuid`, by a C loop written by hand for this
FMU, and by `fmpy.simulate_fmu` with folder, description and instance reused. Aims: at most 1.3 times the C loop,
at least 20 times FMPy's speed. A call from Python costs some 5 µs whatever it does.

{stepping}

## Evaluation

{evaluation}

Several runs of one experiment share a simulation. Aims: below 1.05 for the PRBS run, at most 1.5 for the stage.

## Derivatives

Jacobians by forward sensitivities and by differences, in evaluations: of the linear stage, and of single runs of
10 s at 100 Hz. Differences of a simulation with adaptive steps carry its noise as well. Aims: below central
differences; for few parameters, 1.5 and 0.15 more for each; for 200 entries of a table, below 6.

{derivatives}

## Identification to an equal cost

Three parameters from one run with noise: of the actuator, a PRBS run of 0.5 s at 1 kHz, and of a pendulum with
friction, torque steps over 4 s at 500 Hz. Everybody has the same start and bounds and stops at an error (root mean
square, N.m and rad) within 1 % of the least, or after {limit:.0f} s, in a new process each time. Setting up
counts, imports do not. An exact derivative is one simulation in the count, though it costs more than a plain one
(see above). Aim: a tenth of each peer's wall time.

{identification}

Both FMUs are of `fmuid build`, so every tool has its integrator. The stiff actuator spends nearly all time in the
FMU's own steps, which all tools pay for alike: there a least-squares search written by hand can only lose by the
loop around the steps and by the simulations that exact derivatives save. A simulation of the pendulum costs little
compared with a Python loop over its samples.

## A friction law, as others fit it

Six parameters of a load-dependent friction law with Stribeck effect of a servo pendulum, from closed-loop rollouts
of 6 s: CMA-ES on the mean absolute error, as servo projects do (BAM), and least squares, to an error within 1 % of
each other. Both simulate with `fmuid`: what is compared is the search.

{friction}

## Integrator

Time to simulate the actuator at an equal error: the FMU's own integrator through `fmuid`, and CVODES (CasADi,
compiled, analytic Jacobian, states scaled) on the same equations. The error is the root mean square of the worst
output, relative to its largest value. Aim: at most 2 in the eccentric-load run.

{integrator}

## Workers

400 short runs of the actuator under an eccentric load in worker processes, and 40 long ones of a chain of 600
masses on Dask clusters of this machine. Aims: two workers at least 1.9 times one for runs of 1 ms, two workers of
a cluster at least 1.7 times one for runs of 50 ms and more. The last row is what the machine gave two processes
that share nothing: no more can be had.

{parallel}

## Scale

A chain of masses with cubic springs (2 states each), a held force on the first one, 1000 samples in 10 s:
processor time of the build, C compiler included, and of one simulation at an equal error of the first mass's
position, over that of others. CVODES restarts at every sample, as the FMU does, and has compiled equations; CVODE,
Radau and BDF have theirs in NumPy. All of them know the sparsity of the Jacobian. Aims: 10 s for 100 masses, 90 s
for 1000; not slower than any.

{chain}

{scale}

![time over size]({figure})

Resident memory of a new process grew by {grown:.1f} MB over {evaluations} evaluations, after the first 500; what
they predict is remembered up to 12 MB (aim: below 20 MB per 10 000).

## Import

Beyond a bare interpreter's start. Aims: 0.3 s and 0.5 s.

{imports}

## Building

`fmuid build` of a new model by a new process, in processor time, C compiler included; what does not depend on the
model is compiled already. The train has 20 components of the Standard Library. Aim: 2 s.

{builds}

Next: [other tools](other-tools.md), or [how good it is](quality.md).
"""


def stepping_table(rows: Sequence[tuple[str, float, float, float]]) -> str:
    head = ["", "C loop (ms)", "fmuid (ms)", "FMPy (ms)", "fmuid / C", "FMPy / fmuid"]
    return table(
        head, [[n, f"{c:.3f}", f"{o:.3f}", f"{f:.1f}", f"{o / c:.2f}", f"{f / o:.0f}"] for n, c, o, f in rows]
    )


def evaluation_table(costs: Sequence[evaluation.Cost]) -> str:
    times = [(c, 1e3 * c.ours.median, 1e3 * c.bare.median) for c in costs]
    rows = [[c.what, f"{o:.2f}", f"{b:.2f}", f"{c.ratio:.3f}", f"{c.bare.noise:.2f}"] for c, o, b in times]
    return table(["", "fmuid (ms)", "bare simulations (ms)", "ratio", "noise"], rows)


def derivatives_table(costs: Sequence[evaluation.DerivativeCost]) -> str:
    rows = [[c.what, str(c.parameters), *(f"{n:.1f}" for n in (c.exact, c.forward, c.central))] for c in costs]
    return table(["of", "parameters", "sensitivities", "forward differences", "central differences"], rows)


def integrator_table(measured: Mapping[str, Mapping[float, tuple[float, float]]]) -> str:
    def cell(mine: float, theirs: float) -> str:
        return f"{1e3 * mine:.2f} / {'fails' if theirs == float('inf') else f'{1e3 * theirs:.2f}'}"

    rows = [[label, *(cell(*times) for times in by_error.values())] for label, by_error in measured.items()]
    errors = next(iter(measured.values()))
    return table(["FMU / CVODES (ms)", *(f"error {error:.0e}" for error in errors)], rows)


def parallel_table(measured: Sequence[evaluation.Parallel], missing: str) -> str:
    rows = [
        [p.what, f"{1e3 * p.run:.2g}", f"{1e3 * p.times.median:.0f}", f"{p.gain:.2f}", f"{p.times.noise:.2f}"]
        for p in measured
    ]
    rows += [["Dask, 2 local workers", "", "missing", missing, ""]] if missing else []
    return table(["where", "one run (ms)", "time (ms)", "times one worker's speed", "noise"], rows)


def scale_table(measured: Mapping[str, Mapping[int, float]]) -> str:
    sizes = sorted({size for times in measured.values() for size in times})
    rows = [[what, *(_ms(times[s]) if s in times else "" for s in sizes)] for what, times in measured.items()]
    text = "Time in ms over multiples: of the samples of a run, and the runs of a stage."
    return text + "\n\n" + table(["", *(f"{s} times" for s in sizes)], rows)


def times_table(times: Mapping[str, float]) -> str:
    return table(["", "time (s)"], [[what, f"{t:.2f}"] for what, t in times.items()])


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.0f}" if seconds > 0.1 else f"{1e3 * seconds:.3g}"


def draw(measured: Mapping[str, Mapping[int, float]], path: Path) -> None:
    """Draw time over size, and a line of slope one through the largest."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    from fmuid.report.plots.style import BLUE, GREEN, GREY, ORANGE

    figure, axes = plt.subplots(figsize=(5.0, 3.4), layout="constrained")
    for (what, times), colour, marker in zip(measured.items(), (BLUE, ORANGE, GREEN), "osD", strict=False):
        sizes, seconds = list(times), list(times.values())
        axes.loglog(sizes, seconds, marker + "-", color=colour, label=what)
        axes.loglog(sizes, [seconds[-1] * s / sizes[-1] for s in sizes], "--", color=GREY, lw=0.8)
    axes.set_xlabel("times the size (dashed: in proportion)")
    axes.set_ylabel("time in s")
    axes.legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120, metadata={"Software": None})
    plt.close(figure)


def measure(out: Path, *, quick: bool) -> str:
    """Measure everything, draw the figure beside `out`, and return the page."""
    begun, place = time.perf_counter(), machine()
    n = 3 if quick else 15
    limit = 3.0 if quick else 40.0
    sizes = (1, 3) if quick else (1, 3, 10, 30, 100)
    parts: dict[str, str] = {}

    def part(name: str, run: Callable[[], str]) -> None:
        say(f"{name} ({time.perf_counter() - begun:.0f} s)")
        parts[name] = run()

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        part("stepping", lambda: stepping_table(stepping.measure(folder, quick=quick)))
        part(
            "evaluation",
            lambda: evaluation_table([evaluation.prbs_run(folder, n), *evaluation.stage_evaluation(n)]),
        )
        part(
            "derivatives",
            lambda: derivatives_table([*evaluation.derivatives(n), *evaluation.derivatives_of_runs(folder, n)]),
        )
        race = {"limit": limit, "repeats": 1 if quick else 5}
        part("identification", lambda: identification_speed.page(identification_speed.measure(folder, **race)))
        part("friction", lambda: friction_laws.page(friction_laws.measure(limit=limit, logs=1 if quick else 4)))
        part("integrator", lambda: integrator_table(integrator.measure(1 if quick else 5, quick=quick)))
        part("parallel", lambda: parallel_table(*evaluation.parallel(1 if quick else 5)))
        chains = {"sizes": (3,), "repeats": 1, "tolerances": (1e-3, 1e-4)} if quick else {"sizes": (10, 100, 1000)}
        part("chain", lambda: chain.page(chain.measure(folder, **chains)))
        scaled = evaluation.scaling(sizes, 5.0 if quick else 60.0)
        part("scale", lambda: scale_table(scaled))
        draw(scaled, out.parent / FIGURE)
        evaluations, grown = evaluation.memory(300 if quick else 10_500)
        part("imports", lambda: times_table(evaluation.imports(3 if quick else 9)))
        part("builds", lambda: times_table(evaluation.builds(folder, 1 if quick else 7)))
    return PAGE.format(
        date=datetime.now(UTC).strftime("%Y-%m-%d"),
        minutes=(time.perf_counter() - begun) / 60.0,
        quick=" (quick mode: the numbers mean nothing)" if quick else "",
        machine=place,
        limit=limit,
        figure=FIGURE,
        grown=grown,
        evaluations=evaluations,
        **parts,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "benchmarks.md", help="page to write")
    parser.add_argument("--quick", action="store_true", help="few repeats and small sizes")
    given = parser.parse_args(arguments)
    page = measure(given.out, quick=given.quick)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(page)
    say(f"written: {given.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
