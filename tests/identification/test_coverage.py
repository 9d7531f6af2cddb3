"""How often 95 % intervals hold the truth: the paper's linear stage on the actuator's FMU, over many noises."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.interval_coverage import interval_coverage
from fmuid import CriterionSpec, ParameterSpec, Problem, Task, identify, load_campaign, load_fmu, measured_case

CAMPAIGN = Path(__file__).parents[2] / "campaigns" / "force_feedback"

TRUTH = {"d_S": 2.66, "J_S": 0.003039, "d_G": 70.625}  # as the paper identified them
SIGMA = 0.1  # N.m, of the torque sensor
REPEATS = 5
TIME = np.arange(401) * 5e-4  # s, as the steps of the force-feedback campaign


@pytest.fixture(scope="module")
def runs(fmus):
    """Current steps of 0.5 and 1 A and a random binary signal, output locked, the gear without friction."""
    fmu = load_fmu(fmus["FixedShaft"])
    smooth = {
        n: 0.0 if n[-2] in "45" else 1.0 for n in fmu.variables if n.startswith("lossTable[") and n[-2] in "2345"
    }
    signs = np.repeat(np.random.default_rng(5).choice([-1.0, 1.0], 41), 10)[: len(TIME)]
    inputs = {"step_0p5": 0.5 * (TIME >= 0.01), "step_1p0": 1.0 * (TIME >= 0.01), "prbs_0p5": 0.5 * signs}
    tasks = {n: Task(TIME, {"i_cmd": u}, ("tau_sensor",), smooth) for n, u in inputs.items()}
    return fmu, {n: (task, fmu.simulate(task, TRUTH)[0]) for n, task in tasks.items()}


def fitted(runs, noise, whiten):
    """Identify from the truth on: a fit that is near takes few simulations, and ends where it would from afar."""
    fmu, tasks = runs
    options = {"whiten": whiten}
    cases = [
        measured_case(
            name,
            fmu,
            task,
            {"tau_sensor": exact + noise(len(exact))},
            sigma={"tau_sensor": SIGMA},
            criteria=[CriterionSpec("tau_sensor", options=options)],
        )
        for name, (task, exact) in tasks.items()
    ]
    specs = [ParameterSpec(n, v, 0.05 * v, 20 * v, scale="log") for n, v in TRUTH.items()]
    return identify(Problem(cases, specs)).stages[0]


def coverage(runs, noise, whiten, draws):
    hits = dict.fromkeys(TRUTH, 0)
    for _ in range(draws):
        stage = fitted(runs, noise, whiten)
        for name, value in TRUTH.items():
            low, high = stage[name].interval
            hits[name] += low < value < high
    return {name: count / draws for name, count in hits.items()}


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "whiten"), [("white", "sigma"), ("coloured", "sigma"), ("coloured", "repeats")])
def test_intervals_of_the_linear_stage_hold_the_truth(runs, coloured, kind, whiten):
    generator = np.random.default_rng(2003)

    def noise(n):
        if kind == "white":
            return SIGMA * generator.standard_normal((REPEATS, n))
        # Slow noise hides damping more than white noise does: less of it leaves the problem as linear.
        return 0.2 * SIGMA * np.sqrt(1 - 0.8**2) * coloured(generator, REPEATS, n, colour=0.8)

    coverages = coverage(runs, noise, whiten, draws=200)
    assert all(0.90 <= share <= 0.98 for share in coverages.values()), coverages


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["white", "coloured"])
def test_intervals_of_the_campaigns_own_linear_stage_hold_the_truth(fmus, kind):
    """Fewer noises than `make coverage` draws; docs/statistics.md has its figures."""
    if not (CAMPAIGN / "measurements.h5").exists():
        subprocess.run([sys.executable, "-m", "benchmarks.virtual_rig", str(CAMPAIGN)], check=True)
    coverages = interval_coverage(load_campaign(CAMPAIGN), "linear", draws=30, kind=kind, seed=1)
    assert len(coverages.names) == 11
    assert 0.90 <= np.mean(coverages.shares) <= 0.98, str(coverages)
    assert np.mean(np.sqrt(np.mean(coverages.deviations**2, axis=0))) == pytest.approx(1.0, abs=0.15)
