"""The home rigs, on which rules of the diagnosis were developed."""

from __future__ import annotations

from benchmarks.rigs.belt_axis import BELT_AXIS
from benchmarks.rigs.circuit import CIRCUIT
from benchmarks.rigs.plant import Rig
from benchmarks.rigs.tanks import TANKS
from benchmarks.rigs.thermal_block import THERMAL_BLOCK

FOUND_ON: tuple[Rig, ...] = (BELT_AXIS, THERMAL_BLOCK, CIRCUIT, TANKS)
