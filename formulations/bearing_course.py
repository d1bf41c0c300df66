r"""A polynomial course from bearings of many epochs: pseudo-linear least squares, then one instrumental-variable pass.

A target at :math:`p(t) = \sum_j c_j t^j`, seen at time t from S with azimuth A and elevation E, meets, linearly in c,

.. math:: g^\top \Bigl(\sum_j c_j t^j - S\Bigr) = 0, \quad g_A = (\sin A, -\cos A, 0), \quad
   g_E = (\sin E \cos A, \sin E \sin A, -\cos E),

with errors :math:`\rho \sin n_A` and, to first order, :math:`D n_E`. Here :math:`n_A` and :math:`n_E` are the errors of
the angles, :math:`\rho` is the horizontal range and D the slant range. With rows :math:`G_{kj} = t_k^j g_k`, right
sides :math:`b = g^\top S` and weights W:

- *plain*: :math:`\min |W_0 (G c - b)|^2`, :math:`W_0 = 1/\sigma`;
- *weighted*: the same with the weights :math:`1/(\rho \sigma_A)`, :math:`1/(D \sigma_E)` at the previous course;
- *instrumental*: :math:`Z^\top W^2 (G c - b) = 0`, with the instruments `Z`: the rows `G` at the angles that the
  weighted course predicts. The noise in `G` biases the first two courses. In a run of many rays, this bias is larger
  than the scatter. `Z` does not contain the noise.

No epoch needs enough rows for a separate fix: one station that manoeuvres may be enough.

Source: K. Dogancay, "Bias compensation for the bearings-only pseudolinear target track estimator", IEEE Trans. Signal
Process. 54 (2006), and "3D pseudolinear target motion analysis from angle measurements", IEEE Trans. Signal Process.
63 (2015).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from formulations.algebra import Array, Mask, dot, span, uncentre
from formulations.bearing_ls import BearingRays, lengths, look, rays

# Singular value of scaled rows, relative to the largest, that counts as zero: five decades above rounding errors.
_RANK = 1e-10
_NEAR = 1e-6  # shortest range in a weight, relative to the size of the array, as in `bearing_ls`


@dataclass(frozen=True, slots=True)
class BearingCourses:
    """Pseudo-linear courses of a batch.

    Parameters
    ----------
    plain, weighted, instrumental : Array, shape (N, order + 1, d)
        Position, velocity, half the acceleration at time zero; NaN if the rows do not determine them.
    ok : Mask, shape (N,)
        Whether the instrumental course exists.
    ahead : Mask, shape (N,)
        Whether it also is in front of the stations at every bearing.
    """

    plain: Array
    weighted: Array
    instrumental: Array
    ok: Mask
    ahead: Mask


@dataclass(frozen=True, slots=True)
class _CourseRun:
    """The data of a fit of N courses to m bearings each, in d dimensions.

    `station` (N, m, d) are the positions, `axes` the axes of the stations (None: the axes of the frame). `powers` (N,
    m, order + 1) are the powers of the scaled times. `normal` (N, rows, d) are the vectors g, `right` (N, rows) the
    right sides. `both` is True if elevations follow the azimuths, so that there are 2 m rows. `least` (N, 1) is the
    shortest range in a weight.
    """

    station: Array
    axes: Array | None
    powers: Array
    normal: Array
    right: Array
    both: bool
    least: Array

    def design(self, normal: Array) -> Array:
        """Return the rows G (N, rows, n) of the n course coefficients, made of normals (N, rows, d)."""
        powers = np.concatenate([self.powers, self.powers], axis=1) if self.both else self.powers
        return (powers[..., :, None] * normal[..., None, :]).reshape(*normal.shape[:2], -1)

    def line(self, c: Array) -> Array:
        """Return the lines of sight (N, m, d) to a course c (N, order + 1, d), in the frame of the stations."""
        return np.asarray(self.powers @ c - self.station)

    def own(self, c: Array) -> Array:
        """Return the lines of sight (N, m, d) to a course c, in the axes of each station."""
        return self.line(c) if self.axes is None else np.einsum("nmij,nmj->nmi", self.axes, self.line(c))


def sight_courses(
    azimuth: ArrayLike,
    station: ArrayLike,
    time: ArrayLike,
    weight: ArrayLike,
    *,
    elevation: ArrayLike | None = None,
    elevation_weight: ArrayLike | None = None,
    axes: Array | None = None,
    order: int = 1,
    passes: int = 2,
) -> BearingCourses:
    """Return polynomial courses fitted to bearings, without an initial guess.

    Parameters
    ----------
    azimuth, elevation : array_like, shape (N, m)
        Radians, in the given axes; stations in space need elevations.
    station : array_like, shape (N, m, d)
        Position of the station of each bearing, numbers of order one.
    time : array_like, shape (m,)
        Time of each bearing.
    weight, elevation_weight : array_like, shape (N, m)
        One over the standard deviation; zero if the angle is absent (its value is then not read).
    axes : array_like, shape (N, m, d, d), optional
        Rows are the unit vectors of each station's axes; None: the axes of the frame.
    order : int
        0: static, 1: constant velocity, 2: constant acceleration.
    passes : int
        Weighted passes before the instrumental one: the second moves fixes by some thousandths of their error, a third
        by nothing.

    Returns
    -------
    BearingCourses
        Three courses for each item, and whether they exist.

    Notes
    -----
    Dogancay (2006, 2015); rows are triangularised, not squared. An item that is singular or not finite changes nothing
    in the others.
    """
    S, wA = np.asarray(station, dtype=np.float64), np.asarray(weight, dtype=np.float64)
    use = wA > 0.0
    A, both = np.where(use, azimuth, 0.0), S.shape[-1] == 3
    E = wE = np.zeros_like(wA)
    if both and elevation is not None and elevation_weight is not None:
        wE = np.where(use, elevation_weight, 0.0)
        E = np.where(wE > 0.0, elevation, 0.0)
    W = np.concatenate([wA, wE], axis=-1) if both else wA
    when = np.broadcast_to(np.asarray(time, dtype=np.float64), wA.shape)
    with np.errstate(all="ignore"):
        middle, half = span(when, use)
        powers = ((when - middle) / half)[..., None] ** np.arange(order + 1.0)
        seen = rays(A, E if both else None, axes)
        run = _course_run(S, axes, powers, seen, both)
        G = run.design(run.normal)
        c = plain = _weighted_solution(G, G, run.right, W, order)
        for _ in range(passes):
            c = _weighted_solution(G, G, run.right, W / lengths(run.own(c), run.least), order)
        own = run.own(c)
        instruments = run.design(look(own, axes).normals)
        final = _weighted_solution(instruments, G, run.right, W / lengths(own, run.least), order)
        # a bearing and its opposite give the same row, so the side of the target is checked here
        front = dot(run.line(final), seen.ahead) > 0.0
        ok = np.asarray(np.isfinite(final).all(axis=(-2, -1)))
        three = [uncentre(each, middle, half) for each in (plain, c, final)]
    return BearingCourses(three[0], three[1], three[2], ok, ok & (front | ~use).all(axis=-1))


def _course_run(S: Array, axes: Array | None, powers: Array, seen: BearingRays, both: bool) -> _CourseRun:
    """Return the data of a fit, see `_CourseRun`; `seen` are the directions of sight."""
    normal = seen.normals
    right = dot(normal, np.concatenate([S, S], axis=1) if both else S)
    size = np.sqrt(dot(S, S)).max(axis=-1, keepdims=True)
    # one station at the origin has no size: any positive length is valid
    return _CourseRun(S, axes, powers, normal, right, both, np.maximum(_NEAR * size, 1e-300))


def _weighted_solution(Z: Array, G: Array, b: Array, W: Array, order: int) -> Array:
    """Return the solution c (N, order + 1, d) of ``Z' W^2 (G c - b) = 0``; NaN if it is not unique.

    Z (N, rows, n) are the instruments, G the rows, b the right sides, W (N, rows) the weights. With Z = G it is
    weighted least squares.
    """
    n = G.shape[-1]
    # triangularised, not squared: an orthonormal base of the instruments' columns replaces Z' W
    share = np.where(W > 0.0, W / W.max(axis=-1, keepdims=True), 0.0)[..., None]
    left, right = share * Z, np.concatenate([share * G, share * b[..., None]], axis=-1)
    good = np.isfinite(left).all(axis=(-2, -1)) & np.isfinite(right).all(axis=(-2, -1))
    left, right = (np.where(good[:, None, None], part, 0.0) for part in (left, right))
    short = max(0, n - left.shape[1])  # zero rows if there are fewer rows than unknowns
    left, right = (np.pad(part, ((0, 0), (0, short), (0, 0))) for part in (left, right))
    sizes = np.sqrt((right[..., :n] ** 2).sum(axis=-2))
    good &= (sizes > 0.0).all(axis=-1)
    sizes = np.where(sizes > 0.0, sizes, 1.0)
    base = np.linalg.qr(left)[0]
    small = np.swapaxes(base, -1, -2) @ right
    U, size, V = np.linalg.svd(small[..., :n] / sizes[:, None])
    good &= size[:, -1] > _RANK * size[:, 0]
    inverse = np.where(good[:, None], 1.0 / np.where(good[:, None], size, 1.0), np.nan)
    c = np.einsum("nji,nj->ni", V, inverse * np.einsum("nkj,nk->nj", U, small[..., n])) / sizes
    return np.asarray(c.reshape(len(c), order + 1, -1), dtype=np.float64)
