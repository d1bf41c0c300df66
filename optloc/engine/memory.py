"""Data that all problems of a plan share, the memory of a block of problems, and answers."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.compute.gtrs import scratch
from optloc.compute.jit import compiled
from optloc.compute.systems import LANES

ROUNDING = 4.0 * 2.220446049250313e-16
"""Share of a measurement that is rounding: four of a double lie between it and its residual."""

# Rows of `Room.vector`: current and tried values of a refinement, each followed by its trial; FIX and
# NORMAL are the fix whose mirror image is refined, and the direction in which the stations spread least; OTHER is a
# second start, where SECOND is 1.
X, TRIAL, MOVE, G, G_TRIAL, DIAGONAL, INVERSE, ROW, ORIGIN, CENTRE, FIX, NORMAL, OTHER = range(13)
# Rows of `Room.matrix`: information and factor; FIX_H is the information at the fix, MARGIN the information about
# the position alone, and REST the same at a trial.
H, H_TRIAL, LOWER, FIX_H, MARGIN, REST = range(6)
# Rows of `Room.axes`: BASE spans a chart, AXES are principal axes, EIGEN is the matrix that they make diagonal.
BASE, AXES, EIGEN = range(3)
# Rows of `Room.scalar`.
COST, COST_TRIAL, LOOP, BLUR, DAMPING, GROWTH, GAIN, SOLVABLE, SPARE, ALIVE, GOOD, STEPS, SCALE, SPREAD = range(14)
FIX_COST, FIX_GOOD, HEIGHT, HIGH, LOW, SHARE, BEYOND, SECOND = range(14, 22)


class Admission(NamedTuple):
    """Quantities of a position that are held or bounded, as tapes, and the Earth.

    Parameters
    ----------
    exact : int
        Number of held quantities; they come first.
    code : int64 array (n, 4)
        Operations of all tapes, see `optloc.compute.trace.Tape`.
    block : int64 array (k + 1, 3)
        Where operations, constants and inputs of each begin.
    constant : int64 array (c,), value : array (c,)
        Registers of constants, and what they hold.
    input : int64 array (i, 2)
        Registers of inputs, and which coordinate each is.
    output : int64 array (k, 1 + d)
        Registers of value and derivatives; -1 for a derivative of zero.
    level : array (N or 1, k, 2)
        Lower and upper bounds.
    registers : int
        How many.
    earth : bool
        Whether there is one: then an Earth-centred position is ``turn x + origin``.
    turn, origin : array (3, 3), (3,)
        See there.
    heard, seen : array (s,)
        1.0 for places with a row, and for places with an angle.
    """

    exact: int
    code: Array
    block: Array
    constant: Array
    value: Array
    input: Array
    output: Array
    level: Array
    registers: int
    earth: bool
    turn: Array
    origin: Array
    heard: Array
    seen: Array


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
    admission : Admission
        Which positions are admitted.
    """

    row: Array
    anchor: Array
    linear: Array
    sign: Array
    ranged: Array
    reference: int
    white: Array
    admission: Admission


class Answer(NamedTuple):
    """Answers to N problems, in arrays that are written.

    Parameters
    ----------
    x : array (N, size)
        Parameter vectors, the position first.
    covariance : array (N, n, n)
        Of the first n unknowns.
    multiplier : array (N, c)
        Of what is held: the gradient of the cost and its gradients times these add up to nothing.
    quantity, normal : array (N, k), (N, k, d)
        What is held or bounded, and its gradients.
    cost : array (N,)
        Weighted sums of squared residuals.
    settled : bool array (N,)
        Whether a fix is a good one: a finite input, an exact start, a finished refinement, a regular covariance, a
        place that is not far away. The others need a closer look, and nothing below is known of them.
    rival : array (N, size)
        Another minimum that the mirror image of the fix leads to, and which costs no more than `LISTED` more; NaN.
    rival_cost : array (N,)
        Its cost; infinite without a rival.
    kappa : array (N, 2)
        How far the cost is from the square of a distance, in metres and in inverse range; NaN where not measured.
    infinity : array (N,)
        Least cost at infinity, exactly where it is less than `BEYOND_DOUBT` above the fix, else a lower bound above
        that; infinite where the cost grows without bound, NaN where not measured.
    """

    x: Array
    covariance: Array
    multiplier: Array
    quantity: Array
    normal: Array
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
    y, second, work : array (d + 1, W), (d + 1, W), (n, W)
        Squared-range answers, second ones, and scratch of `optloc.compute.gtrs.minimise`.
    vector, matrix, axes, scalar : array (13, p, W), (6, p, p, W), (3, d, d, W), (22, W)
        See the names of their rows. Positions count from the origin, row ORIGIN.
    face, push : array (2, k, d, W), (c, p, W)
        Gradients of quantities at rows X and TRIAL; of those that are held, their products with an inverse.
    small, part, pivot, diagonal : array (2, c, c, W), (c, W), (c, W), (c, W)
        Products of these with each other, and scratch.
    level, quantity : array (k, 2, W), (k, W)
        Bounds, and what they bound.
    registers, spot : array (r, W), (2, 3)
        Scratch.
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
    second: Array
    work: Array
    vector: Array
    matrix: Array
    axes: Array
    scalar: Array
    face: Array
    push: Array
    small: Array
    part: Array
    pivot: Array
    diagonal: Array
    level: Array
    quantity: Array
    registers: Array
    spot: Array
    own: Any


@compiled
def make_room(model: Model, own: Any, stations: int, d: int, unknowns: int, others: int) -> Room:
    """Return the memory of a block of problems, for numbers of stations, coordinates, unknowns and linear rows."""
    s, p, m = stations, unknowns, model.row.shape[1]
    c, k = model.admission.exact, len(model.admission.output)
    return Room(
        d,
        np.empty(LANES, np.int64),
        np.zeros((m, LANES)),
        np.zeros((len(model.linear), LANES)),
        np.zeros((s, d, LANES)),
        np.zeros((s, d + 2, LANES)),
        np.zeros((s + others, d + 2, LANES)),
        np.zeros((d + 1, LANES)),
        np.zeros((d + 1, LANES)),
        np.zeros((scratch(d + 1), LANES)),
        np.zeros((13, p, LANES)),
        np.zeros((6, p, p, LANES)),
        np.zeros((3, d, d, LANES)),
        np.zeros((22, LANES)),
        np.zeros((2, k, d, LANES)),
        np.zeros((c, p, LANES)),
        np.zeros((2, c, c, LANES)),
        np.zeros((c, LANES)),
        np.zeros((c, LANES)),
        np.zeros((c, LANES)),
        np.zeros((k, 2, LANES)),
        np.zeros((k, LANES)),
        np.zeros((model.admission.registers, LANES)),
        np.zeros((2, 3)),
        own,
    )
