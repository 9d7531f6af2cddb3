"""The library of terms for laws: dimensionless Modelica expressions of the quantities at a place.

A quantity x occurs as x/X, where X is its largest absolute value (rounded up), so that the coefficient of every
term is a flow and gives the size of the term there. Widths, limits, pitches and lags are parameters in x's own
unit.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from fmuid.core.formulas import parse_modelica
from fmuid.core.immutable import FloatArray
from fmuid.data.filtering import first_order

Kind = Literal["position", "angle", "speed", "flow", "value"]
HIDDEN = "hidden"  # the name of a term's own state in its text
SHAPES = ("width", "pitch", "lag")  # names of the parameters of a term's shape
_WIDTHS = (0.1, 0.2, 0.4)  # shares of the largest value of a quantity
_LIMITS = (0.2, 0.35, 0.5, 0.65, 0.8)  # thresholds, as shares of it; a refit moves them
_DIRECTION = 0.01  # share of the largest speed within which friction reverses
_WAVES = np.arange(1.0, 12.5, 0.5)  # number of waves over the range of a position
_TURNS = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)  # waves per turn
_LAGS = 5  # time constants of a term with a state, evenly spaced on a logarithmic scale; a refit moves them
_PLAIN, _SHAPED, _TWO, _STATE = 1, 2, 3, 4  # ranks


@dataclass(frozen=True, slots=True)
class Quantity:
    """A quantity that a law at a place may depend on.

    Attributes
    ----------
    text
        The quantity in Modelica.
    name
        Name of the variable in it.
    size
        Largest absolute value reached.
    low, high
        Range of values reached.
    """

    text: str
    name: str
    unit: str
    size: float
    low: float
    high: float
    kind: Kind = "value"

    @property
    def signed(self) -> bool:
        """Whether it reached both signs."""
        return self.low < -0.05 * self.size and self.high > 0.05 * self.size

    @property
    def ratio(self) -> str:
        """Return the quantity divided by its size, in Modelica."""
        return f"({self.text}/{self.size:g})"


@dataclass(frozen=True, slots=True)
class Shape:
    """A parameter of a term's shape: value, bounds, unit."""

    value: float
    lower: float
    upper: float
    unit: str


@dataclass(frozen=True, slots=True)
class Term:
    """One term of a law, without its coefficient.

    Attributes
    ----------
    text
        Modelica expression of size one, of a place's quantities, its own `shapes` and the state `HIDDEN`.
    rank
        Complexity of the term.
    shapes
        Parameters of its shape, by their names in the text.
    rate
        The derivative of its state, empty if it has none.
    over
        The quantity that it mainly depends on.
    """

    text: str
    rank: int
    over: Quantity
    shapes: Mapping[str, Shape] = field(default_factory=dict)
    rate: str = ""

    @property
    def family(self) -> str:
        """The term irrespective of the values of its shapes."""
        return f"{self.text} | {self.rate}"

    def course(
        self, quantities: Mapping[str, FloatArray], time: FloatArray, values: Mapping[str, float] | None = None
    ) -> FloatArray:
        """Return (N,) values along (N,) time series of the quantities; shapes have their own values by default."""
        columns = {**quantities, "time": time}
        columns |= {n: np.full(len(time), s.value) for n, s in self.shapes.items()}
        columns |= {n: np.full(len(time), v) for n, v in (values or {}).items()}
        if self.rate:
            columns[HIDDEN] = _lagged(self.rate, columns, time)
        return evaluated(self.text, columns)

    def whole_course(self, courses: Sequence[Mapping[str, FloatArray]], time: Sequence[FloatArray]) -> FloatArray:
        """Return the values along the time series of every experiment, one after the other."""
        return np.concatenate([self.course(c, t) for c, t in zip(courses, time, strict=True)])

    def state(
        self, quantities: Mapping[str, FloatArray], time: FloatArray, values: Mapping[str, float]
    ) -> FloatArray:
        """Return (N,) values of its state along time series of the quantities."""
        return replace(self, text=HIDDEN).course(quantities, time, values)


def evaluated(text: str, columns: Mapping[str, FloatArray]) -> FloatArray:
    """Return the value of a Modelica expression of this library at every sample of (N,) columns."""
    expression = parse_modelica(text)
    values = expression.of_samples({n: columns[n] for n in expression.names})
    return np.broadcast_to(values, np.shape(columns["time"])).astype(np.float64)


def names_in(text: str) -> frozenset[str]:
    """Return the names in a Modelica expression of this library."""
    return parse_modelica(text).names


def _lagged(rate: str, columns: Mapping[str, FloatArray], time: FloatArray) -> FloatArray:
    """Return a state that starts at zero and whose derivative is linear in it: ``f - a*hidden``."""
    zero, one = (evaluated(rate, {**columns, HIDDEN: np.full(len(time), value)}) for value in (0.0, 1.0))
    step, decay = float(np.mean(np.diff(time))), float(np.mean(zero - one))
    keep = float(np.exp(-step * decay))
    gain = (1.0 - keep) / decay if decay * step > 1e-9 else step
    # Between two samples it is driven by their mean.
    driven = np.concatenate([[0.0], 0.5 * (zero[1:] + zero[:-1])])
    return first_order(gain * driven, keep)


def library(
    quantities: Sequence[Quantity],
    inputs: Sequence[Quantity],
    time: Sequence[FloatArray],
    others: Sequence[Quantity] = (),
) -> list[Term]:
    """Return every term that a law at a place may have: of one quantity, of two, with a hidden state.

    `others` are variables away from the place: neighbours' states, measured outputs, columns, time.
    """
    terms: list[Term] = []
    for x in quantities:
        terms += _of_one(x) if x.kind != "flow" else ()  # a load only acts together with other quantities
    for u in (*inputs, *others):
        terms += _of_input(u)
    for x in (q for q in quantities if q.kind != "flow"):
        for y in (*quantities, *inputs):
            terms += _of_two(x, y) if y != x else ()
            terms += _with_state(x, y, time)
        for y in others:
            terms += _of_two(x, y)
    return terms


def _of_one(x: Quantity) -> Iterator[Term]:
    r, p = x.ratio, x.text
    yield Term(r, _PLAIN, x)
    yield Term(f"{r}*abs({r})", _PLAIN, x)
    yield Term(f"{r}^3", _PLAIN, x)
    yield Term(f"{r}*sqrt(abs({r}))", _SHAPED, x)
    yield Term(f"{r}*abs({r})^0.25", _SHAPED, x)
    yield Term(f"{r}/sqrt(abs({r}) + 1e-3)", _SHAPED, x)
    yield Term(f"{r}*abs({r})^3", _SHAPED, x)
    yield Term(f"{r}^5", _SHAPED, x)
    if x.signed:
        yield Term(f"{r}^2", _PLAIN, x)
        yield Term(f"abs({r})", _PLAIN, x)
        yield Term(f"{r}^4", _SHAPED, x)
    if x.kind == "speed":
        direction = direction_of(x)
        yield Term(direction, _PLAIN, x)
        yield Term(f"abs({direction})", _PLAIN, x)
        yield from _wide(f"{direction}*exp(-abs({p})/width)", x, _WIDTHS, _SHAPED)
    for sign in (1, -1):
        if (x.high if sign > 0 else -x.low) > 0.3 * x.size:
            s = p if sign > 0 else f"(-{p})"
            yield from _wide(
                f"(exp({s}/width) - 1)/(exp({x.size:g}/width) - 1)", x, (0.15, 0.3, 0.6), _SHAPED, 0.05
            )
            yield from _wide(f"(1 - exp(-{s}/width))", x, _WIDTHS, _SHAPED, 0.03) if not x.signed else ()
            yield from _wide(f"max({s} - width, 0)/{x.size:g}", x, _LIMITS, _SHAPED)
            yield from _wide(f"(max({s} - width, 0)/{x.size:g})^1.5", x, _LIMITS, _SHAPED)
            yield from _wide(f"(max({s} - width, 0)/{x.size:g})^2", x, _LIMITS, _SHAPED)
    yield from _wide(f"tanh({p}/width)", x, _WIDTHS, _SHAPED)
    yield from _wide(f"{r}*exp(-abs({p})/width)", x, _WIDTHS, _SHAPED)
    if x.signed:
        yield from _wide(f"sign_above({p}, width)/{x.size:g}", x, _LIMITS, _SHAPED)
        grown = f"(exp({p}/width) - exp(-{p}/width))/(exp({x.size:g}/width) - exp(-{x.size:g}/width))"
        yield from _wide(grown, x, (0.15, 0.3, 0.6), _SHAPED, 0.05)
    yield from _periodic(x)


def _periodic(x: Quantity) -> Iterator[Term]:
    p = x.text
    if x.kind == "position" and x.high > x.low:
        for waves in _WAVES:
            pitch = (x.high - x.low) / float(waves)
            shapes = {"pitch": Shape(pitch, 0.8 * pitch, 1.25 * pitch, x.unit)}
            for f in ("sin", "cos"):
                yield Term(f"{f}(6.283185307179586*{p}/pitch)", _SHAPED, x, shapes)
    if x.kind == "angle":
        for turns in _TURNS:
            for f in ("sin", "cos"):
                yield Term(f"{f}({turns:g}*{p})", _SHAPED, x)


def direction_of(x: Quantity) -> str:
    """Return the direction of a speed in Modelica: its sign, but continuous through standstill."""
    return f"tanh({x.text}/{_DIRECTION * x.size:g})"


def _wide(text: str, x: Quantity, widths: Iterable[float], rank: int, least: float = 0.02) -> Iterator[Term]:
    """Yield a term for each width, as a share of what `x` reaches."""
    if "sign_above" in text:  # the part beyond a dead zone, with its sign
        p = x.text
        text = text.replace(f"sign_above({p}, width)", f"({p} - max(min({p}, width), -width))")
    for share in widths:
        yield Term(text, rank, x, {"width": Shape(share * x.size, least * x.size, 3.0 * x.size, x.unit)})


def _of_input(u: Quantity) -> Iterator[Term]:
    r = u.ratio
    yield Term(r, _PLAIN, u)
    yield Term(f"{r}*abs({r})", _PLAIN, u)
    yield Term(f"{r}^3", _PLAIN, u)
    if u.signed:
        yield Term(f"abs({r})", _PLAIN, u)
        yield Term(f"{r}^2", _PLAIN, u)


def _of_two(x: Quantity, y: Quantity) -> Iterator[Term]:
    """Yield products of functions of `x`, which may reverse with its sign, and functions of `y`."""
    firsts = [x.ratio, f"{x.ratio}*abs({x.ratio})" if x.signed else f"{x.ratio}^2"]
    firsts = [direction_of(x), *firsts] if x.kind == "speed" else firsts
    seconds = [f"abs({y.ratio})", f"{y.ratio}^2"]
    if y.kind != "flow":
        seconds.append(y.ratio)
    if not y.signed:
        seconds.remove(f"abs({y.ratio})")
    for a in firsts:
        for b in seconds:
            yield Term(f"{a}*{b}", _TWO, x)


def _with_state(x: Quantity, y: Quantity, time: Sequence[FloatArray]) -> Iterator[Term]:
    """Yield terms with a state that lags or accumulates a function of `y`, alone or times a function of `x`."""
    shortest = 5.0 * min(float(np.mean(np.diff(t))) for t in time)
    longest = max(float(t[-1] - t[0]) for t in time)
    firsts = [direction_of(x), x.ratio] if x.kind == "speed" else [x.ratio]
    heats = [f"{y.ratio}^2", f"abs({y.ratio})"] if y.signed else [f"{y.ratio}^2", y.ratio]
    for heat in heats:
        alone = [f"{HIDDEN}"] if x == y else []
        for text in (*alone, *(f"{a}*{HIDDEN}" for a in firsts)):
            for lag in np.geomspace(2.0 * shortest, 0.5 * longest, _LAGS):
                shapes = {"lag": Shape(float(lag), shortest, 3.0 * longest, "s")}
                yield Term(text, _STATE, x, shapes, f"({heat} - {HIDDEN})/lag")
            yield Term(text, _STATE, x, {}, f"{heat}/{longest:g}")


def table(x: Quantity, knots: FloatArray) -> list[Term]:
    """Return the functions of a quantity that are 1 at one of the knots, 0 at the others, and lines between them.

    Beyond the knots they are constant.
    """
    at = _texts(knots)
    falls = [f"({b} - {x.text})/{d:.12g}" for b, d in zip(at[1:], np.diff(knots), strict=True)]
    rises = [f"({x.text} - {a})/{d:.12g}" for a, d in zip(at, np.diff(knots), strict=False)]
    sides = zip(["1", *rises], [*falls, "1"], strict=True)
    return [Term(f"max(0, min({rise}, {fall}))", _PLAIN, x) for rise, fall in sides]


def ramps(x: Quantity, knots: FloatArray) -> list[Term]:
    """Return a constant and the functions of a quantity that rise from 0 to 1 between two of the knots.

    A table is their sum; its sizes are its first value and its increments, which have one sign if it is monotone.
    """
    at = _texts(knots)
    rises = (f"max(0, min(1, ({x.text} - {a})/({b} - {a})))" for a, b in pairwise(at))
    return [Term(text, _PLAIN, x) for text in ("1", *rises)]


def _texts(knots: FloatArray) -> list[str]:
    return [f"({k:.12g})" if k < 0.0 else f"{k:.12g}" for k in knots]
