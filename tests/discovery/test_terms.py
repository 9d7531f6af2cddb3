"""Terms of a law: the same along courses and in a simulated model; a catalogue reads the law as it was written."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fmu_build import compile_flat, load
from fmu_build.instrument import Added, Term, instrument
from fmu_build.model_ports import find_ports
from fmuid.core.toml_tables import toml_document
from fmuid.discovery.injected import Law, entry
from fmuid.discovery.places import Spot
from fmuid.discovery.terms import HIDDEN, Quantity, Shape, library
from fmuid.discovery.terms import Term as LawTerm
from fmuid.effects.effects_file import load_catalogue
from fmuid.identification.problem.cases import RUN_TIME
from tests.diagnosis.test_made_catalogue import RIGS

TIME = np.linspace(0.0, 10.0, 2001)
SPEED = Quantity("rate", "rate", "rad/s", 5.0, -5.0, 4.0, "speed")
ANGLE = Quantity("p", "p", "rad", 20.0, 0.0, 20.0, "angle")
DRIVE = Quantity("u", "u", "V", 10.0, 0.0, 10.0)
COURSES = {"rate": 5.0 * np.sin(TIME), "p": 2.0 * TIME, "u": np.where(TIME < 5.0, 10.0, 0.0)}


def terms():
    return library([SPEED, ANGLE], [DRIVE], [TIME])


def law(*parts):
    port = next(p for p in find_ports(load(RIGS, "Rigs.TwoMass")) if p.name == "rotor")
    return Law(Spot(port, 2.0, (COURSES,), (TIME,), parts), parts, "rotor.law")


def test_every_term_is_finite_and_no_larger_than_about_one_along_its_courses():
    library_terms = terms()
    assert len(library_terms) > 200
    for term in library_terms:
        course = term.course(COURSES, TIME)
        assert np.isfinite(course).all(), term
        assert 0.001 < np.abs(course).max() < 1.6, term


def test_the_library_has_what_engineers_write_down():
    texts = {t.text for t in terms()}
    assert "(rate/5)^3" in texts
    assert "tanh(rate/0.05)*(p/20)^2" in texts
    assert "sin(6*p)" in texts
    assert "max(rate - width, 0)/5" in texts
    assert "(rate/5)*(u/10)" in texts
    assert ("tanh(rate/0.05)*hidden", "((rate/5)^2 - hidden)/lag") in {(t.text, t.rate) for t in terms()}


def test_a_hidden_state_follows_what_heats_it():
    term = LawTerm(f"{HIDDEN}*(rate/5)", 4, SPEED, {"lag": Shape(2.0, 0.1, 30.0, "s")}, f"((u/10) - {HIDDEN})/lag")
    exact = np.where(TIME < 5.0, 1.0 - np.exp(-TIME / 2.0), (1.0 - np.exp(-2.5)) * np.exp(-(TIME - 5.0) / 2.0))
    assert term.state(COURSES, TIME, {}) == pytest.approx(exact, abs=2e-3)
    assert term.course(COURSES, TIME) == pytest.approx(exact * np.sin(TIME), abs=2e-3)
    assert term.state(COURSES, TIME, {"lag": 4.0})[-1] == pytest.approx(
        (1 - np.exp(-1.25)) * np.exp(-1.25), abs=2e-3
    )


def test_a_law_over_the_time_since_a_run_began_has_it_as_an_input():
    since = Quantity(RUN_TIME, RUN_TIME, "s", 10.0, 0.0, 10.0)
    assert law(LawTerm(f"({RUN_TIME}/10)*(rate/5)", 2, since)).effect("a", "b").inputs == {RUN_TIME: "s"}
    assert law(LawTerm("(rate/5)", 1, SPEED)).effect("a", "b").inputs == {}


def test_terms_can_be_put_into_a_model():
    flat = load(RIGS, "Rigs.TwoMass")
    library_terms = library([SPEED, ANGLE], [], [TIME])
    by_family = {t.family: t for t in library_terms}
    laws = [Law(law(t).spot, (t,), f"rotor.law{k}") for k, t in enumerate([*by_family.values()][::4])]
    terms = [Term("rotor", "flow", one.expression, str(k), one.states) for k, one in enumerate(laws)]
    added = [Added(u.name, u.start) for one in laws for u in one.effect("a", "b").unknowns]
    assert compile_flat(instrument(flat, terms, added))


def test_a_law_is_an_entry_of_a_catalogue_like_any_other(tmp_path):
    warm = LawTerm(
        f"{HIDDEN}*(rate/5)", 4, SPEED, {"lag": Shape(2.0, 0.1, 30.0, "s")}, f"((rate/5)^2 - {HIDDEN})/lag"
    )
    wide = LawTerm("tanh(rate/width)", 2, SPEED, {"width": Shape(0.5, 0.1, 15.0, "rad/s")})
    effect = law(warm, wide).effect("law_found@rotor", "a law")
    tables = {
        "format": "fmuid-effects",
        "version": 1,
        "effects": {effect.id: entry(effect)},
        "ports": {"rotor": {}},
    }
    file = tmp_path / "effects.toml"
    file.write_text(toml_document(tables))
    read = load_catalogue(file).effects[effect.id]
    assert read == replace(effect, law=read.law)
    assert read.expression == (
        "rotor.law_size_1*rotor.law_hidden_1*(rate/5) + rotor.law_size_2*tanh(rate/rotor.law_width_2)"
    )
    assert [s.derivative for s in read.states] == ["((rate/5)^2 - rotor.law_hidden_1)/rotor.law_lag_1"]


def test_the_formula_has_numbers_and_units():
    wide = LawTerm("tanh(rate/width)", 2, SPEED, {"width": Shape(0.5, 0.1, 15.0, "rad/s")})
    cubic = LawTerm("(rate/5)^3", 1, SPEED)
    values = {"rotor.law_size_1": 2.0, "rotor.law_width_1": 0.25, "rotor.law_size_2": -0.5}
    assert law(wide, cubic).formula(values) == "2 N.m * tanh(rate/0.25 rad/s) - 0.5 N.m * (rate/5)^3"
