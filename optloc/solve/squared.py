"""From rows of any kind to squared-range rows: linear in (x, t) on a cone, or in (x, |x|^2) on a paraboloid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from formulations.squared_range import Quadric, cone, minimiser, paraboloid, stationary
from optloc import linalg
from optloc.problem import Problem
from optloc.solve.lifted import Coordinates, Lifted, lifted_rows
from optloc.solve.reduce import Ranges
from optloc.threads import WORTH, mapped
from optloc.types import Array

Pick = Callable[[Array, Array, Quadric], tuple[Array, Array]]


@dataclass(frozen=True, slots=True)
class Squared:
    """Squared-range rows of a flat batch in scaled coordinates, y = ((x - origin) / scale, last).

    Parameters
    ----------
    quadric : Quadric
        Cone: last = r_reference / scale. Paraboloid: last = |x - origin|^2 / scale^2.
    origin : array (N, d)
        Metres.
    scale : array (N,)
        Metres.
    ranged, ranged_right : array (N, s, n), (N, s)
        One row for each station; zero where it has none.
    whiten : array (N or 1, s, s)
        Whitening matrix of the least-squares ranges, 1/metres.
    place : array (N, s, d)
        Scaled positions of the stations of `ranged`.
    others : tuple of Lifted
        Rows of other kinds.
    """

    quadric: Quadric
    origin: Array
    scale: Array
    ranged: Array
    ranged_right: Array
    whiten: Array
    place: Array
    others: tuple[Lifted, ...]


def candidates(problem: Problem, found: Ranges | None, pick: Pick) -> Array:
    """Return starting positions (N, q, d) of a flat batch of problems with one static target; NaN where there is none.

    Two weightings: the first takes all ranges as equal, the second divides by twice the ranges to the first
    answer, which turns the error of a squared range into that of a range.

    Parameters
    ----------
    problem : Problem
        N problems.
    found : Ranges, optional
        Its least-squares ranges.
    pick : callable
        Which points of a squared-range problem to take: `minimum`, `every`, `shor` or `hull`.

    References
    ----------
    A. Beck, P. Stoica, J. Li, "Exact and approximate solutions of source localization problems", IEEE Trans.
    Signal Process. 56 (2008), section IV for range differences.
    """
    squared = squared_rows(problem, found)
    first = _picked(squared, np.ones(squared.ranged_right.shape), None, pick)
    point = np.where(np.isfinite(first[:, 0]), first[:, 0], 0.0)
    distance = np.maximum(np.sqrt(((point[:, None, :] - squared.place) ** 2).sum(-1)), 1e-3)
    second = _picked(squared, distance, point, pick)
    points = np.concatenate([second, first], axis=1) if pick is every else second
    return points * squared.scale[:, None, None] + squared.origin[:, None, :]


def _picked(squared: Squared, distance: Array, point: Array | None, pick: Pick) -> Array:
    rows, right = _weighted(squared, distance, point)
    linear = squared.quadric.shape == "paraboloid" and not rows[..., -1].any()
    y, valid = _linear(rows[..., :-1], right) if linear else pick(rows, right, squared.quadric)
    return np.where(valid[..., None], y[..., :-1], np.nan)


def minimum(rows: Array, right: Array, quadric: Quadric) -> tuple[Array, Array]:
    """Return the exact minimiser (N, 1, n) of squared-range problems, and where it exists."""
    y, ok = minimiser(rows, right, quadric, positive=quadric.shape == "cone")
    return y[:, None], ok[:, None]


def every(rows: Array, right: Array, quadric: Quadric) -> tuple[Array, Array]:
    """Return all real stationary points (N, K, n) of squared-range problems, best first, and which are valid."""
    y, _, valid = stationary(rows, right, quadric, positive=quadric.shape == "cone")
    return y, valid


def shor(rows: Array, right: Array, quadric: Quadric) -> tuple[Array, Array]:
    """Return the answers (N, 1, n) of Shor's semidefinite relaxation, over threads."""
    from formulations.squared_range_conic import shor as relax

    return _one_by_one(relax, rows, right, quadric)


def hull(rows: Array, right: Array, quadric: Quadric) -> tuple[Array, Array]:
    """Return the answers (N, 1, n) of the second-order cone relaxation, over threads."""
    from formulations.squared_range_conic import hull as relax

    return _one_by_one(relax, rows, right, quadric)


def _one_by_one(relax: Callable[..., Any], rows: Array, right: Array, quadric: Quadric) -> tuple[Array, Array]:
    usable = np.isfinite(rows).all((-1, -2)) & np.isfinite(right).all(-1)
    y = np.full((len(rows), 1, quadric.size), np.nan)

    def relaxed(i: int) -> None:
        y[i, 0] = relax(rows[i], right[i], quadric, bound=False).y

    mapped(relaxed, np.flatnonzero(usable).tolist(), least=WORTH)
    return y, np.isfinite(y).all(-1)


def _linear(rows: Array, right: Array) -> tuple[Array, Array]:
    """Return the plain least-squares point: no row has ranges."""
    transposed = np.swapaxes(rows, -1, -2)
    x, ok = linalg.solve(transposed @ rows, transposed @ right[..., None])
    y = np.concatenate([np.swapaxes(x, -1, -2), np.zeros((*x.shape[:-2], 1, 1))], axis=-1)
    return y, ok[..., None]


def squared_rows(problem: Problem, found: Ranges | None) -> Squared:
    """Return the squared-range rows of a flat batch of problems.

    Parameters
    ----------
    problem : Problem
        N problems with one static target.
    found : Ranges, optional
        Its least-squares ranges.
    """
    size, d = problem.batch_shape[0], problem.dimension
    on_cone = found is not None and bool(found.free.any())
    place, inside = _station_nodes(problem, found)
    centre = (place * inside[..., None]).sum(1) / np.maximum(inside.sum(1), 1)[:, None]
    origin = centre
    if on_cone:
        assert found is not None
        origin = place[np.arange(size), found.reference]
    spread = np.where(inside, np.linalg.norm(place - centre[:, None], axis=-1), 0.0).max(1)
    if found is not None and not on_cone:
        spread = np.maximum(spread, np.where(found.inside, np.abs(found.offset), 0.0).max(1))
    scale = np.where(spread > 0.0, spread, 1.0)
    place = (place - origin[:, None]) / scale[:, None, None]
    n = d + 1
    quadric = cone(d) if on_cone else paraboloid(d)
    if found is None:
        ranged, right, whiten = np.zeros((size, 1, n)), np.zeros((size, 1)), np.eye(1)[None]
        place = place[:, :1]
    else:
        ranged, right = _range_rows(found, place, scale, on_cone)
        whiten = linalg.whitening(found.covariance)
    others = tuple(
        other
        for rows, start in zip(problem.rows, problem.starts, strict=True)
        if (other := lifted_rows(problem, rows, start, found, Coordinates(origin, scale, on_cone))) is not None
    )
    return Squared(quadric, origin, scale, ranged, right, whiten, place, others)


def _station_nodes(problem: Problem, found: Ranges | None) -> tuple[Array, Array]:
    position = np.broadcast_to(
        problem.stations.position, (problem.batch_shape[0], *problem.stations.position.shape[-3:])
    )
    if found is None:
        used = sorted({int(s) for rows in problem.rows for s in (*rows.a, *rows.b) if s >= 0})
        nodes = position[:, 0, used]
        return nodes, np.ones(nodes.shape[:2], dtype=bool)
    return position[:, found.epoch, found.station], found.inside


def _range_rows(found: Ranges, place: Array, scale: Array, on_cone: bool) -> tuple[Array, Array]:
    """Square r_i = c_i + sign_i t: subtract t^2 = |y|^2 on the cone, keep |y|^2 as unknown on the paraboloid."""
    c = found.offset / scale[:, None]
    squares = (place**2).sum(-1)
    usable = found.inside
    if on_cone:
        usable = usable & (found.sign != 0) & (np.arange(place.shape[1]) != found.reference[:, None])
        rows = np.concatenate([2.0 * place, (2.0 * found.sign * c)[..., None]], axis=-1)
        right = squares - c**2
    else:
        rows = np.concatenate([-2.0 * place, np.ones((*c.shape, 1))], axis=-1)
        right = c**2 - squares
    return np.where(usable[..., None], rows, 0.0), np.where(usable, right, 0.0)


def _weighted(squared: Squared, distance: Array, point: Array | None) -> tuple[Array, Array]:
    """Divide each row by the error it inherits from the measurements at an approximate point."""
    factor = 0.5 * squared.scale[:, None] / distance
    stacked = np.concatenate([squared.ranged, squared.ranged_right[..., None]], axis=-1)
    parts = [squared.whiten @ (factor[..., None] * stacked)]
    for other in squared.others:
        error = np.maximum(np.abs(other.factor(point)), 1e-3) * other.sigma
        parts.append(np.concatenate([other.row, other.right[..., None]], axis=-1) / error[..., None])
    joined = np.concatenate([np.broadcast_to(p, (len(distance), *p.shape[-2:])) for p in parts], axis=-2)
    return joined[..., :-1], joined[..., -1]
