"""Output feedback: a model whose states are corrected by its output errors, sample by sample.

The predictor of the prediction-error method (Ljung, System Identification, 2nd ed., section 4.3): with a gain K, x
is corrected by K (y_measured - y) at every sample, and the measurement is compared with the prediction from the
preceding samples. The prediction for a plant that diverges in open loop thus stays near the measurement.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fmuid.core.errors import ProblemError
from fmuid.core.immutable import FloatArray, read_only
from fmuid.simulation.fmu import Fmu, load_fmu
from fmuid.simulation.segmented import states_of
from fmuid.simulation.simulator import Feedback, Simulator, Task, Wrapped

_DISTURBED = 0.1  # share of an input that the first gain assumes to be unknown
_LEAST = 1e-3  # disturbance of every state, in sigmas of the outputs, so that no gain is 0
_STEP = 1e-4


class ObserverModel(Wrapped):
    """A simulator of one case whose runs are predictions from the preceding samples; a `Simulator`.

    Its gains are set like parameters, ``observer[state,output]``; gains that are not set are 0.

    Parameters
    ----------
    simulator
        An FMU that offers model exchange.
    measured
        (outputs, N) samples of the case's outputs.

    Raises
    ------
    ProblemError
        The model is not an FMU with model exchange.
    """

    def __init__(self, simulator: Simulator, measured: FloatArray) -> None:
        if not isinstance(simulator, Fmu):
            raise ProblemError(
                f"an observer needs one FMU, not {type(simulator).__name__}", fix="use segments instead"
            )
        self.simulator = load_fmu(simulator.path, "model exchange")
        self._states = states_of(self.simulator)
        self.measured = read_only(measured)

    @property
    def states(self) -> tuple[str, ...]:
        """States that the gains correct."""
        return self._states

    @property
    def token(self) -> str:
        """Identity of the model for fingerprints."""
        return f"{self.simulator.token} with an observer"

    @staticmethod
    def gain_name(state: str, output: str) -> str:
        """Return the name of a gain."""
        return f"observer[{state},{output}]"

    def simulate(self, task: Task, parameters: Mapping[str, float]) -> FloatArray:
        """Return the predictions, each from the preceding samples; see `Simulator`."""
        gain = np.array([[parameters.get(self.gain_name(s, o), 0.0) for o in task.outputs] for s in self.states])
        plain = {n: v for n, v in parameters.items() if not n.startswith("observer[")}
        feedback = Feedback(self.measured[:, : len(task.time)], gain)
        return self.simulator.simulate(replace(task, feedback=feedback), plain)

    def first_gain(self, task: Task, parameters: Mapping[str, float], sigma: FloatArray) -> FloatArray:
        """Return the stationary Kalman gain at the start of a run, (states, outputs).

        Parameters
        ----------
        task
            The run.
        parameters
            Parameter values of the model.
        sigma
            (outputs,) standard deviation of the noise of a sample.
        """
        from scipy.linalg import solve_discrete_are

        n = len(task.outputs)
        time, outputs = task.time[:2], (*task.outputs, *self.states)
        inputs = {name: u[:2] for name, u in task.inputs.items()}
        two = replace(task, time=time, inputs=inputs, outputs=outputs)
        begin = self.simulator.simulate(two, parameters)
        states = begin[n:, 0]
        starts = dict(zip(self.states, states.tolist(), strict=True))
        base = self.simulator.simulate(two, dict(parameters) | starts)
        columns = []
        for i, name in enumerate(self.states):
            step = _STEP * max(abs(states[i]), 1.0)
            moved = self.simulator.simulate(two, dict(parameters) | starts | {name: states[i] + step})
            columns.append((moved - base) / step)
        by_state = np.array(columns)  # (states, outputs and states, 2)
        c, a = by_state[:, :n, 0].T, by_state[:, n:, 1].T
        disturbed = []
        for name, u in task.inputs.items():
            size = _DISTURBED * float(np.std(u) or np.abs(u[0]))
            if size > 0.0 and self.variables[name].type in ("Real", "Float64", "Float32"):
                there = replace(two, inputs=inputs | {name: inputs[name] + size})
                disturbed.append((self.simulator.simulate(there, dict(parameters) | starts) - base)[n:, 1])
        b = np.array(disturbed).reshape(-1, len(self.states)).T
        reach = np.linalg.pinv(c) @ sigma
        floor = _LEAST * np.where(np.abs(reach) > 0.0, np.abs(reach), float(np.max(np.abs(reach), initial=1e-9)))
        noise = np.diag(sigma**2)
        try:
            p = solve_discrete_are(a.T, c.T, b @ b.T + np.diag(floor**2), noise)
        except (np.linalg.LinAlgError, ValueError):
            raise ProblemError(
                "no observer is stable at the start of the run: the outputs do not show every unstable state",
                fix="measure more outputs, or use segments",
            ) from None
        return np.asarray(p @ c.T @ np.linalg.inv(c @ p @ c.T + noise))
