"""Outputs that are read after the inputs of their sample act, as by a controller that sends a command and then reads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fmu_build import build
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.simulator import Task

MODEL = """
model Winding
  parameter Real R = 2;
  parameter Real L = 0.5;
  input Real u;
  output Real i(start = 0, fixed = true);
  output Real v = u - R*i "at the coil";
  output Real doubled = 2*u;
equation
  L*der(i) = v;
end Winding;
"""
TIME = np.arange(0.0, 2.0, 0.05)
U = np.where(np.sin(5 * TIME) > 0, 1.0, -0.5)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("winding")
    (folder / "Winding.mo").write_text(MODEL)
    return build(folder / "Winding.mo", "Winding", folder, "2")


@pytest.mark.parametrize("interface", ["co-simulation", "model exchange"])
def test_outputs_are_read_before_or_after_the_input_acts(path, interface) -> None:
    before = Task(TIME, {"u": U}, ("i", "v", "doubled"))
    with Fmu(path, interface) as fmu:
        plain = fmu.simulate(before, {"R": 3.0})
        mixed = fmu.simulate(replace(before, after=("doubled",)), {"R": 3.0})
        late = fmu.simulate(replace(before, after=("i", "v", "doubled")), {"R": 3.0})
    held = np.append(U[0], U[:-1])
    np.testing.assert_allclose(plain[1:], [held - 3 * plain[0], 2 * held], rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(mixed, [plain[0], plain[1], 2 * U])
    np.testing.assert_array_equal(late[0], plain[0])  # a state does not depend on when it is read
    np.testing.assert_allclose(late[1:], [U - 3 * plain[0], 2 * U], rtol=1e-9, atol=1e-12)


def test_derivatives_belong_to_the_same_readings(path) -> None:
    task = Task(TIME, {"u": U}, ("v", "i"), tolerance=1e-9, after=("v",))
    with Fmu(path) as fmu:
        above, below = (fmu.simulate(task, {"R": 3.0 + d, "L": 0.5}) for d in (1e-3, -1e-3))
        exact = fmu.simulate(replace(task, along=({"R": 1.0},)), {"R": 3.0, "L": 0.5})[2:]
    np.testing.assert_allclose(exact, (above - below) / 2e-3, atol=1e-6)


def test_runs_that_share_their_beginning_do_so_up_to_the_input_that_is_read(path) -> None:
    def task(begin: int, group: tuple[int, int] | None) -> Task:
        u = np.where(np.arange(len(TIME)) >= begin, 2.0, 1.0)
        return Task(TIME, {"u": u}, ("doubled", "i"), shared=group, after=("doubled",))

    with Fmu(path) as fmu:
        for begin in (12, 20, 16, 12):
            shared = fmu.simulate(task(begin, (0, begin)), {"R": 3.0})
            with Fmu(path) as other:
                np.testing.assert_array_equal(shared, other.simulate(task(begin, None), {"R": 3.0}))
