r"""A box that contains every point with small range residuals, so that a bound over the box is valid for all space.

Ranges :math:`r_i = |x - s_i|` are measured up to one unknown, :math:`r_i = \sigma_i r_1 + d_i + w_i`, with errors `w`
of covariance `R`. Squared, and with :math:`a_i = s_i - s_1`, :math:`x' = x - s_1`, :math:`r_1^2 = |x'|^2`,

.. math:: 2 a_i^\top x' + 2 \sigma_i d_i r_1 = |a_i|^2 - d_i^2 - \varphi_i, \qquad
   \varphi_i = w_i (2 \sigma_i r_1 + 2 d_i + w_i)

holds exactly. Where the cost is at most :math:`\rho^2`, :math:`|m^\top w| \le \rho \sqrt{m^\top R\, m}` for every
vector `m`; a left inverse of the system therefore bounds :math:`r_1` (which enters its own bound through
:math:`\varphi`), and then the position. Measured ranges bound :math:`r_1` directly.

Source: the linear system is that of H. C. Schau and A. Z. Robinson, "Passive source localization employing
intersecting spherical surfaces from time-of-arrival differences", IEEE Trans. Acoust. Speech Signal Process. 35
(1987); its interval form follows from the Cauchy-Schwarz inequality.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from formulations.algebra import Array

_FLAT = 1e-12  # relative singular value below which a system of squared ranges is singular: above rounding
# Relative enlargement of boxes. It is far above rounding errors of numbers of order one, which an ill-conditioned left
# inverse magnifies, and too small to weaken a bound.
_ROUND = 1.0 + 1e-6
_NEAR = 1e-6  # shortest distance in a weight: the point may be a station, and every weight gives a valid box
_LONG = 1e-9  # share of the largest information below which an axis is not lengthened further: undetermined directions


@dataclass(frozen=True, slots=True)
class Ranged:
    """Measured ranges of one point, up to a common unknown or without one.

    Parameters
    ----------
    station : Array, shape (M, d)
        Positions, the reference first.
    sign : Array, shape (M,)
        If `free`: 1 or -1 in ``r_i = sign_i r_1 + offset_i + error_i``, with 1 for the reference. Not used otherwise.
    offset : Array, shape (M,)
        If `free`: as above, with zero for the reference. Otherwise the measured ranges ``r_i - error_i``.
    covariance : Array, shape (M, M)
        Covariance of the errors; if `free`, the row and the column of the reference are not used.
    free : bool
        Whether the range of the reference is unknown.
    """

    station: Array
    sign: Array
    offset: Array
    covariance: Array
    free: bool

    @property
    def side(self) -> Array:
        """Return the signs of all stations except the reference, shape (M - 1,)."""
        return self.sign[1:] if self.free else np.ones(len(self.station) - 1)

    @property
    def excess(self) -> Array:
        """Return the vector d, shape (M - 1,): known differences of the ranges from the range of the reference."""
        return self.offset[1:] if self.free else self.offset[1:] - self.offset[0]

    @property
    def spread(self) -> Array:
        """Return the covariance R of the errors w, shape (M - 1, M - 1)."""
        inner = self.covariance[1:, 1:]
        if self.free:
            return inner
        cross = self.covariance[0, 1:]
        return np.asarray(inner - cross[:, None] - cross + self.covariance[0, 0])

    def cost(self, point: Array) -> Array:
        """Return the weighted squared misfit of these ranges.

        Parameters
        ----------
        point : Array, shape (..., d)
            Points.

        Returns
        -------
        Array, shape (...)
            The maximum-likelihood cost of these ranges.
        """
        ranges = np.linalg.norm(point[..., None, :] - self.station, axis=-1)
        if self.free:
            error, matrix = ranges[..., 1:] - self.side * ranges[..., :1] - self.excess, self.spread
        else:
            error, matrix = ranges - self.offset, self.covariance
        return np.asarray((error * np.linalg.solve(matrix, error[..., None])[..., 0]).sum(-1))


@dataclass(frozen=True, slots=True)
class EnclosingBox:
    """A parallelepiped of positions and an interval of the reference range.

    Parameters
    ----------
    centre : Array, shape (d,)
        Centre of the positions.
    axes : Array, shape (d, d)
        Half-edges as columns: ``x = centre + axes s`` with ``|s_k| <= 1``.
    low, high : float
        Least and greatest range of the reference.
    """

    centre: Array
    axes: Array
    low: float
    high: float


def enclosure(ranged: Ranged, point: Array, cost: float) -> EnclosingBox | None:
    """Return a box that contains every position with at most a given cost.

    Parameters
    ----------
    ranged : Ranged
        The measurements, numbers of order one.
    point : Array, shape (d,)
        A position near the minimum, for the weights and the axes; any point gives a valid box.
    cost : float
        Greatest relevant cost.

    Returns
    -------
    EnclosingBox or None
        None if the rows do not enclose a region: there are too few rows, or their errors are too large for the
        geometry.

    Notes
    -----
    The module's text.
    """
    a, side, d, rho = ranged.station[1:] - ranged.station[0], ranged.side, ranged.excess, float(np.sqrt(cost))
    right = (a * a).sum(1) - d * d
    system = 2.0 * (np.column_stack([a, side * d]) if ranged.free else a)
    away = np.maximum(np.linalg.norm(point - ranged.station[1:], axis=1), _NEAR)
    root: Array = np.asarray(np.linalg.cholesky(ranged.spread), dtype=np.float64)
    left = _left_inverse(system, away, root)
    error = _ErrorBounds(rho, root, side, d, np.array(np.diag(ranged.spread)))
    if not ranged.free:
        # the reference is measured: it is an unknown in an interval, not a column of the system
        slack = rho * float(np.sqrt(ranged.covariance[0, 0]))
        reach = max(0.0, ranged.offset[0] - slack), ranged.offset[0] + slack
        if left is None:
            return EnclosingBox(ranged.station[0], reach[1] * np.eye(a.shape[1]), *reach)
        return _box(ranged, point, left, right - side * d * sum(reach), error, reach)
    found = None if left is None else error.reference(left[-1], float(left[-1] @ right))
    return None if left is None or found is None else _box(ranged, point, left[:-1], right, error, found)


def ball(ranged: Ranged, centre: Array, radius: float) -> EnclosingBox:
    """Return a box that contains a ball of positions.

    Parameters
    ----------
    ranged : Ranged
        The measurements.
    centre : Array, shape (d,)
        Centre of the ball.
    radius : float
        Radius of the ball.

    Returns
    -------
    EnclosingBox
        A cube, and the interval of reference ranges of points in the ball.
    """
    away = float(np.linalg.norm(centre - ranged.station[0]))
    return EnclosingBox(centre, radius * np.eye(len(centre)), max(0.0, away - radius), away + radius)


def _left_inverse(system: Array, away: Array, root: Array) -> Array | None:
    """Return the left inverse of `system`, weighted for squared ranges, or None if the columns are not independent.

    `away` (M - 1,) are distances from the stations, `root` is the Cholesky factor of the covariance of the errors w.
    """
    rows, columns = system.shape
    if rows < columns:
        return None
    weight = np.linalg.inv(root) / (2.0 * away)
    heavy = weight @ system
    size = np.linalg.norm(heavy, axis=0)
    values = np.linalg.svd(heavy / np.where(size > 0.0, size, 1.0), compute_uv=False)
    if not values[-1] > _FLAT * values[0]:
        return None
    # no other cut of singular values
    return np.asarray(np.linalg.pinv(heavy, rcond=1e-15) @ weight)


@dataclass(frozen=True, slots=True)
class _ErrorBounds:
    """Bounds of the effect of range errors w on linear functions of the squared equations, for a cost of at most rho^2.

    `root` is the Cholesky factor of the covariance R of w, `variance` its diagonal. `side` are the signs, `excess` is
    the vector d of the ranges.
    """

    rho: float
    root: Array
    side: Array
    excess: Array
    variance: Array

    def reference(self, row: Array, middle: float) -> tuple[float, float] | None:
        """Return the interval of r_1 from its row of the left inverse, or None if the errors are too large."""
        # r_1 <= middle + rest + slope r_1: if the slope reaches one, the errors grow with the range without bound
        slope = self._linear_bound(row * self.side)
        rest = self._linear_bound(row * self.excess) + self._square_bound(row)
        if slope >= 1.0 or middle + rest < 0.0:
            return None
        return max(0.0, (middle - rest) / (1.0 + slope)), (middle + rest) / (1.0 - slope)

    def position(self, row: Array, low: float, high: float) -> float:
        """Return a bound of the effect of the errors on a coordinate, for reference ranges from `low` to `high`.

        `row` (M - 1,) is the row of the left inverse for this coordinate.
        """
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        both = self._linear_bound(row * (self.excess + self.side * middle)) + half * self._linear_bound(row * self.side)
        return both + self._square_bound(row)

    def _linear_bound(self, row: Array) -> float:
        """Return a bound of twice ``row' w`` for errors w with a cost of at most rho^2."""
        return 2.0 * self.rho * float(np.linalg.norm(self.root.T @ row))

    def _square_bound(self, row: Array) -> float:
        """Return a bound of ``row' w^2`` for errors w with a cost of at most rho^2."""
        return self.rho**2 * float(np.abs(row) @ self.variance)


def _box(
    ranged: Ranged, point: Array, left: Array, right: Array, error: _ErrorBounds, reach: tuple[float, float]
) -> EnclosingBox:
    """Return the box of ``x' = left (right - phi)`` in principal axes; `reach` is the interval of the reference range.

    A measured reference range is an extra unknown.
    """
    low, high = reach
    axes = _principal_axes(ranged, point)
    rows = np.linalg.inv(axes) @ left
    half = np.array([error.position(row, low, high) for row in rows])
    if not ranged.free:
        half += np.abs(rows @ (error.side * error.excess)) * (high - low)
    return EnclosingBox(ranged.station[0] + left @ right, axes * (half * _ROUND), low / _ROUND, high * _ROUND)


def _principal_axes(ranged: Ranged, point: Array) -> Array:
    """Return the principal axes (d, d) of the errors of a fix at `point`, in columns of one standard deviation."""
    apart = point - ranged.station
    # at a station the direction is undefined: the row is left out, which avoids a division by zero
    unit = apart / np.maximum(np.linalg.norm(apart, axis=1, keepdims=True), 1e-9)
    if ranged.free:
        slope, matrix = unit[1:] - ranged.side[:, None] * unit[0], ranged.spread
    else:
        slope, matrix = unit, ranged.covariance
    values, vectors = np.linalg.eigh(slope.T @ np.linalg.solve(matrix, slope))
    return np.asarray(vectors / np.sqrt(np.maximum(values, _LONG * values[-1])))
