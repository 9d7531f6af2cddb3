"""NIST Statistical Reference Datasets, nonlinear regression: certified values through the whole engine.

All twenty-seven, from both of their starts, as NIST publishes them (`nist/*.dat`, public domain).
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from fmuid import ParameterSpec, Problem, Simulator, Task, Variable, identify, measured_case

exp, pi = np.exp, np.pi


def _exponentials(x, *b):
    return sum(a * exp(-k * x) for a, k in zip(b[::2], b[1::2], strict=True))


def _peaks(x, a, b, c, d, e, f, g, h):
    return a * exp(-b * x) + c * exp(-(((x - d) / e) ** 2)) + f * exp(-(((x - g) / h) ** 2))


def _southern_oscillation(x, a, b, c, d, e, f, g, h, i):
    def wave(period, cosine, sine):
        return cosine * np.cos(2 * pi * x / period) + sine * np.sin(2 * pi * x / period)

    return a + wave(12, b, c) + wave(d, e, f) + wave(g, h, i)


def _cubic_ratio(x, a, b, c, d, e, f, g):
    return (a + b * x + c * x**2 + d * x**3) / (1 + e * x + f * x**2 + g * x**3)


MODELS = {
    "Bennett5": lambda x, a, b, c: a * (b + x) ** (-1 / c),
    "BoxBOD": lambda x, a, b: a * (1 - exp(-b * x)),
    "Chwirut1": lambda x, a, b, c: exp(-a * x) / (b + c * x),
    "Chwirut2": lambda x, a, b, c: exp(-a * x) / (b + c * x),
    "DanWood": lambda x, a, b: a * x**b,
    "ENSO": _southern_oscillation,
    "Eckerle4": lambda x, a, b, c: a / b * exp(-0.5 * ((x - c) / b) ** 2),
    "Gauss1": _peaks,
    "Gauss2": _peaks,
    "Gauss3": _peaks,
    "Hahn1": _cubic_ratio,
    "Kirby2": lambda x, a, b, c, d, e: (a + b * x + c * x**2) / (1 + d * x + e * x**2),
    "Lanczos1": _exponentials,
    "Lanczos2": _exponentials,
    "Lanczos3": _exponentials,
    "MGH09": lambda x, a, b, c, d: a * (x**2 + x * b) / (x**2 + x * c + d),
    "MGH10": lambda x, a, b, c: a * exp(b / (x + c)),
    "MGH17": lambda x, a, b, c, d, e: a + b * exp(-x * d) + c * exp(-x * e),
    "Misra1a": lambda x, a, b: a * (1 - exp(-b * x)),
    "Misra1b": lambda x, a, b: a * (1 - (1 + b * x / 2) ** -2),
    "Misra1c": lambda x, a, b: a * (1 - (1 + 2 * b * x) ** -0.5),
    "Misra1d": lambda x, a, b: a * b * x / (1 + b * x),
    "Nelson": lambda x, z, a, b, c: a - b * x * exp(-c * z),  # of the logarithm of y
    "Rat42": lambda x, a, b, c: a / (1 + exp(b - c * x)),
    "Rat43": lambda x, a, b, c, d: a / (1 + exp(b - c * x)) ** (1 / d),
    "Roszman1": lambda x, a, b, c, d: a - b * x - np.arctan(c / (x - d)) / pi,
    "Thurber": _cubic_ratio,
}


@dataclass(frozen=True)
class Nist:
    """A data set: starts (2, n), certified values and standard deviations (n,), predictors (k, N), response (N,)."""

    name: str
    starts: np.ndarray
    certified: np.ndarray
    deviations: np.ndarray
    x: np.ndarray
    y: np.ndarray


def read(name):
    lines = (Path(__file__).parent / "nist" / f"{name}.dat").read_text().splitlines()
    table = np.array([line.split("=")[1].split() for line in lines if re.match(r"\s*b\d+ =", line)], dtype=float)
    y, *x = np.array([line.split() for line in lines[60:] if line.strip()], dtype=float).T
    return Nist(name, table[:, :2].T, table[:, 2], table[:, 3], np.array(x), np.log(y) if name == "Nelson" else y)


SETS = {name: read(name) for name in MODELS}


@dataclass(frozen=True)
class Curve(Simulator):
    """The regression function as a model whose time axis is an index; the predictors are inputs."""

    nist: Nist

    @property
    def variables(self):
        names = [f"b{i + 1}" for i in range(len(self.nist.certified))]
        return {n: Variable(n, "parameter") for n in names} | {"y": Variable("y", "output")}

    def simulate(self, task, parameters):
        with np.errstate(all="ignore"):
            values = [parameters[f"b{i + 1}"] for i in range(len(self.nist.certified))]
            return MODELS[self.nist.name](*task.inputs.values(), *values)[None]


def problem(nist, start, bounds=None):
    inputs = {f"x{i}": x for i, x in enumerate(nist.x)}
    task = Task(np.arange(len(nist.y), dtype=float), inputs, ("y",))
    case = measured_case("nist", Curve(nist), task, {"y": nist.y})
    lower, upper = bounds or ([-np.inf] * len(start), [np.inf] * len(start))
    box = enumerate(zip(start, lower, upper, strict=True))
    return Problem([case], [ParameterSpec(f"b{i + 1}", float(s), low, high) for i, (s, low, high) in box])


def estimates(result):
    return [e.value for e in result.estimates]


# From the far start of these a local solver ends elsewhere; multistart between bounds is for that.
_BOUNDS = {"MGH09": ([0] * 4, [50] * 4), "MGH17": ([0, 0, -200, 0, 0], [100, 200, 0, 2, 2])}
# Without derivatives, from the near start; the slow ones take 5 s or more.
_DFOLS = ["BoxBOD", "DanWood", "Eckerle4", "MGH09", "Rat42", "Rat43", "Roszman1"]
_DFOLS_SLOW = ["MGH10", "MGH17", "Misra1a", "Misra1b", "Misra1c", "Misra1d", "Thurber"]
_RUNS = [(n, s, solver) for n in MODELS for s in (0, 1) for solver in ("trf", "lm") if s or n not in _BOUNDS]
_RUNS += [(name, 1, "dfols") for name in _DFOLS]
_RUNS += [pytest.param(name, 1, "dfols", marks=pytest.mark.slow) for name in _DFOLS_SLOW]


@pytest.mark.parametrize(("name", "start", "solver"), _RUNS)
def test_certified_values(name, start, solver):
    nist = SETS[name]
    result = identify(problem(nist, nist.starts[start]), solver=solver, with_uncertainty=False)
    assert estimates(result) == pytest.approx(list(nist.certified), rel=1e-6)


@pytest.mark.parametrize("name", _BOUNDS)
def test_certified_values_from_afar(name):
    nist = SETS[name]
    result = identify(problem(nist, nist.starts[0], _BOUNDS[name]), options={"starts": 8}, with_uncertainty=False)
    assert estimates(result) == pytest.approx(list(nist.certified), rel=1e-6)
    assert min(s.cost for s in result.stages[0].starts) == result.stages[0].cost


@pytest.mark.parametrize("name", MODELS)
def test_certified_standard_deviations(name):
    nist = SETS[name]
    uncertainty = identify(problem(nist, nist.certified)).stages[0].uncertainty
    given = [k for k, error in enumerate(uncertainty.naive_errors) if error is not None]
    if name not in ("ENSO", "Nelson"):  # some of theirs are too uncertain for an interval of their own
        assert len(given) == len(nist.certified)
    assert [uncertainty.naive_errors[k] for k in given] == pytest.approx(list(nist.deviations[given]), rel=1e-4)
