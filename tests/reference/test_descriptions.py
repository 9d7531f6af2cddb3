"""Model descriptions of the shipped models: schema, legal combinations, units, and a structure that is true."""

from __future__ import annotations

import zipfile
from functools import cache
from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from lxml import etree

from fmu_build import compile_modelica
from fmu_build.model_description import derivatives, model_description
from tests.conftest import ACTUATOR, MODELICA, SETUPS

SCHEMAS = Path(fmpy.__file__).parent / "schema"


@cache
def compiled(name: str):
    return compile_modelica(MODELICA / "Drives" / "Setups" / f"{name}.mo", f"Drives.Setups.{name}")


@pytest.mark.parametrize("name", SETUPS)
def test_valid(fmus, effect_fmus, name):
    """The XML schema, start values, causality with variability and `initial`, units, the ModelStructure."""
    for built in (fmus, effect_fmus) if name in ACTUATOR else (fmus,):
        assert validate_fmu(str(built[name])) == []


@pytest.mark.slow
def test_valid_in_fmi_3(fmi3_fmus, tmp_path):
    for path in fmi3_fmus.values():
        assert validate_fmu(str(path)) == []
        schema = etree.XMLSchema(etree.parse(SCHEMAS / "fmi3" / "fmi3BuildDescription.xsd"))
        with zipfile.ZipFile(path) as archive:
            build = etree.fromstring(archive.read("sources/buildDescription.xml"))
            names = set(archive.namelist())
        schema.assertValid(build)
        assert {f"sources/{e.get('name')}" for e in build.iter("SourceFile")} <= names


@pytest.mark.parametrize("name", ["EccentricLoad", "LinearAxisClosedLoop"])
def test_dependencies_are_true(name):
    """What is not named does not matter, and factors said to be constant or fixed are."""
    model = compiled(name)
    f, rng = model.functions, np.random.default_rng(3)
    p = np.array(
        [
            v.start * (1 + 0.1 * rng.uniform()) or 0.01
            for v in model.variables
            if v.location.vector == "p" and v.start is not None
        ]
    )
    d = np.array(f["dependent"](p)).ravel()
    known = {v.name: v.location for v in model.variables if v.derivative_of is None and v.location.sign == 1}
    states = [v.derivative_of for v in derivatives(model)]
    inputs = [v.name for v in model.variables if v.causality == "input"]
    unknowns = [v for v in model.variables if v.depends_on is not None and v.location.vector in ("dx", "v")]
    assert {v.name for v in unknowns} >= {v.name for v in derivatives(model)}
    slopes = []
    for _ in range(4):
        x, u = rng.normal(size=model.n_x), rng.normal(size=model.n_u)
        rows = []
        for column in np.eye(model.n_x + model.n_u):
            sx, su = column[: model.n_x], column[model.n_x :]
            seeds = (0.0, x, u, p, d, [], [], [], [], sx, su, np.zeros(model.n_p), np.zeros(model.n_d), [])
            rows.append([np.array(f[n](*seeds)).ravel() for n in ("partials", "variable_partials")])
        slopes.append(
            [[row[["dx", "v"].index(v.location.vector)][v.location.index] for row in rows] for v in unknowns]
        )
    slopes = np.array(slopes)  # point, unknown, state or input
    order = [None] * (model.n_x + model.n_u)
    for n in (*states, *inputs):
        order[known[n].index + (model.n_x if n in inputs else 0)] = n
    counts = {"constant": 0, "fixed": 0, "dependent": 0}
    for i, v in enumerate(unknowns):
        kinds = dict(zip(v.depends_on, v.dependency_kinds, strict=True))
        for j, n in enumerate(order):
            here = slopes[:, i, j]
            if n not in kinds:
                assert not here.any(), (v.name, n)
            else:
                counts[kinds[n]] += 1
                if kinds[n] != "dependent":
                    assert np.ptp(here) == 0, (v.name, n)
    assert min(counts.values()) > 0


def test_units_have_their_base_units():
    """N.m = kg.m2/s2, with rad as FMI counts it."""
    text = model_description(compiled("EccentricLoad"), "{0}", [], 2)
    units = {u.get("name"): dict(u.find("BaseUnit").attrib) for u in etree.fromstring(text.encode()).iter("Unit")}
    assert units["N.m"] == {"kg": "1", "m": "2", "s": "-2"}
    assert units["rad/s"] == {"s": "-1", "rad": "1"}
    assert units["N.m/A"] == {"kg": "1", "m": "2", "s": "-2", "A": "-1"}
    assert units["kg.m2"] == {"kg": "1", "m": "2"}
    assert all(units.values()) or {n for n, b in units.items() if not b} <= {"1"}
