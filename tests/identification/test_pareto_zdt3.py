"""A front in five pieces with local fronts behind them: ZDT3 (Zitzler, Deb and Thiele, 2000)."""

import numpy as np
import pytest

from fmuid import AnalysisSpec, CriterionSpec, ParameterSpec, ParetoSpec, Problem, Task, identify, measured_case
from fmuid.identification.problem.combination import Combination

PIECES = [(0.0, 0.0830), (0.1822, 0.2578), (0.4093, 0.4539), (0.6183, 0.6525), (0.8233, 0.8518)]
SHIFT = 1.0  # so that both objectives are positive


def zdt3(time, inputs, p):
    f = p["x0"]
    g = 1.0 + 9.0 * np.mean([v for n, v in p.items() if n != "x0"])
    return {"f": f, "g": g * (1.0 - np.sqrt(f / g) - f / g * np.sin(10.0 * np.pi * f)) + SHIFT}


@pytest.mark.parametrize("n", [2, 4])
def test_all_pieces_of_a_broken_front_are_found(analytic, n):
    names = [f"x{k}" for k in range(n)]
    task = Task(np.arange(2.0), {}, ("f", "g"))
    case = measured_case(
        "front",
        analytic(zdt3, names, ("f", "g")),
        task,
        {"f": np.zeros(2), "g": np.zeros(2)},
        criteria=[CriterionSpec(s, "error_vector") for s in ("f", "g")],
    )
    specs = [ParameterSpec(name, 0.4, 0.0, 1.0) for name in names]
    asked = Problem([case], specs, combination=Combination("min_max"))
    front = identify(asked, analyses=AnalysisSpec(pareto=ParetoSpec(points=21))).stages[0].front
    f = np.array([p.values[0] for p in front.points])
    true = [zdt3(None, None, dict.fromkeys(names, 0.0) | {"x0": x})["g"] for x in f]
    np.testing.assert_allclose([p.values[1] for p in front.points], true, atol=5e-3)
    inside = [np.sum((f >= low - 5e-3) & (f <= high + 5e-3)) for low, high in PIECES]
    assert min(inside) >= 2
    assert sum(inside) == len(f)
    assert len(f) >= 15
    assert front.message.startswith("complete")
