"""Units of the parameters that effects of a signal have."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np

from fmu_build.flat_model import variable
from fmu_build.model_ports import Port
from fmuid.campaigns.signal_catalogue import RecordedSetup, signal_catalogue
from fmuid.core.campaign import ModelSpec
from fmuid.core.experiments import Experiment, Signal
from fmuid.effects.laws import SIZES, Place, effect_lines, fitting
from fmuid.simulation.simulator import Variable


def units(text: str) -> dict[str, list[str]]:
    """Law -> units of its parameters, of a catalogue for one signal."""
    effects = tomllib.loads(text)["effects"]
    return {id.partition("@")[0]: [p["unit"] for p in e["parameters"].values()] for id, e in effects.items()}


def test_effects_of_a_recorded_signal_have_its_units():
    time = np.arange(50) * 0.1
    runs = [Experiment("run", "bench", time, {"F": Signal("F", np.sin(time), "N", "output")})]
    spec = ModelSpec("bench", Path("bench.fmu"))
    units_of = units(signal_catalogue([RecordedSetup(runs, spec, {"F": Variable("F", "output", unit="N")})]))
    assert units_of == {
        "gain": ["1"],
        "offset": ["N"],
        "lag": ["s", "1"],
        "delay": ["s"],
        "saturation": ["1/(N)", "1"],
        "play": ["N"],
        "drift": ["N/s", "1/s"],
    }


def test_laws_at_a_signal_of_the_model_have_its_units():
    quantities = {"p": variable("F"), "rate": variable("dF")}
    place = Place(Port("F", "signal", "signal", ("a.y",), ("N", "1"), quantities), dict.fromkeys(SIZES, 1.0))
    units_of = {n: units("\n".join(effect_lines(n, law, place)))[n] for n, law in fitting(place)}
    assert units_of["gain"] == ["1"]
    assert units_of["offset"] == units_of["dead_zone"] == units_of["play"] == ["N"]
    assert units_of["rate_limit"] == ["s/(N)"]
    assert units_of["saturation"] == ["1/(N)", "1"]
