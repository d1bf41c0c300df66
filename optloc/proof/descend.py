"""A few damped Newton steps in search coordinates: which minimum a low point belongs to."""

from __future__ import annotations

from optloc.kernels.jit import compiled
from optloc.proof.chart import Box, Chart, Cost, curve_box, value_at
from optloc.proof.linear3 import inverse, positive

_STEPS = 40
_CLOSE = 1e-3


@compiled
def descend(cost: Cost, chart: Chart, box: Box) -> float:
    """Move the centre of a box to a minimum of the cost; return the cost there, or infinity where none is reached.

    The half-widths become zero, and the tables are those of the point. Newton's Hessian where it is positive definite,
    that of Gauss and Newton elsewhere, damped after Levenberg and Marquardt.
    """
    box.half[:] = 0.0
    start = box.at.copy()
    cost_now, damping = value_at(cost, chart, box), 1e-6
    curve_box(cost, chart, box)
    for _ in range(_STEPS):
        length = _step(cost, box, damping)
        if not length >= 0.0:
            return float("inf")
        start[:] = box.at
        for k in range(3):
            box.at[k] -= box.solve[0, k]
        after = value_at(cost, chart, box)
        if after <= cost_now * (1.0 + 1e-14) + 1e-14:
            cost_now = after
            curve_box(cost, chart, box)
            if length < _CLOSE * _CLOSE and damping <= 1e-3:
                sums = box.sums
                good = positive(sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] if sums[5] != 0.0 else 1.0)
                return cost_now if good else float("inf")
            damping *= 0.1
        else:
            box.at[:] = start
            damping = max(10.0 * damping, 1e-4)
    return float("inf")


@compiled
def _step(cost: Cost, box: Box, damping: float) -> float:
    """Write the damped step into the first row of box.solve; return its squared length, NaN where there is none."""
    sums, solve = box.sums, box.solve
    h0, h1, h2, h3, h4, h5 = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    if h5 == 0.0:
        h5 = 1.0
    if not positive(h0, h1, h2, h3, h4, h5):
        for j in range(box.curves.shape[0]):
            force = box.curves[j, 10]
            h0 -= force * box.curves[j, 0]
            h1 -= force * box.curves[j, 1]
            h2 -= force * box.curves[j, 2]
            h3 -= force * box.curves[j, 3]
            h4 -= force * box.curves[j, 4]
            h5 -= force * box.curves[j, 5]
    more = 1.0 + damping
    if not inverse(h0 * more, h1, h2, h3 * more, h4, h5 * more, solve):
        return float("nan")
    g0, g1, g2 = sums[6], sums[7], sums[8]
    s0 = solve[0, 0] * g0 + solve[0, 1] * g1 + solve[0, 2] * g2
    s1 = solve[1, 0] * g0 + solve[1, 1] * g1 + solve[1, 2] * g2
    s2 = solve[2, 0] * g0 + solve[2, 1] * g1 + solve[2, 2] * g2
    solve[0, 0], solve[0, 1], solve[0, 2] = s0, s1, s2
    return float(s0 * s0 + s1 * s1 + s2 * s2)
