"""The start of a fix: the exact minimiser of the squared ranges and the other linear rows.

A block has W problems of s stations and d coordinates, one in each lane. The range to station i is ``r_i = c_i + s_i
t``: c_i follows from the measurements, s_i is 1, -1 or 0, and t is one unknown.

Names in capitals, such as X or GOOD, are rows of the arrays of `optloc.engine.memory.EngineWorkspace`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.base.types import Array
from optloc.engine.admission import restore
from optloc.engine.evaluator import complete, minimise_start, scout
from optloc.engine.memory import (
    BY_SQUARES,
    GOOD,
    OTHER,
    RANGED,
    ROUNDING,
    SCALE,
    SECOND,
    SIGN,
    SOLVABLE,
    SPARE,
    SPREAD,
    EngineModel,
    EngineWorkspace,
    X,
)
from optloc.kernels.gtrs import meet
from optloc.kernels.jit import compiled
from optloc.kernels.systems import LANES

NEAR = 1e-3
"""Least distance from a station in the weight of a row, in units of the stations' spread. At the station a squared
range has no first-order error, so that its weight would be infinite."""


@compiled
def begin(model: EngineModel, rows: Any, room: EngineWorkspace) -> None:
    """Write the starts of a block to row X.

    Squared ranges are solved twice: with weights for equal ranges, then with the ranges of the first solution. Problems
    with another `EngineModel.start` use `scout`.
    """
    scalar, s = room.scalar, len(room.place)
    if model.start != BY_SQUARES:
        scout(model, rows, room)
        return
    square_ranges(
        room.value[:s],
        model.station,
        model.reference,
        room.place,
        scalar[SPREAD],
        scalar[SCALE],
        room.squared,
        scalar[SPARE],
    )
    # the second pass is close to maximum likelihood and needs no initial guess
    for turn in range(2):
        weigh_rows(room.squared, room.place, room.y, scalar[SCALE], model.white, turn == 0, room.rows, scalar[SPARE])
        minimise_start(model, rows, room, turn == 0)
        meet(room.rows, model.reference >= 0, room.y, room.second, scalar[SOLVABLE], scalar[SECOND], room.work)
        _accept(room.y, scalar[SOLVABLE], scalar[GOOD], scalar[SCALE], room.vector[X])
    for i in range(room.d):
        for lane in range(LANES):
            room.vector[OTHER, i, lane] = room.second[i, lane] * scalar[SCALE, lane]
    restore(model, room, 0)
    complete(rows, room)


@compiled
def load_measurements(
    z: Array, item: Array, row: Array, anchor: Array, linear: Array, out: Array, value: Array, blur: Array, good: Array
) -> None:
    """Load the measurements of a block of problems, and compute everything that is linear in them.

    Parameters
    ----------
    z : array (N, m)
        Measurements, SI units or radians.
    item : int64 array (W,)
        Problem of each lane.
    row : array (3, m)
        For each row: the known amount by which the measurement exceeds the model; one over its variance (0 if absent);
        and the factor that multiplies the corrected measurement.
    anchor : int64 array (m,)
        Row whose measurement is subtracted before the sums; -1 for none.
    linear : array (p, m)
        Linear maps of the measurements.
    out : array (m, W)
        Written: measurements less corrections and anchors; zero if absent.
    value : array (p, W)
        Written: the linear maps applied to `out`.
    blur : array (W,)
        Written: rounding error of the whitened residuals.
    good : array (W,)
        Written: 1.0 if all present rows are finite, else 0.0.
    """
    m = len(out)
    for lane in range(LANES):
        blur[lane], good[lane] = 0.0, 1.0
    for j in range(m):
        # An absent row may contain NaN, and zero times NaN is NaN.
        if row[1, j] == 0.0:
            for lane in range(LANES):
                out[j, lane] = 0.0
            continue
        for lane in range(LANES):
            out[j, lane] = z[item[lane], j] - row[0, j]
        for lane in range(LANES):
            blur[lane] += row[1, j] * out[j, lane] * out[j, lane]
            good[lane] = good[lane] if abs(out[j, lane]) < np.inf else 0.0
            out[j, lane] *= row[2, j]
    for lane in range(LANES):
        blur[lane] = ROUNDING * np.sqrt(blur[lane])
    for j in range(m - 1, -1, -1):  # an anchor is the first of its rows, so it is subtracted last
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
def load_stations(
    station: Array, item: Array, reference: int, place: Array, origin: Array, centre: Array, spread: Array, spare: Array
) -> None:
    """Load the stations of a block of problems.

    Parameters
    ----------
    station : array (N or 1, s, d)
        Positions, metres.
    item : int64 array (W,)
        Problem of each lane.
    reference : int
        Station that becomes the origin; with -1, the mean of the stations is the origin.
    place : array (s, d, W)
        Written: positions relative to the origin.
    origin, centre : array (d, W)
        Written: the origin, and the mean of the stations relative to the origin.
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
            # If the range t to one station is unknown, this station is the apex of the cone |x| = t.
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
def square_ranges(
    c: Array,
    station: Array,
    reference: int,
    place: Array,
    spread: Array,
    scale: Array,
    rows: Array,
    spare: Array,
) -> None:
    """Write the squares of the ranges ``r = c + sign t`` as linear rows in (x, t), t from the cone, or in (x, |x|^2).

    Parameters
    ----------
    c : array (s, W)
        Least-squares ranges, metres.
    station : array (4, s)
        `EngineModel.station`.
    reference : int
        Station whose range is t; -1 if all ranges are determined.
    place, spread : array (s, d, W), (W,)
        Results of `load_stations`.
    scale : array (W,)
        Written: unit of length, metres.
    rows : array (s, d + 2, W)
        Written: coefficients of x and of the last coordinate, and the right side; scaled.
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
        # The row of the reference station is 0 = 0.
        sign = station[SIGN, i]
        used = 0.0 if free and (i == reference or sign == 0.0) else station[RANGED, i]
        for lane in range(LANES):
            # The square of r_i = c_i + s_i t, less |x|^2 = t^2, is linear in x and t.
            known = used * c[i, lane] * spare[lane]
            rows[i, d + 1, lane] = known * known
            rows[i, d, lane] = 2.0 * sign * known if free else used
        for j in range(d):
            for lane in range(LANES):
                at = used * place[i, j, lane] * spare[lane]
                rows[i, j, lane] = turn * at
                rows[i, d + 1, lane] -= at * at
        if free:
            for lane in range(LANES):
                rows[i, d + 1, lane] = -rows[i, d + 1, lane]


@compiled
def weigh_rows(
    rows: Array, place: Array, y: Array, scale: Array, white: Array, equal: bool, out: Array, spare: Array
) -> None:
    """Divide squared-range rows by twice the ranges, so that their errors become range errors, and whiten them.

    Parameters
    ----------
    rows, place, scale : array (s, d + 2, W), (s, d, W), (W,)
        Results of `square_ranges` and `load_stations`.
    y : array (d + 1, W)
        Point at which the ranges are computed, scaled.
    white : array (s, s)
        Lower triangular whitening matrix of the ranges, 1/metres.
    equal : bool
        Whether all ranges count as equal, independent of `y`.
    out : array (s, d + 2, W)
        Written: the weighted rows.
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
            spare[lane] = 0.5 * scale[lane] / (1.0 if equal else max(np.sqrt(spare[lane]), NEAR))
        for j in range(d + 2):
            for lane in range(LANES):
                out[i, j, lane] = spare[lane] * rows[i, j, lane]
    # From the last row upwards: each row needs the unchanged rows above it.
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


@compiled
def _accept(y: Array, settled: Array, good: Array, scale: Array, x: Array) -> None:
    """Write the positions of squared-range solutions `y` (d + 1, W) to x (d, W), metres; clear `good` of invalid ones.

    A solution is invalid if `settled` (W,) is 0.0, or if its last coordinate is negative (behind the stations). `scale`
    (W,) is the unit of `y`, metres.
    """
    d = len(y) - 1
    for lane in range(LANES):
        good[lane] = good[lane] * settled[lane] if y[d, lane] >= 0.0 else 0.0
    for j in range(d):
        for lane in range(LANES):
            y[j, lane] = y[j, lane] if good[lane] != 0.0 else 0.0
            x[j, lane] = y[j, lane] * scale[lane]
