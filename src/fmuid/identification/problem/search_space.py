"""Mapping between model space (values for the FMU) and search space (coordinates for a solver)."""

from __future__ import annotations

import graphlib
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fmuid.core.campaign import SEPARATOR, ParameterSpec, Prior, without_owner
from fmuid.core.errors import ProblemError
from fmuid.core.formulas import Expression, parse
from fmuid.core.immutable import FloatArray, frozen_mapping, read_only

_STEP = 1e-6  # step of differences of expressions, in search units


@dataclass(frozen=True, slots=True)
class Move:
    """Change of the parameters with one free parameter, in model space.

    Parameters
    ----------
    slopes
        Derivatives of every dependent parameter with respect to it, including its own of 1.
    ends
        Small upward and downward steps within its bounds.
    """

    slopes: Mapping[str, float]
    ends: tuple[float, float]

    def derivative(
        self, function: Callable[[Mapping[str, float]], FloatArray], values: Mapping[str, float]
    ) -> FloatArray:
        """Return the derivative of a function of the parameters' values, by differences."""
        above, below = (
            function({**values, **{name: values[name] + end * slope for name, slope in self.slopes.items()}})
            for end in self.ends
        )
        return (above - below) / (self.ends[0] - self.ends[1])


@dataclass(frozen=True, slots=True, eq=False)
class SearchSpace:
    """Free, fixed and tied parameters of a problem.

    A linear parameter is searched in units of its start (or of its bounds' range if the start is 0), a logarithmic
    one as ln(value), so that all search coordinates are of order one.

    Parameters
    ----------
    free
        The parameters a solver varies; per-experiment parameters are already named ``name@experiment``.
    fixed
        Every other parameter's value.
    ties
        Follower name -> expression of other parameters.
    least
        Name of a free parameter -> the smallest unit of its search coordinate, independent of its start.
    sizes
        Name of a free parameter -> the unit of its search coordinate, if neither start nor bounds show it.
    """

    free: tuple[ParameterSpec, ...]
    fixed: Mapping[str, float] = field(default_factory=dict)
    ties: Mapping[str, Expression] = field(default_factory=dict)
    least: Mapping[str, float] = field(default_factory=dict)
    sizes: Mapping[str, float] = field(default_factory=dict)
    _order: tuple[str, ...] = field(init=False, default=())
    _unit: FloatArray = field(init=False, default_factory=lambda: np.ones(0))
    _log: NDArray[np.bool_] = field(init=False, default_factory=lambda: np.zeros(0, bool))
    _limits: tuple[FloatArray, FloatArray] = field(init=False, default=(np.ones(0), np.ones(0)))
    _bounds: tuple[FloatArray, FloatArray] = field(init=False, default=(np.ones(0), np.ones(0)))

    def __post_init__(self) -> None:
        for spec in self.free:
            _check(spec)
        free = {spec.name for spec in self.free}
        known = free | set(self.fixed) | set(self.ties)
        for name, expression in self.ties.items():
            if name in free:
                raise ProblemError(f"parameter '{name}' is both free and tied", fix="remove it from 'free'")
            if missing := sorted(expression.names - known):
                raise ProblemError(
                    f"the tie of '{name}' names unknown parameter '{missing[0]}'",
                    fix=f"known: {', '.join(sorted(known))}",
                )
        try:
            order = graphlib.TopologicalSorter({n: e.names & set(self.ties) for n, e in self.ties.items()})
            object.__setattr__(self, "_order", tuple(order.static_order()))
        except graphlib.CycleError as error:
            raise ProblemError(f"circular ties: {' -> '.join(error.args[1])}", fix="break one") from None
        object.__setattr__(self, "fixed", frozen_mapping(self.fixed))
        object.__setattr__(self, "ties", frozen_mapping(self.ties))
        object.__setattr__(self, "_log", np.array([spec.scale == "log" for spec in self.free], dtype=bool))
        units = [
            self.sizes.get(spec.name) or max(_reference(spec), self.least.get(spec.name, 0.0))
            for spec in self.free
        ]
        object.__setattr__(self, "_unit", np.array(units))
        limits = tuple(read_only([getattr(s, end) for s in self.free]) for end in ("lower", "upper"))
        object.__setattr__(self, "_limits", limits)
        object.__setattr__(self, "_bounds", tuple(map(read_only, map(self._search, limits))))

    def __len__(self) -> int:
        return len(self.free)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(spec.name for spec in self.free)

    @property
    def start(self) -> FloatArray:
        """(n,) start in search space."""
        return self._search(np.array([spec.start for spec in self.free]))

    @property
    def lower(self) -> FloatArray:
        """(n,) lower bounds in search space."""
        return self._bounds[0]

    @property
    def upper(self) -> FloatArray:
        """(n,) upper bounds in search space."""
        return self._bounds[1]

    @property
    def bounded(self) -> bool:
        """Whether every free parameter has both bounds, as global solvers need."""
        return not self.unbounded

    @property
    def unbounded(self) -> tuple[str, ...]:
        """Names of the free parameters that lack a bound."""
        return tuple(s.name for s in self.free if not np.isfinite(s.lower) or not np.isfinite(s.upper))

    def to_search(self, values: Mapping[str, float]) -> FloatArray:
        """Return the (n,) search point of model-space `values`."""
        return self._search(np.array([values[spec.name] for spec in self.free]))

    def to_model(self, x: FloatArray) -> dict[str, float]:
        """Return every parameter's model-space value (free, fixed and tied) at the (n,) search point `x`.

        Raises
        ------
        ProblemError
            A tied parameter is undefined there.
        """
        return self.followed(self._untied(x))

    def tried(self, x: FloatArray) -> tuple[dict[str, float], str | None]:
        """Return the values as `to_model` does, and the reason if some are undefined; tied values are NaN then."""
        try:
            return self.to_model(x), None
        except ProblemError as error:
            return self._untied(x) | dict.fromkeys(self._order, math.nan), str(error)

    def followed(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return `values` together with the parameters tied to them."""
        all_values = dict(values)
        for name in self._order:
            all_values[name] = self.ties[name](all_values)
        return all_values

    def _untied(self, x: FloatArray) -> dict[str, float]:
        free = np.minimum(np.maximum(self._model(x), self._limits[0]), self._limits[1]).tolist()
        return dict(self.fixed) | {s.name: v for s, v in zip(self.free, free, strict=True)}

    @property
    def priors(self) -> tuple[tuple[int, Prior], ...]:
        """Index and prior of the free parameters that have a prior."""
        return tuple((i, spec.prior) for i, spec in enumerate(self.free) if spec.prior is not None)

    def slope(self, x: FloatArray) -> FloatArray:
        """Return d model / d search, (n,), at `x`."""
        return np.where(self._log, self._model(x), self._unit)

    def moves(self, x: FloatArray, values: Mapping[str, float]) -> list[Move]:
        """Return the changes of the parameters with each free one at the (n,) search point `x`."""
        moves = []
        for spec, step in zip(self.free, (_STEP * self.slope(x)).tolist(), strict=True):
            slopes = {spec.name: 1.0}
            for name in self._order:
                if not slopes.keys().isdisjoint(self.ties[name].names):
                    slopes[name] = self.ties[name].slope(values, slopes)
            value = values[spec.name]
            moves.append(Move(slopes, (min(step, spec.upper - value), max(-step, spec.lower - value))))
        return moves

    def _search(self, values: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self._log, np.log(np.maximum(values, 0.0)), values / self._unit)

    def _model(self, x: FloatArray) -> FloatArray:
        with np.errstate(over="ignore"):
            return np.where(self._log, np.exp(np.where(self._log, x, 0.0)), x * self._unit)


def expanded(
    specs: Iterable[ParameterSpec],
    free: Iterable[str],
    best: Mapping[str, float],
    ties: Mapping[str, str],
    experiments: Iterable[str],
    *,
    machines: Iterable[str] = (),
) -> SearchSpace:
    """Build the search space of a stage.

    Parameters
    ----------
    specs
        The campaign's parameters.
    free
        Names that are free in this stage; a per-experiment name is expanded to one for each of `experiments`.
    best
        Best values so far, by (expanded) name.
    ties
        Follower -> expression text. A follower of a per-experiment parameter must be per-experiment as well.
    experiments, machines
        Ids of the stage's experiments, and names of the machines that they were made with.
    """
    by_name = {spec.name: spec for spec in specs}
    owners = {"campaign": (), "experiment": tuple(experiments), "machine": tuple(dict.fromkeys(machines))}
    free = tuple(dict.fromkeys(free))
    for name in (*free, *ties):
        if name not in by_name:
            raise ProblemError(f"unknown parameter '{name}'", fix=f"the campaign has: {', '.join(by_name)}")
    free_specs: list[ParameterSpec] = []
    fixed: dict[str, float] = {}
    least: dict[str, float] = {}  # a stage may have left a parameter close to 0
    for spec in by_name.values():
        copies = spec.of_each(owners[spec.per])
        if spec.name in ties:
            continue
        fixed[spec.name] = best.get(spec.name, spec.start)
        if spec.name in free:
            if not copies:
                del fixed[spec.name]
            free_specs += [replace(s, start=best.get(s.name, s.start)) for s in copies or [spec]]
            least |= dict.fromkeys((s.name for s in copies or [spec]), _reference(spec))
        else:
            known = {**spec.values, **best}
            fixed |= {s.name: known[s.name] for s in copies if s.name in known}
    parsed = {name: parse(text, where=f"tie of '{name}'") for name, text in ties.items()}
    parsed |= _of_owners(by_name, parsed, owners)
    for leader in {n for e in parsed.values() for n in e.names} - parsed.keys() - {s.name for s in free_specs}:
        if SEPARATOR in leader:  # fixed, and so far the same in every run
            fixed.setdefault(leader, fixed[without_owner(leader)])
    order = {name: i for i, name in enumerate(free)}
    free_specs.sort(key=lambda s: order[without_owner(s.name)])
    return SearchSpace(tuple(free_specs), fixed, parsed, least)


def _of_owners(
    specs: Mapping[str, ParameterSpec], ties: Mapping[str, Expression], owners: Mapping[str, tuple[str, ...]]
) -> dict[str, Expression]:
    """Return the ties of followers that have one value per run or per machine."""
    tied: dict[str, Expression] = {}
    for name, expression in ties.items():
        per = specs[name].per
        for leader in sorted(expression.names):
            if (kind := specs[leader].per if leader in specs else "campaign") not in ("campaign", per):
                run = "run" if kind == "experiment" else kind
                raise ProblemError(
                    f"'{name}' is tied to '{leader}', which has one value per {run}",
                    fix=f"write per = \"{kind}\" for '{name}' too",
                )
        leaders = {n for n in expression.names if n in specs and specs[n].per != "campaign"}
        for owner in owners[per]:
            renamed = {leader: f"{leader}{SEPARATOR}{owner}" for leader in leaders}
            tied[f"{name}{SEPARATOR}{owner}"] = expression.renamed(renamed)
    return tied


def _check(spec: ParameterSpec) -> None:
    where = f"parameter '{spec.name}'"
    if not spec.lower < spec.upper:
        raise ProblemError(
            f"lower bound {spec.lower:g} is not below upper {spec.upper:g}", where=where, fix="swap them"
        )
    if not spec.lower <= spec.start <= spec.upper:
        raise ProblemError(
            f"start {spec.start:g} is outside [{spec.lower:g}, {spec.upper:g}]",
            where=where,
            fix="move the start or the bound",
        )
    if spec.scale == "log" and not spec.start > 0.0:
        raise ProblemError(
            f"start {spec.start:g} cannot be searched on a log scale", where=where, fix='use scale = "linear"'
        )


def _reference(spec: ParameterSpec) -> float:
    """Return the model-space size of one unit of the search coordinate."""
    if spec.scale == "log":
        return 1.0
    if spec.start != 0.0:
        return abs(spec.start)
    spread = spec.upper - spec.lower
    return 0.1 * spread if np.isfinite(spread) else 1.0
