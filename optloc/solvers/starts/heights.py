"""Starts from a known height: three ranges with one common unknown, or two known ranges, meet the ellipsoid."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from formulations.range_height import Ellipsoid, ellipsoid, locate, locate_by_ranges
from optloc.base.threads import WORTH, mapped
from optloc.base.types import Array, Band
from optloc.models.primitives import WGS84_A, WGS84_F
from optloc.problem.problem import Problem
from optloc.solvers.starts.least_squares_ranges import Ranges, ranges

# Choices of stations, the widest first: the first is good for most places, and the next ones guard against a target for
# which it is ill placed. Each costs a quartic, or a relaxation of a millisecond.
_SUBSETS = 6
# Axes of the ellipsoid in units of its equatorial radius: numbers of order one for the quartic.
_AXES = np.array([1.0, 1.0, 1.0 - WGS84_F])


def known_height(problem: Problem) -> Array | None:
    """Return the height (N,) that rows or an exact constraint give, metres, or None where nothing does."""
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
        True: the answer of the reduced semidefinite relaxation in the place of the quartic's roots, one by one.

    Returns
    -------
    array (N, q, 3)
        Metres; NaN where there is none, q = 0 where no height is known.
    """
    size = problem.batch_shape[0]
    height = known_height(problem) if problem.frame.geodetic and problem.dimension == 3 else None
    found = None if height is None else ranges(problem)
    if height is None or found is None:
        return np.full((size, 0, problem.dimension), np.nan)
    position = np.broadcast_to(problem.stations.position, (size, *problem.stations.position.shape[-3:]))
    place = problem.frame.to_ecef(position[:, found.epoch, found.station]) / WGS84_A
    surface = ellipsoid(_AXES, height / WGS84_A)
    parts = []
    # place and common unknown take three ranges and the height; the place alone takes two known ranges and the height
    for count, mask in ((3, found.free), (2, ~found.free)):
        subsets = _subsets(place, found, mask, count)
        met = _relax if relax and count == 3 else _intersect
        parts += [met(place, found, nodes, surface, mask & (nodes[:, 0] >= 0)) for nodes in subsets]
    if not parts:
        return np.full((size, 0, 3), np.nan)
    return problem.frame.from_ecef(np.concatenate(parts, axis=1) * WGS84_A)


def _subsets(place: Array, found: Ranges, mask: Array, count: int) -> list[Array]:
    """Return up to six choices of nodes (N, count) for each problem, the widest first; -1 where there is none."""
    nodes = place.shape[1]
    if not mask.any() or nodes < count:
        return []
    choices = np.array(list(combinations(range(nodes), count)))
    usable = found.inside[:, choices].all(-1) & mask[:, None]
    if count == 3:
        a, b, c = (place[:, choices[:, i]] for i in range(3))
        # twice the area of the triangle: stations in a line say the same thing
        width = np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    else:
        width = np.linalg.norm(place[:, choices[:, 1]] - place[:, choices[:, 0]], axis=-1)
    # unusable choices come last and are told by their sign
    width = np.where(usable, width, -1.0)
    order = np.argsort(-width, axis=1)[:, :_SUBSETS]
    best = np.take_along_axis(width, order, axis=1)
    return [
        np.where(best[:, i : i + 1] > 0.0, choices[order[:, i]], -1)
        for i in range(order.shape[1])
        if (best[:, i] > 0).any()
    ]


def _relax(place: Array, found: Ranges, nodes: Array, surface: Ellipsoid, mask: Array) -> Array:
    """Return the answers (N, 1, 3) of the reduced relaxation, nearest to the point below the stations."""
    from formulations.range_height_conic import lift

    out = np.full((len(place), 1, 3), np.nan)
    whole = Ellipsoid(
        np.broadcast_to(surface.shape, (len(place), 3, 3)), np.broadcast_to(surface.centre, (len(place), 3))
    )

    def relax(i: int) -> None:
        own = Ellipsoid(whole.shape[i], whole.centre[i])
        stations, offset = place[i, nodes[i]], found.offset[i, nodes[i]] / WGS84_A
        above = stations.mean(0)
        # stations above the Earth see what is below them: of both places the one on their side is meant
        below = own.centre + (above - own.centre) / np.sqrt(own.polar(above, above))
        out[i, 0] = lift(stations, found.sign[i, nodes[i]].astype(float), offset, own, below).x

    mapped(relax, np.flatnonzero(mask & np.isfinite(whole.shape).all((-1, -2))).tolist(), least=WORTH)
    return out


def _intersect(place: Array, found: Ranges, nodes: Array, surface: Ellipsoid, mask: Array) -> Array:
    """Return where the ellipsoid meets the ranges of some nodes, (N, 4, 3) in Earth radii."""
    items = np.flatnonzero(mask)
    out = np.full((len(place), 4, 3), np.nan)
    pick = items[:, None]
    stations, offset = place[pick, nodes[items]], found.offset[pick, nodes[items]] / WGS84_A
    own = Ellipsoid(
        np.broadcast_to(surface.shape, (len(place), 3, 3))[items],
        np.broadcast_to(surface.centre, (len(place), 3))[items],
    )
    if nodes.shape[1] == 3:
        out[items] = locate(stations, found.sign[pick, nodes[items]], offset, own).x
    else:
        out[items] = locate_by_ranges(stations, offset, own).x
    return out
