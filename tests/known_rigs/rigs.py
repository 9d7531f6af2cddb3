"""The home rigs, on which rules of the diagnosis were developed."""

from __future__ import annotations

from tests.known_rigs.belt_axis import BELT_AXIS
from tests.known_rigs.circuit import CIRCUIT
from tests.known_rigs.plant import Rig
from tests.known_rigs.tanks import TANKS
from tests.known_rigs.thermal_block import THERMAL_BLOCK

FOUND_ON: tuple[Rig, ...] = (BELT_AXIS, THERMAL_BLOCK, CIRCUIT, TANKS)
