"""Boxes around minima on which the cost is convex: no second minimum fits in."""

from __future__ import annotations

from optloc.kernels.jit import inlined
from optloc.proof.chart import Box, Chart, Cost, is_convex
from optloc.types import Array

# What is left of a box that is not convex, and how often it is made smaller.
_SHARE, _SHRINKS = 0.7, 60


@inlined
def set_convex(cost: Cost, chart: Chart, box: Box, hull: Array, margin: float) -> bool:
    """Make a box around its centre as large as the cost is found convex on it; return False where it is on none.

    Convex over the whole hull in most cases; else the hull is shrunk as a whole.

    Parameters
    ----------
    cost, chart : Cost, Chart
        The cost and its search coordinates.
    box : Box
        Its centre `at` is a minimum; its half-widths are written.
    hull : array (3,)
        Half-widths beyond which there is nothing to gain.
    margin : float
        By how much the Hessian of f/2 must exceed zero.
    """
    size = 1.0
    for _ in range(_SHRINKS):
        for k in range(3):
            box.half[k] = size * hull[k]
        if is_convex(cost, chart, box, margin):
            return True
        size *= _SHARE
    return False
