"""The model as connected components, with the place marked where the gap enters."""

from __future__ import annotations

import html
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from fmu_build.flat_model import FlatModel, flat_name
from fmu_build.model_ports import find_ports
from fmu_build.syntax import Reference, references
from fmuid.report.document import Drawing

_BOX, _GAP = (132, 40), (44, 26)  # width and height, px
_ACROSS = 4  # layers that fit side by side on a phone; further layers go downwards
_MOST = 40  # largest number of parts that can still be read


@dataclass(frozen=True, slots=True)
class Part:
    """A component, an input or an output, and the name of its class."""

    name: str
    kind: str


@dataclass(frozen=True, slots=True)
class ModelGraph:
    """Components, inputs and outputs of a model, and which of them are connected.

    Attributes
    ----------
    parts
        Parts by name, in the order of their declarations.
    links
        Pairs of names.
    ports
        Names of parts by port.
    """

    parts: dict[str, Part]
    links: frozenset[tuple[str, str]]
    ports: dict[str, tuple[str, ...]]


def graph_of(flat: FlatModel) -> ModelGraph:
    """Return the components that a model declares itself, with its inputs and outputs."""
    parts = {v.name: Part(v.name, v.causality) for v in flat.variables.values() if v.causality == "input"}
    parts |= {
        c.path: Part(c.path, c.class_name.rpartition(".")[2])
        for c in flat.components.values()
        if c.path and not c.parent and c.path not in parts
    }
    parts |= {v.name: Part(v.name, v.causality) for v in flat.variables.values() if v.causality == "output"}
    links = set()
    for equation in flat.equations:
        if equation.origin.kind == "potential":
            links.add(_pair(_parts_of(equation.origin.connectors, parts)))
        elif equation.origin.component == "" and equation.origin.kind in ("class", "binding"):
            used = [*references(equation.left), *references(equation.right)]
            links.add(_pair(_parts_of((flat_name(n) for n in used if isinstance(n, Reference)), parts)))
    linked = {name for pair in links if pair for name in pair}
    linked_parts = {n: p for n, p in parts.items() if n in linked}
    ports = {p.name: tuple(dict.fromkeys(_parts_of(p.connectors, linked_parts))) for p in find_ports(flat)}
    return ModelGraph(linked_parts, frozenset(pair for pair in links if pair is not None), ports)


def drawing(graph: ModelGraph, ports: Collection[str]) -> Drawing | None:
    """Return the picture of a model with `ports` marked; None if there is nothing to show, or too much."""
    beside = _beside(graph)
    layers = _layers(beside)
    components = [part for part in graph.parts.values() if part.kind not in ("input", "output")]
    if not components or not 2 <= len(graph.parts) <= _MOST:
        return None
    marked = {part for port in ports for part in graph.ports.get(port, (port,))} & graph.parts.keys()
    across = len(layers) <= _ACROSS
    place = {}
    for name, (i, k) in _slots(layers, beside).items():
        column, row = (i, k) if across else (k, i)
        place[name] = column * (_BOX[0] + _GAP[0]), row * (_BOX[1] + _GAP[1])
    width = max(x for x, _ in place.values()) + _BOX[0]
    height = max(y for _, y in place.values()) + _BOX[1]
    lines = [_line(place[a], place[b]) for a, b in sorted(graph.links)]
    boxes = [_box(part, place[part.name], marked=part.name in marked) for part in graph.parts.values()]
    svg = (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="model" viewBox="-3 -3 {width + 6} {height + 6}" '
        f'width="{width + 6}" height="{height + 6}" font-family="sans-serif" role="img" '
        f'aria-label="components of the model">{"".join(lines)}{"".join(boxes)}</svg>'
    )
    names = ", ".join(sorted(marked))
    note = f" Framed: where the gap enters ({names})." if marked else ""
    return Drawing("model", "The model", svg, f"Components of the model and what connects them.{note}")


def _parts_of(names: Iterable[str], parts: Collection[str]) -> list[str]:
    """Return the parts that variables or connectors belong to."""
    heads = ((name, name.partition(".")[0].partition("[")[0]) for name in names)
    return [name if name in parts else head for name, head in heads if name in parts or head in parts]


def _pair(names: Sequence[str]) -> tuple[str, str] | None:
    """Return two different names in their order; None if there are not two."""
    different = sorted(set(names))
    return (different[0], different[1]) if len(different) == 2 else None


def _beside(graph: ModelGraph) -> dict[str, set[str]]:
    """Return the parts that each part is connected to."""
    beside: dict[str, set[str]] = {name: set() for name in graph.parts}
    for a, b in graph.links:
        beside[a].add(b)
        beside[b].add(a)
    return beside


def _layers(beside: Mapping[str, set[str]]) -> list[list[str]]:
    """Return the parts grouped by distance from the first, which is an input if there is one."""
    layers: list[list[str]] = []
    left = dict.fromkeys(beside)
    while left:
        reached, depth = [next(iter(left))], 0
        while reached:
            for name in reached:
                left.pop(name)
            if depth == len(layers):
                layers.append([])
            layers[depth] += reached
            near = {other for name in reached for other in beside[name]}
            reached, depth = [name for name in left if name in near], depth + 1
    return layers


def _slots(layers: Sequence[Sequence[str]], beside: Mapping[str, set[str]]) -> dict[str, tuple[int, int]]:
    """Return the layer of each part and its place there, near those that it is connected to in earlier ones."""
    widest = max(map(len, layers), default=0)
    slots: dict[str, tuple[int, int]] = {}
    for i, layer in enumerate(layers):
        near = {name: [slots[other][1] for other in beside[name] if other in slots] for name in layer}
        above = {name: _mean(near[name]) for name in layer}
        wanted = {name: _mean([*near[name], *(above[n] for n in beside[name] & above.keys())]) for name in layer}
        least = 0
        for k, name in enumerate(sorted(layer, key=wanted.__getitem__)):
            slot = min(max(round(wanted[name]), least), widest - len(layer) + k)
            slots[name], least = (i, slot), slot + 1
    return slots


def _mean(numbers: Sequence[float]) -> float:
    return fmean(numbers) if numbers else 0.0  # whatever their order


def _line(a: tuple[int, int], b: tuple[int, int]) -> str:
    (x1, y1), (x2, y2) = ((x + _BOX[0] / 2, y + _BOX[1] / 2) for x, y in (a, b))
    return f'<line x1="{x1:g}" y1="{y1:g}" x2="{x2:g}" y2="{y2:g}" stroke="#888" stroke-width="1.5"/>'


def _box(part: Part, place: tuple[int, int], *, marked: bool) -> str:
    x, y = place
    frame = 'stroke="#d55e00" stroke-width="4"' if marked else 'stroke="#888" stroke-width="1"'
    signal = part.kind in ("input", "output")
    shape = f'rx="{_BOX[1] / 2:g}"' if signal else 'rx="3"'
    text = f'x="{x + _BOX[0] / 2:g}" text-anchor="middle" fill="#222"'
    return (
        f'<rect x="{x}" y="{y}" width="{_BOX[0]}" height="{_BOX[1]}" {shape} fill="white" {frame}/>'
        f'<text {text} y="{y + 17}" font-size="13" font-weight="600">{_short(part.name)}</text>'
        f'<text {text} y="{y + 32}" font-size="12" fill-opacity="0.7">{_short(part.kind)}</text>'
    )


def _short(text: str) -> str:
    return html.escape(text if len(text) <= 18 else f"{text[:17]}…")
