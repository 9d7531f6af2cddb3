"""CasADi functions of a reduced model, and their C code."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

from fmu_build.c_code import c_code, lengths, wrapped
from fmu_build.elimination import plan
from fmu_build.graph import SX, Gradient, Graph, Substitution, is_number, key
from fmu_build.straight import GROWTH, is_short, straight_code
from fmu_build.switches import switching_functions

Functions = dict[str, ca.Function]
PARAMETERS = 3  # position of p among the arguments that most functions share
Slope = tuple[int, int, SX]
"""Row, column and expression of an entry of a sparse matrix."""


@dataclass(frozen=True)
class Ports:
    """Symbols of the vectors, in the order of the interface (see `fmu_build.model`)."""

    t: SX
    x: list[SX]
    u: list[SX]
    p: list[SX]
    d: list[SX]
    z: list[SX]
    pz: list[SX]
    m: list[SX]
    y: list[SX]

    def environment(self) -> list[SX]:
        """Arguments that most functions share."""
        vectors = [self.x, self.u, self.p, self.d, self.z, self.pz, self.m, self.y]
        return [self.t, *map(column, vectors)]


@dataclass(frozen=True)
class Expressions:
    """Everything the generated functions compute, as scalar expressions of the ports."""

    dependent: list[SX]
    x_start: list[SX]
    z_start: list[SX]
    y_start: list[SX]
    xs: list[SX]
    initial: list[SX]
    dx: list[SX]
    v: list[SX]
    residuals: list[SX]
    indicators: list[SX]
    init: SX
    z_new: list[SX]
    x_new: list[SX]
    next_event: SX
    terminate: SX
    reinit: SX
    asserts: list[SX]
    shown: list[SX]
    """Values in the messages of the assertions."""
    outputs: Sequence[bool]
    """Which of v are outputs of the model."""
    delayed: list[SX]
    """What ``delay()`` and ``spatialDistribution()`` remember, then for how long, and initial contents."""
    moved: list[SX]
    """How far the contents of each ``spatialDistribution()`` have moved."""


def column(items: Sequence[SX]) -> SX:
    """Scalars as a column vector."""
    return ca.vertcat(*items) if items else SX(0, 1)


def _values(slopes: Sequence[Slope]) -> SX:
    return column([slope for *_, slope in slopes])


def sparse(rows: Sequence[Gradient], symbols: Sequence[SX], diagonal: int = 0) -> SX:
    """Jacobian with the given gradients as rows: entries that may be nonzero, and the first `diagonal` ones."""
    place = {key(symbol): j for j, symbol in enumerate(symbols)}
    entries = {(place[k], i): slope for i, row in enumerate(rows) for k, slope in row.items() if k in place}
    for i in range(diagonal):
        entries.setdefault((i, i), SX(0.0))
    order = sorted(entries)
    pattern = ca.Sparsity.triplet(len(rows), len(symbols), [i for _, i in order], [j for j, _ in order])
    return SX(pattern, column([entries[at] for at in order]))


@dataclass(frozen=True)
class Slopes:
    """Nonzero partial derivatives, by where they are needed.

    Attributes
    ----------
    scalars, elements
        Of [dx; r] by [p; d; z = pz]: by scalars, and by elements of tables.
    outputs, constants
        Of v by [x; y; p; d; z = pz]: of outputs, and of other variables whose derivatives are all constant.
    linear
        Which entries of v are such other variables.
    """

    scalars: Sequence[Slope]
    elements: Sequence[Slope]
    outputs: Sequence[Slope]
    constants: Sequence[Slope]
    linear: Sequence[bool]


def slopes_of(graph: Graph, ports: Ports, e: Expressions) -> Slopes:
    """Return the partial derivatives that sensitivities follow from."""
    unknowns, parameters = [*ports.x, *ports.y], [*ports.p, *ports.d]
    elements = {i for i, symbol in enumerate(parameters) if symbol.name().endswith("]")}
    by_parameter = _slopes(graph, ports, [*e.dx, *e.residuals], parameters)
    of_variables = _slopes(graph, ports, e.v, [*unknowns, *parameters])
    linear = [
        not shown and all(map(is_number, graph.gradient(v).values()))
        for v, shown in zip(e.v, e.outputs, strict=True)
    ]
    return Slopes(
        [slope for slope in by_parameter if slope[1] not in elements],
        [slope for slope in by_parameter if slope[1] in elements],
        [slope for slope in of_variables if e.outputs[slope[0]]],
        [slope for slope in of_variables if linear[slope[0]]],
        linear,
    )


def _slopes(graph: Graph, ports: Ports, results: Sequence[SX], symbols: Sequence[SX]) -> list[Slope]:
    """Nonzero partial derivatives by the symbols, followed by z together with its pre-values."""
    places = {key(symbol): j for j, symbol in enumerate(symbols)}
    for j, pair in enumerate(zip(ports.z, ports.pz, strict=True), len(symbols)):
        places |= {key(symbol): j for symbol in pair}
    slopes = []
    for i, row in enumerate(map(graph.gradient, results)):
        by_place: dict[int, list[SX]] = {}
        for j, k in sorted((places[k], k) for k in row if k in places):
            by_place.setdefault(j, []).append(row[k])
        slopes += [(i, j, sum(parts[1:], parts[0])) for j, parts in by_place.items()]
    return slopes


def make_functions(graph: Graph, ports: Ports, e: Expressions, by: Slopes) -> Functions:
    """Build the functions of the interface, with common subexpressions shared."""
    environment = ports.environment()
    out: Functions = {}

    def add(name: str, arguments: list[SX], results: list[SX]) -> None:
        shared = ca.cse(results)
        out[name] = ca.Function(f"model_{name}", arguments, shared)

    slopes = [graph.gradient(r) for r in [*e.dx, *e.residuals]]
    unknowns, n_x = [*ports.x, *ports.y], len(ports.x)
    add("dependent", [column(ports.p)], [column(e.dependent)])
    starts = [column(e.x_start), column(e.z_start), column(e.y_start)]
    add("start", [column(ports.p), column(ports.d)], starts)
    conditions = [*e.initial, *e.residuals]
    add(
        "initial",
        [*environment, column(e.xs)],
        [column(conditions), sparse(list(map(graph.gradient, conditions)), unknowns)],
    )
    add("derivatives", environment, [column(e.dx)])
    by_unknown = sparse(slopes, unknowns, n_x)
    by_time = column([row.get(key(ports.t), SX(0.0)) for row in slopes])
    add("jacobian", environment, [column(e.dx), by_unknown, by_time])
    add("loop", environment, [column(e.residuals), sparse(slopes[n_x:], ports.y), by_time[n_x:]])
    add("slopes", environment, [by_unknown, _values(by.scalars)])
    add("element_slopes", environment, [_values(by.elements)])
    add("output_slopes", environment, [_values(by.outputs)])
    add("variables", environment, [column(e.v)])
    vectors = {"x": ports.x, "u": ports.u, "p": ports.p, "d": ports.d, "y": ports.y, "xs": e.xs}
    vectors |= {"z": ports.z, "pz": ports.pz, "t": [ports.t]}
    discrete = " z pz" if ports.z else ""

    def add_partials(name: str, arguments: list[SX], along: str, results: list[SX]) -> None:
        """Exact derivative of the results along seeds of the named vectors."""
        seeds = {n: SX.sym(f"s_{n}", len(vectors[n])) for n in along.split()}
        by_symbol = {key(s): seeds[n][i] for n in seeds for i, s in enumerate(vectors[n])}
        derivative = column([graph.directional(r, by_symbol) for r in results])
        add(name, [*arguments, *seeds.values()], [derivative])

    add_partials("move_partials", environment, "p d" + discrete, [*e.dx, *e.residuals])
    add_partials("partials", environment, "x u p d y" + discrete, e.dx)
    add_partials("variable_partials", environment, "x u p d y" + discrete, e.v)
    add_partials("loop_partials", environment, "x u p d" + discrete, e.residuals)
    add_partials("dependent_partials", [column(ports.p)], "p", e.dependent)
    add_partials("start_partials", [column(ports.p), column(ports.d)], "p d", [*e.x_start, *e.z_start])
    add_partials("initial_partials", [*environment, column(e.xs)], "u p d xs" + discrete, conditions)
    add_partials("indicator_partials", environment, "x u p d y z pz t", e.indicators)
    updated = [*e.z_new, *e.x_new, e.next_event]
    add_partials("update_partials", [*environment, e.init], "x u p d y z pz t", updated)
    add("indicators", environment, [column(e.indicators)])
    add(
        "update",
        [*environment, e.init],
        [column(e.z_new), column(e.x_new), e.next_event, e.terminate, e.reinit],
    )
    add("asserts", environment, [column(e.asserts)])
    add("messages", environment, [column(e.shown)])
    add("moved", environment, [column(e.moved)])
    add("delayed", environment, [column(e.delayed)])
    add_partials("delayed_partials", environment, "x u p d y z pz t", e.delayed)
    return out


@dataclass(frozen=True)
class Header:
    """Contents of ``model.h`` in addition to the functions.

    Attributes
    ----------
    sizes
        Lengths of the vectors and flags, by the name that follows ``MODEL_``.
    inclusive, groups
        Flag and group of each relation; relations of one group depend on each other.
    asserts
        Text of each assertion, and whether it is only a warning.
    shown
        Where the values in the text of each assertion begin, and their total number.
    slopes
        Places of the entries, and those that are constant.
    outputs
        Which entries of v are outputs.
    points
        Where the initial contents of ``spatialDistribution()`` have bends or jumps.
    """

    sizes: Mapping[str, int]
    x_nominal: Sequence[float]
    y_nominal: Sequence[float]
    inclusive: Sequence[bool]
    groups: Sequence[int]
    asserts: Sequence[tuple[str, bool]]
    shown: Sequence[int]
    slopes: Slopes
    outputs: Sequence[bool]
    points: Sequence[float]


# Functions that a simulation calls only at its start and at events, or for hidden derivatives: the compiler need
# not spend much time on them.
RARE = frozenset(
    {
        "dependent",
        "start",
        "initial",
        "update",
        "asserts",
        "messages",
        "variable_partials",
        "dependent_partials",
    }
    | {"start_partials", "initial_partials", "indicator_partials", "update_partials"}
)
# The same without algebraic loops, whose solutions sensitivities include.
WITHOUT_LOOPS = frozenset({"partials", "loop_partials"})


@dataclass(frozen=True)
class Files:
    """Texts of ``model.c``, ``model_rare.c`` and ``model.h``."""

    source: str
    rare: str
    header: str


def _few(functions: Functions) -> dict[str, int]:
    """Return along how many directions derivatives cost less than those by all scalars, or by all elements."""
    length = {name: function.n_instructions() for name, function in functions.items()}
    by_all = {"SLOPE": length["slopes"] - length["jacobian"], "ELEMENT": length["element_slopes"]}
    return {kind: max(by_all[kind], 0) // max(length["move_partials"], 1) for kind in by_all}


def c_files(functions: Functions, header: Header) -> Files:
    """C text of all functions and tables; the same bytes for the same functions."""
    few = _few(functions)
    if not any(few.values()):  # never called: nothing to compile
        unused = functions["move_partials"]
        functions = {**functions, "move_partials": ca.Function(unused.name(), unused.sx_in(), [SX(0, 1)])}
    functions = {**functions, "switches": switching_functions(functions["derivatives"])}
    seldom = RARE if header.sizes["NY"] else RARE | WITHOUT_LOOPS
    often = c_code({n: f for n, f in functions.items() if n not in seldom}, parameters=PARAMETERS)
    rare = c_code({n: f for n, f in functions.items() if n in seldom})
    lines = ["#ifndef MODEL_H", "#define MODEL_H", ""]
    lines += ["#ifndef casadi_int", "#define casadi_int long long int", "#endif", ""]
    lines += [f"#define MODEL_{name} {value}" for name, value in header.sizes.items()]
    lines += [f"#define MODEL_GROWTH {GROWTH!r}"]
    lines += [f"#define MODEL_SZ_{kind} {n}" for kind, n in lengths([often, rare]).items()]
    matrices = {"J": functions["jacobian"], "R": functions["loop"], "I": functions["initial"]}
    tables = []
    for letter, function in matrices.items():
        macros, definitions = _pattern(letter, function.sparsity_out(1), often=letter != "I")
        lines += macros
        tables += definitions
    by = header.slopes
    lines += [f"#define MODEL_NSWITCH {functions['switches'].numel_out(0)}"]
    lines += [f"#define MODEL_FEW_{kind} {n}" for kind, n in few.items()]
    kinds = {
        "SLOPE": by.scalars,
        "ELEMENT": by.elements,
        "OUTPUT_SLOPE": by.outputs,
        "CONSTANT_SLOPE": by.constants,
    }
    places = {"SLOPE": [*by.scalars, *by.elements], "VARIABLE": [*by.outputs, *by.constants]}
    lines += [
        "",
        f"static const double MODEL_X_NOMINAL[] = {{{_numbers(header.x_nominal)}}};",
        f"static const double MODEL_Y_NOMINAL[] = {{{_numbers(header.y_nominal)}}};",
        f"#define MODEL_NPOINT {len(header.points)}",
        f"static const double MODEL_POINT[] = {{{_numbers(header.points)}}};",
        f"static const int MODEL_INCLUSIVE[] = {{{_integers(header.inclusive)}}};",
        f"static const int MODEL_GROUP[] = {{{_integers(header.groups)}}};",
        f"static const int MODEL_ASSERT_WARNING[] = {{{_integers(w for _, w in header.asserts)}}};",
        "static const char* const MODEL_ASSERT_MESSAGE[] = {"
        + (", ".join(_string(text) for text, _ in header.asserts) or '""')
        + "};",
        f"#define MODEL_NSHOWN {header.shown[-1]}",
        f"static const int MODEL_SHOWN[] = {{{_integers(header.shown)}}};",
        f"static const int MODEL_OUTPUT[] = {{{_integers(header.outputs)}}};",
        f"static const int MODEL_LINEAR[] = {{{_integers(by.linear)}}};",
        f"static const double MODEL_CONSTANT[] = {{{_numbers([float(slope) for *_, slope in by.constants])}}};",
        *(f"#define MODEL_N{kind} {len(entries)}" for kind, entries in kinds.items()),
        *(
            f"static const int MODEL_{kind}_ROW[] = {{{_integers(i for i, *_ in entries)}}};"
            for kind, entries in places.items()
        ),
        *(
            f"static const int MODEL_{kind}_COLUMN[] = {{{_integers(j for _, j, _ in entries)}}};"
            for kind, entries in places.items()
        ),
        "",
    ]
    signature = "(const double** arg, double** res, casadi_int* iw, double* w, int mem);"
    lines += [f"int model_{name}{signature}" for name in functions]
    lines += ["int model_laws(const double* p, casadi_int* iw, double* w);"]
    source = "\n".join([often.source, *tables, ""])
    return Files(source, rare.source, "\n".join([*lines, "", "#endif", ""]))


def _pattern(letter: str, sparsity: ca.Sparsity, *, often: bool) -> tuple[list[str], list[str]]:
    """Macros and definitions of a square sparse matrix and its elimination: see ``runtime/linear.h``."""
    name = f"MODEL_{letter}"
    start, rows = list(sparsity.colind()), list(sparsity.row())
    n = sparsity.size2()
    order = plan([rows[start[j] : start[j + 1]] for j in range(n)])
    # Multiplications of a step with nine solutions; a dense matrix needs no table look-ups, so its steps count
    # half.
    work = order.multiplications + 9 * len(order.rows)
    dense = 2 * work > n * n * n / 3 + 9 * n * n
    straight = often and not dense and n > 0 and is_short(order)
    macros = {
        "N": n, "NONZEROS": len(rows), "DENSE": int(dense), "FILLED": len(order.rows),
        "FACTORS": n * n if dense else len(order.rows),
        "FACTOR_CODE": f"model_{letter}_factor" if straight else "NULL",
        "SOLVE_CODE": f"model_{letter}_solve" if straight else "NULL",
    }  # fmt: skip
    tables = {
        "START": start, "ROW": rows, "COLUMN": order.columns, "PLACE": order.places, "LU_START": order.start,
        "LU_DIAGONAL": order.diagonal, "LU_ROW": order.rows, "LU_UPDATED": list(map(int, order.updated)),
        "DIAGONAL": [k for j in range(n) for k in range(start[j], start[j + 1]) if rows[k] == j],
    }  # fmt: skip
    lines = [f"#define {name}_{what} {value}" for what, value in macros.items()]
    lines += [f"extern const int {name}_{what}[];" for what in tables]
    definitions = [f"const int {name}_{w}[] = {{{wrapped(map(str, t)) or '0'}}};" for w, t in tables.items()]
    if straight:
        lines += [f"int model_{letter}_factor(const double* a, double* lu);"]
        lines += [f"void model_{letter}_solve(const double* lu, double* b);"]
        definitions += [straight_code(f"model_{letter}", start, rows, order)]
    return lines, definitions


def _numbers(values: Sequence[float]) -> str:
    return wrapped(repr(float(v)) if math.isfinite(v) else "1.0" for v in values) or "1.0"


def _integers(values: Iterable[int]) -> str:
    return wrapped(str(int(v)) for v in values) or "0"


def _string(text: str) -> str:
    escaped = (
        text.replace("\\", "\\\\")
        .replace("\001", "\\001")
        .replace('"', '\\"')
        .replace("\n", "\\n")
        .replace("\r", "")
    )
    return '"' + escaped.replace("?", "\\?") + '"'


def as_ports(mapping: Mapping[int, SX], expressions: Sequence[SX]) -> list[SX]:
    """Replace symbols in several expressions."""
    substitute = Substitution(mapping)
    return [substitute(e) for e in expressions]
