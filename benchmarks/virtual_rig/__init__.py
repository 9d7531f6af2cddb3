"""A virtual test rig of the actuator, sharing no code with the FMUs: own equations and integrator, in C."""

from benchmarks.virtual_rig.library import Channel, ParameterInfo, parameter_table
from benchmarks.virtual_rig.recorder import Sensors, record
from benchmarks.virtual_rig.rig import Rig, Run

__all__ = ["Channel", "ParameterInfo", "Rig", "Run", "Sensors", "parameter_table", "record"]
