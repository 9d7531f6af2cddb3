"""A reading made of pure tones: effects whose signatures have any wanted angle between them, to steer the search."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.subject import Subject
from fmuid.effects.effect import Catalogue, Effect, Port, Sensor, Unknown
from fmuid.identification.problem.cases import measured_case
from fmuid.simulation.simulator import Simulator, Task, Variable

TIME = 5e-3 * np.arange(400)
SIGMA = 0.05
STRENGTHS = (0.7, 1.0, 1.3, 1.6)  # of the experiments
SENSORS = {
    n: Sensor(n, v, SIGMA, "V", n) for n, v in (("second reading", "z"), ("first reading", "y"), ("none", "x"))
}
NOMINAL = Unknown("k", 0.5, -10.0, 10.0, 1e-2)


def tone(number: int) -> np.ndarray:
    """Return a tone; different ones are orthogonal over the time of a run."""
    return np.sqrt(2.0) * np.sin(2 * np.pi * (2 * number + 1) * TIME / 2.0)


@dataclass(frozen=True)
class Reading(Simulator):
    """y = strength (k tone 0 + the sum over the effects of size times law); a law has a weight for each tone.

    Weights of negative tones are in `z`, which no sensor reads.
    """

    laws: Mapping[str, Mapping[int, float]]

    @property
    def variables(self) -> dict[str, Variable]:
        parameters = {n: Variable(n, "parameter", "fixed", start=0.0) for n in self.laws}
        k = Variable("k", "parameter", "fixed", start=0.0)
        return parameters | {"k": k, "u": Variable("u", "input"), **{n: Variable(n, "output") for n in ("y", "z")}}

    def simulate(self, task: Task, parameters: Mapping[str, float]) -> np.ndarray:
        values = {**task.start_values, **parameters}
        rows = {"y": values["k"] * tone(0), "z": np.zeros(TIME.size)}
        for name, law in self.laws.items():
            for t, w in law.items():
                rows["z" if t < 0 else "y"] += values.get(name, 0.0) * w * tone(abs(t))
        read = [task.inputs["u"] * rows[n][: len(task.time)] for n in task.outputs]
        return np.array(read).reshape(len(read), len(task.time))


def heard(
    laws: Mapping[str, Mapping[int, float]],
    truth: Mapping[int, float],
    *,
    ports: Mapping[str, str] | None = None,
    repeats: int = 5,
) -> Subject:
    """Return the subject of a diagnosis: readings with the tones of `truth`, effects with `laws` to explain them.

    `ports` gives the port of an effect; each has its own otherwise.
    """
    rng = np.random.default_rng(0)
    reading, cases = Reading(laws), []
    for k, strength in enumerate(STRENGTHS):
        task = Task(TIME, {"u": np.full(TIME.size, strength)}, ("y",))
        true = strength * (tone(0) + sum(w * tone(t) for t, w in truth.items()))
        cases.append(
            measured_case(f"e{k}", reading, task, {"y": true + SIGMA * rng.standard_normal((repeats, TIME.size))})
        )
    model = CampaignModel(tuple(cases))
    at = {name: (ports or {}).get(name, f"at {name}") for name in laws}
    effects = {
        name: Effect(
            name,
            name,
            at[name],
            (Unknown(name, 0.0, -10.0, 10.0, 1e-2),),
            {name: 0.0},
            ({name: 0.3},),
            two_sided=True,
        )
        for name in laws
    }
    catalogue = Catalogue(effects, {p: Port(p, None, None, 1.0) for p in at.values()}, sensors=SENSORS)
    return Subject(model, Observed.from_runs(model.runs), (NOMINAL,), catalogue, tuple(effects.values()))
