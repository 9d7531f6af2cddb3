"""The model as a graph of its components, with the place of the gap marked."""

from __future__ import annotations

import re
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

from fmu_build import load
from fmuid.report.model_graph import drawing, graph_of

BENCH = Path(str(files("fmuid.demo").joinpath("Bench.mo")))


def test_components_inputs_and_outputs_are_linked_as_the_model_connects_them() -> None:
    graph = graph_of(load(BENCH, "Bench.Drive"))
    assert [(p.name, p.kind) for p in graph.parts.values()] == [
        ("tau", "input"),
        ("motor", "Motor"),
        ("rotor", "Inertia"),
        ("shaft", "Shaft"),
        ("load", "Inertia"),
        ("w_motor", "output"),
        ("w_load", "output"),
    ]
    train = {("motor", "tau"), ("motor", "rotor"), ("rotor", "shaft"), ("load", "shaft")}
    assert graph.links == train | {("rotor", "w_motor"), ("load", "w_load")}


def test_the_place_of_the_gap_is_framed_and_said() -> None:
    picture = drawing(graph_of(load(BENCH, "Bench.Drive")), ["load"])
    assert picture is not None
    assert "where the gap enters (load)" in picture.caption
    ElementTree.fromstring(picture.svg)
    framed = re.findall(r'stroke-width="4"/><text[^>]*>(\w+)</text>', picture.svg)
    assert framed == ["load"]
    plain = drawing(graph_of(load(BENCH, "Bench.Drive")), [])
    assert plain is not None
    assert 'stroke-width="4"' not in plain.svg


def test_a_model_of_equations_alone_has_no_picture(tmp_path: Path) -> None:
    file = tmp_path / "Decay.mo"
    file.write_text("model Decay\n  input Real u;\n  output Real x;\nequation\n  der(x) = u - x;\nend Decay;\n")
    assert drawing(graph_of(load(file, "Decay")), ["x"]) is None


def test_a_component_is_placed_beside_those_that_it_is_connected_to(tmp_path: Path) -> None:
    """A long chain branches off, and goes on where it left the others."""
    file = tmp_path / "Tree.mo"
    chain = [f"c{k}" for k in range(7)]
    lines = [
        "package P",
        "connector Pin Real v; flow Real i; end Pin;",
        "model Part Pin p; Pin n; equation p.i + n.i = 0; p.v - n.v = p.i; end Part;",
        "model Tree",
        *(f"Part {name};" for name in ["root", "side", *chain]),
        "equation",
        "root.p.v = 1;",
        "connect(root.n, side.p);",
        "connect(root.n, c0.p);",
        "side.n.v = 0;",
        *(f"connect({a}.n, {b}.p);" for a, b in pairwise(chain)),
        "c6.n.v = 0;",
        "end Tree;",
        "end P;",
    ]
    file.write_text("\n".join(lines))
    picture = drawing(graph_of(load(file, "P.Tree")), [])
    assert picture is not None
    boxes = re.findall(r'<rect x="(\d+)" y="(\d+)"[^>]*/><text[^>]*>(\w+)</text>', picture.svg)
    column = {name: x for x, _, name in boxes}
    assert column["side"] != column["c0"]
    assert {column[name] for name in chain} == {column["c0"]}
