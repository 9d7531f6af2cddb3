"""Laws of friction, one evaluation at a time: loss table, sliding torque, bristle."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence

Row = tuple[float, float, float, float]


def loss_table(rows: Sequence[Sequence[float]]) -> Callable[[float], Row]:
    """Return the function |w| -> (eta1, eta2, tau_bf1, tau_bf2) of a loss table.

    Linear between the rows, constant outside them (Table 2 of Peer and others, 2003).

    Parameters
    ----------
    rows
        Rows of |w| in rad/s (strictly increasing), eta1, eta2, tau_bf1 and tau_bf2 in N.m.
    """
    speeds = [row[0] for row in rows]
    values: list[Row] = [(row[1], row[2], row[3], row[4]) for row in rows]
    last = len(rows) - 1

    def losses(speed: float) -> Row:
        k = bisect_right(speeds, speed) - 1
        if k < 0:
            return values[0]
        if k >= last:
            return values[last]
        share = (speed - speeds[k]) / (speeds[k + 1] - speeds[k])
        a, b = values[k], values[k + 1]
        return (
            a[0] + share * (b[0] - a[0]),
            a[1] + share * (b[1] - a[1]),
            a[2] + share * (b[2] - a[2]),
            a[3] + share * (b[3] - a[3]),
        )

    return losses


def sliding_torque(load_torque: float, row: Row, blend: float) -> float:
    """Loss torque in N.m at positive speed, explicit in the load torque T = -tau_F/n.

    Table 1 of the paper with tau_W = T + loss torque: the driving branch where T >= -tau_bf1, the braking
    one below, joined over `blend` (N.m). At negative speed it is ``-sliding_torque(-T, ...)``.
    """
    eta1, eta2, bearing1, bearing2 = row
    if load_torque >= -bearing1:
        return (load_torque + bearing1) / eta1 - load_torque
    braking = eta2 * (load_torque + bearing2) - load_torque
    if load_torque <= -bearing1 - blend:
        return braking
    driving = (load_torque + bearing1) / eta1 - load_torque
    share = 1.0 + (load_torque + bearing1) / blend
    return share * driving + (1.0 - share) * braking


def bristle(rate: float, z: float, damping_time: float, elastic: float) -> tuple[float, float]:
    """Return der(z) and the share of break-away friction of an elasto-plastic bristle.

    Parameters
    ----------
    rate
        Sliding speed over presliding deflection, 1/s.
    z
        Deflection over presliding deflection, in [-1, 1].
    damping_time
        The share is z + damping_time der(z), limited to [-1, 1]; s.
    elastic
        Below this deflection the bristle does not slide at all.
    """
    dz = rate
    wound = abs(z) - elastic
    if wound > 0.0 and z * rate > 0.0:
        dz -= rate * (wound / (1.0 - elastic)) ** 2
    share = z + damping_time * dz
    return dz, -1.0 if share < -1.0 else 1.0 if share > 1.0 else share
