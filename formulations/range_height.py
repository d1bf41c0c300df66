r"""Points of an ellipsoid from ranges known up to one unknown: a quartic, and the horizon.

.. math:: (x - c)^\top A\,(x - c) = 1, \qquad |x - s_i| = \sigma_i \tau + c_i \quad (i = 1, 2, 3)

Two range differences and a known height: eliminating the ranges leaves a conic in its plane,
:math:`x = b + p\,t + n\,\mu`, :math:`\mu^2 = q(t)` (:mod:`formulations._curve`), on which the ellipsoid reads
:math:`E(t) + L(t)\,\mu + \alpha\,\mu^2 = 0`. With :math:`Q = E + \alpha q` the first coordinate is a root of

.. math:: Q(t)^2 - L(t)^2\, q(t) = 0,

at most four real ones. Squaring also admits the sign-flipped problem, whose points have a negative range; they are
dropped. Two known ranges lie on a circle, which has the same form. Each root starts a Newton iteration on the two
conics from both signs of :math:`\mu`, which gives back the digits the squares lost and needs no rule for
:math:`L = 0`.

Source: K. C. Ho and Y. T. Chan, "Geolocation of a known altitude object from TDOA and FDOA measurements", IEEE Trans.
Aerosp. Electron. Syst. 33 (1997), section III (there for a sphere and iterated; here exact for the ellipsoid).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formulations._curve import Curve, three_stations, two_stations
from formulations.ellipsoid import Ellipsoid

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SLOTS = 4
_NEWTON = 30
# how far from an intersection, relatively, an iteration may start
_NEAR = 1e-3
# of a range and of the ellipsoid's form; and two points closer than the second are one
_TOLERANCE = 1e-11
_SAME = 1e-7


@dataclass(frozen=True, slots=True)
class Candidates:
    """Points that fit, in no particular order.

    Parameters
    ----------
    x : Array, shape (..., 4, 3)
        Points, NaN where not valid.
    ranges : Array, shape (..., 4, s)
        Their ranges to the s stations.
    valid : Mask, shape (..., 4)
        True where a slot holds a point.
    """

    x: Array
    ranges: Array
    valid: Mask


def locate(stations: Array, sign: ArrayLike, offset: Array, surface: Ellipsoid, *, positive: bool = True) -> Candidates:
    """All points of the ellipsoid whose ranges to three stations are known up to one unknown.

    Parameters
    ----------
    stations : Array, shape (..., 3, 3)
        Positions, one a row, numbers of order one.
    sign : array_like, shape (..., 3)
        1 or -1: ranges are ``sign tau + offset``. Range differences to the first station: all 1. Sums: -1.
    offset : Array, shape (..., 3)
        The known parts.
    surface : Ellipsoid
        Shape (..., 3, 3) and centre (..., 3).
    positive : bool
        Drop points with a negative range; False keeps the solutions of the sign-flipped problem.

    Returns
    -------
    Candidates
        None where the stations lie on a line, the input is not finite or nothing real fits.

    Notes
    -----
    Ho and Chan (1997), section III, for the ellipsoid.
    """
    if not np.all(np.abs(sign) == 1.0):
        raise ValueError("signs must be 1 or -1")
    lead = np.broadcast_shapes(
        np.shape(stations)[:-2], np.shape(sign)[:-1], np.shape(offset)[:-1], surface.shape.shape[:-2],
        surface.centre.shape[:-1],
    )  # fmt: skip
    flat, A, centre = (
        _flat(stations, (3, 3), lead),
        _flat(surface.shape, (3, 3), lead),
        _flat(surface.centre, (3,), lead),
    )
    curve = three_stations(flat, _flat(sign, (3,), lead), _flat(offset, (3,), lead))
    return _shaped(_meet(curve, flat, A, centre, positive=positive), lead)


def locate_by_ranges(stations: Array, ranges: Array, surface: Ellipsoid) -> Candidates:
    """All points of the ellipsoid with known ranges to two stations.

    Parameters
    ----------
    stations : Array, shape (..., 2, 3)
        Positions, one a row, numbers of order one.
    ranges : Array, shape (..., 2)
        Ranges.
    surface : Ellipsoid
        Shape (..., 3, 3) and centre (..., 3).

    Returns
    -------
    Candidates
        None where the spheres do not meet, the input is not finite or nothing real fits.

    Notes
    -----
    The circle of the two spheres in the place of Ho and Chan's conic.
    """
    lead = np.broadcast_shapes(
        np.shape(stations)[:-2], np.shape(ranges)[:-1], surface.shape.shape[:-2], surface.centre.shape[:-1]
    )
    flat, A, centre = (
        _flat(stations, (2, 3), lead),
        _flat(surface.shape, (3, 3), lead),
        _flat(surface.centre, (3,), lead),
    )
    known = _flat(ranges, (2,), lead)
    curve = two_stations(flat, known, centre)
    return _shaped(_meet(curve, flat, A, centre, positive=True), lead)


def _flat(value: ArrayLike, last: tuple[int, ...], lead: tuple[int, ...]) -> Array:
    """Give a value one batch axis."""
    return np.broadcast_to(np.asarray(value, dtype=np.float64), (*lead, *last)).reshape(-1, *last)


def _shaped(found: Candidates, lead: tuple[int, ...]) -> Candidates:
    """Give the batch axis its shape back."""
    x, ranges = (v.reshape(*lead, *v.shape[1:]) for v in (found.x, found.ranges))
    return Candidates(x, ranges, found.valid.reshape(*lead, _SLOTS))


def _meet(curve: Curve, stations: Array, A: Array, centre: Array, *, positive: bool) -> Candidates:
    """All points common to N curves and their ellipsoids."""
    with np.errstate(all="ignore"):
        E, L, alpha = curve.on_ellipsoid(A, centre)
        t, mu = _starts(curve.square, E, L, alpha)
        t, mu = _newton(t, mu, curve.square, E, L, alpha)
        x = curve.points(t, mu)
        ranges = curve.rate[:, None] * t[..., None] + curve.offset[:, None]
        away = x[:, :, None] - stations[:, None]
        size = 1.0 + np.max(np.abs(ranges), axis=-1)
        miss = np.max(np.abs(np.sqrt(_dot(away, away)) - np.abs(ranges)), axis=-1)
        off = x - centre[:, None]
        height = np.abs(np.einsum("nki,nij,nkj->nk", off, A, off) - 1.0)
        valid = curve.ok[:, None] & (miss <= _TOLERANCE * size) & (height <= _TOLERANCE)
        if positive:
            valid &= (ranges >= 0.0).all(axis=-1)
        same = np.abs(t[:, :, None] - t[:, None]) + np.abs(mu[:, :, None] - mu[:, None])
    same = (same <= _SAME * size[:, :, None]) & valid[:, None]
    # drop what an earlier slot holds already
    valid &= ~np.tril(same, -1).any(axis=-1)
    order = np.argsort(~valid, axis=-1, kind="stable")[:, :_SLOTS]
    valid = np.take_along_axis(valid, order, axis=1)
    x, ranges = (np.take_along_axis(v, order[..., None], axis=1) for v in (x, ranges))
    x[~valid], ranges[~valid] = np.nan, np.nan
    return Candidates(x, ranges, valid)


def quartic(square: Array, E: Array, L: Array, alpha: Array) -> Array:
    """Coefficients of ``Q^2 - L^2 q``, the eliminant of the two conics.

    Parameters
    ----------
    square : Array, shape (N, 3)
        Coefficients of q, constant first.
    E : Array, shape (N, 3)
        Coefficients of E.
    L : Array, shape (N, 2)
        Coefficients of L.
    alpha : Array, shape (N,)
        Coefficient of mu^2.

    Returns
    -------
    Array, shape (N, 5)
        Constant first.
    """
    Q = E + alpha[:, None] * square
    return _times(Q, Q) - _times(_times(L, L), square)


def _times(a: Array, b: Array) -> Array:
    """Product of polynomials, constant first."""
    out = np.zeros((len(a), a.shape[1] + b.shape[1] - 1))
    for i in range(a.shape[1]):
        out[:, i : i + b.shape[1]] += a[:, i, None] * b
    return out


def _roots(c: Array) -> Array:
    """Find the four complex roots."""
    c = np.where(np.isfinite(c).all(axis=-1, keepdims=True), c, [1.0, 0.0, 0.0, 0.0, 1.0])
    size = np.max(np.abs(c), axis=-1)
    c = c / np.where(size > 0.0, size, 1.0)[:, None]
    # a lost leading coefficient is a root at infinity
    lead = np.where(np.abs(c[:, 4]) > 1e-14, c[:, 4], 1e-14)
    companion = np.zeros((len(c), 4, 4))
    companion[:, [1, 2, 3], [0, 1, 2]] = 1.0
    companion[:, :, 3] = -c[:, :4] / lead[:, None]
    return np.asarray(np.linalg.eigvals(companion), dtype=np.complex128)


def _starts(square: Array, E: Array, L: Array, alpha: Array) -> tuple[Array, Array]:
    """Find starts near every real intersection, two slots a root; NaN where there is nothing to start from."""
    roots = _roots(quartic(square, E, L, alpha))
    t = np.tile(roots.real, 2)
    # a pair that has just left the real axis may be a double root
    real = np.abs(np.tile(roots.imag, 2)) <= _NEAR * (1.0 + np.abs(t))
    mu = np.sqrt(np.maximum(_value(square, t), 0.0)) * np.repeat([1.0, -1.0], _SLOTS)
    parts = np.stack([_value(E, t), (L[:, :1] + L[:, 1:] * t) * mu, alpha[:, None] * mu * mu])
    near = np.abs(parts.sum(axis=0)) <= _NEAR * (np.abs(parts).sum(axis=0) + np.abs(E).max(axis=-1, keepdims=True))
    return np.where(real & near, t, np.nan), mu


def _newton(t: Array, mu: Array, square: Array, E: Array, L: Array, alpha: Array) -> tuple[Array, Array]:
    """Newton's iteration on the two conics; slots that lead nowhere are caught by their residuals."""
    go = np.isfinite(t)
    for _ in range(_NEWTON):
        one = mu * mu - _value(square, t)
        cross = L[:, :1] + L[:, 1:] * t
        two = _value(E, t) + (cross + alpha[:, None] * mu) * mu
        one_t, one_mu = -square[:, 1:2] - 2.0 * square[:, 2:] * t, 2.0 * mu
        two_t, two_mu = E[:, 1:2] + 2.0 * E[:, 2:] * t + L[:, 1:] * mu, cross + 2.0 * alpha[:, None] * mu
        determinant = one_t * two_mu - one_mu * two_t
        move_t = (two * one_mu - one * two_mu) / determinant
        move_mu = (one * two_t - two * one_t) / determinant
        go &= np.isfinite(move_t) & np.isfinite(move_mu)
        t, mu = np.where(go, t + move_t, t), np.where(go, mu + move_mu, mu)
        # a slot that has settled rests: the length of the iteration depends on its neighbours
        go &= np.abs(move_t) + np.abs(move_mu) > 1e-14 * (np.abs(t) + np.abs(mu))
        if not go.any():
            break
    return t, mu


def _value(c: Array, t: Array) -> Array:
    return np.asarray(c[:, :1] + t * (c[:, 1:2] + t * c[:, 2:]))


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.sum(a * b, axis=-1))
