"""Boxes around minima on which the cost is convex: no second minimum fits in."""

from __future__ import annotations

from optloc.kernels.jit import compiled
from optloc.proof.chart import Box, Chart, Cost, is_convex
from optloc.types import Array


@compiled
def grow(cost: Cost, chart: Chart, box: Box, hull: Array, margin: float, best: Array) -> bool:
    """Find a box around the centre of `box` on which the cost is convex; return False where there is none.

    The whole hull first; else a cube, doubled while it is convex, and its sides one by one.

    Parameters
    ----------
    cost, chart : Cost, Chart
        The cost and its search coordinates.
    box : Box
        Its centre `at` is a minimum.
    hull : array (3,)
        Half-widths beyond which there is nothing to gain.
    margin : float
        By how much the Hessian of f/2 must exceed zero.
    best : array (3,)
        Written: half-widths.
    """
    if _is_convex(cost, chart, box, hull, margin):
        best[:] = hull
        return True
    size = 4.0
    good = _cube(cost, chart, box, hull, size, margin)
    if good:
        for _ in range(24):
            if not _cube(cost, chart, box, hull, 2.0 * size, margin):
                break
            size *= 2.0
    else:
        for _ in range(10):
            size *= 0.5
            good = _cube(cost, chart, box, hull, size, margin)
            if good:
                break
        if not good:
            return False
    if _cube(cost, chart, box, hull, 1.4 * size, margin):
        size *= 1.4
    for k in range(3):
        best[k] = min(size, hull[k])
    for k in range(3):
        _stretch(cost, chart, box, hull, k, margin, best)
    return True


@compiled
def _is_convex(cost: Cost, chart: Chart, box: Box, half: Array, margin: float) -> bool:
    box.half[:] = half
    return is_convex(cost, chart, box, margin)


@compiled
def _cube(cost: Cost, chart: Chart, box: Box, hull: Array, size: float, margin: float) -> bool:
    for k in range(3):
        box.half[k] = min(size, hull[k])
    return is_convex(cost, chart, box, margin)


@compiled
def _stretch(cost: Cost, chart: Chart, box: Box, hull: Array, k: int, margin: float, best: Array) -> None:
    """Lengthen one side of a convex box while it stays convex."""
    for _ in range(24):
        if best[k] >= hull[k]:
            return
        box.half[:] = best
        box.half[k] = min(1.6 * best[k], hull[k])
        if not is_convex(cost, chart, box, margin):
            return
        best[k] = box.half[k]
