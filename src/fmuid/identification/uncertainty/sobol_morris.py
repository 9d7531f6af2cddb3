"""Global sensitivity over the parameters' ranges: Sobol' indices and Morris screening, the only user of SALib."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fmu_build.errors import counted
from fmuid.core.campaign import ParameterSpec
from fmuid.core.errors import ProblemError, SimulationError
from fmuid.core.formatting import text_table
from fmuid.core.immutable import FloatArray, read_only
from fmuid.identification.problem.derivatives import noise_floor
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.problem.search_space import SearchSpace

Method = Literal["sobol", "morris"]
Quantity = Literal["change", "criterion", "mean", "final", "minimum", "maximum"]
STRONGEST = {"sobol": "total", "morris": "mu_star"}
"""The index of each method that measures how much a parameter matters, including all its interactions."""
SAMPLES = {"sobol": 256, "morris": 20}
_WIDE = 0.1  # half width of a total index's interval above which more samples are advised
NEGLIGIBLE = 0.01  # of an output: fixing a parameter with a smaller share keeps 99 % of the variance
_LEVEL = 0.95
_RESAMPLES = 300  # number of bootstrap samples
_LEVELS = 4  # levels of the grid of a Morris trajectory
_CUT = 3.0  # standard deviations at which a prior is cut
_BLOCK = 64  # points simulated at once
_FEWEST = 8  # smallest number of base samples for computing indices


@dataclass(frozen=True, slots=True)
class Index:
    """An index, and the half width of its 95 % interval by bootstrap; None if the method has none."""

    value: float
    half_width: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class OutputSensitivity:
    """Sensitivity of one scalar.

    Parameters
    ----------
    label, unit
        The output, ``run: signal``, and the unit of the scalar; ``1`` for multiples of the noise.
    scalars
        (draws,) its values; NaN where the simulation failed.
    indices
        One for each parameter, by name: ``first`` and ``total`` of Sobol', as shares of the variance; ``mu_star``
        (mean size), ``mu`` (mean) and ``sigma`` (standard deviation) of Morris' elementary effects, which are
        changes of the scalar per range of the parameter. Empty if no parameter moves the scalar by more than the
        simulator's own noise.
    """

    label: str
    unit: str
    scalars: FloatArray
    indices: Mapping[str, tuple[Index, ...]]

    def strengths(self, method: Method) -> FloatArray:
        """(P,) importance of each parameter: total index, or share of the largest mean effect; NaN without one."""
        return self._shares(method, [i.value for i in self.indices.get(STRONGEST[method], ())])

    def ends(self, method: Method, sign: float) -> FloatArray:
        """(P,) lower (-1) or upper (1) ends of the intervals of `strengths`."""
        strongest = self.indices.get(STRONGEST[method], ())
        return self._shares(method, [i.value + sign * (i.half_width or 0.0) for i in strongest])

    def _shares(self, method: Method, values: Sequence[float]) -> FloatArray:
        if method == "sobol":
            return np.array(values)
        largest = max((i.value for i in self.indices.get("mu_star", ())), default=1.0)
        return np.array(values) / largest


@dataclass(frozen=True, slots=True, eq=False)
class GlobalSensitivity:
    """Which parameters matter over their whole ranges, by Sobol' indices or Morris screening.

    Parameters
    ----------
    method, quantity
        The method, and the scalar that each output became.
    names
        Names of the P parameters.
    ranges
        Ends of the range from which each parameter is drawn, in its unit.
    draws
        (draws, P) drawn values.
    outputs
        The sensitivity of each output.
    samples
        Base samples (Sobol') or trajectories (Morris) from which the indices are computed.
    failed, failure
        Number of draws that could not be simulated, and the first reason. Base samples or trajectories with such a
        draw are left out.
    seed
        Seed of the draws and of the bootstrap.
    interrupted
        Whether fewer draws were simulated than asked for.
    """

    method: Method
    quantity: Quantity
    names: tuple[str, ...]
    ranges: tuple[tuple[float, float], ...]
    draws: FloatArray
    outputs: tuple[OutputSensitivity, ...]
    samples: int
    failed: int
    failure: str | None
    seed: int
    interrupted: bool = False

    @property
    def negligible(self) -> tuple[str, ...]:
        """Parameters whose share of every output is below 1 %, by the upper end of its interval."""
        moving = [o.ends(self.method, 1.0) for o in self.outputs if o.indices]
        if not moving:
            return self.names
        return tuple(n for n, share in zip(self.names, np.max(moving, axis=0), strict=True) if share < NEGLIGIBLE)

    @property
    def unmoved(self) -> tuple[str, ...]:
        """Outputs that no parameter moves."""
        return tuple(o.label for o in self.outputs if not o.indices)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a JSON value, format ``fmuid-sensitivity``, without the draws."""
        outputs = []
        for output in self.outputs:
            known = output.scalars[np.isfinite(output.scalars)]
            indices = {
                name: {kind: asdict(of_kind[k]) for kind, of_kind in output.indices.items()}
                for k, name in enumerate(self.names)
                if output.indices
            }
            spread = {"mean": float(np.mean(known)), "standard_deviation": float(np.std(known))}
            outputs.append({"output": output.label, "unit": output.unit, **spread, "parameters": indices})
        return {
            "format": "fmuid-sensitivity",
            "version": 1,
            "method": self.method,
            "of": self.quantity,
            "parameters": {
                name: {"from": low, "to": high} for name, (low, high) in zip(self.names, self.ranges, strict=True)
            },
            "samples": self.samples,
            "simulated": len(self.draws),
            "failed": self.failed,
            "failure": self.failure,
            "level": _LEVEL,
            "seed": self.seed,
            "interrupted": self.interrupted,
            "outputs": outputs,
            "negligible": list(self.negligible),
            "unmoved": list(self.unmoved),
            "text": " ".join(self.remarks()),
        }

    def remarks(self) -> list[str]:
        """Return the meaning of the indices, in sentences."""
        remarks = []
        if self.negligible:
            below = "of the largest effect" if self.method == "morris" else "of the variance"
            remarks.append(f"Below 1 % {below} in every output: {', '.join(self.negligible)}.")
        if self.unmoved:
            remarks.append(f"Moved by no parameter: {', '.join(self.unmoved)}.")
        if self.failed:
            what = "base samples" if self.method == "sobol" else "trajectories"
            remarks.append(
                f"{counted(self.failed, 'draw')} of {len(self.draws)} could not be simulated ({self.failure}); the"
                f" {what} with them are left out, {self.samples} remain. Narrow the bounds to what the model"
                " bears."
            )
        widths = [
            (i.half_width or 0.0, name, o.label)
            for o in self.outputs
            if self.method == "sobol" and o.indices
            for name, i in zip(self.names, o.indices["total"], strict=True)
        ]
        if widths and max(widths)[0] > _WIDE:
            width, name, label = max(widths)
            remarks.append(f"Widest interval: ± {width:.2g}, total of {name} in {label}; more samples narrow it.")
        if self.interrupted:
            remarks.append(f"Interrupted after {counted(len(self.draws), 'draw')}.")
        return remarks

    def __str__(self) -> str:
        """Return each parameter's strongest output, and the remarks."""
        kinds = ("total", "first") if self.method == "sobol" else ("mu_star", "mu", "sigma")
        rows = [["parameter", "from", "to", *(h for kind in kinds for h in _header(kind)), "most in"]]
        moving = [o for o in self.outputs if o.indices]
        for k, (name, (low, high)) in enumerate(zip(self.names, self.ranges, strict=True)):
            ends = [name, f"{low:.4g}", f"{high:.4g}"]
            if not moving:
                rows.append([*ends, *(["-"] * (len(rows[0]) - 4)), "no output"])
                continue
            most = max(moving, key=lambda o: o.ends(self.method, -1.0)[k])
            cells = [c for kind in kinds for c in _cells(most.indices[kind][k])]
            rows.append([*ends, *cells, most.label])
        return "\n".join([text_table(rows), *self.remarks()])


def _header(kind: str) -> list[str]:
    return [kind, "±"] if kind in ("total", "first", "mu_star") else [kind]


def _cells(index: Index) -> list[str]:
    shown = f"{index.value:.3g}"
    return [shown] if index.half_width is None else [shown, f"{index.half_width:.2g}"]


def global_sensitivity_of(
    problem: Problem,
    method: Method = "sobol",
    *,
    of: Quantity = "change",
    samples: int | None = None,
    seed: int = 0,
    say: Callable[[float], None] = lambda _: None,
) -> GlobalSensitivity:
    """Return the global sensitivity of a problem's outputs to its free parameters.

    Parameters are drawn independently: uniformly between their bounds (in their logarithm with ``scale = "log"``),
    or from their prior, cut at three standard deviations and at the bounds. First-order and total indices are
    estimated as by Saltelli and others (2010) on a scrambled Sobol' sequence; elementary effects as by Morris
    (1991), with the mean size of Campolongo and others (2007). Both use SALib.

    Parameters
    ----------
    problem
        The problem; its measurements only matter if `of` is ``criterion``.
    method
        ``sobol``, which takes ``samples * (P + 2)`` simulations of every case for P parameters, or ``morris``,
        which takes ``samples * (P + 1)``.
    of
        The scalar that each output becomes: ``change``, root mean square of its change from the prediction at the
        start values, in standard deviations of its noise; ``criterion``, value of each criterion; or the ``mean``,
        ``final``, ``minimum`` or ``maximum`` value of the output.
    samples
        Base samples, a power of two (Sobol'), or trajectories (Morris); 256 and 20 by default.
    seed
        Seed of the draws and of the bootstrap.
    say
        Called with the fraction done (0 to 1).

    Returns
    -------
    GlobalSensitivity
        If interrupted, from the draws simulated so far.

    Raises
    ------
    ProblemError
        SALib is not installed, a parameter has no range, or `samples` does not fit the method.
    SimulationError
        The start values, or too many draws, cannot be simulated.
    """
    salib = _salib()
    count = SAMPLES[method] if samples is None else samples
    if count < _FEWEST or (method == "sobol" and count & (count - 1)):
        kind = "a power of two" if method == "sobol" else "a number"
        raise ProblemError(f"{count} samples", where=method, fix=f"give {kind} of {_FEWEST} or more")
    space = problem.space
    if not len(space):
        raise ProblemError("there is no free parameter", where=problem.name, fix="set free = true for one")
    ranges = tuple(drawn_between(spec) for spec in space.free)
    (here,) = problem.evaluate_many([space.start])
    if here.failure is not None:
        raise SimulationError(here.failure, where="start values", fix="choose others")
    # For SALib, a seed of 0 means none.
    seeds = [int(s) for s in np.random.default_rng(seed).integers(1, 2**31, size=2)]
    cube = {"num_vars": len(space), "names": list(space.names), "bounds": [[0.0, 1.0]] * len(space)}
    if method == "sobol":
        unit = salib.sobol_sample.sample(cube, count, calc_second_order=False, seed=seeds[0])
        size = len(space) + 2
    else:
        unit = salib.morris_sample.sample(cube, count, num_levels=_LEVELS, seed=seeds[0])
        size = len(space) + 1
    draws = np.stack([_quantiles(s, u, r) for s, u, r in zip(space.free, unit.T, ranges, strict=True)], axis=1)
    labels, units, scalars_of = _scalars(problem, of, here)
    simulated, failure, interrupted = _simulated(problem, space, draws, size, scalars_of, say=say)
    unit, draws = unit[: len(simulated)], draws[: len(simulated)]
    failed = ~np.isfinite(simulated).all(axis=1)
    kept = np.repeat(~failed.reshape(-1, size).any(axis=1), size)
    if kept.sum() < _FEWEST * size:
        raise SimulationError(
            f"{failed.sum()} of {len(simulated)} draws cannot be simulated ({failure})",
            where=method,
            fix="narrow the bounds to what the model bears",
        )

    def analysed(scalars: FloatArray) -> dict[str, tuple[Index, ...]]:
        common: dict[str, Any] = {"num_resamples": _RESAMPLES, "conf_level": _LEVEL, "seed": seeds[1]}
        if method == "sobol":
            s = salib.sobol_analyze.analyze(cube, scalars, calc_second_order=False, **common)
            return {"first": _indices(s["S1"], s["S1_conf"]), "total": _indices(s["ST"], s["ST_conf"])}
        m = salib.morris_analyze.analyze(cube, unit[kept], scalars, num_levels=_LEVELS, **common)
        return {
            "mu_star": _indices(m["mu_star"], m["mu_star_conf"]),
            "mu": _indices(m["mu"]),
            "sigma": _indices(m["sigma"]),
        }

    outputs = []
    for label, u, column, noise in zip(labels, units, simulated.T, _own_noise(problem, of, here), strict=True):
        varies = float(np.ptp(column[kept])) > max(noise, 1e-9 * float(np.max(np.abs(column[kept]))))
        outputs.append(OutputSensitivity(label, u, read_only(column), analysed(column[kept]) if varies else {}))
    return GlobalSensitivity(
        method,
        of,
        space.names,
        ranges,
        read_only(draws),
        tuple(outputs),
        int(kept.sum()) // size,
        int(failed.sum()),
        failure,
        seed,
        interrupted,
    )


def drawn_between(spec: ParameterSpec) -> tuple[float, float]:
    """Return the range that a parameter is drawn from: its bounds, and three standard deviations of its prior.

    Raises
    ------
    ProblemError
        It has neither bounds nor prior, or they do not overlap.
    """
    where = f"parameter '{spec.name}'"
    low, high = spec.lower, spec.upper
    if spec.prior is not None:
        low = max(low, spec.prior.mean - _CUT * spec.prior.sd)
        high = min(high, spec.prior.mean + _CUT * spec.prior.sd)
    if not (np.isfinite(low) and np.isfinite(high)):
        raise ProblemError("has no range to be drawn from", where=where, fix="give lower and upper, or a prior")
    if not low < high:
        raise ProblemError("its prior lies outside its bounds", where=where, fix="correct one of them")
    if spec.scale == "log" and spec.prior is None and low <= 0.0:
        raise ProblemError(f"lower = {low:g} has no logarithm", where=where, fix="give a lower bound above 0")
    return low, high


def _quantiles(spec: ParameterSpec, unit: FloatArray, ends: tuple[float, float]) -> FloatArray:
    """Return the values of a parameter at (n,) probabilities."""
    low, high = ends
    if spec.prior is not None:
        from scipy.stats import truncnorm

        mean, sd = spec.prior.mean, spec.prior.sd
        return np.asarray(truncnorm.ppf(unit, (low - mean) / sd, (high - mean) / sd, mean, sd))
    if spec.scale == "log":
        return np.asarray(low * (high / low) ** unit)
    return low + (high - low) * unit


def _simulated(
    problem: Problem,
    space: SearchSpace,
    draws: FloatArray,
    size: int,
    scalars_of: Callable[[Evaluation], FloatArray],
    *,
    say: Callable[[float], None],
) -> tuple[FloatArray, str | None, bool]:
    """Return the (n, outputs) scalars of the draws, NaN where one failed, and the first reason.

    Also return whether it was interrupted; n then covers the complete groups of `size` that were simulated.
    """
    points = [space.to_search(dict(zip(space.names, row, strict=True))) for row in draws.tolist()]
    rows: list[FloatArray] = []
    failure = None
    interrupted = False
    try:
        for begin in range(0, len(points), _BLOCK):
            for evaluation in problem.evaluate_many(points[begin : begin + _BLOCK]):
                failure = failure or evaluation.failure
                rows.append(scalars_of(evaluation))
            say(min(1.0, (begin + _BLOCK) / len(points)))
    except KeyboardInterrupt:
        if len(rows) < _FEWEST * size:
            raise
        interrupted = True
    return np.array(rows[: len(rows) // size * size]), failure, interrupted


def _scalars(
    problem: Problem, of: Quantity, here: Evaluation
) -> tuple[tuple[str, ...], tuple[str, ...], Callable[[Evaluation], FloatArray]]:
    """Return labels and units of the scalars, and the function that computes them from an evaluation."""
    if of == "criterion":
        return problem.labels, ("1",) * len(problem.labels), lambda e: e.criteria
    channels = [(case, channel) for case in problem.cases for channel in case.channels]
    labels = tuple(f"{case.id}: {channel.signal}" for case, channel in channels)
    start = [y for rows in here.predictions for y in rows]
    reduced: dict[Quantity, Callable[[FloatArray, int], float]] = {
        "change": lambda y, k: float(np.sqrt(np.mean(np.square((y - start[k]) / channels[k][1].noise.sigma)))),
        "mean": lambda y, _: float(np.mean(y)),
        "final": lambda y, _: float(y[-1]),
        "minimum": lambda y, _: float(np.min(y)),
        "maximum": lambda y, _: float(np.max(y)),
    }
    reduce = reduced[of]

    def scalars(evaluation: Evaluation) -> FloatArray:
        if not evaluation.ok:
            return np.full(len(labels), np.nan)
        return np.array([reduce(y, k) for k, y in enumerate(y for rows in evaluation.predictions for y in rows)])

    units = tuple("1" if of == "change" else channel.unit or "1" for _, channel in channels)
    return labels, units, scalars


def _own_noise(problem: Problem, of: Quantity, here: Evaluation) -> list[float]:
    """Return how much each scalar varies with the simulator's own noise; 0 if that is unknown."""
    try:
        floor = noise_floor(problem, here.x)
    except SimulationError:
        return [0.0] * len(problem.labels if of == "criterion" else [c for k in problem.cases for c in k.channels])
    if of == "criterion":
        return [floor.residual] * len(problem.labels)
    noises = [float(n) for rows in floor.outputs for n in np.atleast_1d(rows)]
    if of != "change":
        return noises
    sigmas = [channel.noise.sigma for case in problem.cases for channel in case.channels]
    return [n / s for n, s in zip(noises, sigmas, strict=True)]


def _indices(values: NDArray[Any], half_widths: NDArray[Any] | None = None) -> tuple[Index, ...]:
    if half_widths is None:
        return tuple(Index(float(v)) for v in values)
    return tuple(Index(float(v), float(h)) for v, h in zip(values, half_widths, strict=True))


def _salib() -> Any:
    """Return SALib's samplers and analyses, as attributes."""
    from types import SimpleNamespace

    try:
        from SALib.analyze import morris as morris_analyze
        from SALib.analyze import sobol as sobol_analyze
        from SALib.sample import morris as morris_sample
        from SALib.sample import sobol as sobol_sample
    except ImportError:
        raise ProblemError("needs SALib", where="sensitivity", fix="pip install 'fmuid[sensitivity]'") from None
    return SimpleNamespace(
        morris_analyze=morris_analyze,
        sobol_analyze=sobol_analyze,
        morris_sample=morris_sample,
        sobol_sample=sobol_sample,
    )
