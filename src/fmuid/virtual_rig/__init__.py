"""A virtual test rig of the actuator, sharing no code with the FMUs: own equations and integrator, in C."""

from fmuid.virtual_rig.library import Channel, ParameterInfo, parameter_table
from fmuid.virtual_rig.recording import Sensors, record
from fmuid.virtual_rig.rig import Rig, Run

__all__ = ["Channel", "ParameterInfo", "Rig", "Run", "Sensors", "parameter_table", "record"]
