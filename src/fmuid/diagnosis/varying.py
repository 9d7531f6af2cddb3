"""Coefficients that vary, and laws that act beyond a threshold, judged before a model with them is built.

Every parameter may depend on variables near it, on measured outputs, on logged columns that the model does not
use, on time, or on the component's own warming. The response to each dependence follows from one linearisation of
the model along its runs (`linear_response`). Those that explain more of the residual than noise would become
effects. Laws at places are compared by the responses to the flows that they would cause, at all times or beyond a
threshold only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import msgspec
import numpy as np
from numpy.typing import NDArray

from fmu_build import compile_flat
from fmu_build.domains import MECHANICAL
from fmu_build.flat_model import FlatModel
from fmu_build.instrument import Added, Term, instrument
from fmu_build.model_ports import (
    Coefficient,
    Port,
    across_branches,
    coefficients,
    in_products_with,
    parameter_port,
)
from fmu_build.model_ports import places as find_places
from fmuid.core.campaign import Campaign
from fmuid.core.errors import SimulationError
from fmuid.core.formulas import parse, parse_modelica
from fmuid.core.immutable import FloatArray
from fmuid.core.toml_tables import toml_text
from fmuid.data.filtering import first_order
from fmuid.data.noise.level import GAP_THAT_MATTERS
from fmuid.diagnosis.cross_validation import draw_noise
from fmuid.diagnosis.observed import gap, orthonormal, project_off
from fmuid.diagnosis.refit import Refit
from fmuid.diagnosis.scores import SEEN, nominal_basis, stack
from fmuid.diagnosis.subject import Subject
from fmuid.diagnosis.variants import varying_parameters
from fmuid.diagnosis.verdict import Refinement
from fmuid.effects.effect import Effect
from fmuid.effects.flat_expressions import Seen, names_at, seen_at
from fmuid.effects.laws import (
    Dependence,
    Law,
    LawParameter,
    Place,
    effect_lines,
    fitting,
    laws,
    names_in,
    varying_id,
)
from fmuid.identification.problem.cases import LOGGED, RUN_TIME, logged
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.linear_response import Linearised, LinearisedFmu, LinearResponse

TIME, WARMTH, COEFFICIENT = "time", "warmth", "parameter"
_OF_RUN = RUN_TIME.removeprefix(LOGGED)
_MOST = 10  # coefficients that vary, built into a model
_EACH = 4  # of one parameter; laws that always act and laws beyond a threshold that refits compare
_SHARE = 0.25  # least score, as a share of the best one
_ALIKE = 1e-4  # courses whose correlation is within this of 1 are the same
_ONE_FLOW = 1e-6  # relative: what else there is of rates in proportion, beyond rounding
_SHOWN = 1e-3  # of a response: what the fitted parameters have to leave of it
_FUNCTION = 0.02  # of the mean square step between neighbours that have nothing to do with each other
_MOVES = 1e-3  # relative to its size: what moves less counts as constant
_FEW = 8  # states: in a model with more, only those near a component may change it
_ABOUT_ONE = (0.7, 1.4)  # factors by which the size of a law may change that is not linear in it
_CLOSES = 0.2  # share of what a law leaves beyond the noise that a later one has to explain: a tenth of the gap
_MARGIN = 1.2  # over the largest score that noise alone reaches
_ROUNDS = 8  # of the search for a law's shape
_PART = 0.125  # first steps of that search, as a share of what is possible
_INSIDE = 0.01  # share of what is possible that the search stays away from a bound
_SHARES = (0.1, 0.25, 0.5, 1.0, 2.0)  # of a size that fits a small response: where the search for it begins
_LEAST = 0.02  # of its value: a coefficient that comes nearer to vanishing acts as one of that size
_THRESHOLDS = tuple(0.1 * k for k in range(1, 10))  # of the range of what a law depends on
_STRAIGHT = 0.02  # of its change: a course that is this near to its chord is a line


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """What a coefficient may depend on.

    Attributes
    ----------
    name
        As in ids: a variable, a signal, a column, or time, from its origin in the logs or from a run's beginning.
    text
        In Modelica.
    courses
        (N,) values in every run whose model has the coefficient.
    direct
        Whether it is a state, an input or time, so that a dependence makes no algebraic loop.
    near
        Whether it is a variable at the component itself.
    column
        Whether it is a logged column that the model does not use, which becomes an input.
    factor
        Whether it multiplies or divides the coefficient.
    within
        The places whose coefficient and variable these are, or the input that multiplies it.
    """

    name: str
    text: str
    unit: str
    courses: tuple[FloatArray, ...]
    direct: bool = True
    near: bool = False
    column: bool = False
    factor: bool = False
    within: tuple[str, ...] = ()

    @property
    def low(self) -> float:
        """The least value."""
        return min(float(c.min()) for c in self.courses)

    @property
    def high(self) -> float:
        """The largest value."""
        return max(float(c.max()) for c in self.courses)

    @property
    def reference(self) -> float:
        """The value at which the coefficient is the parameter's own: zero, or that at the first start."""
        span = self.high - self.low
        zero = self.low <= 0.1 * span and self.high >= -0.1 * span
        return 0.0 if zero else float(self.courses[0][0])

    @property
    def sizes(self) -> dict[str, float]:
        """Numbers for the library's formulas, without the duration of the runs."""
        low, high, at = self.low, self.high, self.reference
        return {"P": max(high - at, at - low), "Z": at, "low": low, "high": high}

    @property
    def signed(self) -> bool:
        """Whether it moves to both sides of the reference."""
        at, share = self.reference, 0.1 * self.sizes["P"]
        return self.low < at - share and self.high > at + share


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """A law for a coefficient over a source, with the fall of the cost that it promises at values of a trial.

    `change` is the largest relative change of the coefficient at the size that fits, which is `scale` times the
    trial's; what the model does follows a `power` of the coefficient.
    """

    coefficient: Coefficient
    source: Source
    name: str
    trial: Mapping[str, float]
    drop: float
    change: float
    signature: FloatArray
    scale: float
    power: float

    @property
    def law(self) -> Law:
        """The law of the library."""
        return laws()[self.name]

    @property
    def over(self) -> str:
        """What it depends on, as in ids."""
        return WARMTH if self.law.memory else self.source.name

    @property
    def scales(self) -> bool:
        """Whether its response at any size is that of the trial, scaled."""
        return _linear(self.law) and self.power == 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """A setup's model, linearised along its runs.

    `across` are the branches of differences (`across_branches`), `places` the numbers of the coefficients, and of
    flows at the `ports`, in the responses; `index` are the numbers of the setup's cases.
    Without source, `flat` is None.
    """

    flat: FlatModel | None
    across: Mapping[str, str]
    linear: Linearised | LinearisedFmu
    coefficients: Mapping[str, Coefficient]
    places: Mapping[str, int]
    index: Sequence[int]
    courses: Sequence[Mapping[str, FloatArray]]
    responses: Sequence[LinearResponse]
    values: Mapping[str, float]
    ports: Mapping[str, Port]
    seen: Mapping[str, Sequence[Seen | None]]

    def offers(self, variable: str) -> bool:
        """Return whether coefficients may depend on a variable; without source, only on states and inputs."""
        return self.linear.direct(variable) if self.flat is None else variable in self.flat.variables

    def near(self, name: str) -> tuple[str, ...]:
        """Return the variables where a coefficient acts."""
        c = self.coefficients[name]
        return c.variables if self.flat is None else (*_ends(self.flat, c), *c.variables)

    def branches(self, name: str) -> Iterator[str]:
        """Yield the components with two connectors in which a coefficient acts."""
        if self.flat is not None:
            ends = [c.component for c in self.flat.connectors.values()]
            yield from (c for c in self.coefficients[name].components if c and ends.count(c) > 1)

    def around(self, name: str) -> list[str]:
        """Return the states that a coefficient may depend on."""
        states = self.linear.states
        if len(states) <= _FEW or self.flat is None:
            return states
        parts = _around(self.flat, self.coefficients[name])
        return [v for v in states if self.flat.variables[v].component in parts]


def varying_lines(
    subject: Subject,
    nominal: Refit,
    campaign: Campaign,
    setups: Sequence[Setup],
    known: Mapping[str, object],
    *,
    costs: Callable[[Sequence[str]], Mapping[str, float]],
) -> list[str]:
    """Return the entries of a catalogue for the coefficients that seem to vary; none if there is no setup.

    Laws of one coefficient that the responses to small changes do not tell apart are refitted.

    Parameters
    ----------
    subject
        The plain models with their measurements.
    nominal
        The plain models refitted.
    setups
        The models, linearised.
    known
        Names of the places that the catalogue already has.
    costs
        Entries of a catalogue -> the cost that a refit with each effect leaves, by id.
    """
    groups, among = scored(subject, campaign, setups, nominal)
    several = [one for group in groups if len(group) > 1 for one in group]
    if several:
        left = costs(_lines(subject, several, among, {}, apart=True))
        size = stack(nominal.residuals, subject.observed).size
        groups = [[_first(group, lambda one: left[_id_apart(one)] - size)] for group in groups]
    return _lines(subject, [group[0] for group in groups], among, known)


def _lines(
    subject: Subject, chosen: Sequence[Scored], among: int, known: Mapping[str, object], *, apart: bool = False
) -> list[str]:
    """Return the entries of a catalogue. If several laws of a coefficient are kept `apart`, ids name the law."""
    duration = max(float(np.ptp(case.time)) for case in subject.model.cases)
    lines: list[str] = []
    for name, unit in {
        s.coefficient.name: s.coefficient.unit for s in chosen if s.coefficient.name not in known
    }.items():
        lines += [f"[ports.{toml_text(name)}]", f"description = {toml_text(f'Value of {name}')}"]
        lines += [f"unit = {toml_text(unit)}", ""]
    for one in chosen:
        source, law = one.source, _from(one)
        port = parameter_port(one.coefficient.name, source.unit, one.coefficient.unit)
        usual = source.near or source.name in _measured(subject)
        usual = source.column or (usual and bool(one.coefficient.components))  # else unknown
        inputs = {source.text: source.unit} if source.text.startswith(LOGGED) else {}
        within = () if law.memory else source.within
        over = Dependence(
            one.over, source.text, usual, not source.direct or bool(law.states), inputs, among, within
        )
        over = replace(over, name=_apart(one)) if apart else over
        lines += effect_lines(one.name, law, Place(port, {**source.sizes, "T": duration}), over)
    return lines


def _apart(one: Scored) -> str:
    return f"{one.over}, {one.name}"


def _id_apart(one: Scored) -> str:
    return varying_id(one.coefficient.name, _apart(one))


def _from(one: Scored) -> Law:
    """Return a law that is tried at the shape that explained most, first of all."""
    shape = {key: repr(one.trial[key]) for key in one.law.parameters}
    sizes = dict.fromkeys(t["size"] for t in one.law.trials or ())
    others = [{**shape, "size": size} for size in sizes] if _linear(one.law) else one.law.trials or []
    return msgspec.structs.replace(one.law, trials=[shape, *others])


def scored(
    subject: Subject, campaign: Campaign, setups: Sequence[Setup], nominal: Refit
) -> tuple[list[list[Scored]], int]:
    """Return the dependences that explain more of the residual than noise would, best first.

    Each has one law, or several that refits have to choose from. Also return how many laws were compared.
    """
    observed = subject.observed
    basis, residual = nominal_basis(nominal, observed), stack(nominal.residuals, observed)
    pairs: list[tuple[list[Setup], list[Scored]]] = []
    among = 0
    for name in dict.fromkeys(name for setup in setups for name in setup.coefficients):
        having = [setup for setup in setups if name in setup.coefficients]
        by_over: dict[str, list[Scored]] = {}
        for source in _sources(subject, campaign, having, name):
            for one in _of(subject, having, source, name, basis=basis, residual=residual):
                by_over.setdefault(one.over, []).append(one)
        among += sum(map(len, by_over.values()))
        pairs += [(having, every) for every in sorted(by_over.values(), key=_largest, reverse=True)[:_EACH]]
    if not pairs:
        return [], among
    pairs.sort(key=lambda pair: -_largest(pair[1]))
    least = 0.5 * _SHARE * _largest(pairs[0][1])
    beyond = float(residual @ residual) - residual.size
    groups = []
    for having, every in (pair for pair in pairs[: 2 * _MOST] if _largest(pair[1]) >= least):
        by_source = [[s for s in every if s.source is source] for source in dict.fromkeys(s.source for s in every)]
        shaped = [s for of in by_source for s in _with_shapes(subject, having, of, basis=basis, residual=residual)]
        groups.append(_open(shaped, beyond))
    groups.sort(key=_largest, reverse=True)
    beyond_noise = _beyond_noise(subject, nominal, basis, [s.signature for group in groups for s in group])
    least = max(beyond_noise, _SHARE * _largest(groups[0]))
    return [group for group in groups if _largest(group) >= least][:_MOST], among


def _beyond_noise(subject: Subject, nominal: Refit, basis: FloatArray, signatures: Sequence[FloatArray]) -> float:
    """Return the fall of the cost from which one of the `signatures` explains more than noise alone would."""
    (prediction,) = subject.model.predict([nominal.values])
    assert not isinstance(prediction, SimulationError)
    return _MARGIN * draw_noise(subject.observed, prediction).null(basis, signatures).threshold()


def linearised(
    subject: Subject, nominal: Refit, models: Mapping[str, FlatModel | Fmu], places: Sequence[Place]
) -> list[Setup]:
    """Return the setups linearised at the refitted parameters; none if there is no gap.

    Parameters
    ----------
    nominal
        The plain models refitted.
    models
        The flat models of setups that have a source, and the FMUs of others that offer model exchange.
    places
        Where laws may act in models with source.
    """
    if gap(nominal.residuals, subject.observed) <= GAP_THAT_MATTERS:
        return []
    every = (_setup(subject, name, model, nominal, places) for name, model in models.items())
    return [setup for setup in every if setup is not None]


def _setup(
    subject: Subject, name: str, model: FlatModel | Fmu, nominal: Refit, places: Sequence[Place]
) -> Setup | None:
    """Return a setup linearised at the refitted parameters; None if no run or no coefficient is there."""
    index = [k for k, case in enumerate(subject.model.cases) if case.setup == name]
    by_name = _without_source(model) if isinstance(model, Fmu) else {c.name: c for c in coefficients(model)}
    if not index or not by_name:
        return None
    linear: Linearised | LinearisedFmu
    at: list[Port] = []
    if isinstance(model, Fmu):
        flat, linear, factors = None, LinearisedFmu(model, list(by_name)), {n: n for n in by_name}
        wanted = dict.fromkeys(linear.needed)
    else:
        # A parameter that varies in one equation only gets a factor there.
        flat, factors = (
            model,
            {n: f"{n.replace(':', '.')}.factor" if n != c.parameter else n for n, c in by_name.items()},
        )
        terms = [Term(n, "parameter", f"p*{factor}") for n, factor in factors.items() if factor != n]
        here = find_places(flat)
        at = [place.port for place in places if place.port.name in here and any(_flow_laws(place))]
        factors |= {_flow(port): f"{port.name}.flow_factor" for port in at}
        terms += [Term(port.name, "flow", f"{factors[_flow(port)]} - 1") for port in at]
        split = instrument(flat, terms, [Added(factor, 1.0) for n, factor in factors.items() if factor != n])
        linear = Linearised(compile_flat(split), [*factors.values()])
        near = (v for c in by_name.values() for v in (*c.variables, *_ends(model, c)))
        probes = (v for port in at for v in (*names_at(port), *(n for of in port.probes.values() for n in of)))
        wanted = dict.fromkeys([*linear.needed, *near, *probes])
    where = {n: linear.parameters.index(factor) for n, factor in factors.items() if factor in linear.parameters}
    cases = [subject.model.cases[k] for k in index]
    wanted |= dict.fromkeys(c.variable for case in cases for c in case.channels)
    names = [n for n in wanted if all(n in case.simulator.variables for case in cases)]
    rows = replace(subject.model, cases=tuple(cases)).trajectories(nominal.values, names)
    courses, responses, known = [], [], {**subject.model.fixed, **nominal.values}
    for case, row in zip(cases, rows, strict=True):
        driven = {n: np.asarray(u)[case.lead :] for n, u in case.task.inputs.items()}
        courses.append(dict(zip(names, row, strict=True)) | driven)
        values = {**case.task.start_values, **subject.model.start_values(case, known)}
        responses.append(linear.along(case.time, courses[-1], values, case.task.outputs))
    shared = _of_one_flow(where, responses)
    where = {n: k for n, k in where.items() if n not in shared}
    across = {} if flat is None else across_branches(flat)
    having = {n: by_name[n] for n in where if n in by_name}
    ports = {port.name: port for port in at if _flow(port) in where}
    seen = {
        n: [seen_at(p, c, case.time) for case, c in zip(cases, courses, strict=True)] for n, p in ports.items()
    }
    return Setup(flat, across, linear, having, where, index, courses, responses, known, ports, seen)


def _flow(port: Port) -> str:
    """Return the name of a flow at a port among the coefficients."""
    return f"flow@{port.name}"


def _of_one_flow(places: Mapping[str, int], responses: Sequence[LinearResponse]) -> set[str]:
    """Return the places of parameters in two equations where they set one flow, which both stores share.

    What leaves one store enters the other, and action is reaction: such a parameter varies in both equations
    alike. The two places then move the rates of the states in proportion.
    """
    shared = set[str]()
    for one, other in combinations((n for n in places if ":" in n), 2):
        if one.partition(":")[0] == other.partition(":")[0]:
            rates = [np.concatenate([r.rates[:, :, places[n]] for r in responses]) for n in (one, other)]
            sizes = [float(np.linalg.norm(r)) for r in rates]
            if min(sizes) > 0.0:
                singular = np.linalg.svd(
                    np.hstack([r / s for r, s in zip(rates, sizes, strict=True)]), compute_uv=False
                )
                if singular[1] <= _ONE_FLOW * singular[0]:
                    shared |= {one, other}
    return shared


def _without_source(fmu: Fmu) -> dict[str, Coefficient]:
    """Return the parameters of an FMU that may vary, which may act at any of its states."""
    variables, states = fmu.variables, fmu.states
    names = [n for n in varying_parameters(fmu) if variables[n].start]
    return {n: Coefficient(n, variables[n].unit or "1", (), states) for n in names}


def _ends(flat: FlatModel, c: Coefficient) -> Iterator[str]:
    """Yield potentials and flows of the components in which a coefficient acts."""
    for connector in flat.connectors.values():
        if connector.component and connector.component in c.components:
            yield from connector.potentials
            yield from connector.flows


def _measured(subject: Subject) -> dict[str, str]:
    """Return the model's variable of each measured signal."""
    return {c.signal: c.variable for case in subject.model.cases for c in case.channels}


def _sources(subject: Subject, campaign: Campaign, having: Sequence[Setup], name: str) -> list[Source]:
    """Return the quantities that a coefficient may depend on; of several that are the same, only the first."""
    cases = [(subject.model.cases[k], c) for s in having for k, c in zip(s.index, s.courses, strict=True)]
    sources: list[Source] = []
    known: list[FloatArray] = []

    def offer(source: Source) -> None:
        whole = np.concatenate(source.courses)
        size = float(np.abs(whole).max())
        if not np.isfinite(whole).all() or float(np.ptp(whole)) <= _MOVES * size:
            return
        unit = _unit(whole)
        same = next((k for k, other in enumerate(known) if _one_course(unit, other)), None)
        if same is None:
            known.append(unit)
            sources.append(source)
        else:
            before = sources[same]
            near, factor = before.near or source.near, before.factor or source.factor
            sources[same] = replace(before, near=near, factor=factor)

    units = {v: one.unit or "1" for v, one in cases[0][0].simulator.variables.items()}
    signals = {variable: signal for signal, variable in _measured(subject).items()}
    neighbours = [v for s in having for v in s.near(name)]
    states = [v for s in having for v in s.around(name)]
    inputs = [n for case, _ in cases for n in case.task.inputs]
    near = {*neighbours}
    factors = {n for s in having if s.flat is not None for n in in_products_with(s.flat, name.partition(":")[0])}
    # Of variables that are equal, a measured signal or an input names a dependence best.
    ordered = dict.fromkeys([*inputs, *signals, *states, *neighbours])
    for variable in ordered:
        if all(variable in c for _, c in cases) and all(s.offers(variable) for s in having):
            direct = all(s.linear.direct(variable) for s in having)
            course = tuple(c[variable] for _, c in cases)
            name_ = signals.get(variable, variable)
            here, multiplies = variable in near, variable in factors
            offer(Source(name_, variable, units.get(variable, "1"), course, direct, here, factor=multiplies))
    logs = [[campaign.measurements[id].unused for id in case.experiments] for case, _ in cases]
    for column in (n for n in logs[0][0] if all(n in one for log in logs for one in log)):
        values = tuple(np.mean([one[column].values for one in log], axis=0) for log in logs)
        offer(Source(column, logged(column), logs[0][0][column].unit, values, column=True))
    offer(Source(TIME, TIME, "s", tuple(case.time for case, _ in cases)))
    begun = tuple(case.columns[RUN_TIME][1] for case, _ in cases)
    offer(Source(_OF_RUN, RUN_TIME, "s", begun))
    branch = next((b for s in having for b in s.branches(name)), "")
    nodes = _nodes(having, name)

    def within(source: Source, unit: FloatArray) -> tuple[str, ...]:
        written = next((s.across[source.text] for s in having if source.text in s.across), "")
        if source.factor and written:
            return (written,)
        if source.name in inputs:
            return (source.name,) * source.factor
        node = next((n for n, of in nodes.items() if any(_one_course(unit, one) for one in of)), "")
        return tuple(place for place in (branch * source.near, node) if place)

    return [replace(source, within=within(source, unit)) for source, unit in zip(sources, known, strict=True)]


def _nodes(having: Sequence[Setup], name: str) -> dict[str, list[FloatArray]]:
    """Return the nodes where a coefficient acts as a law there would, with its quantities, of unit length.

    It moves the rates of the states as a flow at the node, which is a function of its potential or of its rate: a
    conductance to a fixed temperature, a bearing.
    """
    nodes: dict[str, list[FloatArray]] = {}
    responses = [(s, r) for s in having for r in s.responses]
    begins = np.cumsum([0, *(len(r.time) for _, r in responses[:-1])])
    knots = np.concatenate([k + r.knots for k, (_, r) in zip(begins, responses, strict=True)]).astype(np.intp)
    for port in having[0].ports.values():
        if port.kind != "node" or any(port.name not in setup.ports for setup in having):
            continue
        flows = [_as_flow(r, s.places[name], s.places[_flow(port)]) for s, r in responses]
        flow = [part for part in flows if part is not None]
        if len(flow) < len(flows):
            continue
        _, columns = _columns(having, port)
        for course in (columns[quantity] for quantity in ("rate", "p") if quantity in columns):
            if np.ptp(course) > 0.0 and _is_function(course[knots], np.concatenate(flow)):
                nodes.setdefault(port.name, []).append(_unit(course))
    return nodes


def _as_flow(response: LinearResponse, coefficient: int, flow: int) -> FloatArray | None:
    """Return the (K,) flow that moves the rates as a coefficient does; None if a flow does not."""
    rates, unit = response.rates[:, :, coefficient], response.rates[:, :, flow]
    energy = np.sum(unit**2, axis=1)
    amount = np.sum(rates * unit, axis=1) / np.where(energy > 0.0, energy, np.inf)
    rest = float(np.linalg.norm(rates - amount[:, None] * unit))
    size = float(np.linalg.norm(rates))
    return amount if size > 0.0 and rest <= _ONE_FLOW * size else None


def _is_function(x: FloatArray, y: FloatArray) -> bool:
    """Return whether neighbours in `x` are neighbours in `y` (von Neumann 1941)."""
    steps = np.diff(y[np.argsort(x, kind="stable")])
    return float(steps @ steps) <= _FUNCTION * 2.0 * float(np.sum((y - y.mean()) ** 2))


def _unit(course: FloatArray) -> FloatArray:
    """Return a course around its mean, of unit length."""
    centred = course - course.mean()
    return np.asarray(centred / np.linalg.norm(centred))


def _one_course(a: FloatArray, b: FloatArray) -> bool:
    """Return whether two courses of unit length are one."""
    return abs(float(a @ b)) >= 1.0 - _ALIKE


def _around(flat: FlatModel, c: Coefficient) -> set[str]:
    """Return the components in which a coefficient acts, and those that are connected to them."""
    components = {*c.components}
    for equation in flat.equations:
        if equation.origin.connectors:
            joined = {flat.connectors[p].component for p in equation.origin.connectors if p in flat.connectors}
            if joined & {*c.components}:
                components |= joined
    return components


def _of(
    subject: Subject,
    having: Sequence[Setup],
    source: Source,
    name: str,
    *,
    basis: FloatArray,
    residual: FloatArray,
) -> Iterator[Scored]:
    """Return the laws of a coefficient over a source, each with the best of its trials."""
    duration = max(float(np.ptp(case.time)) for case in subject.model.cases)
    tried = [(n, t) for n, law in laws().items() if _suits(law, source) for t in _trials(law, source, duration)]
    return _at(subject, having, source, name, tried, basis=basis, residual=residual)


def _at(
    subject: Subject,
    having: Sequence[Setup],
    source: Source,
    name: str,
    tried: Sequence[tuple[str, Mapping[str, float]]],
    *,
    basis: FloatArray,
    residual: FloatArray,
    sized: bool = False,
) -> Iterator[Scored]:
    """Yield the laws of a coefficient over a source, each with the best of its trials that can be evaluated.

    Trials of laws that are linear in their size show the response to any size, unless they are `sized` and the
    model follows another power of the coefficient.
    """
    trials: dict[str, list[Mapping[str, float]]] = {}
    for law_name, trial in tried:
        trials.setdefault(law_name, []).append(trial)
    times = [subject.model.cases[k].time for s in having for k in s.index]
    x, ends = np.concatenate(source.courses), _ends_of(times)
    power = float(np.median([r.powers[s.places[name]] for s in having for r in s.responses]))
    rows: list[FloatArray] = []
    for law_name, of_law in trials.items():
        changes = _acting(_changes(laws()[law_name], x, times, of_law), power)
        moves = np.any([np.ptp(run, axis=1) > 0.0 for run in np.split(changes, ends, axis=1)], axis=0)
        kept = np.isfinite(changes).all(axis=1) & moves
        rows.append(changes[kept])
        trials[law_name] = [trial for trial, there in zip(of_law, kept, strict=True) if there]
    if not any(map(len, rows)):
        return
    moved = _moved(subject, having, name, np.split(np.concatenate(rows), ends, axis=1))
    responses = _responses(moved, basis, residual)
    shown = responses.lengths > 0.0
    lengths = np.where(shown, responses.lengths, 1.0)
    begin = 0
    for (law_name, of_law), changes in zip(trials.items(), rows, strict=True):
        law, part = laws()[law_name], slice(begin, begin + len(of_law))
        begin, amount, length = part.stop, responses.amounts[part], lengths[part]
        fitting, drops = amount / length, np.where((amount > 0.0) | law.two_sided, amount**2, 0.0)
        if not _linear(law) or (sized and power != 1.0):  # another size is another shape
            fitting = np.clip(fitting, *_ABOUT_ONE)
            drops = length**2 * fitting * (2.0 * amount / length - fitting)
        if not shown[part].any():
            continue
        k = int(np.argmax(np.where(shown[part], drops, -np.inf)))
        change = float(abs(fitting[k]) * np.abs(changes[k]).max())
        coefficient, signature = having[0].coefficients[name], responses.signatures(part.start + k)
        yield Scored(
            coefficient, source, law_name, of_law[k], float(drops[k]), change, signature, float(fitting[k]), power
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Responses:
    """(R, M) changes of the residual beyond what the parameters, whose responses have a `basis`, imitate of them.

    Their (R,) lengths and how far the residual follows each are zero where the parameters imitate nearly all.
    """

    moved: FloatArray
    basis: FloatArray
    within: FloatArray
    lengths: FloatArray
    amounts: FloatArray

    def signatures(self, rows: int | slice) -> FloatArray:
        """Return some of the changes, without that part, with unit length."""
        lengths = self.lengths[rows]
        beyond = self.moved[rows] - self.within[rows] @ self.basis.T
        return np.asarray(beyond / np.where(lengths > 0.0, lengths, np.inf)[..., None])


def _responses(moved: FloatArray, basis: FloatArray, residual: FloatArray) -> _Responses:
    within, wholes = moved @ basis, np.linalg.norm(moved, axis=1)
    lengths = np.sqrt(np.maximum(wholes**2 - np.sum(within**2, axis=1), 0.0))
    lengths = np.where(lengths > _SHOWN * wholes, lengths, 0.0)
    follows = within @ (basis.T @ residual) - moved @ residual
    return _Responses(moved, basis, within, lengths, follows / np.where(lengths > 0.0, lengths, np.inf))


def _acting(changes: FloatArray, power: float) -> FloatArray:
    """Return the relative changes of a coefficient as they act on what follows a power of it."""
    return changes if power == 1.0 else (np.maximum(1.0 + changes, _LEAST) ** power - 1.0) / power


def _largest(scored: Sequence[Scored]) -> float:
    return max(s.drop for s in scored)


def _with_shapes(
    subject: Subject, having: Sequence[Setup], every: Sequence[Scored], *, basis: FloatArray, residual: FloatArray
) -> list[Scored]:
    """Return laws over one source at the shapes that explain most; else trials would be compared instead of laws.

    A pattern search, on a logarithmic scale for values that are positive.
    """
    coefficient, source = every[0].coefficient.name, every[0].source
    linear = [one for one in every if not one.scales and _linear(one.law)]
    fitting = [(one.name, trial) for one in linear for trial in _fitting(one)]
    resized = _at(subject, having, source, coefficient, fitting, basis=basis, residual=residual, sized=True)
    best = {one.name: one for one in (*every, *resized)}
    part, bounds = dict.fromkeys(best, _PART), {name: _bounds(one) for name, one in best.items()}
    for _ in range(_ROUNDS):
        tried = [
            (name, {**one.trial, **dict(zip(bounds[name], values, strict=True))})
            for name, one in best.items()
            for values in product(
                *(
                    [_further(one.trial[k], s * part[name], *e) for s in (-1, 0, 1)]
                    for k, e in bounds[name].items()
                )
            )
            if bounds[name]
        ]
        before = dict(best)
        for one in _at(subject, having, source, coefficient, tried, basis=basis, residual=residual, sized=True):
            best[one.name] = one if one.drop > best[one.name].drop else best[one.name]
        part = {name: part[name] if best[name] is not before[name] else 0.5 * part[name] for name in best}
    return [*best.values()]


def _bounds(one: Scored) -> dict[str, tuple[float, float]]:
    """Return the bounds of what determines a law's shape."""
    known = {k: v for k, v in one.trial.items() if k not in one.law.parameters}
    return {
        key: (parse(p.least)(known), parse(p.most)(known))
        for key, p in one.law.parameters.items()
        if key != "size" or not one.scales
    }


def _fitting(one: Scored) -> list[dict[str, float]]:
    """Return the values of a trial at shares of the size that fits a small response, up to where it may end."""
    low, high = _bounds(one)["size"]
    most = one.scale * one.trial["size"]
    return [{**one.trial, "size": float(np.clip(share * most, low, high))} for share in _SHARES]


def _further(value: float, step: float, least: float, most: float) -> float:
    """Return a value moved by a share of what is possible, and not to a bound, where no shape is plausible."""
    at, low, high = np.log([value, least, most]) if least > 0.0 else (value, least, most)
    margin = _INSIDE * (high - low)
    moved = float(np.clip(at + step * (high - low), low + margin, high - margin))
    return float(np.exp(moved)) if least > 0.0 else moved


def _relevant(left: float) -> float:
    """Return the fall of the cost that a later law of the library has to reach where an earlier one has `left`."""
    return max(_CLOSES * left, SEEN**2)


def _first(every: Sequence[Scored], left: Callable[[Scored], float], curved: float = 0.0) -> Scored:
    """Return the first law of the library that leaves hardly more than later ones of what is beyond the noise.

    Where responses are `curved`, what a law explains is uncertain by the square of that times its change. Laws
    that fit best at a bound of their shape have another one, and come last.
    """
    best, *others = sorted(every, key=_at_bound)
    for one in others:
        if left(best) - left(one) > max(_relevant(left(best)), (curved * one.change) ** 2 * one.drop):
            best = one
    return best


def _at_bound(one: Scored) -> bool:
    """Return whether a law fits best where the search for its shape ends."""
    bounds = _bounds(one).items()
    return any(one.trial[k] == _further(end, 0.0, *ends) for k, ends in bounds for end in ends)


def _open(every: Sequence[Scored], beyond: float) -> list[Scored]:
    """Return the law that describes a dependence, first of all, and those that refits have to compare with it.

    The response to a change c differs from its linear part by about c/2 of that. Laws that explain relevantly
    more than the first one may be better, but not beyond that doubt.
    """

    def left(one: Scored) -> float:
        return max(beyond - one.drop, 0.0)

    by_name = {one.name: one for one in sorted(every, key=lambda one: one.drop)}
    compared = [one for one in every if by_name[one.name] is one]
    first = _first(compared, left, 0.5)
    return [first, *(one for one in compared if left(first) - left(one) > _relevant(left(first)))]


def _suits(law: Law, source: Source) -> bool:
    """Return whether a coefficient may vary by a law over a source."""
    return (
        COEFFICIENT in law.domains
        and (not law.absolute or source.unit == "K")
        and (not law.signed or source.signed)
        and (not law.memory or (source.near and source.text != TIME))
    )


def _trials(law: Law, source: Source, duration: float) -> Iterator[dict[str, float]]:
    """Yield values of a law's parameters and sizes, once for each shape of a law that is linear in its size."""
    sizes = {**source.sizes, "T": duration}
    starts = {k: parse(p.start)(sizes) for k, p in law.parameters.items() if p.start}
    seen = []
    for trial in law.trials or ():
        values = {**sizes, **starts, **{k: parse(text)(sizes) for k, text in trial.items()}}
        shape = {k: v for k, v in values.items() if k != "size"}
        if shape not in seen or not _linear(law):
            seen.append(shape)
            yield values


def _linear(law: Law) -> bool:
    return law.of(COEFFICIENT).startswith("p*(1 + size*")


def _changes(
    law: Law, x: FloatArray, times: Sequence[FloatArray], trials: Sequence[Mapping[str, float]]
) -> FloatArray:
    """Return the (R, N) relative changes of a coefficient where its source is `x`, for each of R trials."""
    shape = len(trials), len(x)
    columns: dict[str, FloatArray] = {"x": x, "p": np.ones(1)}
    columns |= {key: np.array([[trial[key]] for trial in trials]) for key in trials[0]}
    for state, one in law.states.items():
        heats = _evaluated(one.derivative, {**columns, state: np.zeros(1)}, shape) * columns["lag"]
        warmed = (_warmed(heat, times, trial["lag"]) for heat, trial in zip(heats, trials, strict=True))
        columns[state] = np.array([*warmed])
    return _evaluated(law.of(COEFFICIENT), columns, shape) - 1.0


def _warmed(heat: FloatArray, times: Sequence[FloatArray], lag: float) -> FloatArray:
    """Return the state of a law that follows `heat` with a lag, from zero in each run."""
    warmed = []
    for part, time in zip(np.split(heat, _ends_of(times)), times, strict=True):
        keep = np.exp(-float(np.mean(np.diff(time))) / lag)
        warmed.append(first_order((1.0 - keep) * np.append(0.0, part[:-1]), keep))
    return np.concatenate(warmed)


def _ends_of(times: Sequence[FloatArray]) -> NDArray[np.intp]:
    """Return where to split what belongs to the samples of all runs, joined."""
    return np.cumsum([len(time) for time in times])[:-1]


def _evaluated(text: str, columns: Mapping[str, FloatArray], shape: tuple[int, int]) -> FloatArray:
    expression = parse_modelica(text)
    return np.broadcast_to(expression.of_samples({n: columns[n] for n in expression.names}), shape)


def _moved(subject: Subject, having: Sequence[Setup], name: str, courses: Sequence[FloatArray]) -> FloatArray:
    """Return (R, M) changes of the whitened residual by R courses of a coefficient, given for each run."""
    observed = subject.observed
    count = len(courses[0])
    parts = [np.zeros((count, w.size)) for w in observed.whiteners]
    remaining = iter(courses)
    for setup in having:
        j = setup.places[name]
        for k, response in zip(setup.index, setup.responses, strict=True):
            case = subject.model.cases[k]
            moved = response.to(j, next(remaining))
            shown = np.stack([c.scaled(case.time, moved[:, i], setup.values) if not c.plain else moved[:, i]
                              for i, c in enumerate(case.channels)], axis=1)  # fmt: skip
            whitened = observed.whiteners[k](shown).reshape(count, -1)
            if observed.nuisances:
                whitened = project_off(whitened.T, observed.nuisances[k]).T
            parts[k] = np.sqrt(observed.repeats[k]) * whitened
    return np.concatenate(parts, axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class LawThere:
    """A law at a place, with the fall of the cost that its response promises where the model is.

    Of one that acts `beyond` a threshold only, that is its law without one.
    """

    name: str
    law: Law
    place: Place
    drop: float
    signature: FloatArray
    beyond: str = ""

    @property
    def id(self) -> str:
        """Id of the effect."""
        return f"{self.name}@{self.place.port.name}"

    @property
    def without(self) -> str:
        """Id of the effect without a threshold."""
        return f"{self.beyond or self.name}@{self.place.port.name}"


def laws_beyond(
    subject: Subject,
    nominal: Refit,
    setups: Sequence[Setup],
    places: Sequence[Place],
    *,
    costs: Callable[[Sequence[LawThere]], Mapping[str, float]],
) -> dict[str, Law]:
    """Return the laws that explain more where they act beyond a threshold only, by effect.

    With a threshold, they have to explain relevantly more than any law without one, and more than noise would: as
    responses promise where the model is, and then next to refits of those without one.

    Parameters
    ----------
    costs
        Laws -> the cost that a refit with each leaves, by id.
    """
    observed = subject.observed
    basis, residual = nominal_basis(nominal, observed), stack(nominal.residuals, observed)
    every = [law for place in places for law in _laws_at(subject, setups, place, basis=basis, residual=residual)]
    always = sorted((one for one in every if not one.beyond), key=lambda one: -one.drop)[:_EACH]
    most = max((one.drop for one in always), default=0.0)
    least = most + _relevant(max(float(residual @ residual) - residual.size - most, 0.0))
    beyond = sorted((one for one in every if one.beyond and one.drop > least), key=lambda one: -one.drop)[:_EACH]
    if not beyond:
        return {}
    least = _beyond_noise(subject, nominal, basis, [one.signature for one in beyond])
    beyond = [one for one in beyond if one.drop >= least]
    if not beyond:
        return {}
    same = {one.without for one in beyond}
    plain = {one.id: one for one in (*always, *(one for one in every if one.id in same))}
    left = costs([*plain.values(), *beyond])
    without = min((left[name] for name in plain), default=nominal.cost)
    most = without - _relevant(max(without - residual.size, 0.0))
    kept = (one for one in beyond if min(left[one.id], nominal.cost - one.drop) < most)
    return {one.without: one.law for one in kept}


def _laws_at(
    subject: Subject, setups: Sequence[Setup], place: Place, *, basis: FloatArray, residual: FloatArray
) -> Iterator[LawThere]:
    """Yield the flows without states that laws cause at a place, each also beyond the best of some thresholds."""
    port = place.port
    having = [setup for setup in setups if port.name in setup.ports]
    times, columns = _columns(having, port)
    if not columns:
        return

    def explained(flows: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return signatures of unit length, and how far the residual follows the flows."""
        moved = _moved(subject, having, _flow(port), np.split(np.array(flows), _ends_of(times), axis=1))
        responses = _responses(moved, basis, residual)
        return responses.signatures(slice(None)), responses.amounts

    of, unit = ("abs(rate)", f"{port.units[0]}/s") if port.domain in MECHANICAL else ("p", port.units[0])
    for name, law in _flow_laws(place):
        text, starts = law.of(port.domain), _started(law, place)
        if not names_in(text) <= {*columns, *starts}:
            continue
        sizes = _sizes(law)
        signatures, amounts = explained([_flows(text, columns, starts | size) for size in sizes])
        shown = orthonormal(signatures.T).T @ residual
        drop = float(shown @ shown) if law.two_sided or amounts.max() > 0.0 else 0.0
        yield LawThere(name, law, place, drop, signatures[0])
        if len(sizes) > 1 or not names_in(of) <= columns.keys():
            continue
        x = _flows(of, columns, {})
        reach = low, high = float(x.min()), float(x.max())
        if high <= low:
            continue
        thresholds = [low + share * (high - low) for share in _THRESHOLDS]
        gated = [law.beyond(port.domain, of, reach, threshold=at, unit=unit) for at in thresholds]
        flows = [_flows(one.of(port.domain), columns, _started(one, place) | sizes[0]) for one in gated]
        signatures, amounts = explained(flows)
        drops = np.where((amounts > 0.0) | law.two_sided, amounts**2, 0.0)
        k = int(np.argmax(drops))
        idle = _idle(law, place, text, columns, x >= thresholds[k])
        best = law.beyond(port.domain, of, reach, threshold=thresholds[k], unit=unit, fixed=idle)
        yield LawThere(f"{name}_beyond", best, place, float(drops[k]), signatures[k], beyond=name)


def _flow_laws(place: Place) -> Iterator[tuple[str, Law]]:
    """Yield the laws at a place that are flows and have no states."""
    yield from ((name, law) for name, law in fitting(place) if law.acts == "flow" and not law.states)


def _idle(
    law: Law, place: Place, text: str, columns: Mapping[str, FloatArray], there: NDArray[np.bool_]
) -> list[str]:
    """Return the shapes that hardly change the flow of a law `there`: how soon dry friction changes its sign."""
    starts = _started(law, place) | _sizes(law)[0]
    flow = _flows(text, columns, starts)[there]

    def changed(key: str, p: LawParameter) -> float:
        ends = (parse(end)(place.sizes) for end in (p.least, p.most))
        return max(float(np.abs(_flows(text, columns, {**starts, key: end})[there] - flow).max()) for end in ends)

    least = _MOVES * float(np.abs(flow).max()) if len(flow) else 0.0
    return [key for key, p in law.parameters.items() if p.off is None and len(flow) and changed(key, p) <= least]


def _columns(having: Sequence[Setup], port: Port) -> tuple[list[FloatArray], dict[str, FloatArray]]:
    """Return the times of all runs, and the quantities at a port in them, joined; none if a run lacks them."""
    every = [one for setup in having for one in setup.seen[port.name]]
    seen = [one for one in every if one is not None]
    if not seen or len(seen) < len(every):
        return [], {}
    columns = {
        "time": [one.time for one in seen],
        "rate": [one.rate for one in seen],
        "acceleration": [np.gradient(one.rate, one.time) for one in seen],
        "p": [one.p for one in seen if one.p is not None],
    }
    return columns["time"], {n: np.concatenate(parts) for n, parts in columns.items() if len(parts) == len(seen)}


def _sizes(law: Law) -> list[dict[str, float]]:
    """Return each size of a law alone, at 1."""
    sizes = [key for key, p in law.parameters.items() if p.off is not None]
    return [{key: float(key == one) for key in sizes} for one in sizes]


def _started(law: Law, place: Place) -> dict[str, float]:
    """Return the sizes of a place, and a law's parameters where they start."""
    starts = {key: parse(p.start or p.off or "0")(place.sizes) for key, p in law.parameters.items()}
    return {**place.sizes, **starts}


def _flows(text: str, columns: Mapping[str, FloatArray], values: Mapping[str, float]) -> FloatArray:
    """Return an expression over all samples."""
    known = {**columns, **{name: np.full(1, value) for name, value in values.items()}}
    course: FloatArray = _evaluated(text, known, (1, len(columns["time"])))[0]
    return course


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """A coefficient over what it depends on.

    Attributes
    ----------
    name, unit
        The coefficient.
    over, over_unit
        What it depends on.
    x, y
        (N,) values over the range that the runs reach.
    slope
        Relative change per unit of `x` of a dependence that is nearly a line, else None.
    """

    name: str
    unit: str
    over: str
    over_unit: str
    x: FloatArray
    y: FloatArray
    slope: float | None

    def __str__(self) -> str:
        """Return it in words and numbers."""
        ends = self.y[0], self.y[-1]
        beyond = np.maximum(self.y - max(ends), min(ends) - self.y)
        turn = int(np.argmax(beyond)) if beyond.max() > _STRAIGHT * np.ptp(self.y) else len(self.y) - 1
        over = {TIME: "over time", _OF_RUN: "in the course of a run"}.get(self.over, f"with {self.over}")
        unit = "" if self.over_unit == "1" else f" {self.over_unit}"
        of_unit = "" if self.unit == "1" else f" {self.unit}"
        rate = "" if self.slope is None else f" by {100.0 * abs(self.slope):.3g} % per{unit or ' unit'}"
        there = self.y[turn]
        text = (
            f"{self.name} {_moves(ends[0], there)} {over}{rate}, from {ends[0]:.3g} to {there:.3g}{of_unit} "
            f"between {self.x[0]:.3g} and {self.x[turn]:.3g}{unit}"
        )
        if turn == len(self.y) - 1:
            return text
        return f"{text}, then {_moves(there, ends[1])} to {ends[1]:.3g}{of_unit} at {self.x[-1]:.3g}{unit}"


def _moves(before: float, after: float) -> str:
    return "grows" if after > before else "falls"


def source_of(
    subject: Subject, effect: Effect, values: Mapping[str, float]
) -> tuple[str, str, tuple[FloatArray, ...]]:
    """Return the variable of a coefficient that varies, in Modelica, its unit and its (N,) values in every run."""
    cases = subject.model.cases
    (source,) = parse_modelica(effect.expression).names - {"p", *(u.name for u in effect.unknowns)}
    if source == TIME:
        return source, "s", tuple(case.time for case in cases)
    if source.startswith(LOGGED):
        logs = (np.asarray(case.task.inputs[source])[case.lead :] for case in cases)
        return source, effect.inputs[source], tuple(logs)
    units = (v.unit for case in cases if (v := case.simulator.variables.get(source)))
    return source, next(units, None) or "1", tuple(row[0] for row in subject.model.trajectories(values, [source]))


def course_of(
    subject: Subject, effect: Effect, values: Mapping[str, float], tables: Sequence[Refinement] = ()
) -> Course | None:
    """Return a coefficient that varies at fitted values over what it depends on; None for other effects.

    Those of the `tables` that refine its law change it further.
    """
    if effect.acts != "parameter" or not effect.expression:
        return None
    formula = parse_modelica(effect.expression)
    sizes = {u.name: values.get(u.name, u.start) for u in effect.unknowns}
    every = {**subject.model.fixed, **values}
    source, unit, reached = source_of(subject, effect, every)
    parameter = effect.port.partition(":")[0]
    case = next(c for c in subject.model.cases if parameter in c.simulator.variables)
    p = subject.model.start_values(case, every).get(parameter, case.simulator.variables[parameter].start)
    x = np.linspace(min(float(r.min()) for r in reached), max(float(r.max()) for r in reached), 200)
    columns = {n: np.full(len(x), v) for n, v in {"p": p or 0.0, **sizes}.items()} | {source: x}
    y = formula.of_samples({n: columns[n] for n in formula.names})
    for table in (t for t in tables if t.effect == effect.id):
        y = y * (1.0 + np.interp(x, table.knots[0], table.values))
    chord = y[0] + (y[-1] - y[0]) * (x - x[0]) / (x[-1] - x[0])
    straight = float(np.abs(y - chord).max()) <= _STRAIGHT * abs(float(y[-1] - y[0]))
    declared = case.simulator.variables[parameter].unit or "1"
    slope = float((y[-1] - y[0]) / (x[-1] - x[0]) / p) if straight and p else None
    return Course(effect.port, declared, effect.over or source, unit, x, y, slope)
