r"""Curves on which a point has measured ranges, as conics in their own plane.

.. math:: x(t, \mu) = b + p\,t + n\,\mu, \qquad \mu^2 = q_0 + q_1 t + q_2 t^2, \qquad r_i = \rho_i t + e_i

Three stations whose ranges are known up to one unknown: squared and subtracted, :math:`r_i = \sigma_i r_1 + e_i`
gives :math:`2 a_i^\top (x - s_1) = |a_i|^2 - e_i^2 - 2 \sigma_i e_i r_1` with :math:`a_i = s_i - s_1`; `n` is the unit
normal of the plane of the stations and `t` is :math:`r_1`, shifted and scaled so that `p` is at most a unit long and
`b` near the stations (nearly collinear stations make both huge otherwise). Two stations of known range: a circle
about their line, `t` and :math:`\mu` being cosine and sine.

Source: K. C. Ho and Y. T. Chan, "Geolocation of a known altitude object from TDOA and FDOA measurements", IEEE Trans.
Aerosp. Electron. Syst. 33 (1997), section III (the elimination).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# sine of the angle at the first station below which three stations count as one line
_THIN = 1e-7


@dataclass(frozen=True, slots=True)
class Curve:
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
        False where the stations fix no such curve; the other arrays are finite all the same.
    """

    base: Array
    along: Array
    across: Array
    square: Array
    rate: Array
    offset: Array
    ok: Mask

    def points(self, t: Array, mu: Array) -> Array:
        """Points of the planes of the curves.

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
        """Coefficients of the ellipsoid ``(x - centre)'A(x - centre) = 1`` on the planes of the curves.

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
        E = np.stack([_dot(c, Ac) - 1.0, 2.0 * _dot(self.along, Ac), _dot(self.along, Ap)], axis=-1)
        L = 2.0 * np.stack([_dot(self.across, Ac), _dot(self.across, Ap)], axis=-1)
        return E, L, _dot(self.across, An)


def three_stations(stations: Array, sign: Array, offset: Array) -> Curve:
    """Curve of the points whose ranges to three stations are known up to one unknown.

    Parameters
    ----------
    stations : Array, shape (N, 3, 3)
        Positions, one a row.
    sign, offset : Array, shape (N, 3)
        Ranges ``sign tau + offset`` with one unknown tau; signs are 1 or -1.

    Returns
    -------
    Curve
        Not ok where the stations lie on a line.

    Notes
    -----
    Ho and Chan (1997), section III.
    """
    turn = sign * sign[:, :1]
    gap = offset - turn * offset[:, :1]
    a = stations[:, 1:] - stations[:, :1]
    length = np.sum(a * a, axis=-1)
    normal = np.cross(a[:, 0], a[:, 1])
    size = np.sum(normal * normal, axis=-1)
    ok = np.isfinite(gap).all(axis=-1)
    ok &= size > _THIN**2 * length[:, 0] * length[:, 1]
    size, gap = np.where(ok, size, 1.0), np.where(ok[:, None], gap, 0.0)
    a = np.where(ok[:, None, None], a, np.eye(3)[1:])
    normal = np.where(ok[:, None], normal, np.eye(3)[0])
    length = np.where(ok[:, None], length, 1.0)
    # the reciprocal basis of the plane
    first, second = np.cross(a[:, 1], normal) / size[:, None], np.cross(normal, a[:, 0]) / size[:, None]
    fixed, slope = 0.5 * (length - gap[:, 1:] ** 2), -turn[:, 1:] * gap[:, 1:]
    p = slope[:, :1] * first + slope[:, 1:] * second
    start = fixed[:, :1] * first + fixed[:, 1:] * second
    long = np.maximum(_dot(p, p), 1.0)
    shift = -_dot(start, p) / long
    start, scale = start + p * shift[:, None], 1.0 / np.sqrt(long)
    square = [shift**2 - _dot(start, start), 2.0 * scale * (shift - _dot(start, p)), (1.0 - _dot(p, p)) / long]
    return Curve(
        np.where(ok[:, None], stations[:, 0], 0.0) + start,
        p * scale[:, None],
        normal / np.sqrt(size)[:, None],
        np.stack(square, axis=-1),
        turn * scale[:, None],
        gap + turn * shift[:, None],
        ok,
    )


def two_stations(stations: Array, ranges: Array, towards: Array) -> Curve:
    """Circle of the points with known ranges to two stations.

    Parameters
    ----------
    stations : Array, shape (N, 2, 3)
        Positions, one a row.
    ranges : Array, shape (N, 2)
        Ranges.
    towards : Array, shape (N, 3)
        A point; mu grows towards it where it is off the line of the stations.

    Returns
    -------
    Curve
        The parameters (t, mu) lie on the unit circle. Not ok where the spheres do not meet.
    """
    a = stations[:, 1] - stations[:, 0]
    length = np.sqrt(_dot(a, a))
    usable = np.isfinite(ranges).all(axis=-1) & np.isfinite(towards).all(axis=-1) & (length > 0.0)
    axis = np.where(usable[:, None], a, np.eye(3)[0]) / np.where(usable, length, 1.0)[:, None]
    length, ranges = np.where(usable, length, 1.0), np.where(usable[:, None], ranges, 0.0)
    foot = 0.5 * (length + (ranges[:, 0] - ranges[:, 1]) * (ranges[:, 0] + ranges[:, 1]) / length)
    radius = (ranges[:, 0] - foot) * (ranges[:, 0] + foot)
    ok = usable & (radius >= 0.0)
    radius = np.sqrt(np.where(ok, radius, 0.0))
    base = np.where(usable[:, None], stations[:, 0], 0.0) + axis * foot[:, None]
    up = _perpendicular(axis, np.where(usable[:, None], towards, 0.0) - base)
    square = np.broadcast_to([1.0, 0.0, -1.0], base.shape)
    along = np.cross(axis, up) * radius[:, None]
    return Curve(base, along, up * radius[:, None], square, np.zeros_like(ranges), ranges, ok)


def _perpendicular(axis: Array, hint: Array) -> Array:
    """Find the unit vector normal to the axis, towards the hint where that is off the axis."""
    least = np.eye(3)[np.argmin(np.abs(axis), axis=-1)]
    off = hint - axis * _dot(axis, hint)[:, None]
    weak = _dot(off, off) <= 1e-12 * _dot(hint, hint)
    off = np.where(weak[:, None], least - axis * _dot(axis, least)[:, None], off)
    return np.asarray(off / np.sqrt(_dot(off, off))[:, None])


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.sum(a * b, axis=-1))
