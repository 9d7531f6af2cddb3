"""CasADi functions of a reduced model, and their C code."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

from fmu_build.graph import SX, Gradient, Graph, Substitution, key

Functions = dict[str, ca.Function]
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
    outputs: Sequence[bool]
    """Which of v are outputs of the model."""


def column(items: Sequence[SX]) -> SX:
    """Scalars as a column vector."""
    return ca.vertcat(*items) if items else SX(0, 1)


def dense(rows: Sequence[Gradient], symbols: Sequence[SX]) -> SX:
    """Jacobian with the given gradients as rows, every entry stored."""
    out = SX.zeros(len(rows), len(symbols))
    for j, symbol in enumerate(symbols):
        for i, row in enumerate(rows):
            if key(symbol) in row:
                out[i, j] = row[key(symbol)]
    return ca.densify(out)


def parameter_slopes(graph: Graph, ports: Ports, e: Expressions) -> tuple[list[Slope], list[Slope]]:
    """Partial derivatives of dx by [p; d; z = pz], where not zero: by scalars, and by elements of tables."""
    scalars: list[Slope] = []
    elements: list[Slope] = []
    parameters = [*ports.p, *ports.d]
    for i, row in enumerate(map(graph.gradient, e.dx)):
        for j, symbol in enumerate(parameters):
            if key(symbol) in row:
                (elements if symbol.name().endswith("]") else scalars).append((i, j, row[key(symbol)]))
        for j, pair in enumerate(zip(ports.z, ports.pz, strict=True), len(parameters)):
            found = [row[key(symbol)] for symbol in pair if key(symbol) in row]
            if found:
                scalars.append((i, j, sum(found[1:], found[0])))
    return scalars, elements


def make_functions(graph: Graph, ports: Ports, e: Expressions) -> Functions:
    """Build the functions of the interface, common subexpressions shared."""
    environment = ports.environment()
    out: Functions = {}

    def add(name: str, arguments: list[SX], results: list[SX]) -> None:
        shared = ca.cse([ca.densify(r) for r in results])
        out[name] = ca.Function(f"model_{name}", arguments, shared)

    slopes_dx = [graph.gradient(r) for r in e.dx]
    slopes_r = [graph.gradient(r) for r in e.residuals]
    add("dependent", [column(ports.p)], [column(e.dependent)])
    starts = [column(e.x_start), column(e.z_start), column(e.y_start)]
    add("start", [column(ports.p), column(ports.d)], starts)
    conditions = [*e.initial, *e.residuals]
    slopes = [graph.gradient(r) for r in conditions]
    jacobian = dense(slopes, [*ports.x, *ports.y])
    add("initial", [*environment, column(e.xs)], [column(conditions), jacobian])
    add("derivatives", environment, [column(e.dx)])
    add(
        "jacobian",
        environment,
        [column(e.dx), dense(slopes_dx, ports.x), dense(slopes_dx, [ports.t]), dense(slopes_dx, ports.y)],
    )
    add(
        "loop",
        environment,
        [
            column(e.residuals),
            dense(slopes_r, ports.y),
            dense(slopes_r, ports.x),
            dense(slopes_r, [ports.t]),
        ],
    )
    scalars, elements = (column([slope for _, _, slope in own]) for own in parameter_slopes(graph, ports, e))
    add("slopes", environment, [dense(slopes_dx, ports.x), scalars])
    add("element_slopes", environment, [elements])
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

    add_partials("partials", environment, "x u p d y" + discrete, e.dx)
    add_partials("variable_partials", environment, "x u p d y" + discrete, e.v)
    outputs = [v if is_output else SX(0.0) for v, is_output in zip(e.v, e.outputs, strict=True)]
    add_partials("output_partials", environment, "x u p d y" + discrete, outputs)
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
    return out


# An exponent is mostly a parameter, and mostly one of these; libm's pow takes longer than the rest of an equation.
_POWER = """#include <math.h>
static inline double power(double x, double y) {
  return y==1. ? x : y==2. ? x*x : y==0. ? 1. : y==.5 && x>=0. ? sqrt(x) : y==-1. ? 1./x : pow(x, y);
}
"""


def c_source(functions: Functions) -> str:
    """C text of all functions; the same bytes for the same functions."""
    generator = ca.CodeGenerator("model", {"with_header": False, "casadi_int": "long long int"})
    for function in functions.values():
        generator.add(function)
    source = str(generator.dump())
    for name, sign in (("fmin", "<"), ("fmax", ">")):  # libm's are calls that compilers may not inline
        source = source.replace(f"return {name}(x, y);", f"return x{sign}y || isnan(y) ? x : y;")
    return _POWER + source.replace("=pow(", "=power(")


def c_header(
    functions: Functions,
    sizes: Mapping[str, int],
    x_nominal: Sequence[float],
    y_nominal: Sequence[float],
    inclusive: Sequence[bool],
    asserts: Sequence[tuple[str, bool]],
    slopes: Sequence[Sequence[Slope]],
    outputs: Sequence[bool],
) -> str:
    """Return the text of ``model.h``: sizes, tables and prototypes."""
    lines = ["#ifndef MODEL_H", "#define MODEL_H", ""]
    lines += ["#ifndef casadi_int", "#define casadi_int long long int", "#endif", ""]
    lines += [f"#define MODEL_{name} {value}" for name, value in sizes.items()]
    largest = [0, 0, 0, 0]
    kinds = ("ARG", "RES", "IW", "W")
    for name, f in functions.items():
        work = (f.sz_arg(), f.sz_res(), f.sz_iw(), f.sz_w())
        lines += [f"#define model_{name}_SZ_{kind} {n}" for kind, n in zip(kinds, work, strict=True)]
        largest = [max(a, b) for a, b in zip(largest, work, strict=True)]
    lines += [f"#define MODEL_SZ_{kind} {n}" for kind, n in zip(kinds, largest, strict=True)]
    lines += [
        "",
        f"static const double MODEL_X_NOMINAL[] = {{{_numbers(x_nominal)}}};",
        f"static const double MODEL_Y_NOMINAL[] = {{{_numbers(y_nominal)}}};",
        f"static const int MODEL_INCLUSIVE[] = {{{_integers(inclusive)}}};",
        f"static const int MODEL_ASSERT_WARNING[] = {{{_integers(w for _, w in asserts)}}};",
        "static const char* const MODEL_ASSERT_MESSAGE[] = {"
        + (", ".join(_string(text) for text, _ in asserts) or '""')
        + "};",
        f"static const int MODEL_OUTPUT[] = {{{_integers(outputs)}}};",
        f"#define MODEL_NSLOPE {len(slopes[0])}",
        f"#define MODEL_NELEMENT {len(slopes[1])}",
        f"static const int MODEL_SLOPE_ROW[] = {{{_integers(i for own in slopes for i, _, _ in own)}}};",
        f"static const int MODEL_SLOPE_COLUMN[] = {{{_integers(j for own in slopes for _, j, _ in own)}}};",
        "",
    ]
    signature = "(const double** arg, double** res, casadi_int* iw, double* w, int mem)"
    lines += [f"int model_{name}{signature};" for name in functions]
    return "\n".join([*lines, "", "#endif", ""])


def _numbers(values: Sequence[float]) -> str:
    return ", ".join(repr(float(v)) if math.isfinite(v) else "1.0" for v in values) or "1.0"


def _integers(values: Iterable[int]) -> str:
    return ", ".join(str(int(v)) for v in values) or "0"


def _string(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n").replace("\r", "")
    return '"' + escaped.replace("?", "\\?") + '"'


def as_ports(mapping: Mapping[int, SX], expressions: Sequence[SX]) -> list[SX]:
    """Replace symbols in several expressions."""
    substitute = Substitution(mapping)
    return [substitute(e) for e in expressions]
