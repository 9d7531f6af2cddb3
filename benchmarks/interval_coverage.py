"""How often the intervals of a stage hold the truth: the stage fitted again and again to simulated measurements.

The runs of the stage are simulated with known values of every parameter, noise is added as strong as each signal's
sigma, and the stage is run as the campaign has it. Of 95 % intervals 95 % should hold the known values.

Tables of every kind of noise are of a light model: campaigns have six runs of a first-order lag, 300 samples each;
inputs are steps and sines, other ones in every campaign. Where the model lacks friction, intervals should hold the
values that predict other runs best, those that fit 1000 runs without noise.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.study_command import run_module
from fmuid.core.campaign import Campaign, ModelSpec, ParameterSpec, StageSpec
from fmuid.core.errors import ProblemError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.core.formatting import text_table
from fmuid.core.immutable import FloatArray
from fmuid.data.noise.level import conversion_at
from fmuid.identification.identify import identify
from fmuid.identification.problem.cases import Case, experiments_of
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.result import StageResult
from fmuid.identification.validate import validate
from fmuid.simulation.simulator import Simulator, Task, Variable

KINDS = {
    "white": "white",
    "coloured": "correlated by 0.8 from sample to sample",
    "heavy": "heavy tails (Student's t, 3 degrees of freedom)",
    "outliers": "1 sample in 100 is 10 sigma off",
    "gaps": "white; a fifth of the samples is missing, in blocks of 10",
    "jitter": "white; samples are taken up to 0.3 intervals early or late",
    "rounded": "white; values are rounded to 2 sigma",
    "unstated": "white; sigma is not stated",
    "signal": "grows with the signal tenfold",
    "inputs": "white; inputs are recorded with noise (5 % of their standard deviation)",
    "stated inputs": "the same; their sigma is stated",
    "gain": "white; a gain varies by 3 % from run to run",
    "friction": "white; the model lacks friction",
}
"""How measurements differ from the model, in words."""
WRONG = {
    "friction": KINDS["friction"],
    "lag": "white; the model lacks a second lag, of 10 samples",
    "delay": "white; the model lacks a delay of 5 samples",
    "saturation": "white; the model lacks a saturation at 1.5 standard deviations",
}
"""What a model of a wrong structure lacks, in words."""
_COLOUR, _OUTLIERS, _FAR, _GAPS, _BLOCK, _JITTER, _STEP = 0.8, 0.01, 10.0, 0.2, 10, 0.3, 2.0
_FRICTION, _GAIN, _INPUTS, _LEAST = 0.1, 0.03, 0.05, 0.1
_LAG, _DELAY, _MOST = 10.0, 5, 1.5
TIME = 0.02 * np.arange(300)
RUNS, SIGMA, MANY = 6, 0.05, 1000
_STAGE = "all"
_NEW = 100_000  # seeds of new runs


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """What the intervals of one stage are worth; prints as a table.

    Parameters
    ----------
    names
        Free parameters.
    inside
        (draws, n) whether the interval holds the truth; False where there is none.
    deviations
        (draws, n) deviations from the truth in standard errors, NaN where there is none.
    warned
        (draws,) whether the stage has a warning, marks an interval, or did not converge.
    """

    names: tuple[str, ...]
    inside: FloatArray
    deviations: FloatArray
    warned: FloatArray

    @property
    def shares(self) -> FloatArray:
        """(n,) share of the draws whose interval holds the truth."""
        return np.asarray(np.mean(self.inside, axis=0))

    def __str__(self) -> str:
        """Return the shares as a table."""
        rms = np.sqrt(np.nanmean(self.deviations**2, axis=0))
        rows = [
            [name, f"{100 * share:.1f} %", f"{z:.2f}"]
            for name, share, z in zip(self.names, self.shares, rms, strict=True)
        ]
        rows.append(["mean", f"{100 * np.mean(self.shares):.1f} %", f"{np.mean(rms):.2f}"])
        return text_table(
            [["parameter", f"inside, of {len(self.inside)}", "RMS deviation / standard error"], *rows]
        )


def interval_coverage(
    campaign: Campaign,
    stage: str,
    *,
    draws: int = 200,
    kind: str = "white",
    seed: int = 0,
    simulators: Mapping[str, Simulator] | None = None,
    aim: Mapping[str, float] | None = None,
) -> Coverage:
    """Return how often the 95 % intervals of a stage hold the values that its measurements were simulated with.

    Parameters
    ----------
    campaign, stage
        The campaign, and the name of its stage; every parameter's value is its `truth`, or else its start.
    draws
        Number of noises.
    kind
        One of `KINDS` or `WRONG`.
    seed
        Of the noise.
    simulators
        Models by setup; the campaign's FMUs by default.
    aim
        Values that intervals should hold, if not those that the measurements are simulated with.

    Raises
    ------
    FmuidError
        The stage cannot be posed, or its runs cannot be simulated.
    """
    truth, stages = fitted_stages(campaign, stage, draws=draws, kind=kind, seed=seed, simulators=simulators)
    inside, deviations, warned = [], [], []
    names: tuple[str, ...] = ()
    for result in stages:
        names = tuple(e.name for e in result.estimates)
        pairs = [(result[n], (aim or truth)[n]) for n in names]
        inside.append([e.interval is not None and e.interval[0] < v < e.interval[1] for e, v in pairs])
        deviations.append([(e.value - v) / (e.standard_error or np.nan) for e, v in pairs])
        warned.append(warns(result))
    return Coverage(
        names, np.array(inside, dtype=np.float64), np.array(deviations), np.array(warned, dtype=np.float64)
    )


def warns(stage: StageResult) -> bool:
    """Return whether a stage has a warning or an unexplained residual, marks an interval, or did not converge."""
    marks = any(e.note for e in stage.estimates)
    return bool(stage.warnings) or bool(stage.unexplained) or not stage.sound or marks


def fitted_stages(
    campaign: Campaign, stage: str, *, with_uncertainty: bool = True, **drawn: Any
) -> tuple[Mapping[str, float], Iterator[StageResult]]:
    """Return the true values of the parameters, and the stage fitted to measurements of `drawn_campaigns`."""
    truth, models, campaigns = drawn_campaigns(campaign, stage, **drawn)
    fitted = (identify(one, simulators=models, with_uncertainty=with_uncertainty) for one in campaigns)
    return truth, (result.stages[0] for result in fitted)


def drawn_campaigns(
    campaign: Campaign,
    stage: str,
    *,
    draws: int,
    kind: str,
    seed: int,
    simulators: Mapping[str, Simulator] | None = None,
) -> tuple[Mapping[str, float], Mapping[str, Simulator], Iterator[Campaign]]:
    """Return the true values of the parameters, the models, and campaigns with `draws` simulated measurements."""
    from fmuid.identification.check import load_models

    if stage not in campaign.stages:
        raise ProblemError(f"no stage '{stage}'", fix=f"the campaign has: {', '.join(campaign.stages)}")
    truth = {n: s.start if s.truth is None else s.truth for n, s in campaign.parameters.items()}
    specs = {n: replace(s, start=truth[n]) for n, s in campaign.parameters.items()}
    spec = replace(campaign.stages[stage], start={})
    campaign = replace(campaign, parameters=specs, stages={stage: spec})
    models = simulators or load_models(campaign)
    problem = Problem.of_stage(campaign, spec, models)
    exact = problem.evaluate(problem.space.start)
    if exact.failure is not None:
        raise ProblemError(f"the true values cannot be simulated ({exact.failure})", fix="check `truth`")
    sources = {e: pair for pair in zip(problem.cases, exact.predictions, strict=True) for e in pair[0].experiments}
    generator = np.random.default_rng(seed)
    return exact.parameters, models, (_drawn(campaign, spec, sources, generator, kind) for _ in range(draws))


def _drawn(
    campaign: Campaign,
    stage: StageSpec,
    sources: Mapping[str, tuple[Case, FloatArray]],
    generator: np.random.Generator,
    kind: str,
) -> Campaign:
    """Return the campaign with the stage's runs simulated, with noise."""
    runs = {}
    for run in experiments_of(campaign, stage.experiments, where=f"stage '{stage.name}'"):
        case, prediction = sources[run.id]
        runs[run.id] = _measured(run, case, prediction, generator, kind)
    ids = tuple(runs)
    return replace(campaign, measurements=Measurements(runs), identification=ids, validation=())


def _measured(
    run: Experiment, case: Case, prediction: FloatArray, generator: np.random.Generator, kind: str
) -> Experiment:
    signals = dict(run.signals)
    gain = 1.0 + _GAIN * float(generator.standard_normal()) if kind == "gain" else 1.0
    if kind.endswith("inputs"):
        for name, signal in run.inputs.items():
            sigma = _INPUTS * float(np.std(signal.values))
            values = signal.values + sigma * generator.standard_normal(len(signal.values))
            signals[name] = replace(signal, values=values, sigma=sigma if kind == "stated inputs" else None)
    for channel, exact in zip(case.channels, prediction, strict=True):
        signal, sigma = signals[channel.signal], channel.noise.sigma
        y = gain * _reading(exact, run.time, generator, kind) + sigma * _noise(exact, generator, kind)
        if kind == "rounded":
            y = _STEP * sigma * np.round(y / (_STEP * sigma))
        if kind == "gaps":
            blocks = generator.random(-(-len(y) // _BLOCK)) < _GAPS
            y = np.where(np.repeat(blocks, _BLOCK)[: len(y)], np.nan, y)
        convert = conversion_at(signal.unit, channel.unit, f"signal '{signal.name}'")
        values = np.where(np.isfinite(signal.values), (y - convert.offset) / convert.factor, np.nan)
        stated = None if kind == "unstated" else signal.sigma
        signals[signal.name] = replace(signal, values=values, sigma=stated)
    return replace(run, signals=signals)


def _reading(y: FloatArray, time: FloatArray, generator: np.random.Generator, kind: str) -> FloatArray:
    """Return the (N,) readings of a perfect sensor, for outputs of the model."""
    if kind == "jitter":
        moved = time + _JITTER * np.median(np.diff(time)) * generator.uniform(-1.0, 1.0, len(time))
        return np.asarray(np.interp(moved, time, y))
    if kind == "friction":
        speed = np.gradient(y)
        return y - _FRICTION * np.std(y) * np.tanh(speed / max(0.05 * float(np.max(np.abs(speed))), 1e-300))
    if kind == "lag":
        from scipy.signal import lfilter

        decay = np.exp(-1.0 / _LAG)
        return np.asarray(lfilter([1.0 - decay], [1.0, -decay], y))
    if kind == "delay":
        return np.concatenate([np.full(_DELAY, y[0]), y[:-_DELAY]])
    if kind == "saturation":
        return np.clip(y, -_MOST * np.std(y), _MOST * np.std(y))
    return y


def _noise(y: FloatArray, generator: np.random.Generator, kind: str) -> FloatArray:
    """Return (N,) noise for outputs `y`, of unit variance apart from outliers."""
    from scipy.signal import lfilter

    n = len(y)
    if kind == "coloured":
        white = generator.standard_normal(n + 100)
        return np.asarray(lfilter([np.sqrt(1.0 - _COLOUR**2)], [1.0, -_COLOUR], white)[100:])
    if kind == "heavy":
        return np.asarray(generator.standard_t(3, n) / np.sqrt(3.0))
    noise = generator.standard_normal(n)
    if kind == "outliers":
        return noise + _FAR * (generator.random(n) < _OUTLIERS) * np.sign(generator.standard_normal(n))
    if kind == "signal":
        size = _LEAST + (1.0 - _LEAST) * np.abs(y) / max(float(np.max(np.abs(y))), 1e-300)
        return noise * size / np.sqrt(np.mean(size**2))
    return noise


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
    """Print the coverage of a campaign's stage, or, without a campaign, the tables of the light model."""
    usage = "[DRAWS]" if len(arguments) <= 1 else "CAMPAIGN STAGE [DRAWS] [KIND]"
    return run_module(f"benchmarks.interval_coverage {usage}", arguments, _command)


def _command(arguments: Sequence[str]) -> None:
    from fmuid.campaigns.campaign_toml import load_campaign

    stage, given = (arguments[:2], arguments[2:]) if len(arguments) > 1 else ((), arguments)
    draws, kind = [*given, *("200", "white")[len(given) :]]
    if not draws.isdigit() or not int(draws) or kind not in KINDS:
        known = ", ".join(KINDS)
        raise ProblemError(f"'{draws} {kind}'", where="DRAWS KIND", fix=f"a number, and one of: {known}")
    if stage:
        print(interval_coverage(load_campaign(stage[0]), stage[1], draws=int(draws), kind=kind))
    else:
        print(page(int(draws)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
