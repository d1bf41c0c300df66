"""Coordinates in which the error of a fix is Gaussian: metres, or inverse range, or neither.

With the mean c of the stations as origin, a position is ``x = c + (r / w)(u0 + B p)``. Here r and u0 are the distance
and the direction of the fix. The columns of B are orthogonal to u0. p is a direction and w an inverse range; both have
no unit. The fix is p = 0, w = 1. Infinity is w = 0, a regular point. The error of a distant emitter is curved in metres
and Gaussian in ``y = (p, w)``.

Letters: d coordinates (2 or 3), q points, N fixes. Leading axes `...` count the fixes of a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from optloc.base import linalg
from optloc.base.errors import InvalidProblem, nearest
from optloc.base.records import Axes, take
from optloc.base.types import Array
from optloc.models.primitives import wrap
from optloc.problem.truncated import HELD, Truncated, is_along

CARTESIAN, INVERSE_RANGE, CURVED = range(3)
"""Kinds of a chart, by the valid Gaussian: in metres, in y = (p, w), or neither."""

NAMES = ("cartesian", "inverse range", "curved")
"""Names of the kinds, in the order of their numbers."""

TRUNCATED = "truncated"
"""Name of a Cartesian chart if bounds truncate the distribution."""

# Standard deviations from a fence beyond which it removes a probability below 1e-9.
_FAR_INSIDE = 6.0

Extent = Literal["range", "bearing", "elevation", "height", "x", "y", "z"]

# The advice names a function, because a module of a higher layer computes the region.
_ADVICE = "use `optloc.uncertainty.likelihood_region(problem, fix)` for the region of the target"


def distance_and_direction(position: Array, centre: Array) -> tuple[Array, Array]:
    """Return the distance r (...), metres, and the direction u0 (..., d) of positions (..., d) from centres (..., d).

    If the position is at the centre (r = 0), the direction is the first axis.
    """
    away = np.asarray(position - centre)
    r = np.sqrt((away**2).sum(-1))
    first = np.eye(away.shape[-1])[0]
    return r, np.where(r[..., None] > 0.0, away / np.where(r > 0.0, r, 1.0)[..., None], first)


def basis(direction: Array) -> Array:
    """Return d - 1 orthonormal vectors (..., d, d - 1), in columns, orthogonal to unit vectors (..., d), d = 2 or 3.

    They are the matrix B of this module.

    References
    ----------
    T. Duff et al., "Building an orthonormal basis, revisited", Journal of Computer Graphics Techniques 6 (2017).
    """
    u = np.asarray(direction)
    if u.shape[-1] == 2:
        return np.stack([-u[..., 1], u[..., 0]], axis=-1)[..., None]
    x, y, z = u[..., 0], u[..., 1], u[..., 2]
    # With the sign of z, the denominator is never near zero.
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    first = np.stack([1.0 + sign * a * x * x, sign * a * x * y, -sign * x], axis=-1)
    return np.stack([first, np.stack([a * x * y, sign + a * y * y, -y], axis=-1)], axis=-1)


def to_chart(points: Array, position: Array, centre: Array) -> Array:
    """Return chart coordinates (..., d) of points: p, then w.

    Parameters
    ----------
    points : array (..., d)
        Metres.
    position, centre : array (..., d)
        The fix, at p = 0 and w = 1, and the mean of the stations. Both broadcast against the points.

    Returns
    -------
    array (..., d)
        NaN if the fix is at the centre. w is negative for points behind the centre, and infinite for points whose
        direction from the centre is orthogonal to u0.
    """
    r, u0 = distance_and_direction(position, centre)
    away = points - centre
    along, across = np.where(r > 0.0, (away * u0).sum(-1), np.nan), (away[..., None] * basis(u0)).sum(-2)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.concatenate([across / along[..., None], (r / along)[..., None]], axis=-1)


def to_position(y: Array, position: Array, centre: Array) -> Array:
    """Return the positions (..., d), metres, of chart coordinates y (..., d); the inverse of `to_chart`.

    `position` and `centre` (..., d) are the fix and the mean of the stations, metres.
    """
    r, u0 = distance_and_direction(position, centre)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(centre + (r / y[..., -1])[..., None] * _ray(y, u0))


def jacobian(y: Array, position: Array, centre: Array) -> Array:
    """Return the Jacobian dx/dy (..., d, d) at chart coordinates y (..., d); at the fix it is [r B, -r u0].

    `position` and `centre` (..., d) are the fix and the mean of the stations, metres.
    """
    r, u0 = distance_and_direction(position, centre)
    shape = np.broadcast_shapes(y.shape, u0.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        size = (r / y[..., -1])[..., None, None]
        along = -size * (_ray(y, u0) / y[..., -1:])[..., None]
    across = np.broadcast_to(size * basis(u0), (*shape, shape[-1] - 1))
    return np.concatenate([across, np.broadcast_to(along, (*shape, 1))], axis=-1)


def log_volume(y: Array, position: Array, centre: Array) -> Array:
    """Return ``log |det dx/dy|`` (...) at chart coordinates y (..., d): ``d log r - (d + 1) log w``.

    It converts a density in chart coordinates to a density in metres. `position` and `centre` (..., d) are the fix and
    the mean of the stations, metres.
    """
    r, d = distance_and_direction(position, centre)[0], y.shape[-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(d * np.log(r) - (d + 1) * np.log(y[..., -1]))


def _ray(y: Array, u0: Array) -> Array:
    """Return the vectors u0 + B p (..., d) for chart coordinates y (..., d) and directions u0 (..., d).

    They point from the centre to the positions with coordinates y. Their length is at least 1.
    """
    return np.asarray(u0 + (basis(u0) * y[..., None, :-1]).sum(-1))


def quantile(probability: float, dimension: int) -> float:
    """Return the quantile of the chi-square distribution with `dimension` degrees of freedom.

    A squared error in standard deviations is below this number with the given probability.

    Parameters
    ----------
    probability : float
        Above 0 and below 1.
    dimension : int
        Degrees of freedom.
    """
    from scipy.special import gammaincinv

    if not 0.0 < probability < 1.0:
        raise InvalidProblem(f"a probability of {probability:g} is not between 0 and 1", "level", "such as 0.95")
    return float(2.0 * gammaincinv(dimension / 2, probability))


def tail_probability(cost: Array, dof: Array) -> Array:
    """Return the p-value (...), the chi-square probability of a cost at least this large; NaN without redundancy.

    `cost` (...) is chi-square at the fix. `dof` (...) is the number of degrees of freedom.
    """
    from scipy.special import gammaincc

    redundant = (dof > 0) & np.isfinite(cost)
    return np.where(redundant, gammaincc(np.where(redundant, dof, 1) / 2, np.where(redundant, cost, 0.0) / 2), np.nan)


@dataclass(frozen=True, slots=True)
class Skew:
    """Laws of positions that J uncertain fences make asymmetric: a Gaussian times the probability of each fence.

    Parameters
    ----------
    margin : array (..., J)
        Margins of the fixes, in standard deviations of the fences; infinite for unused entries.
    slope : array (..., J, d)
        Decrease of the margins with the position, per metre.
    shift : array (..., d)
        Mean of the Gaussian minus the fix, metres.
    covariance : array (..., d, d)
        Covariance of the Gaussian, square metres.
    """

    margin: Annotated[Array, Axes(1, slots=True, empty=np.inf)]
    slope: Annotated[Array, Axes(2, slots=True, empty=0.0)]
    shift: Annotated[Array, Axes(1, empty=0.0)]
    covariance: Annotated[Array, Axes(2)]

    @property
    def matters(self) -> Array:
        """Return a mask (...) of the fixes whose law a fence changes, if the law is known."""
        # margin at the mean of the Gaussian, and its standard deviation with the error of the fence
        mean = self.margin - (self.slope * self.shift[..., None, :]).sum(-1)
        variance = ((self.slope[..., :, None, :] * self.covariance[..., None, :, :]).sum(-1) * self.slope).sum(-1)
        near = mean < _FAR_INSIDE * np.sqrt(1.0 + variance)
        return np.asarray(near.any(-1) & np.isfinite(self.covariance).all((-1, -2)))

    def probability(self, points: Array) -> Array:
        """Return the probability (p,) that points (p, d), metres from one fix, are inside all fences."""
        from scipy.special import ndtr

        return np.asarray(ndtr(self.margin - (points[:, None] * self.slope).sum(-1)).prod(-1))


@dataclass(frozen=True, slots=True)
class Chart:
    """Coordinates in which the errors of fixes are Gaussian, with the parameters of the distribution.

    Parameters
    ----------
    kind : int8 array (...)
        `CARTESIAN`: Gaussian in metres, with `position` and `covariance`. `INVERSE_RANGE`: Gaussian in chart
        coordinates, with `mean` and `spread`. `CURVED`: in neither, or there is no covariance.
    position : array (..., d)
        The fixes, metres.
    covariance : array (..., d, d)
        Inverse of the information matrix of the fixes, square metres.
    centre : array (..., d)
        Mean of the stations, metres.
    truncated : Truncated, optional
        Normal distributions that bounds truncate. For Cartesian fixes they replace `covariance`.
    inflation : array (...), optional
        Factors by which trackers multiply the covariances when they start from the fixes: above 1 for fixes with the
        finding `tails`, otherwise 1.
    skew : Skew, optional
        Laws that uncertain fences make asymmetric; `covariance` is then the mean squared error about the fix.
    """

    kind: Annotated[Array, Axes(0, empty=CURVED)]
    position: Annotated[Array, Axes(1)]
    covariance: Annotated[Array, Axes(2)]
    centre: Annotated[Array, Axes(1)]
    truncated: Truncated | None = None
    inflation: Annotated[Array, Axes(0, empty=1.0)] | None = None
    skew: Skew | None = None

    @property
    def name(self) -> Any:
        """Return the name of the kind of a single fix, or an array (...) of names for a batch.

        If bounds truncate the distribution of a Cartesian fix, its name is "truncated".
        """
        names = np.array([*NAMES, TRUNCATED])
        return names[self.kind] if self.truncated is None else np.where(self.cut_off, TRUNCATED, names[self.kind])[()]

    @property
    def distance(self) -> Array:
        """Return the distances r (...) of the fixes from the centre, metres."""
        return distance_and_direction(self.position, self.centre)[0]

    @property
    def direction(self) -> Array:
        """Return the directions u0 (..., d) of the fixes from the centre."""
        return distance_and_direction(self.position, self.centre)[1]

    @property
    def basis(self) -> Array:
        """Return B (..., d, d - 1): unit vectors, in columns, that are orthogonal to the direction."""
        return basis(self.direction)

    @property
    def mean(self) -> Array:
        """Return the chart coordinates (..., d) of the fixes themselves: p = 0, w = 1."""
        y = np.zeros(self.position.shape)
        y[..., -1] = 1.0
        return y

    @property
    def gradient(self) -> Array:
        """Return G = dx/dy (..., d, d) at the fixes, metres per unit of the chart coordinates."""
        return jacobian(self.mean, self.position, self.centre)

    @property
    def spread(self) -> Array:
        """Return the covariance (..., d, d) of the chart coordinates at the fixes; infinite or NaN at the centre."""
        r, u0 = distance_and_direction(self.position, self.centre)
        # The columns of the gradient are orthogonal with length r, so its inverse is its transpose over r squared.
        axes = np.concatenate([basis(u0), -u0[..., None]], axis=-1)
        turned = (self.covariance[..., :, :, None] * axes[..., None, :, :]).sum(-2)
        form = (axes[..., :, :, None] * turned[..., :, None, :]).sum(-3)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(form / (r**2)[..., None, None])

    def to_chart(self, points: Array) -> Array:
        """Return chart coordinates of points (..., d), metres; see `optloc.problem.chart.to_chart`."""
        return to_chart(np.asarray(points), self.position, self.centre)

    def to_position(self, y: Array) -> Array:
        """Return positions, metres, of chart coordinates (..., d)."""
        return to_position(np.asarray(y), self.position, self.centre)

    def log_volume(self, y: Array) -> Array:
        """Return ``log |det dx/dy|`` (...) at chart coordinates (..., d)."""
        return log_volume(np.asarray(y), self.position, self.centre)

    def distance_squared(self, points: Array) -> Array:
        """Return squared distances of points from the fixes, in standard deviations, in the coordinates of the chart.

        Parameters
        ----------
        points : array (..., d)
            Metres; they broadcast against the fixes.

        Returns
        -------
        array (...)
            Chi-square distributed for the true position. Infinite for points behind the centre in the inverse-range
            chart, NaN for curved fixes. If bounds truncate the distribution, the result is the chi-square value of the
            highest-density region whose edge contains the point, and infinity outside the bounds.
        """
        away = np.asarray(points) - self.position
        dy = self.to_chart(points) - self.mean
        # dy' G'A G dy: the gradient at the fix converts a step in chart coordinates to metres.
        to_metres = (self.gradient * np.where(np.isfinite(dy), dy, 0.0)[..., None, :]).sum(-1)
        step = np.where((self.kind == INVERSE_RANGE)[..., None], to_metres, away)
        solved, known = linalg.solve(np.broadcast_to(self.covariance, (*step.shape, step.shape[-1])), step[..., None])
        form = (step * solved[..., 0]).sum(-1)
        if (on_surface := self._is_singular()).any():
            form, known = self._along_surface(step, form, known & ~on_surface)
        inverse = self.kind == INVERSE_RANGE
        behind = inverse & ~((dy[..., -1] > -1.0) & np.isfinite(dy).all(-1))
        # NaN for curved fixes, and for fixes without a valid covariance.
        form = np.array(np.where(known & (self.kind != CURVED), np.where(behind, np.inf, form), np.nan))
        away = np.broadcast_to(away, (*form.shape, away.shape[-1]))
        for i, distribution in self._truncated_fixes():
            selected = np.zeros(self.kind.shape, dtype=bool)
            selected[i] = True
            selected = np.broadcast_to(selected, form.shape)
            form[selected] = distribution.distance_squared(away[selected])
        return form

    def _is_singular(self) -> Array:
        """Return a mask (...) of singular covariances: an equality constraint fixes the position in one direction."""
        finite = np.asarray(np.isfinite(self.covariance).all((-1, -2)))
        values = np.linalg.eigvalsh(np.where(finite[..., None, None], self.covariance, np.eye(self.position.shape[-1])))
        return np.asarray(values[..., 0] <= HELD * values[..., -1])

    def _along_surface(self, step: Array, form: Array, known: Array) -> tuple[Array, Array]:
        """Return squared distances (...) of steps (..., d), also for singular covariances, and valid flags (...).

        A surface has fewer degrees of freedom than space. The returned distance has, with d degrees of freedom, the
        same probability as the distance on the surface. Steps that leave the surface get infinity.

        `step` are metres relative to the fixes. `form` (...) are the squared distances by the inverse covariance.
        `known` (...) selects the fixes for which `form` is valid.
        """
        from scipy.special import gammainc, gammaincinv

        finite, d = np.asarray(np.isfinite(self.covariance).all((-1, -2))), step.shape[-1]
        # `within` is chi-square distributed with `rank` degrees of freedom, and `level` is its probability.
        covariance = np.where(finite[..., None, None], self.covariance, 0.0)
        inverse = np.linalg.pinv(covariance, HELD, hermitian=True)
        projector = covariance @ inverse
        rank = np.round(np.trace(projector, axis1=-2, axis2=-1))
        within = (step * (inverse * step[..., None, :]).sum(-1)).sum(-1)
        level = np.where(rank > 0, gammainc(np.maximum(rank, 1.0) / 2.0, within / 2.0), 0.0)
        value = np.where(is_along(projector, step), 2.0 * gammaincinv(d / 2.0, level), np.inf)
        return np.where(known, form, value), known | np.broadcast_to(finite, known.shape)

    @property
    def cut_off(self) -> Array:
        """Return a mask (...) of the Cartesian fixes whose distribution is truncated at bounds."""
        if self.truncated is None:
            return np.zeros(self.kind.shape, dtype=bool)
        return np.asarray(self.truncated.cuts & (self.kind == CARTESIAN))

    def _truncated_fixes(self) -> Iterator[tuple[tuple[int, ...], Truncated]]:
        """Yield the index and the truncated distribution of each fix whose distribution bounds truncate."""
        if self.truncated is not None:
            for i in zip(*np.nonzero(np.atleast_1d(self.cut_off)), strict=True):
                index = tuple(map(int, i)) if self.kind.shape else ()
                yield index, take(self.truncated, index)

    def covers(self, points: Array, level: float = 0.95) -> Array:
        """Return whether points (..., d), metres, are in the regions that contain the target with a given probability.

        Parameters
        ----------
        points : array (..., d)
            Metres; they broadcast against the fixes, (q, d) for one fix and (q, N, d) for N.
        level : float
            Probability that the region of a fix contains the target.

        Returns
        -------
        bool array (...)
            Whether a point is in the error ellipsoid: in metres, or in chart coordinates.
        """
        self._require_gaussian("region")
        with np.errstate(invalid="ignore"):
            return np.asarray(self.distance_squared(points) <= quantile(level, self.position.shape[-1]))

    def interval(self, extent: Extent, level: float = 0.95) -> tuple[Array, Array]:
        """Return the ends of an interval that contains one coordinate of the true position with a given probability.

        Parameters
        ----------
        extent : str
            "range": distance from the centre along the direction of the fix, metres; the far end is infinite if the
            data do not exclude infinity. "bearing": angle at the centre, radians from the first axis towards the
            second; the ends are not wrapped, and they are a full turn apart if every bearing is possible. "elevation":
            radians above the plane of the first two axes. "height": the third coordinate, metres. "x", "y", "z": a
            coordinate, metres.
        level : float
            Probability that the interval contains the true value.

        Returns
        -------
        low, high : array (...)
            The ends.

        Notes
        -----
        For a Cartesian fix the range interval is a first-order approximation. It is rough near the centre.
        """
        if extent not in _EXTENTS:
            raise InvalidProblem(f"there is no interval of {extent!r}", "extent", nearest(str(extent), _EXTENTS))
        self._require_gaussian(f"interval of the {extent}")
        if extent in {"elevation", "height", "z"} and self.position.shape[-1] != 3:
            raise InvalidProblem(f"a fix in the plane has no {extent}", "extent", "use x, y, range or bearing")
        # The second argument is the half-width z of the interval, in standard deviations.
        low, high = map(np.array, _EXTENTS[extent](self, float(np.sqrt(quantile(level, 1)))))
        for i, distribution in self._truncated_fixes():
            low[i], high[i] = distribution.interval(self._coordinate_function(extent, i), level)
        return low, high

    def mean_of(self, x: Array, covariance: Array, start: int) -> Array:
        """Return the means (..., n) of the distributions of fixes x (..., n) with covariances (..., n, n).

        Truncation at bounds shifts the mean. The position is entries `start` to `start + d`. The mean of the other
        unknowns follows from their correlation with the position.

        `x` are the estimates with the highest likelihood.
        """
        out, position = np.array(x), slice(start, start + self.position.shape[-1])
        for i, law in self._truncated_fixes():
            cov = covariance[i]
            out[i] += cov[:, position] @ np.linalg.pinv(cov[position, position], hermitian=True) @ law.moments()[0]
        return out

    def _coordinate_function(self, extent: Extent, i: tuple[int, ...]) -> Callable[[Array], Array]:
        """Return the function of points (..., d) that returns one coordinate (...) of each point, metres or radians.

        The points are metres relative to fix i. `extent` is the name of the coordinate, as for `interval`. A truncated
        distribution needs this function for its interval.
        """
        start, centre = self.position[i], self.centre[i]
        if extent in _COORDINATES:
            j = _COORDINATES[extent]
            return lambda away: np.asarray(start[j] + away[..., j])
        if extent == "range":
            return lambda away: distance_and_direction(start + away, centre)[0]
        if extent == "elevation":
            return lambda away: np.asarray(np.arcsin(distance_and_direction(start + away, centre)[1][..., 2]))
        middle = np.arctan2(self.direction[i][1], self.direction[i][0])

        # Bearings are within half a turn of the bearing of the fix, so that an interval has no jump at 180 degrees.

        def bearing(away: Array) -> Array:
            there = start + away - centre
            return np.asarray(middle + wrap(np.arctan2(there[..., 1], there[..., 0]) - middle))

        return bearing

    def _require_gaussian(self, result: str) -> None:
        """Raise if a fix is curved, because no Gaussian is valid for it; `result` names the requested result."""
        curved = int((self.kind == CURVED).sum())
        if curved:
            subject = "this fix is" if self.kind.ndim == 0 else f"{curved} of {self.kind.size} fixes are"
            raise InvalidProblem(f"{subject} not Gaussian in any coordinates, so there is no {result}", "fix", _ADVICE)


def _range(chart: Chart, z: float) -> tuple[Array, Array]:
    """Return the ends (...) of the range interval, metres.

    They are r / (1 +- z sigma_w) in inverse range and r -+ z sigma_r in metres. z is the half-width of the interval in
    standard deviations.
    """
    r, step = chart.distance, z * np.sqrt(chart.spread[..., -1, -1])
    with np.errstate(divide="ignore", invalid="ignore"):
        far = np.where(step < 1.0, r / (1.0 - step), np.inf)
        near, width = r / (1.0 + step), z * np.sqrt(_bilinear(chart.covariance, chart.direction, chart.direction))
    inverse = chart.kind == INVERSE_RANGE
    return np.where(inverse, near, np.maximum(r - width, 0.0)), np.where(inverse, far, r + width)


def _bearing(chart: Chart, z: float) -> tuple[Array, Array]:
    """Return the ends (...) of the bearing interval, radians; z is the half-width in standard deviations."""
    east, _, ahead = _local_axes(chart)
    middle = np.arctan2(chart.direction[..., 1], chart.direction[..., 0])
    low, high = _angle_interval(chart, z, east, ahead)
    return middle + low, middle + high


def _elevation(chart: Chart, z: float) -> tuple[Array, Array]:
    """Return the ends (...) of the elevation interval, radians; z is the half-width in standard deviations."""
    _, up, _ = _local_axes(chart)
    low, high = _angle_interval(chart, z, up, chart.direction)
    middle = np.arctan2(chart.direction[..., 2], up[..., 2])
    return np.maximum(middle + low, -0.5 * np.pi), np.minimum(middle + high, 0.5 * np.pi)


def _coordinate(j: int) -> Callable[[Chart, float], tuple[Array, Array]]:
    """Return the function of a chart and z that returns the ends (...) of the interval of coordinate j, metres."""

    def ends(chart: Chart, z: float) -> tuple[Array, Array]:
        """Return the ends (...) of the interval, metres; raise if a fix is not Gaussian in metres."""
        if (chart.kind != CARTESIAN).any():
            what = "a coordinate of a fix that is not Gaussian in metres has no interval"
            raise InvalidProblem(what, "extent", _ADVICE)
        width = z * np.sqrt(chart.covariance[..., j, j])
        return chart.position[..., j] - width, chart.position[..., j] + width

    return ends


_COORDINATES: dict[Extent, int] = {"x": 0, "y": 1, "z": 2, "height": 2}
AXES: tuple[Extent, ...] = ("x", "y", "z")
"""Extents that are coordinates."""
_EXTENTS: dict[Extent, Callable[[Chart, float], tuple[Array, Array]]] = {
    "range": _range,
    "bearing": _bearing,
    "elevation": _elevation,
    **{name: _coordinate(j) for name, j in _COORDINATES.items()},
}


def _local_axes(chart: Chart) -> tuple[Array, Array, Array]:
    """Return three unit vectors (..., d) for the direction u0.

    The first is horizontal and orthogonal to u0. The second points upward and is orthogonal to u0. The third is the
    horizontal component of u0, with length 1. In the plane the second is zero.
    """
    u0 = chart.direction
    size = np.hypot(u0[..., 0], u0[..., 1])
    # For a vertical direction the bearing is arbitrary.
    c = np.where(size > 0.0, u0[..., 0] / np.where(size > 0.0, size, 1.0), 1.0)
    s = np.where(size > 0.0, u0[..., 1] / np.where(size > 0.0, size, 1.0), 0.0)
    if u0.shape[-1] == 2:
        return np.stack([-s, c], axis=-1), np.zeros_like(u0), np.stack([c, s], axis=-1)
    o = np.zeros_like(s)
    up = np.stack([-u0[..., 2] * c, -u0[..., 2] * s, size], axis=-1)
    return np.stack([-s, c, o], axis=-1), up, np.stack([c, s, o], axis=-1)


def _angle_interval(chart: Chart, z: float, side: Array, ahead: Array) -> tuple[Array, Array]:
    """Return the least and the greatest angle (...), radians, from `ahead` towards `side`, both unit vectors (..., d).

    z is the half-width of the interval in standard deviations. The tangent of the angle is a quotient of two Gaussian
    numbers. The numerator has mean zero, the denominator mean m. By Fieller, its interval is all t with ``(t m)^2 <=
    z^2 var(numerator - t denominator)``. If every angle is possible, the ends are -pi and pi.

    References
    ----------
    E. C. Fieller, "Some problems in interval estimation", Journal of the Royal Statistical Society B 16 (1954).
    """
    u0, r = chart.direction, chart.distance
    middle = r * (ahead * u0).sum(-1)
    # In chart coordinates only the component orthogonal to the direction is random; in metres both are.
    inverse = (chart.kind == INVERSE_RANGE)[..., None]
    denominator = np.where(inverse, ahead - (ahead * u0).sum(-1, keepdims=True) * u0, ahead)
    variance = z**2 * _bilinear(chart.covariance, side, side)
    covariance = z**2 * _bilinear(chart.covariance, side, denominator)
    # Coefficient of t^2 in Fieller's inequality. If it is not positive, the solutions are not one finite interval.
    lead = middle**2 - z**2 * _bilinear(chart.covariance, denominator, denominator)
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(np.maximum(covariance**2 + lead * variance, 0.0))
        low, high = np.arctan((-covariance - root) / lead), np.arctan((-covariance + root) / lead)
    # If the region contains the centre, or a point straight above it, the angle is undefined there and any value is
    # possible.
    known = lead > 0.0
    return np.where(known, low, -np.pi), np.where(known, high, np.pi)


def _bilinear(matrix: Array, u: Array, v: Array) -> Array:
    """Return the bilinear form u'M v (...) of vectors (..., d) and a matrix (..., d, d)."""
    return np.asarray((u[..., :, None] * matrix * v[..., None, :]).sum((-1, -2)))
