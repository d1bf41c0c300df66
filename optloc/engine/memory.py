"""What all problems of a plan share, the memory of a block of them, and what is found."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.compute.gtrs import scratch
from optloc.compute.jit import compiled
from optloc.compute.systems import LANES

ROUNDING = 4.0 * 2.220446049250313e-16
"""Share of a measurement that is rounding: four of a double lie between it and its residual."""

# Rows of `Room.vector`: where a refinement stands and what it tries, each followed by the same of a trial; FIX and
# NORMAL are the fix whose mirror image is refined, and the direction in which the stations spread least.
X, TRIAL, MOVE, G, G_TRIAL, DIAGONAL, INVERSE, ROW, ORIGIN, CENTRE, FIX, NORMAL = range(12)
# Rows of `Room.matrix`: information and factor; FIX_H is the information at the fix, MARGIN what is left of it without
# the unknowns beside the position, and REST the same at a trial.
H, H_TRIAL, LOWER, FIX_H, MARGIN, REST = range(6)
# Rows of `Room.axes`: BASE spans a chart, AXES are principal axes, EIGEN is the matrix that they make diagonal.
BASE, AXES, EIGEN = range(3)
# Rows of `Room.scalar`.
COST, COST_TRIAL, LOOP, BLUR, DAMPING, GROWTH, GAIN, SOLVABLE, SPARE, ALIVE, GOOD, STEPS, SCALE, SPREAD = range(14)
FIX_COST, FIX_GOOD, HEIGHT, HIGH, LOW, SHARE, BEYOND = range(14, 21)


class Model(NamedTuple):
    """How measurements z become a start: linear maps to ranges to s stations, and what the rows are corrected by.

    Parameters
    ----------
    row : array (3, m)
        Known amount by which each measurement exceeds the model; one over its variance, 0 where absent; and what it is
        multiplied with then.
    anchor : int64 array (m,)
        Row whose measurement is subtracted first, -1 for none: emission times count from it.
    linear : array (s + v, m)
        Maps to the least-squares ranges c, known up to sign * t, and to v more values that an evaluator wants.
    sign : array (s,)
        How the unknown range t enters each; zeros where the ranges are determined.
    ranged : array (s,)
        1.0 for the stations whose range is known, up to t.
    reference : int
        Station whose range is t; -1 where the ranges are determined.
    white : array (s, s)
        Lower triangular whitening matrix of c.
    """

    row: Array
    anchor: Array
    linear: Array
    sign: Array
    ranged: Array
    reference: int
    white: Array


class Answer(NamedTuple):
    """What is found of N problems, in arrays that are written.

    Parameters
    ----------
    x : array (N, size)
        Parameter vectors, the position first.
    covariance : array (N, n, n)
        Of the first n unknowns.
    cost : array (N,)
        Weighted sums of squared residuals.
    settled : bool array (N,)
        Whether a fix is a good one: a finite input, an exact start, a finished refinement, a regular covariance, a
        place that is not far away. The others need a closer look, and nothing below is known of them.
    rival : array (N, size)
        Another minimum that the mirror image of the fix leads to, and which costs no more than `LISTED` more; NaN.
    rival_cost : array (N,)
        Its cost; infinite where there is none.
    kappa : array (N, 2)
        How far the cost is from the square of a distance, in metres and in inverse range; NaN where not measured.
    infinity : array (N,)
        Least cost at infinity, exactly where it is less than `BEYOND_DOUBT` above the fix, else a lower bound above
        that; infinite where the cost grows without bound, NaN where nobody has looked.
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
    """Memory of a block of W problems of p unknowns, the first d of which are the position, and of s stations.

    Parameters
    ----------
    d : int
        Coordinates of a position.
    item : int64 array (W,)
        Problem of each lane.
    seen : array (m, W)
        Measurements.
    value : array (s + v, W)
        Their images under `Model.linear`.
    place : array (s, d, W)
        Stations from the origin, metres.
    squared, rows : array (s, d + 2, W), (s + l, d + 2, W)
        Squared-range rows as they are; and weighed, behind them the l linear rows of other kinds.
    y, work : array (d + 1, W), (n, W)
        Squared-range answers, and scratch of `optloc.compute.gtrs.minimise`.
    vector, matrix, axes, scalar : array (12, p, W), (6, p, p, W), (3, d, d, W), (21, W)
        See the names of their rows. Positions count from the origin, row ORIGIN.
    own : named tuple
        What the evaluator of the rows keeps.
    """

    d: int
    item: Array
    seen: Array
    value: Array
    place: Array
    squared: Array
    rows: Array
    y: Array
    work: Array
    vector: Array
    matrix: Array
    axes: Array
    scalar: Array
    own: Any


@compiled
def make_room(model: Model, own: Any, stations: int, d: int, unknowns: int, others: int) -> Room:
    """Return the memory of a block of problems: of so many unknowns, with so many linear rows of other kinds."""
    s, p, m = stations, unknowns, model.row.shape[1]
    return Room(
        d,
        np.empty(LANES, np.int64),
        np.zeros((m, LANES)),
        np.zeros((len(model.linear), LANES)),
        np.zeros((s, d, LANES)),
        np.zeros((s, d + 2, LANES)),
        np.zeros((s + others, d + 2, LANES)),
        np.zeros((d + 1, LANES)),
        np.zeros((scratch(d + 1), LANES)),
        np.zeros((12, p, LANES)),
        np.zeros((6, p, p, LANES)),
        np.zeros((3, d, d, LANES)),
        np.zeros((21, LANES)),
        own,
    )
