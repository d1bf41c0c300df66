r"""Pseudo-linear fixes from bearings: weighted least squares, then one instrumental-variable pass.

A station S with azimuth A and elevation E (in its own axes) sees p in two planes,

.. math:: g_A = (\sin A, -\cos A, 0), \quad g_E = (\sin E \cos A, \sin E \sin A, -\cos E), \qquad g^\top (p - S) = 0,

with errors :math:`\rho \sin n_A` and, to first order, :math:`D n_E`. Here :math:`n_A` and :math:`n_E` are the errors of
the angles, :math:`\rho` is the horizontal range and D the slant range. In the plane there is only the first row. With
rows `G`, right sides :math:`b = g^\top S` and weights `W`:

- *plain*: :math:`\min |W_0 (G p - b)|^2`, :math:`W_0 = 1/\sigma`;
- *weighted*: the same with the weights :math:`1/(\rho \sigma_A)`, :math:`1/(D \sigma_E)` at the previous fix;
- *instrumental*: :math:`Z^\top W^2 (G p - b) = 0`, with the instruments `Z`: the rows `G` at the angles that the
  weighted fix predicts. The noise in `G` biases the first two fixes: with many rays, towards the stations by about
  :math:`-(G^\top G)^{-1} \sum \sigma^2 (\rho u_h + D u)`. `Z` does not contain the noise.

Source: K. Dogancay, "Bias compensation for the bearings-only pseudolinear target track estimator", IEEE Trans. Signal
Process. 54 (2006), and "3D pseudolinear target motion analysis from angle measurements", IEEE Trans. Signal Process.
63 (2015).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from formulations.algebra import Array, Mask, dot

# Determinant of a normal matrix, relative to the product of its row lengths, that counts as zero: some hundred
# roundings.
_FLAT = 1e-13
# Shortest range in a weight, relative to the size of the array: an intermediate fix may be at a station, but no real
# target is so near to a station.
_NEAR = 1e-6
_PARALLEL = 1e13  # condition number from which lines count as parallel: less than three digits would be left


@dataclass(frozen=True, slots=True)
class BearingRays:
    """Directions of sight, and the two tangents along which the angles increase, in the frame of the stations.

    Parameters
    ----------
    ahead : Array, shape (..., N, d)
        Unit directions; horizontal in the station's axes if the bearings are azimuths only.
    across : Array, shape (..., N, d)
        Unit tangents of increasing azimuth.
    upward : Array, shape (..., N, 3) or None
        Unit tangents of increasing elevation; None in the plane.
    """

    ahead: Array
    across: Array
    upward: Array | None

    @property
    def normals(self) -> Array:
        """Return the rows ``g`` (up to sign), shape (..., N or 2 N, d): azimuths, then elevations."""
        return self.across if self.upward is None else np.concatenate([self.across, self.upward], axis=-2)


@dataclass(frozen=True, slots=True)
class Sighted:
    """Pseudo-linear fixes of a batch.

    Parameters
    ----------
    plain, weighted, instrumental : Array, shape (..., d)
        The three fixes; NaN if the rows do not determine a fix.
    ok : Mask, shape (...)
        Whether the instrumental fix exists.
    ahead : Mask, shape (...)
        Whether it also is in front of every station that has a bearing.
    """

    plain: Array
    weighted: Array
    instrumental: Array
    ok: Mask
    ahead: Mask


def rays(azimuth: ArrayLike, elevation: ArrayLike | None = None, axes: ArrayLike | None = None) -> BearingRays:
    """Return the unit directions of angles.

    Parameters
    ----------
    azimuth : array_like, shape (..., N)
        Angle from the first axis towards the second, radians.
    elevation : array_like, shape (..., N), optional
        Angle above the plane of the first two axes, radians; None for the plane problem.
    axes : array_like, shape (..., N, d, d), optional
        Rows are the unit vectors of each station's axes; None: the axes of the frame.

    Returns
    -------
    BearingRays
        Unit vectors.

    Notes
    -----
    The directions of the module's text: ``across = -g_A``, ``upward = -g_E``.
    """
    A = np.asarray(azimuth, dtype=np.float64)
    if elevation is None:
        local = [np.stack([np.cos(A), np.sin(A)], axis=-1), np.stack([-np.sin(A), np.cos(A)], axis=-1)]
    else:
        A, E = np.broadcast_arrays(A, np.asarray(elevation, dtype=np.float64))
        ca, sa, ce, se = np.cos(A), np.sin(A), np.cos(E), np.sin(E)
        local = [
            np.stack([ce * ca, ce * sa, se], axis=-1),
            np.stack([-sa, ca, np.zeros_like(A)], axis=-1),
            np.stack([-se * ca, -se * sa, ce], axis=-1),
        ]
    if axes is not None:
        turn = np.asarray(axes, dtype=np.float64)
        local = [np.einsum("...ij,...i->...j", turn, vector) for vector in local]
    return BearingRays(local[0], local[1], local[2] if elevation is not None else None)


def sight(
    azimuth: ArrayLike,
    station: ArrayLike,
    weight: ArrayLike,
    *,
    elevation: ArrayLike | None = None,
    elevation_weight: ArrayLike | None = None,
    axes: ArrayLike | None = None,
    passes: int = 2,
) -> Sighted:
    """Return fixes from bearings, without an initial guess.

    Parameters
    ----------
    azimuth, elevation : array_like, shape (..., N)
        Radians, in the given axes. Without `elevation`, the problem is plane if the stations are plane. Otherwise it
        has only azimuths, which do not determine the height unless the axes differ.
    station : array_like, shape (..., N, d)
        Positions, numbers of order one.
    weight, elevation_weight : array_like, shape (..., N)
        One over the standard deviation; zero if the angle is absent (its value is then not read). An elevation
        needs the azimuth of the same station.
    axes : array_like, shape (..., N, d, d), optional
        Rows are the unit vectors of each station's axes; None: the axes of the frame.
    passes : int
        Weighted passes before the instrumental one: the second moves fixes by some thousandths of their error, a third
        by nothing.

    Returns
    -------
    Sighted
        Three fixes for each item, and whether they exist.

    Notes
    -----
    Dogancay (2006, 2015). Elementwise: an item that is singular or not finite changes nothing in the others.
    """
    S = np.asarray(station, dtype=np.float64)
    wA = np.asarray(weight, dtype=np.float64)
    use = wA > 0.0
    # the values of absent angles may be NaN; zeros replace them
    A = np.where(use, azimuth, 0.0)
    E, wE = None, np.zeros_like(wA)
    if S.shape[-1] == 3:
        wE = wE if elevation is None or elevation_weight is None else np.where(use, elevation_weight, 0.0)
        E = np.where(wE > 0.0, 0.0 if elevation is None else elevation, 0.0)
    turn = None if axes is None else np.asarray(axes, dtype=np.float64)
    with np.errstate(all="ignore"):
        seen = rays(A, E, turn)
        # relative to the middle of the present stations: far from the origin the products g'S lose the digits of the
        # fix
        share = np.where(use, 1.0, 0.0)[..., None]
        middle = (share * S).sum(axis=-2, keepdims=True) / share.sum(axis=-2, keepdims=True)
        S = S - middle
        least = _NEAR * np.sqrt((share * S * S).sum(axis=(-2, -1)))[..., None]
        G, W = seen.normals, np.concatenate([wA, wE], axis=-1) if E is not None else wA
        own = np.concatenate([S, S], axis=-2) if E is not None else S
        b = dot(G, own)
        point = plain = _weighted_solution(G, G, b, W)
        for _ in range(passes):
            point = _weighted_solution(G, G, b, W / lengths(_lines_in_axes(point, S, turn), least))
        line = _lines_in_axes(point, S, turn)
        final = _weighted_solution(look(line, turn).normals, G, b, W / lengths(line, least))
        # an azimuth and its opposite give the same row, so the side of the target is checked here
        front = dot(final[..., None, :] - S, seen.ahead) > 0.0
    ok = np.asarray(np.isfinite(final).all(axis=-1))
    shift = middle[..., 0, :]
    return Sighted(plain + shift, point + shift, final + shift, ok, ok & (front | ~use).all(axis=-1))


def predict(point: Array, station: Array, axes: ArrayLike | None = None) -> Array:
    """Return azimuth and elevation of a point.

    Parameters
    ----------
    point : Array, shape (..., 3)
        Target.
    station : Array, shape (..., N, 3)
        Positions.
    axes : array_like, shape (..., N, 3, 3), optional
        Rows are the unit vectors of each station's axes.

    Returns
    -------
    Array, shape (..., N, 2)
        Radians.

    Notes
    -----
    Plain geometry.
    """
    line = _lines_in_axes(point, station, None if axes is None else np.asarray(axes, dtype=np.float64))
    flat = np.hypot(line[..., 0], line[..., 1])
    return np.stack([np.arctan2(line[..., 1], line[..., 0]), np.arctan2(line[..., 2], flat)], axis=-1)


def meeting(direction: Array, station: Array) -> Array:
    """Return the point nearest to lines in the least-squares sense, with weights of one over the distance along them.

    Parameters
    ----------
    direction : Array, shape (N, 3)
        Unit vectors.
    station : Array, shape (N, 3)
        A point of each line.

    Returns
    -------
    Array, shape (3,)
        The point; NaN if the lines are parallel.

    Notes
    -----
    Two passes, the first without weights.
    """
    off = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    weight, point = np.ones(len(station)), np.full(3, np.nan)
    for _ in range(2):
        left = np.einsum("n,nij->ij", weight, off)
        if not np.isfinite(left).all() or np.linalg.cond(left) > _PARALLEL:
            return np.full(3, np.nan)
        point = np.linalg.solve(left, np.einsum("n,nij,nj->i", weight, off, station))
        weight = 1.0 / np.maximum(np.sum((point - station) ** 2, axis=1), _NEAR**2)
    return point


def look(line: Array, axes: ArrayLike | None = None) -> BearingRays:
    """Return the unit directions of lines of sight.

    Parameters
    ----------
    line : Array, shape (..., N, d)
        From each station to the target, in the station's axes; with elevations in space.
    axes : array_like, shape (..., N, d, d), optional
        Rows are the unit vectors of each station's axes; None: the axes of the frame.

    Returns
    -------
    BearingRays
        Unit vectors in the frame.
    """
    azimuth = np.arctan2(line[..., 1], line[..., 0])
    if line.shape[-1] == 2:
        return rays(azimuth, None, axes)
    return rays(azimuth, np.arctan2(line[..., 2], np.hypot(line[..., 0], line[..., 1])), axes)


def lengths(line: Array, least: Array) -> Array:
    """Return the factors from angle errors to row errors: horizontal ranges, then, in space, slant ranges.

    Parameters
    ----------
    line : Array, shape (..., N, d)
        From each station to the target, in the station's axes.
    least : Array, broadcast to shape (..., N)
        Shortest horizontal range.

    Returns
    -------
    Array, shape (..., N) or (..., 2 N)
        One factor for each row.
    """
    flat = np.maximum(np.hypot(line[..., 0], line[..., 1]), least)
    return flat if line.shape[-1] == 2 else np.concatenate([flat, np.hypot(flat, line[..., 2])], axis=-1)


def _lines_in_axes(point: Array, S: Array, turn: Array | None) -> Array:
    """Return the lines of sight (..., N, d) from stations S to a point, in the axes of each station.

    `turn` (..., N, d, d) are the axes; None: the axes of the frame.
    """
    line = point[..., None, :] - S
    return line if turn is None else np.einsum("...ij,...j->...i", turn, line)


def _weighted_solution(Z: Array, G: Array, b: Array, W: Array) -> Array:
    """Return the solution p (..., d) of ``Z' W^2 (G p - b) = 0``, with one step of refinement; NaN if it is not unique.

    Z are the instruments, G the rows, b the right sides, W the weights. With Z = G it is weighted least squares.
    """
    # only ratios of weights matter; the largest weight becomes one, so that no square overflows
    left = Z * np.where(W > 0.0, W / W.max(axis=-1, keepdims=True), 0.0)[..., None] ** 2
    inverse = _inverse(np.einsum("...ki,...kj->...ij", left, G))
    point = np.zeros(inverse.shape[:-1])
    # the second round is the refinement: residuals from G, not from the squares in the normal matrix
    for _ in range(2):
        rest = b - np.einsum("...kj,...j->...k", G, point)
        point = point + np.einsum("...ij,...j->...i", inverse, np.einsum("...ki,...k->...i", left, rest))
    return point


def _inverse(M: Array) -> Array:
    """Return the inverse of matrices (..., 2, 2) or (..., 3, 3) by cofactors; NaN if singular."""
    if M.shape[-1] == 2:
        first, second = M[..., 0, :], M[..., 1, :]
        columns = np.stack(
            [np.stack([second[..., 1], -second[..., 0]], -1), np.stack([-first[..., 1], first[..., 0]], -1)], -1
        )
    else:
        a, b, c = M[..., 0, :], M[..., 1, :], M[..., 2, :]
        columns = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)
    determinant = (M[..., 0, :] * columns[..., :, 0]).sum(axis=-1)
    size = np.sqrt((M * M).sum(axis=-1)).prod(axis=-1)
    determinant = np.where(np.abs(determinant) > _FLAT * size, determinant, np.nan)
    return np.asarray(columns / determinant[..., None, None])
