"""A box around all points that several stations see in directions close to those of the fix."""

from __future__ import annotations

from math import cos, hypot, pi, sin, sqrt

import numpy as np

from optloc.kernels.jit import compiled, zero
from optloc.proof.linear3 import inverse
from optloc.proof.nodes import AZIMUTH, ELEVATION
from optloc.types import Array


@compiled
def around_rays(kinds: Array, data: Array, x: Array, back: Array, swing: Array, lower: Array, upper: Array) -> None:
    """Clip a box of search coordinates by angles that differ little from those at the fix.

    With n the horizontal and v the other unit vector across the direction from a station to the fix, a point at
    distance r whose azimuth and elevation differ by at most a and e obeys ``|n.(x - x^)| <= r sin a`` and
    ``|v.(x - x^)| <= r (sin e + 1 - cos a)``. With r at most the fix's distance plus ``y = |x - x^|`` and a left
    inverse of these rows, y is bounded first, then each coordinate.

    Parameters
    ----------
    kinds, data : array (J,), (J, width)
        The nodes.
    x, back : array (3,), (3, 3)
        The fix, and the derivative of the search coordinates with respect to the position.
    swing : array (J,)
        How far each angle may be from its value at the fix, radians; infinite where it is not known.
    lower, upper : array (3,)
        Corners of the box, clipped in place.
    """
    J = kinds.shape[0]
    rows, reach, far = np.empty((J, 3)), np.empty(J), np.empty(J)
    count = zero()
    for j in range(J):
        if kinds[j] == AZIMUTH and swing[j] < 0.5 * pi:
            count = _add_azimuth(data[j], x, sin(swing[j]), rows, reach, far, count)
        elif kinds[j] == ELEVATION and swing[j] < 0.5 * pi:
            turn = _azimuth_beside(kinds, data, swing, j)
            if turn < 0.5 * pi:
                count = _add_elevation(data[j], x, sin(swing[j]) + 1.0 - cos(turn), rows, reach, far, count)
    gamma = np.empty((3, max(count, 1)))
    if not _weighted_inverse(rows, reach, far, count, back, gamma):
        return
    steep, most = 0.0, 0.0
    for i in range(count):
        size = sqrt(gamma[0, i] ** 2 + gamma[1, i] ** 2 + gamma[2, i] ** 2) * reach[i]
        steep += size
        most += size * far[i]
    if not steep < 1.0 - 1e-9:
        return
    most /= 1.0 - steep
    for k in range(3):
        wide = 0.0
        for i in range(count):
            pull = abs(back[k, 0] * gamma[0, i] + back[k, 1] * gamma[1, i] + back[k, 2] * gamma[2, i])
            wide += pull * reach[i] * (far[i] + most)
        wide *= 1.0 + 1e-6
        lower[k], upper[k] = max(lower[k], -wide), min(upper[k], wide)


@compiled
def _azimuth_beside(kinds: Array, data: Array, swing: Array, j: int) -> float:
    """Return how far the azimuth may swing that the station of elevation j measures, pi if there is none."""
    least = pi
    for m in range(kinds.shape[0]):
        if kinds[m] == AZIMUTH:
            same = True
            for k in range(15):
                same = same and data[m, k] == data[j, k]
            if same:
                least = min(least, swing[m])
    return least


@compiled
def _local(data: Array, x: Array) -> tuple[float, float, float]:
    """Return the line from station to fix in the station's axes."""
    a, b, c = x[0] - data[0], x[1] - data[1], x[2] - data[2]
    return (
        data[6] * a + data[7] * b + data[8] * c,
        data[9] * a + data[10] * b + data[11] * c,
        data[12] * a + data[13] * b + data[14] * c,
    )


@compiled
def _add_azimuth(data: Array, x: Array, width: float, rows: Array, reach: Array, far: Array, count: int) -> int:
    p, q, r = _local(data, x)
    flat = hypot(p, q)
    if flat > 0.0:
        for k in range(3):
            rows[count, k] = (p * data[9 + k] - q * data[6 + k]) / flat
        reach[count], far[count] = width, hypot(flat, r)
        count += 1
    return count


@compiled
def _add_elevation(data: Array, x: Array, width: float, rows: Array, reach: Array, far: Array, count: int) -> int:
    p, q, r = _local(data, x)
    flat = hypot(p, q)
    whole = hypot(flat, r)
    if flat > 0.0:
        for k in range(3):
            outward = (p * data[6 + k] + q * data[9 + k]) / flat
            rows[count, k] = (flat * data[12 + k] - r * outward) / whole
        reach[count], far[count] = width, whole
        count += 1
    return count


@compiled
def _weighted_inverse(rows: Array, reach: Array, far: Array, count: int, back: Array, gamma: Array) -> bool:
    """Write the left inverse of rows weighted by their widths; False where they do not determine a position."""
    solve, normal = np.empty((3, 3)), np.zeros((3, 3))
    for i in range(count):
        weight = 1.0 / (reach[i] * far[i]) ** 2 if reach[i] * far[i] > 0.0 else 0.0
        for k in range(3):
            for m in range(3):
                normal[k, m] += weight * rows[i, k] * rows[i, m]
    plane = back[2, 0] == 0.0 and back[2, 1] == 0.0 and back[2, 2] == 0.0
    if plane:
        normal[2, 2] = 1.0
    size = normal[0, 0] + normal[1, 1]
    if not size > 0.0 or not inverse(
        normal[0, 0], normal[0, 1], normal[0, 2], normal[1, 1], normal[1, 2], normal[2, 2], solve
    ):
        return False
    for i in range(count):
        weight = 1.0 / (reach[i] * far[i]) ** 2 if reach[i] * far[i] > 0.0 else 0.0
        for k in range(3):
            gamma[k, i] = weight * (solve[k, 0] * rows[i, 0] + solve[k, 1] * rows[i, 1] + solve[k, 2] * rows[i, 2])
    return _inverts(gamma, rows, count, plane)


@compiled
def _inverts(gamma: Array, rows: Array, count: int, plane: bool) -> bool:
    """Return whether gamma times rows is the identity up to a small rounding."""
    for k in range(2 if plane else 3):
        for m in range(3):
            total = 0.0
            for i in range(count):
                total += gamma[k, i] * rows[i, m]
            if not abs(total - (k == m)) < 1e-7:
                return False
    return True
