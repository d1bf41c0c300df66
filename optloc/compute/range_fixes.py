"""A fix from ranges in one compiled call: start, refinement, covariance, and whether the answer is plainly good."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.compute.gtrs import minimise, scratch
from optloc.compute.jit import compiled
from optloc.compute.range_refine import (
    ALIVE,
    BLUR,
    CENTRE,
    COST,
    DIAGONAL,
    GOOD,
    H_TRIAL,
    INVERSE,
    LOOP,
    LOWER,
    MOVE,
    ORIGIN,
    SCALE,
    SOLVABLE,
    SPARE,
    SPREAD,
    STEPS,
    H,
    X,
    ranges,
    refine,
)
from optloc.compute.systems import LANES, factor_plain, solve_plain

# The start of a fix from ranges: measurements, stations and squared-range rows of a block of problems.

# Least distance from a station that weighs a row, in units of the stations' spread: at the station itself a squared
# range has no first-order error, and its weight would be infinite.
_NEAR = 1e-3
# Four roundings of a double lie between a measurement and its residual.
_ROUNDING = 4.0 * 2.220446049250313e-16


@compiled
def read(
    z: Array, item: Array, row: Array, anchor: Array, linear: Array, out: Array, value: Array, blur: Array, good: Array
) -> None:
    """Take the measurements of a block of problems, and everything that is linear in them.

    Parameters
    ----------
    z : array (N, m)
        Measurements, metres.
    item : int64 array (W,)
        Problem of each lane.
    row : array (2, m)
        Of each row: known amount by which the measurement exceeds the model; one over its variance, 0 where absent.
    anchor : int64 array (m,)
        Row that is subtracted from each before anything is added up, -1 for none.
    linear : array (p, m)
        Linear maps of the measurements.
    out : array (m, W)
        Written: measurements less corrections and anchors; zero where absent.
    value : array (p, W)
        Written: their images.
    blur : array (W,)
        Written: rounding error of the whitened residuals.
    good : array (W,)
        Written: 1.0 where all rows that are present are finite, else 0.0.
    """
    m = len(out)
    for lane in range(LANES):
        blur[lane], good[lane] = 0.0, 1.0
    for j in range(m):
        # An absent row may hold NaN, which no share of zero would remove.
        if row[1, j] == 0.0:
            for lane in range(LANES):
                out[j, lane] = 0.0
            continue
        for lane in range(LANES):
            out[j, lane] = z[item[lane], j] - row[0, j]
        for lane in range(LANES):
            blur[lane] += row[1, j] * out[j, lane] * out[j, lane]
            good[lane] = good[lane] if abs(out[j, lane]) < np.inf else 0.0
    for lane in range(LANES):
        blur[lane] = _ROUNDING * np.sqrt(blur[lane])
    for j in range(m - 1, -1, -1):  # an anchor is the first of its rows: it goes last
        if anchor[j] >= 0:
            for lane in range(LANES):
                out[j, lane] -= out[anchor[j], lane]
    for i in range(len(linear)):
        for lane in range(LANES):
            value[i, lane] = 0.0
        for j in range(m):
            share = linear[i, j]
            if share != 0.0:
                for lane in range(LANES):
                    value[i, lane] += share * out[j, lane]


@compiled
def stand(
    station: Array, item: Array, reference: int, place: Array, origin: Array, centre: Array, spread: Array, spare: Array
) -> None:
    """Take the stations of a block of problems.

    Parameters
    ----------
    station : array (N or 1, s, d)
        Positions, metres.
    item : int64 array (W,)
        Problem of each lane.
    reference : int
        Station that becomes the origin; -1: their mean does.
    place : array (s, d, W)
        Written: positions from the origin.
    origin, centre : array (d, W)
        Written: the origin, and the mean of the stations from there.
    spread : array (W,)
        Written: greatest distance of a station from the mean.
    spare : array (W,)
        Scratch.
    """
    s, d = place.shape[:2]
    shared = len(station) == 1
    for j in range(d):
        for lane in range(LANES):
            centre[j, lane] = 0.0
        for i in range(s):
            for lane in range(LANES):
                place[i, j, lane] = station[0 if shared else item[lane], i, j]
                centre[j, lane] += place[i, j, lane] / s
        for lane in range(LANES):
            # Where the range to one station is unknown it is the apex of the cone: |x| = t holds about it.
            origin[j, lane] = place[reference, j, lane] if reference >= 0 else centre[j, lane]
            centre[j, lane] -= origin[j, lane]
    for lane in range(LANES):
        spread[lane] = 0.0
    for i in range(s):
        for lane in range(LANES):
            spare[lane] = 0.0
        for j in range(d):
            for lane in range(LANES):
                place[i, j, lane] -= origin[j, lane]
                apart = place[i, j, lane] - centre[j, lane]
                spare[lane] += apart * apart
        for lane in range(LANES):
            spread[lane] = max(spread[lane], np.sqrt(spare[lane]))


@compiled
def square(
    c: Array, sign: Array, reference: int, place: Array, spread: Array, scale: Array, rows: Array, spare: Array
) -> None:
    """Square the ranges ``r = c + sign t``: linear in (x, t) with t from the cone, or in (x, |x|^2).

    Parameters
    ----------
    c : array (s, W)
        Least-squares ranges, metres.
    sign : array (s,)
        How the unknown range t enters.
    reference : int
        Station whose range is t; -1 where ranges are determined.
    place, spread : array (s, d, W), (W,)
        Of `stand`.
    scale : array (W,)
        Written: unit of length.
    rows : array (s, d + 2, W)
        Written: coefficients of x and of the last entry, and the right side; scaled.
    spare : array (W,)
        Scratch.
    """
    s, d = place.shape[:2]
    free = reference >= 0
    turn = 2.0 if free else -2.0
    for lane in range(LANES):
        scale[lane] = spread[lane]
    if not free:
        for i in range(s):
            for lane in range(LANES):
                scale[lane] = max(scale[lane], abs(c[i, lane]))
    for lane in range(LANES):
        scale[lane] = scale[lane] if scale[lane] > 0.0 else 1.0
        spare[lane] = 1.0 / scale[lane]
    for i in range(s):
        # The reference's own row would read 0 = 0.
        used = 0.0 if free and (i == reference or sign[i] == 0.0) else 1.0
        for lane in range(LANES):
            # r_i = c_i + s_i t squared, less |x|^2 = t^2: linear in x and t.
            known = used * c[i, lane] * spare[lane]
            rows[i, d + 1, lane] = known * known
            rows[i, d, lane] = 2.0 * sign[i] * known if free else 1.0
        for j in range(d):
            for lane in range(LANES):
                at = used * place[i, j, lane] * spare[lane]
                rows[i, j, lane] = turn * at
                rows[i, d + 1, lane] -= at * at
        if free:
            for lane in range(LANES):
                rows[i, d + 1, lane] = -rows[i, d + 1, lane]


@compiled
def weigh(
    rows: Array, place: Array, y: Array, scale: Array, white: Array, equal: bool, out: Array, spare: Array
) -> None:
    """Divide squared-range rows by twice the ranges, which turns their errors into those of ranges, and whiten them.

    Parameters
    ----------
    rows, place, scale : array (s, d + 2, W), (s, d, W), (W,)
        Of `square` and `stand`.
    y : array (d + 1, W)
        Where the ranges are taken, scaled.
    white : array (s, s)
        Lower triangular whitening matrix of the ranges, 1/metres.
    equal : bool
        Take all ranges as equal instead.
    out : array (s, d + 2, W)
        Written.
    spare : array (W,)
        Scratch.
    """
    s, d = place.shape[:2]
    for i in range(s):
        for lane in range(LANES):
            spare[lane] = 0.0
        for j in range(d):
            for lane in range(LANES):
                apart = y[j, lane] - place[i, j, lane] / scale[lane]
                spare[lane] += apart * apart
        for lane in range(LANES):
            spare[lane] = 0.5 * scale[lane] / (1.0 if equal else max(np.sqrt(spare[lane]), _NEAR))
        for j in range(d + 2):
            for lane in range(LANES):
                out[i, j, lane] = spare[lane] * rows[i, j, lane]
    # From the last row up: each needs those above it as they were.
    for i in range(s - 1, -1, -1):
        for j in range(d + 2):
            for lane in range(LANES):
                out[i, j, lane] *= white[i, i]
        for k in range(i):
            share = white[i, k]
            if share != 0.0:
                for j in range(d + 2):
                    for lane in range(LANES):
                        out[i, j, lane] += share * out[k, j, lane]


# The fix: start, refinement and covariance, and what makes it plainly good.

# Steps after which the problems of a block that still move wait for each other: fixes near their stations take two to
# five.
_FEW = 6
# A tenfold margin to the share below which a direction counts as open (1e-12): between them the long way decides.
_WEAK = 1e-11
# A fourfold margin to the spreads of the stations from which on a fix is doubted.
_FAR = 2.5e3


class Model(NamedTuple):
    """Linear maps from measurements z to all that a fix needs; every row is a sum of ranges to s stations.

    Parameters
    ----------
    row : array (2, m)
        Known amount by which each measurement exceeds the model, metres; one over its variance, 0 where absent.
    anchor : int64 array (m,)
        Row whose measurement is subtracted first, -1 for none: emission times count from it.
    linear : array (s + q + e + l, m)
        Maps to the least-squares ranges c, known up to sign * t; to whitened rows u, of which the cost is
        ``|u - K r|^2 + |loops|^2``; to emission times for zero ranges; and to the loops, which depend on no range.
    sign : array (s,)
        How the unknown range t enters each; zeros where the ranges are determined.
    reference : int
        Station whose range is t; -1 where the ranges are determined.
    white : array (s, s)
        Lower triangular whitening matrix of c.
    K : array (q, s)
        Whitened rows over the ranges.
    travel : array (e, s)
        How the ranges reduce the emission times.
    start : int64 array (e,)
        Anchor of each emission time, -1 where there is no row.
    """

    row: Array
    anchor: Array
    linear: Array
    sign: Array
    reference: int
    white: Array
    K: Array
    travel: Array
    start: Array


@compiled
def fixes(
    model: Model,
    z: Array,
    station: Array,
    tolerance: float,
    most: int,
    x: Array,
    covariance: Array,
    cost: Array,
    plain: Array,
) -> int:
    """Fix N positions from ranges, each from measurements alone, and return the most steps that one took.

    Parameters
    ----------
    model : Model
        What all problems share.
    z : array (N, m)
        Measurements, metres.
    station : array (N or 1, s, d)
        Stations, metres.
    tolerance, most : float, int
        Tolerance and limit of `optloc.compute.range_refine.refine`.
    x : array (N, d + e)
        Written: positions, then emission times (times c, metres).
    covariance : array (N, d, d)
        Written: of the positions.
    cost : array (N,)
        Written: weighted sums of squared residuals.
    plain : bool array (N,)
        Written: whether the fix is plainly good: a finite input, an exact start, a finished refinement, a regular
        covariance, a place that is not far away. The others need a closer look.
    """
    row, anchor, linear, sign, reference, white, K, travel, start = model
    count, (s, d), q, e = len(z), station.shape[1:], len(K), len(start)
    item, late = np.empty(LANES, np.int64), np.empty(count, np.int64)
    seen, value = np.zeros((z.shape[1], LANES)), np.zeros((len(linear), LANES))
    place, unit, r = np.zeros((s, d, LANES)), np.zeros((s, d, LANES)), np.zeros((s, LANES))
    squared, rows = np.zeros((s, d + 2, LANES)), np.zeros((s, d + 2, LANES))
    y, work = np.zeros((d + 1, LANES)), np.zeros((scratch(d + 1), LANES))
    vector, matrix, scalar = np.zeros((10, d, LANES)), np.zeros((3, d, d, LANES)), np.zeros((14, LANES))
    c, u, emission, loops = value[:s], value[s : s + q], value[s + q : s + q + e], value[s + q + e :]
    spare, good = scalar[SPARE], scalar[GOOD]
    # First all blocks with a few steps, then those that still move, collected in full blocks.
    waiting, first, steps, again = 0, 0, 0, False
    while first < (waiting if again else count):
        size = min(LANES, (waiting if again else count) - first)
        for lane in range(LANES):
            at = first + min(lane, size - 1)
            item[lane] = late[at] if again else at
        read(z, item, row, anchor, linear, seen, value, scalar[BLUR], good)
        _loops(loops, scalar[LOOP])
        if len(station) > 1 or (first == 0 and not again):
            stand(station, item, reference, place, vector[ORIGIN], vector[CENTRE], scalar[SPREAD], spare)
        if again:
            _resume(x, item, vector)
        else:
            square(c, sign, reference, place, scalar[SPREAD], scalar[SCALE], squared, spare)
            # All ranges as equal first, then weighed by the ranges of that answer: near to maximum likelihood, and no
            # guess.
            for turn in range(2):
                weigh(squared, place, y, scalar[SCALE], white, turn == 0, rows, spare)
                minimise(rows, reference >= 0, y, scalar[SOLVABLE], work)
                _accept(y, scalar[SOLVABLE], good, scalar[SCALE], vector[X])
        refine(K, u, place, r, unit, vector, matrix, scalar, tolerance, most - _FEW if again else min(_FEW, most))
        _invert(vector, matrix, scalar)
        if e:
            ranges(place, vector[X], r, unit, spare)
            _emit(travel, r, start, row, z, item, emission)
        _write(vector, matrix, scalar, emission, item[:size], x, covariance, cost, plain)
        for lane in range(size):
            steps = max(steps, int(scalar[STEPS, lane]) + (_FEW if again else 0))
            if not again and scalar[ALIVE, lane] != 0.0 and most > _FEW:
                late[waiting] = item[lane]
                waiting += 1
        first += LANES
        if not again and first >= count:
            first, again = 0, True
    return steps


@compiled
def _loops(loops: Array, cost: Array) -> None:
    """Write the cost of the loops."""
    count = len(loops)
    for lane in range(LANES):
        cost[lane] = 0.0
    for i in range(count):
        for lane in range(LANES):
            cost[lane] += loops[i, lane] * loops[i, lane]


@compiled
def _accept(y: Array, settled: Array, good: Array, scale: Array, x: Array) -> None:
    """Take positions from squared-range answers; those that are not settled, or behind the stations, are not good."""
    d = len(x)
    for lane in range(LANES):
        good[lane] = good[lane] * settled[lane] if y[d, lane] >= 0.0 else 0.0
    for j in range(d):
        for lane in range(LANES):
            y[j, lane] = y[j, lane] if good[lane] != 0.0 else 0.0
            x[j, lane] = y[j, lane] * scale[lane]


@compiled
def _resume(x: Array, item: Array, vector: Array) -> None:
    """Go on from the positions reached so far."""
    for j in range(vector.shape[1]):
        for lane in range(LANES):
            vector[X, j, lane] = x[item[lane], j] - vector[ORIGIN, j, lane]


@compiled
def _emit(travel: Array, r: Array, start: Array, row: Array, z: Array, item: Array, emission: Array) -> None:
    """Complete the emission times: less the ranges' share, plus the measurement that they count from."""
    for j in range(len(start)):
        at = start[j]
        for lane in range(LANES):
            total = emission[j, lane] + (z[item[lane], at] - row[0, at] if at >= 0 else 0.0)
            for k in range(len(r)):
                total -= travel[j, k] * r[k, lane]
            emission[j, lane] = total


@compiled
def _write(
    vector: Array,
    matrix: Array,
    scalar: Array,
    emission: Array,
    item: Array,
    x: Array,
    covariance: Array,
    cost: Array,
    plain: Array,
) -> None:
    """Write the first lanes to the fixes of their problems."""
    d = vector.shape[1]
    for lane, i in enumerate(item):
        plain[i] = scalar[SOLVABLE, lane] * scalar[GOOD, lane] > scalar[ALIVE, lane]
        cost[i] = scalar[COST, lane]
        for j in range(d):
            x[i, j] = vector[X, j, lane] + vector[ORIGIN, j, lane]
            for k in range(d):
                covariance[i, j, k] = matrix[H_TRIAL, max(j, k), min(j, k), lane]
        for j in range(len(emission)):
            x[i, d + j] = emission[j, lane]


@compiled
def _invert(vector: Array, matrix: Array, scalar: Array) -> None:
    """Write the lower half of the covariance over H_TRIAL, and whether it is regular and the fix near to SOLVABLE."""
    d = vector.shape[1]
    diagonal, inverse, move, fine, away = (
        vector[DIAGONAL],
        vector[INVERSE],
        vector[MOVE],
        scalar[SOLVABLE],
        scalar[SPARE],
    )
    for lane in range(LANES):
        away[lane] = 0.0
    for i in range(d):
        for lane in range(LANES):
            diagonal[i, lane] = matrix[H, i, i, lane]
            apart = (vector[X, i, lane] - vector[CENTRE, i, lane]) / scalar[SPREAD, lane]
            away[lane] += apart * apart
    for lane in range(LANES):
        # Far away the cost hardly depends on the distance: verdicts there need the stages of the long way.
        fine[lane] = 1.0 if away[lane] <= _FAR * _FAR else 0.0
    factor_plain(matrix[H], diagonal, matrix[LOWER], inverse)
    for j in range(d):
        for i in range(d):
            for lane in range(LANES):
                move[i, lane] = 1.0 if i == j else 0.0
        solve_plain(matrix[LOWER], inverse, move)
        for lane in range(LANES):
            fine[lane] = fine[lane] if 0.0 < inverse[j, lane] * diagonal[j, lane] < 1.0 / _WEAK else 0.0
        for i in range(j, d):
            for lane in range(LANES):
                matrix[H_TRIAL, i, j, lane] = move[i, lane]
