"""Reference FMUs in pure Python: equations written by hand, integrated by SciPy at tight tolerance.

They have the variables of the FMUs built from ``modelica/Drives`` and ``modelica/Pendulum`` and stand in for
them where there is no compiler; FMU outputs are compared with them point by point.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from fmuid.core.errors import FmuError
from fmuid.reference.actuator import eccentric_load, fixed_shaft, free_shaft
from fmuid.reference.linear_axis import linear_axis_closed_loop, linear_axis_open_loop
from fmuid.reference.reference_fmu import Equations, ReferenceFmu
from fmuid.reference.servo_pendulum import position_driven, torque_driven

__all__ = ["MODELS", "ReferenceFmu", "reference_fmu"]

MODELS: Mapping[str, Callable[[], Equations]] = MappingProxyType(
    {
        "FixedShaft": fixed_shaft,
        "FreeShaft": free_shaft,
        "EccentricLoad": eccentric_load,
        "LinearAxisOpenLoop": linear_axis_open_loop,
        "LinearAxisClosedLoop": linear_axis_closed_loop,
        "PositionDriven": position_driven,
        "TorqueDriven": torque_driven,
    }
)


def reference_fmu(name: str, *, tolerance: float = 1e-8, method: str = "LSODA") -> ReferenceFmu:
    """Return a new reference FMU.

    Parameters
    ----------
    name
        Name of the FMU it stands in for, such as ``FixedShaft``.
    tolerance
        Relative tolerance of the integrator.
    method
        Stiff method of ``scipy.integrate.solve_ivp``: ``LSODA``, ``Radau`` or ``BDF``.

    Raises
    ------
    FmuError
        There is no reference of that name.
    """
    try:
        equations = MODELS[name]()
    except KeyError:
        raise FmuError(f"no reference model '{name}'", fix=f"there are {', '.join(MODELS)}") from None
    return ReferenceFmu(equations, tolerance=tolerance, method=method)
