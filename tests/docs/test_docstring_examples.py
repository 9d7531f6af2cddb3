"""Examples in docstrings run, in a folder with a log and a model."""

from __future__ import annotations

import doctest
import importlib
import inspect
import types
import typing
from pathlib import Path

import numpy as np
import pytest

import fmuid

SOURCES = Path(fmuid.__file__).parent
EXAMPLES = sorted(f for f in SOURCES.rglob("*.py") if ">>> " in f.read_text(encoding="utf-8"))
MODEL = """\
model Tank
  parameter Real C(unit = "J/K") = 4000 "heat capacity";
  parameter Real G(unit = "W/K") = 5 "loss to the room";
  input Real P(unit = "W");
  output Real T(unit = "K", start = 0, fixed = true) "over the temperature of the room";
equation
  C*der(T) = P - G*T;
end Tank;
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tank with C = 5000 J/K and G = 8 W/K, its model, and its campaign ``tank``."""
    folder = tmp_path_factory.mktemp("examples")
    rng, level, rows = np.random.default_rng(3), 0.0, ["time [s],P [W],T [K]"]
    for t in np.arange(0.0, 4000.0, 4.0):
        power = 900.0 * (t % 1600 > 400) + 300.0 * (t % 700 > 500)
        rows.append(f"{t:g},{power:g},{level + 0.05 * rng.standard_normal():.4f}")
        level = power / 8.0 + (level - power / 8.0) * np.exp(-4.0 * 8.0 / 5000.0)
    (folder / "log.csv").write_text("\n".join(rows) + "\n")
    (folder / "Tank.mo").write_text(MODEL)
    fmuid.start(folder / "log.csv", model=folder / "Tank.mo", out=folder / "tank", say=lambda _: None)
    return folder


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda f: f.stem)
def test_the_examples_of_a_module_run(file: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    name = ".".join(file.relative_to(SOURCES.parent).with_suffix("").parts)
    failed, tried = doctest.testmod(importlib.import_module(name), extraglobs={"fmuid": fmuid})
    assert tried > 0
    assert failed == 0


def test_the_types_that_public_functions_return_are_public() -> None:
    returned = set()
    for function in (getattr(fmuid, name) for name in fmuid.__all__):
        if inspect.isfunction(function):
            module = importlib.import_module(function.__module__)
            kind = eval(function.__annotations__["return"], vars(module) | vars(typing), {})
            kinds = typing.get_args(kind) if isinstance(kind, types.UnionType) else (kind,)
            returned |= {k.__name__ for k in kinds if k is not None and k.__module__.startswith("fmuid")}
    assert returned <= set(fmuid.__all__)
