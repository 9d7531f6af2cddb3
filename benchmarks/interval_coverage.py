"""How often the intervals of a stage hold the truth: the stage fitted again and again to simulated measurements.

The runs of the stage are simulated with known values of every parameter, noise is added as strong as each signal's
sigma, and the stage is run as the campaign has it. Of 95 % intervals 95 % should hold the known values.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
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
from fmuid.simulation.simulator import Simulator

KINDS = ("friction", "gain", "inputs", "signal")
"""An effect that the model lacks, a gain that varies from run to run, noise of the recorded inputs, and noise that
grows with the signal."""
_FRICTION, _GAIN, _INPUTS, _LEAST = 0.1, 0.03, 0.05, 0.1


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
    """

    names: tuple[str, ...]
    inside: FloatArray
    deviations: FloatArray

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
    colour: float = 0.0,
    kind: str = "",
    seed: int = 0,
    simulators: Mapping[str, Simulator] | None = None,
) -> Coverage:
    """Return how often the 95 % intervals of a stage hold the values that its measurements were simulated with.

    Parameters
    ----------
    campaign, stage
        The campaign, and the name of its stage; every parameter's value is its `truth`, or else its start.
    draws
        Number of noises.
    colour
        Correlation of the noise from sample to sample, of a first-order autoregression; 0 for white noise.
    kind
        One of `KINDS`, in addition to the noise; empty for none.
    seed
        Of the noise.
    simulators
        Models by setup; the campaign's FMUs by default.

    Raises
    ------
    FmuidError
        The stage cannot be posed, or its runs cannot be simulated.
    """
    from fmuid.identification.check import load_models

    if stage not in campaign.stages:
        raise ProblemError(f"no stage '{stage}'", fix=f"the campaign has: {', '.join(campaign.stages)}")
    truth = {n: s.start if s.truth is None else s.truth for n, s in campaign.parameters.items()}
    specs = {n: replace(s, start=truth[n]) for n, s in campaign.parameters.items()}
    spec = replace(campaign.stages[stage], start={})
    campaign = replace(campaign, parameters=specs, stages={stage: spec})
    simulators = simulators or load_models(campaign)
    problem = Problem.of_stage(campaign, spec, simulators)
    exact = problem.evaluate(problem.space.start)
    if exact.failure is not None:
        raise ProblemError(f"the true values cannot be simulated ({exact.failure})", fix="check `truth`")
    sources = {e: pair for pair in zip(problem.cases, exact.predictions, strict=True) for e in pair[0].experiments}
    generator = np.random.default_rng(seed)
    inside, deviations = [], []
    for _ in range(draws):
        drawn = _drawn(campaign, spec, sources, generator, colour, kind)
        found = identify(drawn, simulators=simulators).stages[0]
        pairs = [(found[n], exact.parameters[n]) for n in problem.space.names]
        inside.append([e.interval is not None and e.interval[0] < v < e.interval[1] for e, v in pairs])
        deviations.append([(e.value - v) / (e.standard_error or np.nan) for e, v in pairs])
    return Coverage(problem.space.names, np.array(inside, dtype=np.float64), np.array(deviations))


def _drawn(
    campaign: Campaign,
    stage: StageSpec,
    sources: Mapping[str, tuple[Case, FloatArray]],
    generator: np.random.Generator,
    colour: float,
    kind: str,
) -> Campaign:
    """Return the campaign with the stage's runs simulated, with noise."""
    runs = {}
    for run in experiments_of(campaign, stage.experiments, where=f"stage '{stage.name}'"):
        case, prediction = sources[run.id]
        runs[run.id] = _measured(run, case, prediction, generator, colour, kind)
    ids = tuple(runs)
    return replace(campaign, measurements=Measurements(runs), identification=ids, validation=())


def _measured(
    run: Experiment,
    case: Case,
    prediction: FloatArray,
    generator: np.random.Generator,
    colour: float,
    kind: str,
) -> Experiment:
    from scipy.signal import lfilter

    signals = dict(run.signals)
    gain = 1.0 + _GAIN * float(generator.standard_normal()) if kind == "gain" else 1.0
    if kind == "inputs":
        for name, signal in run.inputs.items():
            scatter = _INPUTS * float(np.std(signal.values)) * generator.standard_normal(len(signal.values))
            signals[name] = replace(signal, values=signal.values + scatter)
    for channel, y in zip(case.channels, prediction, strict=True):
        signal = signals[channel.signal]
        white = generator.standard_normal(len(y) + 100)
        noise = lfilter([np.sqrt(1.0 - colour**2)], [1.0, -colour], white)[100:]
        if kind == "signal":
            noise = noise * (_LEAST + (1.0 - _LEAST) * np.abs(y) / max(float(np.max(np.abs(y))), 1e-300))
        if kind == "friction":
            speed = np.gradient(y)
            y = y - _FRICTION * np.std(y) * np.tanh(speed / max(0.05 * float(np.max(np.abs(speed))), 1e-300))
        y = gain * y
        convert = conversion_at(signal.unit, channel.unit, f"signal '{signal.name}'")
        values = (y + channel.noise.sigma * noise - convert.offset) / convert.factor
        signals[signal.name] = replace(signal, values=np.where(np.isfinite(signal.values), values, np.nan))
    return replace(run, signals=signals)


def main(arguments: Sequence[str]) -> int:
    """`python -m benchmarks.interval_coverage CAMPAIGN STAGE [DRAWS] [COLOUR|KIND]`: print a table."""
    return run_module("benchmarks.interval_coverage CAMPAIGN STAGE [DRAWS] [COLOUR|KIND]", arguments, _command)


def _command(arguments: Sequence[str]) -> None:
    from fmuid.campaigns.campaign_toml import load_campaign

    campaign, stage, *numbers = arguments
    kind = numbers.pop() if numbers and numbers[-1] in KINDS else ""
    try:
        draws, colour = int(numbers[0]) if numbers else 200, float(numbers[1]) if len(numbers) > 1 else 0.0
    except ValueError as error:
        raise ProblemError(
            f"is no number ({error})", where="DRAWS, COLOUR", fix=f"such as 200 0.8, or 200 {KINDS[0]}"
        ) from None
    print(interval_coverage(load_campaign(campaign), stage, draws=draws, colour=colour, kind=kind))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
