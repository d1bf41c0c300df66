"""Starts and bounds from angles alone: instrumental variables, unit directions, the smallest maximal angle.

Letters: N problems, m bearings or rows, k epochs, d coordinates, `order` the degree of a polynomial course. `seen` are
the bearings of all problems.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from formulations.bearing_course import BearingCourses, sight_courses
from formulations.bearing_ls import rays, sight
from formulations.bistatic import course, triad
from optloc.base.linalg import centre_and_spread
from optloc.base.threads import WORTH, map_on_threads
from optloc.base.types import Array, Rows
from optloc.linear.courses import elapsed
from optloc.problem.noise import variances
from optloc.problem.problem import Problem
from optloc.solvers.starts.position import known_height, spread_of


@dataclass(frozen=True, slots=True)
class Bearings:
    """The angles of a flat batch of N problems, one bearing for each station and epoch that has an azimuth.

    Parameters
    ----------
    station : array (N, m, d)
        Positions in units of `scale` from `centre`.
    angle : array (N, m, 2)
        Azimuth and elevation, radians; the elevation is zero if it is absent.
    weight : array (N, m, 2)
        One over the standard deviations, 1/radians; zero for absent angles.
    axes : array (N, m, d, d), optional
        Axes of the stations, as rows.
    centre : array (N, d)
        Middle of the stations, metres.
    scale : array (N,)
        Spread of the stations, metres.
    """

    station: Array
    angle: Array
    weight: Array
    axes: Array | None
    centre: Array
    scale: Array

    def metres(self, point: Array) -> Array:
        """Return scaled points (N, ..., d) in the frame of the problem, metres."""
        extra = (1,) * (point.ndim - 2)
        return point * self.scale.reshape(-1, *extra, 1) + self.centre.reshape(-1, *extra, point.shape[-1])


def bearings(problem: Problem) -> Bearings | None:
    """Return the angles of a flat batch with one static target, or None if no azimuth was measured."""
    rows = {block.kind: (block, start) for block, start in zip(problem.rows, problem.starts, strict=True)}
    # an elevation without its azimuth gives no linear equation for the position
    if "azimuth" not in rows:
        return None
    block, start = rows["azimuth"]
    size = problem.batch_shape[0]
    angle, weight = np.zeros((size, block.count, 2)), np.zeros((size, block.count, 2))
    angle[..., 0], weight[..., 0] = _values(problem, block, start)
    if "elevation" in rows:
        other, begin = rows["elevation"]
        value, importance = _values(problem, other, begin)
        keys = {key: i for i, key in enumerate(_station_epochs(other))}
        for i, key in enumerate(_station_epochs(block)):
            if key in keys:
                angle[:, i, 1], weight[:, i, 1] = value[:, keys[key]], importance[:, keys[key]]
    place = _for_rows(problem.stations.position, 3, block, size)
    axes = None if problem.stations.axes is None else _for_rows(problem.stations.axes, 4, block, size)
    centre, spread = centre_and_spread(place)
    scale = np.where(spread > 0.0, spread, 1.0)
    return Bearings((place - centre[:, None]) / scale[:, None, None], angle, weight, axes, centre, scale[:size])


def _station_epochs(rows: Rows) -> list[tuple[int, int]]:
    """Return pairs (station, epoch) of the rows, to find the elevation that belongs to an azimuth."""
    return list(zip(rows.a.tolist(), rows.epoch.tolist(), strict=True))


def _values(problem: Problem, rows: Rows, start: int) -> tuple[Array, Array]:
    """Return the angles (N, m), radians, and one over their standard deviations (N, m); zero for absent rows.

    `start` is the number of the first of the rows in the problem.
    """
    sigma = np.sqrt(variances(problem.noise, problem.count)[..., start : start + rows.count])
    shape = (problem.batch_shape[0], rows.count)
    importance = np.where(rows.weight > 0.0, np.sqrt(rows.weight) / sigma, 0.0)
    return np.broadcast_to(rows.z - rows.correction, shape), np.broadcast_to(importance, shape)


def _for_rows(array: Array, core: int, rows: Rows, size: int) -> Array:
    """Return a quantity of stations at the stations and epochs of rows, (N, m, ...).

    `array` (..., k or 1, s, ...) has `core` axes without the batch axes. `size` is N.
    """
    full = np.broadcast_to(array, (size, *array.shape[array.ndim - core :]))
    epoch = rows.epoch if full.shape[1] > 1 else np.zeros_like(rows.epoch)
    return full[:, epoch, rows.a]


def instrumental(seen: Bearings) -> Array:
    """Return the instrumental-variable fixes (N, 1, d), metres; NaN without a solution."""
    d = seen.station.shape[-1]
    steep = (None, None) if d == 2 else (seen.angle[..., 1], seen.weight[..., 1])
    azimuth, importance = seen.angle[..., 0], seen.weight[..., 0]
    found = sight(azimuth, seen.station, importance, elevation=steep[0], elevation_weight=steep[1], axes=seen.axes)
    return seen.metres(np.where(found.ok[:, None], found.instrumental, np.nan))[:, None]


def courses(problem: Problem) -> BearingCourses | None:
    """Return the pseudo-linear courses of a flat batch of runs, or None if its rows are not all angles.

    Parameters
    ----------
    problem : Problem
        N runs of one target on a polynomial course, without other unknowns.

    Returns
    -------
    BearingCourses
        In metres and seconds since the reference time of the state.
    """
    if any(rows.kind not in ("azimuth", "elevation") for rows in problem.rows):
        return None
    seen = bearings(problem)
    if seen is None:
        return None
    seen = _in_plan(problem, seen)
    # True if azimuths are used as bearings in the plane of a problem in space
    flat = seen.station.shape[-1] < problem.dimension
    block = next(rows for rows in problem.rows if rows.kind == "azimuth")
    found = sight_courses(
        seen.angle[..., 0],
        seen.station,
        elapsed(problem, 0)[block.epoch],
        seen.weight[..., 0],
        elevation=None if flat else seen.angle[..., 1],
        elevation_weight=None if flat else seen.weight[..., 1],
        axes=seen.axes,
        order=problem.motions[0].order,
    )

    # coefficients of the course in metres: only the first one is a position, and gets the centre
    def metres(c: Array) -> Array:
        out = c * seen.scale[:, None, None]
        out[:, 0] += seen.centre
        return out

    return BearingCourses(
        metres(found.plain), metres(found.weighted), metres(found.instrumental), found.ok, found.ahead
    )


def course_states(problem: Problem) -> Array | None:
    """Return the states (N, order + 1, d) of the instrumental courses, or None if rows are not all angles.

    A state is position, velocity and acceleration, in m and s. It is NaN if the run does not determine a course, or if
    the course is not in front of the stations.
    """
    found = courses(problem)
    if found is None:
        return None
    # coefficients of 1, t, t^2 become position, velocity and acceleration: x = p + v t + a t^2 / 2
    unit = np.array([1.0, 1.0, 2.0])[: found.plain.shape[1], None]
    states = np.where(found.ahead[:, None, None], unit * found.instrumental, np.nan)
    return states if states.shape[-1] == problem.dimension else _at_height(problem, states)


def _in_plan(problem: Problem, seen: Bearings) -> Bearings:
    """Return azimuths as bearings in the plane if there are no elevations and the height is known."""
    local = problem.frame.kind == "enu" and problem.dimension == _SPACE
    if not local or (seen.weight[..., 1] > 0.0).any() or known_height(problem) is None:
        return seen
    return replace(seen, station=seen.station[..., :2], axes=None, centre=seen.centre[..., :2])


# coordinates of space
_SPACE = 3


def _at_height(problem: Problem, plan: Array) -> Array:
    """Return states (N, q, 3) from states in the plane (N, q, 2), at the known height.

    A state has q vectors: position, then its derivatives. The height above the origin ignores the curvature of the
    Earth.
    """
    level = known_height(problem)
    assert level is not None
    assert problem.frame.origin is not None
    states = np.concatenate([plan, np.zeros((*plan.shape[:2], 1))], axis=-1)
    states[:, 0, 2] = level - problem.frame.origin[2]
    return states


def by_directions(seen: Bearings) -> Array:
    """Return the fixes (N, 1, d), metres, of the unit-direction relaxation, over threads; NaN without elevations."""
    from formulations.direction_sdp import directions

    out = np.full((len(seen.station), 1, seen.station.shape[-1]), np.nan)
    if out.shape[-1] == 2:  # directions in a plane are azimuths, which need no relaxation
        return out

    def relax(item: tuple[int, Array]) -> None:
        i, use = item
        out[i, 0] = directions(**sights(seen, i, use)).point

    map_on_threads(relax, complete_bearings(seen), least=WORTH)
    return seen.metres(out)


def sights(seen: Bearings, i: int, use: Array) -> dict[str, Any]:
    """Return the arguments of `formulations.direction_sdp.directions` for the bearings `use` (m,) of problem i."""
    axes = None if seen.axes is None else seen.axes[i, use]
    angle, sigma = seen.angle[i, use], 1.0 / seen.weight[i, use]
    return {"angle": angle, "sigma": sigma, "station": seen.station[i, use], "axes": axes}


def cones_of(seen: Bearings, i: int) -> tuple[Array, Array, Array] | None:
    """Return directions and stations (m, d) and scales (m,) of the cones of problem i; None without two bearings."""
    d = seen.station.shape[-1]
    use = (seen.weight[i, :, : d - 1] > 0.0).all(-1) & np.isfinite(seen.angle[i]).all(-1)
    if use.sum() < 2:
        return None
    ahead = rays(seen.angle[..., 0], seen.angle[..., 1] if d == 3 else None, seen.axes).ahead
    # a cone has equal width in all directions, so its half angle is the larger deviation
    return ahead[i, use], seen.station[i, use], 1.0 / seen.weight[i, use, : d - 1].min(-1)


def least_worst(seen: Bearings) -> Array:
    """Return the fixes (N, 1, d), metres, with the smallest maximal angle in sigma; NaN without two bearings."""
    from formulations.minimax_cone import minimax

    d = seen.station.shape[-1]
    out = np.full((len(seen.station), 1, d), np.nan)

    for i in range(len(out)):  # each is a series of programs of a tenth of a millisecond: too short for threads
        cones = cones_of(seen, i)
        if cones is not None:
            out[i, 0] = minimax(*cones).point
    return seen.metres(out)


def angle_bounds(seen: Bearings, point: Array) -> Array:
    """Return lower bounds (N,) of the maximum-likelihood cost over all positions; minus infinity without a bound.

    Parameters
    ----------
    seen : Bearings
        All the rows of the problems.
    point : array (N, 3)
        Refined fixes, metres.
    """
    from formulations.direction_sdp import angle_bound

    out = np.full(len(point), -np.inf)
    scaled = (point - seen.centre) / seen.scale[:, None]

    def bound(item: tuple[int, Array]) -> None:
        i, use = item
        # a bound from some of the rows would be valid but poor, so it is not computed
        if np.isfinite(scaled[i]).all() and not (seen.weight[i, ~use] > 0.0).any():
            axes = None if seen.axes is None else seen.axes[i, use]
            sigma = 1.0 / seen.weight[i, use]
            out[i] = angle_bound(seen.angle[i, use], sigma, seen.station[i, use], scaled[i], axes=axes).bound

    map_on_threads(bound, complete_bearings(seen), least=WORTH)
    return out


def complete_bearings(seen: Bearings) -> list[tuple[int, Array]]:
    """Return the problems with at least two complete bearings: pairs of their number and flags (m,) of these bearings.

    The list is empty in a plane.
    """
    if seen.station.shape[-1] != 3:
        return []
    use = np.asarray((seen.weight > 0.0).all(-1) & np.isfinite(seen.angle).all(-1))
    return [(int(i), use[i]) for i in np.flatnonzero(use.sum(1) > 1)]


# One receiver and one illuminator: a polynomial course from delays and angles of several epochs.


def course_starts(problem: Problem) -> Array | None:
    """Return the state (N, order + 1, 3) of the only target, or None if the rows do not belong to one bistatic pair.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems whose rows are range sums of one pair of stations at rest, and angles of its receiver.

    Returns
    -------
    array (N, order + 1, 3)
        Position, velocity and acceleration; NaN if the epochs do not determine them.
    """
    found = pair(problem)
    if found is None:
        return None
    receiver, illuminator = found
    size, k = problem.batch_shape[0], problem.epochs
    # azimuth, elevation and range sum of each epoch; an infinite deviation is an absent row
    value, sigma = np.zeros((3, size, k)), np.full((3, size, k), np.inf)
    deviation = np.sqrt(variances(problem.noise, problem.count))
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        kind = ("azimuth", "elevation", "range_sum").index(rows.kind)
        value[kind][:, rows.epoch] = rows.z - rows.correction
        values = deviation[..., start : start + rows.count]
        sigma[kind][:, rows.epoch] = np.where(rows.weight > 0.0, values, np.inf)
    place = np.broadcast_to(problem.stations.position, (size, *problem.stations.position.shape[-3:]))[:, 0]
    home, away = place[:, receiver], place[:, illuminator] - place[:, receiver]
    length = float(spread_of(problem)[1][0])
    # unit vectors of increasing azimuth, of increasing elevation, and along the line of sight
    axes = triad(value[0], value[1])
    if problem.stations.axes is not None:
        values = np.broadcast_to(problem.stations.axes, (size, *problem.stations.axes.shape[-4:]))[:, 0, receiver]
        axes = axes @ values[:, None]
    # path by the target minus direct path
    excess = value[2] - np.sqrt((away**2).sum(-1))[:, None]
    # The error across the line of sight is the error of the angle in radians times the range; for azimuths also times
    # cos E.
    spread = np.stack([np.cos(value[1]) * sigma[0], sigma[1], sigma[2] / length], axis=-1)
    since, order = elapsed(problem, 0), problem.motions[0].order
    fitted = course(excess / length, axes, away / length, np.broadcast_to(since, (size, k)), spread, order=order)
    # as above: the second derivative is twice the coefficient of t^2
    state = fitted.coefficients * length * np.array([1.0, 1.0, 2.0])[: order + 1, None]
    state[:, 0] += home
    return np.asarray(state)


def pair(problem: Problem) -> tuple[int, int] | None:
    """Return the numbers of receiver and illuminator of all rows; None without one bistatic pair at rest."""
    kinds = {rows.kind: rows for rows in problem.rows}
    if problem.dimension != 3 or set(kinds) != {"range_sum", "azimuth", "elevation"} or len(kinds) != len(problem.rows):
        return None
    if problem.stations.position.shape[-3] > 1 or not all(_once_an_epoch(rows) for rows in problem.rows):
        return None
    ends = {(int(a), int(b)) for a, b in zip(kinds["range_sum"].a, kinds["range_sum"].b, strict=True)}
    receivers = {int(a) for kind in ("azimuth", "elevation") for a in kinds[kind].a}
    if len(receivers) != 1 or len({frozenset(end) for end in ends}) != 1:
        return None
    receiver = receivers.pop()
    others = {a if b == receiver else b for a, b in ends if receiver in (a, b)}
    # rows may name the two stations in either order
    return (receiver, others.pop()) if len(others) == 1 else None


def _once_an_epoch(rows: Rows) -> bool:
    """Return whether each epoch has at most one of the rows."""
    return len(np.unique(rows.epoch)) == rows.count
