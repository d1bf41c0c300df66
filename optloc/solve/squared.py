"""From rows of any kind to squared-range rows: linear in (x, t) on a cone, or in (x, |x|^2) on a paraboloid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from formulations.squared_range import Quadric, cone, paraboloid, stationary
from optloc import linalg
from optloc.models import MODELS, Point, lifted_row
from optloc.noise import variances
from optloc.problem import Problem
from optloc.solve.reduce import Ranges, ranges
from optloc.types import Array, Rows


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
    covariance : array (N or 1, s, s)
        Of the least-squares ranges, in units of scale squared.
    place : array (N, s, d)
        Scaled positions of the stations of `ranged`.
    others : tuple of Linear row sets
        Rows of other kinds.
    """

    quadric: Quadric
    origin: Array
    scale: Array
    ranged: Array
    ranged_right: Array
    covariance: Array
    place: Array
    others: tuple[Other, ...]


@dataclass(frozen=True, slots=True)
class Other:
    """Linear rows of one kind: ``row . y = right``, whose error is ``factor(x)`` times the measurement's."""

    row: Array
    right: Array
    sigma: Array
    factor: Any


def candidates(problem: Problem, found: Ranges | None, passes: int = 2) -> tuple[Array, Array]:
    """Return starting positions of a flat batch of problems with one static target.

    Parameters
    ----------
    problem : Problem
        N problems.
    found : Ranges, optional
        Its least-squares ranges.
    passes : int
        Weightings: the first takes all ranges as equal, later ones use the cheapest point before.

    Returns
    -------
    position : array (N, q, d)
        Metres; NaN where there is none. Best first.
    valid : bool array (N, q)
        Which are candidates.
    """
    squared = squared_rows(problem, found)
    distance = np.ones(squared.ranged_right.shape)
    point: Array | None = None
    every, good = [], []
    for _ in range(passes):
        rows, right = _weighted(squared, distance, point)
        y, _, valid = _stationary(rows, right, squared.quadric)
        every.insert(0, y[..., :-1])
        good.insert(0, valid)
        point = np.where(valid[:, :1], y[:, 0, :-1], 0.0 if point is None else point)
        distance = np.maximum(np.linalg.norm(point[:, None, :] - squared.place, axis=-1), 1e-3)
    position = np.concatenate(every, axis=1) * squared.scale[:, None, None] + squared.origin[:, None, :]
    return position, np.concatenate(good, axis=1)


def _stationary(rows: Array, right: Array, quadric: Quadric) -> tuple[Array, Array, Array]:
    if quadric.shape == "paraboloid" and not rows[..., -1].any():
        return _linear(rows[..., :-1], right)
    return stationary(rows, right, quadric, positive=quadric.shape == "cone")


def _linear(rows: Array, right: Array) -> tuple[Array, Array, Array]:
    """Return the plain least-squares point: no row has ranges."""
    transposed = np.swapaxes(rows, -1, -2)
    x, ok = linalg.solve(transposed @ rows, transposed @ right[..., None])
    y = np.concatenate([np.swapaxes(x, -1, -2), np.zeros((*x.shape[:-2], 1, 1))], axis=-1)
    return y, np.zeros(y.shape[:-1]), ok[..., None]


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
        ranged, right, covariance = np.zeros((size, 1, n)), np.zeros((size, 1)), np.eye(1)[None]
        place = place[:, :1]
    else:
        ranged, right = _range_rows(found, place, scale, on_cone)
        covariance = found.covariance / (scale**2)[:, None, None]
    others = tuple(
        other
        for rows, start in zip(problem.rows, problem.starts, strict=True)
        if (other := _other_rows(problem, rows, start, found, origin, scale, on_cone)) is not None
    )
    return Squared(quadric, origin, scale, ranged, right, covariance, place, others)


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
    factor = 1.0 / (2.0 * distance)
    whiten = linalg.whitening(squared.covariance)
    stacked = np.concatenate([squared.ranged, squared.ranged_right[..., None]], axis=-1)
    parts = [whiten @ (factor[..., None] * stacked)]
    for other in squared.others:
        error = np.maximum(np.abs(other.factor(point)), 1e-3) * other.sigma
        parts.append(np.concatenate([other.row, other.right[..., None]], axis=-1) / error[..., None])
    joined = np.concatenate([np.broadcast_to(p, (len(distance), *p.shape[-2:])) for p in parts], axis=-2)
    return joined[..., :-1], joined[..., -1]


def _other_rows(
    problem: Problem, rows: Rows, start: int, found: Ranges | None, origin: Array, scale: Array, on_cone: bool
) -> Other | None:
    """Return the lifted rows of one kind with its ranges replaced by c + sign t, or None where it has no such row."""
    model = MODELS[rows.kind]
    if model.ranges is not None or model.lifted is None:
        return None
    a, b = _points(problem, rows, origin, scale)
    m = rows.z - rows.correction
    azimuth = _azimuth_of(problem, rows) if rows.kind == "elevation" else None
    if azimuth is not None:
        row, right, factor = _paired_elevation(m, azimuth, a)
    else:
        made = _substituted(lifted_row(model, m, a, b), rows, a, b, found, scale, on_cone)
        if made is None:
            return None
        row, right, factor = made
    size = problem.batch_shape[0]
    row, right = np.broadcast_to(row, (size, *row.shape[-2:])), np.broadcast_to(right, (size, right.shape[-1]))
    weight = np.broadcast_to(rows.weight, right.shape)
    sigma = np.sqrt(variances(problem.noise, problem.count)[..., start : start + rows.count])
    present = weight > 0.0
    sigma = sigma / np.sqrt(np.where(present, weight, 1.0))
    return Other(np.where(present[..., None], row, 0.0), np.where(present, right, 0.0), sigma, factor)


def _points(problem: Problem, rows: Rows, origin: Array, scale: Array) -> tuple[Point, Point]:
    def point(index: Array) -> Point:
        position = problem.stations.position
        epoch = rows.epoch if position.shape[-3] > 1 else np.zeros_like(rows.epoch)
        place = (position[..., epoch, index, :] - origin[:, None]) / scale[:, None, None]
        axes = problem.stations.axes
        if axes is not None:
            when = rows.epoch if axes.shape[-4] > 1 else np.zeros_like(rows.epoch)
            picked = axes[..., when, index, :, :]
            axes = tuple(tuple(picked[..., i, c] for c in range(picked.shape[-1])) for i in range(picked.shape[-2]))
        return Point(tuple(place[..., c] for c in range(place.shape[-1])), None, axes)

    return point(rows.a), point(rows.b)


def _azimuth_of(problem: Problem, rows: Rows) -> Array | None:
    """Return the azimuth that the same station measured of the same target and epoch, (..., m); None if any lacks one."""
    for other in problem.rows:
        if other.kind != "azimuth":
            continue
        keys = list(zip(other.a.tolist(), other.epoch.tolist(), other.target.tolist(), strict=True))
        wanted = list(zip(rows.a.tolist(), rows.epoch.tolist(), rows.target.tolist(), strict=True))
        if all(key in keys for key in wanted):
            pick = [keys.index(key) for key in wanted]
            return np.asarray(other.z[..., pick] - other.correction[..., pick])
    return None


def _paired_elevation(m: Array, azimuth: Array, a: Point) -> tuple[Array, Array, Any]:
    """Return the row [sin E cos A, sin E sin A, -cos E] . (x - s) = 0 in the station's axes; its error is range times n_E."""
    local = (np.sin(m) * np.cos(azimuth), np.sin(m) * np.sin(azimuth), -np.cos(m))
    basis = a.axes or tuple(tuple(float(i == j) for j in range(3)) for i in range(3))
    normal = [sum(local[i] * basis[i][c] for i in range(3)) for c in range(3)]
    place = np.stack(np.broadcast_arrays(*a.position), axis=-1)
    row = np.stack(np.broadcast_arrays(*normal), axis=-1)
    right = (row * place).sum(-1)
    row = np.concatenate([row, np.zeros((*row.shape[:-1], 1))], axis=-1)

    def factor(point: Array | None) -> Array:
        if point is None:
            return np.ones(1)
        return np.asarray(np.linalg.norm(point[:, None] - place, axis=-1))

    return row, right, factor


def _substituted(
    lifted: Any, rows: Rows, a: Point, b: Point, found: Ranges | None, scale: Array, on_cone: bool
) -> tuple[Array, Array, Any] | None:
    """Return row, right side and error factor of a lifted row in terms of y, or None where a range stays unknown."""
    d = len(a.position)

    def factor(point: Array | None) -> Array:
        if point is None:
            return np.ones(1)
        t = Point(tuple(point[:, None, c] for c in range(d)), None, None)
        return np.asarray(lifted.factor(t, a, b))

    shape = np.broadcast_shapes(*(np.shape(v) for v in (*a.position, lifted.ra, lifted.rb, lifted.constant)))
    x = [np.broadcast_to(v, shape) for v in (lifted.x or (0.0,) * d)]
    ranged = np.any(lifted.ra != 0.0) or np.any(lifted.rb != 0.0)
    if not ranged:
        return np.stack([*x, np.zeros(shape)], axis=-1), np.broadcast_to(-lifted.constant, shape), factor
    if found is None and lifted.x is None:
        return _squared_ratio(lifted, a, b, factor)
    if found is None:
        return None
    last, constant = np.zeros(shape), np.broadcast_to(lifted.constant, shape)
    for coefficient, index in ((lifted.ra, rows.a), (lifted.rb, rows.b)):
        if not np.any(coefficient != 0.0):
            continue
        node = [_node(found, int(s), int(e)) for s, e in zip(index, rows.epoch, strict=True)]
        if min(node) < 0:
            return None
        last = last + coefficient * found.sign[:, node]
        constant = constant + coefficient * found.offset[:, node] / scale[:, None]
    if not on_cone:
        last = np.zeros(shape)
    return np.stack([*x, last], axis=-1), -constant, factor


def _node(found: Ranges, station: int, epoch: int) -> int:
    at = np.flatnonzero((found.station == station) & ((found.epoch == epoch) | (found.epoch.max(initial=0) == 0)))
    return int(at[0]) if len(at) and found.inside[:, at[0]].all() else -1


def _squared_ratio(lifted: Any, a: Point, b: Point, factor: Any) -> tuple[Array, Array, Any]:
    """Square ``ra r_a + rb r_b = 0``: linear in (x, |x|^2)."""
    p, q = lifted.ra**2, lifted.rb**2
    at_a = sum(v * v for v in a.position)
    at_b = sum(v * v for v in b.position)
    x = [-2.0 * (p * u - q * v) for u, v in zip(a.position, b.position, strict=True)]
    row = np.stack(np.broadcast_arrays(*x, p - q), axis=-1)

    def squared(point: Array | None) -> Array:
        if point is None:
            return np.ones(1)
        r_b = np.sqrt(sum((point[:, None, c] - v) ** 2 for c, v in enumerate(b.position)))
        return np.asarray(2.0 * np.sqrt(q) * r_b * np.abs(factor(point)) / np.maximum(np.sqrt(p), 1e-12))

    return row, np.asarray(q * at_b - p * at_a), squared


__all__ = ["Squared", "candidates", "ranges", "squared_rows"]
