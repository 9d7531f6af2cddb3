"""Where an unknown effect enters."""

from dataclasses import replace

import numpy as np
import pytest
from plants import PORTS, misread, plant

from fmuid.diagnosis.candidates import fit_effects
from fmuid.diagnosis.localisation import entries, likelier, places, with_knots
from fmuid.diagnosis.refit import refit
from fmuid.effects.effect import Port


def entered_at(subject, knots=None, **options):
    nominal = fit_effects(subject, (), [{}])
    at = (subject.model, subject.observed, nominal.fit, tuple(PORTS.values()))
    return places(entries(*at)) if knots is None else with_knots(*at, np.linspace(0.0, 1.0, knots), **options)


@pytest.mark.parametrize("hidden", [{"hill": 0.3}, {"grip": 0.2}])
def test_a_hidden_force_enters_where_the_force_acts(hidden):
    assert entered_at(plant(hidden)) == ("friction",)


def test_an_error_of_a_sensor_enters_there():
    assert entered_at(misread(plant({}), lambda v, t: 0.02 * np.sin(40.0 * v))) == ("reading",)


def test_a_course_that_differs_from_run_to_run_is_found_too():
    """No function of speed, position or time that all runs share is behind it."""
    rng = np.random.default_rng(3)
    subject = misread(
        plant({}), lambda _, t: 0.02 * np.sin(2 * np.pi * rng.uniform(0.5, 3.0) * t + rng.uniform(0.0, 6.0))
    )
    assert entered_at(subject) == ("reading",)


def test_a_fast_course_gets_finer_knots():
    subject = misread(plant({}), lambda _, t: 0.02 * np.sign(np.sin(2 * np.pi * 7.0 * t)))
    coarse, fine = (entered_at(subject, knots)["reading"] for knots in (24, 70))
    assert coarse.explained < 0.6
    assert fine.explained > 0.75
    assert fine.left < 0.5 * coarse.left
    assert entered_at(subject) == ("reading",)


def test_responses_to_fewer_knots_are_used_again():
    subject = plant({"hill": 0.3})
    alone, again = entered_at(subject, 25), entered_at(subject, 25, among=np.linspace(0.0, 1.0, 9))
    for port, entry in alone.items():
        assert again[port].evidence == pytest.approx(entry.evidence, rel=0.01)
        assert again[port].explained == pytest.approx(entry.explained, abs=0.01)


def test_what_a_complete_model_leaves_enters_nowhere():
    assert entered_at(plant({})) == ()


def test_a_course_is_no_less_likely_for_nominal_parameters_at_their_bounds():
    """An effect is fitted together with the nominal parameters, as a course is, and gains what these gain."""
    subject = plant({"hill": 0.3})
    nominal, named = fit_effects(subject, (), [{}]), fit_effects(subject, subject.effects[:1], [{}])
    narrow = [replace(u, lower=u.start - 1e-6, upper=u.start + 1e-6) for u in subject.nominal]
    stuck = replace(nominal, fit=refit(subject.model.predict, subject.observed, narrow))
    for base in (nominal, stuck):
        courses = entries(subject.model, subject.observed, base.fit, tuple(PORTS.values()))
        assert likelier(courses, base, named)


def test_ports_that_no_sensor_tells_apart_are_named_together():
    subject = plant({"hill": 0.3})
    nominal = fit_effects(subject, (), [{}])
    twin = Port("twin", "port", None, 0.1, "N")
    entered = entries(subject.model, subject.observed, nominal.fit, (*PORTS.values(), twin))
    assert set(places(entered)) == {"friction", "twin"}
