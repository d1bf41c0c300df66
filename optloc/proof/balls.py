"""Balls that hold all points at which one node lies in an interval."""

from __future__ import annotations

from math import sqrt

from optloc.kernels.jit import compiled
from optloc.models.primitives import WGS84_A
from optloc.proof.nodes import HEIGHT, RANGE, RATIO
from optloc.types import Array


@compiled
def around_node(
    kind: int, data: Array, least: float, most: float, x: Array, back: Array, lower: Array, upper: Array
) -> None:
    """Clip a box of search coordinates by all points at which a node lies between `least` and `most`.

    A range gives a ball around its station. Points with ``r_a <= q r_b``, q < 1, fill the ball of Apollonius. A
    geodetic height is at least the distance from the Earth's centre less the equatorial radius. Angles bound nothing.

    Parameters
    ----------
    kind, data : int, array (width,)
        The node.
    least, most : float
        Its interval.
    x, back : array (3,), (3, 3)
        Origin of the search coordinates, and their derivative with respect to the position.
    lower, upper : array (3,)
        Corners of the box, clipped in place.
    """
    c0, c1, c2, radius = data[0], data[1], data[2], most
    if kind == RATIO:
        q = most if most < 1.0 else (1.0 / least if least > 1.0 else 1.0)
        if not q * q < 1.0 - 1e-9:
            return
        near, far = (0, 3) if most < 1.0 else (3, 0)
        q = max(q, 0.0)
        scale = 1.0 / (1.0 - q * q)
        c0 = (data[near] - q * q * data[far]) * scale
        c1 = (data[near + 1] - q * q * data[far + 1]) * scale
        c2 = (data[near + 2] - q * q * data[far + 2]) * scale
        p0, p1, p2 = data[0] - data[3], data[1] - data[4], data[2] - data[5]
        radius = q * sqrt(p0 * p0 + p1 * p1 + p2 * p2) * scale
    elif kind == HEIGHT:
        c0 -= data[6] * data[3] + data[9] * data[4] + data[12] * data[5]
        c1 -= data[7] * data[3] + data[10] * data[4] + data[13] * data[5]
        c2 -= data[8] * data[3] + data[11] * data[4] + data[14] * data[5]
        radius = WGS84_A + most
    elif kind != RANGE:
        return
    radius = max(radius, 0.0) * (1.0 + 1e-9)
    c0, c1, c2 = c0 - x[0], c1 - x[1], c2 - x[2]
    for k in range(3):
        b0, b1, b2 = back[k, 0], back[k, 1], back[k, 2]
        centre = b0 * c0 + b1 * c1 + b2 * c2
        reach = radius * sqrt(b0 * b0 + b1 * b1 + b2 * b2) + 1e-9 * abs(centre)
        lower[k], upper[k] = max(lower[k], centre - reach), min(upper[k], centre + reach)
