"""NIST Statistical Reference Datasets, nonlinear regression: certified values through the whole engine.

Seventeen of the twenty-seven: of each level of difficulty, but not the long tables of samples.
"""

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


def _three_exponentials(x, a, b, c, d, e, f):
    return a * exp(-b * x) + c * exp(-d * x) + e * exp(-f * x)


_LANCZOS = " ".join(f"{0.05 * k:.2f}" for k in range(24))
_MISRA = (
    "77.6 114.9 141.1 190.8 239.9 289 332.8 378.4 434.8 477.3 536.8 593.1 689.1 760",
    "10.07 14.73 17.94 23.93 29.61 35.18 40.02 44.82 50.76 55.05 61.01 66.4 75.47 81.78",
)
SETS = {
    "Misra1a": Nist(
        lambda x, a, b: a * (1 - exp(-b * x)),
        *_MISRA,
        ((500, 1e-4), (250, 5e-4)),
        (2.3894212918e02, 5.5015643181e-04),
        (2.7070075241, 7.2668688436e-06),
    ),
    "Misra1b": Nist(
        lambda x, a, b: a * (1 - (1 + b * x / 2) ** -2),
        *_MISRA,
        ((500, 1e-4), (300, 2e-4)),
        (3.3799746163e02, 3.9039091287e-04),
        (3.1643950207, 4.2547321834e-06),
    ),
    "Misra1c": Nist(
        lambda x, a, b: a * (1 - (1 + 2 * b * x) ** -0.5),
        *_MISRA,
        ((500, 1e-4), (600, 2e-4)),
        (6.3642725809e02, 2.0813627256e-04),
        (4.6638326572, 1.7728423155e-06),
    ),
    "Misra1d": Nist(
        lambda x, a, b: a * b * x / (1 + b * x),
        *_MISRA,
        ((500, 1e-4), (450, 3e-4)),
        (4.3736970754e02, 3.0227324449e-04),
        (3.6489174345, 2.9334354479e-06),
    ),
    "MGH10": Nist(
        lambda x, a, b, c: a * exp(b / (x + c)),
        "50 55 60 65 70 75 80 85 90 95 100 105 110 115 120 125",
        "34780 28610 23650 19630 16370 13720 11540 9744 8261 7030 6005 5147 4427 3820 3307 2872",
        ((0.02, 4000, 250),),
        (5.6096364710e-03, 6.1813463463e03, 3.4522363462e02),
        (1.5687892471e-04, 2.3309021107e01, 7.8486103508e-01),
    ),
    "MGH17": Nist(
        lambda x, a, b, c, d, e: a + b * exp(-x * d) + c * exp(-x * e),
        " ".join(str(10 * k) for k in range(33)),
        "0.844 0.908 0.932 0.936 0.925 0.908 0.881 0.85 0.818 0.784 0.751 0.718 0.685 0.658 0.628 0.603 0.58"
        " 0.558 0.538 0.522 0.506 0.49 0.478 0.467 0.457 0.448 0.438 0.431 0.424 0.42 0.414 0.411 0.406",
        ((0.5, 1.5, -1, 0.01, 0.02),),
        (3.7541005211e-01, 1.9358469127, -1.4646871366, 1.2867534640e-02, 2.2122699662e-02),
        (2.0723153551e-03, 2.2031669222e-01, 2.2175707739e-01, 4.4861358114e-04, 8.9471996575e-04),
    ),
    "Eckerle4": Nist(
        lambda x, a, b, c: a / b * exp(-0.5 * ((x - c) / b) ** 2),
        "400 405 410 415 420 425 430 435 436.5 438 439.5 441 442.5 444 445.5 447 448.5 450 451.5 453 454.5 456"
        " 457.5 459 460.5 462 463.5 465 470 475 480 485 490 495 500",
        "0.0001575 0.0001699 0.000235 0.0003102 0.0004917 0.000871 0.0017418 0.00464 0.0065895 0.0097302"
        " 0.0149002 0.023731 0.0401683 0.0712559 0.1264458 0.2073413 0.2902366 0.3445623 0.3698049 0.3668534"
        " 0.3106727 0.2078154 0.1164354 0.0616764 0.03372 0.0194023 0.0117831 0.0074357 0.0022732 0.00088"
        " 0.0004579 0.0002345 0.0001586 0.0001143 0.000071",
        ((1.5, 5, 450),),
        (1.5543827178, 4.0888321754, 4.5154121844e02),
        (1.5408051163e-02, 4.6803020753e-02, 4.6800518816e-02),
    ),
    "Roszman1": Nist(
        lambda x, a, b, c, d: a - b * x - arctan(c / (x - d)) / np.pi,
        "-4868.68 -4868.09 -4867.41 -3375.19 -3373.14 -3372.03 -2473.74 -2472.35 -2469.45 -1894.65 -1893.4"
        " -1497.24 -1495.85 -1493.41 -1208.68 -1206.18 -1206.04 -997.92 -996.61 -996.31 -834.94 -834.66 -710.03"
        " -530.16 -464.17",
        "0.252429 0.252141 0.251809 0.297989 0.296257 0.295319 0.339603 0.337731 0.33382 0.38951 0.386998"
        " 0.438864 0.434887 0.427893 0.471568 0.461699 0.461144 0.513532 0.506641 0.505062 0.535648 0.533726"
        " 0.568064 0.612886 0.624169",
        ((0.1, -1e-5, 1000, -100), (0.2, -5e-6, 1200, -150)),
        (2.0196866396e-01, -6.1953516256e-06, 1.2044556708e03, -1.8134269537e02),
        (1.9172666023e-02, 3.2058931691e-06, 7.4050983057e01, 4.9573513849e01),
    ),
    "Lanczos1": Nist(
        _three_exponentials,
        _LANCZOS,
        # NIST made the samples by the formula, to fourteen digits.
        " ".join(
            repr(round(float(_three_exponentials(0.05 * k, 0.0951, 1, 0.8607, 3, 1.5576, 5)), 12))
            for k in range(24)
        ),
        ((0.5, 0.7, 3.6, 4.2, 4, 6.3),),
        (9.5100000027e-02, 1.0000000001, 8.6070000013e-01, 3.0000000002, 1.5575999998, 5.0000000001),
        (),  # of 1e-11
    ),
    "Lanczos2": Nist(
        _three_exponentials,
        _LANCZOS,
        "2.5134 2.04433 1.6684 1.36642 1.12323 0.92689 0.767934 0.638878 0.533784 0.447936 0.377585 0.319739"
        " 0.272013 0.232497 0.199659 0.17227 0.149341 0.13007 0.113812 0.100042 0.0883321 0.0783354 0.0697669"
        " 0.0623931",
        ((0.5, 0.7, 3.6, 4.2, 4, 6.3),),
        (9.6251029939e-02, 1.0057332849, 8.6424689056e-01, 3.0078283915, 1.5529016879, 5.0028798100),
        (
            6.6770575477e-04,
            3.3989646176e-03,
            1.7185846685e-03,
            4.1707005856e-03,
            2.3744381417e-03,
            1.3958787284e-03,
        ),
    ),
    "Lanczos3": Nist(
        _three_exponentials,
        _LANCZOS,
        "2.5134 2.0443 1.6684 1.3664 1.1232 0.9269 0.7679 0.6389 0.5338 0.4479 0.3776 0.3197 0.272 0.2325 0.1997"
        " 0.1723 0.1493 0.1301 0.1138 0.1 0.0883 0.0783 0.0698 0.0624",
        ((0.5, 0.7, 3.6, 4.2, 4, 6.3),),  # from the farther start one-sided differences leave 5.5 digits
        (8.6816414977e-02, 9.5498101505e-01, 8.4400777463e-01, 2.9515951832, 1.5825685901, 4.9863565084),
        (
            1.7197908859e-02,
            9.7041624475e-02,
            4.1488663282e-02,
            1.0766312506e-01,
            5.8371576281e-02,
            3.4436403035e-02,
        ),
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


# Without derivatives three exponentials (Lanczos) are out of reach; the slow ones take 5 s or more.
_SLOW = {"MGH10", "Misra1a", "Misra1b", "Misra1c", "Misra1d", "Thurber", "MGH17"}
_RUNS = [(name, s, solver) for name, n in SETS.items() for s in range(len(n.starts)) for solver in ("trf", "lm")]
_RUNS += [
    pytest.param(name, s, "dfols", marks=[pytest.mark.slow] if name in _SLOW else [])
    for name, n in SETS.items()
    for s in range(len(n.starts))
    if not name.startswith("Lanczos")
]


@pytest.mark.parametrize(("name", "start", "solver"), _RUNS)
def test_certified_values(name, start, solver):
    nist = SETS[name]
    result = identify(problem(nist, nist.starts[start]), solver=solver, with_uncertainty=False)
    found = [result.parameters[f"b{i + 1}"] for i in range(len(nist.certified))]
    assert found == pytest.approx(nist.certified, rel=1e-6)


@pytest.mark.parametrize("name", [name for name, nist in SETS.items() if nist.deviations])
def test_certified_standard_deviations(name):
    nist = SETS[name]
    found = identify(problem(nist, nist.certified)).stages[0].uncertainty
    assert found.naive_errors == pytest.approx(nist.deviations, rel=1e-4)
