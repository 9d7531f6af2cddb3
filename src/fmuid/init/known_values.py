"""Parameters whose values are known without measuring, and the ranges of those that are not."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable
from pathlib import Path

from fmuid.core.campaign import ModelSource
from fmuid.core.units import conversion, convert_factor, convertible
from fmuid.simulation.simulator import Variable

CONSTANT = "a constant of nature"
MEDIUM = "a property of air or water"
REGULARISATION = "regularises the model"
TABLE = "an entry of a table, or one of many numbered values"
DEFAULT = "a default of the library, which the model does not set"

CERTAIN = (CONSTANT, REGULARISATION, DEFAULT)
"""Reasons for which a diagnosis need not doubt a value either."""

_WITHIN = 10.0  # factor by which parameters may differ from their start values
_KELVINS = 30.0  # by which absolute temperatures may differ from theirs
_COLD, _HOT = 150.0, 2000.0  # K: others are differences of temperature, or activation energies over R
_MANY = 6  # numbered values of one name from which they are a table
# Values and units; models round them, so the last number is the relative tolerance.
_CONSTANTS = (
    (9.80665, "m/s2", 2e-3),
    (8.314462618, "J/(mol.K)", 1e-3),
    (5.670374e-8, "W/(m2.K4)", 1e-3),
    (96485.332, "C/mol", 1e-3),
    (1.380649e-23, "J/K", 1e-3),
    (6.02214076e23, "1/mol", 1e-3),
    (1.602176634e-19, "C", 1e-3),
    (6.62607015e-34, "J.s", 1e-3),
    (299792458.0, "m/s", 1e-3),
    (1.25663706e-6, "H/m", 1e-3),
    (8.8541878e-12, "F/m", 1e-3),
)
_MEDIA = (
    ("kg/m3", 1.0, 1.35),
    ("kg/m3", 950.0, 1030.0),
    ("J/(kg.K)", 1000.0, 1015.0),
    ("J/(kg.K)", 4100.0, 4230.0),
)
_GRAVITY = re.compile(r"g(?:_?n|rav\w*)?|grav\w*", re.IGNORECASE)
_SMOOTHS = re.compile(r"regulari[sz]|smooth|eps(?:ilon)?$|_small$|relfric$|_reg$|^reg_", re.IGNORECASE)
_SMOOTHING = re.compile(r"regulari[sz]|smoothing|\bnumerical\b|steepness|sharpness", re.IGNORECASE)
_RATIO = re.compile(r"ratio|\bteeth\b|\bnumber of\b|\bpole pairs\b|\bturns\b|\bgear(?:ing)?\b", re.IGNORECASE)
_START = re.compile(
    r"(?:_0|_start|_init(?:ial)?|^start_\w+|0)$|\bat the (?:start|beginning)\b|\binitial\b", re.IGNORECASE
)
_DRAWN = ("m", "m2", "m3", "rad")  # units of quantities that a drawing shows
_COMMENTS = re.compile(r'"(?:[^"\\]|\\.)*"|//[^\n]*|/\*.*?\*/', re.DOTALL)
_STANDARD = re.compile(r"(?:Obsolete)?Modelica|Complex")  # the Standard Library and its companions


class ModelText:
    """The text of a model's source without comments and descriptions; empty if the source is unknown.

    It includes libraries in the folders of the source, but not the Modelica Standard Library.
    """

    def __init__(self, source: ModelSource | None = None) -> None:
        files = [] if source is None else _files(source)
        self.known = bool(files)
        self._text = _COMMENTS.sub(" ", "\n".join(f.read_text(encoding="utf-8", errors="replace") for f in files))
        self._words = frozenset(re.findall(r"[^\W\d]\w*", self._text))

    def mentions(self, name: str) -> bool:
        """Return whether an identifier occurs anywhere."""
        return name in self._words

    def only_smooths(self, name: str) -> bool:
        """Return whether a parameter is only used to scale the argument of tanh, atan or erf."""
        word = re.escape(name)
        declared = len(re.findall(rf"\bparameter\b[^;]*?\b{word}\b(?=\s*(?:\(|=|;))", self._text))
        uses = len(re.findall(rf"\b{word}\b", self._text)) - declared
        inside = rf"\b(?:tanh|atan|erf)\s*\((?:[^();]|\([^();]*\))*/\s*{word}\b"
        return uses > 0 and len(re.findall(inside, self._text)) == uses


def why_known(parameter: Variable, text: ModelText, tables: Collection[str] = ()) -> str | None:
    """Return why the value of a parameter is known without measuring, None if it is not.

    `tables` are the names from `table_entries`.
    """
    name, start = _last(parameter.name), parameter.start or 0.0
    if parameter.name in tables:
        return TABLE
    if any(_is(parameter, value, unit, tolerance) for value, unit, tolerance in _CONSTANTS) or (
        not parameter.unit and _GRAVITY.fullmatch(name) and abs(abs(start) - 9.8) < 0.03
    ):
        return CONSTANT
    if any(low <= start <= high and parameter.unit and convertible(parameter.unit, u) for u, low, high in _MEDIA):
        return MEDIUM
    if _SMOOTHS.search(name) or _SMOOTHING.search(parameter.description) or text.only_smooths(name):
        return REGULARISATION
    if text.known and "." in parameter.name and not text.mentions(name):
        return DEFAULT
    return None


def table_entries(parameters: Iterable[Variable]) -> frozenset[str]:
    """Return the names of elements of matrices, and of many values that differ by a number in their names."""
    names = [v.name for v in parameters]
    stems = {n: re.sub(r"\d+", "#", n) for n in names}
    count = Counter(stems.values())
    return frozenset(n for n in names if "," in n or (stems[n] != n and count[stems[n]] >= _MANY))


def is_drawn(parameter: Variable) -> bool:
    """Return whether a drawing shows a parameter: a length, an area, a volume, an angle or a gear ratio.

    Start values, coefficients without a unit and elements of tables, such as the efficiencies in a gear's loss
    table, are none of these.
    """
    words = f"{_last(parameter.name)} {parameter.description}"
    if "," in parameter.name or _START.search(_last(parameter.name)) or _START.search(parameter.description):
        return False
    if not parameter.unit or parameter.unit == "1":
        return bool(_RATIO.search(words))
    return any(convertible(parameter.unit, unit) for unit in _DRAWN)


def is_temperature(parameter: Variable) -> bool:
    """Return whether a parameter is an absolute temperature."""
    unit = parameter.unit
    if not unit or not convertible(unit, "K"):
        return False
    return unit != "K" or _COLD <= (parameter.start or 0.0) <= _HOT


def guessed_bounds(parameter: Variable, within: float = _WITHIN) -> tuple[float, float]:
    """Return the bounds of a free parameter: a factor `within`, or 30 K around an absolute temperature."""
    start = parameter.start or 0.0
    if is_temperature(parameter):
        width = _KELVINS / conversion(parameter.unit or "K", "K").factor
        low, high = start - width, start + width
    else:
        low, high = (start / within, start * within) if start > 0 else (start * within, -start * within)
    low = max(low, parameter.min if parameter.min is not None else low)
    high = min(high, parameter.max if parameter.max is not None else high)
    return low, high


def plausible_change(parameter: Variable) -> float:
    """Return how far a parameter may be off, relative to its value: 1 except for absolute temperatures."""
    start = abs(parameter.start or 0.0)
    low, high = guessed_bounds(parameter)
    return min(1.0, 0.5 * (high - low) / start) if is_temperature(parameter) and start else 1.0


def _last(name: str) -> str:
    return re.sub(r"\[.*\]$", "", name.rpartition(".")[2])


def _is(parameter: Variable, value: float, unit: str, tolerance: float) -> bool:
    if not parameter.unit or not parameter.start or not convertible(parameter.unit, unit):
        return False
    return abs(abs(parameter.start) * convert_factor(parameter.unit, unit) - value) <= tolerance * value


def _files(source: ModelSource) -> list[Path]:
    files = source.file.parent.rglob("*.mo") if source.file.name == "package.mo" else [source.file]
    places = (place for root in source.roots for place in root.iterdir() if not _STANDARD.match(place.name))
    library = [path for place in places for path in ([place] if place.suffix == ".mo" else place.rglob("*.mo"))]
    return [path for path in (*files, *library) if path.is_file()]
