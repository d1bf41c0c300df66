"""Descents: which minimum a low point belongs to, by a few damped Newton steps."""

from __future__ import annotations

from math import inf, sqrt

from optloc.kernels.jit import compiled, inlined, put
from optloc.kernels.systems import inverse, positive_along
from optloc.proof.curvature import G0, G1, G2
from optloc.proof.nodes.node import FORCE, H00, H01, H02, H11, H12, H22
from optloc.proof.search_space import Box, Cost, LocalAxes, curve_box, rounding_at_centre, value_at

# Steps of a descent: damped Newton needs five to ten from a box near a minimum; beyond forty it creeps along a valley.
_STEPS = 40
# A step that gains so many standard deviations, squared, ends it: the next one, of Newton's, would be a millionth.
_CLOSE = 1e-3
# Damping at first, its factors after a step that was good and one that was not, and from where on it grows again. Steps
# that are damped by more than the last are no Newton steps, and do not end a descent.
_DAMPING, _LESS, _MORE, _LEAST, _FREE = 1e-6, 0.1, 10.0, 1e-4, 1e-3
# Rounding of sums of squares, relative and absolute; a step may raise the cost by it and by what residuals are rounded.
_SAME_COST = 1e-14


@compiled
def descend(cost: Cost, chart: LocalAxes, box: Box) -> float:
    """Move the centre of a box to a minimum of the cost; return the cost there, or infinity where none is reached.

    The half-widths become zero, and the tables are those of the point. Newton's Hessian where it is positive definite,
    that of Gauss and Newton elsewhere, damped after Levenberg and Marquardt. Lengths of steps are counted in standard
    deviations, whatever the unit of the search coordinates is: away from the fix they are another.
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
    """Write the damped step into the first row of box.solve; return its squared length in standard deviations.

    NaN where there is none.
    """
    sums = box.sums
    h0, h1, h2, h3, h4, h5 = sums[H00], sums[H01], sums[H02], sums[H11], sums[H12], sums[H22]
    second, third = h3 != 0.0, h5 != 0.0
    if not positive_along(h0, h1, h2, h3, h4, h5, second, third):
        # Less the curvature of the nodes, Gauss and Newton's information is left, which always falls.
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
    """Write the step of a Hessian (00, 01, 02, 11, 12, 22) as `newton_step` does; return its squared length, or NaN."""
    sums, solve, more = box.sums, box.solve, 1.0 + damping
    if not inverse(h0 * more, h1, h2, h3 * more, h4, h5 * more, solve):
        return float("nan")
    g0, g1, g2 = sums[G0], sums[G1], sums[G2]
    s0 = solve[0, 0] * g0 + solve[0, 1] * g1 + solve[0, 2] * g2
    s1 = solve[1, 0] * g0 + solve[1, 1] * g1 + solve[1, 2] * g2
    s2 = solve[2, 0] * g0 + solve[2, 1] * g1 + solve[2, 2] * g2
    solve[0, 0], solve[0, 1], solve[0, 2] = s0, s1, s2
    return float(s0 * g0 + s1 * g1 + s2 * g2)
