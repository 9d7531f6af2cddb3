"""NIST Statistical Reference Datasets, nonlinear regression: certified values through the whole engine."""

from dataclasses import dataclass

import numpy as np
import pytest

from fmuid import ParameterSpec, Problem, Task, Variable, identify, measured_case

exp, arctan = np.exp, np.arctan


@dataclass(frozen=True)
class Nist:
    model: object
    x: str
    y: str
    starts: tuple
    certified: tuple
    deviations: tuple


SETS = {
    "Misra1a": Nist(
        lambda x, a, b: a * (1 - exp(-b * x)),
        "77.6 114.9 141.1 190.8 239.9 289 332.8 378.4 434.8 477.3 536.8 593.1 689.1 760",
        "10.07 14.73 17.94 23.93 29.61 35.18 40.02 44.82 50.76 55.05 61.01 66.4 75.47 81.78",
        ((500, 1e-4), (250, 5e-4)),
        (2.3894212918e02, 5.5015643181e-04),
        (2.7070075241, 7.2668688436e-06),
    ),
    "DanWood": Nist(
        lambda x, a, b: a * x**b,
        "1.309 1.471 1.49 1.565 1.611 1.68",
        "2.138 3.421 3.597 4.34 4.882 5.66",
        ((1, 5), (0.7, 4)),
        (7.6886226176e-01, 3.8604055871),
        (1.8281973860e-02, 5.1726610913e-02),
    ),
    "Rat42": Nist(
        lambda x, a, b, c: a / (1 + exp(b - c * x)),
        "9 14 21 28 42 57 63 70 79",
        "8.93 10.8 18.59 22.33 39.35 56.11 61.73 64.62 67.08",
        ((100, 1, 0.1), (75, 2.5, 0.07)),
        (7.2462237576e01, 2.6180768402, 6.7359200066e-02),
        (1.7340283401, 8.8295217536e-02, 3.4465663377e-03),
    ),
    "Rat43": Nist(
        lambda x, a, b, c, d: a / (1 + exp(b - c * x)) ** (1 / d),
        "1 2 3 4 5 6 7 8 9 10 11 12 13 14 15",
        "16.08 33.83 65.8 97.2 191.55 326.2 386.87 520.53 590.03 651.92 724.93 699.56 689.96 637.56 717.41",
        ((700, 5, 0.75, 1.3),),
        (6.9964151270e02, 5.2771253025, 7.5962938329e-01, 1.2792483859),
        (1.6302297817e01, 2.0828735829, 1.9566123451e-01, 6.8761936385e-01),
    ),
    "MGH09": Nist(
        lambda x, a, b, c, d: a * (x**2 + x * b) / (x**2 + x * c + d),
        "4 2 1 0.5 0.25 0.167 0.125 0.1 0.0833 0.0714 0.0625",
        "0.1957 0.1947 0.1735 0.16 0.0844 0.0627 0.0456 0.0342 0.0323 0.0235 0.0246",
        ((0.25, 0.39, 0.415, 0.39),),
        (1.9280693458e-01, 1.9128232873e-01, 1.2305650693e-01, 1.3606233068e-01),
        (1.1435312227e-02, 1.9633220911e-01, 8.0842031232e-02, 9.0025542308e-02),
    ),
    "BoxBOD": Nist(
        lambda x, a, b: a * (1 - exp(-b * x)),
        "1 2 3 5 7 10",
        "109 149 149 191 213 224",
        ((100, 0.75),),
        (2.1380940889e02, 5.4723748542e-01),
        (1.2354515176e01, 1.0455993237e-01),
    ),
    "Thurber": Nist(
        lambda x, a, b, c, d, e, f, g: (a + b * x + c * x**2 + d * x**3) / (1 + e * x + f * x**2 + g * x**3),
        "-3.067 -2.981 -2.921 -2.912 -2.84 -2.797 -2.702 -2.699 -2.633 -2.481 -2.363 -2.322 -1.501 -1.46"
        " -1.274 -1.212 -1.1 -1.046 -0.915 -0.714 -0.566 -0.545 -0.4 -0.309 -0.109 -0.103 0.01 0.119 0.377"
        " 0.79 0.963 1.006 1.115 1.572 1.841 2.047 2.2",
        "80.574 84.248 87.264 87.195 89.076 89.608 89.868 90.101 92.405 95.854 100.696 101.06 401.672 390.724"
        " 567.534 635.316 733.054 759.087 894.206 990.785 1090.109 1080.914 1122.643 1178.351 1260.531"
        " 1273.514 1288.339 1327.543 1353.863 1414.509 1425.208 1421.384 1442.962 1464.35 1468.705 1447.894"
        " 1457.628",
        ((1300, 1500, 500, 75, 1, 0.4, 0.05),),
        (
            1.2881396800e03,
            1.4910792535e03,
            5.8323836877e02,
            7.5416644291e01,
            9.6629502864e-01,
            3.9797285797e-01,
            4.9727297349e-02,
        ),
        (
            4.6647963344,
            3.9571156086e01,
            2.8698696102e01,
            5.5675370270,
            3.1333340687e-02,
            1.4984928198e-02,
            6.5842344623e-03,
        ),
    ),
}


@dataclass(frozen=True)
class Curve:
    """The regression function as a model whose time axis is an index; x is an input."""

    nist: Nist

    @property
    def variables(self):
        names = [f"b{i + 1}" for i in range(len(self.nist.certified))]
        return {n: Variable(n, "parameter") for n in names} | {"y": Variable("y", "output")}

    def simulate(self, task, parameters):
        with np.errstate(all="ignore"):
            values = [parameters[f"b{i + 1}"] for i in range(len(self.nist.certified))]
            return self.nist.model(task.inputs["x"], *values)[None]


def problem(nist, start):
    x, y = (np.array(text.split(), dtype=float) for text in (nist.x, nist.y))
    task = Task(np.arange(len(x), dtype=float), {"x": x}, ("y",))
    case = measured_case("nist", Curve(nist), task, {"y": y})
    return Problem([case], [ParameterSpec(f"b{i + 1}", float(s)) for i, s in enumerate(start)])


@pytest.mark.parametrize("solver", ["trf", "lm", "dfols"])
@pytest.mark.parametrize(("name", "start"), [(n, s) for n, nist in SETS.items() for s in range(len(nist.starts))])
def test_certified_values(name, start, solver):
    nist = SETS[name]
    result = identify(problem(nist, nist.starts[start]), solver=solver, with_uncertainty=False)
    found = [result.parameters[f"b{i + 1}"] for i in range(len(nist.certified))]
    assert found == pytest.approx(nist.certified, rel=1e-6)


@pytest.mark.parametrize("name", SETS)
def test_certified_standard_deviations(name):
    nist = SETS[name]
    found = identify(problem(nist, nist.certified)).stages[0].uncertainty
    assert found.naive_errors == pytest.approx(nist.deviations, rel=1e-4)
