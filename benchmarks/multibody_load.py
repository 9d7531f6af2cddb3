"""The actuator with an eccentric load, as mgr sin(phi) and as a body of Modelica.Mechanics.MultiBody.

    python -m benchmarks.multibody_load

Both are built and simulated with the same speed reference. Without the Modelica Standard Library, one line says
how to get it.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import fmpy
import numpy as np

from fmu_build import build
from fmu_build.errors import ModelicaError

SETUPS = Path(__file__).parents[1] / "modelica" / "Drives" / "Setups"
MODELS = {"mgr sin(phi)": "EccentricLoad", "MultiBody": "EccentricLoadMultiBody"}
STOP = 2.0


def simulated(model: str, folder: Path) -> np.ndarray:
    """Build a setup and simulate it with a reference that swings between both directions."""
    fmu = build(SETUPS / f"{model}.mo", f"Drives.Setups.{model}", folder)
    time = np.linspace(0.0, STOP, 201)
    reference = np.array(
        list(zip(time, 100 * np.sin(2 * np.pi * time), strict=True)), dtype=[("time", float), ("w_ref", float)]
    )
    known = {v.name for v in fmpy.read_model_description(str(fmu)).modelVariables if v.causality == "output"}
    return fmpy.simulate_fmu(
        str(fmu), stop_time=STOP, output_interval=STOP / 200, input=reference, relative_tolerance=1e-9,
        output=sorted(known), fmi_type="CoSimulation",
    )  # fmt: skip


def main() -> None:
    """Print the largest difference of each output."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            plain, body = (simulated(model, Path(folder)) for model in MODELS.values())
        except ModelicaError as error:
            print(f"the variant with MultiBody is left out: {error}")
            return
    print(f"eccentric load, {' and '.join(MODELS)}, largest difference over {STOP:g} s:")
    for name in plain.dtype.names[1:]:
        print(f"  {name}: {np.abs(plain[name] - body[name]).max():.2g} (range {np.ptp(plain[name]):.3g})")


if __name__ == "__main__":
    sys.exit(main())
