"""The rigs that rules may be found on."""

from __future__ import annotations

from benchmarks.abroad.belt_axis import BELT_AXIS
from benchmarks.abroad.circuit import CIRCUIT
from benchmarks.abroad.plant import Rig
from benchmarks.abroad.tanks import TANKS
from benchmarks.abroad.thermal_block import THERMAL_BLOCK

FOUND_ON: tuple[Rig, ...] = (BELT_AXIS, THERMAL_BLOCK, CIRCUIT, TANKS)
