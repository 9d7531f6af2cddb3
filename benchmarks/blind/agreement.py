"""Do random rigs agree with their models, before any diagnosis?

The model is built into an FMU and driven by held inputs; the plant has the same parameters, drawn up to a fifth
off. A disagreement is a mistake in one of them, to be mended; no rig is dropped.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.blind.plants.grammar import KINDS_OF_WAVE, Rig, draw_rig, wave
from benchmarks.blind.plants.modelica import class_name, modelica

TOLERANCE = 0.05  # standard deviations of the noise, largest over a run


def disagreement(rig: Rig, seed: int, folder: Path) -> float:
    """Return the largest difference between plant and model in a run, in standard deviations of the noise."""
    import fmpy

    from fmuid.init.starting import given_model

    rng = np.random.default_rng([seed, rig.number, 11])
    values = {n: v * float(np.exp(rng.uniform(-0.2, 0.2))) for n, v in rig.nominal.items()}
    u = np.stack([wave(rng, s, rig.samples, KINDS_OF_WAVE[rig.number % 5]) for s in rig.inputs])
    plant = rig.with_values(values)
    y, _ = plant.run(rig.dt, u, plant.steps(rig.dt, u[:, 0]))
    file = folder / f"{class_name(rig)}.mo"
    file.write_text(modelica(rig), encoding="utf-8")
    time = np.arange(rig.samples) * rig.dt
    given = np.array(
        list(zip(time, *u, strict=True)), dtype=[("time", float), *((s.name, float) for s in rig.inputs)]
    )
    names = [s.name for s in rig.outputs]
    simulated = fmpy.simulate_fmu(
        str(given_model(file).fmu), fmi_type="CoSimulation", start_values=values, input=given, output=names,
        stop_time=time[-1], output_interval=rig.dt, relative_tolerance=1e-8,
    )  # fmt: skip
    error = np.stack([simulated[n][: rig.samples] for n in names]) - y
    return float(np.max(np.abs(error) / np.array(rig.noise)[:, None]))


def disagreements(seed: int, count: int) -> list[str]:
    """Print the disagreement of every rig; return a line if one is too large."""
    worst = 0.0
    with tempfile.TemporaryDirectory() as folder:
        for number in range(count):
            rig = draw_rig(seed, number)
            error = disagreement(rig, seed, Path(folder))
            worst = max(worst, error)
            print(
                f"rig {number:3}: {error:8.4f} sigma  {rig.kind}, {rig.components} components, {rig.style}",
                flush=True,
            )
    print(f"largest: {worst:.4f} sigma, tolerance {TOLERANCE}")
    return ["a plant and its model disagree"] if worst > TOLERANCE else []
