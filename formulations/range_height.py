r"""Points of an ellipsoid from ranges known up to one unknown: a quartic, and the horizon.

.. math:: (x - c)^\top A\,(x - c) = 1, \qquad |x - s_i| = \sigma_i \tau + c_i \quad (i = 1, 2, 3)

Two range differences and a known height. Squared and subtracted, :math:`r_i = \sigma_i r_1 + e_i` gives :math:`2
a_i^\top (x - s_1) = |a_i|^2 - e_i^2 - 2 \sigma_i e_i r_1` with :math:`a_i = s_i - s_1`: the ranges leave a conic in its
own plane,

.. math:: x(t, \mu) = b + p\,t + n\,\mu, \qquad \mu^2 = q(t) = q_0 + q_1 t + q_2 t^2, \qquad r_i = \rho_i t + e_i,

in which `n` is the unit normal of the plane of the stations. The parameter `t` is :math:`r_1`, shifted and scaled: `p`
is at most a unit long and `b` is near the stations. Otherwise both would be huge for nearly collinear stations. Two
known ranges leave a circle about the line of their stations, which has the same form, `t` and :math:`\mu` being cosine
and sine. On the conic the ellipsoid reads :math:`E(t) + L(t)\,\mu + \alpha\,\mu^2 = 0`. With :math:`Q = E + \alpha q`
the first coordinate is a root of

.. math:: Q(t)^2 - L(t)^2\, q(t) = 0,

at most four real ones. Squaring also admits the problem with flipped signs, whose points have a negative range; they
are dropped. Each root starts a Newton iteration on the two conics from both signs of :math:`\mu`. The iteration
restores the digits that squaring has lost, and needs no special case for :math:`L = 0`.

Points on the far side of the ellipsoid are not visible. The polar plane of an outside point `s`, :math:`(x - c)^\top A
(s - c) = 1`, touches the ellipsoid where the tangents from `s` do: it cuts off exactly the part that is seen from `s`.
In numbers of order one (semi-axes as units) the form keeps all digits; in metres it loses eight of them.

Sources: K. C. Ho and Y. T. Chan, "Geolocation of a known altitude object from TDOA and FDOA measurements", IEEE Trans.
Aerosp. Electron. Syst. 33 (1997), section III (the elimination, there for a sphere and iterated; here exact for the
ellipsoid); D. Hilbert and S. Cohn-Vossen, "Geometry and the Imagination", 1932, chapter III (poles and polar planes).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from formulations.algebra import Array, Mask, dot, flatten

_SLOTS = 4  # roots of a quartic
# Sine of the angle at the first station below which three stations count as collinear: the normal of their plane, a
# difference of products, has only half of its digits there.
_THIN = 1e-7
_AXIAL = 1e-12  # squared sine of the angle between a direction and the axis below which they count as parallel
_LEAD = 1e-14  # leading coefficient of the quartic, relative to the largest, that is rounding: a root at infinity
# Greatest relative residual of the two conics at a start of the iteration. Eigenvalues of the companion matrix are
# accurate to 1e-8 at a double root. A pair slightly off the real axis is wrong by the root of the perturbation.
_NEAR = 1e-3
_NEWTON = 30  # steps; quadratic convergence at simple roots; a bit per step at double roots, accurate to 1e-8
_RESTS = 1e-14  # relative step at which a slot has converged
_TOLERANCE = 1e-11  # relative residual of ranges and of the ellipsoid's form after Newton's iteration, with a margin
_SAME = 1e-7  # two points closer than this are the same, found from both signs or from both parts of a double root


@dataclass(frozen=True, slots=True)
class Ellipsoid:
    """The surface ``(x - centre)' shape (x - centre) = 1``.

    Parameters
    ----------
    shape : Array, shape (..., 3, 3)
        Symmetric positive definite.
    centre : Array, shape (..., 3)
        Centre.
    """

    shape: Array
    centre: Array

    def polar(self, x: Array, s: Array) -> Array:
        """Return the bilinear form ``(x - centre)' shape (s - centre)``.

        Parameters
        ----------
        x, s : Array, shape (..., 3)
            Points.

        Returns
        -------
        Array, shape (...)
            The form; for equal points it is 1 on the surface, and greater outside.
        """
        left = np.einsum("...i,...ij->...j", x - self.centre, self.shape)
        return np.asarray(np.sum(left * (s - self.centre), axis=-1))


def ellipsoid(
    axes: ArrayLike, height: ArrayLike = 0.0, *, origin: ArrayLike = 0.0, rotation: ArrayLike | None = None
) -> Ellipsoid:
    """Return the ellipsoid with all semi-axes increased by a height.

    It is the surface of this height to about 1e-3 of the flattening.

    Parameters
    ----------
    axes : array_like, shape (..., 3)
        Semi-axes along the coordinates of the ellipsoid's frame, for instance (a, a, b).
    height : array_like, shape (...)
        Height that is added to each semi-axis.
    origin : array_like, shape (..., 3)
        Origin of the target frame, in the ellipsoid's frame.
    rotation : array_like, shape (..., 3, 3), optional
        Rows are the axes of the target frame, in the ellipsoid's frame: ``rotation @ (x - origin)`` are coordinates in
        the target frame.

    Returns
    -------
    Ellipsoid
        The ellipsoid in the target frame.
    """
    inverse = (np.asarray(axes, dtype=np.float64) + np.asarray(height, dtype=np.float64)[..., None]) ** -2
    R = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
    centre = np.broadcast_to(-np.asarray(origin, dtype=np.float64), (*np.shape(origin)[:-1], 3))
    return Ellipsoid(np.einsum("...ik,...k,...jk->...ij", R, inverse, R), np.einsum("...ij,...j->...i", R, centre))


def visible(x: Array, surface: Ellipsoid, s: Array) -> Mask:
    """Return whether a point of the ellipsoid is visible from a station: no part of the ellipsoid is in between.

    Parameters
    ----------
    x : Array, shape (..., 3)
        Points of the surface.
    surface : Ellipsoid
        Shape (..., 3, 3) and centre (..., 3) broadcast against the points.
    s : Array, shape (..., 3)
        Stations. From a station inside the ellipsoid every point is visible.

    Returns
    -------
    Mask, shape (...)
        The mask; False if x or s is not finite.
    """
    inside = surface.polar(s, s) <= 1.0
    # the tolerance includes the tangent points of the cone
    return np.asarray((surface.polar(x, s) >= 1.0) | (inside & np.isfinite(x).all(axis=-1)))


@dataclass(frozen=True, slots=True)
class HeightCandidates:
    """Points that fit, in no particular order.

    Parameters
    ----------
    x : Array, shape (..., 4, 3)
        Points; NaN if not valid.
    ranges : Array, shape (..., 4, s)
        Ranges of the points to the s stations.
    valid : Mask, shape (..., 4)
        Whether a slot contains a point.
    """

    x: Array
    ranges: Array
    valid: Mask


def locate(
    stations: Array, sign: ArrayLike, offset: Array, surface: Ellipsoid, *, positive: bool = True
) -> HeightCandidates:
    """Return all points of the ellipsoid whose ranges to three stations are known up to one unknown.

    Parameters
    ----------
    stations : Array, shape (..., 3, 3)
        Positions as rows, numbers of order one.
    sign : array_like, shape (..., 3)
        1 or -1: ranges are ``sign tau + offset``. Range differences to the first station: all 1. Sums: -1.
    offset : Array, shape (..., 3)
        The known parts of the ranges.
    surface : Ellipsoid
        Shape (..., 3, 3) and centre (..., 3).
    positive : bool
        Whether to drop points with a negative range; False keeps the solutions of the problem with flipped signs.

    Returns
    -------
    HeightCandidates
        No valid point if the stations are collinear, the input is not finite or no real point fits.

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
        flatten(stations, (3, 3), lead),
        flatten(surface.shape, (3, 3), lead),
        flatten(surface.centre, (3,), lead),
    )
    curve = three_stations(flat, flatten(sign, (3,), lead), flatten(offset, (3,), lead))
    return _reshape(_curve_points(curve, flat, A, centre, positive=positive), lead)


def locate_by_ranges(stations: Array, ranges: Array, surface: Ellipsoid) -> HeightCandidates:
    """Return all points of the ellipsoid with known ranges to two stations.

    Parameters
    ----------
    stations : Array, shape (..., 2, 3)
        Positions as rows, numbers of order one.
    ranges : Array, shape (..., 2)
        Ranges.
    surface : Ellipsoid
        Shape (..., 3, 3) and centre (..., 3).

    Returns
    -------
    HeightCandidates
        No valid point if the spheres do not meet, the input is not finite or no real point fits.

    Notes
    -----
    The circle of the two spheres replaces Ho and Chan's conic.
    """
    lead = np.broadcast_shapes(
        np.shape(stations)[:-2], np.shape(ranges)[:-1], surface.shape.shape[:-2], surface.centre.shape[:-1]
    )
    flat, A, centre = (
        flatten(stations, (2, 3), lead),
        flatten(surface.shape, (3, 3), lead),
        flatten(surface.centre, (3,), lead),
    )
    known = flatten(ranges, (2,), lead)
    curve = two_stations(flat, known, centre)
    return _reshape(_curve_points(curve, flat, A, centre, positive=True), lead)


def _reshape(found: HeightCandidates, lead: tuple[int, ...]) -> HeightCandidates:
    """Return candidates (N, ...) with the batch axis reshaped to `lead`, the shape of the caller's batch."""
    x, ranges = (v.reshape(*lead, *v.shape[1:]) for v in (found.x, found.ranges))
    return HeightCandidates(x, ranges, found.valid.reshape(*lead, _SLOTS))


def _curve_points(curve: HeightCurve, stations: Array, A: Array, centre: Array, *, positive: bool) -> HeightCandidates:
    """Return all common points of N curves and their ellipsoids; shapes A (N, 3, 3), centres (N, 3).

    If `positive` is True, points with a negative range to one of the `stations` (N, s, 3) are dropped.
    """
    with np.errstate(all="ignore"):
        E, L, alpha = curve.on_ellipsoid(A, centre)
        t, mu = _starts(curve.square, E, L, alpha)
        t, mu = _newton(t, mu, curve.square, E, L, alpha)
        x = curve.points(t, mu)
        ranges = curve.rate[:, None] * t[..., None] + curve.offset[:, None]
        away = x[:, :, None] - stations[:, None]
        size = 1.0 + np.max(np.abs(ranges), axis=-1)
        miss = np.max(np.abs(np.sqrt(dot(away, away)) - np.abs(ranges)), axis=-1)
        off = x - centre[:, None]
        height = np.abs(np.einsum("nki,nij,nkj->nk", off, A, off) - 1.0)
        valid = curve.ok[:, None] & (miss <= _TOLERANCE * size) & (height <= _TOLERANCE)
        if positive:
            valid &= (ranges >= 0.0).all(axis=-1)
        same = np.abs(t[:, :, None] - t[:, None]) + np.abs(mu[:, :, None] - mu[:, None])
    same = (same <= _SAME * size[:, :, None]) & valid[:, None]
    # drop points that an earlier slot contains
    valid &= ~np.tril(same, -1).any(axis=-1)
    # valid points first: at most four of the eight slots contain different points
    order = np.argsort(~valid, axis=-1, kind="stable")[:, :_SLOTS]
    valid = np.take_along_axis(valid, order, axis=1)
    x, ranges = (np.take_along_axis(v, order[..., None], axis=1) for v in (x, ranges))
    x[~valid], ranges[~valid] = np.nan, np.nan
    return HeightCandidates(x, ranges, valid)


# Curves of the points with given ranges.


@dataclass(frozen=True, slots=True)
class HeightCurve:
    """A batch of N curves.

    Parameters
    ----------
    base, along, across : Array, shape (N, 3)
        The vectors b, p and n.
    square : Array, shape (N, 3)
        The coefficients q, constant first.
    rate, offset : Array, shape (N, s)
        Ranges ``rate t + offset`` of the s stations.
    ok : Mask, shape (N,)
        False if the stations do not define a curve; the other arrays are finite nevertheless.
    """

    base: Array
    along: Array
    across: Array
    square: Array
    rate: Array
    offset: Array
    ok: Mask

    def points(self, t: Array, mu: Array) -> Array:
        """Return points in the planes of the curves.

        Parameters
        ----------
        t, mu : Array, shape (N, K)
            Coordinates.

        Returns
        -------
        Array, shape (N, K, 3)
            The points x.
        """
        return np.asarray(
            self.base[:, None] + self.along[:, None] * t[..., None] + self.across[:, None] * mu[..., None]
        )

    def on_ellipsoid(self, A: Array, centre: Array) -> tuple[Array, Array, Array]:
        """Return the coefficients of the ellipsoid ``(x - centre)'A(x - centre) = 1`` in the planes of the curves.

        Parameters
        ----------
        A : Array, shape (N, 3, 3)
            Shapes.
        centre : Array, shape (N, 3)
            Centres.

        Returns
        -------
        E : Array, shape (N, 3)
            Coefficients of 1, t, t^2.
        L : Array, shape (N, 2)
            Coefficients of mu, t mu.
        alpha : Array, shape (N,)
            Coefficient of mu^2; the sum vanishes on the ellipsoid.
        """
        c = self.base - centre
        Ac, Ap, An = (np.einsum("nij,nj->ni", A, v) for v in (c, self.along, self.across))
        E = np.stack([dot(c, Ac) - 1.0, 2.0 * dot(self.along, Ac), dot(self.along, Ap)], axis=-1)
        L = 2.0 * np.stack([dot(self.across, Ac), dot(self.across, Ap)], axis=-1)
        return E, L, dot(self.across, An)


def three_stations(stations: Array, sign: Array, offset: Array) -> HeightCurve:
    """Return the curve of the points whose ranges to three stations are known up to one unknown.

    Parameters
    ----------
    stations : Array, shape (N, 3, 3)
        Positions, one a row.
    sign, offset : Array, shape (N, 3)
        Ranges ``sign tau + offset`` with one unknown tau; signs are 1 or -1.

    Returns
    -------
    HeightCurve
        The curve; not ok if the stations are collinear.

    Notes
    -----
    Ho and Chan (1997), section III.
    """
    # ranges as functions of the first: r_i = turn_i r_1 + gap_i
    turn = sign * sign[:, :1]
    gap = offset - turn * offset[:, :1]
    a = stations[:, 1:] - stations[:, :1]
    length = np.sum(a * a, axis=-1)
    normal = np.cross(a[:, 0], a[:, 1])
    size = np.sum(normal * normal, axis=-1)
    ok = np.isfinite(gap).all(axis=-1)
    ok &= size > _THIN**2 * length[:, 0] * length[:, 1]
    # items that are not ok get valid numbers, so that no result is infinite or NaN
    size, gap = np.where(ok, size, 1.0), np.where(ok[:, None], gap, 0.0)
    a = np.where(ok[:, None, None], a, np.eye(3)[1:])
    normal = np.where(ok[:, None], normal, np.eye(3)[0])
    length = np.where(ok[:, None], length, 1.0)
    # the reciprocal basis of the plane
    first, second = np.cross(a[:, 1], normal) / size[:, None], np.cross(normal, a[:, 0]) / size[:, None]
    fixed, slope = 0.5 * (length - gap[:, 1:] ** 2), -turn[:, 1:] * gap[:, 1:]
    p = slope[:, :1] * first + slope[:, 1:] * second
    start = fixed[:, :1] * first + fixed[:, 1:] * second
    # r_1 = scale t + shift: p becomes at most a unit long, and b is near the stations
    long = np.maximum(dot(p, p), 1.0)
    shift = -dot(start, p) / long
    start, scale = start + p * shift[:, None], 1.0 / np.sqrt(long)
    square = [shift**2 - dot(start, start), 2.0 * scale * (shift - dot(start, p)), (1.0 - dot(p, p)) / long]
    return HeightCurve(
        np.where(ok[:, None], stations[:, 0], 0.0) + start,
        p * scale[:, None],
        normal / np.sqrt(size)[:, None],
        np.stack(square, axis=-1),
        turn * scale[:, None],
        gap + turn * shift[:, None],
        ok,
    )


def two_stations(stations: Array, ranges: Array, towards: Array) -> HeightCurve:
    """Return the circle of the points with known ranges to two stations.

    Parameters
    ----------
    stations : Array, shape (N, 2, 3)
        Positions, one a row.
    ranges : Array, shape (N, 2)
        Ranges.
    towards : Array, shape (N, 3)
        A point; mu increases towards it if it is off the line of the stations.

    Returns
    -------
    HeightCurve
        The circle; its parameters (t, mu) are on the unit circle. Not ok if the spheres do not meet.
    """
    a = stations[:, 1] - stations[:, 0]
    length = np.sqrt(dot(a, a))
    usable = np.isfinite(ranges).all(axis=-1) & np.isfinite(towards).all(axis=-1) & (length > 0.0)
    axis = np.where(usable[:, None], a, np.eye(3)[0]) / np.where(usable, length, 1.0)[:, None]
    length, ranges = np.where(usable, length, 1.0), np.where(usable[:, None], ranges, 0.0)
    # centre of the circle on the line from the first station, and squared radius; factored, so that no digits cancel
    foot = 0.5 * (length + (ranges[:, 0] - ranges[:, 1]) * (ranges[:, 0] + ranges[:, 1]) / length)
    radius = (ranges[:, 0] - foot) * (ranges[:, 0] + foot)
    ok = usable & (radius >= 0.0)
    radius = np.sqrt(np.where(ok, radius, 0.0))
    base = np.where(usable[:, None], stations[:, 0], 0.0) + axis * foot[:, None]
    up = _perpendicular(axis, np.where(usable[:, None], towards, 0.0) - base)
    square = np.broadcast_to([1.0, 0.0, -1.0], base.shape)
    along = np.cross(axis, up) * radius[:, None]
    return HeightCurve(base, along, up * radius[:, None], square, np.zeros_like(ranges), ranges, ok)


def _perpendicular(axis: Array, hint: Array) -> Array:
    """Return unit vectors (N, 3) normal to the axes (N, 3), towards the hint (N, 3) if the hint is off the axis.

    Otherwise they point towards the coordinate axis that is farthest from the axis.
    """
    least = np.eye(3)[np.argmin(np.abs(axis), axis=-1)]
    off = hint - axis * dot(axis, hint)[:, None]
    weak = dot(off, off) <= _AXIAL * dot(hint, hint)
    off = np.where(weak[:, None], least - axis * dot(axis, least)[:, None], off)
    return np.asarray(off / np.sqrt(dot(off, off))[:, None])


# Intersections of a curve with the ellipsoid.


def quartic(square: Array, E: Array, L: Array, alpha: Array) -> Array:
    """Return the coefficients of ``Q^2 - L^2 q``, the eliminant of the two conics.

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
        Coefficients, constant first.
    """
    Q = E + alpha[:, None] * square
    return _times(Q, Q) - _times(_times(L, L), square)


def _times(a: Array, b: Array) -> Array:
    """Return the product of polynomials; coefficients are constant first."""
    out = np.zeros((len(a), a.shape[1] + b.shape[1] - 1))
    for i in range(a.shape[1]):
        out[:, i : i + b.shape[1]] += a[:, i, None] * b
    return out


def _roots(c: Array) -> Array:
    """Return the four complex roots (N, 4) of quartics (N, 5); coefficients are constant first."""
    # coefficients that are not finite are replaced by 1 + t^4, which has no real root
    c = np.where(np.isfinite(c).all(axis=-1, keepdims=True), c, [1.0, 0.0, 0.0, 0.0, 1.0])
    size = np.max(np.abs(c), axis=-1)
    c = c / np.where(size > 0.0, size, 1.0)[:, None]
    # a vanishing leading coefficient is a root at infinity
    lead = np.where(np.abs(c[:, 4]) > _LEAD, c[:, 4], _LEAD)
    companion = np.zeros((len(c), 4, 4))
    companion[:, [1, 2, 3], [0, 1, 2]] = 1.0
    companion[:, :, 3] = -c[:, :4] / lead[:, None]
    return np.asarray(np.linalg.eigvals(companion), dtype=np.complex128)


def _starts(square: Array, E: Array, L: Array, alpha: Array) -> tuple[Array, Array]:
    """Return starts (t, mu), each (N, 8), near every real intersection, two slots for each root.

    t is NaN if a slot has no start. See `quartic` for the arguments.
    """
    roots = _roots(quartic(square, E, L, alpha))
    t = np.tile(roots.real, 2)
    # a pair slightly off the real axis may be a double root
    real = np.abs(np.tile(roots.imag, 2)) <= _NEAR * (1.0 + np.abs(t))
    mu = np.sqrt(np.maximum(_value(square, t), 0.0)) * np.repeat([1.0, -1.0], _SLOTS)
    parts = np.stack([_value(E, t), (L[:, :1] + L[:, 1:] * t) * mu, alpha[:, None] * mu * mu])
    near = np.abs(parts.sum(axis=0)) <= _NEAR * (np.abs(parts).sum(axis=0) + np.abs(E).max(axis=-1, keepdims=True))
    return np.where(real & near, t, np.nan), mu


def _newton(t: Array, mu: Array, square: Array, E: Array, L: Array, alpha: Array) -> tuple[Array, Array]:
    """Return the results (t, mu) of Newton's iteration on the two conics, from starts (N, K).

    Slots that did not converge are not marked; the caller finds them by their residuals. See `quartic` for the
    coefficients `square`, E, L and alpha.
    """
    go = np.isfinite(t)
    for _ in range(_NEWTON):
        # residuals of the two conics, and their derivatives by t and mu
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
        # a converged slot does not move any more, because the number of iterations depends on its neighbours
        go &= np.abs(move_t) + np.abs(move_mu) > _RESTS * (np.abs(t) + np.abs(mu))
        if not go.any():
            break
    return t, mu


def _value(c: Array, t: Array) -> Array:
    """Return the values of quadratic polynomials c (N, 3) at t (N, K); coefficients are constant first."""
    return np.asarray(c[:, :1] + t * (c[:, 1:2] + t * c[:, 2:]))
