"""Places of a model where a law may act, with the quantities there and their time series."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass

import numpy as np

from fmu_build.domains import MECHANICAL
from fmu_build.flat_model import FlatModel
from fmu_build.model_ports import Port, find_ports
from fmuid.core.campaign import ModelSpec
from fmuid.core.errors import ProblemError
from fmuid.core.immutable import FloatArray
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.variants import model_exchange, observed_states, state_places
from fmuid.discovery.terms import HIDDEN, SHAPES, Kind, Quantity, Term, library, names_in
from fmuid.effects.flat_expressions import courses_at, largest_flow, names_at
from fmuid.identification.problem.cases import RUN_TIME
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.model_source import flat_model

TIME = "time"
_OTHERS = 6  # variables away from a place that its laws may use
_MOVES = 1e-6  # relative to its size: a quantity that moves less counts as constant
_SAME = 1e-4  # time series whose correlation is within this of 1 are the same
_POSITION: Mapping[str, Kind] = {"rotational": "angle", "translational": "position"}


@dataclass(frozen=True, slots=True, eq=False)
class Spot:
    """A port, with the quantities available there.

    Attributes
    ----------
    flow
        The largest flow there.
    courses
        (N,) samples by the name that a law or table uses, one mapping per experiment.
    time
        (N,) times of these samples.
    terms
        Terms that a law there may contain.
    quantities
        What a table there may be over: quantities at the place, inputs, measured outputs and potentials elsewhere.
    nearby
        Names of the quantities at the place and of the inputs.
    """

    port: Port
    flow: float
    courses: tuple[Mapping[str, FloatArray], ...]
    time: tuple[FloatArray, ...]
    terms: tuple[Term, ...]
    quantities: tuple[Quantity, ...] = ()
    nearby: tuple[str, ...] = ()


def inside_of(model: ModelSpec) -> FlatModel | Fmu | None:
    """Return a model's source, or its FMU for model exchange; None if it has neither."""
    return model_exchange(model) if model.source is None else flat_model(model.source)


def names_of_places(inside: FlatModel | Fmu) -> set[str]:
    """Return the names of the places of a model, at ports or at states."""
    if isinstance(inside, Fmu):
        return {f"der({state})" for state in inside.states}
    return {port.name for port in find_ports(inside)}


def spot(name: str, inside: FlatModel | Fmu, model: CampaignModel, values: Mapping[str, float]) -> Spot | None:
    """Return a place with its quantities along the trajectories at `values`; None if nothing moves or flows.

    `inside` is the model's source, or its FMU for model exchange, whose places are at states.
    """
    if isinstance(inside, Fmu):
        return _at_state(name, inside, model, values)
    return _at_port(name, inside, model, values)


def _at_port(name: str, flat: FlatModel, model: CampaignModel, values: Mapping[str, float]) -> Spot | None:
    ports = {port.name: port for port in find_ports(flat)}
    port = ports.get(name)
    if port is None or port.kind not in ("node", "branch"):
        return None
    load = _load_probe(port, list(ports.values())) if port.domain in MECHANICAL else ()
    elsewhere = [c.variable for case in model.cases for c in case.channels]
    elsewhere += [n for p in ports.values() for n in _potentials(p)]
    wanted = [n for group in (*port.probes.values(), load, names_at(port), elsewhere) for n in group]
    known = set.intersection(*(set(case.simulator.variables) for case in model.cases))
    wanted = [n for n in dict.fromkeys(wanted) if n in known]
    rows = model.trajectories(values, wanted)
    courses, around, flows = [], [], []
    for case, row in zip(model.cases, rows, strict=True):
        course = dict(zip(wanted, row, strict=True))
        driven = {n: np.asarray(u)[case.lead :] for n, u in case.task.inputs.items()}
        courses.append(_local(port, load, course, case.time) | driven)
        columns = {n: u for n, (_, u) in case.columns.items()}
        others = {n: course[n] for n in elsewhere if n in known - courses[-1].keys()}
        around.append({TIME: case.time} | columns | courses[-1] | others)
        flows += [float(np.abs(course[n]).max()) for n in port.probes.get("flow", ()) if n in course]
        flows.append(largest_flow(port, course, case.time))
    everywhere = set.intersection(*map(set, courses))  # setups may differ in their inputs
    courses = [{n: c for n, c in course.items() if n in everywhere} for course in courses]
    if everywhere.isdisjoint({"p", "rate"}) or max(flows, default=0.0) == 0.0:
        return None
    free_inputs = [n for n in model.cases[0].task.inputs if n.isidentifier() and n not in port.quantities]
    units = {n: v.unit or "1" for n, v in model.cases[0].simulator.variables.items()}
    of_port = _quantities(port, courses)
    inputs = [q for n in free_inputs if (q := _quantity(n, n, units.get(n, "1"), courses)) is not None]
    potential, flow = port.units
    units |= {"p": potential, "rate": f"{potential}/s", "load": flow, "through": flow}
    near = {n for p in _neighbours(port, [*ports.values()]) for n in _potentials(p)}
    near |= {c.variable for case in model.cases for c in case.channels}
    bare = Spot(port, max(flows), tuple(around), (), ())
    return _with_terms(bare, model, (of_port, inputs), near, units)


def _with_terms(
    spot: Spot,
    model: CampaignModel,
    here: tuple[Sequence[Quantity], Sequence[Quantity]],
    near: Set[str],
    units: Mapping[str, str],
) -> Spot:
    """Return a place with times, and what a law or table there may contain.

    `here` are quantities at the place, and inputs; `near` are variables elsewhere that a law there may use.
    """
    time, columns = tuple(case.time for case in model.cases), model.cases[0].columns
    names = tuple(q.name for part in here for q in part)
    shared = [n for n in dict.fromkeys((*names, *spot.courses[0])) if all(n in one for one in spot.courses)]
    around = [{n: one[n] for n in shared} for one in spot.courses]
    units = {**units, **{n: unit for n, (unit, _) in columns.items()}, TIME: "s"}
    every = [q for n in shared if (q := _quantity(n, n, units.get(n, "1"), around)) is not None]
    quantities = _apart([q for q in every if q.name not in (TIME, RUN_TIME)], around)
    elsewhere = {*near, TIME, *columns}.difference(names)
    away = [_from_start(q, around) for q in _apart(every, around) if q.name in elsewhere]
    terms = _distinct(library(*here, time, away[:_OTHERS]), around, time)
    return Spot(spot.port, spot.flow, tuple(around), time, tuple(terms), tuple(quantities), names)


def _potentials(port: Port) -> list[str]:
    """Return the variables of a port's potential, and of the speed there.

    Rates of other potentials are no states: a flow that depended on one would change it at once (algebraic loop).
    """
    kinds = ("p", "rate") if port.domain in MECHANICAL else ("p",)
    return [n for kind in kinds for n in port.probes.get(kind, ())]


def _neighbours(port: Port, ports: Sequence[Port]) -> list[Port]:
    """Return the ports at components that are connected to a port; all of them where its equations are written."""

    def components(one: Port) -> set[str]:
        return {connector.rpartition(".")[0] for connector in one.connectors}

    parts = components(port)
    return [p for p in ports if not parts or not parts.isdisjoint(components(p))]


def _from_start(x: Quantity, courses: Sequence[Mapping[str, FloatArray]]) -> Quantity:
    """Return a quantity that stays far from zero above its first value."""
    far = min(abs(x.low), abs(x.high)) >= x.high - x.low and not x.signed
    return _above_start(x, courses) if far else x


def _above_start(x: Quantity, courses: Sequence[Mapping[str, FloatArray]]) -> Quantity:
    first = float(courses[0][x.name][0])
    text = f"({x.name} - {first:.6g})" if first >= 0.0 else f"({x.name} + {-first:.6g})"
    return _quantity(text, x.name, x.unit, courses, x.kind, above=first) or x


def _at_state(name: str, fmu: Fmu, model: CampaignModel, values: Mapping[str, float]) -> Spot | None:
    """Return a place at a state: laws there use the states, inputs, columns and time."""
    known = set.intersection(*(set(case.simulator.variables) for case in model.cases))
    wanted = [n for n in observed_states(fmu) if n in known]
    times = [case.time for case in model.cases]
    courses = [dict(zip(wanted, row, strict=True)) for row in model.trajectories(values, wanted)]
    place = next((p for p in state_places(fmu, times, courses)[0] if p.port.name == name), None)
    if place is None:
        return None
    driven = [{n: np.asarray(u)[case.lead :] for n, u in case.task.inputs.items()} for case in model.cases]
    columns = [{n: u for n, (_, u) in case.columns.items()} for case in model.cases]
    around = tuple(
        {TIME: t}
        | {n: one[n] for n in fmu.states if _is_name(n)}
        | {n: u for n, u in row.items() if _is_name(n)}
        | logged
        for t, one, row, logged in zip(times, courses, driven, columns, strict=True)
    )
    units = {n: v.unit or "1" for n, v in model.cases[0].simulator.variables.items()}
    port, flow = place.port, place.sizes["P" if place.port.kind == "loop" else "F"]
    kinds: dict[str, Kind] = {"rate": "speed", "p": _POSITION.get(port.domain, "value")}
    of_place = [
        _above_start(q, around) if port.domain == "thermal" else q
        for what, n in place.names.items()
        if (q := _quantity(n, n, units.get(n, "1"), around, kinds.get(what, "value"))) is not None
    ]
    inputs = [q for n in driven[0] if (q := _quantity(n, n, units.get(n, "1"), around)) is not None]
    return _with_terms(Spot(port, flow, around, (), ()), model, (of_place, inputs), {*fmu.states}, units)


def _is_name(variable: str) -> bool:
    """Return whether a law can use a variable by its name, which may be quoted or that of a law's parameter."""
    try:
        return names_in(variable) == {variable} and variable not in {*SHAPES, HIDDEN, TIME}
    except ProblemError:
        return False


def _load_probe(port: Port, ports: Sequence[Port]) -> tuple[str, ...]:
    """Return the variable of the flow through the compliant neighbour of a node, if it has one."""
    load = port.quantities.get("load")
    near = [b for b in ports if b.kind == "branch" and b.quantities.get("through") == load]
    return near[0].probes["flow"][:1] if load is not None and near else ()


def _local(
    port: Port, load: Sequence[str], course: Mapping[str, FloatArray], time: FloatArray
) -> dict[str, FloatArray]:
    """Return time series by the names that laws at a port use."""
    if port.shares:
        return courses_at(port, course, time)

    def across(names: Sequence[str]) -> FloatArray | None:
        potentials = [course[n] for n in names if n in course]
        if not names or len(potentials) != len(names):
            return None
        return potentials[1] - potentials[0] if port.kind == "branch" else potentials[0]

    p = across(port.probes["p"])
    if p is None:
        return {}
    quantities = {"p": p}
    if "rate" in port.quantities and port.domain in MECHANICAL:
        rate = across(port.probes.get("rate", ()))
        quantities["rate"] = np.gradient(p, time) if rate is None else rate
    if port.kind == "branch" and (flow := course.get(port.probes["flow"][0])) is not None:
        quantities["through"] = flow
    if load and load[0] in course:
        quantities["load"] = course[load[0]]
    return quantities


def _quantities(port: Port, courses: Sequence[Mapping[str, FloatArray]]) -> list[Quantity]:
    potential, flow = port.units
    start, p = float(courses[0].get("p", [0.0])[0]), "p"
    if port.domain == "thermal" and port.kind == "node" and start != 0.0:
        p = f"(p - {start:.6g})"  # above its start value
    position = _POSITION.get(port.domain, "value") if port.kind == "node" else "value"
    quantities = [
        _quantity(p, "p", potential, courses, position, above=start if p != "p" else 0.0),
        _quantity("rate", "rate", f"{potential}/s", courses, "speed"),
        _quantity("load", "load", flow, courses, "flow"),
    ]
    return [q for q in quantities if q is not None]


def _quantity(
    text: str,
    name: str,
    unit: str,
    courses: Sequence[Mapping[str, FloatArray]],
    kind: Kind = "value",
    *,
    above: float = 0.0,
) -> Quantity | None:
    if not all(name in c for c in courses):
        return None
    low = min(float(c[name].min()) for c in courses) - above
    high = max(float(c[name].max()) for c in courses) - above
    size = max(abs(low), abs(high))
    if high - low <= _MOVES * size:
        return None
    digits = 10.0 ** (np.floor(np.log10(size)) - 1)
    return Quantity(text, name, unit, float(f"{np.ceil(size / digits) * digits:.2g}"), low, high, kind)


def _distinct(
    terms: Sequence[Term], courses: Sequence[Mapping[str, FloatArray]], time: Sequence[FloatArray]
) -> list[Term]:
    """Leave out terms that, along these time series, do the same as a simpler one."""
    kept: list[Term] = []
    known = np.empty((len(terms), sum(map(len, time))))
    for term in sorted(terms, key=lambda t: t.rank):
        course = term.whole_course(courses, time)
        length = float(np.linalg.norm(course))
        if not np.isfinite(length) or length < 1e-6 * np.sqrt(len(course)):
            continue
        course /= length
        if kept and float(np.abs(known[: len(kept)] @ course).max()) > 1.0 - _SAME:
            continue
        known[len(kept)] = course
        kept.append(term)
    return kept


def _apart(quantities: Sequence[Quantity], courses: Sequence[Mapping[str, FloatArray]]) -> list[Quantity]:
    """Return the quantities that are not, up to a factor and a shift, another one before them."""
    distinct: list[tuple[Quantity, FloatArray]] = []
    for quantity in quantities:
        course = np.concatenate([c[quantity.name] for c in courses])
        course = course - course.mean()
        course /= np.linalg.norm(course)
        if all(abs(float(course @ other)) < 1.0 - _SAME for _, other in distinct):
            distinct.append((quantity, course))
    return [quantity for quantity, _ in distinct]
