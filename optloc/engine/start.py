"""The start of a fix: squared ranges and other linear rows, minimised exactly."""

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
"""Least distance from a station that weighs a row, in units of the stations' spread: at the station itself a squared
range has no first-order error, and its weight would be infinite."""


@compiled
def begin(model: EngineModel, rows: Any, room: EngineWorkspace) -> None:
    """Find starts: squared ranges weighed as equal first, then by the ranges of that answer; or in other ways."""
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
    # near to maximum likelihood, and no guess
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
    """Take the measurements of a block of problems, and everything that is linear in them.

    Parameters
    ----------
    z : array (N, m)
        Measurements, metres.
    item : int64 array (W,)
        Problem of each lane.
    row : array (3, m)
        Of each row: known amount by which the measurement exceeds the model; one over its variance, 0 where absent; and
        what the measurement is multiplied with then.
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
            out[j, lane] *= row[2, j]
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
def load_stations(
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
    """Square the ranges ``r = c + sign t``: linear in (x, t) with t from the cone, or in (x, |x|^2).

    Parameters
    ----------
    c : array (s, W)
        Least-squares ranges, metres.
    station : array (4, s)
        Of `optloc.engine.memory.EngineModel`.
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
        sign = station[SIGN, i]
        used = 0.0 if free and (i == reference or sign == 0.0) else station[RANGED, i]
        for lane in range(LANES):
            # r_i = c_i + s_i t squared, less |x|^2 = t^2: linear in x and t.
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
            spare[lane] = 0.5 * scale[lane] / (1.0 if equal else max(np.sqrt(spare[lane]), NEAR))
        for j in range(d + 2):
            for lane in range(LANES):
                out[i, j, lane] = spare[lane] * rows[i, j, lane]
    # From the last row up: each row needs the rows above it unchanged.
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
    """Take positions from squared-range answers; those that are not settled, or behind the stations, are not good."""
    d = len(y) - 1
    for lane in range(LANES):
        good[lane] = good[lane] * settled[lane] if y[d, lane] >= 0.0 else 0.0
    for j in range(d):
        for lane in range(LANES):
            y[j, lane] = y[j, lane] if good[lane] != 0.0 else 0.0
            x[j, lane] = y[j, lane] * scale[lane]
