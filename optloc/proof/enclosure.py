"""A box around all points that cost less than a level, from the measurements alone."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from optloc.kernels.jit import compiled
from optloc.proof.balls import around_node
from optloc.proof.convex import FORCE
from optloc.proof.groups import LOOSE, Groups
from optloc.proof.nodes import AZIMUTH, ELEVATION
from optloc.proof.rays import around_rays
from optloc.proof.squares import ERROR, SLACK, SWING, TIE_WIDTH, around_squares
from optloc.types import Array


@compiled
def enclose(
    kinds: Array,
    data: Array,
    A: Array,
    groups: Groups,
    nodes: Array,
    curves: Array,
    x: Array,
    sense: Array,
    back: Array,
    rho: float,
    lower: Array,
    upper: Array,
) -> bool:
    """Enclose all points with ``|K phi(x) - w| <= rho`` in a box of search coordinates around a fix.

    Within a group of nodes (`optloc.proof.groups`) the errors obey ``|m.e| <= rho sqrt(m'R m)`` for every m. Ranges and
    linear forms are squared to equations linear in position and one more unknown; other nodes give balls of their own.

    Parameters
    ----------
    kinds, data : array (J,), (J, width)
        The nodes.
    A : array (J, J)
        ``K'K``.
    groups : Groups
        The nodes in groups.
    nodes, curves : array (J, NODE_WIDTH), (J, CURVE_WIDTH)
        Tables of the fix, of which the values of the nodes and the forces ``K'(K phi - w)`` are read.
    x : array (3,)
        The fix.
    sense, back : array (3, 3)
        T with x + T s, and its inverse.
    rho : float
        Square root of the level.
    lower, upper : array (3,)
        Written: corners in search coordinates, infinite where there is no bound.

    Returns
    -------
    bool
        Whether the box is bounded.
    """
    rho, first, angles = rho * (1.0 + SLACK) + SLACK, 0, 0
    order, R, ties = groups.order, groups.R, np.empty((kinds.shape[0], TIE_WIDTH))
    for k in range(3):
        plane = sense[0, k] == 0.0 and sense[1, k] == 0.0 and sense[2, k] == 0.0
        lower[k], upper[k] = (0.0, 0.0) if plane else (-inf, inf)
    ties[:, SWING] = inf
    for number in range(kinds.shape[0]):
        count, reference = order[1, number], order[2, number]
        if count == 0:
            break
        size = count if reference < 0 else count - 1
        own, member = R[first : first + size, first : first + size], order[0, first : first + size]
        first += count
        if reference == LOOSE:
            continue
        for i in range(size):
            j, error = member[i], 0.0
            for m in range(size):
                error += own[i, m] * curves[member[m], FORCE]
            ties[j, ERROR] = error
            if groups.tie[j] == 0.0:
                middle, reach = nodes[j, 0] - error, rho * sqrt(own[i, i])
                ties[j, SWING] = abs(error) + reach
                angles += kinds[j] in (AZIMUTH, ELEVATION)
                around_node(kinds[j], data[j], middle - reach, middle + reach, x, back, lower, upper)
        around_squares(kinds, data, A, nodes, back, rho, member, reference, own, groups.tie, ties, lower, upper)
    if angles:
        around_rays(kinds, data, x, back, ties[:, SWING].copy(), lower, upper)
    bounded = True
    for k in range(3):
        bounded = bounded and -inf < lower[k] <= upper[k] < inf
    return bounded
