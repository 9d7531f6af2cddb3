"""The variables of a model description, as users see them, and their locations in the FMU."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice, product
from pathlib import Path

import numpy as np

from fmuid.core.errors import FmuError
from fmuid.core.immutable import FloatArray
from fmuid.simulation.fmu_description import DescribedVariable, FmuDescription
from fmuid.simulation.simulator import Variable
from fmuid.simulation.stepper import DTYPES

MAX_VARIABLES = 200_000

# FMI type -> (function suffix, place in stepper.CTYPES)
_STORAGE = {
    2: {
        "Real": ("Real", 0),
        "Integer": ("Integer", 6),
        "Enumeration": ("Integer", 6),
        "Boolean": ("Boolean", 6),
    },
    3: {
        "Float64": ("Float64", 0),
        "Float32": ("Float32", 1),
        "Int8": ("Int8", 2),
        "UInt8": ("UInt8", 3),
        "Int16": ("Int16", 4),
        "UInt16": ("UInt16", 5),
        "Int32": ("Int32", 6),
        "UInt32": ("UInt32", 7),
        "Int64": ("Int64", 8),
        "UInt64": ("UInt64", 9),
        "Enumeration": ("Int64", 8),
        "Boolean": ("Boolean", 3),
    },
}


@dataclass(frozen=True, slots=True)
class Slot:
    """Location of a scalar in the FMU: element `element` of the `size` values of `reference`.

    `suffix` names the functions (``Real`` in fmi2SetReal), None if the type is not numeric. `refusal` says why the
    start value cannot be set, None if it can be set; if the start value is `exact`, the FMU begins with it.
    `starts` are the start values of all elements. `whole_numbers` are the smallest and the largest value of a type
    of whole numbers, None for other types.
    """

    reference: int
    suffix: str | None
    storage: int
    element: int
    size: int
    starts: tuple[float, ...]
    refusal: str | None
    whole_numbers: tuple[int, int] | None
    exact: bool = False

    @property
    def has_start(self) -> bool:
        """Whether the description gives the start value."""
        return math.isfinite(self.starts[self.element])

    def check(self, name: str, values: float | FloatArray, where: Path) -> None:
        """Refuse values that the variable's type does not hold."""
        if not np.isfinite(values).all():
            raise FmuError(f"'{name}' cannot be set to {values}", where=where, fix="give a finite value")
        if self.whole_numbers is None:
            return
        low, high = self.whole_numbers
        if np.any(np.mod(values, 1) != 0):
            raise FmuError(f"'{name}' takes whole numbers only", where=where, fix="round its values")
        if np.min(values) < low or np.max(values) > high:
            raise FmuError(f"'{name}' takes {low} to {high} only", where=where, fix="give values in this range")


def in_words(parameters: Mapping[str, float], limit: int = 12) -> str:
    """Return parameters for a message as ``c = 1, d = 2``, at most `limit` of them."""
    shown = ", ".join(f"{k} = {v:.9g}" for k, v in islice(parameters.items(), limit))
    return shown + (f" and {len(parameters) - limit} more" if len(parameters) > limit else "")


def _number(text: str | None) -> float:
    if text is None:
        return math.nan
    folded = text.strip().casefold()
    if folded in {"true", "false"}:
        return float(folded == "true")
    try:
        return float(folded)
    except ValueError:
        return math.nan


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _whole_numbers(type: str, storage: int) -> tuple[int, int] | None:
    if storage < 2:
        return None
    held = np.iinfo(DTYPES[storage])
    return (0, 1) if type == "Boolean" else (max(int(held.min), -(2**53)), min(int(held.max), 2**53))


def _refusal(variable: DescribedVariable) -> str | None:
    """Return why a start value cannot be set before initialisation, in FMI's terms; None if it can."""
    causality, variability, initial = variable.causality, variable.variability, variable.initial
    if variability == "constant":
        return "is a constant"
    if causality in {"calculatedParameter", "structuralParameter", "independent"}:
        return f"is a {causality}" if causality != "independent" else "is the independent variable"
    if causality == "input" or initial in {"exact", "approx"}:
        return None
    return f"is {'an output' if causality == 'output' else 'a local variable'} that the FMU calculates"


def _elements(shape: tuple[int, ...]) -> Iterator[str]:
    """Yield the subscripts of an array in FMI's row-major order, counted from one as in Modelica."""
    for index in product(*(range(1, n + 1) for n in shape)):
        yield f"[{','.join(map(str, index))}]" if index else ""


def elements_of(variable: DescribedVariable) -> list[str]:
    """Return the names of a variable's elements; of a scalar, its name."""
    return [f"{variable.name}{subscript}" for subscript in _elements(variable.shape)]


def read_variables(
    description: FmuDescription, version: int, where: Path
) -> tuple[dict[str, Variable], dict[str, Slot]]:
    """Return the scalar variables of a model description, and their slots, by name.

    An FMI 3.0 array is listed element by element, as ``table[1,2]``.

    Raises
    ------
    FmuError
        There are too many variables, or one has no value reference; `where` names the FMU.
    """
    variables: dict[str, Variable] = {}
    slots: dict[str, Slot] = {}
    computed = set(description.states if description.starts_settable else ())
    for v in description.variables:
        suffix, storage = _STORAGE[version].get(v.type, (None, 0))
        low, high = (_number(bound) if suffix else math.nan for bound in (v.minimum, v.maximum))
        size, refusal = math.prod(v.shape), None if v.name in computed else _refusal(v)
        if not 0 <= v.reference < 2**32:
            what = f"variable '{v.name}' has the value reference {v.reference}"
            raise FmuError(what, where=where, fix="export it again: FMI allows 0 to 4294967295")
        if len(variables) + size > MAX_VARIABLES:
            what = f"has more than {MAX_VARIABLES} variables, including array elements"
            raise FmuError(what, where=where, fix="export it with fewer")
        starts = [_number(s) for s in (v.start or "").split()] if suffix else []
        starts = starts * size if len(starts) == 1 else starts
        starts += [math.nan] * (size - len(starts))
        for i, subscript in enumerate(_elements(v.shape)):
            name = f"{v.name}{subscript}"
            variables[name] = Variable(
                name=name,
                causality=v.causality,
                variability=v.variability,
                unit=v.unit,
                start=_finite(starts[i]),
                min=_finite(low),
                max=_finite(high),
                description=v.description,
                type=v.type,
            )
            slots[name] = Slot(
                reference=v.reference,
                suffix=suffix,
                storage=storage,
                element=i,
                size=size,
                starts=tuple(starts),
                refusal=refusal if suffix else f"is a {v.type}, not a number",
                whole_numbers=_whole_numbers(v.type, storage),
                exact=v.initial == "exact" or (v.name in computed and v.initial == "calculated"),
            )
    return variables, slots


def read_feedthrough(description: FmuDescription, variables: Mapping[str, Variable]) -> dict[str, frozenset[str]]:
    """Return the inputs on which each output depends without delay, by element; all if not stated."""
    elements = {v.name: elements_of(v) for v in description.variables}
    inputs = frozenset(n for n, v in variables.items() if v.causality == "input")
    inputs_of = {n: inputs for n, v in variables.items() if v.causality == "output"}
    for output, dependencies in description.outputs.items():
        if dependencies is not None:
            known = frozenset(n for name in dependencies for n in elements[name]) & inputs
            inputs_of |= dict.fromkeys(elements[output], known)
    return inputs_of
