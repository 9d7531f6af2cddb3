"""A driven mass with friction: a rig and a model to diagnose that need no FMU."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import ClassVar

import numpy as np

from benchmarks.shared_library import compiled
from fmuid.core.errors import SimulationError
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.subject import Subject
from fmuid.effects.effect import Catalogue, Effect, Port, Regime, Unknown
from fmuid.identification.problem.cases import measured_case
from fmuid.simulation.simulator import Simulator, Task, Variable

DT = 5e-3
N = 400
SIGMA = 2e-3
PARAMETERS = {
    "m": 1.0,
    "d": 0.8,
    "Fc": 0.5,
    "a": 0.0,
    "tilt": 0.0,
    "cable": 0.0,
    "square": 0.0,
    "grip": 0.0,
    "hill": 0.0,
}


@cache
def _run() -> Callable[..., None]:
    """The steps of the mass, in C: the diagnoses of all tests spend their time there."""
    run = ctypes.CDLL(str(compiled("mass", Path(__file__).with_name("mass.c")))).mass_run
    numbers = np.ctypeslib.ndpointer(dtype=np.float64, flags="C_CONTIGUOUS")
    run.argtypes = [numbers] * 4 + [ctypes.c_long, ctypes.c_double, numbers]
    run.restype = None
    return run


class Mass(Simulator):
    """m der(v) = u - d v - (Fc + bump) s - a |s| - tilt - cable - square v |v| - hill sin 8x - port.

    s = tanh(v / 0.02); Fc is larger by `grip` at some positions.
    """

    variables: ClassVar = {
        **{n: Variable(n, "parameter", "fixed", start=v) for n, v in PARAMETERS.items()},
        **{n: Variable(n, "input") for n in ("u", "port")},
        **{n: Variable(n, "output") for n in ("x", "v")},
    }

    def simulate(self, task: Task, parameters: Mapping[str, float]) -> np.ndarray:
        p = {**PARAMETERS, **task.start_values, **parameters}
        values = [*(p[n] for n in ("m", "d", "Fc", "a", "square", "grip", "hill")), p["tilt"] + p["cable"]]
        n = len(task.time)
        rows = np.empty((n, 2))
        inputs = [np.ascontiguousarray(task.inputs.get(name, np.zeros(n)), float) for name in ("u", "port")]
        _run()(np.array(values), np.ascontiguousarray(task.time, float), *inputs, n, DT / 2, rows)
        if not np.isfinite(rows).all():
            raise SimulationError("the mass ran away")
        named = dict(zip(("x", "v"), rows.T, strict=True))
        return np.array([named[o] for o in task.outputs])


def _effect(name: str, parameter: str, size: float, **options: bool) -> Effect:
    two_sided = options.get("two_sided", False)
    unknown = Unknown(parameter, 0.0, -10.0 if two_sided else 0.0, 10.0, 1e-3)
    trials = ({parameter: size}, {parameter: 4 * size})
    return Effect(name, name, "friction", (unknown,), {parameter: 0.0}, trials, two_sided=two_sided)


EFFECTS = {
    e.id: e
    for e in (
        _effect("asymmetry", "a", 0.05, two_sided=True),
        _effect("quadratic", "square", 0.1, two_sided=True),
        _effect("tilt", "tilt", 0.05, two_sided=True),
        Effect(
            "reading_gain",
            "the speed reading is out of scale",
            "reading",
            (Unknown("v.gain", 1.0, 0.5, 2.0, 2e-3),),
            {"v.gain": 1.0},
            ({"v.gain": 1.03},),
            two_sided=True,
        ),
        Effect(
            "dead_time",
            "the command comes late",
            "command",
            (Unknown("u.delay", 0.0, 0.0, 0.1, 1e-3),),
            {"u.delay": 0.0},
            ({"u.delay": 5e-3},),
        ),
    )
}
TWIN = _effect("cable", "cable", 0.05, two_sided=True)
PORTS = {
    "friction": Port("friction", "port", None, 0.05, "N"),
    "reading": Port("reading", None, "v", 0.01, "m/s"),
    "command": Port("command", None, None, 1.0),
}
REGIMES = {"speed": Regime("speed", "v", "speed", "m/s"), "position": Regime("position", "x", "value", "m")}
NOMINAL = (
    Unknown("m", 0.8, 0.1, 10.0, 0.01),
    Unknown("d", 0.5, 0.0, 10.0, 0.01),
    Unknown("Fc", 0.3, 0.0, 5.0, 0.01),
)


def inputs() -> dict[str, np.ndarray]:
    """Forces of five experiments."""
    t = DT * np.arange(N)
    steps = np.repeat([1.5, -1.5, 2.5, -2.5], N // 4)
    return {
        "sine": 1.8 * np.sin(2 * np.pi * 1.0 * t),
        "fast": 2.5 * np.sin(2 * np.pi * 2.0 * t),
        "steps": steps,
        "ramp": 3.0 * np.sin(2 * np.pi * 0.5 * t) ** 3,
        "mixed": 1.2 * np.sin(2 * np.pi * 0.5 * t) + 1.2 * np.sin(2 * np.pi * 1.5 * t),
    }


def plant(
    truth: Mapping[str, float],
    *,
    effects: Mapping[str, Effect] = EFFECTS,
    repeats: int = 5,
    seed: int = 0,
    delay: float = 0.0,
    gain: float = 1.0,
    noise: float = 1.0,
    step: float = 0.0,
    experiments: tuple[str, ...] = (),
) -> Subject:
    """Return the subject of a diagnosis: runs of a mass with `truth`, and the model without it.

    `noise` is over the usual one; with a `step` the speed is counted, and so quiet that it repeats exactly.
    `experiments` names some of them.
    """
    rng = np.random.default_rng(seed)
    mass, cases = Mass(), []
    for name, u in inputs().items():
        if experiments and name not in experiments:
            continue
        time = DT * np.arange(N)
        late = np.interp(time - delay, time, u) if delay else u
        plain = Task(time, {"u": u}, ("x", "v"))
        true = mass.simulate(replace(plain, inputs={"u": late}), truth) * np.array([[1.0], [gain]])
        white = SIGMA * np.array([[0.2], [1.0]]) * rng.standard_normal((repeats, 2, N))
        offset = 0.2 * SIGMA * rng.standard_normal((repeats, 2, 1))
        runs = true + noise * (white + offset)
        if step:
            runs[:, 1] = step * np.round(true[1] / step)
        case = measured_case(name, mass, plain, {"x": runs[:, 0], "v": runs[:, 1]})
        cases.append(replace(case, setup="bench"))
    model = CampaignModel(tuple(cases))
    observed = Observed.from_runs(model.runs)
    return Subject(model, observed, NOMINAL, Catalogue(effects, PORTS, REGIMES), tuple(effects.values()))


def misread(subject: Subject, error: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Subject:
    """Return the same runs with an error of the speed reading, a function of its course and time."""
    cases = []
    for case in subject.model.cases:
        x, v = case.channels
        wrong = v.repeats + error(v.repeats.mean(axis=0), DT * np.arange(v.repeats.shape[1]))
        cases.append(replace(case, channels=(x, replace(v, repeats=wrong))))
    model = replace(subject.model, cases=tuple(cases))
    return replace(subject, model=model, observed=Observed.from_runs(model.runs))
