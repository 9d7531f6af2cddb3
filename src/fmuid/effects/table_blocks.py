"""Learned tables as blocks of the Modelica Standard Library, for the source of a corrected model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from fmu_build.flat_model import FlatModel
from fmu_build.modelica_text import expression_text, name_text
from fmu_build.syntax import Binary, Call, Expression, If, Literal, Part, Reference, transform

_SIZE = "_size_1"


@dataclass(frozen=True, slots=True)
class TableBlock:
    """A table over one variable as a `CombiTable1Ds`: its name, knots, parameters, and variable.

    The parameters are the values at the knots, or the first value and the increments from knot to knot.
    """

    name: str
    knots: tuple[Expression, ...]
    sizes: tuple[str, ...]
    over: Expression
    increments: bool

    @property
    def declaration(self) -> str:
        """The component in Modelica."""
        sizes = [name_text(size) for size in self.sizes]
        values = [" + ".join(sizes[: k + 1]) for k in range(len(sizes))] if self.increments else sizes
        rows = (f"{expression_text(knot)}, {value}" for knot, value in zip(self.knots, values, strict=True))
        hold = "Modelica.Blocks.Types.Extrapolation.HoldLastPoint"
        block = "Modelica.Blocks.Tables.CombiTable1Ds"
        return f"{block} {name_text(self.name)}(table = [{'; '.join(rows)}], extrapolation = {hold});"

    @property
    def equation(self) -> str:
        """The equation of its input."""
        return f"{name_text(self.name)}.u = {expression_text(self.over)};"


def with_table_blocks(
    flat: FlatModel, sizes: Sequence[tuple[str, ...]]
) -> tuple[FlatModel, tuple[TableBlock, ...]]:
    """Return a model whose tables over one variable are outputs of blocks, and these blocks.

    Parameters
    ----------
    sizes
        For each law, the names of its parameters in the model. Only tables over one variable are replaced.
    """
    laws = {of_law for of_law in sizes if len(of_law) > 1 and of_law[0].endswith(_SIZE)}
    blocks: dict[str, TableBlock] = {}

    def block_of(node: Any) -> Any:
        if isinstance(node, Binary) and node.operator == "+" and (table := _table(node)) and table.sizes in laws:
            known = blocks.setdefault(table.name, table)
            if expression_text(known.over) == expression_text(table.over):
                return Reference(node.at, (Part(table.name), Part("y", (Literal(node.at, 1),))))
        # A block of zeros is zero, so it needs no guard.
        if isinstance(node, Call) and node.function == "noEvent" and isinstance(guarded := node.arguments[0], If):
            value, zero = guarded.branches[0][1], guarded.otherwise
            if isinstance(value, Reference) and value.parts[0].name in blocks and isinstance(zero, Literal):
                return value
        return node

    equations = tuple(
        replace(e, left=transform(e.left, block_of), right=transform(e.right, block_of)) for e in flat.equations
    )
    return replace(flat, equations=equations), tuple(blocks.values())


def _table(total: Binary) -> TableBlock | None:
    """Return the table that a sum of sizes times functions of one variable is, if it is one."""
    sizes: list[str] = []
    begins: list[Expression] = []
    ends: list[Expression] = []
    over: list[Expression] = []
    increments = False
    rise: Expression | None
    fall: Expression | None
    for term in _addends(total):
        match term:
            case Binary(operator="*", left=Reference() as size, right=Literal(value=1) as rise) if not sizes:
                fall, increments = rise, True
            case Binary(
                operator="*",
                left=Reference() as size,
                right=Call(
                    function="max", arguments=(Literal(value=0), Call(function="min", arguments=(rise, fall)))
                ),
            ):
                pass
            case _:
                return None
        sizes.append(size.name)
        match rise:
            case Binary(operator="/", left=Binary(operator="-", left=x, right=begin)):
                begins.append(begin)
                over.append(x)
        match fall:
            case Binary(
                operator="/", left=Binary(operator="-", left=x, right=begin), right=Binary(operator="-", left=end)
            ):
                begins.append(begin)
                ends.append(end)
                over.append(x)
            case Binary(operator="/", left=Binary(operator="-", left=end, right=x)):
                ends.append(end)
                over.append(x)
    if not begins or len({expression_text(x) for x in over}) != 1 or len(ends) != len(sizes) - 1:
        return None
    if [*map(expression_text, begins[1:])] != [*map(expression_text, ends[:-1])]:
        return None
    return TableBlock(sizes[0].removesuffix(_SIZE), (begins[0], *ends), tuple(sizes), over[0], increments)


def _addends(total: Expression) -> Iterator[Expression]:
    if isinstance(total, Binary) and total.operator == "+":
        yield from _addends(total.left)
        yield total.right
    else:
        yield total
