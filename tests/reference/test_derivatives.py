"""Directional derivatives of the shipped FMUs against central differences, by every state, input and parameter."""

from __future__ import annotations

from pathlib import Path

import fmpy
import fmpy.fmi2
import numpy as np
import pytest

from tests.conftest import ACTUATOR, SETUPS


class Model:
    """The FMU in model exchange: derivatives and outputs as functions of states, inputs and parameters."""

    def __init__(self, path: Path, folder: Path) -> None:
        description = fmpy.read_model_description(str(path))
        variables = description.modelVariables
        self.names = {v.name: v for v in variables}
        self.states = [d.variable.derivative for d in description.derivatives]
        self.rates = [d.variable for d in description.derivatives]
        self.outputs = [v for v in variables if v.causality == "output"]
        self.calculated = [v for v in variables if v.causality == "calculatedParameter" and v.type == "Real"]
        self.inputs = [v for v in variables if v.causality == "input"]
        self.parameters = [v for v in variables if v.causality == "parameter" and v.type == "Real"]
        identifier = description.modelExchange.modelIdentifier
        self.c = fmpy.fmi2.FMU2Model(
            guid=description.guid,
            unzipDirectory=fmpy.extract(str(path), str(folder)),
            modelIdentifier=identifier,
            instanceName="one",
        )
        self.c.instantiate()

    def unknowns(self):
        return [v.valueReference for v in (*self.rates, *self.outputs, *self.calculated)]

    def go_to(self, x, u, p) -> None:
        """A new run whose parameters, inputs and states are as given."""
        self.c.reset()
        self.c.setupExperiment(startTime=0.0)
        self.c.setReal([v.valueReference for v in self.parameters], p)
        self.c.enterInitializationMode()
        self.c.exitInitializationMode()
        self.c.enterContinuousTimeMode()
        self.c.setReal([v.valueReference for v in self.inputs], u)
        self.c.setContinuousStates((fmpy.fmi2.fmi2Real * len(x))(*x), len(x))

    def values(self, *point):
        self.go_to(*point)
        return np.array(self.c.getReal(self.unknowns()))


def close(exact, left, right, step):
    """Central difference within 1e-6 of itself and of what rounding of its two ends allows."""
    difference = (right - left) / (2 * step)
    rounding = 100 * np.finfo(float).eps * np.maximum(np.abs(left), np.abs(right)) / step
    return np.abs(exact - difference) <= 1e-6 * np.abs(difference) + rounding


@pytest.mark.parametrize(("name", "laws"), [*((s, False) for s in SETUPS), *((s, True) for s in ACTUATOR)])
def test_by_every_state_input_and_parameter(fmus, effect_fmus, name, laws, tmp_path):
    model = Model((effect_fmus if laws else fmus)[name], tmp_path)
    rng = np.random.default_rng(7)
    start = [float(v.start) for v in model.parameters]
    size = [float(v.nominal or 1.0) for v in model.states]
    # away from neutral values, where an effect is a kink
    p = np.array([v * (1 + 0.1 * rng.uniform()) if v else 0.01 * rng.uniform(0.5, 1) for v in start])
    point = [rng.normal(size=len(size)) * size, rng.normal(size=len(model.inputs)), p]
    moved = np.zeros(len(model.unknowns()), dtype=bool)
    for which, variables in enumerate((model.states, model.inputs, model.parameters)):
        for i, v in enumerate(variables):
            model.go_to(*point)
            exact = np.array(model.c.getDirectionalDerivative(model.unknowns(), [v.valueReference], [1.0]))
            differences = []
            for part in (1e-4, 1e-5, 1e-3, 1e-6):  # kinks are near for some, curvature is large for others
                step, ends = part * abs(point[which][i]), []
                for sign in (-1, 1):
                    other = [vector.copy() for vector in point]
                    other[which][i] += sign * step
                    ends.append(model.values(*other))
                differences.append((ends[1] - ends[0]) / (2 * step))
                good = close(exact, *ends, step)
                if good.all():
                    break
            assert good.all(), (v.name, exact[~good], np.array(differences)[:, ~good])
            moved |= exact != 0.0
    assert moved[: len(model.rates)].all()
    model.c.freeInstance()
