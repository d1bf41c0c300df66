"""Starts of one position without a first guess, from closed forms; and tests of the problems that they serve.

Letters: N problems, q starts of a problem, s stations with ranges, d coordinates. `found` are the least-squares ranges
of the problems (`optloc.linear.least_squares_ranges`).
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np

from formulations.range_height import Ellipsoid, ellipsoid, locate, locate_by_ranges
from optloc.base.linalg import centre_and_spread
from optloc.base.threads import WORTH, map_on_threads
from optloc.base.types import Array, Band
from optloc.linear.least_squares_ranges import Ranges, ranges
from optloc.linear.mirror import is_of_ranges, one_position, rows_of_stations
from optloc.models.primitives import WGS84_A, WGS84_F
from optloc.problem.problem import Problem
from optloc.solvers.starts.squared_range import Pick, candidates, stationary_points

# Search for other minima near a weak fix. With these positions the Monte Carlo cases in docs/measured/global.md miss no
# minimum without a warning.
#
# Shares of the distance of the fix. They are geometric, because the range of a far emitter shows only in the curvature
# of wave fronts, which is one over the range.
_RADIAL = np.array([0.25, 0.45, 0.7, 1.5, 2.5, 4.0, 8.0])
# Spreads of the stations, in the direction of the fix: outside the network, and at nearly flat wave fronts. They serve
# fixes between the stations, for which no share of the distance leads out.
_FAR = np.array([3.0, 30.0])
# Standard deviations along the longest axis: nearer than one and a half, refinement leads back to the fix. Each
# doubling reaches across a valley twice as long.
_STEPS = np.array([-12.0, -6.0, -3.0, -1.5, 1.5, 3.0, 6.0, 12.0])


def squared_range_starts(problem: Problem, pick: Pick) -> Array:
    """Return squared-range candidates (N, q, d), metres, of a flat batch with one static target; NaN in empty slots.

    Parameters
    ----------
    problem : Problem
        N problems. Problems with determined ranges and problems whose ranges share an unknown are solved separately.
    pick : callable
        Selects the points, see `optloc.solvers.starts.squared_range`.
    """
    found = ranges(problem)
    if found is None or found.free.all() or not found.free.any():
        return candidates(problem, found, pick)
    # ranges with a common unknown lead to a cone, known ranges to a paraboloid; one batch cannot have both
    parts = []
    for mask in (found.free, ~found.free):
        some = problem.take(np.flatnonzero(mask))
        parts.append((mask, candidates(some, ranges(some), pick)))
    position = np.full((len(found.free), max(points.shape[1] for _, points in parts), problem.dimension), np.nan)
    for mask, points in parts:
        position[mask, : points.shape[1]] = points
    return position


def along_the_valley(problem: Problem, position: Array, covariance: Array) -> Array:
    """Return points (N, q, d) from which other minima near a weak fix can be reached.

    Far emitters have a long valley towards the stations, and flat networks have one across their plane. So other minima
    are on the line to the centre of the stations, or along the longest axis of the error ellipsoid.

    Parameters
    ----------
    problem : Problem
        N problems.
    position : array (N, d)
        Fixes, metres.
    covariance : array (N, d, d)
        Covariances of the fixes; if one is not finite, its steps along the axis are NaN.
    """
    centre, size = centre_and_spread(problem.stations.places)
    away = position - centre
    length = np.sqrt((away**2).sum(-1, keepdims=True))
    ahead = away / np.where(length > 0.0, length, 1.0)
    scaled = centre[..., None, :] + _RADIAL[:, None] * away[:, None]
    far = centre[..., None, :] + _FAR[:, None] * (np.broadcast_to(size, (len(away),))[:, None] * ahead)[:, None]
    known = np.asarray(np.isfinite(covariance).all((-1, -2)))
    # eigenvalues ascend: the last vector is the longest axis; rounding may make its square slightly negative
    values, vectors = np.linalg.eigh(np.where(known[:, None, None], covariance, 0.0))
    longest = np.sqrt(np.maximum(values[:, -1:], 0.0)) * vectors[..., -1]
    stepped = position[:, None] + _STEPS[:, None] * np.where(known[:, None], longest, np.nan)[:, None]
    return np.concatenate([scaled, far, stepped], axis=1)


def subarray_starts(problem: Problem) -> Array:
    """Return the candidates (N, q, d), metres, of all arrays that lack one station; NaN in empty slots."""
    parts = []
    for touched in rows_of_stations(problem):
        weight = np.where(touched, 0.0, np.broadcast_to(problem.weight, (*problem.batch_shape, problem.count)))
        # a station without rows changes nothing, and without the only station there is no problem
        touching = np.flatnonzero((weight != problem.weight).any(1) & (weight > 0.0).any(1))
        if len(touching):
            rest = problem.with_rows(weight=weight).take(touching)
            found = squared_range_starts(rest, stationary_points)
            spread = np.full((problem.batch_shape[0], *found.shape[1:]), np.nan)
            spread[touching] = found
            parts.append(spread)
    if not parts:
        return np.full((problem.batch_shape[0], 0, problem.dimension), np.nan)
    return np.concatenate(parts, axis=1)


# The size of a problem: solvers need numbers of order one.


def spread_of(problem: Problem) -> tuple[Array, Array]:
    """Return the centre of the stations (N or 1, d) and their greatest distance from it (N or 1,), metres."""
    places = problem.stations.places
    centre, spread = centre_and_spread(places if places.ndim == 3 else places[None])
    # stations at one point have no size, so the unit is one metre
    return centre, np.where(spread > 0.0, spread, 1.0)


def distance_of(problem: Problem, position: Array) -> Array:
    """Return the distances (N, ...) of positions (N, ..., d) from the centre of the stations, in their spreads."""
    centre, spread = spread_of(problem)
    extra = (1,) * (position.ndim - 2)
    # a run to infinity may overflow, and infinity is then the right distance
    with np.errstate(over="ignore", invalid="ignore"):
        away = position - centre.reshape(-1, *extra, centre.shape[-1])
        return np.asarray(np.sqrt((away**2).sum(-1)) / spread.reshape(-1, *extra))


def over_ground(problem: Problem) -> bool:
    """Return whether the problem has one position on Earth, and a row or a constraint may give its height."""
    has_height = bool(problem.constraints) or any(rows.kind == "height" for rows in problem.rows)
    return has_height and problem.frame.geodetic and problem.dimension == 3 and one_position(problem)


def is_registration_run(problem: Problem) -> bool:
    """Return whether a problem is a run of range rows with one target and a geometry that moves."""
    if len(problem.motions) != 1 or problem.epochs < 2:
        return False
    motion, moving = problem.motions[0], problem.stations.position.shape[-3] > 1
    differences = any(is_of_ranges(rows.kind) for rows in problem.rows)
    return differences and motion.known is None and motion.span == "run" and (moving or motion.order > 0)


# Starts from a known height: intersections of the ellipsoid with three ranges with one common unknown, or with two
# known ranges.

# Sets of stations, the widest first. The first set is good for most positions, and the others serve targets for which
# it is badly placed. Each set takes a quartic, or a relaxation of a millisecond.
_SUBSETS = 6
# Axes of the ellipsoid in units of its equatorial radius: numbers of order one for the quartic.
_AXES = np.array([1.0, 1.0, 1.0 - WGS84_F])


def known_height(problem: Problem) -> Array | None:
    """Return the height (N,) from rows or an exact constraint, metres, or None without either.

    The height is NaN for a problem whose rows of the kind "height" are all absent.
    """
    size = problem.batch_shape[0]
    for constraint in problem.constraints:
        if not isinstance(constraint, Band) or constraint.kind != "height":
            continue
        if np.all(constraint.lower == constraint.upper):
            return np.broadcast_to(constraint.lower, (size,))
    for rows in problem.rows:
        if rows.kind == "height":
            value = np.broadcast_to(rows.z - rows.correction, (size, rows.count))
            present = np.broadcast_to(rows.weight > 0.0, value.shape)
            first = present.argmax(1)
            return np.where(present.any(1), value[np.arange(size), first], np.nan)
    return None


def height_starts(problem: Problem, *, relax: bool = False) -> Array:
    """Return candidate positions (N, q, 3) of a flat batch from a known height and its best-placed stations.

    Parameters
    ----------
    problem : Problem
        N problems with one static target.
    relax : bool
        True: the point of the reduced semidefinite relaxation instead of the roots of the quartic, one by one.

    Returns
    -------
    array (N, q, 3)
        Metres; NaN in empty slots, q = 0 if no height is known.
    """
    scene = _height_scene(problem)
    if scene is None:
        return np.full((problem.batch_shape[0], 0, problem.dimension), np.nan)
    place, found, surface = scene
    parts = []
    # position and common unknown need three ranges and the height; the position alone needs two known ranges and the
    # height
    for count, mask in ((3, found.free), (2, ~found.free)):
        subsets = _subsets(place, found, mask, count)
        method = _relax if relax and count == 3 else _intersect
        parts += [method(place, found, nodes, surface, mask & (nodes[:, 0] >= 0)) for nodes in subsets]
    if not parts:
        return np.full((problem.batch_shape[0], 0, 3), np.nan)
    return problem.frame.from_ecef(np.concatenate(parts, axis=1) * WGS84_A)


def _height_scene(problem: Problem) -> tuple[Array, Ranges, Ellipsoid] | None:
    """Return stations (N, s, 3) in Earth radii, ranges and ellipsoids of the known heights; None without either."""
    size = problem.batch_shape[0]
    height = known_height(problem) if problem.frame.geodetic and problem.dimension == 3 else None
    found = None if height is None else ranges(problem)
    if height is None or found is None:
        return None
    position = np.broadcast_to(problem.stations.position, (size, *problem.stations.position.shape[-3:]))
    place = problem.frame.to_ecef(position[:, found.epoch, found.station]) / WGS84_A
    return place, found, ellipsoid(_AXES, height / WGS84_A)


def height_sights(problem: Problem) -> dict[str, Any] | None:
    """Return the arguments of `formulations.range_height_conic.lift` for the widest three stations of one problem.

    None if no height is known, or if there are no three ranges with a common unknown.
    """
    scene = _height_scene(problem)
    if scene is None:
        return None
    place, found, surface = scene
    mask = found.free & np.isfinite(np.broadcast_to(surface.shape, (len(place), 3, 3))).all((-1, -2))
    subsets = _subsets(place, found, mask, 3)
    return _lift_arguments(place, found, subsets[0], surface, 0) if subsets and (subsets[0][0] >= 0).all() else None


def _lift_arguments(place: Array, found: Ranges, nodes: Array, surface: Ellipsoid, i: int) -> dict[str, Any]:
    """Return the arguments of `formulations.range_height_conic.lift` for problem i; the others are as in `_relax`."""
    own = Ellipsoid(
        np.broadcast_to(surface.shape, (len(place), 3, 3))[i], np.broadcast_to(surface.centre, (len(place), 3))[i]
    )
    stations, offset = place[i, nodes[i]], found.offset[i, nodes[i]] / WGS84_A
    above = stations.mean(0)
    # stations above the Earth measure targets below them, so of two solutions the one on their side is taken
    below = own.centre + (above - own.centre) / np.sqrt(own.polar(above, above))
    sign = found.sign[i, nodes[i]].astype(float)
    return {"stations": stations, "sign": sign, "offset": offset, "surface": own, "near": below}


def _subsets(place: Array, found: Ranges, mask: Array, count: int) -> list[Array]:
    """Return up to six sets of stations for each problem, the widest first: arrays (N, count), -1 in empty slots.

    `place` (N, s, 3) are the stations with ranges, `mask` (N,) flags the problems, and `count` is the size of a set.
    """
    nodes = place.shape[1]
    if not mask.any() or nodes < count:
        return []
    choices = np.array(list(combinations(range(nodes), count)))
    usable = found.inside[:, choices].all(-1) & mask[:, None]
    if count == 3:
        a, b, c = (place[:, choices[:, i]] for i in range(3))
        # twice the area of the triangle: stations in a line give no independent information
        width = np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    else:
        width = np.linalg.norm(place[:, choices[:, 1]] - place[:, choices[:, 0]], axis=-1)
    # unusable sets are marked by their sign and come last
    width = np.where(usable, width, -1.0)
    order = np.argsort(-width, axis=1)[:, :_SUBSETS]
    best = np.take_along_axis(width, order, axis=1)
    return [
        np.where(best[:, i : i + 1] > 0.0, choices[order[:, i]], -1)
        for i in range(order.shape[1])
        if (best[:, i] > 0).any()
    ]


def _relax(place: Array, found: Ranges, nodes: Array, surface: Ellipsoid, mask: Array) -> Array:
    """Return the points (N, 1, 3) of the reduced relaxation, in Earth radii: nearest to the point below the stations.

    `place` (N, s, 3) are the stations with ranges, in Earth radii. `nodes` (N, 3) are the numbers of the stations to
    use. `surface` is the ellipsoid of the height. `mask` (N,) flags the problems to solve, and NaN is the result for
    others.
    """
    from formulations.range_height_conic import lift

    out = np.full((len(place), 1, 3), np.nan)
    finite = np.isfinite(np.broadcast_to(surface.shape, (len(place), 3, 3))).all((-1, -2))

    def relax(i: int) -> None:
        out[i, 0] = lift(**_lift_arguments(place, found, nodes, surface, i)).x

    map_on_threads(relax, np.flatnonzero(mask & finite).tolist(), least=WORTH)
    return out


def _intersect(place: Array, found: Ranges, nodes: Array, surface: Ellipsoid, mask: Array) -> Array:
    """Return the intersections of the ellipsoid with the ranges of some stations, (N, 4, 3) in Earth radii.

    The arguments are as in `_relax`, with two known ranges or three ranges with a common unknown. NaN in empty
    slots.
    """
    items = np.flatnonzero(mask)
    out = np.full((len(place), 4, 3), np.nan)
    pick = items[:, None]
    stations, offset = place[pick, nodes[items]], found.offset[pick, nodes[items]] / WGS84_A
    ellipsoids = Ellipsoid(
        np.broadcast_to(surface.shape, (len(place), 3, 3))[items],
        np.broadcast_to(surface.centre, (len(place), 3))[items],
    )
    if nodes.shape[1] == 3:
        out[items] = locate(stations, found.sign[pick, nodes[items]], offset, ellipsoids).x
    else:
        out[items] = locate_by_ranges(stations, offset, ellipsoids).x
    return out
