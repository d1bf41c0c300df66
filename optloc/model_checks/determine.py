"""Quantities that the data of one fix determine, with any status: directions, ranges, coordinates and curves.

A fix that is not `ok` may still determine a direction, a distance from a line or plane, or a curve.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.base import linalg
from optloc.base.errors import InvalidProblem
from optloc.base.frames import CARTESIAN
from optloc.base.types import Array, Status
from optloc.linear.mirror import plane_of_stations
from optloc.model_checks.coplanar import Across, information_in_square, interval_across, is_coplanar
from optloc.model_checks.directions import INFINITY, DirectionCost, directions_of, extent_of, has_directions, minima_of
from optloc.models import MODELS
from optloc.problem.chart import AXES, Extent, quantile
from optloc.problem.determined import LEVEL, Determined, Quantity
from optloc.problem.fix import Fix
from optloc.problem.noise import variances
from optloc.problem.problem import Problem

# Half width of a 95 % interval in standard deviations.
_WIDE = float(np.sqrt(quantile(LEVEL, 1)))
# Smallest redundancy for a direction: one unknown, the range, may be undetermined.
_MIN_DOF = -1
# Length of an infinite curve in baselines, and the number of its points, which is odd.
_REACH, _POINTS = 10.0, 201
# Cosine between an axis and the normal of a plane below which the axis is in the plane: rounding.
_IN_PLANE = 1e-9
# Distance in spreads of the stations beyond which an end is infinite: a tenth of the distance that represents infinity.
_ENDLESS = 0.1 / INFINITY


def determined(problem: Problem, fix: Fix) -> Determined:
    """Return directions, ranges and curves that the data of one fix determine, with any status.

    Parameters
    ----------
    problem : Problem
        A single problem.
    fix : Fix
        Its fix. Only the weights of its rows and its reason are used: the function searches all minima.

    Returns
    -------
    Determined
        For one static position without constraints: directions with cones and ranges; coordinates relative to a line or
        plane of all stations; or the curve of a single measurement. For other problems, the reason of the fix.

    Raises
    ------
    InvalidProblem
        If there are several fixes.

    Notes
    -----
    A cone holds the directions u with ``min over w >= 0 of f(u, w) <= f_min + q``. Here w is the inverse of the
    distance from the centre of the stations. f_min is the lowest cost, infinity included. q is the quantile of
    chi-square with d - 1 degrees of freedom. Azimuth, elevation, range and all other intervals follow from profiles of
    the cost with one degree of freedom. With small arrays and far targets, 94.6 % of 2 200 simulated directions are in
    the cones.

    References
    ----------
    S. S. Wilks, "The large-sample distribution of the likelihood ratio for testing composite hypotheses", Annals of
    Mathematical Statistics 9 (1938).
    """
    if fix.shape != () or int(np.prod(problem.batch_shape)) != 1:
        advice = "take one fix of a batch: `problem.flat().take([i])` and `fix.flat()[i]`"
        raise InvalidProblem("several fixes were given, not one", "fix", advice)
    # in a batch, the weights of a fix with fewer rows are padded
    flat = problem.flat().with_rows(weight=fix.weights[None, : problem.count])
    words = str(fix.reason[()] or "")
    if not has_directions(flat) or not _is_complete(flat):
        centre = problem.stations.places.reshape(-1, problem.dimension).mean(0)
        return Determined(centre, _level(problem, centre), problem.frame.geodetic, words=words)
    with np.errstate(all="ignore"):
        return replace(_determined_of_problem(flat, int(fix.dof)), words=words)


def _level(problem: Problem, centre: Array) -> Array:
    """Return the unit vectors east, north and up (d, d) as rows at `centre`, or the axes of a Cartesian frame."""
    return problem.frame.enu_axes(centre) if problem.frame.geodetic else np.eye(problem.dimension)


def _is_complete(problem: Problem) -> bool:
    """Return whether the problem has present rows and all their values are finite."""
    present = problem.weight > 0.0
    return bool(present.any() and np.isfinite(np.where(present, problem.z, 0.0)).all())


def _determined_of_problem(flat: Problem, dof: int) -> Determined:
    """Return the determined quantities of a flat batch of one problem with `dof` degrees of freedom.

    The function tries these cases in order: all stations on a line in space; a single measurement in the plane; all
    others. In the last case, it searches for directions if at most one unknown, the range, is undetermined. If the
    range of each direction has an upper limit, coordinates in the plane of the stations are added.
    """
    surface, north = DirectionCost.of(flat), flat.frame.geodetic
    level = _level(flat, surface.centre)
    axes, line = plane_of_stations(flat)[1][0], _about_line(flat)
    if line is not None:
        return Determined(surface.centre, level, north, (), _along_line(line), axis=axes[:, -1])
    # `outside` states that the result assumes a target outside the sphere of the stations
    outside, (name, curve, numbers) = False, _curve(flat)
    if curve is not None:
        return Determined(surface.centre, level, north, (), numbers, curve, name)
    found = directions_of(surface, level, few=dof < 0) if dof >= _MIN_DOF else ()
    if dof >= 0 and not found:
        # between the stations any direction is possible: consider only targets outside their sphere
        found = directions_of(replace(surface, most=1.0), level)
        outside = bool(found)
    # `mixed` means that the range has an upper limit; without a limit, the distance from a plane has none either
    closed = not outside and all(one.mixed for one in found)
    across = _in_plane(flat, surface) if closed and is_coplanar(flat)[0] else ()
    axis = axes[:, 0] if across else None
    return Determined(surface.centre, level, north, found, across, axis=axis, outside=outside)


# Stations on a line in space: the data do not determine the angle of the target about the line.


def _about_line(flat: Problem) -> Problem | None:
    """Return the problem in a plane through the line of all stations, or None if the stations are on no line in space.

    In the plane, the stations are on the x axis and do not move. The result is also None if all stations are at one
    point.
    """
    if flat.dimension != 3 or not is_coplanar(flat)[0]:
        return None
    centre, axes, _, size = plane_of_stations(flat)
    if size[0] == 0.0:
        return None
    # columns of the axes: number 2 is along the line, number 1 perpendicular to it
    in_plane = (flat.stations.position - centre[0]) @ axes[0][:, [2, 1]]
    no_velocity = None if flat.stations.velocity is None else np.zeros((1, flat.stations.count, 2))
    stations = replace(flat.stations, position=in_plane, velocity=no_velocity, axes=None)
    reduced = replace(flat, stations=stations, frame=CARTESIAN)
    return reduced if is_coplanar(reduced)[0] else None


def _along_line(problem: Problem) -> tuple[Quantity, ...]:
    """Return three quantities with 95 % intervals, for stations on the x axis of a problem in the plane.

    They are the angle to the line (rad), the coordinate along the line (m) and the distance from it (m). The intervals
    cover the regions of all minima whose cost is close enough to the lowest cost. If no minimum has a finite cost, the
    result is empty. If the best minimum is at infinity, each coordinate is infinite, or zero if it is below a limit.
    """
    surface, rise = DirectionCost.of(problem), quantile(LEVEL, 1)
    minima = minima_of(surface, rise)
    if not np.isfinite(minima.cost[0]):
        return ()
    best = surface.positions(minima.u[:1], minima.v[:1])[0]
    best = np.where(
        minima.v[0] <= INFINITY, np.where(np.abs(best) < _ENDLESS * surface.spread, 0.0, np.inf * best), best
    )
    found = [
        extent_of(surface, minima.u[i], float(minima.v[i]), float(minima.cost[0]), rise) for i in range(len(minima.v))
    ]
    points = np.concatenate(found)
    # a region on both sides of the line contains points of the line: distance 0, and angle 0 or pi
    crosses = any((edge[:, 1] > 0.0).any() and (edge[:, 1] < 0.0).any() for edge in found)
    angle = np.abs(np.arctan2(points[:, 1], points[:, 0]))
    turn = abs(float(np.arctan2(minima.u[0, 1], minima.u[0, 0])))
    low, high = float(angle.min()), float(angle.max())
    ahead = crosses and bool((points[:, 0] > 0.0).any()), crosses and bool((points[:, 0] < 0.0).any())
    limit = _ENDLESS * surface.spread
    along, away = _endless(points[:, 0], limit), _endless(np.abs(points[:, 1]), limit)
    return (
        Quantity(
            "angle to line",
            turn,
            0.0 if ahead[0] else low,
            np.pi if ahead[1] else high,
            "rad",
        ),
        Quantity("place along line", float(best[0]), along[0], along[1], "m"),
        Quantity("distance from line", abs(float(best[1])), 0.0 if crosses else away[0], away[1], "m"),
    )


def _endless(values: Array, limit: float) -> tuple[float, float]:
    """Return the smallest and the largest value, m; an end becomes infinite if its size is at least `limit`, m."""
    ends = np.array([values.min(), values.max()])
    low, high = np.where(np.abs(ends) < limit, ends, np.copysign(np.inf, ends)).tolist()
    return low, high


# Stations in a plane: the data do not determine the side of the plane.


def _in_plane(flat: Problem, surface: DirectionCost) -> tuple[Quantity, ...]:
    """Return the coordinates in the plane of all stations and the distance from the plane, with 95 % intervals in m.

    The result is empty if a coordinate is unbounded, if the best minimum is at infinity, or with fewer rows than
    coordinates.
    """
    if (flat.weight > 0.0).sum() < flat.dimension:
        return ()
    minima = minima_of(surface, rise=0.0)  # only the lowest minimum
    if not np.isfinite(minima.cost[0]) or minima.v[0] <= INFINITY:
        return ()
    across = Across.of(flat)
    x, cost, _ = across.refine(across.to_plane(surface.vectors(minima.u[:1], minima.v[:1])), held=False)
    low, high = interval_across(across, x, cost, LEVEL)
    spread, ok = linalg.inverse(information_in_square(across, x)[0])
    if not ok[0] or not np.isfinite(high[0]):
        return ()
    part, d = across.part, flat.dimension
    # the last coordinate is the distance from the plane; its interval comes from the cost, not from the covariance
    place, inner = x[0, part], spread[0, part, part][:-1, :-1]
    name = "distance from plane" if d == 3 else "distance from line"
    far = Quantity(name, float(place[-1]) if place[-1] > across.least[0] else 0.0, float(low[0]), float(high[0]), "m")
    return (*_coordinates(across, place[:-1], inner), far)


def _coordinates(across: Across, place: Array, covariance: Array) -> tuple[Quantity, ...]:
    """Return the coordinates of a position in the plane of the stations, with 95 % intervals in m.

    `place` (d - 1,) and `covariance` (d - 1, d - 1) are along the axes of the plane. The results are along the axes of
    the frame if enough of these are in the plane, else along the principal axes of the stations.
    """
    centre, axes = across.centre[0], across.axes[0]
    # axes of the frame that are perpendicular to the normal of the plane
    level = np.flatnonzero(np.abs(axes[:, -1]) <= _IN_PLANE)
    if len(level) == len(place):
        names, turn, start = ["xyz"[i] for i in level], axes[level, :-1], centre[level]
    else:
        names = [f"along ({', '.join(f'{a:.2f}' for a in axis)})" for axis in axes.T[:-1]]
        turn, start = np.eye(len(place)), np.zeros(len(place))
    values = start + turn @ place
    half_width = _WIDE * np.sqrt(np.maximum(np.diagonal(turn @ covariance @ turn.T), 0.0))
    ends = zip(names, values.tolist(), (values - half_width).tolist(), (values + half_width).tolist(), strict=True)
    return tuple(Quantity(name, value, low, high, "m") for name, value, low, high in ends)


# One measurement in the plane determines a curve.

_NAMES = {"tdoa": "hyperbola", "range": "circle", "range_sum": "ellipse"}
_LENGTHS = {"tdoa": "difference", "range": "range", "range_sum": "sum"}


def _curve(flat: Problem) -> tuple[str, Array | None, tuple[Quantity, ...]]:
    """Return the name of the curve of a single row in the plane, its points (k, 2) in m, and the measured length.

    If the problem is not of this form, the results are an empty name, None and an empty tuple.
    """
    numbers = np.flatnonzero(flat.weight.reshape(-1) > 0.0)
    if flat.dimension != 2 or len(numbers) != 1 or flat.biases or flat.priors:
        return "", None, ()
    block = int(np.searchsorted(flat.starts, numbers[0], side="right")) - 1
    rows, i = flat.rows[block], int(numbers[0]) - flat.starts[block]
    if rows.kind not in _NAMES:
        return "", None, ()
    z = float(flat.observed.reshape(-1)[numbers[0]])
    sigma = float(np.sqrt(np.broadcast_to(variances(flat.noise, flat.count), (1, flat.count))[0, numbers[0]]))
    ends = flat.stations.position.reshape(-1, flat.stations.count, 2)[0]
    names = [flat.stations.names[int(k)] for k in (rows.a[i], rows.b[i])[: MODELS[rows.kind].stations]]
    length = Quantity(_LENGTHS[rows.kind], z, z - _WIDE * sigma, z + _WIDE * sigma, "m")
    a, b = ends[int(rows.a[i])], ends[int(rows.b[i])] if len(names) > 1 else ends[int(rows.a[i])]
    points = _hyperbola(a, b, z) if rows.kind == "tdoa" else _ellipse(a, b, z if len(names) > 1 else 2.0 * z)
    return f"{_NAMES[rows.kind]} about {' and '.join(names)}", points, (length,)


def _hyperbola(a: Array, b: Array, z: float) -> Array:
    """Return points (k, 2) of the hyperbola |x - a| - |x - b| = z, m; of a ray if |z| is at least the baseline.

    `a` and `b` (2,) are the positions of the stations, m.
    """
    base = float(np.hypot(*(a - b)))
    along = (b - a) / base
    if abs(z) >= base:
        return np.stack([b, b + _REACH * base * along] if z > 0.0 else [a, a - _REACH * base * along])
    # semi-axes: `vertex` along the baseline (with the sign of z), and `side` across
    vertex, side = 0.5 * z, np.sqrt(0.25 * base**2 - 0.25 * z**2)
    turn = np.linspace(-1.0, 1.0, _POINTS) * np.arcsinh(_REACH * base / side)
    # for z > 0 the branch is nearer to b
    ahead = vertex * np.cosh(turn)
    return np.asarray(0.5 * (a + b) + ahead[:, None] * along + (side * np.sinh(turn))[:, None] * _perpendicular(along))


def _ellipse(a: Array, b: Array, total: float) -> Array:
    """Return points (k, 2) with a given sum of distances from a and b, m; the segment a-b if the sum is too small.

    `total` is the sum, and `a` and `b` (2,) are the positions of the stations, m.
    """
    base = float(np.hypot(*(a - b)))
    along = (b - a) / base if base > 0.0 else np.array([1.0, 0.0])
    if total <= base:
        return np.stack([a, b])
    turn = np.linspace(0.0, 2.0 * np.pi, _POINTS)
    long, short = 0.5 * total, 0.5 * np.sqrt(total**2 - base**2)
    ring = (
        0.5 * (a + b) + (long * np.cos(turn))[:, None] * along + (short * np.sin(turn))[:, None] * _perpendicular(along)
    )
    ring[-1] = ring[0]
    return np.asarray(ring)


def _perpendicular(along: Array) -> Array:
    """Return the vector `along` (2,) after a rotation by a right angle, counter-clockwise."""
    return np.array([-along[1], along[0]])


# A single fix with the status `ok`.


def of_fix(fix: Fix) -> Determined | None:
    """Return the coordinates of a single fix with their 95 % intervals, m, if its status is `ok`, else None."""
    if Status(int(fix.code)) is not Status.OK or fix.chart is None:
        return None
    numbers = tuple(
        Quantity(name, value, *_interval(fix, name), "m")
        for name, value in zip(AXES, fix.position.tolist(), strict=False)
    )
    centre, north = np.asarray(fix.chart.centre), fix.frame.geodetic
    level = fix.frame.enu_axes(centre) if north else np.eye(len(centre))
    return Determined(centre, level, north, (), numbers)


def _interval(fix: Fix, axis: Extent) -> tuple[float, float]:
    """Return the 95 % interval of a coordinate ("x", "y" or "z") of a fix, m.

    If bounds truncate the distribution, it is the shortest interval, else plus and minus 1.96 sigma. `axis` is the name
    of the coordinate.
    """
    if fix.chart is not None and fix.chart.cut_off:
        low, high = fix.interval(axis)
        return float(low), float(high)
    value, half_width = (float(each[AXES.index(axis)]) for each in (fix.position, _WIDE * fix.sigma()))
    return value - half_width, value + half_width
