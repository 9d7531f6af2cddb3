"""C code of CasADi functions: functions of bounded size, loops where scalars repeat each other.

An SX function is a long list of scalar operations. Written down as one C function it costs the compiler far more
than twice the time for twice the length. Here it becomes statements, each a tree of operations between values that
are used more than once (or are results). In a long function, statements of one shape whose values do not depend on
each other become one loop over tables of where the operands lie; what is left is cut into functions of bounded
size. A short function is one piece of straight code.
"""

from __future__ import annotations

import math
import re
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca

from fmu_build.idle import without_branches

_LARGEST_TREE = 40  # operations in a statement
_LARGEST_CONDITION = 8  # operations in a condition that is evaluated wherever it saves some ...
_MOST_CONDITIONS = 12  # ... and number of such conditions for one value
_LARGEST_PIECE = 400  # operations in a piece of straight code
_TINY = 150  # a function with up to this many operations stays one piece of straight code ...
_SHORT = 1000  # ... as does one with up to this many if loops would not make it much shorter
_MOST_RESULTS = 3  # in the statement of a value; further ones are copies of it
_FEWEST = 6  # statements that make up a loop

_CALL = re.compile(r"[a-z]\(")  # a function call, which takes as long as many operations

_LAWS = """\
/* 1 if every branch that depends on parameters alone is off, else 2. */
int {name}(const double* p, long long int* iw, double* w) {{
  const double* arg[1] = {{p}};
  double on, *res[1] = {{&on}};
  {on}(arg, res, iw, w, 0);
  return on == 0. ? 1 : 2;
}}
"""
_FIRST_IDLE = """\
  if (mem == 1) return {idle}(arg, res, iw, w, mem);
"""

Node = int
Leaf = tuple[int, int]
"""Argument and position in it; ``(-1, node)`` is a value of another statement."""

_TEMPLATES: dict[int, str] = {
    ca.OP_ADD: "({}+{})", ca.OP_SUB: "({}-{})", ca.OP_MUL: "({}*{})", ca.OP_DIV: "({}/{})", ca.OP_NEG: "(-{})",
    ca.OP_EXP: "exp({})", ca.OP_LOG: "log({})", ca.OP_POW: "power({}, {})", ca.OP_CONSTPOW: "power({}, {})",
    ca.OP_SQRT: "sqrt({})", ca.OP_SQ: "square({})", ca.OP_TWICE: "(2.*{})", ca.OP_SIN: "sin({})",
    ca.OP_COS: "cos({})", ca.OP_TAN: "tan({})", ca.OP_ASIN: "asin({})", ca.OP_ACOS: "acos({})",
    ca.OP_ATAN: "atan({})",
    ca.OP_LT: "({}<{})", ca.OP_LE: "({}<={})", ca.OP_EQ: "({}=={})", ca.OP_NE: "({}!={})", ca.OP_NOT: "(!{})",
    ca.OP_AND: "({}&&{})", ca.OP_OR: "({}||{})", ca.OP_FLOOR: "floor({})", ca.OP_CEIL: "ceil({})",
    ca.OP_FMOD: "fmod({}, {})", ca.OP_REMAINDER: "remainder({}, {})", ca.OP_FABS: "fabs({})",
    ca.OP_SIGN: "sign({})", ca.OP_COPYSIGN: "copysign({}, {})", ca.OP_IF_ELSE_ZERO: "({}?{}:0)",
    ca.OP_FMIN: "smaller({}, {})", ca.OP_FMAX: "larger({}, {})", ca.OP_INV: "(1./{})", ca.OP_SINH: "sinh({})",
    ca.OP_COSH: "cosh({})", ca.OP_TANH: "tanh({})", ca.OP_ASINH: "asinh({})", ca.OP_ACOSH: "acosh({})",
    ca.OP_ATANH: "atanh({})", ca.OP_ATAN2: "atan2({}, {})", ca.OP_EXPM1: "expm1({})", ca.OP_LOG1P: "log1p({})",
    ca.OP_HYPOT: "hypot({}, {})", ca.OP_ERF: "erf({})", ca.OP_ASSIGN: "{}",
}  # fmt: skip

# An exponent is usually a parameter, and usually one of these; libm's pow takes longer than the rest of an
# equation.
# libm's fmin and fmax are calls that compilers may not inline.
_HELPERS = {
    "power": """static inline double power(double x, double y) {
  return y==1. ? x : y==2. ? x*x : y==0. ? 1. : y==.5 && x>=0. ? sqrt(x) : y==-1. ? 1./x : pow(x, y);
}
""",
    "square": "static inline double square(double x) { return x*x; }\n",
    "sign": "static inline double sign(double x) { return x<0 ? -1 : x>0 ? 1 : x; }\n",
    "smaller": "static inline double smaller(double x, double y) { return x<y || isnan(y) ? x : y; }\n",
    "larger": "static inline double larger(double x, double y) { return x>y || isnan(y) ? x : y; }\n",
}


@dataclass(frozen=True)
class Code:
    """C code and the lengths of the work arrays ``arg, res, w`` that each function needs."""

    source: str
    work: Mapping[str, tuple[int, int, int]]


def c_code(functions: Mapping[str, ca.Function], prefix: str = "model_", parameters: int | None = None) -> Code:
    """Write functions as C, as ``int PREFIXname(const double** arg, double** res, ...)``.

    Parameters
    ----------
    functions
        SX functions by name. Only the nonzeros of a sparse result are computed, column by column.
    parameters
        Index of the argument that does not change over a simulation, in functions with at least so many arguments.
        If several branches depend on it alone, such as laws that are off at zero, there is a second version
        without them, which is called if ``mem`` is 1. ``int PREFIXlaws(const double* p, ...)`` returns 1 if all of
        them are off, else 2.

    Returns
    -------
    Code
        The same bytes for the same functions.
    """
    tables = _Tables()
    parts, work = [], {}
    versions = {name: without_branches(function, parameters) for name, function in functions.items()}
    if parameters is not None:
        p, on = ca.SX(), ca.SX(0.0)
        for asked, _ in filter(None, versions.values()):
            p = ca.SX.sym("p", asked.size1_in(0)) if p.is_empty() else p
            on = ca.logic_or(on, asked(p))
        writer = _Writer(f"{prefix}any_on", ca.Function("any_on", [p], [ca.cse(on)]), tables)
        parts += [writer.write(head="static "), _LAWS.format(name=f"{prefix}laws", on=writer.name)]
        work["laws"] = (1, 1, writer.slots)
    for name, function in functions.items():
        writer = _Writer(f"{prefix}{name}", function, tables, parameters)
        version = versions[name]
        if version is None:
            parts.append(writer.write())
            slots = writer.slots
        else:
            idle = _Writer(f"{prefix}{name}_idle", version[1], tables, parameters)
            parts.append(idle.write(head="static "))
            parts.append(writer.write(first=_FIRST_IDLE.format(idle=idle.name)))
            slots = max(writer.slots, idle.slots)
        work[name] = (max(function.n_in(), 1), max(function.n_out(), 1), slots)
    body = "".join(parts)
    helpers = "".join(text for name, text in _HELPERS.items() if f"{name}(" in body)
    return Code("#include <math.h>\n\n" + helpers + tables.text() + body, work)


class _Tables:
    """Integer tables, each distinct content once."""

    def __init__(self) -> None:
        self._names: dict[tuple[int, ...], str] = {}

    def name(self, content: tuple[int, ...]) -> str:
        return self._names.setdefault(content, f"T{len(self._names)}")

    def text(self) -> str:
        return "".join(
            f"static const int {name}[] = {{\n{wrapped(map(str, content))}}};\n"
            for content, name in self._names.items()
        )


def wrapped(items: Iterable[str], most: int = 20) -> str:
    """Comma-separated items in lines of at most `most` of them."""
    given = list(items)
    return ",\n".join(", ".join(given[i : i + most]) for i in range(0, len(given), most))


@dataclass
class _Statement:
    """One value: its tree of operations with holes for the leaves, and its destinations."""

    node: Node
    shape: str
    leaves: list[Leaf]
    operations: int
    results: list[Leaf] = field(default_factory=list)
    level: int = 0
    kept: bool = False  # in w, for other pieces


def _cost(statement: _Statement) -> int:
    return statement.operations + len(statement.results)


_Tree = tuple[str, list[Leaf], int]
"""Operations with holes for the leaves, the leaves, and the number of operations."""


def _guards(
    operations: Sequence[tuple[int, tuple[Node, ...]]],
    leaf: Mapping[Node, Leaf | str],
    results: Container[Node],
    parameters: int | None,
) -> dict[Node, _Tree]:
    """Return the conditions under which values are needed: those of the only branches that use them.

    There are few such conditions, and they are short and depend on parameters alone, such as whether one is zero.
    Those that change during a simulation would take the compiler longer, and the processor no less.
    """
    always: frozenset[Node] = frozenset([-1])
    needed = {node: always for node in range(len(operations)) if node in results}
    for node in range(len(operations) - 1, -1, -1):
        op, given = operations[node]
        needed_here = needed.get(node, frozenset())
        for place, below in enumerate(given):
            use = frozenset(given[:1]) if op == ca.OP_IF_ELSE_ZERO and place == 1 else needed_here
            either = needed.get(below, frozenset()) | use
            needed[below] = either if len(either) <= _MOST_CONDITIONS else always
    short = _short(operations, leaf, parameters)
    guards: dict[Node, _Tree] = {}
    for node, on in needed.items():
        whatever = any(operations[c][0] == ca.OP_NOT and operations[c][1][0] in on for c in on)
        if on and not whatever and all(condition in short for condition in on):
            trees = [short[condition] for condition in sorted(on)]
            leaves = [at for tree in trees for at in tree[1]]
            guards[node] = "||".join(tree[0] for tree in trees), leaves, sum(tree[2] for tree in trees)
    return guards


def _short(
    operations: Sequence[tuple[int, tuple[Node, ...]]], leaf: Mapping[Node, Leaf | str], parameters: int | None
) -> dict[Node, _Tree]:
    """Return the trees of values that take few operations from the parameters."""
    short: dict[Node, _Tree] = {}
    for node, (op, given) in enumerate(operations):
        at = leaf.get(node)
        if isinstance(at, str):
            short[node] = at, [], 0
        elif at is not None:
            if at[0] == parameters:
                short[node] = "{}", [at], 0
        elif all(n in short for n in given):
            below = [short[n] for n in given]
            size = 1 + sum(tree[2] for tree in below)
            if size <= _LARGEST_CONDITION:
                shape = _TEMPLATES[op].format(*(tree[0] for tree in below))
                short[node] = shape, [leaf_ for tree in below for leaf_ in tree[1]], size
    return short


def _guarded(condition: _Tree | None, shape: str, leaves: list[Leaf], size: int) -> _Tree:
    """Return a tree that is evaluated only where its value is needed, if that saves more than it costs."""
    if condition is None or (size <= condition[2] and not _CALL.search(shape)):
        return shape, leaves, size
    return f"(({condition[0]})?{shape}:0)", [*condition[1], *leaves], size + condition[2]


def _constant(value: float) -> str:
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    text = repr(value)
    return f"({text})" if value < 0 else text


class _Trees:
    """The operations of a function as trees: a statement for each value that is used more than once."""

    def __init__(self, function: ca.Function, parameters: int | None) -> None:
        self._operations: list[tuple[int, tuple[Node, ...]]] = []
        self._leaf: dict[Node, Leaf | str] = {}
        self._results: dict[Node, list[Leaf]] = {}
        register: dict[int, Node] = {}
        for k in range(function.n_instructions()):
            op, out = function.instruction_id(k), function.instruction_output(k)
            node = len(self._operations)
            if op == ca.OP_OUTPUT:
                source = register[function.instruction_input(k)[0]]
                self._results.setdefault(source, []).append((out[0], out[1]))
                continue
            given: tuple[Node, ...] = ()
            if op == ca.OP_INPUT:
                argument, position = function.instruction_input(k)
                self._leaf[node] = (argument, position)
            elif op == ca.OP_CONST:
                self._leaf[node] = _constant(function.instruction_constant(k))
            else:
                # CasADi names the single operand of a unary operation twice
                operands = function.instruction_input(k)[: _TEMPLATES[op].count("{}")]
                given = tuple(register[i] for i in operands)
            self._operations.append((op, given))
            register[out[0]] = node
        self._used = [0] * len(self._operations)
        for node in (n for _, given in self._operations for n in given):
            self._used[node] += 1
        self._guards = _guards(self._operations, self._leaf, self._results, parameters)
        self._trees: dict[Node, _Tree] = {}
        self._statements: list[_Statement] = []
        self._copies: list[_Statement] = []

    def statements(self) -> list[_Statement]:
        """List the statements, each after those whose values it uses."""
        for node, (op, given) in enumerate(self._operations):
            if node not in self._leaf:
                self._operation(node, op, given)
            elif node in self._results:
                shape, leaves, size = self._tree(node)
                self._copies += [_Statement(-1, shape, leaves, size, [r]) for r in self._results[node]]
        for number, copy in enumerate(self._copies):
            copy.node = len(self._operations) + number
        return [*self._statements, *self._copies]

    def _tree(self, node: Node) -> tuple[str, list[Leaf], int]:
        at = self._leaf.get(node)
        if isinstance(at, str):
            return at, [], 0
        if at is not None:
            return "{}", [at], 0
        return self._trees.pop(node) if node in self._trees else ("{}", [(-1, node)], 0)

    def _operation(self, node: Node, op: int, given: tuple[Node, ...]) -> None:
        below = [self._tree(n) for n in given]
        size = 1 + sum(b[2] for b in below)
        if size > _LARGEST_TREE:  # the largest operand becomes a separate statement
            largest = max(range(len(below)), key=lambda i: below[i][2])
            shape, leaves, count = below[largest]
            self._statements.append(
                _Statement(given[largest], *_guarded(self._guards.get(given[largest]), shape, leaves, count))
            )
            below[largest] = ("{}", [(-1, given[largest])], 0)
            size = 1 + sum(b[2] for b in below)
        shape = _TEMPLATES[op].format(*(b[0] for b in below))
        leaves = [at for b in below for at in b[1]]
        results = self._results.get(node, [])
        if self._used[node] == 1 and not results:
            self._trees[node] = (shape, leaves, size)
        elif len(results) <= _MOST_RESULTS:
            guarded = _guarded(self._guards.get(node), shape, leaves, size)
            self._statements.append(_Statement(node, *guarded, results))
        else:
            self._statements.append(_Statement(node, shape, leaves, size))
            self._copies += [_Statement(-1, "{}", [(-1, node)], 0, [result]) for result in results]


class _Writer:
    def __init__(self, name: str, function: ca.Function, tables: _Tables, parameters: int | None = None) -> None:
        self.name = name
        self.tables = tables
        self.slots = 0
        self._slot: dict[Node, int] = {}
        self._statements = _Trees(function, parameters).statements()
        self._of = {s.node: s for s in self._statements}
        self._used = {node for s in self._statements for argument, node in s.leaves if argument == -1}

    def write(self, head: str = "", first: str = "") -> str:
        """Return the C function; `head` precedes it, `first` is executed before everything else."""
        self._head, self._first = head, first
        statements = self._statements
        total = sum(map(_cost, statements))
        if total > _TINY:
            pieces = self._pieces(statements)
            written = sum(_cost(p[0]) if isinstance(p, tuple) else sum(map(_cost, p)) for p in pieces)
            if total > _SHORT or 4 * written < total:
                return self._in_pieces(pieces)
        return self._signature(self._piece(statements, set()))

    def _signature(self, body: str) -> str:
        unused = "".join(f" (void){n};" for n in ("arg", "res", "iw", "w", "mem"))
        return (
            f"{self._head}int {self.name}"
            "(const double** arg, double** res, long long int* iw, double* w, int mem) {\n"
            f" {unused}\n{self._first}{body}  return 0;\n}}\n\n"
        )

    def _in_pieces(self, pieces: list[list[_Statement] | tuple[_Statement, ...]]) -> str:
        inside = [{s.node for s in piece} for piece in pieces]
        for nodes, piece in zip(inside, pieces, strict=True):
            for s in piece:
                for argument, node in s.leaves:
                    if argument == -1 and (node not in nodes or isinstance(piece, tuple)):
                        self._of[node].kept = True
        for piece in pieces:
            all_kept = isinstance(piece, tuple) and any(s.kept for s in piece)  # then their places are contiguous
            for s in piece:
                s.kept |= all_kept
                if s.kept:
                    self._slot[s.node] = self.slots
                    self.slots += 1
        # Pieces are joined into functions of bounded size; called through a table, they are not all inlined into
        # one.
        bodies: list[list[str]] = [[]]
        size = 0
        for nodes, piece in zip(inside, pieces, strict=True):
            is_loop = isinstance(piece, tuple)
            cost = 10 * piece[0].operations if is_loop else sum(s.operations for s in piece)
            if bodies[-1] and size + cost > _LARGEST_PIECE:
                bodies.append([])
                size = 0
            size += cost
            text = self._loop(piece) if is_loop else self._piece(piece, nodes)
            bodies[-1].append(f"  {{\n{text}  }}\n")
        parts = [
            f"static void {self.name}_{i}(const double** arg, double** res, double* w) {{\n"
            f"  (void)arg; (void)res; (void)w;\n{''.join(body)}}}\n\n"
            for i, body in enumerate(bodies)
        ]
        names = wrapped((f"{self.name}_{i}" for i in range(len(parts))), 4)
        table = f"static void (*const {self.name}_parts[])(const double**, double**, double*) = {{\n{names}}};\n\n"
        call = f"  for (int i = 0; i < {len(parts)}; i++) {self.name}_parts[i](arg, res, w);\n"
        return "".join(parts) + table + self._signature(call)

    def _pieces(self, statements: list[_Statement]) -> list[list[_Statement] | tuple[_Statement, ...]]:
        """Straight pieces (lists) and loops (tuples), each after those it uses."""
        for s in statements:
            below = (self._of[node].level for argument, node in s.leaves if argument == -1)
            s.level = 1 + max(below, default=0)
        groups: dict[tuple[object, ...], list[_Statement]] = {}
        for s in statements:
            # An array is part of the shape, a position in it is not.
            what = (s.level, s.shape, tuple(a for a, _ in s.leaves), tuple(k for k, _ in s.results))
            groups.setdefault(what, []).append(s)
        loops: dict[int, list[tuple[_Statement, ...]]] = {}
        straight: dict[int, list[_Statement]] = {}
        for group in groups.values():
            level = group[0].level
            if len(group) >= _FEWEST:
                loops.setdefault(level, []).append(tuple(group))
            else:
                straight.setdefault(level, []).extend(group)
        if not loops:  # in the original order, which keeps values close to their uses
            return list(self._cut(statements))
        pieces: list[list[_Statement] | tuple[_Statement, ...]] = []
        waiting: list[_Statement] = []
        for level in sorted({s.level for s in statements}):
            waiting += straight.get(level, [])
            if level in loops:
                pieces += self._cut(waiting)
                pieces += loops[level]
                waiting = []
        return [*pieces, *self._cut(waiting)]

    @staticmethod
    def _cut(statements: Sequence[_Statement]) -> Iterable[list[_Statement]]:
        piece: list[_Statement] = []
        size = 0
        for s in statements:
            cost = s.operations + 1
            if piece and size + cost > _LARGEST_PIECE:
                yield piece
                piece, size = [], 0
            piece.append(s)
            size += cost
        if piece:
            yield piece

    def _piece(self, statements: Sequence[_Statement], nodes: set[Node]) -> str:
        """Straight code: values in local variables, results stored at the end."""
        lines, stores = [], []
        by_result: dict[int, list[str]] = {}
        arguments: set[int] = set()
        local = {s.node: f"v{i}" for i, s in enumerate(statements)}

        def operand(at: Leaf) -> str:
            argument, position = at
            if argument >= 0:
                arguments.add(argument)
                return f"a{argument}[{position}]"
            if nodes and position not in nodes:
                return f"w[{self._slot[position]}]"
            return local[position]

        for s in statements:
            text = s.shape.format(*map(operand, s.leaves))
            if len(s.results) == 1 and not s.kept and s.node not in self._used:
                k, position = s.results[0]
                by_result.setdefault(k, []).append(f"    r{k}[{position}] = {text};")
                continue
            lines.append(f"  const double {local[s.node]} = {text};")
            if s.kept:
                stores.append(f"  w[{self._slot[s.node]}] = {local[s.node]};")
            for k, position in s.results:
                by_result.setdefault(k, []).append(f"    r{k}[{position}] = {local[s.node]};")
        head = [f"  const double* const a{k} = arg[{k}];" for k in sorted(arguments)]
        for k, lines_of_result in sorted(by_result.items()):
            stores += [f"  double* const r{k} = res[{k}];", f"  if (r{k}) {{", *lines_of_result, "  }"]
        return "\n".join([*head, *lines, *stores, ""])

    def _loop(self, group: Sequence[_Statement]) -> str:
        """One loop over statements of one shape."""
        first = group[0]
        arguments: set[int] = set()

        def index(positions: tuple[int, ...]) -> str:
            start, step = positions[0], positions[1] - positions[0]
            if all(p == start + i * step for i, p in enumerate(positions)):
                if step == 0:
                    return str(start)
                return f"{start} + i" if step == 1 else f"{start} + i * {step}"
            return f"{self.tables.name(positions)}[i]"

        def operand(place: int) -> str:
            argument = first.leaves[place][0]
            if argument >= 0:
                arguments.add(argument)
                return f"a{argument}[{index(tuple(s.leaves[place][1] for s in group))}]"
            return f"w[{index(tuple(self._slot[s.leaves[place][1]] for s in group))}]"

        text = first.shape.format(*(operand(i) for i in range(len(first.leaves))))
        lines = [f"  for (int i = 0; i < {len(group)}; i++) {{", f"    const double v = {text};"]
        if first.kept:
            lines.append(f"    w[{index(tuple(self._slot[s.node] for s in group))}] = v;")
        for place, (k, _) in enumerate(first.results):
            lines.append(f"    if (r{k}) r{k}[{index(tuple(s.results[place][1] for s in group))}] = v;")
        head = [f"  const double* const a{k} = arg[{k}];" for k in sorted(arguments)]
        head += [f"  double* const r{k} = res[{k}];" for k in sorted({k for k, _ in first.results})]
        return "\n".join([*head, *lines, "  }", ""])


def lengths(codes: Iterable[Code]) -> dict[str, int]:
    """Largest work arrays over functions: ``ARG, RES, IW, W``."""
    works = [w for code in codes for w in code.work.values()]
    largest = [max((w[i] for w in works), default=1) for i in range(3)]
    return {"ARG": largest[0], "RES": largest[1], "IW": 1, "W": max(largest[2], 1)}
