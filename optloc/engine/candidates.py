"""Starts where squared ranges have too few rows: where ranges meet an ellipsoid, or the cheapest of many places.

Each leads to a few candidates, which are refined. The cheapest two that are different go on: the second competes in the
place of a mirror image.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.base.types import Array
from optloc.compute.jit import compiled
from optloc.compute.polynomial import real_roots
from optloc.compute.systems import LANES
from optloc.engine.admission import admit, restore
from optloc.engine.evaluator import complete, costs
from optloc.engine.images import LISTED, NEAR
from optloc.engine.memory import (
    ALIVE,
    CENTRE,
    COST,
    COST_TRIAL,
    FIX,
    FIX_COST,
    FIX_H,
    GOOD,
    HIGH,
    LOWER_BOUND,
    ORIGIN,
    OTHER,
    SECOND,
    SIGN,
    SPREAD,
    TRIAL,
    H,
    Model,
    Room,
    X,
)
from optloc.engine.refine import refine
from optloc.models.primitives import WGS84_A, WGS84_F

CANDIDATES = 4
"""Of a fix: roots of a quartic, or sectors of places."""

# Of the refinement of candidates: a hundredth of a standard deviation separates minima, and a candidate that has not
# arrived after these steps is on its way to infinity.
_TOLERANCE, _STEPS = 1e-2, 40
# Vectors of scratch for one lane: stations, then as named in `_conic`.
VECTORS = 12
# Sine of the angle at a station below which three stations count as one line, as in `formulations.range_height`.
_THIN = 1e-7
# Share by which a root may miss the two conics: double roots are good to half of the digits.
_NEARLY = 1e-3
# Miss that is rounding: the forms are of order one.
_ROUNDING = 1e-13
# Squared distance, in Earth radii, below which two candidates are one.
_SAME = 1e-14


@compiled
def refine_candidates(model: Model, rows: Any, room: Room, spot: Array) -> None:
    """Refine candidates, and write the best to row X, and to row OTHER another minimum where there is one.

    Parameters
    ----------
    model : Model
        How measurements become a start.
    rows : named tuple
        Of the evaluator.
    room : Room
        Of the block; lanes without a candidate that is admitted are not good.
    spot : array (CANDIDATES, d + 1, W)
        Candidates from the origin, NaN for an empty place; their costs are written behind the coordinates.
    """
    vector, scalar, d = room.vector, room.scalar, room.d
    for lane in range(LANES):
        scalar[HIGH, lane], scalar[FIX_COST, lane] = scalar[GOOD, lane], np.inf
    for k in range(CANDIDATES):
        for lane in range(LANES):
            there = spot[k, 0, lane] < np.inf
            scalar[GOOD, lane] = scalar[HIGH, lane] if there else 0.0
            for j in range(d):
                vector[X, j, lane] = spot[k, j, lane] if there else vector[CENTRE, j, lane]
        restore(model, room, 0)
        complete(rows, room)
        refine(model, rows, room, _TOLERANCE, _STEPS)
        for lane in range(LANES):
            scalar[GOOD, lane] *= 1.0 - scalar[ALIVE, lane]
        admit(model, room, scalar[GOOD])
        _keep(room, spot[k])
    _choose(model, room, spot)


@compiled
def _keep(room: Room, spot: Array) -> None:
    """Write where the refinement of a candidate ended, and keep the best so far, with its information, as FIX."""
    vector, scalar, d = room.vector, room.scalar, room.d
    for lane in range(LANES):
        good = scalar[GOOD, lane] != 0.0
        spot[d, lane] = scalar[COST, lane] if good else np.inf
        better = spot[d, lane] < scalar[FIX_COST, lane]
        for j in range(d):
            spot[j, lane] = vector[X, j, lane]
        if better:
            scalar[FIX_COST, lane] = scalar[COST, lane]
            for i in range(vector.shape[1]):
                vector[FIX, i, lane] = vector[X, i, lane]
                for j in range(i + 1):
                    room.matrix[FIX_H, i, j, lane] = room.matrix[H, i, j, lane]


@compiled
def _choose(model: Model, room: Room, spot: Array) -> None:
    """Write the best candidate to row X, and the cheapest of those at other minima to row OTHER.

    A lane is not good if a third minimum is as good as a rival. Nor is it if the best one is poor: places in between
    may hold a better minimum.
    """
    vector, scalar, d = room.vector, room.scalar, room.d
    for lane in range(LANES):
        least = scalar[FIX_COST, lane] + LISTED
        found = least < np.inf and scalar[FIX_COST, lane] <= model.limit
        scalar[GOOD, lane], scalar[SECOND, lane] = 1.0 if found else 0.0, 0.0
        if not found:
            continue
        for i in range(vector.shape[1]):
            vector[X, i, lane] = vector[FIX, i, lane]
        for k in range(CANDIDATES):
            if spot[k, d, lane] <= least and _is_apart(room, spot[k], FIX, lane):
                least, scalar[SECOND, lane] = spot[k, d, lane], 1.0
                for j in range(d):
                    vector[OTHER, j, lane] = spot[k, j, lane]
        for k in range(CANDIDATES):
            rivals = spot[k, d, lane] <= scalar[FIX_COST, lane] + LISTED and scalar[SECOND, lane] != 0.0
            if rivals and _is_apart(room, spot[k], FIX, lane) and _is_apart(room, spot[k], OTHER, lane):
                scalar[GOOD, lane] = 0.0


@compiled
def _is_apart(room: Room, spot: Array, row: int, lane: int) -> bool:
    """Return whether a candidate of a lane is more than three standard deviations of FIX from a row of vectors."""
    apart = 0.0
    for i in range(room.d):
        for j in range(room.d):
            across = room.matrix[FIX_H, max(i, j), min(i, j), lane]
            first, second = spot[i, lane] - room.vector[row, i, lane], spot[j, lane] - room.vector[row, j, lane]
            apart += across * first * second
    return bool(apart > NEAR)


# The cheapest of many places.

# Distances of places in spreads of the stations: from among them to where wave fronts are nearly flat.
_RADII = (0.4, 1.0, 2.5, 8.0)
RINGS = len(_RADII)
"""Rings of places."""


@compiled
def look_around(model: Model, rows: Any, room: Room, spot: Array, rings: int) -> None:
    """Write the cheapest place of each sector about the stations to `spot`, see `refine_candidates`.

    The rings count from the nearest; a surface makes one of all.
    """
    vector, scalar, d = room.vector, room.scalar, room.d
    each = len(model.ahead) // CANDIDATES
    for k in range(CANDIDATES):
        for lane in range(LANES):
            spot[k, d, lane] = np.inf
            for j in range(d):
                spot[k, j, lane] = np.nan
        for i in range(each * rings):
            for lane in range(LANES):
                for j in range(d):
                    step = scalar[SPREAD, lane] * _RADII[i // each] * model.ahead[k * each + i % each, j]
                    vector[TRIAL, j, lane] = vector[CENTRE, j, lane] + step
                for j in range(d, vector.shape[1]):
                    vector[TRIAL, j, lane] = vector[X, j, lane]
            restore(model, room, 1)
            costs(rows, room)
            for lane in range(LANES):
                if scalar[COST_TRIAL, lane] < spot[k, d, lane]:
                    spot[k, d, lane] = scalar[COST_TRIAL, lane]
                    for j in range(d):
                        spot[k, j, lane] = vector[TRIAL, j, lane]


# Directions of a sector.
_FAN = {2: 4, 3: 12}


def directions(d: int) -> Array:
    """Return unit vectors (n, d), sector by sector, as even as can be."""
    count = CANDIDATES * _FAN[d]
    number = np.arange(count) + 0.5
    if d == 2:
        turn = 2.0 * np.pi * number / count
        return np.stack([np.cos(turn), np.sin(turn)], axis=1)
    # a spiral: equal steps of height, and of the golden angle
    up, turn = 1.0 - 2.0 * number / count, number * np.pi * (3.0 - np.sqrt(5.0))
    level = np.sqrt(1.0 - up * up)
    ahead = np.stack([level * np.cos(turn), level * np.sin(turn), up], axis=1)
    return np.asarray(ahead[np.argsort(np.arctan2(ahead[:, 1], ahead[:, 0]), kind="stable")])


# Where ranges known up to one unknown meet an ellipsoid: `formulations.range_height`, for one lane after the other.

_S, _A, _B, _N, _FIRST, _ALONG, _BASE, _EDGE = 0, 3, 4, 5, 6, 7, 8, 9
_RANGE = _N  # behind the coordinates of two rows: how the ranges to the other stations follow from the first


@compiled
def meet_ellipsoid(model: Model, room: Room, w: Array, spot: Array) -> None:
    """Write where the ranges to the first three stations meet the ellipsoid of a known height to `spot`.

    Parameters
    ----------
    model : Model
        With the source of the height.
    room : Room
        Of the block.
    w : array (VECTORS, DEGREE + 2)
        Scratch.
    spot : array (CANDIDATES, d + 1, W)
        As of `refine_candidates`.
    """
    for lane in range(LANES):
        for k in range(CANDIDATES):
            spot[k, 0, lane] = np.nan
        height = room.side[LOWER_BOUND, model.height, lane] if model.height >= 0 else room.seen[-1 - model.height, lane]
        _place_stations(model, room, w, lane)
        _meet(model, room, w, height / WGS84_A, lane, spot)


@compiled
def _place_stations(model: Model, room: Room, w: Array, lane: int) -> None:
    """Write the first three stations, Earth-centred in radii, to the first rows of w."""
    globe, origin = model.admission.globe, room.vector[ORIGIN]
    for s in range(3):
        for i in range(3):
            at = globe[3, i]
            for j in range(3):
                at += globe[i, j] * (room.place[s, j, lane] + origin[j, lane])
            w[_S + s, i] = at / WGS84_A


@compiled
def _dot(w: Array, a: int, b: int) -> float:
    return float(w[a, 0] * w[b, 0] + w[a, 1] * w[b, 1] + w[a, 2] * w[b, 2])


@compiled
def _cross(w: Array, a: int, b: int, out: int) -> None:
    """Write the vector product of two rows to a third."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        w[out, i] = w[a, j] * w[b, k] - w[a, k] * w[b, j]


@compiled
def _meet(model: Model, room: Room, w: Array, height: float, lane: int, spot: Array) -> None:
    """Write the points of one lane.

    On the plane curve ``base + along t + n mu`` with ``mu^2 = q(t)`` all ranges are right. On the ellipsoid
    ``E(t) + L(t) mu + alpha mu^2 = 0``. So t is a root of ``(E + alpha q)^2 - L^2 q``.
    """
    turn, gap = model.station[SIGN, 0], room.value[0, lane] / WGS84_A
    for s in range(2):
        for i in range(3):
            w[_A + s, i] = w[_S + 1 + s, i] - w[_S, i]
    _cross(w, _A, _B, _N)
    size = _dot(w, _N, _N)
    if not size > _THIN * _THIN * _dot(w, _A, _A) * _dot(w, _B, _B):
        return
    # the reciprocal basis of the stations' plane takes what two differences of squares say
    _cross(w, _B, _N, _FIRST)
    for i in range(3):
        w[_BASE, i], w[_ALONG, i] = 0.0, 0.0
    for s in range(2):
        if s == 1:
            _cross(w, _N, _A, _FIRST)
        sign = model.station[SIGN, 1 + s] * turn
        off = room.value[1 + s, lane] / WGS84_A - sign * gap
        w[_RANGE + s, 3], w[_RANGE + s, 4] = sign, off
        fixed = 0.5 * (_dot(w, _A + s, _A + s) - off * off)
        for i in range(3):
            w[_BASE, i] += fixed * w[_FIRST, i] / size
            w[_ALONG, i] -= sign * off * w[_FIRST, i] / size
    # the range to the first station is t / scale + shift, so that the curve's vectors are of order one
    long = max(_dot(w, _ALONG, _ALONG), 1.0)
    shift, scale = -_dot(w, _BASE, _ALONG) / long, 1.0 / np.sqrt(long)
    for i in range(3):
        w[_BASE, i] += shift * w[_ALONG, i]
        w[_ALONG, i] *= scale
        w[_N, i] /= np.sqrt(size)
    q0 = shift * shift - _dot(w, _BASE, _BASE)
    q1 = 2.0 * scale * shift - 2.0 * _dot(w, _BASE, _ALONG)
    q2 = scale * scale - _dot(w, _ALONG, _ALONG)
    for i in range(3):
        w[_BASE, i] += w[_S, i]
    _cut(room, model, w, height, lane, spot, (q0, q1, q2, scale, shift))


@compiled
def _form(w: Array, a: int, b: int, height: float) -> float:
    """Return the ellipsoid's bilinear form of two rows."""
    wide, high = 1.0 / (1.0 + height), 1.0 / (1.0 - WGS84_F + height)
    return float((w[a, 0] * w[b, 0] + w[a, 1] * w[b, 1]) * wide * wide + w[a, 2] * w[b, 2] * high * high)


@compiled
def _cut(room: Room, model: Model, w: Array, height: float, lane: int, spot: Array, curve: Any) -> None:
    """Write the points of a curve on the ellipsoid."""
    q0, q1, q2, scale, shift = curve
    alpha = _form(w, _N, _N, height)
    e0, e1 = _form(w, _BASE, _BASE, height) - 1.0 + alpha * q0, 2.0 * _form(w, _BASE, _ALONG, height) + alpha * q1
    e2 = _form(w, _ALONG, _ALONG, height) + alpha * q2
    l0, l1 = 2.0 * _form(w, _N, _BASE, height), 2.0 * _form(w, _N, _ALONG, height)
    c, root = w[_EDGE], w[_A]
    c[0] = e0 * e0 - l0 * l0 * q0
    c[1] = 2.0 * e0 * e1 - 2.0 * l0 * l1 * q0 - l0 * l0 * q1
    c[2] = e1 * e1 + 2.0 * e0 * e2 - l1 * l1 * q0 - 2.0 * l0 * l1 * q1 - l0 * l0 * q2
    c[3] = 2.0 * e1 * e2 - l1 * l1 * q1 - 2.0 * l0 * l1 * q2
    c[4] = e2 * e2 - l1 * l1 * q2
    # what is on the Earth is no farther from a station than the station from the centre, and a radius more
    most = np.sqrt(_dot(w, _S, _S)) + 1.0 + abs(height)
    found, count = real_roots(c, -shift / scale, (most - shift) / scale, w[_EDGE + 1 :], root), 0
    for i in range(found):
        t = root[i]
        middle, slope = e0 + (e1 + e2 * t) * t, l0 + l1 * t
        mu, first = np.sqrt(max(q0 + (q1 + q2 * t) * t, 0.0)), scale * t + shift
        behind = False  # a range and its negative have one square
        for s in range(2):
            behind = behind or w[_RANGE + s, 3] * first + w[_RANGE + s, 4] < 0.0
        for side in range(2):
            across = mu if side == 0 else -mu
            miss, size = abs(middle + slope * across), abs(middle) + abs(slope) * mu
            if count < CANDIDATES and not behind and miss <= _NEARLY * size + _ROUNDING:
                count += _put(room, model, w, t, across, lane, spot, count)


@compiled
def _put(room: Room, model: Model, w: Array, t: float, across: float, lane: int, spot: Array, count: int) -> int:
    """Write a point of the curve as the next candidate unless it is there, and return whether it was written."""
    globe, origin, point = model.admission.globe, room.vector[ORIGIN], w[_FIRST]
    for i in range(3):
        point[i] = w[_BASE, i] + w[_ALONG, i] * t + w[_N, i] * across
    for j in range(3):
        at = 0.0
        for i in range(3):
            at += globe[i, j] * (point[i] * WGS84_A - globe[3, i])
        spot[count, j, lane] = at - origin[j, lane]
    for k in range(count):
        apart = 0.0
        for j in range(3):
            apart += (spot[count, j, lane] - spot[k, j, lane]) ** 2
        if apart <= _SAME * WGS84_A * WGS84_A:
            spot[count, 0, lane] = np.nan
            return 0
    return 1
