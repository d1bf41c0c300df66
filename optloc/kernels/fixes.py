"""A fix from ranges in one compiled call: start, refinement, covariance, and whether the answer is plainly good."""

from __future__ import annotations

import numpy as np

from optloc.kernels.fixes_lanes import Lanes, Model, apply, lanes_for
from optloc.kernels.fixes_refine import ranges, refine
from optloc.kernels.fixes_start import begin, read, stand
from optloc.kernels.gtrs import LANES, factor, solve
from optloc.kernels.jit import compiled
from optloc.types import Array

_FEW = 6  # steps after which the problems of a block that still move wait for each other
_WEAK = 1e-11  # a tenfold margin to the pivot below which a direction counts as open
_FAR = 2.5e3  # a fourfold margin to the spreads of the stations from which on a fix is doubted


@compiled
def fixes(
    model: Model,
    z: Array,
    station: Array,
    tolerance: float,
    limit: int,
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
    tolerance, limit : float, int
        Of `optloc.kernels.fixes_refine.refine`.
    x : array (N, d + e)
        Written: positions, then emission times (times c, metres).
    covariance : array (N, d, d)
        Written: of the positions.
    cost : array (N,)
        Written: weighted sums of squared residuals.
    plain : bool array (N,)
        Written: whether the fix is plainly good: a finite input, an exact start, a finished refinement, a regular
        covariance, a place that is not far away, a cost that the noise allows. The others need a closer look.
    """
    count, d = len(z), station.shape[2]
    lanes = lanes_for(model, d)
    item, late = np.empty(LANES, np.int64), np.empty(count, np.int64)
    waiting, most = 0, 0
    if len(station) == 1:
        stand(model, station, np.zeros(LANES, np.int64), lanes)
    for first in range(0, count, LANES):
        size = min(LANES, count - first)
        for lane in range(LANES):
            item[lane] = first + min(lane, size - 1)
        _load(model, z, station, item, lanes)
        begin(model, lanes)
        refine(model, lanes, tolerance, min(_FEW, limit))
        most = max(most, _store(model, lanes, z, item, size, x, covariance, cost, plain))
        if limit > _FEW:
            for lane in range(size):
                late[waiting] = item[lane]
                waiting += 1 if lanes.alive[lane] != 0.0 else 0
    for first in range(0, waiting, LANES):
        size = min(LANES, waiting - first)
        for lane in range(LANES):
            item[lane] = late[first + min(lane, size - 1)]
        _load(model, z, station, item, lanes)
        for j in range(d):
            for lane in range(LANES):
                lanes.x[j, lane] = x[item[lane], j] - lanes.origin[j, lane]
        refine(model, lanes, tolerance, limit - _FEW)
        most = max(most, _FEW + _store(model, lanes, z, item, size, x, covariance, cost, plain))
    return most


@compiled
def _load(model: Model, z: Array, station: Array, item: Array, lanes: Lanes) -> None:
    read(model, z, item, lanes)
    if len(station) > 1:
        stand(model, station, item, lanes)


@compiled
def _store(
    model: Model,
    lanes: Lanes,
    z: Array,
    item: Array,
    size: int,
    x: Array,
    covariance: Array,
    cost: Array,
    plain: Array,
) -> int:
    """Write the first lanes to the fixes of their problems, and return the most steps that one took."""
    d = len(lanes.x)
    _invert(lanes)
    _remote(lanes)
    _emit(model, lanes)
    most = 0.0
    for lane in range(size):
        i = item[lane]
        fine = lanes.settled[lane] * lanes.good[lane] * (1.0 - lanes.alive[lane])
        plain[i] = fine != 0.0 and lanes.spare[lane] <= _FAR and lanes.cost[lane] <= model.limit
        cost[i] = lanes.cost[lane]
        most = max(most, lanes.steps[lane])
        for j in range(d):
            x[i, j] = lanes.x[j, lane] + lanes.origin[j, lane]
            for k in range(d):
                covariance[i, j, k] = lanes.H2[max(j, k), min(j, k), lane]
        for j in range(len(model.start)):
            at = model.start[j]
            known = z[i, at] - model.correction[at] if at >= 0 else 0.0
            x[i, d + j] = lanes.emission[j, lane] + known
    return int(most)


@compiled
def _invert(lanes: Lanes) -> None:
    """Write the lower half of the inverse information into `H2`, and into `settled` whether it is regular."""
    d, width = lanes.x.shape
    for i in range(d):
        for lane in range(width):
            lanes.diagonal[i, lane] = lanes.H[i, i, lane]
    factor(lanes.H, lanes.diagonal, lanes.lower, lanes.inverse)
    for lane in range(width):
        lanes.settled[lane] = 1.0
    for j in range(d):
        for lane in range(width):
            share = lanes.inverse[j, lane] * lanes.diagonal[j, lane]
            lanes.settled[lane] = lanes.settled[lane] if 0.0 < share < 1.0 / _WEAK else 0.0
        for i in range(d):
            for lane in range(width):
                lanes.move[i, lane] = 1.0 if i == j else 0.0
        solve(lanes.lower, lanes.inverse, lanes.move)
        for i in range(j, d):
            for lane in range(width):
                lanes.H2[i, j, lane] = lanes.move[i, lane]


@compiled
def _remote(lanes: Lanes) -> None:
    """Write how far the fixes are from the stations into `spare`, in units of their spread."""
    d, width = lanes.x.shape
    for lane in range(width):
        lanes.spare[lane] = 0.0
    for j in range(d):
        for lane in range(width):
            lanes.spare[lane] += (lanes.x[j, lane] - lanes.centre[j, lane]) ** 2
    for lane in range(width):
        lanes.spare[lane] = np.sqrt(lanes.spare[lane]) / lanes.spread[lane]


@compiled
def _emit(model: Model, lanes: Lanes) -> None:
    """Find the emission times that fit the positions best, less those of their anchors."""
    count, width = lanes.emission.shape
    if count == 0:
        return
    ranges(lanes, lanes.x)
    apply(model.travel, lanes.r, lanes.emission)
    for k in range(count):
        apply(model.emission[k : k + 1], lanes.z, lanes.extra.reshape(1, width))
        for lane in range(width):
            lanes.emission[k, lane] = lanes.extra[lane] - lanes.emission[k, lane]
