"""The flat model as a value: where equations come from, and a changed and a plain model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fmu_build import compile_flat, load
from fmu_build.errors import ModelicaError
from fmu_build.flat_model import ADDED, FlatModel, Variable, number, variable
from fmu_build.modelica_text import modelica_text
from fmu_build.syntax import Binary
from tests.conftest import MODELICA
from tests.fmu_build.simulate import Instance

TEXT = """model TwoMasses
  Drives.Components.Inertia a(J = 2, phi(start = 0, fixed = true), w(start = 1, fixed = true));
  Drives.Components.SpringDamper shaft(c = 8, d = 0.5);
  Drives.Components.Inertia b(J = 4, phi(start = 0, fixed = true), w(start = 0, fixed = true));
equation
  connect(a.flange_b, shaft.flange_a);
  connect(shaft.flange_b, b.flange_a);
end TwoMasses;
"""


@pytest.fixture(scope="module")
def flat(tmp_path_factory) -> FlatModel:
    file = tmp_path_factory.mktemp("flat") / "TwoMasses.mo"
    file.write_text(TEXT)
    return load(file, "TwoMasses", [MODELICA])


def test_balances_and_equalities_name_their_connectors(flat):
    balances = {e.origin.connectors: e for _, e in flat.flow_balances()}
    assert set(balances) == {
        ("a.flange_b", "shaft.flange_a"),
        ("shaft.flange_b", "b.flange_a"),
        ("a.flange_a",),
        ("b.flange_b",),
    }
    assert str(balances["a.flange_b", "shaft.flange_a"].at) == "TwoMasses.mo:6"
    equalities = [e.origin.connectors for _, e in flat.equalities()]
    assert equalities == [("a.flange_b", "shaft.flange_a"), ("shaft.flange_b", "b.flange_a")]
    flange = flat.connectors["shaft.flange_a"]
    assert (flange.component, flange.class_name) == ("shaft", "Drives.Interfaces.Flange_a")
    assert (flange.potentials, flange.flows) == (("shaft.flange_a.phi",), ("shaft.flange_a.tau",))


def test_the_instance_tree_has_classes_units_and_the_equations_of_each_component(flat):
    assert flat.components["a"].class_name == "Drives.Components.Inertia"
    assert flat.components["shaft"].parent == ""
    assert "Drives.Interfaces.PartialTwoFlanges" in flat.components["a"].bases
    assert flat.variables["a.J"].unit == "kg.m2"
    assert flat.variables["a.J"].component == "a"
    assert flat.variables["a.flange_a.tau"].flow
    files = {e.at.file for _, e in flat.equations_of("a")}
    assert files <= {"Inertia.mo", "PartialTwoFlanges.mo"}
    assert files


def test_a_torque_added_to_a_balance_acts_there_and_zero_changes_nothing(flat):
    plain = Instance.of(compile_flat(flat))
    changed = flat.with_variable(Variable("port", ADDED, causality="input", direction="input", unit="N.m"))
    (node,) = (i for i, e in flat.flow_balances() if "b.flange_a" in e.origin.connectors)
    changed = changed.with_term(node, Binary(ADDED, "*", number(-1), variable("port")))
    with_port = Instance.of(compile_flat(changed))
    x = with_port.start()
    np.testing.assert_array_equal(with_port.derivative(0.0, x, [0.0]), plain.derivative(0.0, plain.start()))
    difference = with_port.derivative(0.0, x, [3.0]) - with_port.derivative(0.0, x, [0.0])
    assert sorted(difference) == pytest.approx([0, 0, 0, 3 / 4])
    with pytest.raises(ModelicaError, match="already a variable 'port'"):
        changed.with_variable(Variable("port", ADDED))


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("tests/fmu_build/models/Rigs.mo", "Rigs.Geared"),
        ("modelica/Drives/Setups/FixedShaftWithEvents.mo", "Drives.Setups.FixedShaftWithEvents"),
    ],
)
def test_a_flat_model_written_as_source_is_the_same_model(file, name, tmp_path):
    source = Path(__file__).parents[2] / file
    flat = load(source, name)
    text = tmp_path / "Written.mo"
    text.write_text(modelica_text(flat, "Written", ["Made by a test."]))
    plain, again = compile_flat(flat), compile_flat(load(text, "Written"))
    assert (again.n_x, again.n_u, again.n_y, again.has_events) == (
        plain.n_x,
        plain.n_u,
        plain.n_y,
        plain.has_events,
    )
    values = []
    for one in (plain, again):
        random = np.random.default_rng(1)
        function = one.functions["derivatives"]
        point = [np.abs(random.normal(size=function.numel_in(k))) for k in range(function.n_in())]
        values.append(np.array(function(*point)).ravel())
    assert np.isfinite(values[0]).all()
    assert np.array_equal(*values)


def test_start_values_of_a_library_contradict_none_of_the_model_when_all_are_written_at_the_top(tmp_path):
    text = tmp_path / "Hanging.mo"
    text.write_text(
        "model Hanging Drives.Components.EccentricLoad load(J = 1, mgr = 9.81, phi(start = 1, fixed = true),"
        " w(start = 0, fixed = true)); end Hanging;"
    )
    flat = load(text, "Hanging", [MODELICA])
    text.write_text(modelica_text(flat, "Hanging"))
    plain, again = compile_flat(flat), compile_flat(load(text, "Hanging"))
    assert [*plain.warnings] == [*again.warnings] == []
    assert "start = 0, nominal = 1, fixed = true" in text.read_text()
