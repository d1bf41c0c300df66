"""The start of a fix from ranges: measurements, stations and squared-range rows of a block of problems."""

from __future__ import annotations

import numpy as np

from optloc.kernels.fixes_lanes import Lanes, Model, apply
from optloc.kernels.gtrs import minimise
from optloc.kernels.jit import compiled
from optloc.types import Array

_NEAR = 1e-3  # least distance from a station that weighs a row, in units of the stations' spread


@compiled
def read(model: Model, z: Array, item: Array, lanes: Lanes) -> None:
    """Take the measurements of a block of problems: least-squares ranges, whitened rows, loops, rounding errors.

    Parameters
    ----------
    model : Model
        What all problems share.
    z : array (N, m)
        Measurements.
    item : int64 array (W,)
        Problem of each lane.
    lanes : Lanes
        Written.
    """
    m, width = lanes.z.shape
    for lane in range(width):
        lanes.blur[lane], lanes.loop[lane], lanes.good[lane] = 0.0, 0.0, 1.0
    for j in range(m):
        if model.present[j] == 0.0:
            for lane in range(width):
                lanes.z[j, lane] = 0.0
            continue
        for lane in range(width):
            lanes.z[j, lane] = z[item[lane], j] - model.correction[j]
        for lane in range(width):
            lanes.blur[lane] += model.precision[j] * lanes.z[j, lane] ** 2
            lanes.good[lane] = lanes.good[lane] if abs(lanes.z[j, lane]) < np.inf else 0.0
    for lane in range(width):
        lanes.blur[lane] = 4.0 * 2.220446049250313e-16 * np.sqrt(lanes.blur[lane])
    for j in range(m - 1, -1, -1):
        at = model.anchor[j]
        if at >= 0 and at != j:
            for lane in range(width):
                lanes.z[j, lane] -= lanes.z[at, lane]
    for j in range(m):
        if model.anchor[j] == j:
            for lane in range(width):
                lanes.z[j, lane] = 0.0
    apply(model.offset, lanes.z, lanes.c)
    apply(model.right, lanes.z, lanes.u)
    for k in range(len(model.loops)):
        apply(model.loops[k : k + 1], lanes.z, lanes.spare.reshape(1, width))
        for lane in range(width):
            lanes.loop[lane] += lanes.spare[lane] ** 2


@compiled
def stand(model: Model, station: Array, item: Array, lanes: Lanes) -> None:
    """Take the stations (N or 1, s, d) of a block of problems: their origin, and the unit of their coordinates."""
    s, d, width = lanes.place.shape
    free = model.sign[model.reference] != 0.0
    shared = len(station) == 1
    for i in range(s):
        for j in range(d):
            for lane in range(width):
                lanes.place[i, j, lane] = station[0 if shared else item[lane], i, j]
    for j in range(d):
        for lane in range(width):
            lanes.centre[j, lane] = 0.0
        for i in range(s):
            for lane in range(width):
                lanes.centre[j, lane] += lanes.place[i, j, lane] / s
        for lane in range(width):
            lanes.origin[j, lane] = lanes.place[model.reference, j, lane] if free else lanes.centre[j, lane]
            lanes.centre[j, lane] -= lanes.origin[j, lane]
    for lane in range(width):
        lanes.spread[lane] = 0.0
    for i in range(s):
        for lane in range(width):
            lanes.spare[lane] = 0.0
        for j in range(d):
            for lane in range(width):
                lanes.place[i, j, lane] -= lanes.origin[j, lane]
                lanes.spare[lane] += (lanes.place[i, j, lane] - lanes.centre[j, lane]) ** 2
        for lane in range(width):
            lanes.spread[lane] = max(lanes.spread[lane], lanes.spare[lane])
    for lane in range(width):
        lanes.spread[lane] = np.sqrt(lanes.spread[lane])


@compiled
def begin(model: Model, lanes: Lanes) -> None:
    """Find where to start: the squared-range fix, with equal weights first and then weighted by its own ranges.

    Lanes whose fix is not settled, or lies behind the stations, are marked in `good`.
    """
    s, d, width = lanes.place.shape
    free = model.sign[model.reference] != 0.0
    _unit(lanes, free)
    _square(model, lanes, free)
    for turn in range(2):
        for i in range(s):
            _weigh(lanes, i, turn == 0)
            for j in range(d + 2):
                row = lanes.rows[i, j] if j <= d else lanes.right[i]
                for lane in range(width):
                    row[lane] = lanes.spare[lane] * lanes.squared[i, j, lane]
        _whiten(model, lanes)
        minimise(lanes.rows, lanes.right, free, lanes.y, lanes.settled, lanes.work)
        for lane in range(width):
            lanes.good[lane] *= lanes.settled[lane]
            lanes.good[lane] = lanes.good[lane] if lanes.y[d, lane] >= 0.0 else 0.0
    for j in range(d):
        for lane in range(width):
            lanes.x[j, lane] = lanes.y[j, lane] * lanes.scale[lane] if lanes.good[lane] != 0.0 else 0.0


@compiled
def _unit(lanes: Lanes, free: bool) -> None:
    """Find the unit of length: the spread of the stations, and of determined ranges."""
    s, width = lanes.c.shape
    for lane in range(width):
        lanes.scale[lane] = lanes.spread[lane]
    if not free:
        for i in range(s):
            for lane in range(width):
                lanes.scale[lane] = max(lanes.scale[lane], abs(lanes.c[i, lane]))
    for lane in range(width):
        lanes.scale[lane] = lanes.scale[lane] if lanes.scale[lane] > 0.0 else 1.0


@compiled
def _square(model: Model, lanes: Lanes, free: bool) -> None:
    """Square ``r = c + sign t``: linear in (x, t) with t from the cone, or in (x, |x|^2)."""
    s, d, width = lanes.place.shape
    for i in range(s):
        if free and (i == model.reference or model.sign[i] == 0.0):
            for j in range(d + 2):
                for lane in range(width):
                    lanes.squared[i, j, lane] = 0.0
            continue
        turn = 2.0 if free else -2.0
        right = lanes.squared[i, d + 1]
        for lane in range(width):
            c = lanes.c[i, lane] / lanes.scale[lane]
            right[lane] = c * c
            lanes.squared[i, d, lane] = turn * model.sign[i] * c if free else 1.0
        for j in range(d):
            for lane in range(width):
                place = lanes.place[i, j, lane] / lanes.scale[lane]
                lanes.squared[i, j, lane] = turn * place
                right[lane] -= place * place
        if free:
            for lane in range(width):
                right[lane] = -right[lane]


@compiled
def _weigh(lanes: Lanes, i: int, equal: bool) -> None:
    """Find what turns the error of a squared range into that of the range: one over twice the range, scaled."""
    d, width = lanes.x.shape
    if equal:
        for lane in range(width):
            lanes.spare[lane] = 0.5 * lanes.scale[lane]
        return
    for lane in range(width):
        lanes.spare[lane] = 0.0
    for j in range(d):
        for lane in range(width):
            lanes.spare[lane] += (lanes.y[j, lane] - lanes.place[i, j, lane] / lanes.scale[lane]) ** 2
    for lane in range(width):
        lanes.spare[lane] = 0.5 * lanes.scale[lane] / max(np.sqrt(lanes.spare[lane]), _NEAR)


@compiled
def _whiten(model: Model, lanes: Lanes) -> None:
    """Multiply the rows and right sides by the lower triangular whitening matrix, in place from the last one up."""
    s, n, width = lanes.rows.shape
    for i in range(s - 1, -1, -1):
        for j in range(n + 1):
            out = lanes.rows[i, j] if j < n else lanes.right[i]
            for lane in range(width):
                out[lane] *= model.white[i, i]
            for k in range(i):
                factor = model.white[i, k]
                if factor != 0.0:
                    other = lanes.rows[k, j] if j < n else lanes.right[k]
                    for lane in range(width):
                        out[lane] += factor * other[lane]
