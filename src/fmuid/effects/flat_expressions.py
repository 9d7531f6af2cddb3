"""Values over time of expressions of a flat model, from those of its variables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from fmu_build.flat_model import differentiated, flat_name
from fmu_build.model_ports import Port
from fmu_build.syntax import Binary, Call, Expression, If, Literal, Reference, Unary, references
from fmuid.core.immutable import FloatArray

_FUNCTIONS: Mapping[str, Callable[..., FloatArray]] = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan,
    "atan2": np.arctan2, "sinh": np.sinh, "cosh": np.cosh, "tanh": np.tanh, "exp": np.exp, "log": np.log,
    "log10": np.log10, "sqrt": np.sqrt, "abs": np.abs, "sign": np.sign, "min": np.minimum, "max": np.maximum,
    "noEvent": np.asarray, "smooth": lambda *both: both[1], "homotopy": lambda *both: both[0],
}  # fmt: skip
_PREFIXES: Mapping[str, Callable[[FloatArray], FloatArray]] = {
    "-": np.negative, "+": np.positive, "not": np.logical_not,
}  # fmt: skip
_OPERATORS: Mapping[str, Callable[[FloatArray, FloatArray], FloatArray]] = {
    "+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide, "^": np.power,
    "<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal, "==": np.equal,
    "<>": np.not_equal, "and": np.logical_and, "or": np.logical_or,
}  # fmt: skip


class _UnknownError(Exception):
    """An expression has a variable or an operation that is not known here."""


def names_at(port: Port) -> list[str]:
    """Return the variables that the quantities and the flows of a port without connectors depend on."""
    every = (*port.quantities.values(), *port.terms) if port.shares else ()
    return list(dict.fromkeys(flat_name(reference) for reference in references(every)))


def courses_at(port: Port, courses: Mapping[str, FloatArray], time: FloatArray) -> dict[str, FloatArray]:
    """Return the quantities of a port without connectors over time, as far as they are known."""
    quantities = {name: values_of(e, courses, time) for name, e in port.quantities.items()}
    return {name: course for name, course in quantities.items() if course is not None}


def largest_flow(port: Port, courses: Mapping[str, FloatArray], time: FloatArray) -> float:
    """Return the largest absolute value of a summand of a port without connectors."""
    flows = (values_of(term, courses, time) for term in port.terms)
    return max((float(np.abs(course).max()) for course in flows if course is not None), default=0.0)


@dataclass(frozen=True, slots=True)
class Seen:
    """Potential and rate at a port in a run, the largest flow, and the largest drop around a loop."""

    time: FloatArray
    p: FloatArray | None
    rate: FloatArray
    flow: float
    drop: float = 0.0


def seen_at(port: Port, course: Mapping[str, FloatArray], t: FloatArray) -> Seen | None:
    """Return the variables of a port in a run; None if the model has none of them there."""
    if port.shares:
        here, size = courses_at(port, course, t), largest_flow(port, course, t)
        if port.kind == "loop" and (through := here.get("through")) is not None:
            return Seen(t, None, np.gradient(through, t), float(np.abs(through).max()), size)
        p = here.get("p")
        rate = here.get("rate", None if p is None else np.gradient(p, t))
        return None if rate is None else Seen(t, p, rate, size)
    potentials = [course[n] for n in port.probes["p"] if n in course]
    if len(potentials) != len(port.probes["p"]):
        return None
    p = potentials[1] - potentials[0] if port.kind == "branch" else potentials[0]
    flow = max((float(np.abs(course[n]).max()) for n in port.probes.get("flow", ()) if n in course), default=0.0)
    if port.coil and (through := course.get(port.probes["flow"][0])) is not None:
        return Seen(t, p, np.gradient(through, t), flow)
    speeds = [course[n] for n in port.probes.get("rate", ()) if n in course]
    if not speeds or len(speeds) != len(port.probes["rate"]):
        return Seen(t, p, np.gradient(p, t), flow)
    return Seen(t, p, speeds[1] - speeds[0] if port.kind == "branch" else speeds[0], flow)


def values_of(e: Expression, courses: Mapping[str, FloatArray], time: FloatArray) -> FloatArray | None:
    """Return the values of an expression at (N,) times; None if it is not known, or not finite.

    Derivatives are differences of neighbouring samples.

    Parameters
    ----------
    courses
        (N,) values of variables.
    """
    try:
        with np.errstate(all="ignore"):
            values = np.asarray(_value(e, {"time": time, **courses}), dtype=np.float64)
            course = np.broadcast_to(values, time.shape)
    except _UnknownError:
        return None
    return course if np.isfinite(course).all() else None


def _value(e: Expression | None, courses: Mapping[str, FloatArray]) -> FloatArray:
    def values(*inner: Expression | None) -> list[FloatArray]:
        return [_value(one, courses) for one in inner]

    match e:
        case Literal():
            return np.asarray(e.value)
        case Reference() if (name := flat_name(e)) in courses:
            return courses[name]
        case Unary() if e.operator in _PREFIXES:
            return _PREFIXES[e.operator](*values(e.operand))
        case Binary() if e.operator in _OPERATORS:
            return _OPERATORS[e.operator](*values(e.left, e.right))
        case If(branches=((condition, branch), *further)):
            rest = replace(e, branches=tuple(further)) if further else e.otherwise
            return np.where(*values(condition, branch, rest))
        case Call(arguments=(inner,)) if differentiated(e) is not None:
            return np.gradient(*values(inner), courses["time"])
        case Call() if e.function in _FUNCTIONS:
            return _FUNCTIONS[e.function](*values(*e.arguments))
    raise _UnknownError
