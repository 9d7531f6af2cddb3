"""Derivatives of whole runs: exact through reversals, the same from both steppers and from workers."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest

from fmu_build import build as build_modelica
from fmuid.core.campaign import CriterionSpec, ParameterSpec
from fmuid.core.errors import FmuError
from fmuid.core.formulas import parse
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.observed import Observed, project_off
from fmuid.diagnosis.refit import refit
from fmuid.diagnosis.scores import score_effects
from fmuid.effects.effect import Effect, Unknown
from fmuid.identification.problem.cases import measured_case
from fmuid.identification.problem.derivatives import Differences, noise_floor
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.search_space import expanded
from fmuid.identification.solvers.least_squares import TrustRegion
from fmuid.identification.solvers.search import Search, Status
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.pool.workers import WorkerPool
from fmuid.simulation.runners import in_process
from fmuid.simulation.segmented import Segmented
from fmuid.simulation.simulator import Task

MODEL = """
model Slider "A mass that reverses in dry friction"
  parameter Real m = 0.8;
  parameter Real d = 0.5;
  parameter Real fc[2] = {0.4, 0.4} "Coulomb friction forward, backward";
  input Real u;
  output Real x(start = 0, fixed = true);
  output Real v(start = 0.1, fixed = true);
protected
  Real z(start = 0, fixed = true) "Bristle";
  Real level = if noEvent(v > 0) then fc[1] else fc[2];
equation
  der(x) = v;
  m*der(v) = u - d*v - level*z;
  0.002*der(z) = v - abs(v)*z;
end Slider;
"""
TIME = 5e-3 * np.arange(401)
TASK = Task(TIME, {"u": 1.5 * np.sign(np.sin(2 * np.pi * 1.3 * TIME))}, ("x", "v"), tolerance=1e-9)
VALUES = {"m": 0.8, "d": 0.5, "fc[1]": 0.4, "fc[2]": 0.4}
ALONG = ({"m": 1.0}, {"d": 2.0}, {"fc[1]": 1.0, "fc[2]": 1.0}, {"v": 1.0})


def made(folder, text):
    """The FMU of the model in a Modelica text."""
    name = text.split()[1]
    (folder / f"{name}.mo").write_text(text)
    return Fmu(build_modelica(folder / f"{name}.mo", name, folder))


@pytest.fixture(scope="module")
def slider(tmp_path_factory):
    return made(tmp_path_factory.mktemp("slider"), MODEL).path


def test_derivatives_are_those_of_accurate_runs_through_reversals(slider):
    fmu = Fmu(slider)
    assert fmu.differentiates(["m", "d", "fc[1]", "v"])
    assert not fmu.differentiates(["m", "u"])
    assert not fmu.differentiates(["nothing"])
    got = fmu.simulate(replace(TASK, along=ALONG), VALUES)
    assert np.array_equal(got[:2], fmu.simulate(TASK, VALUES))
    assert np.count_nonzero(np.diff(np.sign(got[1]))) >= 4
    start = {**VALUES, "v": 0.1}
    for direction, rows in zip(ALONG, got[2:].reshape(-1, 2, len(TIME)), strict=True):
        ends = [
            fmu.simulate(
                replace(TASK, tolerance=1e-12), start | {n: start[n] + s * 1e-4 * w for n, w in direction.items()}
            )
            for s in (1, -1)
        ]
        exact = (ends[0] - ends[1]) / 2e-4
        error = np.linalg.norm(rows - exact, axis=1) / np.linalg.norm(exact, axis=1)
        assert np.all(error < 2e-3), (direction, error)


@pytest.mark.parametrize("interpolation", ["hold", "linear"])
def test_inputs_move_along_directions_by_courses_of_their_own(slider, interpolation):
    fmu = Fmu(slider)
    assert fmu.moves_inputs
    task = replace(TASK, interpolation=interpolation, tolerance=1e-12)
    courses = np.array(
        [np.ones(401), np.sin(9.0 * TIME), np.maximum(0.0, TIME - 1.0), np.sign(np.sin(14.0 * TIME))]
    )
    got = fmu.simulate(replace(task, along=({},) * 3 + ({"m": 0.5},), driven={"u": courses}), VALUES)
    assert got[:2] == pytest.approx(fmu.simulate(task, VALUES), abs=1e-9)
    for k, (course, rows) in enumerate(zip(courses, got[2:].reshape(-1, 2, len(TIME)), strict=True)):
        ends = [
            fmu.simulate(
                replace(task, inputs={"u": task.inputs["u"] + s * 1e-4 * course}),
                {**VALUES, "m": 0.8 + s * 0.5e-4 * (k == 3)},
            )
            for s in (1, -1)
        ]
        exact = (ends[0] - ends[1]) / 2e-4
        error = np.linalg.norm(rows - exact, axis=1) / np.linalg.norm(exact, axis=1)
        assert np.all(error < 2e-3), (k, error)


def test_a_table_that_moves_as_one_has_the_sum_of_its_entries_derivatives(tmp_path):
    fmu = made(
        tmp_path,
        """
        model Table "Damping by speed, between points of a table"
          parameter Real d[12] = {2.0 + 0.1*k for k in 1:12};
          parameter Real m = 0.8;
          input Real u;
          output Real v(start = 0, fixed = true);
          Real w[5](each start = 0, each fixed = true) "Of bodies that are dragged along";
          Real friction = (v - w[1])*sum(d[k]*noEvent(max(0, 1 - abs(5*abs(v - w[1]) - k + 1))) for k in 1:12);
        equation
          m*der(v) = u - friction;
          der(w) = {friction*k - w[k] for k in 1:5};
        end Table;
        """,
    )
    entries = [f"d[{k}]" for k in range(1, 13)]
    each, one = ({name: 1.0} for name in entries), dict.fromkeys(entries, 1.0)
    task = replace(TASK, inputs={"u": 4.0 * TASK.inputs["u"]}, outputs=("v",))
    together = fmu.simulate(replace(task, along=(one,)), {})[1]
    apart = fmu.simulate(replace(task, along=({"m": 1.0}, *each)), {})[2:]
    assert np.count_nonzero(np.ptp(apart, axis=1)) >= 6
    assert together == pytest.approx(apart.sum(axis=0), rel=1e-9, abs=1e-12)
    mixed = fmu.simulate(replace(task, along=({"m": 1.0}, one)), {})[1:]
    assert mixed[1] == pytest.approx(together, rel=1e-9, abs=1e-12)


def test_many_directions_at_once_are_those_one_by_one(tmp_path):
    fmu = made(
        tmp_path,
        """
        model Wall "Damping from a table, whose entries come into play one after the other, and a wall that throws back"
          parameter Real d[30] = {0.3 + 0.01*k for k in 1:30};
          parameter Real m = 0.8;
          input Real u;
          output Real x(start = 0, fixed = true);
          output Real v(start = 0, fixed = true);
        equation
          der(x) = v;
          m*der(v) = u - v*sum(d[k]*noEvent(max(0, 1 - abs(8*abs(v) - k + 1))) for k in 1:30);
          when x > 0.3 then
            reinit(v, -0.7*pre(v));
          end when;
        end Wall;
        """,
    )
    names = [f"d[{k}]" for k in range(1, 31)] + ["x", "m"]
    task = replace(TASK, inputs={"u": 4.0 * TIME * np.sin(9.0 * TIME)})
    together = fmu.simulate(replace(task, along=tuple({n: 1.0} for n in names)), {})[2:].reshape(len(names), 2, -1)
    begins = [np.flatnonzero(np.any(rows != 0.0, axis=0)) for rows in together]
    assert sum(b.size == 0 for b in begins) >= 5  # speeds that are never reached
    assert len({b[0] for b in begins if b.size}) >= 8
    for name, rows in zip(names, together, strict=True):
        alone = fmu.simulate(replace(task, along=({name: 1.0},)), {})[2:]
        assert rows == pytest.approx(alone, rel=1e-9, abs=1e-10), name


def test_workers_agree(slider):
    task = replace(TASK, along=ALONG[:2], tolerance=1e-5)
    fast = Fmu(slider).simulate(task, VALUES)
    with WorkerPool(1) as pool:
        (far,) = pool.run([(Fmu(slider), task, VALUES)])
    assert np.array_equal(far, fast)


def _problem(path, *, start):
    """A search on both scales, with a tie, a bound that is touched, a sensor and two criteria."""
    fmu = Fmu(path)
    truth = fmu.simulate(
        replace(TASK, tolerance=1e-10), {"m": 1.0, "d": 0.3, "fc[1]": 0.35, "fc[2]": 0.35, "v": 0.0}
    )
    noise = np.random.default_rng(0).normal(0.0, [[1e-4], [1e-3]], truth.shape)
    case = measured_case(
        "run",
        fmu,
        replace(TASK, start_values={"v": 0.0}),
        dict(zip(TASK.outputs, truth * [[1.0], [1.02]] + noise, strict=True)),
        sigma={"x": 1e-4, "v": 1e-3},
        criteria=(CriterionSpec("x"), CriterionSpec("v", weight=0.5)),
        parameters={"forward": "fc[1]", "backward": "fc[2]"},
    )
    gain = {"gain": parse("scale", where="test")}
    case = replace(case, channels=(case.channels[0], replace(case.channels[1], sensor=gain)))
    specs = [
        ParameterSpec("m", start["m"], 0.1, 10.0, scale="log"),
        ParameterSpec("d", start["d"], 0.0, 5.0),
        ParameterSpec("forward", start["f"], 0.0, 5.0),
        ParameterSpec("backward", 0.4, 0.0, 5.0),
        ParameterSpec("scale", 1.0, 0.5, 2.0),
    ]
    free = ["m", "d", "forward", "scale"]
    return Problem([case], expanded(specs, free, {}, {"backward": "1.0 * forward"}, ["run"]))


def test_the_jacobian_of_a_problem_is_that_of_differences(slider, monkeypatch):
    jacobians = []
    for able in (True, False):
        if not able:
            monkeypatch.setattr(Fmu, "differentiates", lambda *_: False)
        problem = _problem(slider, start={"m": 0.8, "d": 0.0, "f": 0.4})
        here, floor = problem.evaluate(problem.space.start), noise_floor(problem, problem.space.start)
        jobs = []
        problem.runner = lambda asked, jobs=jobs: jobs.extend(asked) or in_process(asked)
        differences = Differences(problem, floor, central=True)
        jacobian = differences.jacobian(problem.evaluate_many, here)
        if able:
            assert np.array_equal(differences.jacobian(problem.evaluate_many, here), jacobian)
        jacobians.append((jacobian, len(jobs)))
    (exact, fewer), (finite, more) = jacobians
    assert fewer == 1  # nothing is done twice
    assert more >= 5
    error = np.linalg.norm(exact - finite, axis=0) / np.linalg.norm(finite, axis=0)
    assert np.all(error < [2e-3, 2e-2, 2e-3, 1e-6])  # d is at its bound: a one-sided difference


def test_a_search_ends_at_the_same_optimum_with_either_jacobian(slider, monkeypatch):
    ends = []
    for exact in (True, False):
        if not exact:
            monkeypatch.setattr(Fmu, "differentiates", lambda *_: False)
        purposes = []
        problem = _problem(slider, start={"m": 0.8, "d": 0.5, "f": 0.4})
        search = Search(problem, record=lambda _, purpose, __, purposes=purposes: purposes.append(purpose))
        assert TrustRegion().solve(search, search.problem.space.start).status is Status.CONVERGED
        ends.append((search.best, [key for key, _ in groupby(purposes)].count("derivative")))
    (a, once), (b, always) = ends
    assert a.parameters == pytest.approx(
        {**a.parameters, "m": 1.0, "d": 0.3, "forward": 0.35, "scale": 1.02}, rel=2e-2
    )
    assert a.cost == pytest.approx(b.cost, rel=1e-4)
    assert a.x == pytest.approx(b.x, rel=1e-3)
    assert once <= 1  # for the noise of the simulations, no slope among them
    assert always > 2


def test_other_fmus_have_none(build):
    fmu = Fmu(build(2))
    assert not fmu.differentiates(["c"])
    with pytest.raises(FmuError, match="cannot differentiate"):
        fmu.simulate(Task(TIME, {}, ("x",), along=({"c": 1.0},)), {})


def test_a_diagnosis_takes_exact_derivatives(slider):
    fmu = Fmu(slider)
    noise = np.random.default_rng(0)
    task = replace(TASK, start_values={"v": 0.0}, tolerance=1e-8)
    y = fmu.simulate(task, {"m": 1.0, "d": 0.3, "fc[1]": 0.35, "fc[2]": 0.38})
    runs = y + noise.normal(0.0, [[[1e-4], [1e-3]]], (4, *y.shape))
    case = replace(measured_case("run", fmu, task, {"x": runs[:, 0], "v": runs[:, 1]}), setup="bench")
    batches = []
    model = CampaignModel(
        (case,),
        lambda asked: batches.append(len(asked)) or in_process(asked),
        fixed={"friction": 0.36},
        tie={"fc[2]": parse("1.05 * friction", where="test"), "fc[1]": parse("friction", where="test")},
    )
    unknowns = [
        Unknown("m", 0.8, 0.1, 10.0, 1e-4),
        Unknown("d", 0.5, -5.0, 5.0, 1e-4),
        Unknown("friction", 0.4, 0.0, 5.0, 1e-4),
        Unknown("v", 0.01, -1.0, 1.0, 1e-4),
    ]
    effect = Effect(
        "late", "late", "drive", (Unknown("u.delay", 0.0, 0.0, 0.1, 1e-3),), {"u.delay": 0.0}, ({"u.delay": 0.01},)
    )
    observed = Observed.from_runs(model.runs)
    fits = []
    for tangents in (model.tangents, None):
        batches.clear()
        fit = refit(model.predict, observed, unknowns, tangents=tangents, tolerance=1e-9, max_iterations=30)
        (score,) = score_effects(model.predict, observed, fit, [effect])
        fits.append((fit, score, [size for size in batches if size > 1]))
    (exact, a, once), (finite, b, always) = fits
    assert len(once) <= len(always)  # differences are taken at the end alone, of a plausible size
    assert set(once) == {len(unknowns)}
    assert set(always) <= {len(unknowns), 2 * len(unknowns)}  # to one side, and far to either side
    assert len(always) > 2
    assert exact.cost == pytest.approx(finite.cost, rel=1e-3)
    assert exact.values == pytest.approx(finite.values, rel=3e-2, abs=3e-3)
    assert a.drop == pytest.approx(b.drop, rel=1e-3)
    slopes = np.linalg.norm(exact.jacobian[0] - finite.jacobian[0], axis=0)
    assert np.all(slopes < 2e-2 * np.linalg.norm(finite.jacobian[0], axis=0))


def test_exact_derivatives_pass_through_effects_on_signals(slider):
    fmu = Fmu(slider)
    task = replace(TASK, tolerance=1e-10)
    case = measured_case("run", fmu, task, {name: fmu.simulate(task, {})[[k]] for k, name in enumerate("xv")})
    model = CampaignModel((case,))
    values = {"m": 0.8, "d": 0.5, "x.lag": 0.05, "v.crosstalk[x]": 0.2, "u.gain": 0.1}
    exact = model.tangents(values, ["m", "d", "x.lag"])
    assert set(exact) == {"m", "d"}
    for name, (slope,) in exact.items():
        ends = ({**values, name: values[name] + step} for step in (1e-4, -1e-4))
        (above,), (below,) = (model.predict([end])[0] for end in ends)
        assert slope == pytest.approx((above - below) / 2e-4, rel=1e-3, abs=1e-3 * np.abs(slope).max())


@pytest.mark.parametrize("segmented", [False, True])
def test_one_run_gives_the_responses_to_many_courses_at_a_port(tmp_path, segmented):
    fmu = made(
        tmp_path,
        MODEL.replace("input Real u;", "input Real u; input Real f(start = 0);").replace("= u -", "= u + f -"),
    )
    task = replace(TASK, tolerance=1e-10)
    y = fmu.simulate(task, VALUES)
    model = Segmented(fmu, task, 0.5, y, np.ones_like(y), at=VALUES) if segmented else fmu
    batches = []
    campaign = CampaignModel(
        (measured_case("run", model, task, {name: y[[k]] for k, name in enumerate("xv")}),),
        lambda asked: batches.append(len(asked)) or in_process(asked),
    )
    values = VALUES if segmented else {**VALUES, "v.crosstalk[x]": 0.2}
    courses = [[np.ones(401)], [np.sin(9.0 * TIME)], [np.maximum(0.0, TIME - 1.0)]]
    moved = campaign.moved_by(values, "f", 1e-3, courses)
    assert batches == [1]
    (base,) = campaign.predict([values], near=values)
    driven = campaign.predict_driven(values, [{"f": [1e-3 * u for u in course]} for course in courses])
    for (got,), (wanted,) in zip(moved, driven, strict=True):
        response = wanted - base[0]
        if segmented:  # what fits of the states explain is not in it
            tangents = model.state_tangents(VALUES).reshape(-1, response.size).T
            response = project_off(response.ravel(), np.linalg.qr(tangents)[0]).reshape(response.shape)
            got = project_off(got.ravel(), np.linalg.qr(tangents)[0]).reshape(response.shape)
        assert np.linalg.norm(got - response) < 0.04 * np.linalg.norm(response)


def test_a_run_whose_model_has_no_such_port_is_not_moved_and_not_simulated(tmp_path, slider):
    fmu = made(
        tmp_path,
        MODEL.replace("input Real u;", "input Real u; input Real f(start = 0);").replace("= u -", "= u + f -"),
    )
    cases = []
    for name, model in (("without", Fmu(slider)), ("with", fmu)):
        y = model.simulate(TASK, VALUES)
        cases.append(measured_case(name, model, TASK, {n: y[[k]] for k, n in enumerate("xv")}))
    simulated = []
    campaign = CampaignModel(
        tuple(cases), lambda asked: simulated.extend(job[0] for job in asked) or in_process(asked)
    )
    ((still, moved),) = campaign.moved_by(VALUES, "f", 1e-3, [[np.ones(401)] * 2])
    assert simulated == [fmu]
    assert not still.any()
    assert still.shape == moved.shape
    assert moved.any()
