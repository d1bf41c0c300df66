"""Descents in search coordinates: which minimum a low point belongs to."""

from __future__ import annotations

from optloc.compute.jit import compiled
from optloc.compute.systems import inverse, positive
from optloc.proof.chart import Box, Chart, Cost, curve_box, value_at
from optloc.proof.curvature import G0, G1, G2
from optloc.proof.nodes.node import FORCE, H00, H01, H02, H11, H12, H22

# A few damped Newton steps.

# Steps of a descent: damped Newton needs five to ten from a box near a minimum; beyond forty it creeps along a valley.
_STEPS = 40
# A step of so many standard deviations ends it: the next one, of Newton's, would be a millionth.
_CLOSE = 1e-3
# Damping at first, its factors after a step that was good and one that was not, and from where on it grows again. Steps
# that are damped by more than the last are no Newton steps, and do not end a descent.
_DAMPING, _LESS, _MORE, _LEAST, _FREE = 1e-6, 0.1, 10.0, 1e-4, 1e-3
# Rounding of two costs of the same point, relative and absolute: a step may raise the cost by it.
_SAME_COST = 1e-14


@compiled
def descend(cost: Cost, chart: Chart, box: Box) -> float:
    """Move the centre of a box to a minimum of the cost; return the cost there, or infinity where none is reached.

    The half-widths become zero, and the tables are those of the point. Newton's Hessian where it is positive definite,
    that of Gauss and Newton elsewhere, damped after Levenberg and Marquardt.
    """
    box.half[:] = 0.0
    start = box.at.copy()
    cost_now, damping = value_at(cost, chart, box), _DAMPING
    curve_box(cost, chart, box)
    for _ in range(_STEPS):
        length = _step(cost, box, damping)
        if not length >= 0.0:
            return float("inf")
        start[:] = box.at
        for k in range(3):
            box.at[k] -= box.solve[0, k]
        after = value_at(cost, chart, box)
        if after <= cost_now * (1.0 + _SAME_COST) + _SAME_COST:
            cost_now = after
            curve_box(cost, chart, box)
            if length < _CLOSE * _CLOSE and damping <= _FREE:
                sums = box.sums
                good = positive(
                    sums[H00],
                    sums[H01],
                    sums[H02],
                    sums[H11] if sums[H11] != 0.0 else 1.0,
                    sums[H12],
                    sums[H22] if sums[H22] != 0.0 else 1.0,
                )
                return cost_now if good else float("inf")
            damping *= _LESS
        else:
            box.at[:] = start
            damping = max(_MORE * damping, _LEAST)
    return float("inf")


@compiled
def _step(cost: Cost, box: Box, damping: float) -> float:
    """Write the damped step into the first row of box.solve; return its squared length, NaN where there is none."""
    sums, solve = box.sums, box.solve
    h0, h1, h2, h3, h4, h5 = sums[H00], sums[H01], sums[H02], sums[H11], sums[H12], sums[H22]
    h3, h5 = h3 if h3 != 0.0 else 1.0, h5 if h5 != 0.0 else 1.0
    if not positive(h0, h1, h2, h3, h4, h5):
        # Less the curvature of the nodes, Gauss and Newton's information is left, which always falls.
        for j in range(box.curves.shape[0]):
            force = box.curves[j, FORCE]
            h0 -= force * box.curves[j, H00]
            h1 -= force * box.curves[j, H01]
            h2 -= force * box.curves[j, H02]
            h3 -= force * box.curves[j, H11]
            h4 -= force * box.curves[j, H12]
            h5 -= force * box.curves[j, H22]
    more = 1.0 + damping
    if not inverse(h0 * more, h1, h2, h3 * more, h4, h5 * more, solve):
        return float("nan")
    g0, g1, g2 = sums[G0], sums[G1], sums[G2]
    s0 = solve[0, 0] * g0 + solve[0, 1] * g1 + solve[0, 2] * g2
    s1 = solve[1, 0] * g0 + solve[1, 1] * g1 + solve[1, 2] * g2
    s2 = solve[2, 0] * g0 + solve[2, 1] * g1 + solve[2, 2] * g2
    solve[0, 0], solve[0, 1], solve[0, 2] = s0, s1, s2
    return float(s0 * s0 + s1 * s1 + s2 * s2)
