"""What the noise of recorded inputs does to an estimate: it scatters, and it is biased (errors in variables).

The model is simulated with the recorded inputs, noise included, while the plant saw the true ones. How far this
moves the estimate is learned by moving it again: noise of the same size is added to the recorded inputs, and
a Gauss-Newton step follows it (simulation extrapolation to first order; Cook and Stefanski, 1994). Noises come in
pairs of opposite sign. The difference of the two steps is the scatter, their mean is the bias.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.derivatives import Differences, NoiseFloor
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation

_PAIRS = 20  # noises for the scatter
_DIFFERENTIATED = 4  # for the bias: it varies less, but needs derivatives


@dataclass(frozen=True, slots=True, eq=False)
class InputNoise:
    """Effect of the inputs' noise on an estimate in search space: covariance (n, n) and bias (n,)."""

    covariance: FloatArray
    bias: FloatArray

    @classmethod
    def none(cls, n: int) -> InputNoise:
        """Return that of `n` parameters whose inputs are known exactly."""
        return cls(np.zeros((n, n)), np.zeros(n))


def noisy_inputs(problem: Problem) -> dict[str, float]:
    """Return the root mean square noise of the recorded inputs whose noise is known, by variable."""
    known: dict[str, list[float]] = {}
    for case in problem.cases:
        for name, sigma in case.input_noise.items():
            known.setdefault(name, []).append(sigma)
    return {name: float(np.sqrt(np.mean(np.square(each)))) for name, each in known.items()}


def input_noise(
    problem: Problem, here: Evaluation, j: FloatArray, bread: FloatArray, floor: NoiseFloor
) -> InputNoise:
    """Return the scatter and the bias of an estimate from the noise of the recorded inputs.

    Parameters
    ----------
    here, j, bread
        Evaluation of the estimate, its Jacobian J (m, n), and (J'J)^-1, (n, n).
    floor
        The simulator's noise floor.

    Raises
    ------
    SimulationError
        The model cannot be simulated with more noise on its inputs.
    """
    if not any(case.input_noise for case in problem.cases):
        return InputNoise.none(len(bread))
    generator = np.random.default_rng(0)
    steps, means = [], []
    for pair in range(_PAIRS):
        noises = [
            {n: s * generator.standard_normal(len(case.task.inputs[n])) for n, s in case.input_noise.items()}
            for case in problem.cases
        ]
        sides = [_noisier(problem, noises, sign) for sign in (1.0, -1.0)]
        plus, minus = (_evaluated(side, here.x) for side in sides)
        steps.append(-bread @ j.T @ (plus.residuals - minus.residuals) / 2.0)
        if pair < _DIFFERENTIATED:
            differences = [Differences(side, floor, central=False) for side in sides]
            scores = [
                d.jacobian(side.evaluate_many, there).T @ there.residuals
                for d, side, there in zip(differences, sides, (plus, minus), strict=True)
            ]
            means.append(-bread @ (np.mean(scores, axis=0) - j.T @ here.residuals))
    # The noise in the log has moved the estimate by as much as more of it does.
    return InputNoise(np.array(steps).T @ np.array(steps) / _PAIRS, np.mean(means, axis=0))


def _noisier(problem: Problem, noises: Sequence[Mapping[str, FloatArray]], sign: float) -> Problem:
    """Return the problem with `sign` times the noises, by case and input, added to the inputs."""
    cases = []
    for case, noise in zip(problem.cases, noises, strict=True):
        inputs = dict(case.task.inputs) | {n: case.task.inputs[n] + sign * noise[n] for n in noise}
        cases.append(replace(case, task=replace(case.task, inputs=inputs)))
    return problem.with_cases(cases)


def _evaluated(problem: Problem, x: FloatArray) -> Evaluation:
    evaluation = problem.evaluate(x)
    if evaluation.failure is not None:
        raise SimulationError(evaluation.failure)
    return evaluation
