"""The FMI 2.0 side: modes, values, states, derivatives, messages."""

from __future__ import annotations

import threading

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

MODELS = [
    "pendulum",
    "train",
    "robertson",
    "van_der_pol",
    "bouncing_ball",
    "sampled_counter",
    "stick_slip",
    "relay",
    "algebraic_loop",
    "failing",
]


@pytest.mark.parametrize("name", MODELS)
def test_valid(built, name):
    assert validate_fmu(str(built(name)[0])) == []


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_simulates_in_fmpy(built, kind):
    result = fmpy.simulate_fmu(
        str(built("pendulum")[0]),
        fmi_type=kind,
        stop_time=1.0,
        output_interval=0.1,
        start_values={"phi": 0.5, "m": 2.0},
        relative_tolerance=1e-8,
        output=["phi", "J"],
    )
    assert result["phi"][0] == 0.5
    assert result["J"] == pytest.approx(0.5)
    assert result["phi"][-1] == pytest.approx(-0.1641947, abs=2e-7)


def test_direct_feedthrough_and_lazy_values(fmu):
    one = fmu("pendulum").start()
    one.c.doStep(0.0, 0.1)
    one.set(tau=0.25)
    assert one.get("through") == 0.5
    before = one.get("der(w)")
    one.set(tau=0.5)
    assert one.get("der(w)") == pytest.approx(before + 0.25 / one.get("J"))


def test_calculated_parameters_follow(fmu):
    one = fmu("pendulum")
    one.set(m=3.0, l=2.0)
    assert one.get("J") == 12.0
    one.start()
    assert one.get("J") == 12.0


def test_setting_what_cannot_be_set(fmu):
    one = fmu("pendulum").start()
    for name, value, message in [
        ("m", 2.0, "before the simulation"),
        ("phi", 0.0, "start value"),
        ("energy", 1.0, "computed by the model"),
        ("tau", float("nan"), "tau cannot be set to nan"),
    ]:
        with pytest.raises(FMICallException):
            one.set(**{name: value})
        assert message in one.messages[-1]
        assert name in one.messages[-1]


def test_fmu_state_brings_back_the_whole_future(fmu):
    u = np.where(np.arange(40) // 3 % 2, 0.8, -0.8)
    one = fmu("train").start()
    one.run(["w"], 20, 1e-3, inputs={"i_cmd": u})
    state = one.c.getFMUstate()
    data = one.c.serializeFMUstate(state)
    first = one.run(["tau_sensor", "b"], 20, 1e-3, at=0.02, inputs={"i_cmd": u[20:]})
    one.c.setFMUstate(state)
    np.testing.assert_array_equal(one.run(["tau_sensor", "b"], 20, 1e-3, at=0.02, inputs={"i_cmd": u[20:]}), first)
    one.c.freeFMUstate(state)
    other = fmu("train").start()
    other.c.setFMUstate(other.c.deSerializeFMUstate(data))
    np.testing.assert_array_equal(
        other.run(["tau_sensor", "b"], 20, 1e-3, at=0.02, inputs={"i_cmd": u[20:]}), first
    )
    strange = fmu("pendulum").start()
    with pytest.raises(FMICallException):
        strange.c.deSerializeFMUstate(data)
    assert "not a state of this FMU" in strange.messages[-1]


@pytest.mark.parametrize(
    ("name", "unknowns", "knowns"),
    [
        ("pendulum", ["der(phi)", "der(w)", "energy", "through", "J"], ["phi", "w", "tau", "m", "l", "damping"]),
        ("algebraic_loop", ["der(x)", "out", "y"], ["x", "u", "a"]),
    ],
)
def test_directional_derivatives_are_exact(fmu, name, unknowns, knowns):
    one = fmu(name, co_simulation=False)
    one.start()
    for known in knowns:
        exact = [one.c.getDirectionalDerivative([one.vr[n]], [one.vr[known]], [1.0])[0] for n in unknowns]
        ends = []
        for sign in (1, -1):
            other = fmu(name)
            start = other.get(known)
            eps = 1e-6 * max(1.0, abs(start))
            other.set(**{known: start + sign * eps})
            ends.append(other.start().get(*unknowns))
        np.testing.assert_allclose(exact, (ends[0] - ends[1]) / (2 * eps), rtol=1e-6, atol=1e-8)


def test_directional_derivative_by_a_calculated_parameter_holds_the_others(fmu):
    one = fmu("pendulum", co_simulation=False).start(l=0.5)
    by_j = one.c.getDirectionalDerivative([one.vr["der(w)"], one.vr["J"]], [one.vr["J"]], [1.0])
    assert by_j == pytest.approx([-one.get("der(w)") / one.get("J"), 1.0])


def test_directional_derivatives_in_initialization_mode_follow_the_start(fmu):
    """x(0) = 2 b + c with c = b^2, unless set; (1 + x) y + y^3 = b is solved for y; x' = -y."""

    def initialising(**values):
        one = fmu("dependent_start", co_simulation=False)
        one.c.setupExperiment(startTime=0.0)
        one.set(**values)
        one.c.enterInitializationMode()
        return one

    names = ["x", "der(x)", "out", "c"]
    for given, known in (({}, "b"), ({"x": 1.5}, "b"), ({"x": 1.5}, "x")):
        one = initialising(b=0.7, **given)
        exact = one.c.getDirectionalDerivative([one.vr[n] for n in names], [one.vr[known]], [1.0])
        value, eps = one.get(known), 1e-6
        low, high = (initialising(**{"b": 0.7, **given, known: value + e}).get(*names) for e in (-eps, eps))
        np.testing.assert_allclose(exact, (high - low) / (2 * eps), rtol=1e-8, atol=1e-9)


def test_instances_in_threads_do_not_disturb_each_other(fmu):
    """ctypes releases the interpreter lock in every call: the instances really run at once."""
    u = np.where(np.arange(100) // 3 % 2, 0.8, -0.8)
    alone = fmu("train").start().run(["tau_sensor"], 100, 1e-3, inputs={"i_cmd": u})
    results: dict[int, np.ndarray] = {}
    instances = [fmu("train").start(**({} if i % 2 else {"d_S": 2.66})) for i in range(4)]

    def work(i):
        results[i] = instances[i].run(["tau_sensor"], 100, 1e-3, inputs={"i_cmd": u})

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for i in range(4):
        np.testing.assert_array_equal(results[i], alone)


def test_every_failure_has_a_message(fmu):
    blown = fmu("failing").start()
    with pytest.raises(FMICallException):
        blown.run(["x"], 5, 0.3)
    assert "t = 1.000" in blown.messages[-1]
    assert "step size" in blown.messages[-1]
    assert "of x" in blown.messages[-1]

    limited = fmu("failing").start(limit=2.0)
    with pytest.raises(FMICallException):
        limited.run(["x"], 8, 0.1)
    assert "assertion violated: x must stay below its limit" in limited.messages[-1]

    warned = fmu("failing").start(floor=1.5)
    warned.run(["x"], 3, 0.1)
    assert [m for m in warned.messages if "rather small" in m] == ["t = 0: x is rather small"]

    not_a_number = fmu("failing").start()
    not_a_number.set(u=2.0)
    with pytest.raises(FMICallException):
        not_a_number.c.doStep(0.0, 0.1)
    assert "derivative of w is not finite" in not_a_number.messages[-1]

    folded = fmu("fold").start()
    with pytest.raises(FMICallException):
        folded.run(["out"], 15, 0.1)
    assert "cannot be evaluated or solved" in folded.messages[-1]

    with pytest.raises(FMICallException):
        fmu("pendulum").start(tolerance=-1.0)


def test_a_percent_sign_in_a_message_is_no_format(fmu):
    one = fmu("pendulum")
    with pytest.raises(FMICallException):
        one.c.getReal([999])
    assert one.messages == ["no variable has the value reference 999"]
