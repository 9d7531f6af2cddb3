"""The smallest size at which an effect would have been seen, and effects that never would be."""

from types import SimpleNamespace

import numpy as np
import pytest

from fmuid.core.errors import SimulationError
from fmuid.diagnosis.refit import Refit
from fmuid.diagnosis.scores import hidden, score_effects, smallest_seen
from fmuid.diagnosis.verdict import Hidden
from fmuid.effects.effect import Effect, Unknown

# One run of three samples; the model's parameter does what the first component is.
OBSERVED = SimpleNamespace(
    runs=[SimpleNamespace(n_repeats=1)], scatter=[np.zeros((1, 3))], repeats=np.array([1.0]), residuals=tuple
)
BASE = Refit((), {}, (np.zeros(3),), (np.array([[1.0], [0.0], [0.0]]),), 0.0, 0, True)
RESPONSES = {
    "linear": lambda size: (0.0, 10.0 * size, 0.0),
    "limit": lambda size: (0.0, 400.0 * max(0.0, size - 0.6), 0.0),  # nothing happens below it
    "growing": lambda size: (0.0, 0.0, np.expm1(9.0 * size)),
    "far": lambda size: (0.0, 2.0 * size, 0.0),  # three times the trial are not enough
    "bounded": lambda size: (0.0, 5.0 * size, 0.0),  # nor is the bound
    "lost": lambda size: (1e3 * size, 0.3 * size, 0.0),
    "nowhere": lambda size: (0.2 * size, 0.2 * size, 0.0),
    "fragile": lambda size: (0.0, 4.0 * size, 0.0) if size < 1.5 else None,
}


def effect(name):
    unknown = Unknown(name, 0.0, -10.0, 1.5 if name == "bounded" else 10.0, 0.01)
    return Effect(name, "", "port", (unknown,), {name: 0.0}, ({name: 0.1}, {name: 1.0}))


EFFECTS = [effect(name) for name in RESPONSES]


def predict(points, near=None):
    predictions = []
    for point in points:
        ((name, size),) = point.items()
        moved = RESPONSES[name](size)
        predictions.append(SimulationError("fails") if moved is None else [np.array(moved)])
    return predictions


def seen(*, simulated=True):
    scores = score_effects(predict, OBSERVED, BASE, EFFECTS)
    sizes = smallest_seen(predict, OBSERVED, BASE, scores, EFFECTS, threshold=100.0, simulated=simulated)
    return {name: values[name] for name, values in sizes.items()}


def test_sizes_that_would_just_be_seen_are_found_by_simulation():
    sizes = seen()
    assert sizes.keys() == {"linear", "limit", "growing", "fragile"}
    true = {"linear": 1.0, "limit": 0.625, "growing": np.log(11.0) / 9.0, "fragile": 1.5}
    for name, size in true.items():
        assert size <= sizes[name] <= 1.1 * size, name


def test_without_simulations_effects_are_taken_to_act_in_proportion():
    sizes = seen(simulated=False)
    assert sizes["linear"] == pytest.approx(1.0)
    assert sizes["limit"] == pytest.approx(1.0 / 16.0)


def test_what_no_sensor_would_show_and_what_fitted_parameters_would_hide_is_listed():
    assert hidden(score_effects(predict, OBSERVED, BASE, EFFECTS)) == Hidden(("nowhere",), ("lost",))
