"""Arrays of components, records, matrices, if-equations, conditional and outer components."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from fmpy import read_model_description
from scipy.linalg import expm

from fmu_build import build, compile_modelica
from fmu_build.errors import ModelicaError
from tests.fmu_build.simulate import Instance, states

STRUCTURE = Path(__file__).parent / "models" / "Structure.mo"
NOTHING = np.zeros(0)


@cache
def instance(name: str) -> Instance:
    return Instance.of(compile_modelica(STRUCTURE, f"Structure.{name}"))


def test_rc_circuit():
    times = np.linspace(0.0, 0.5, 6)
    x = instance("RC").simulate(times, lambda t: (5.0,))
    np.testing.assert_allclose(x[:, 0], 5.0 * (1 - np.exp(-times / 0.1)), atol=1e-8)


def test_array_of_components_connected_in_a_loop():
    ladder = instance("Ladder")
    assert states(ladder.model) == [f"c[{k}].v" for k in (1, 2, 3, 4)]
    a = (np.diag([-2.0, -2, -2, -1]) + np.eye(4, k=1) + np.eye(4, k=-1)) / (10 * 2e-3)
    rng = np.random.default_rng(0)
    v = rng.normal(size=4)
    expected = a @ v + np.array([3.0, 0, 0, 0]) / (10 * 2e-3)
    np.testing.assert_allclose(ladder.derivative(0.0, v, [3.0]), expected, rtol=1e-12)


def test_parallel_capacitors_are_one_state():
    parallel = instance("Parallel")
    assert states(parallel.model) == ["c1.v"]
    x = parallel.simulate([0.0, 0.2], lambda t: (5.0,))
    assert x[-1, 0] == pytest.approx(5.0 * (1 - np.exp(-0.2 / 0.4)))
    assert parallel.get("i2", 0.2, x[-1], [5.0]) == pytest.approx(0.75 * (5.0 - x[-1, 0]) / 100)


def test_records_and_functions_of_records():
    records = instance("Records")
    assert records.get("y", 0.0, NOTHING, [2.0]) == pytest.approx(np.sin(1.5) * 2 + np.cos(1.5))
    assert records.get("n", 0.0, NOTHING, [2.0]) == 3.0


@pytest.mark.parametrize(("u", "m", "y"), [(2.0, (1, 1), 4.0), (-0.5, (0, 1), 1.0), (-3.0, (0, 0), -3.0)])
def test_if_equations_of_different_form(u, m, y):
    i = instance("IfEquations")
    assert i.model.n_m == 2
    env = i.env(0.0, np.zeros(1), [u])
    truth = np.asarray(i.model.functions["indicators"](*env)).ravel() > 0
    assert tuple(map(int, truth)) == m
    env[7] = np.array(m, dtype=float)
    v = np.asarray(i.model.functions["variables"](*env)).ravel()
    where = next(x for x in i.model.variables if x.name == "y").location
    assert v[where.index] == pytest.approx(y)


def test_matrices():
    matrices = instance("Matrices")
    a = np.array([[0, 1, 0], [-4, -0.4, 1], [0, 0, 0]])
    times = np.linspace(0.0, 2.0, 5)
    x = matrices.simulate(times, lambda t: (1.0,))
    np.testing.assert_allclose(x, [(expm(a * t) @ [1, 0, 1])[:2] for t in times], atol=1e-7)
    assert matrices.get("t[2,1]", 0.0, x[0]) == pytest.approx(1.6)
    assert matrices.get("t[2,2]", 0.0, x[0]) == pytest.approx(1 + 0.16 + 1)


def test_conditional_component():
    assert instance("Choice").get("y", 0.0, NOTHING, [2.0]) == 6.0


def test_outer_parameter_is_one_with_the_inner():
    outer = Instance.of(instance("Outer").model, {"g": 2.0})
    np.testing.assert_array_equal(outer.derivative(0.0, np.array([1.0, 0.5, 2.0, 0.0])), [0.5, -2.0, 0.0, -2.0])
    assert [v.name for v in outer.model.variables if v.causality == "parameter"] == ["g"]


@pytest.mark.parametrize("times", [8, 9])
def test_an_equation_is_differentiated_eight_times_and_no_more(tmp_path, times):
    chain = f"for i in 1:{times} loop der(x[i]) = x[i + 1]; end for;"
    file = tmp_path / "Chain.mo"
    file.write_text(f"model Chain Real x[{times + 1}]; equation x[1] = sin(time); {chain} end Chain;")
    if times > 8:
        with pytest.raises(ModelicaError, match="structurally singular"):
            compile_modelica(file, "Chain")
        return
    chained = Instance.of(compile_modelica(file, "Chain"))
    assert states(chained.model) == []
    assert chained.get("x[9]", 0.3, NOTHING, []) == pytest.approx(np.sin(0.3))


def test_second_derivatives_have_the_names_of_fmi(tmp_path):
    (tmp_path / "M.mo").write_text(
        "model M Real q[1, 2](each start = 0.1); Real x[2], y[2], v[2], w[2], F[2]; equation\n"
        "for k in 1:2 loop x[k] = sin(q[1, k]); y[k] = -cos(q[1, k]); v[k] = der(x[k]); w[k] = der(y[k]);\n"
        "der(v[k]) = -F[k]*x[k]; der(w[k]) = -F[k]*y[k] - 9.81; end for; end M;"
    )
    fmu = build(tmp_path / "M.mo", "M", tmp_path)  # which a fixture validates
    names = [v.name for v in read_model_description(str(fmu)).modelVariables]
    assert [n for n in names if "der(q[1,2]" in n] == ["der(q[1,2])", "der(q[1,2],2)"]


def test_constraints_are_judged_where_they_hold(tmp_path):
    (tmp_path / "M.mo").write_text(
        "model M type Free = Real(stateSelect = StateSelect.prefer);\n"
        "Free phi(start = 1, fixed = true), w(start = 0, fixed = true); Real square, s, v, f; equation w = der(phi);"
        " v = der(s); square = 2.25 - cos(phi); s*sqrt(square - 1) = 1;\n"  # NaN at square = 0
        "2*der(v) = -f; der(w) = -(f*s^3/2 + 1)*sin(phi); end M;"
    )
    crank = Instance.of(compile_modelica(tmp_path / "M.mo", "M"))
    assert states(crank.model) == ["phi", "w"]
    x = crank.simulate([0.0, 2.0])[-1]
    assert 0.5 * x[1] ** 2 + crank.get("v", 2.0, x) ** 2 - np.cos(x[0]) == pytest.approx(-np.cos(1.0), abs=1e-6)
