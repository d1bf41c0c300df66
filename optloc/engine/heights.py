"""The points where ranges known up to one unknown meet the ellipsoid of a known height: a quartic, one lane at a time.

`formulations.range_height` explains the mathematics. A lane is one problem of a block. `w` is the scratch of one lane;
the constants _S to _EDGE name its rows. `spot` (CANDIDATES, d + 1, W) receives the points, metres. `room` is the
workspace of the block, see `optloc.engine.memory.EngineWorkspace`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.base.types import Array
from optloc.engine.candidates import CANDIDATES
from optloc.engine.memory import LOWER_BOUND, ORIGIN, SIGN, EngineModel, EngineWorkspace
from optloc.kernels.jit import compiled
from optloc.kernels.polynomial import real_roots
from optloc.kernels.systems import LANES
from optloc.models.primitives import WGS84_A, WGS84_F

# Number of scratch vectors for one lane; the constants below name them.
VECTORS = 12
# Sine of the angle at a station below which three stations count as collinear, as in `formulations.range_height`.
_THIN = 1e-7
# Relative error with which a root may miss the two conics: double roots have only half of the digits.
_NEARLY = 1e-3
# Absolute error that counts as rounding: the forms are of order one.
_ROUNDING = 1e-13
# Squared distance, in Earth radii, below which two candidates are the same.
_SAME = 1e-14

_S, _A, _B, _N, _FIRST, _ALONG, _BASE, _EDGE = 0, 3, 4, 5, 6, 7, 8, 9
_RANGE = _N  # two rows also contain sign and offset of the ranges to the other stations


@compiled
def meet_ellipsoid(model: EngineModel, room: EngineWorkspace, w: Array, spot: Array) -> None:
    """Write the points where the ranges to the first three stations meet the ellipsoid of a known height to `spot`.

    Parameters
    ----------
    model : EngineModel
        Contains the source of the height.
    room : EngineWorkspace
        Workspace of the block.
    w : array (VECTORS, DEGREE + 2)
        Scratch.
    spot : array (CANDIDATES, d + 1, W)
        Written: candidates as for `refine_candidates`.
    """
    for lane in range(LANES):
        for k in range(CANDIDATES):
            spot[k, 0, lane] = np.nan
        height = room.side[LOWER_BOUND, model.height, lane] if model.height >= 0 else room.seen[-1 - model.height, lane]
        _place_stations(model, room, w, lane)
        _meet(model, room, w, height / WGS84_A, lane, spot)


@compiled
def _place_stations(model: EngineModel, room: EngineWorkspace, w: Array, lane: int) -> None:
    """Write the first three stations of a lane, Earth-centred and in Earth radii, to the rows _S to _S + 2 of `w`."""
    globe, origin = model.admission.globe, room.vector[ORIGIN]
    for s in range(3):
        for i in range(3):
            at = globe[3, i]
            for j in range(3):
                at += globe[i, j] * (room.place[s, j, lane] + origin[j, lane])
            w[_S + s, i] = at / WGS84_A


@compiled
def _dot(w: Array, a: int, b: int) -> float:
    # Return the inner product of two rows of `w`.
    return float(w[a, 0] * w[b, 0] + w[a, 1] * w[b, 1] + w[a, 2] * w[b, 2])


@compiled
def _cross(w: Array, a: int, b: int, out: int) -> None:
    """Write the vector product of the rows `a` and `b` of `w` to the row `out`."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        w[out, i] = w[a, j] * w[b, k] - w[a, k] * w[b, j]


@compiled
def _meet(model: EngineModel, room: EngineWorkspace, w: Array, height: float, lane: int, spot: Array) -> None:
    """Write the candidates of one lane to `spot`; `height` is in Earth radii.

    On the plane curve ``base + along t + n mu`` with ``mu^2 = q(t)`` all ranges are satisfied. The parameter t is the
    range to the first station, shifted and scaled; n is the unit normal of the plane of the stations. The ellipsoid
    requires ``E(t) + L(t) mu + alpha mu^2 = 0``: E is quadratic, L is linear in t. So t is a root of ``(E + alpha q)^2
    - L^2 q``.
    """
    turn, gap = model.station[SIGN, 0], room.value[0, lane] / WGS84_A
    for s in range(2):
        for i in range(3):
            w[_A + s, i] = w[_S + 1 + s, i] - w[_S, i]
    _cross(w, _A, _B, _N)
    size = _dot(w, _N, _N)
    if not size > _THIN * _THIN * _dot(w, _A, _A) * _dot(w, _B, _B):
        return
    # two differences of squared ranges fix two components; the reciprocal basis of the stations' plane applies them
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
    # the range to the first station is t / scale + shift, so that the vectors of the curve are of order one
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
    """Return the bilinear form of the ellipsoid at `height` (Earth radii) for the rows `a` and `b` of `w`.

    A point x is on the ellipsoid if the form of x with itself is one.
    """
    wide, high = 1.0 / (1.0 + height), 1.0 / (1.0 - WGS84_F + height)
    return float((w[a, 0] * w[b, 0] + w[a, 1] * w[b, 1]) * wide * wide + w[a, 2] * w[b, 2] * high * high)


@compiled
def _cut(
    room: EngineWorkspace, model: EngineModel, w: Array, height: float, lane: int, spot: Array, curve: Any
) -> None:
    """Write the points of a curve on the ellipsoid to `spot`, for one lane.

    `curve` has the coefficients q0, q1, q2 of q(t), and scale and shift of t, see `_meet`. `height` is in Earth radii.
    """
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
    # the range to a point on the Earth is at most the station's distance from the centre plus one radius and the height
    most = np.sqrt(_dot(w, _S, _S)) + 1.0 + abs(height)
    found, count = real_roots(c, -shift / scale, (most - shift) / scale, w[_EDGE + 1 :], root), 0
    for i in range(found):
        t = root[i]
        middle, slope = e0 + (e1 + e2 * t) * t, l0 + l1 * t
        mu, first = np.sqrt(max(q0 + (q1 + q2 * t) * t, 0.0)), scale * t + shift
        behind = False  # a range and its negative have the same square
        for s in range(2):
            behind = behind or w[_RANGE + s, 3] * first + w[_RANGE + s, 4] < 0.0
        for side in range(2):
            across = mu if side == 0 else -mu
            miss, size = abs(middle + slope * across), abs(middle) + abs(slope) * mu
            if count < CANDIDATES and not behind and miss <= _NEARLY * size + _ROUNDING:
                count += _put(room, model, w, t, across, lane, spot, count)


@compiled
def _put(
    room: EngineWorkspace, model: EngineModel, w: Array, t: float, across: float, lane: int, spot: Array, count: int
) -> int:
    """Write a point of the curve as candidate number `count`, unless it exists already; return 1 if written, else 0.

    The point is ``base + along t + n across``, see `_meet`.
    """
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
