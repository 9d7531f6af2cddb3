"""Plants that run away when they are simulated open loop, recorded in closed loop by independent code."""

import numpy as np

from fmuid.core.campaign import Campaign, ModelSpec, ParameterSpec, StageSpec
from fmuid.core.experiments import Experiment, Measurements, Signal

PENDULUM = {"J": 0.02, "mgl": 0.6, "d": 0.01}
TROLLEY = {"m": 2.0, "d": 0.5}
STEP = 0.005


def balanced(seed, duration=12.0, noise=1e-3):
    """An inverted pendulum under a sampled controller that follows a reference; (time, torque, measured angle)."""
    generator = np.random.default_rng(seed)
    time = np.arange(0.0, duration, STEP)
    reference = 0.25 * np.sin(2.1 * time + seed) + 0.15 * np.sin(5.3 * time)
    state, torque, angle = np.array([0.05, 0.0]), np.empty(time.size), np.empty(time.size)
    last = 0.05
    for k in range(time.size):
        angle[k] = state[0] + noise * generator.standard_normal()
        torque[k] = -1.6 * (angle[k] - reference[k]) - 0.12 * (angle[k] - last) / STEP * (k > 0)
        torque[k] = np.clip(torque[k], -2.0, 2.0)
        last = angle[k]
        p, tau = PENDULUM, torque[k]
        for _ in range(4):  # Runge-Kutta steps
            h, slopes = STEP / 4, [np.zeros(2)]
            for share in (0.0, 0.5, 0.5, 1.0):
                x = state + share * h * slopes[-1]
                bent = (tau + p["mgl"] * np.sin(x[0]) - p["d"] * x[1]) / p["J"]
                slopes.append(np.array([x[1], bent]))
            state = state + h / 6 * (slopes[1] + 2 * slopes[2] + 2 * slopes[3] + slopes[4])
    return time, torque, angle


def driven(seed, duration=20.0, noise=1e-3, drift=0.02):
    """A trolley on rails that are not level, and tilt: a slow force that no model has; (time, force, position)."""
    generator = np.random.default_rng(seed)
    time = np.arange(0.0, duration, 0.02)
    force = 3.0 * np.sign(np.sin(1.7 * time)) + 1.5 * np.sin(4.1 * time + seed)
    walk = drift * np.cumsum(generator.standard_normal(time.size))
    state, position = np.zeros(2), np.empty(time.size)
    for k in range(time.size):
        position[k] = state[0] + noise * generator.standard_normal()
        decay = np.exp(-TROLLEY["d"] / TROLLEY["m"] * 0.02)
        settled = (force[k] + walk[k]) / TROLLEY["d"]
        moved = settled * 0.02 + (state[1] - settled) * TROLLEY["m"] / TROLLEY["d"] * (1 - decay)
        state = np.array([state[0] + moved, settled + (state[1] - settled) * decay])
    return time, force, position


def campaign(folder, fmu, runs, inputs, outputs, specs, sigma, **stage):
    """A campaign of runs (id -> time, input, output) of one plant."""
    (u, u_unit), (y, y_unit) = inputs, outputs
    experiments = {
        name: Experiment(
            name,
            "plant",
            time,
            {u: Signal(u, into, u_unit, "input"), y: Signal(y, out, y_unit, "output", sigma)},
        )
        for name, (time, into, out) in runs.items()
    }
    ids = tuple(experiments)
    return Campaign(
        name="plant",
        title="",
        folder=folder,
        measurements=Measurements(experiments),
        models={"plant": ModelSpec("plant", fmu)},
        parameters={s.name: s for s in specs},
        settings={},
        stages={"all": StageSpec("all", ids[:-1] or ids, tuple(s.name for s in specs), **stage)},
        identification=ids[:-1] or ids,
        validation=ids[-1:],
    )


def pendulum_specs():
    return [
        ParameterSpec("J", 0.03, 0.002, 0.2, scale="log"),
        ParameterSpec("mgl", 0.4, 0.05, 5.0, scale="log"),
        ParameterSpec("d", 0.005, 1e-4, 0.5, scale="log"),
    ]


def trolley_specs():
    return [ParameterSpec("m", 3.0, 0.2, 20.0, scale="log"), ParameterSpec("d", 1.0, 0.01, 10.0, scale="log")]
