"""Enclosures of a cost with unknown factors that grows without limit: boxes around all positions of low cost.

The cost is ``|sum_g k_g K_g phi + K_0 phi - w|^2`` with factors k_g and nodes phi_j (`optloc.proof.scaled.reduction`).
Group g contains the nodes of factor g; the group -1 has no factor. rho is the root of a level of the cost. Corners
`low` and `high` (3,) are in the search coordinates of `chart`, around the fix x (D,). If a function `_meet_...` returns
False, its method does not apply.
"""

from __future__ import annotations

from math import inf

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, zero
from optloc.kernels.systems import invert
from optloc.proof.box import reaches_infinity
from optloc.proof.enclosure import SLACK, around_node
from optloc.proof.groups import NONE, empty_groups
from optloc.proof.local_search import region_of
from optloc.proof.nodes.node import LOG_RANGE, RANGE
from optloc.proof.scaled.reduction import Scaled
from optloc.proof.search_space import Cost, LocalAxes, chart_at, cost_of, empty_box


@compiled
def stays_finite(scaled: Scaled) -> bool:
    """Return whether the cost and the factors stay finite at infinity: the nodes of each factor are balanced.

    Far away, levels with a free exponent have the cost of a linear field, because the exponent grows with the
    distance.
    """
    last = scaled.lift.shape[0] - scaled.lift.shape[1]
    for j in range(scaled.group.shape[0]):
        g = scaled.group[j]
        if scaled.cost.kinds[j] == LOG_RANGE and g >= 0 and not scaled.lift[last + g, g] > 0.0:
            return False
    K = scaled.cost.K.copy()
    for g in range(-1, scaled.lift.shape[1]):
        for j in range(K.shape[1]):
            for i in range(K.shape[0]):
                K[i, j] = scaled.cost.K[i, j] if scaled.group[j] == g else 0.0
        if not reaches_infinity(scaled.cost.kinds, K):
            return False
    return True


# For costs that grow without limit, there are four enclosures. Rows without a factor enclose the positions of low
# cost, such as a prior on the position. If priors keep the factors from zero, balls around the stations do.
# Differences of two waves, and a linear field of levels, give balls as well.

# Least pivot as a share of the diagonal, as in `optloc.proof.enclosure`.
_PIVOT = 1e-9
# Least useful factor: the balls of a smaller factor are ten times larger.
_SMALLEST = 0.1
# Least useful difference of two factors.
_LEAST_GAP = 0.03


@compiled
def first_enclosed(
    scaled: Scaled, chart: LocalAxes, x: Array, levels: Array, least: float, low: Array, high: Array
) -> int:
    """Return the index of the first level whose positions are enclosed, or the number of levels; write the corners.

    `levels` (G,) are in descending order, and no level counts as lower than `least`, the cost of the fix.
    """
    for k in range(levels.shape[0]):
        level = max(levels[k], least)
        if (
            _enclose(_without_factors(scaled), chart, x, level, low, high)
            or _meet_balls(scaled, chart, x, level, low, high)
            or _meet_differences(scaled, chart, x, level, low, high)
            or _meet_field(scaled, chart, x, level, low, high)
        ):
            return k
    return int(levels.shape[0])


@compiled
def _without_factors(scaled: Scaled) -> Cost:
    """Return the cost of the rows whose nodes have no factors; it is nowhere more than the cost of all rows."""
    K, rows, columns = scaled.cost.K, zero(), zero()
    row, column = np.zeros(K.shape[0], dtype=np.int64), np.zeros(K.shape[1], dtype=np.int64)
    for j in range(K.shape[1]):
        if scaled.group[j] < 0:
            column[columns] = j
            columns += 1
    for i in range(K.shape[0]):
        own, other = False, False
        for j in range(K.shape[1]):
            own = own or (scaled.group[j] < 0 and K[i, j] != 0.0)
            other = other or (scaled.group[j] >= 0 and K[i, j] != 0.0)
        if own and not other:
            row[rows] = i
            rows += 1
    part, kinds = np.zeros((rows, columns)), np.zeros(columns, dtype=np.int64)
    w, data = np.zeros(rows), np.zeros((columns, scaled.cost.data.shape[1]))
    for j in range(columns):
        kinds[j] = scaled.cost.kinds[column[j]]
        data[j] = scaled.cost.data[column[j]]
        for i in range(rows):
            part[i, j] = K[row[i], column[j]]
    for i in range(rows):
        w[i] = scaled.cost.w[row[i]]
    cost = cost_of(kinds, data, part, w)
    R, groups = cost.A.copy(), empty_groups(columns)
    if columns == 0 or not invert(R, columns, _PIVOT):
        return cost
    # One group of all nodes. Without it, each coordinate of an uncorrelated prior would be a group, which alone bounds
    # no position.
    for j in range(columns):
        groups.order[0, j] = j
        for m in range(columns):
            groups.R[j, m] = R[j, m]
    groups.tie[:], groups.order[1] = 0.0, 0
    groups.order[1, 0], groups.order[2, 0] = columns, NONE
    return Cost(kinds, data, part, w, cost.A, cost.weight, groups)


@compiled
def _enclose(cost: Cost, chart: LocalAxes, x: Array, level: float, low: Array, high: Array) -> bool:
    """Write the corners of a box around all positions whose cost is below a level; return False without a box.

    `cost` is the cost of rows without factors (`_without_factors`).
    """
    q, J = cost.K.shape
    if q == 0 or J == 0:
        return False
    box, none = empty_box(q, J), np.full(x.shape[0], np.nan)
    chart_at(cost, x, box)
    return region_of(cost, chart, box, np.sqrt(level), none, none, low, high)


@compiled
def _factor_at(scaled: Scaled, g: int, rho: float) -> float:
    """Return an end of a factor's range from its prior: the least for negative rho, else the greatest; 1 for no factor.

    The prior is the last row of the factor. Without a prior the greatest is infinite, and the least -1.
    """
    if g < 0:
        return 1.0
    last = scaled.lift.shape[0] - scaled.lift.shape[1] + g
    lift = scaled.lift[last, g]
    if not lift > 0.0:
        return inf if rho > 0.0 else -1.0
    return float((scaled.cost.w[last] + rho) / lift * (1.0 + (1e-12 if rho > 0.0 else -1e-12)))


@compiled
def _is_of_ranges(scaled: Scaled) -> bool:
    """Return whether all nodes are ranges: only then do the balls around stations apply."""
    good = True
    for j in range(scaled.cost.kinds.shape[0]):
        good = good and scaled.cost.kinds[j] == RANGE
    return good


@compiled
def _open(x: Array, low: Array, high: Array) -> None:
    """Write infinite corners, which contain all positions x (D,); coordinates that do not exist get the corners 0."""
    low[:], high[:] = -inf, inf
    for k in range(x.shape[0], 3):
        low[k] = high[k] = 0.0


@compiled
def _fitted(scaled: Scaled, R: Array, j: int) -> float:
    """Return the least-squares estimate of node j times its factor, in the unit of the node: entry j of ``R K'w``.

    R (J, J) is the inverse of K'K. The radius of a ball of the enclosure is this estimate plus its uncertainty, divided
    by the least factor.
    """
    cost, total = scaled.cost, 0.0
    for m in range(R.shape[0]):
        for i in range(cost.w.shape[0]):
            total += R[j, m] * cost.K[i, m] * cost.w[i]
    return total


@compiled
def _meet_balls(scaled: Scaled, chart: LocalAxes, x: Array, level: float, low: Array, high: Array) -> bool:
    """Write the corners of a box that contains the intersection of the balls of all ranges; return False without balls.

    A range times the factor is within ``rho sqrt(R_jj)`` of its least-squares value, with R the inverse of K'K.
    """
    cost = scaled.cost
    R, J, rho = cost.A.copy(), cost.kinds.shape[0], np.sqrt(level)
    for g in range(scaled.lift.shape[1]):
        if not _factor_at(scaled, g, -rho) >= _SMALLEST:
            return False
    if not _is_of_ranges(scaled) or not invert(R, J, _PIVOT):
        return False
    _open(x, low, high)
    for j in range(J):
        most = rho * np.sqrt(R[j, j]) * (1.0 + SLACK) + _fitted(scaled, R, j)
        most = most * (1.0 + SLACK) / _factor_at(scaled, scaled.group[j], -rho)
        around_node(RANGE, cost.data[j], 0.0, most, chart.origin, chart.back, low, high)
    return True


@compiled
def _meet_differences(scaled: Scaled, chart: LocalAxes, x: Array, level: float, low: Array, high: Array) -> bool:
    """Write the corners of a box around stations that receive two waves of one emission.

    Return False without these stations. The difference of both arrivals is the range times the difference of the
    factors. The null space of K'K is the vector of ones, and differences of nodes do not depend on it. So a multiple of
    its square is added, which makes K'K regular.
    """
    cost, found = scaled.cost, False
    R, J, rho, size = cost.A.copy(), cost.kinds.shape[0], np.sqrt(level), 0.0
    for j in range(J):
        size += R[j, j] / (J * J)
    for j in range(J):
        total = 0.0
        for m in range(J):
            total += cost.A[j, m]
            R[j, m] += size
        if abs(total) > _PIVOT * size:
            return False
    if not _is_of_ranges(scaled) or not invert(R, J, _PIVOT):
        return False
    _open(x, low, high)
    for j in range(J):
        for m in range(J):
            gap = _factor_at(scaled, scaled.group[j], -rho) - _factor_at(scaled, scaled.group[m], rho)
            if (cost.data[j] != cost.data[m]).any() or not gap >= _LEAST_GAP:
                continue
            most = rho * np.sqrt(max(R[j, j] + R[m, m] - 2.0 * R[j, m], 0.0)) * (1.0 + SLACK)
            most += abs(_fitted(scaled, R, j) - _fitted(scaled, R, m)) * (1.0 + SLACK)
            around_node(RANGE, cost.data[j], 0.0, most / gap * (1.0 + SLACK), chart.origin, chart.back, low, high)
            found = True
    return found


@compiled
def _meet_field(scaled: Scaled, chart: LocalAxes, x: Array, level: float, low: Array, high: Array) -> bool:
    """Write the corners of a box outside which levels with a free exponent cost too much; or return False.

    Let the stations s_j, counted from their middle, be closer to it than D/2, and let k be the exponent. For a position
    at distance D in direction u, ``log r_j`` is ``log D - u.s_j / D`` within ``(s_j / D)^2``. With ``q = k u / D`` and
    ``M = K s``, the residual is ``w + M q`` within |q| B / D, where B is the sum of ``|K_j| s_j^2``. Let r be the
    length of the residual of the best q, and m the least singular value of M. For ``D > B (|w| + r) / (m (r - rho))``
    each q leaves a residual longer than rho.
    """
    cost, J, rho = scaled.cost, scaled.cost.kinds.shape[0], np.sqrt(level)
    d, middle, widest, bend, whole = x.shape[0], np.zeros(3), 0.0, 0.0, 0.0
    for j in range(J):
        if scaled.group[j] != 0 or cost.kinds[j] != LOG_RANGE:
            return False
        for k in range(d):
            middle[k] += cost.data[j, k] / J
    M, inner, pull = np.zeros((cost.w.shape[0], d)), np.zeros((d, d)), np.zeros(d)
    for j in range(J):
        away = 0.0
        for k in range(d):
            apart = cost.data[j, k] - middle[k]
            away += apart * apart
            for i in range(M.shape[0]):
                M[i, k] += cost.K[i, j] * apart
        widest, bend = max(widest, away), bend + cost.weight[j] * away
    for i in range(M.shape[0]):
        whole += cost.w[i] * cost.w[i]
        for k in range(d):
            pull[k] -= M[i, k] * cost.w[i]
            for m in range(d):
                inner[k, m] += M[i, k] * M[i, m]
    if not invert(inner, d, _PIVOT):
        return False
    field, trace = whole, 0.0
    for k in range(d):
        trace += inner[k, k]  # at least the inverse of the least eigenvalue
        for m in range(d):
            field -= pull[k] * inner[k, m] * pull[m]
    r = np.sqrt(max(field - _PIVOT * whole, 0.0))
    if not r > rho * (1.0 + SLACK):
        return False
    reach = bend * (np.sqrt(whole) + r) * np.sqrt(trace) / (r - rho)
    around = cost.data[0].copy()
    for k in range(3):
        around[k] = middle[k]
    _open(x, low, high)
    reach = max(reach, 2.0 * np.sqrt(widest)) * (1.0 + SLACK)
    around_node(RANGE, around, 0.0, reach, chart.origin, chart.back, low, high)
    return True
