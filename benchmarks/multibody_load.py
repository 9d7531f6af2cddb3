"""The actuator with an eccentric load, as mgr sin(phi) and as a body of Modelica.Mechanics.MultiBody.

Prints the largest difference of each output, or how to get the Modelica Standard Library.
"""

import tempfile
from pathlib import Path

import fmpy
import numpy as np

from fmu_build import build
from fmu_build.errors import ModelicaError

SETUPS = Path(__file__).parents[1] / "modelica" / "Drives" / "Setups"


def simulated(model: str, folder: str) -> np.ndarray:
    """Build a setup and simulate it with a speed that swings between both directions."""
    fmu = build(SETUPS / f"{model}.mo", f"Drives.Setups.{model}", folder)
    time = np.linspace(0.0, 2.0, 201)
    speed = np.rec.fromarrays([time, 100 * np.sin(2 * np.pi * time)], names=["time", "w_ref"])
    return fmpy.simulate_fmu(str(fmu), stop_time=2, output_interval=0.01, input=speed, relative_tolerance=1e-9)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        try:
            plain, body = (simulated(model, folder) for model in ("EccentricLoad", "EccentricLoadMultiBody"))
            for name in plain.dtype.names[1:]:
                difference = np.abs(plain[name] - body[name]).max()
                print(f"{name}: {difference:.2g} (range {np.ptp(plain[name]):.3g})")
        except ModelicaError as error:
            print(f"the variant with MultiBody is left out: {error}")
