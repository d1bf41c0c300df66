"""Descents: damped Newton steps from a point of low cost to the minimum that it belongs to.

Steps are in search coordinates (`optloc.proof.search_space`). The box of a descent is a point: its half-widths are
zero.
"""

from __future__ import annotations

from math import inf, sqrt

from optloc.kernels.jit import compiled, inlined, put
from optloc.kernels.systems import inverse, positive_along
from optloc.proof.curvature import G0, G1, G2
from optloc.proof.nodes.node import FORCE, H00, H01, H02, H11, H12, H22
from optloc.proof.search_space import Box, Cost, LocalAxes, curve_box, rounding_at_centre, value_at

# Greatest number of steps of a descent. From a box near a minimum, damped Newton needs five to ten; after forty it
# moves slowly along a valley.
_STEPS = 40
# A step shorter than this, in standard deviations, ends a descent: the next Newton step would be a millionth.
_CLOSE = 1e-3
# First damping; its factors after a successful and an unsuccessful step; and the least damping after an unsuccessful
# step. Steps with a damping above `_FREE` are no Newton steps, and do not end a descent.
_DAMPING, _LESS, _MORE, _LEAST, _FREE = 1e-6, 0.1, 10.0, 1e-4, 1e-3
# Rounding of sums of squares, relative and absolute. A step may raise the cost by this and by the rounding of
# residuals.
_SAME_COST = 1e-14


@compiled
def descend(cost: Cost, chart: LocalAxes, box: Box) -> float:
    """Move the centre of a box to a minimum of the cost; return the cost there, or infinity if no minimum is reached.

    The half-widths become zero, and the tables are filled for the point. If Newton's Hessian is positive definite, it
    is used, else the Gauss-Newton one; both are damped (Levenberg-Marquardt). Lengths of steps are in standard
    deviations at the point, because the unit of the search coordinates is a standard deviation at the fix only.
    """
    box.half[:] = 0.0
    start = box.at.copy()
    cost_now, damping = value_at(cost, chart, box), _DAMPING
    if not cost_now < inf:
        return inf
    noise = rounding_at_centre(cost, chart, box)
    curve_box(cost, chart, box)
    for _ in range(_STEPS):
        length = newton_step(box, damping)
        if not length >= 0.0:
            return float("inf")
        put(box.at, start)
        for k in range(3):
            box.at[k] -= box.solve[0, k]
        after = value_at(cost, chart, box)
        if after <= cost_now + _SAME_COST * (1.0 + cost_now) + noise * (2.0 * sqrt(cost_now) + noise):
            cost_now = after
            noise = rounding_at_centre(cost, chart, box)
            curve_box(cost, chart, box)
            if length < _CLOSE * _CLOSE + noise * noise and damping <= _FREE:
                sums = box.sums
                h0, h1, h2, h3, h4, h5 = sums[H00], sums[H01], sums[H02], sums[H11], sums[H12], sums[H22]
                good = positive_along(h0, h1, h2, h3, h4, h5, h3 != 0.0, h5 != 0.0)
                return cost_now if good else float("inf")
            damping *= _LESS
        else:
            put(start, box.at)
            damping = max(_MORE * damping, _LEAST)
    return float("inf")


@compiled
def newton_step(box: Box, damping: float) -> float:
    """Write the damped step into the first row of box.solve; return its squared length in squared standard deviations.

    The step is subtracted from the coordinates. `damping` is the share by which the diagonal of the Hessian grows. The
    result is NaN if there is no step.
    """
    sums = box.sums
    h0, h1, h2, h3, h4, h5 = sums[H00], sums[H01], sums[H02], sums[H11], sums[H12], sums[H22]
    second, third = h3 != 0.0, h5 != 0.0
    if not positive_along(h0, h1, h2, h3, h4, h5, second, third):
        # Without the curvature of the nodes, the Gauss-Newton matrix remains, whose step always reduces the cost.
        for j in range(box.curves.shape[0]):
            force = box.curves[j, FORCE]
            h0 -= force * box.curves[j, H00]
            h1 -= force * box.curves[j, H01]
            h2 -= force * box.curves[j, H02]
            h3 -= force * box.curves[j, H11]
            h4 -= force * box.curves[j, H12]
            h5 -= force * box.curves[j, H22]
    h3, h5 = h3 if second else 1.0, h5 if third else 1.0
    return abs(damped_step(box, h0, h1, h2, h3, h4, h5, damping))


@inlined
def damped_step(box: Box, h0: float, h1: float, h2: float, h3: float, h4: float, h5: float, damping: float) -> float:
    """Write the step of a Hessian (00, 01, 02, 11, 12, 22) like `newton_step`; return its squared length, or NaN.

    The gradient is in ``box.sums``. The damping multiplies the diagonal by 1 + damping.
    """
    sums, solve, more = box.sums, box.solve, 1.0 + damping
    if not inverse(h0 * more, h1, h2, h3 * more, h4, h5 * more, solve):
        return float("nan")
    g0, g1, g2 = sums[G0], sums[G1], sums[G2]
    s0 = solve[0, 0] * g0 + solve[0, 1] * g1 + solve[0, 2] * g2
    s1 = solve[1, 0] * g0 + solve[1, 1] * g1 + solve[1, 2] * g2
    s2 = solve[2, 0] * g0 + solve[2, 1] * g1 + solve[2, 2] * g2
    solve[0, 0], solve[0, 1], solve[0, 2] = s0, s1, s2
    return float(s0 * g0 + s1 * g1 + s2 * g2)
