"""How often the 95 % intervals of a light model hold the truth, under each kind of noise: a table for the docs.

A campaign has six runs of a first-order lag, 300 samples each; inputs are steps and sines, other ones in every
campaign. Where the model lacks friction, intervals should hold the values that predict other runs best, those that
fit 1000 runs without noise.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.interval_coverage import (
    KINDS,
    WRONG,
    Coverage,
    drawn_campaigns,
    fitted_stages,
    interval_coverage,
    warns,
)
from benchmarks.study_command import run_module
from fmuid.core.campaign import Campaign, ModelSpec, ParameterSpec, StageSpec
from fmuid.core.errors import ProblemError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.core.immutable import FloatArray
from fmuid.identification.identify import identify
from fmuid.identification.validate import validate
from fmuid.simulation.simulator import Simulator, Task, Variable

TIME = 0.02 * np.arange(300)
RUNS, SIGMA, MANY = 6, 0.05, 1000
_STAGE = "all"
_NEW = 100_000  # seeds of new runs


class Lag(Simulator):
    """T dy/dt = k u - y + b, solved exactly for inputs that are held."""

    @property
    def variables(self) -> Mapping[str, Variable]:
        """Parameters k, T and b, input u, and output y."""
        parameters = {name: Variable(name, "parameter") for name in ("k", "T", "b")}
        return parameters | {"u": Variable("u", "input"), "y": Variable("y", "output")}

    def simulate(self, task: Task, parameters: Mapping[str, float]) -> FloatArray:
        """Return y."""
        from scipy.signal import lfilter

        p = dict(task.start_values) | dict(parameters)
        decay = np.exp(-TIME[1] / p["T"])
        y = p["k"] * lfilter([0.0, 1.0 - decay], [1.0, -decay], task.inputs["u"]) + p["b"]
        return np.asarray(y)[None]


def light_campaign(seed: int, runs: int = RUNS, sigma: float = SIGMA) -> Campaign:
    """Return a campaign of runs with inputs of its own."""
    generator, experiments = np.random.default_rng(seed), {}
    for k in range(runs):
        steps = np.repeat(generator.uniform(-1.0, 1.0, 15), 20)
        size, frequency = generator.uniform(0.5, 2.0), generator.uniform(0.3, 2.0)
        u = steps if k % 2 else size * np.sin(2.0 * np.pi * frequency * TIME)
        signals = {"u": Signal("u", u, "1", "input"), "y": Signal("y", np.zeros(len(TIME)), "1", "output", sigma)}
        experiments[f"run{k}"] = Experiment(f"run{k}", "bench", TIME, signals)
    parameters = {
        "k": ParameterSpec("k", 1.5, 0.1, 10.0, truth=2.0),
        "T": ParameterSpec("T", 0.4, 0.05, 5.0, scale="log", truth=0.5),
        "b": ParameterSpec("b", 0.05, truth=0.1),
    }
    return Campaign(
        "lag",
        "",
        Path(),
        Measurements(experiments),
        {"bench": ModelSpec("bench", Path("lag.fmu"))},
        parameters,
        {},
        {_STAGE: StageSpec(_STAGE, tuple(experiments), tuple(parameters))},
        tuple(experiments),
        (),
    )


def light_coverage(kind: str, draws: int, *, runs: int = RUNS) -> Coverage:
    """Return how often intervals hold the truth under one of `KINDS`, in as many campaigns as `draws`."""
    simulators, aim = {"bench": Lag()}, None
    if kind == "friction":
        aim = best_values(kind, simulators)
    coverages = [
        interval_coverage(
            light_campaign(seed, runs), _STAGE, draws=1, kind=kind, seed=seed, simulators=simulators, aim=aim
        )
        for seed in range(draws)
    ]
    joined = (np.concatenate([getattr(one, of) for one in coverages]) for of in ("inside", "deviations", "warned"))
    return Coverage(coverages[0].names, *joined)


def best_values(kind: str, simulators: Mapping[str, Simulator]) -> dict[str, float]:
    """Return the values that fit many runs of a kind almost without noise."""
    campaign = light_campaign(MANY, MANY, 1e-3 * SIGMA)
    _, stages = fitted_stages(
        campaign, _STAGE, draws=1, kind=kind, seed=0, simulators=simulators, with_uncertainty=False
    )
    return {e.name: e.value for e in next(stages).estimates}


@dataclass(frozen=True, slots=True, eq=False)
class Predicted:
    """Of each campaign (n,): the share of the samples of new runs within their intervals, and whether it warns."""

    inside: FloatArray
    warned: FloatArray


def new_run_coverage(kind: str, draws: int, *, runs: int = RUNS) -> Predicted:
    """Return how often the 95 % intervals of predictions hold the samples of two new runs of the same kind."""
    simulators, shares, warned = {"bench": Lag()}, [], []
    for seed in range(draws):
        fitted, new = (
            next(drawn_campaigns(one, _STAGE, draws=1, kind=kind, seed=number, simulators=simulators)[2])
            for number, one in ((seed, light_campaign(seed, runs)), (_NEW + seed, light_campaign(_NEW + seed, 2)))
        )
        result = identify(fitted, simulators=simulators)
        shown = validate(result, new, experiments=new.identification, simulators=simulators)
        shares.append(np.mean([score.within for score in shown.scores]))
        warned.append(warns(result.stages[0]))
    return Predicted(np.array(shares), np.array(warned, dtype=np.float64))


def page(draws: int) -> str:
    """Return tables in Markdown: intervals by kind of noise and for few runs, and predictions of new runs."""
    rows = [(KINDS[kind], kind, RUNS) for kind in KINDS]
    rows += [(f"the same gain, {runs} run{'s' * (runs > 1)}", "gain", runs) for runs in (1, 2, 3)]
    lines = ["| measurements | k | T | b | mean | with a warning or mark |", "|---|---|---|---|---|---|"]
    for words, kind, runs in rows:
        coverage = light_coverage(kind, draws, runs=runs)
        shares = [*coverage.shares, np.mean(coverage.shares)]
        cells = " | ".join(f"{100 * share:.0f}" for share in shares)
        lines.append(f"| {words} | {cells} | {100 * np.mean(coverage.warned):.0f} |")
    lines += [
        "",
        "| new runs | after runs | samples in the interval | with a warning or mark |",
        "|---|---|---|---|",
    ]
    for kind, words in ({"white": KINDS["white"], "gain": KINDS["gain"]} | WRONG).items():
        for runs in (2, 3, RUNS):
            new = new_run_coverage(kind, draws, runs=runs)
            cells = f"{100 * np.mean(new.inside):.0f} | {100 * np.mean(new.warned):.0f}"
            lines.append(f"| {words} | {runs} | {cells} |")
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> int:
    """`python -m benchmarks.kinds_of_noise [DRAWS]`: print a table."""
    return run_module("benchmarks.kinds_of_noise [DRAWS]", arguments, _command)


def _command(arguments: Sequence[str]) -> None:
    draws = arguments[0] if arguments else "100"
    if not draws.isdigit() or not int(draws):
        raise ProblemError(f"is '{draws}'", where="DRAWS", fix="write a number")
    print(page(int(draws)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
