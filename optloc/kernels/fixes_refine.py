"""Damped Gauss-Newton of a position from ranges, many problems side by side: the rules of `optloc.solve.refine`."""

from __future__ import annotations

import numpy as np

from optloc.kernels.fixes_lanes import Lanes, Model
from optloc.kernels.gtrs import factor, solve
from optloc.kernels.jit import compiled
from optloc.types import Array

_FLOOR = 1e-13  # rounding error of a cost, relative to one more than it
_PIVOT = 1e-15  # share of its diagonal that a pivot must exceed


@compiled
def refine(model: Model, lanes: Lanes, tolerance: float, limit: int) -> None:
    """Refine the positions `x` of the lanes that are `good`; those that do not finish in time stay `alive`.

    Parameters
    ----------
    model : Model
        What all problems share.
    lanes : Lanes
        Positions in; positions, costs, information and numbers of steps out. A lane that fails is no longer `good`.
    tolerance : float
        A fix is finished when its next step is shorter than this many of its own standard deviations.
    limit : int
        Steps tried at most.

    Notes
    -----
    Levenberg's method with Marquardt's scaling; the damping follows H. B. Nielsen, "Damping parameter in Marquardt's
    method", IMM-REP-1999-05, Technical University of Denmark.
    """
    width = len(lanes.cost)
    equations(model, lanes, lanes.x, lanes.H, lanes.g, lanes.cost)
    for lane in range(width):
        lanes.good[lane] = lanes.good[lane] if lanes.cost[lane] < np.inf else 0.0
        lanes.alive[lane] = lanes.good[lane]
        lanes.damping[lane], lanes.growth[lane], lanes.steps[lane] = 1e-6, 2.0, 0.0
    for _ in range(limit):
        _propose(lanes)
        equations(model, lanes, lanes.trial, lanes.H2, lanes.g2, lanes.cost2)
        _decide(lanes, tolerance)
        alive = 0.0
        for lane in range(width):
            alive += lanes.alive[lane]
        if alive == 0.0:
            break


@compiled
def equations(model: Model, lanes: Lanes, x: Array, H: Array, g: Array, cost: Array) -> None:
    """Find information (lower half), right-hand side and cost at positions x (d, W) from the origin."""
    s, d, width = lanes.place.shape
    ranges(lanes, x)
    for lane in range(width):
        cost[lane] = lanes.loop[lane]
    for i in range(d):
        for lane in range(width):
            g[i, lane] = 0.0
        for j in range(i + 1):
            for lane in range(width):
                H[i, j, lane] = 0.0
    for k in range(len(model.K)):
        for lane in range(width):
            lanes.spare[lane] = lanes.u[k, lane]
        for j in range(d):
            for lane in range(width):
                lanes.row[j, lane] = 0.0
        for i in range(s):
            share = model.K[k, i]
            if share != 0.0:
                for lane in range(width):
                    lanes.spare[lane] -= share * lanes.r[i, lane]
                for j in range(d):
                    for lane in range(width):
                        lanes.row[j, lane] += share * lanes.unit[i, j, lane]
        for lane in range(width):
            cost[lane] += lanes.spare[lane] * lanes.spare[lane]
        for i in range(d):
            for lane in range(width):
                g[i, lane] += lanes.row[i, lane] * lanes.spare[lane]
            for j in range(i + 1):
                for lane in range(width):
                    H[i, j, lane] += lanes.row[i, lane] * lanes.row[j, lane]


@compiled
def ranges(lanes: Lanes, x: Array) -> None:
    """Find ranges and unit vectors from the stations at positions x (d, W)."""
    s, d, width = lanes.place.shape
    for i in range(s):
        for lane in range(width):
            lanes.r[i, lane] = 0.0
        for j in range(d):
            for lane in range(width):
                apart = x[j, lane] - lanes.place[i, j, lane]
                lanes.unit[i, j, lane] = apart
                lanes.r[i, lane] += apart * apart
        for lane in range(width):
            lanes.r[i, lane] = np.sqrt(lanes.r[i, lane])
        for lane in range(width):
            lanes.spare[lane] = 1.0 / lanes.r[i, lane]
        for j in range(d):
            for lane in range(width):
                lanes.unit[i, j, lane] *= lanes.spare[lane]


@compiled
def _propose(lanes: Lanes) -> None:
    """Find the damped step; `extra` is the squared length in its own standard deviations, `spare` the least pivot."""
    d, width = lanes.x.shape
    for i in range(d):
        for lane in range(width):
            lanes.diagonal[i, lane] = lanes.H[i, i, lane] * (1.0 + lanes.damping[lane])
            lanes.move[i, lane] = lanes.g[i, lane]
    factor(lanes.H, lanes.diagonal, lanes.lower, lanes.inverse)
    solve(lanes.lower, lanes.inverse, lanes.move)
    for lane in range(width):
        lanes.extra[lane], lanes.settled[lane] = 0.0, 1.0
    for i in range(d):
        for lane in range(width):
            lanes.extra[lane] += lanes.move[i, lane] * lanes.g[i, lane]
            lanes.trial[i, lane] = lanes.x[i, lane] + lanes.move[i, lane]
            share = lanes.inverse[i, lane] * lanes.diagonal[i, lane]
            lanes.settled[lane] = lanes.settled[lane] if 0.0 < share < 1.0 / _PIVOT else 0.0


@compiled
def _decide(lanes: Lanes, tolerance: float) -> None:
    """Keep the steps that lower the cost, move the damping, and end the lanes whose step was small."""
    d, width = lanes.x.shape
    for lane in range(width):
        cost, gain, damping = lanes.cost[lane], lanes.extra[lane], lanes.damping[lane]
        achieved, floor = cost - lanes.cost2[lane], _FLOOR * (1.0 + cost)
        rounding = floor + 2.0 * lanes.blur[lane] * np.sqrt(1.0 + cost)
        solvable = lanes.alive[lane] * lanes.settled[lane]
        better = solvable if achieved >= -rounding else 0.0
        better = better if lanes.cost2[lane] < np.inf else 0.0
        small = solvable if abs(gain) * (1.0 + damping) <= max(tolerance**2, floor + lanes.blur[lane] ** 2) else 0.0
        ratio = min(max(achieved / (gain if gain > 0.0 else 1.0), 0.0), 1.0)
        shape = 2.0 * ratio - 1.0
        change = 0.1 if ratio > 0.9 else max(1.0 / 3.0, 1.0 - shape * shape * shape)
        down, up = max(damping * change, 1e-12), damping * lanes.growth[lane] + 1e-12
        lanes.damping[lane] = down if better != 0.0 else up
        lanes.growth[lane] = 2.0 if better != 0.0 else 2.0 * lanes.growth[lane]
        lanes.cost[lane] = lanes.cost2[lane] if better != 0.0 else cost
        lanes.steps[lane] += lanes.alive[lane]
        lanes.spare[lane] = better
        lost = lanes.alive[lane] if better == 0.0 and lanes.damping[lane] > 1e12 and small == 0.0 else 0.0
        lanes.good[lane] = lanes.good[lane] if lost == 0.0 else 0.0
        lanes.alive[lane] = lanes.alive[lane] if small + lost == 0.0 else 0.0
    for i in range(d):
        for lane in range(width):
            keep = lanes.spare[lane] != 0.0
            lanes.x[i, lane] = lanes.trial[i, lane] if keep else lanes.x[i, lane]
            lanes.g[i, lane] = lanes.g2[i, lane] if keep else lanes.g[i, lane]
        for j in range(i + 1):
            for lane in range(width):
                lanes.H[i, j, lane] = lanes.H2[i, j, lane] if lanes.spare[lane] != 0.0 else lanes.H[i, j, lane]
