import numpy as np
import pytest

from fmuid.core.campaign import ParameterSpec
from fmuid.core.errors import ProblemError
from fmuid.identification.problem.search_space import SearchSpace, expanded


def test_search_coordinates_are_of_order_one_and_lead_back():
    specs = (
        ParameterSpec("stiffness", 130_000.0, 1e4, 1e6),
        ParameterSpec("inertia", 3e-3, 1e-5, 1.0, scale="log"),
        ParameterSpec("offset", 0.0, -2.0, 2.0),
    )
    space = SearchSpace(specs, {"n": 50.0})
    values = {"stiffness": 2.6e5, "inertia": 0.01, "offset": 0.3, "n": 50.0}
    x = space.to_search(values)
    assert x == pytest.approx([2.0, np.log(0.01), 0.75])
    assert space.to_model(x) == pytest.approx(values)
    assert space.slope(x) == pytest.approx([130_000.0, 0.01, 0.4])


def test_a_point_outside_the_bounds_is_moved_onto_them():
    space = SearchSpace((ParameterSpec("a", 1.0, 0.5, 2.0),))
    assert space.to_model(np.array([9.0])) == {"a": 2.0}


def test_ties_follow_their_leaders_in_any_order():
    specs = [ParameterSpec(n, 1.0) for n in ("a", "b", "c")]
    space = expanded(specs, ["a"], {}, {"c": "b + 1", "b": "2 * a"}, [])
    assert space.to_model(np.array([3.0])) == {"a": 3.0, "b": 6.0, "c": 7.0}


def test_a_stage_that_ended_at_next_to_nothing_does_not_shrink_the_next_one_s_coordinates():
    specs = [ParameterSpec("a", 0.0, 0.0, 0.5), ParameterSpec("b", 2.0, 0.0, 9.0), ParameterSpec("c", 2.0)]
    space = expanded(specs, ["a", "b", "c"], {"a": 1e-13, "b": 1e-9, "c": 3.0}, {}, [])
    assert space.slope(space.start) == pytest.approx([0.05, 2.0, 3.0])


def test_a_per_experiment_parameter_is_free_once_for_each():
    specs = [ParameterSpec("k", 2.0), ParameterSpec("offset", 0.0, per="experiment")]
    space = expanded(specs, ["offset", "k"], {"k": 4.0, "offset@b": 0.5}, {}, ["a", "b"])
    assert space.names == ("offset@a", "offset@b", "k")
    assert space.to_model(space.start)["offset@b"] == 0.5


def test_a_tie_of_per_experiment_parameters_holds_run_by_run():
    """Also along a chain, and where the leader is held."""
    per_run = [
        ParameterSpec(n, s, per="experiment") for n, s in (("load[1]", 1.0), ("b", 1.0), ("c", 1.0), ("held", 5.0))
    ]
    ties = {"b": "2 * k * load[1] + held", "c": "max(b, 0)"}
    space = expanded([ParameterSpec("k", 3.0), *per_run], ["load[1]", "k"], {"held@y": 7.0}, ties, ["x", "y"])
    assert space.names == ("load[1]@x", "load[1]@y", "k")
    values = space.to_model(space.to_search({"load[1]@x": 1.0, "load[1]@y": 2.0, "k": 3.0}))
    assert (values["b@x"], values["b@y"], values["c@x"], values["c@y"]) == (11.0, 19.0, 11.0, 19.0)


def test_what_all_runs_share_does_not_follow_what_each_has_its_own_of():
    specs = [ParameterSpec("a", 1.0, per="experiment"), ParameterSpec("b", 1.0)]
    with pytest.raises(ProblemError, match="'b' is tied to 'a', which has one value per run; write per ="):
        expanded(specs, ["a"], {}, {"b": "2 * a"}, ["x"])


@pytest.mark.parametrize(
    ("ties", "message"),
    [
        ({"a": "b", "b": "a"}, "circular ties"),
        ({"b": "nothing"}, "unknown parameter 'nothing'"),
        ({"nothing": "a"}, "unknown parameter 'nothing'"),
    ],
)
def test_ties_that_cannot_be_are_refused(ties, message):
    specs = [ParameterSpec("a", 1.0), ParameterSpec("b", 1.0), ParameterSpec("c", 1.0)]
    with pytest.raises(ProblemError, match=message):
        expanded(specs, ["c"], {}, ties, [])


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (ParameterSpec("a", 3.0, 0.0, 2.0), "outside"),
        (ParameterSpec("a", 1.0, 2.0, 0.0), "not below"),
        (ParameterSpec("a", 0.0, 0.0, 2.0, scale="log"), "log scale"),
    ],
)
def test_impossible_parameters_are_refused(spec, message):
    with pytest.raises(ProblemError, match=message):
        SearchSpace((spec,))
