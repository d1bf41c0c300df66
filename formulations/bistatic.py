r"""One receiver at the origin, one illuminator at A: range from excess path and direction, and a moving start.

With :math:`d = |A|`, unit direction u and excess path :math:`l = r + |r u - A| - d`,

.. math:: r = \frac{l^2 + 2 d l}{2\,[\,d - u^\top A + l\,]}, \qquad
   \frac{\partial l}{\partial r} = 1 + \frac{r - u^\top A}{|r u - A|} \ge 0.

Between the receiver and the illuminator, l and the slope are zero, so that the quotient is 0/0.

A target :math:`p(t) = \sum_k c_k t^k` meets, exactly and linearly in c,

.. math:: e_1^\top p = 0, \quad e_2^\top p = 0, \quad (u - A/L)^\top p = \frac{L^2 - d^2}{2 L}, \qquad L = l + d,

with :math:`e_1, e_2` normal to u; for angle errors :math:`\sigma_1, \sigma_2` and path error :math:`\sigma_l` the rows
have the deviations :math:`r \sigma_1`, :math:`r \sigma_2` and, to first order, :math:`\sigma_l |p - A| / L`. An angle
error :math:`\delta` changes the last row by :math:`r \delta^2 / 2` in second order, which must be added to its
deviation. Otherwise a precise path would turn the errors of u in its row into wrong information about the direction.

Source: M. I. Skolnik, "An analysis of bistatic radar", IRE Trans. Aerosp. Navig. Electron. ANE-8 (1961) (the ellipse);
the linear rows are its polar equation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from formulations.algebra import Array, Mask, dot, flatten, span, uncentre

_PASSES = 2  # weights from half the path, then from the resulting course; a start needs no third pass
_RANK = 1e-11  # singular value of the whitened rows, relative to the largest, that counts as zero: far above rounding


@dataclass(frozen=True, slots=True)
class BistaticRanges:
    """Ranges from the receiver.

    Parameters
    ----------
    range : Array, shape (...)
        Ranges; NaN if not valid.
    slope : Array, shape (...)
        Change of the excess path with the range, from 0 (towards the illuminator) to 2 (away from it); NaN at 0/0.
    turn : Array, shape (..., 3)
        Change of the excess path with the direction, a vector normal to it.
    valid : Mask, shape (...)
        False if the excess path is not positive, the input is not finite or the slope is below the limit.
    """

    range: Array
    slope: Array
    turn: Array
    valid: Mask

    def deviation(self, excess: ArrayLike, direction: Array) -> Array:
        """Return a bound of the standard deviation of the range of one epoch.

        Parameters
        ----------
        excess : array_like, shape (...)
            Standard deviation of the excess path.
        direction : Array, shape (..., 3, 3)
            Covariance of the unit direction.

        Returns
        -------
        Array, shape (...)
            The bound; infinite if not valid.
        """
        spread = np.einsum("...i,...ij,...j->...", self.turn, direction, self.turn)
        noise = np.sqrt(np.asarray(excess, dtype=np.float64) ** 2 + spread)
        return np.where(self.valid, noise / np.where(self.valid, self.slope, 1.0), np.inf)


@dataclass(frozen=True, slots=True)
class BistaticCourse:
    """A polynomial course.

    Parameters
    ----------
    coefficients : Array, shape (..., order + 1, 3)
        Position, velocity, half the acceleration, ... at time zero; NaN if not valid.
    valid : Mask, shape (...)
        False if the epochs do not determine the course, or if it is not in front of the receiver at each epoch.
    """

    coefficients: Array
    valid: Mask


def triad(azimuth: ArrayLike, elevation: ArrayLike) -> Array:
    """Return the axes of a direction: of increasing azimuth, of increasing elevation, and the direction.

    Parameters
    ----------
    azimuth, elevation : array_like, shape (...)
        Radians; azimuth from +x towards +y, elevation from the xy plane towards +z.

    Returns
    -------
    Array, shape (..., 3, 3)
        Unit vectors as rows. Errors along the first are azimuth errors times the cosine of the elevation.
    """
    azimuth, elevation = np.broadcast_arrays(azimuth, elevation)
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    rows = [[-sa, ca, 0.0 * sa], [-se * ca, -se * sa, ce], [ce * ca, ce * sa, se]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def range_of(excess: ArrayLike, direction: Array, illuminator: Array, *, least: float = 1e-6) -> BistaticRanges:
    """Return the range from excess path and direction, in closed form.

    Parameters
    ----------
    excess : array_like, shape (...)
        Excess path l, in the unit of the illuminator's position.
    direction : Array, shape (..., 3)
        Unit direction of the target from the receiver.
    illuminator : Array, shape (..., 3)
        Position of the illuminator relative to the receiver.
    least : float
        Least slope of a valid range: at the default, a metre of path is a thousand kilometres of range.

    Returns
    -------
    BistaticRanges
        Ranges with the partial derivatives that bound their errors.

    Notes
    -----
    Skolnik (1961).
    """
    l = np.asarray(excess, dtype=np.float64)  # noqa: E741
    u, A = np.asarray(direction, dtype=np.float64), np.asarray(illuminator, dtype=np.float64)
    with np.errstate(all="ignore"):
        d, along = np.sqrt(dot(A, A)), dot(u, A)
        off = A - along[..., None] * u
        aside = dot(off, off)
        # d - u'A without cancellation near the direction of the illuminator
        behind = np.where(along > 0.0, aside / (d + along), d - along)
        r = (0.5 * l * l + d * l) / (behind + l)
        reach = np.sqrt((r - along) ** 2 + aside)
        # 1 + (r - u'A) / reach, without cancellation if the target is in front of the illuminator
        slope = np.where(along > r, aside / (reach + (along - r)), reach + (r - along)) / reach
        turn = -off * (r / reach)[..., None]
        valid = (l > 0.0) & np.isfinite(r) & np.isfinite(slope) & (slope >= least)
    return BistaticRanges(np.where(valid, r, np.nan), slope, turn, valid)


def course(
    excess: Array, axes: Array, illuminator: Array, time: Array, sigma: Array, *, order: int = 1
) -> BistaticCourse:
    """Return a polynomial course fitted to several epochs by weighted linear least squares.

    Parameters
    ----------
    excess : Array, shape (..., k)
        Excess paths.
    axes : Array, shape (..., k, 3, 3)
        Rows: two unit vectors normal to the direction, and the direction (:func:`triad`).
    illuminator : Array, shape (..., 3)
        Position of the illuminator relative to the receiver.
    time : Array, shape (..., k)
        Times of the epochs.
    sigma : Array, shape (..., k, 3)
        Standard deviations along the two normals (radians) and of the excess path; infinite for an absent row.
    order : int
        0: static, 1: constant velocity, 2: constant acceleration.

    Returns
    -------
    BistaticCourse
        A start for the maximum-likelihood fit; without noise, the truth.

    Notes
    -----
    The weights need ranges: half the path in a first pass, the ranges of the resulting course in a second.
    """
    lead = np.broadcast_shapes(
        excess.shape, axes.shape[:-2], (*illuminator.shape[:-1], 1), time.shape, sigma.shape[:-1]
    )
    lead, k = lead[:-1], lead[-1]
    path, when = flatten(excess, (k,), lead), flatten(time, (k,), lead)
    e, A, deviation = flatten(axes, (k, 3, 3), lead), flatten(illuminator, (3,), lead), flatten(sigma, (k, 3), lead)
    with np.errstate(all="ignore"):
        d = np.sqrt(dot(A, A))[:, None]
        L = path + d
        usable = np.isfinite(L + when + e.sum(axis=(-2, -1))) & (L > 0.0)
        present = usable[..., None] & (deviation > 0.0) & np.isfinite(deviation)
        usable &= present.any(axis=-1)
        middle, spread = span(when, usable)
        powers = np.where(usable, (when - middle) / spread, 0.0)[..., None] ** np.arange(order + 1.0)
        normals = np.concatenate([e[:, :, :2], (e[:, :, 2] - A[:, None] / L[..., None])[:, :, None, :]], axis=2)
        normals = np.where(present[..., None], normals, 0.0)
        right = np.where(present, [0.0, 0.0, 1.0] * ((L * L - d * d) / (2.0 * L))[..., None], 0.0)
        # An angle error shortens u'p by half its square, which is not small compared with the error of a precise path.
        # The added term is the root of the second moment of half the sum of two squared normal errors. This moment is
        # (3 s1^4 + 3 s2^4 + 2 s1^2 s2^2) / 4 for deviations s1 and s2.
        square = np.where(present[..., :2], deviation[..., :2], 0.0) ** 2
        bend = 0.5 * np.sqrt(3.0 * (square**2).sum(axis=-1) + 2.0 * square.prod(axis=-1))
        far = across = 0.5 * L
        for _ in range(_PASSES):
            path_row = np.hypot(across / L * deviation[..., 2], far * bend)
            scale = np.stack([far * deviation[..., 0], far * deviation[..., 1], path_row], axis=-1)
            c, ok = _fit_course(normals, right, powers, np.where(present, 1.0 / scale, 0.0))
            p = np.einsum("nkj,nji->nki", powers, c)
            far, across = np.sqrt(dot(p, p)), np.sqrt(dot(p - A[:, None], p - A[:, None]))
        ok &= ((dot(p, e[:, :, 2]) > 0.0) | ~usable).all(axis=-1)
        c = np.where(ok[:, None, None], uncentre(c, middle, spread), np.nan)
    return BistaticCourse(c.reshape(*lead, order + 1, 3), ok.reshape(lead))


def _fit_course(normals: Array, right: Array, powers: Array, weight: Array) -> tuple[Array, Mask]:
    """Return the weighted least-squares course (N, order + 1, 3), and whether the system has full rank (N,).

    Each epoch has three rows: `normals` (N, k, 3, 3), right sides and weights (N, k, 3). `powers` (N, k, order + 1) are
    powers of the time; `weight` is one over the standard deviation.
    """
    count, order = len(right), powers.shape[-1]
    n = 3 * order
    B = powers[:, :, None, :, None] * (normals * weight[..., None])[:, :, :, None]
    rows = np.concatenate([B.reshape(count, -1, n), (right * weight).reshape(count, -1, 1)], axis=-1)
    good = np.isfinite(rows).all(axis=(-2, -1))
    rows = np.where(good[:, None, None], rows, 0.0)
    # zero rows are appended if there are fewer rows than unknowns, so that the triangle is square
    rows = np.pad(rows, ((0, 0), (0, max(0, n + 1 - rows.shape[1])), (0, 0)))
    triangle = np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64)[:, :n]
    U, size, V = np.linalg.svd(triangle[..., :n])
    good &= size[:, -1] > _RANK * size[:, 0]
    inverse = np.where(good[:, None], 1.0 / np.where(good[:, None], size, 1.0), 0.0)
    c = np.einsum("nji,nj->ni", V, inverse * np.einsum("nkj,nk->nj", U, triangle[..., n]))
    return c.reshape(count, order, 3), good
