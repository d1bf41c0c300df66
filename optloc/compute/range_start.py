"""The start of fixes from ranges: the model that problems share, memory for a block of them, squared ranges."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.compute.gtrs import scratch
from optloc.compute.jit import compiled
from optloc.compute.systems import LANES

# Least distance from a station that weighs a row, in units of the stations' spread: at the station itself a squared
# range has no first-order error, and its weight would be infinite.
_NEAR = 1e-3
ROUNDING = 4.0 * 2.220446049250313e-16
"""Share of a measurement that is rounding: four of a double lie between it and its residual."""


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
        blur[lane] = ROUNDING * np.sqrt(blur[lane])
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


# The model, and the memory of a block.

# Rows of `Room.vector`: where a refinement stands and what it tries; FIX and NORMAL are the fix whose mirror image is
# refined, and the direction in which the stations spread least.
X, TRIAL, MOVE, G, G_TRIAL, DIAGONAL, INVERSE, ROW, ORIGIN, CENTRE, FIX, NORMAL = range(12)
# Rows of `Room.matrix`: information and factor; BASE spans a chart, AXES are principal axes, and FIX_H is the
# information at the fix.
H, H_TRIAL, LOWER, FIX_H, BASE, AXES = range(6)
# Rows of `Room.scalar`.
COST, COST_TRIAL, LOOP, BLUR, DAMPING, GROWTH, GAIN, SOLVABLE, SPARE, ALIVE, GOOD, STEPS, SCALE, SPREAD = range(14)
FIX_COST, FIX_GOOD, HEIGHT, HIGH, LOW, SHARE, BEYOND = range(14, 21)


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
        Whitened rows over the ranges, 1/metres.
    travel : array (e, s)
        How the ranges reduce the emission times.
    start : int64 array (e,)
        Anchor of each emission time, -1 where there is no row.
    norm : float
        Greatest singular value of K.
    level : bool
        Whether K takes no notice of what all ranges have in common: then the cost has limits at infinity.
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
    norm: float
    level: bool


class Answer(NamedTuple):
    """What is found of N problems, in arrays that are written.

    Parameters
    ----------
    x : array (N, d + e)
        Positions, then emission times (times c, metres).
    covariance : array (N, d, d)
        Of the positions.
    cost : array (N,)
        Weighted sums of squared residuals.
    settled : bool array (N,)
        Whether a fix is a good one: a finite input, an exact start, a finished refinement, a regular covariance, a
        place that is not far away. The others need a closer look, and nothing below is known of them.
    rival : array (N, d + e)
        Another minimum that the mirror image of the fix leads to, and which costs no more than `LISTED` more; NaN.
    rival_cost : array (N,)
        Its cost; infinite where there is none.
    kappa : array (N, 2)
        How far the cost is from the square of a distance, in metres and in inverse range; NaN where not measured.
    infinity : array (N,)
        Least cost at infinity, exactly where it is less than `BEYOND_DOUBT` above the fix, else a lower bound above
        that; infinite where the cost grows without bound.
    """

    x: Array
    covariance: Array
    cost: Array
    settled: Array
    rival: Array
    rival_cost: Array
    kappa: Array
    infinity: Array


class Room(NamedTuple):
    """Memory of a block of W problems of s stations in d dimensions.

    Parameters
    ----------
    item : int64 array (W,)
        Problem of each lane.
    seen : array (m, W)
        Measurements.
    value : array (s + q + e + l, W)
        Their images under `Model.linear`.
    place : array (s, d, W)
        Stations, metres.
    unit, r : array (s, d, W), (s, W)
        Unit vectors from the stations, and ranges.
    squared, rows : array (s, d + 2, W)
        Squared-range rows, as they are and weighed.
    y, work : array (d + 1, W), (n, W)
        Squared-range answers, and scratch of `optloc.compute.gtrs.minimise`.
    vector, matrix, scalar : array (12, d, W), (6, d, d, W), (21, W)
        See the names of their rows.
    sent : array (e, W)
        Emission times.
    flat : array (q, d, W)
        How the whitened rows fall with the direction of a remote emitter, along principal axes.
    bend : array (d, W)
        Eigenvalues of that map's square.
    """

    item: Array
    seen: Array
    value: Array
    place: Array
    unit: Array
    r: Array
    squared: Array
    rows: Array
    y: Array
    work: Array
    vector: Array
    matrix: Array
    scalar: Array
    sent: Array
    flat: Array
    bend: Array


@compiled
def make_room(model: Model, stations: int, d: int) -> Room:
    """Return the memory of a block of problems."""
    s, m = stations, model.row.shape[1]
    return Room(
        np.empty(LANES, np.int64),
        np.zeros((m, LANES)),
        np.zeros((len(model.linear), LANES)),
        np.zeros((s, d, LANES)),
        np.zeros((s, d, LANES)),
        np.zeros((s, LANES)),
        np.zeros((s, d + 2, LANES)),
        np.zeros((s, d + 2, LANES)),
        np.zeros((d + 1, LANES)),
        np.zeros((scratch(d + 1), LANES)),
        np.zeros((12, d, LANES)),
        np.zeros((6, d, d, LANES)),
        np.zeros((21, LANES)),
        np.zeros((len(model.start), LANES)),
        np.zeros((len(model.K), d, LANES)),
        np.zeros((d, LANES)),
    )
