"""How often the intervals of a stage hold the truth: the stage fitted again and again to simulated measurements.

The runs of the stage are simulated with known values of every parameter, noise is added as strong as each signal's
sigma, and the stage is run as the campaign has it. Of 95 % intervals 95 % should hold the known values.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.study_command import run_module
from fmuid.core.campaign import Campaign, StageSpec
from fmuid.core.errors import ProblemError
from fmuid.core.experiments import Experiment, Measurements
from fmuid.core.formatting import text_table
from fmuid.core.immutable import FloatArray
from fmuid.data.noise.level import conversion_at
from fmuid.identification.identify import identify
from fmuid.identification.problem.cases import Case, experiments_of
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.result import StageResult
from fmuid.simulation.simulator import Simulator

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
    campaign: Campaign,
    stage: str,
    *,
    draws: int,
    kind: str,
    seed: int,
    simulators: Mapping[str, Simulator] | None = None,
    with_uncertainty: bool = True,
) -> tuple[Mapping[str, float], Iterator[StageResult]]:
    """Return the true values of the parameters, and the stage fitted to `draws` simulated measurements."""
    truth, models, drawn = drawn_campaigns(
        campaign, stage, draws=draws, kind=kind, seed=seed, simulators=simulators
    )
    return truth, (identify(one, simulators=models, with_uncertainty=with_uncertainty).stages[0] for one in drawn)


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


def main(arguments: Sequence[str]) -> int:
    """`python -m benchmarks.interval_coverage CAMPAIGN STAGE [DRAWS] [KIND]`: print a table."""
    return run_module("benchmarks.interval_coverage CAMPAIGN STAGE [DRAWS] [KIND]", arguments, _command)


def _command(arguments: Sequence[str]) -> None:
    from fmuid.campaigns.campaign_toml import load_campaign

    campaign, stage, draws, kind = [*arguments, *("200", "white")[len(arguments) - 2 :]]
    if not draws.isdigit() or kind not in KINDS:
        raise ProblemError(
            f"'{draws} {kind}'", where="DRAWS KIND", fix=f"a number, and one of: {', '.join(KINDS)}"
        )
    print(interval_coverage(load_campaign(campaign), stage, draws=int(draws), kind=kind))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
