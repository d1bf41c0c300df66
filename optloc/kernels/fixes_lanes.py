"""What a block of fixes from ranges needs: the model that all problems share, and the scratch of a block of lanes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.kernels.gtrs import LANES, scratch
from optloc.kernels.jit import compiled
from optloc.types import Array


class Model(NamedTuple):
    """Linear maps from measurements z to all that a fix needs; every row is a sum of ranges to s stations.

    Parameters
    ----------
    present : float array (m,)
        1.0 for a row that counts, 0.0 for an absent one.
    correction : array (m,)
        Known amount by which the measurement exceeds the model, metres.
    precision : array (m,)
        One over the variance of each row; zero where absent.
    anchor : int64 array (m,)
        Row whose measurement is subtracted first, -1 for none: emission times count from it.
    offset : array (s, m)
        Least-squares ranges c = offset z, known up to sign * t.
    sign : array (s,)
        How the unknown range t enters each; zeros where the ranges are determined.
    reference : int
        Station whose range is t.
    white : array (s, s)
        Lower triangular whitening matrix of c.
    K : array (q, s)
        Whitened rows over the ranges: the cost is ``|right z - K r|^2 + |loops z|^2``.
    right : array (q, m)
        See `K`.
    loops : array (l, m)
        What the rows say about each other whatever the ranges are.
    emission : array (e, m)
        Emission times are ``emission z - travel r``, plus that of their anchor.
    travel : array (e, s)
        See `emission`.
    start : int64 array (e,)
        Anchor of each emission time.
    limit : float
        Cost above which the residuals are larger than the noise allows.
    """

    present: Array
    correction: Array
    precision: Array
    anchor: Array
    offset: Array
    sign: Array
    reference: int
    white: Array
    K: Array
    right: Array
    loops: Array
    emission: Array
    travel: Array
    start: Array
    limit: float


class Lanes(NamedTuple):
    """Scratch of one block; the last axis counts its W problems, lengths are in metres unless said otherwise.

    Parameters
    ----------
    z : array (m, W)
        Measurements less corrections and anchors.
    c, u : array (s, W), (q, W)
        Least-squares ranges, and whitened rows.
    place : array (s, d, W)
        Stations from the origin of the problem.
    origin, centre : array (d, W)
        Of the coordinates, in the frame of the problem; the mean of the stations from there.
    spread : array (W,)
        Greatest distance of a station from their mean.
    scale : array (W,)
        Unit of the squared-range problem.
    squared, rows, right : array (s, d + 2, W), (s, d + 1, W), (s, W)
        Squared-range rows with their right sides, scaled; the same whitened.
    y, settled, work : array (d + 1, W), (W,), (scratch, W)
        Of `optloc.kernels.gtrs.minimise`.
    x, trial, move : array (d, W)
        Position from the origin, the one tried, and the step to it.
    r, unit : array (s, W), (s, d, W)
        Ranges and unit vectors at a point.
    H, H2, g, g2, cost, cost2 : arrays (d, d, W), (d, W), (W,)
        Information (lower half), right-hand side and cost at `x` and at `trial`.
    lower, inverse, diagonal, row : arrays (d, d, W), (d, W), (d, W), (d, W)
        Factorisation, and one row of the Jacobian.
    emission : array (e, W)
        Emission times.
    loop, blur, damping, growth, alive, good, steps, extra, spare : array (W,)
        Cost of the loops; rounding error of the whitened residuals; state of the refinement; scratch.
    """

    z: Array
    c: Array
    u: Array
    place: Array
    origin: Array
    centre: Array
    spread: Array
    scale: Array
    squared: Array
    rows: Array
    right: Array
    y: Array
    settled: Array
    work: Array
    x: Array
    trial: Array
    move: Array
    r: Array
    unit: Array
    H: Array
    H2: Array
    g: Array
    g2: Array
    cost: Array
    cost2: Array
    lower: Array
    inverse: Array
    diagonal: Array
    row: Array
    emission: Array
    loop: Array
    blur: Array
    damping: Array
    growth: Array
    alive: Array
    good: Array
    steps: Array
    extra: Array
    spare: Array


@compiled
def lanes_for(model: Model, d: int) -> Lanes:
    """Return the scratch of a block of problems in d dimensions."""
    m, s, q, w, n = len(model.present), len(model.sign), len(model.K), LANES, d + 1
    return Lanes(
        np.zeros((m, w)),
        np.zeros((s, w)),
        np.zeros((q, w)),
        np.zeros((s, d, w)),
        np.zeros((d, w)),
        np.zeros((d, w)),
        np.zeros(w),
        np.ones(w),
        np.zeros((s, n + 1, w)),
        np.zeros((s, n, w)),
        np.zeros((s, w)),
        np.zeros((n, w)),
        np.zeros(w),
        np.zeros((scratch(n), w)),
        np.zeros((d, w)),
        np.zeros((d, w)),
        np.zeros((d, w)),
        np.zeros((s, w)),
        np.zeros((s, d, w)),
        np.zeros((d, d, w)),
        np.zeros((d, d, w)),
        np.zeros((d, w)),
        np.zeros((d, w)),
        np.zeros(w),
        np.zeros(w),
        np.zeros((d, d, w)),
        np.zeros((d, w)),
        np.zeros((d, w)),
        np.zeros((d, w)),
        np.zeros((len(model.emission), w)),
        np.zeros(w),
        np.zeros(w),
        np.zeros(w),
        np.zeros(w),
        np.zeros(w),
        np.zeros(w),
        np.zeros(w),
        np.zeros(w),
        np.zeros(w),
    )


@compiled
def apply(matrix: Array, values: Array, out: Array) -> None:
    """Write the product of one matrix (p, q) for all problems with a vector (q, W) of each into out (p, W)."""
    p, q = matrix.shape
    width = out.shape[1]
    for i in range(p):
        for lane in range(width):
            out[i, lane] = 0.0
        for j in range(q):
            factor = matrix[i, j]
            if factor != 0.0:
                for lane in range(width):
                    out[i, lane] += factor * values[j, lane]
