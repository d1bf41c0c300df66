"""Damped Gauss-Newton of a position from ranges, many problems side by side: the rules of `optloc.solvers.refine`."""

from __future__ import annotations

import numpy as np

from optloc.base.linalg import PIVOT
from optloc.base.types import Array
from optloc.compute.damping import FIRST_DAMPING, FIRST_GROWTH, judge_lane
from optloc.compute.jit import compiled
from optloc.compute.range_start import (
    ALIVE,
    BLUR,
    COST,
    COST_TRIAL,
    DAMPING,
    DIAGONAL,
    G_TRIAL,
    GAIN,
    GOOD,
    GROWTH,
    H_TRIAL,
    INVERSE,
    LOOP,
    LOWER,
    MOVE,
    ROW,
    SOLVABLE,
    SPARE,
    STEPS,
    TRIAL,
    G,
    H,
    X,
)
from optloc.compute.systems import LANES, factor_plain, solve_plain


@compiled
def refine(
    K: Array,
    u: Array,
    place: Array,
    r: Array,
    unit: Array,
    vector: Array,
    matrix: Array,
    scalar: Array,
    tolerance: float,
    limit: int,
) -> None:
    """Refine the positions of the lanes that are good; those that do not finish in time stay alive.

    Parameters
    ----------
    K, u : array (q, s), (q, W)
        The cost is ``|u - K r|^2`` and that of the loops.
    place : array (s, d, W)
        Stations, metres.
    r, unit : array (s, W), (s, d, W)
        Scratch: ranges and unit vectors.
    vector, matrix, scalar : array (12, d, W), (6, d, d, W), (21, W)
        Of `optloc.compute.range_start.Room`: positions in row X, cost of the loops, rounding error and which lanes are
        good in; positions, right-hand sides, information (lower half), costs, steps, which are alive and which good
        out.
    tolerance : float
        A fix is finished when its next step is shorter than this many of its own standard deviations.
    limit : int
        Steps tried at most.

    Notes
    -----
    Levenberg's method with Marquardt's scaling; the damping follows H. B. Nielsen, "Damping parameter in Marquardt's
    method", IMM-REP-1999-05, Technical University of Denmark.
    """
    equations(
        K, u, place, r, unit, vector[X], vector[ROW], scalar[SPARE], scalar[LOOP], matrix[H], vector[G], scalar[COST]
    )
    for lane in range(LANES):
        # A start that is NaN or infinite is not good, and takes no step.
        scalar[GOOD, lane] = scalar[GOOD, lane] if scalar[COST, lane] < np.inf else 0.0
        scalar[ALIVE, lane] = scalar[GOOD, lane]
        scalar[DAMPING, lane], scalar[GROWTH, lane], scalar[STEPS, lane] = FIRST_DAMPING, FIRST_GROWTH, 0.0
    # All lanes step until none is alive: a lane that is finished takes no more steps that count.
    for _ in range(limit):
        propose(vector, matrix, scalar)
        equations(
            K,
            u,
            place,
            r,
            unit,
            vector[TRIAL],
            vector[ROW],
            scalar[SPARE],
            scalar[LOOP],
            matrix[H_TRIAL],
            vector[G_TRIAL],
            scalar[COST_TRIAL],
        )
        if not decide(vector, matrix, scalar, tolerance):
            break


@compiled
def equations(
    K: Array,
    u: Array,
    place: Array,
    r: Array,
    unit: Array,
    x: Array,
    row: Array,
    left: Array,
    loop: Array,
    information: Array,
    right: Array,
    cost: Array,
) -> None:
    """Find information (lower half), right-hand side and cost at positions x (d, W); `row` and `left` are scratch."""
    d = len(x)
    ranges(place, x, r, unit, left)
    for lane in range(LANES):
        cost[lane] = loop[lane]
    for i in range(d):
        for lane in range(LANES):
            right[i, lane] = 0.0
        for j in range(i + 1):
            for lane in range(LANES):
                information[i, j, lane] = 0.0
    for k in range(len(K)):
        _row(K[k], u[k], r, unit, row, left)
        for lane in range(LANES):
            cost[lane] += left[lane] * left[lane]
        for i in range(d):
            for lane in range(LANES):
                right[i, lane] += row[i, lane] * left[lane]
            for j in range(i + 1):
                for lane in range(LANES):
                    information[i, j, lane] += row[i, lane] * row[j, lane]


@compiled
def _row(share: Array, seen: Array, r: Array, unit: Array, row: Array, left: Array) -> None:
    """Find one whitened row (d, W) of the Jacobian and its residual (W,): what is seen less shares of the ranges."""
    s, d = unit.shape[:2]
    for lane in range(LANES):
        left[lane] = seen[lane]
    for j in range(d):
        for lane in range(LANES):
            row[j, lane] = 0.0
    for i in range(s):
        part = share[i]
        # Pairs of stations: of a row over all ranges two entries are not zero.
        if part != 0.0:
            for lane in range(LANES):
                left[lane] -= part * r[i, lane]
            for j in range(d):
                for lane in range(LANES):
                    row[j, lane] += part * unit[i, j, lane]


@compiled
def ranges(place: Array, x: Array, r: Array, unit: Array, spare: Array) -> None:
    """Find ranges (s, W) and unit vectors (s, d, W) from the stations at positions x (d, W)."""
    s, d = place.shape[:2]
    for i in range(s):
        for lane in range(LANES):
            spare[lane] = 0.0
        for j in range(d):
            for lane in range(LANES):
                apart = x[j, lane] - place[i, j, lane]
                unit[i, j, lane] = apart
                spare[lane] += apart * apart
        for lane in range(LANES):
            r[i, lane] = np.sqrt(spare[lane])
            spare[lane] = 1.0 / r[i, lane]
        for j in range(d):
            for lane in range(LANES):
                unit[i, j, lane] *= spare[lane]


@compiled
def propose(vector: Array, matrix: Array, scalar: Array) -> None:
    """Find the damped step, its squared length in its own standard deviations, and whether it exists."""
    d = vector.shape[1]
    diagonal, inverse, move, right, damping = (
        vector[DIAGONAL],
        vector[INVERSE],
        vector[MOVE],
        vector[G],
        scalar[DAMPING],
    )
    gain, solvable, information = scalar[GAIN], scalar[SOLVABLE], matrix[H]
    for lane in range(LANES):
        gain[lane], solvable[lane] = 0.0, 1.0
    for i in range(d):
        for lane in range(LANES):
            diagonal[i, lane] = information[i, i, lane] * (1.0 + damping[lane])
            move[i, lane] = right[i, lane]
    factor_plain(information, diagonal, matrix[LOWER], inverse)
    solve_plain(matrix[LOWER], inverse, move)
    x, trial = vector[X], vector[TRIAL]
    for i in range(d):
        for lane in range(LANES):
            gain[lane] += move[i, lane] * right[i, lane]
            trial[i, lane] = x[i, lane] + move[i, lane]
            # One over the share of its diagonal that a pivot keeps: at least one, infinite or negative where there is
            # no pivot.
            share = inverse[i, lane] * diagonal[i, lane]
            solvable[lane] = solvable[lane] if 0.0 < share < 1.0 / PIVOT else 0.0


@compiled
def decide(vector: Array, matrix: Array, scalar: Array, tolerance: float) -> bool:
    """Keep the steps that lower the cost, move the damping, end lanes whose step was small; return if any is alive."""
    d = vector.shape[1]
    # Lanes that are finished go through the rule too, and are left as they are: their step counts as unsolvable.
    kept, alive = scalar[SPARE], scalar[ALIVE]
    for lane in range(LANES):
        better, small, stuck, scalar[DAMPING, lane], scalar[GROWTH, lane] = judge_lane(
            scalar[COST, lane],
            scalar[COST_TRIAL, lane],
            scalar[GAIN, lane],
            alive[lane] * scalar[SOLVABLE, lane] != 0.0,
            scalar[BLUR, lane],
            scalar[DAMPING, lane],
            scalar[GROWTH, lane],
            tolerance,
            True,
        )
        scalar[COST, lane] = scalar[COST_TRIAL, lane] if better else scalar[COST, lane]
        scalar[STEPS, lane] += alive[lane]
        scalar[GOOD, lane] = 0.0 if stuck and alive[lane] != 0.0 else scalar[GOOD, lane]
        alive[lane] = 0.0 if small or stuck else alive[lane]
        kept[lane] = 1.0 if better else 0.0
    for i in range(d):
        for lane in range(LANES):
            # Selections instead of branches: lanes that keep and lanes that refuse go through one instruction.
            vector[X, i, lane] = vector[TRIAL, i, lane] if kept[lane] != 0.0 else vector[X, i, lane]
            vector[G, i, lane] = vector[G_TRIAL, i, lane] if kept[lane] != 0.0 else vector[G, i, lane]
        for j in range(i + 1):
            for lane in range(LANES):
                matrix[H, i, j, lane] = matrix[H_TRIAL, i, j, lane] if kept[lane] != 0.0 else matrix[H, i, j, lane]
    left = 0.0
    for lane in range(LANES):
        left += alive[lane]
    return left > 0.0


@compiled
def costs(K: Array, u: Array, place: Array, x: Array, r: Array, left: Array, loop: Array, cost: Array) -> None:
    """Find the cost alone at positions x (d, W): a third of the work of `equations`; `r` and `left` are scratch."""
    s, d = place.shape[:2]
    for i in range(s):
        for lane in range(LANES):
            r[i, lane] = 0.0
        for j in range(d):
            for lane in range(LANES):
                apart = x[j, lane] - place[i, j, lane]
                r[i, lane] += apart * apart
        for lane in range(LANES):
            r[i, lane] = np.sqrt(r[i, lane])
    for lane in range(LANES):
        cost[lane] = loop[lane]
    for k in range(len(K)):
        for lane in range(LANES):
            left[lane] = u[k, lane]
        for i in range(s):
            part = K[k, i]
            if part != 0.0:
                for lane in range(LANES):
                    left[lane] -= part * r[i, lane]
        for lane in range(LANES):
            cost[lane] += left[lane] * left[lane]
