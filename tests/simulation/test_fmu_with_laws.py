"""Laws that are added to the derivatives of a Model Exchange FMU, in an FMU that contains it."""

from __future__ import annotations

import math
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp

from fmu_build.errors import ModelicaError
from fmu_build.instrument import Added, State
from fmuid.core.errors import FmuError, SimulationError
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.fmu_copy import copy_with_starts
from fmuid.simulation.fmu_with_laws import CoefficientLaw, StateLaw, write_fmu_with_laws
from fmuid.simulation.law_code import OPERATIONS, Operand, code_of
from fmuid.simulation.simulator import Task
from tests.foreign_fmus.plants import PLANTS, plant_fmu
from tests.reference.plain_fmpy import simulate_fmu

TIME = np.linspace(0.0, 1.0, 101)
TORQUE = 0.2 * np.sin(9 * TIME)
OUTPUTS = ("w1", "w2", "phi2")
DRAG, BRISTLE, SIZE, DISTANCE = "w2.quadratic", "w2.presliding_bristle", "w2.presliding", "w2.presliding_distance"
ADDED = [
    Added(DRAG, 0.0, "rad-1"),
    Added(SIZE, 0.0, "rad.s-2"),
    Added(DISTANCE, 0.01, "rad"),
    Added("der(w1).added_flow", 0.0, "rad.s-2", input=True),
]
LAWS = [
    StateLaw("w2", f"{DRAG}*w2*abs(w2)", {DRAG: 0.0}),
    StateLaw("w2", f"{SIZE}*{BRISTLE}", {SIZE: 0.0}, (State(BRISTLE, f"(w2 - abs(w2)*{BRISTLE})/{DISTANCE}"),)),
    StateLaw("w1", "der(w1).added_flow"),
]


@pytest.fixture(scope="module", params=[2, 3])
def drive(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return plant_fmu("DRIVE", tmp_path_factory.mktemp("drive"), request.param)


@pytest.fixture(scope="module")
def with_laws(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("laws ä%") / "Drive.fmu"
    write_fmu_with_laws(Fmu(drive, "model exchange"), LAWS, ADDED, target)
    return target


def exact(drag: float = 0.0, size: float = 0.0, distance: float = 0.01, added: float = 0.0) -> np.ndarray:
    """What SciPy makes of the same equations; inputs are held."""
    p = PLANTS["DRIVE"].nominal
    x, rows = np.zeros(5), [np.zeros(5)]
    for k, tau in enumerate(TORQUE[:-1]):

        def slope(_: float, x: np.ndarray, tau: float = tau) -> np.ndarray:
            plain = PLANTS["DRIVE"].slope(x, [tau], p)
            law = drag * x[3] * abs(x[3]) + size * x[4]
            return np.array([*plain[:2], plain[2] - added, plain[3] - law, (x[3] - abs(x[3]) * x[4]) / distance])

        x = solve_ivp(slope, TIME[k : k + 2], x, "LSODA", rtol=1e-9, atol=1e-10).y[:, -1]
        rows.append(x)
    return np.array(rows)[:, [2, 3, 1]].T


def test_without_sizes_it_is_the_contained_fmu_bit_for_bit(drive, with_laws):
    for interpolation, tolerance in (("hold", 0.0), ("linear", 1e-8)):  # slopes of inputs are rounded
        task = Task(TIME, {"tau": TORQUE}, OUTPUTS, interpolation=interpolation)
        plain = Fmu(drive, "model exchange").simulate(task, {"J1": 3e-3})
        np.testing.assert_allclose(Fmu(with_laws).simulate(task, {"J1": 3e-3}), plain, rtol=0, atol=tolerance)


@pytest.mark.parametrize("values", [{"drag": 0.3}, {"size": 6.0}, {"drag": 0.1, "size": 3.0, "distance": 0.02}])
def test_laws_and_their_states_act_as_scipy_says(with_laws, values):
    fmu = Fmu(with_laws)
    task = Task(TIME, {"tau": TORQUE}, OUTPUTS, tolerance=1e-8)
    names = {"drag": DRAG, "size": SIZE, "distance": DISTANCE}
    simulated = fmu.simulate(task, {names[n]: v for n, v in values.items()})
    reference = exact(**values)
    np.testing.assert_allclose(simulated, reference, atol=2e-6 * np.abs(reference).max())
    assert np.abs(simulated - exact()).max() > 1e-2  # it does act
    assert fmu.renewal == "reset"


def test_elements_of_arrays_are_set(build, tmp_path):
    """`sum` is of a table of 2 by 3 entries, the k-th of which is weighted by k."""
    fmu = Fmu(build(3, ("ModelExchange",)), "model exchange")
    write_fmu_with_laws(fmu, [], [], tmp_path / "Laws.fmu")
    task = Task(np.linspace(0.0, 0.1, 3), {}, ("sum", "table[1,2]"))
    laws = Fmu(tmp_path / "Laws.fmu")
    for values in ({"table[1,2]": 3.0}, {"table[1,2]": 3.0, "table[2,1]": 7.0}, {}):
        np.testing.assert_array_equal(laws.simulate(task, values), fmu.simulate(task, values))
    assert laws.simulate(task, {"table[1,2]": 3.0})[0, 0] > laws.simulate(task, {})[0, 0]


def test_a_driven_input_is_taken_from_the_derivative(with_laws):
    task = Task(TIME, {"tau": TORQUE, "der(w1).added_flow": np.full(TIME.size, 4.0)}, OUTPUTS, tolerance=1e-8)
    fmu = Fmu(with_laws)
    for shared in (None, ("course", 50)):  # no state is kept where runs begin alike
        np.testing.assert_allclose(fmu.simulate(replace(task, shared=shared), {}), exact(added=4.0), atol=1e-5)


def test_a_reset_of_the_contained_fmu_that_forgets_little_is_noticed(build, tmp_path):
    contained = build(2, ("ModelExchange",), ("RESET_FORGETS_STATE",))
    law = StateLaw("v", "v.drag*v", {"v.drag": 0.0})
    write_fmu_with_laws(Fmu(contained, "model exchange"), [law], [Added("v.drag", 0.0)], tmp_path / "Laws.fmu")
    fmu, task = Fmu(tmp_path / "Laws.fmu"), Task(TIME, {}, ("x", "v"))
    first = fmu.simulate(task, {"v.drag": 0.5})
    np.testing.assert_array_equal(fmu.simulate(task, {"v.drag": 0.5}), first)
    assert fmu.renewal == "instantiate"


@pytest.mark.parametrize("fmi", [2, 3])
def test_directional_derivatives_serve_with_laws_and_their_states(build, tmp_path, fmi):
    """The FMU's derivatives have an error of 1e-8, which differences would amplify; one law has a state."""
    laws = [
        StateLaw("v", "v.drag*v*abs(v)", {"v.drag": 0.0}),
        StateLaw("v", "v.slow*z", {"v.slow": 0.0}, (State("z", "20*(v - z)"),)),
    ]
    added = [Added("v.drag", 0.0), Added("v.slow", 0.0)]
    fmu = Fmu(build(fmi, ("ModelExchange",), ("NOISE=1e-8",)), "model exchange")
    write_fmu_with_laws(fmu, laws, added, tmp_path / "Laws.fmu")
    time, values = np.linspace(0.0, 1.0, 101), {"c": 400.0, "d": 2.0}
    task = Task(time, {}, ("x", "count"), {"level": -1.0}, tolerance=1e-6)
    plain = Fmu(tmp_path / "Laws.fmu").simulate(task, values)
    np.testing.assert_array_equal(plain, fmu.simulate(task, values))
    sizes = {"v.drag": 0.8, "v.slow": 5.0}
    x, calls = Fmu(tmp_path / "Laws.fmu").simulate(task, {**values, **sizes})

    def slope(_: float, x: np.ndarray) -> list[float]:
        a = -400.0 * x[0] - 2.0 * x[1] - 0.8 * x[1] * abs(x[1]) - 5.0 * x[2]
        return [x[1], a, 20.0 * (x[1] - x[2])]

    reference = solve_ivp(slope, (0.0, 1.0), [0.1, 0.0, 0.0], t_eval=time, rtol=1e-10, atol=1e-12).y[0]
    np.testing.assert_allclose(x, reference, atol=3e-6)
    assert np.abs(x - plain[0]).max() > 1e-2
    assert calls[-1] < 20 * len(time)


VARYING = {  # a stiffness that grows with the speed, a damping that warms up, and an inertia that grows with time
    "c": CoefficientLaw("c", "p*(1 + c.speed*abs(w2))", {"c.speed": 0.0}),
    "d": CoefficientLaw("d", "p*(1 + d.warmth*heat)", {"d.warmth": 0.0}, (State("heat", "abs(w1) - heat/0.2"),)),
    "J2": CoefficientLaw("J2", "p*(1 + J2.time*time)", {"J2.time": 0.0}),
}


@pytest.mark.parametrize("values", [{"c.speed": 0.08}, {"d.warmth": 6.0}, {"J2.time": 1.5}])
def test_parameters_vary_as_scipy_says(drive, tmp_path, values):
    target = tmp_path / "Varying.fmu"
    write_fmu_with_laws(Fmu(drive, "model exchange"), list(VARYING.values()), [Added(n, 0.0) for n in ("c.speed", "d.warmth", "J2.time")], target)  # fmt: skip
    fmu, task = Fmu(target), Task(TIME, {"tau": TORQUE}, OUTPUTS, tolerance=1e-8)
    of_model = {"c": 12.0, "d": 0.03, "J2": 4e-3}
    plain = fmu.simulate(task, of_model)
    np.testing.assert_array_equal(plain, Fmu(drive, "model exchange").simulate(task, of_model))
    x, rows = np.zeros(5), [np.zeros(5)]
    for k, tau in enumerate(TORQUE[:-1]):

        def slope(t: float, x: np.ndarray, tau: float = tau) -> np.ndarray:
            c = of_model["c"] * (1 + values.get("c.speed", 0.0) * abs(x[3]))
            d = of_model["d"] * (1 + values.get("d.warmth", 0.0) * x[4])
            inertia = of_model["J2"] * (1 + values.get("J2.time", 0.0) * t)
            moved = PLANTS["DRIVE"].slope(x, [tau], (PLANTS["DRIVE"].nominal[0], c, d, inertia))
            return np.array([*moved, abs(x[2]) - x[4] / 0.2])

        x = solve_ivp(slope, TIME[k : k + 2], x, "LSODA", rtol=1e-9, atol=1e-10).y[:, -1]
        rows.append(x)
    reference = np.array(rows)[:, [2, 3, 1]].T
    for _ in range(2):  # the second time after a reset
        simulated = fmu.simulate(task, {**of_model, **values})
        np.testing.assert_allclose(simulated, reference, atol=5e-6 * np.abs(reference).max())
    assert np.abs(simulated - plain).max() > 1e-3 * np.abs(plain).max()
    np.testing.assert_allclose(simulate_fmu(target, task, {**of_model, **values}, 1e-8), simulated, atol=1e-9)
    if "c.speed" in values:
        with pytest.raises(SimulationError, match="a parameter whose value is zero cannot vary"):
            fmu.simulate(task, {**of_model, **values, "c": 0.0})


def test_any_tool_can_run_it_and_copies_start_with_their_values(with_laws, tmp_path):
    assert validate_fmu(str(with_laws)) == []
    copy = tmp_path / "Copy.fmu"
    copy_with_starts(Fmu(with_laws), {DRAG: 0.3, "J2": 4e-3}, copy)
    task = Task(TIME, {"tau": TORQUE}, OUTPUTS)
    expected = Fmu(with_laws).simulate(task, {DRAG: 0.3, "J2": 4e-3})
    np.testing.assert_array_equal(Fmu(copy).simulate(task, {}), expected)
    np.testing.assert_allclose(simulate_fmu(copy, task, {}, tolerance=1e-6), expected, atol=1e-9)


def test_the_same_laws_give_the_same_bytes(drive, with_laws, tmp_path):
    write_fmu_with_laws(Fmu(drive, "model exchange"), LAWS, ADDED, tmp_path / "Again.fmu")
    assert (tmp_path / "Again.fmu").read_bytes() == with_laws.read_bytes()


def test_a_damaged_list_of_laws_is_refused(with_laws, tmp_path):
    with zipfile.ZipFile(with_laws) as archive:
        laws = archive.read("resources/laws.txt").decode().split("\n")
    first = next(i for i, line in enumerate(laws) if line.startswith("1 1 "))
    program = laws[first + 1].split()
    for damage in ("1 9999", "99 0", "7 0"):  # no such state; no such operation; an operation without operands
        broken = [*laws]
        broken[first + 1] = " ".join([*program[:2], damage, *program[4:]])
        with zipfile.ZipFile(with_laws) as archive, zipfile.ZipFile(tmp_path / "Damaged.fmu", "w") as copy:
            for name in archive.namelist():
                text = "\n".join(broken) if name == "resources/laws.txt" else archive.read(name)
                copy.writestr(name, text)
        task = Task(TIME, {"tau": TORQUE}, OUTPUTS)
        with pytest.raises(FmuError, match=r"laws\.txt does not fit the contained FMU"):
            Fmu(tmp_path / "Damaged.fmu").simulate(task, {})


EXPRESSIONS = {
    "2 - 3*(-x^2)/y": lambda x, y: 2 - 3 * -(x**2) / y,
    "if x > 0 and not y <= -1 then x elseif x < -1 or y == 2 then 2*y else -7": lambda x, y: (
        x if x > 0 and not y <= -1 else 2 * y if x < -1 or y == 2 else -7
    ),
    "min(abs(x), 1) + max(x, y) - sign(x)": lambda x, y: min(abs(x), 1) + max(x, y) - (x > 0) + (x < 0),
    "noEvent(if x <> y then tanh(x/y) else 0) + atan2(x, y)": lambda x, y: math.tanh(x / y) + math.atan2(x, y),
    "sqrt(exp(x)) + log(10)*log10(3) + sin(x)*cos(y)*tan(x)": lambda x, y: (
        math.sqrt(math.exp(x)) + math.log(10) * math.log10(3) + math.sin(x) * math.cos(y) * math.tan(x)
    ),
    "asin(0.3) + acos(0.3)*atan(x) + sinh(x) - cosh(y)": lambda x, y: (
        math.asin(0.3) + math.acos(0.3) * math.atan(x) + math.sinh(x) - math.cosh(y)
    ),
    "time + 'T.loss'".replace("'", ""): lambda x, y: 0.5 + 7.0,
}


@pytest.mark.parametrize("text", EXPRESSIONS)
def test_expressions_mean_what_modelica_says(drive, tmp_path, text):
    """Where nothing else acts, a derivative of minus the expression shows in a step of the state."""
    names = {"x": 0.4, "y": -1.7, "T.loss": 7.0}
    for x, y in ((0.4, -1.7), (-1.6, 1.9), (0.4, 0.6)):
        added = [Added("x", x), Added("y", y), Added("T.loss", names["T.loss"])]
        law = StateLaw("phi1", text.replace("time", "(0*time + 0.5)"))
        write_fmu_with_laws(Fmu(drive, "model exchange"), [law], added, tmp_path / "E.fmu")
        fmu = Fmu(tmp_path / "E.fmu")
        (phi,) = fmu.simulate(Task(np.array([0.0, 1e-5]), {}, ("phi1",)), {"c": 0.0, "d": 0.0})
        assert phi[1] / 1e-5 == pytest.approx(-EXPRESSIONS[text](x, y), rel=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("size*load", "cannot use 'load'"),
        ("size*foo(w2)", "no function 'foo'"),
        ("size*", "unexpected"),
        ("abs(w2, w2)", "takes 1 argument"),
    ],
)
def test_a_wrong_expression_is_an_error_with_its_place(text, message):
    with pytest.raises(ModelicaError, match=message) as refused:
        code_of(text, {"size": Operand("PARAMETER"), "w2": Operand("STATE")}, "[effects.'mine@der(w2)']")
    assert "mine@der(w2)" in str(refused.value)


def test_an_fmu_without_model_exchange_has_no_places(tmp_path, build):
    with pytest.raises(FmuError, match="does not offer model exchange"):
        write_fmu_with_laws(Fmu(build(2, ("CoSimulation",))), LAWS, ADDED, tmp_path / "No.fmu")


def test_operations_are_those_of_the_c_code():
    header = Path(sys.modules[StateLaw.__module__].__file__ or "").with_name("laws.h").read_text()
    listed = header.partition("enum {")[2].partition("}")[0].replace("\n", " ").split(",")
    assert [name.strip() for name in listed[:-1]] == list(OPERATIONS)
