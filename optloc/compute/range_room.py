"""What problems of ranges share, and the working memory of a block of them: which number stands where."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.compute.gtrs import scratch
from optloc.compute.jit import compiled
from optloc.compute.systems import LANES

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
