"""From Modelica source to a `CompiledModel`."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import accumulate
from pathlib import Path
from types import MappingProxyType
from typing import Literal as Choice

from fmu_build import algebra, algorithms, codegen, events, messages, start, unit_check
from fmu_build.equations import Assertion, Equations, collect, definable
from fmu_build.flat_model import FlatModel
from fmu_build.front.flatten import load
from fmu_build.graph import SX, Graph, Substitution, key
from fmu_build.interface import describe
from fmu_build.invariants import state_derivatives
from fmu_build.loops import SwitchedLoopError
from fmu_build.model import CompiledModel
from fmu_build.scope import ModelScope, without_value
from fmu_build.syntax import Assign, Call, Literal, Part, Reference, WhenStatement, references
from fmu_build.system import System, solved
from fmu_build.transports import transports_of
from fmu_build.variables import Declared


def compile_modelica(file: Path, class_name: str, roots: Sequence[Path] = ()) -> CompiledModel:
    """Translate a Modelica class: flatten, reduce the index, sort, solve, differentiate, generate C.

    Parameters
    ----------
    file
        Source file with the class, or any file of its package.
    class_name
        Qualified class name, as ``Drives.Setups.FixedShaft``.
    roots
        Directories of further libraries.

    Raises
    ------
    ModelicaError
        The source is wrong or outside the supported subset; the message names file and line.
    """
    return compile_flat(load(Path(file), class_name, roots))


_Reduced = tuple[System, Equations, events.Events, start.InitialConditions, list[SX]]
"""Sorted equations, all equations, events, initial conditions, and symbols of the states' start values."""


def compile_flat(flat: FlatModel) -> CompiledModel:
    """Translate a flattened class (see `compile_modelica`)."""
    return _generate(*_reduced(flat))


def check_flat(flat: FlatModel) -> tuple[str, ...]:
    """Return the names of a class's states, or raise the errors that `compile_flat` finds in its equations."""
    return tuple(state.symbol.name() for state in _reduced(flat)[0].reduced.states)


def _reduced(flat: FlatModel) -> _Reduced:
    structural: set[str] = set()
    promoted: set[str] = set()
    open_: set[str] = set()
    events_in_smooth: Choice["", "some", "all"] = ""
    while True:
        scope = ModelScope(flat, Graph(), structural, open_)
        scope.evaluate.events_in_smooth = events_in_smooth
        scope.functions.by_parameters = partial(_deciding, scope, structural)
        try:
            return _translate(flat, scope)
        except SwitchedLoopError:
            events_in_smooth = "all" if events_in_smooth else "some"
        except _Unsolved as error:
            # Parameters that the initial equations determine together with the states become constant states.
            if not error.names - promoted:
                raise
            promoted |= error.names
            open_ |= error.names if error.open else set()
            for name in sorted(error.names):
                flat = _with_followers(_as_state(flat, name), name)
        except algebra.UnknownSizeError as error:
            # Parameters that turn out to determine a size become constants of the translation.
            names = _deciding(scope, structural, error.value)
            if not names:
                raise flat.error(str(error), error.span) from None
            structural |= names


def _deciding(scope: ModelScope, constants: set[str], value: SX) -> set[str]:
    """Return the parameters, other than `constants`, that determine a value; none if others also determine it."""
    declared = [scope.declarations.by_symbol.get(k) for k in scope.graph.symbols(value)]
    parameters = [d.variable.name for d in declared if d is not None and d.kind == "parameter"]
    return set(parameters) - constants if len(parameters) == len(declared) else set()


def _translate(flat: FlatModel, scope: ModelScope) -> _Reduced:
    equations = collect(scope)
    for section in flat.algorithms:
        equations.add(scope, algorithms.run(scope, section, initial=False))
    for section in flat.initial_algorithms:
        equations.initial += algorithms.run(scope, section, initial=True)
    _check_discrete(scope, equations)
    equations.asserts += [Assertion(*parts) for parts in scope.functions.asserts]
    explicit = _initial_parameters(scope, equations)
    system = solved(scope, equations)
    _check_left_limits(system)
    happenings = events.collect(system, equations, explicit)
    xs = [SX.sym(f"start({s.symbol.name()})") for s in system.reduced.states]
    conditions = start.initial_conditions(system, [*equations.initial, *system.reduced.invariants], xs)
    return system, equations, happenings, conditions, xs


def _check_discrete(scope: ModelScope, equations: Equations) -> None:
    """Refuse equations that give a variable which changes at events only a value that changes between them."""
    for equation in equations.discrete:
        targets = definable(scope, equation)
        values = [side for side in equation.sides or () if not any(key(side) == key(t) for t in targets)]
        declared = scope.declared(targets[0]) if targets else None
        if declared is None or not any(map(scope.changes_between_events, values)):
            continue
        if not {declared.name, declared.variable.name} & scope.in_whens:
            raise scope.flat.error(
                f"'{declared.name}' changes at events only, but its value changes between them", equation.at,
                "assign it in a when-equation",
            )  # fmt: skip


class _Unsolved(Exception):  # noqa: N818  (not an error)
    """Parameters with fixed = false that no initial equation determines from parameters alone.

    They are `open` if no initial equation has them at all, but a fixed start may.
    """

    def __init__(self, names: set[str], *, open: bool = False) -> None:
        super().__init__(names)
        self.names = names
        self.open = open


def _as_state(flat: FlatModel, name: str) -> FlatModel:
    """Return the model with a parameter as a variable that does not change.

    If time and parameters determine it, or if it is no Real, it is a discrete variable, which keeps its value from
    the start.
    """
    for equation in flat.initial_equations:
        given = (
            isinstance(equation.left, Reference) and equation.left.name == name and not equation.left.subscripts
        )
        discrete = flat.variables[name].type != "Real"
        if given and (discrete or all(_is_known(flat, r) for r in references(equation.right))):
            assert isinstance(equation.left, Reference)
            variable = replace(flat.variables[name], variability="discrete", fixed=None, binding=None)
            start = WhenStatement(
                equation.at,
                ((Call(equation.at, "initial", ()), (Assign(equation.at, equation.left, equation.right),)),),
            )
            return replace(
                flat,
                variables=MappingProxyType({**flat.variables, name: variable}),
                initial_equations=tuple(e for e in flat.initial_equations if e is not equation),
                whens=(*flat.whens, start),
            )
    if flat.variables[name].type != "Real":
        raise without_value(flat, name, flat.variables[name].at)
    variable = replace(flat.variables[name], variability="continuous", fixed=None, binding=None)
    changed = replace(flat, variables=MappingProxyType({**flat.variables, name: variable}))
    rate = Call(variable.at, "der", (Reference(variable.at, (Part(name),)),))
    return changed.with_equation(rate, Literal(variable.at, 0.0))


def _with_followers(flat: FlatModel, name: str) -> FlatModel:
    """Return the model in which the parameters that a variable determines are variables of its kind."""
    variables, variability = dict(flat.variables), flat.variables[name].variability
    waiting = [name]
    while waiting:
        decided = waiting.pop()
        for follower, variable in variables.items():
            if variable.variability == "parameter" and any(
                r.name == decided for r in references(variable.binding)
            ):
                variables[follower] = replace(variable, variability=variability, fixed=None)
                waiting.append(follower)
    return replace(flat, variables=MappingProxyType(variables))


def _is_known(flat: FlatModel, reference: Reference) -> bool:
    variable = flat.variables.get(reference.name)
    return reference.name == "time" or (variable is not None and variable.variability in ("constant", "parameter"))


def _initial_parameters(scope: ModelScope, equations: Equations) -> start.Explicit:
    """Apply and remove the initial equations of parameters with fixed=false and of discrete variables."""
    explicit = start.split_initial(scope, equations.initial)
    equations.initial = explicit.rest
    open_ = [d for d in scope.parameters.from_initial if key(algebra.sx(d.symbol)) not in explicit.parameters]
    used = {k for e in equations.initial for k in scope.graph.symbols(e.residual)}
    wanted = {d.variable.name for d in open_ if key(algebra.sx(d.symbol)) in used}
    if wanted:
        raise _Unsolved(wanted)
    if reals := {d.variable.name for d in open_ if d.type == "Real"}:
        raise _Unsolved(reals, open=True)
    for declared in open_:
        raise without_value(scope.flat, declared.name, declared.at)
    for declared in scope.parameters.from_initial:
        value = explicit.parameters[key(algebra.sx(declared.symbol))]
        scope.parameters.dependent.append((declared, value))
    if scope.parameters.from_initial:
        scope.parameters.dependent[:] = _in_order(scope)
    return explicit


def _in_order(scope: ModelScope) -> list[tuple[Declared, SX]]:
    """Return the dependent parameters, each after those on which it depends."""
    pairs = {key(algebra.sx(declared.symbol)): (declared, value) for declared, value in scope.parameters.dependent}
    place = {k: number for number, k in enumerate(pairs)}
    done: dict[int, tuple[Declared, SX]] = {}
    path: set[int] = set()

    def visit(k: int) -> None:
        if k in done:
            return
        declared, value = pairs[k]
        if k in path:
            raise scope.flat.error(f"parameter '{declared.name}' depends on itself", declared.at)
        path.add(k)
        for symbol in sorted(scope.graph.symbols(value) & pairs.keys(), key=place.__getitem__):
            visit(symbol)
        done[k] = pairs[k]

    for k in pairs:
        visit(k)
    return list(done.values())


def _check_left_limits(system: System) -> None:
    for variable in system.scope.left_limits.values():
        symbol, _ = system.representative(variable)
        declared = system.scope.declared(variable)
        if not system.is_state(symbol) and not (declared is not None and declared.kind == "input"):
            raise system.scope.flat.error(
                f"pre({variable.name()}) of a continuous variable that is not a state",
                declared.at if declared else None,
            )


def _unheeded_choices(system: System) -> Iterator[str]:
    """Yield a warning for each variable that is a state, or is not, against its ``stateSelect``."""
    for declared in system.scope.declarations.scalars.values():
        wanted = declared.variable.state_select
        if declared.kind == "continuous" and wanted in ("always", "never"):
            symbol, _ = system.representative(algebra.sx(declared.symbol))
            if system.is_state(symbol) != (wanted == "always"):
                what = "is a state" if wanted == "never" else "cannot be a state"
                yield f"{declared.at}: '{declared.name}' {what}, although its stateSelect is {wanted}"


def _generate(
    system: System,
    equations: Equations,
    happenings: events.Events,
    conditions: start.InitialConditions,
    xs: list[SX],
) -> CompiledModel:
    scope, flat = system.scope, system.scope.flat
    transports = transports_of(system)
    interface = describe(system, happenings, conditions, transports.symbols)
    ports = codegen.Ports(
        scope.time,
        [s.symbol for s in system.reduced.states],
        interface.inputs,
        [algebra.sx(d.symbol) for d, _ in scope.parameters.independent],
        [algebra.sx(d.symbol) for d, _ in scope.parameters.dependent],
        [d.symbol for d in happenings.discrete],
        [d.previous for d in happenings.discrete],
        [r.symbol for r in scope.relations],
        system.solution.iterates,
    )
    never = {key(scope.init): SX(0.0)}

    def local(expressions: Sequence[SX]) -> list[SX]:
        return [transports.at_outlets(e) for e in expressions] if scope.transports else list(expressions)

    def continuous(expressions: Sequence[SX]) -> list[SX]:
        return local(codegen.as_ports(never, expressions))

    of_independent = Substitution()
    dependent: list[SX] = []
    for symbol, (_, value) in zip(ports.d, scope.parameters.dependent, strict=True):
        dependent.append(of_independent(value))
        of_independent.define(symbol, dependent[-1])
    asserts = [system.rewrite(a.condition) for a in equations.asserts]
    shown = {v.location.index for v in interface.variables if v.causality == "output" and v.location.vector == "v"}
    outputs = [i in shown for i in range(len(interface.evaluated))]
    delays = scope.delays.values()
    remembered = [*(system.rewrite(d.value) for d in delays), *transports.remembered]
    remembered += [*(system.rewrite(d.time) for d in delays), *transports.profile]
    expressions = codegen.Expressions(
        dependent=dependent,
        x_start=[s.value for s in conditions.starts],
        z_start=[d.start for d in happenings.discrete],
        y_start=[s.value for s in interface.iterate_starts],
        xs=xs,
        initial=continuous(conditions.residuals),
        dx=continuous(state_derivatives(system)),
        v=continuous(interface.evaluated),
        residuals=continuous(system.solution.residuals),
        indicators=continuous([system.rewrite(r.difference) for r in scope.relations]),
        init=scope.init,
        z_new=local([d.value for d in happenings.discrete]),
        x_new=local(happenings.states),
        next_event=local([happenings.next_event])[0],
        terminate=local([happenings.terminate])[0],
        reinit=local([happenings.reinit])[0],
        asserts=continuous(asserts),
        shown=continuous([system.rewrite(v) for a in equations.asserts for v in messages.values(a.message)]),
        outputs=outputs,
        delayed=continuous(remembered),
        moved=continuous(transports.moved),
    )
    slopes = codegen.slopes_of(scope.graph, ports, expressions)
    functions = codegen.make_functions(scope.graph, ports, expressions, slopes)
    has_events = bool(
        ports.z or ports.m or scope.time_events or equations.whens or scope.delays or scope.transports
    )
    sizes = {
        "NX": len(ports.x), "NU": len(ports.u), "NP": len(ports.p), "ND": len(ports.d), "NZ": len(ports.z),
        "NM": len(ports.m), "NY": len(ports.y), "NV": len(interface.evaluated), "NASSERT": len(asserts),
        "NDELAY": len(scope.delays), "NTRANSPORT": len(scope.transports),
        "HAS_EVENTS": int(has_events), "HAS_INITIAL": int(not conditions.explicit),
    }  # fmt: skip
    texts = [(f"{a.at}: {messages.text(a.message)}", a.warning) for a in equations.asserts]
    firsts = list(accumulate((len(messages.values(a.message)) for a in equations.asserts), initial=0))
    files = codegen.c_files(
        functions,
        codegen.Header(
            sizes,
            interface.x_nominal,
            interface.y_nominal,
            [r.inclusive for r in scope.relations],
            events.relation_groups(system, happenings),
            texts,
            firsts,
            slopes,
            outputs,
            transports.points,
        ),
    )
    model = CompiledModel(
        name=flat.class_name.rpartition(".")[2],
        class_name=flat.class_name,
        description=flat.description,
        variables=interface.variables,
        units=interface.units,
        experiment=flat.experiment,
        n_x=sizes["NX"], n_u=sizes["NU"], n_p=sizes["NP"], n_d=sizes["ND"], n_z=sizes["NZ"], n_m=sizes["NM"],
        n_delay=sizes["NDELAY"] + sizes["NTRANSPORT"], n_y=sizes["NY"], n_v=sizes["NV"], n_assert=sizes["NASSERT"],
        has_events=has_events,
        has_initial=not conditions.explicit,
        c_source=files.source,
        c_rare=files.rare,
        c_header=files.header,
        content_hash="",
        warnings=tuple(dict.fromkeys(
            (*flat.warnings, *scope.parameters.warnings, *_unheeded_choices(system), *unit_check.check(flat))
        )),
        functions=functions,
    )  # fmt: skip
    what = repr(replace(model, c_source="", c_rare="", c_header="")) + "".join(
        (model.c_source, model.c_rare, model.c_header)
    )
    return replace(model, content_hash=hashlib.sha256(what.encode()).hexdigest())
