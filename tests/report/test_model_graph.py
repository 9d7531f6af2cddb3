"""The model as a graph of its components, with the place of the gap marked."""

from __future__ import annotations

import re
from importlib.resources import files
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
    file.write_text(
        "model Decay\n  output Real x(start = 1, fixed = true);\nequation\n  der(x) = -x;\nend Decay;\n"
    )
    assert drawing(graph_of(load(file, "Decay")), ["x"]) is None
