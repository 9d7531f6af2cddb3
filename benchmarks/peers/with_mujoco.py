"""Identify a pendulum from logs with mujoco.sysid: `with_mujoco.py FOLDER`, one CSV file (time, tau, phi) per run.

Prints the estimates, their 95 % half widths and the wall time as JSON.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
from mujoco import sysid

MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.005" integrator="RK4" gravity="0 0 -9.81"><flag contact="disable"/></option>
  <worldbody>
    <body name="arm">
      <inertial pos="0 0 -0.3" mass="0.3" diaginertia="1e-6 1e-6 1e-6"/>
      <joint name="pivot" type="hinge" axis="0 1 0" armature="0.01" damping="0.02"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="pivot"/></actuator>
  <sensor><jointpos name="phi" joint="pivot"/></sensor>
</mujoco>
"""
PARAMETERS = {  # start, lower, upper; how to set it
    "m": (0.36, 0.1, 1.0, lambda spec, p: setattr(spec.body("arm"), "mass", p.value[0])),
    "J": (0.006, 1e-4, 0.05, lambda spec, p: setattr(spec.joint("pivot"), "armature", p.value[0])),
    "d": (0.03, 0.0, 0.2, lambda spec, p: setattr(spec.joint("pivot"), "damping", np.r_[p.value[0], 0, 0])),
}


def main() -> None:
    runs = [np.loadtxt(file, delimiter=",", skiprows=1) for file in sorted(Path(sys.argv[1]).glob("*.csv"))]
    begun = time.perf_counter()
    spec = mujoco.MjSpec.from_string(MODEL)
    model = spec.compile()
    data = mujoco.MjData(model)
    start = sysid.create_initial_state(model, data.qpos, data.qvel, data.act)
    sequences = [
        sysid.ModelSequences(
            f"pendulum{k}",
            spec,
            f"run{k}",
            start,
            sysid.TimeSeries(t, tau[:, None]),
            sysid.TimeSeries.from_names(t[1:], phi[:-1, None], model),  # MuJoCo reads sensors before it steps
        )
        for k, (t, tau, phi) in enumerate(run.T for run in runs)
    ]
    parameters = sysid.ParameterDict()
    for name, (value, lower, upper, modifier) in PARAMETERS.items():
        parameters.add(sysid.Parameter(name, nominal=value, min_value=lower, max_value=upper, modifier=modifier))
    residual = sysid.build_residual_fn(models_sequences=sequences)
    optimum, result = sysid.optimize(initial_params=parameters, residual_fn=residual, verbose=False)
    residuals, _, _ = residual(result.x, optimum)
    _, widths = sysid.calculate_intervals(residuals, result.jac)
    values = {name: [float(optimum[name].value[0]), float(w)] for name, w in zip(PARAMETERS, widths, strict=True)}
    print(json.dumps({"seconds": time.perf_counter() - begun, "values": values}))


main()
