"""Parameters that a term replaces by a variable."""

from pathlib import Path

import numpy as np
import pytest

from fmu_build import compile_flat, load
from fmu_build.errors import ModelicaError
from fmu_build.instrument import Added, State, Term, instrument
from fmu_build.model_ports import coefficients, in_products_with
from fmu_build.syntax import walk

RIGS = Path(__file__).parent / "models" / "Rigs.mo"


def flat(name):
    return load(RIGS, f"Rigs.{name}")


def derivatives(model, states=None, parameters=None):
    """Derivatives by state, at states of 1, 2, 3 ... or the given ones."""
    compiled = compile_flat(model)
    x = {v.name: v.location.index for v in compiled.variables if v.location.vector == "x"}
    p = {v.name: v for v in compiled.variables if v.location.vector == "p"}
    at = np.arange(1.0, compiled.n_x + 1)
    for name, value in (states or {}).items():
        at[x[name]] = value
    values = np.zeros(compiled.n_p)
    for name, v in p.items():
        values[v.location.index] = (parameters or {}).get(name, v.start)
    d = compiled.functions["dependent"](values)
    dx = compiled.functions["derivatives"](0.3, at, np.ones(compiled.n_u), values, d, [], [], [], [])
    return {name: float(np.array(dx).ravel()[i]) for name, i in x.items()}


def varying(name, law, size=0.0, **further):
    value = f"noEvent(if abs(size) > 0 then {law} else p)"
    return [Term(name, "parameter", value, **further)], [Added("size", size)]


@pytest.mark.parametrize("rig", ["TwoMass", "Circuit", "Tanks"])
def test_a_coefficient_that_does_not_vary_leaves_the_model_bit_for_bit(rig):
    model = flat(rig)
    names = [c.name for c in coefficients(model)]
    assert names
    plain = derivatives(model)
    for name in names:
        x = next(iter(plain))
        changed = derivatives(instrument(model, *varying(name, f"p*(1 + size*{x})")))
        assert changed == plain, name


def test_a_coefficient_that_varies_acts_as_its_value_does():
    model = flat("TwoMass")
    changed = instrument(model, *varying("shaft.d", "p*(1 + size*load.w)", size=0.5))
    at = {"load.w": 2.0}
    as_given = derivatives(model, at, {"shaft.d": next(
        float(v.binding.value) for v in model.variables.values() if v.name == "shaft.d") * 2.0})  # fmt: skip
    assert derivatives(changed, at) == pytest.approx(as_given, rel=1e-12)


@pytest.mark.parametrize(("place", "acts"), [("load.J", "parameter"), ("motor.tau", "signal")])
def test_laws_act_one_after_the_other_in_a_model_of_their_number_of_terms(place, acts):
    """Each names the value three times: written into one another, twelve laws would have half a million terms."""

    def with_laws(n):
        return instrument(
            flat("TwoMass"), [Term(place, acts, "noEvent(if p > 0.012 then 0.9*p else 2*p)")] * n, []
        )

    sizes = [sum(1 for _ in walk((e.left, e.right))) for n in (2, 12) for e in with_laws(n).equations]
    assert sum(sizes) < 2000
    at = {"load.w": 2.0}
    value = {"parameter": 5e-3, "signal": 1.0}[acts]
    for _ in range(3):
        value = 0.9 * value if value > 0.012 else 2 * value
    three = derivatives(with_laws(3), at)
    one = derivatives(instrument(flat("TwoMass"), [Term(place, acts, repr(value))], []), at)
    assert three == pytest.approx(one, rel=1e-12)


def test_parameters_computed_from_it_follow(tmp_path):
    file = tmp_path / "Follows.mo"
    file.write_text("""
model Follows
  parameter Real a = 2;
  parameter Real b = 3*a;
  final parameter Real c = b + a;
  Real x(start = 1, fixed = true);
  Real w = c*x;
equation
  der(x) = -w;
end Follows;
""")
    model = load(file, "Follows")
    assert [c.name for c in coefficients(model)] == ["a"]
    changed = instrument(model, *varying("a", "p*(1 + size*x)", size=0.1))
    assert derivatives(changed, {"x": 5.0})["x"] == pytest.approx(-8.0 * 1.5 * 5.0)


def test_a_coefficient_may_have_a_memory():
    model = flat("TwoMass")
    state = State("warmth", "(load.w^2 - warmth)/7")
    terms, added = varying("shaft.d", "p*(1 + size*warmth)", states=(state,))
    slopes = derivatives(instrument(model, terms, added), {"load.w": 3.0, "warmth": 2.0})
    assert slopes["warmth"] == pytest.approx(1.0)


def test_what_is_no_coefficient_is_refused():
    with pytest.raises(ModelicaError, match=r"'shaft.q' is not a parameter that acts.*did you mean 'shaft.[cd]'"):
        instrument(flat("TwoMass"), *varying("shaft.q", "p"))


MOTOR = """
model Motor
  parameter Real K = 2;
  input Real u;
  Real i(start = 1, fixed = true);
  Real w(start = 1, fixed = true);
equation
  der(i) = u - i - K*w;
  der(w) = K*i - w;
end Motor;
"""


def test_a_parameter_may_vary_in_one_of_its_equations(tmp_path):
    file = tmp_path / "Motor.mo"
    file.write_text(MOTOR)
    model = load(file, "Motor")
    assert [c.name for c in coefficients(model)] == ["K", "K:i", "K:w"]
    changed = instrument(model, *varying("K:w", "p*(1 + size*i)", size=0.5))
    slopes = derivatives(changed, {"i": 4.0, "w": 3.0})
    assert slopes == {"i": pytest.approx(1.0 - 4.0 - 2.0 * 3.0), "w": pytest.approx(2.0 * 3.0 * 4.0 - 3.0)}
    both, added = varying("K:w", "p*(1 + size*i)", size=0.5)
    both += [Term("K", "parameter", "3*p")]
    slopes = derivatives(instrument(model, both, added), {"i": 4.0, "w": 3.0})
    assert slopes == {"i": pytest.approx(1.0 - 4.0 - 6.0 * 3.0), "w": pytest.approx(6.0 * 3.0 * 4.0 - 3.0)}


OVEN = """
model Oven
  parameter Real C = 10;
  parameter Real R = 2;
  parameter Real G = 1;
  parameter Real share = 1/R;
  input Real u;
  input Real fan;
  input Real T_out;
  Real T(start = 1, fixed = true);
  Real loss = G*(T - T_out);
equation
  C*der(T) = -(share*u^2) - fan - loss;
end Oven;
"""


def test_names_that_multiply_a_parameter(tmp_path):
    """Also through a parameter computed from it; those in a difference do not."""
    file = tmp_path / "Oven.mo"
    file.write_text(OVEN)
    model = load(file, "Oven")
    assert in_products_with(model, "R") == {"u"}
    assert in_products_with(model, "G") == set()
