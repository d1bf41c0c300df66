"""Rows of other kinds than ranges, made linear in squared-range coordinates: bearings and gain ratios."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from optloc.models import MODELS, LiftedRow, Point, lifted_row
from optloc.noise import variances
from optloc.problem import Problem
from optloc.solve.reduce import Ranges
from optloc.types import Array, Rows

Factor = Callable[[Array | None], Array]
Row = tuple[Array, Array, Factor]


@dataclass(frozen=True, slots=True)
class Coordinates:
    """Scaled coordinates y = ((x - origin) / scale, last).

    Parameters
    ----------
    origin : array (N, d)
        Metres.
    scale : array (N,)
        Metres.
    on_cone : bool
        Whether `last` is the range to the reference station; else it is |x - origin|^2 / scale^2.
    """

    origin: Array
    scale: Array
    on_cone: bool


@dataclass(frozen=True, slots=True)
class Lifted:
    """Linear rows of one kind, ``row . y = right``.

    Parameters
    ----------
    row : array (N, m, d + 1)
        Coefficients; zero for an absent row.
    right : array (N, m)
        Right-hand sides.
    sigma : array (..., m)
        Standard deviations of the measurements.
    factor : callable
        Maps points (N, d), or None for "one scale away", to the row's error per unit of measurement error (N, m).
    """

    row: Array
    right: Array
    sigma: Array
    factor: Factor


def lifted_rows(problem: Problem, rows: Rows, start: int, found: Ranges | None, to: Coordinates) -> Lifted | None:
    """Return the linear rows of one kind, or None where it has none.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems.
    rows : Rows
        One of its kinds.
    start : int
        Global number of its first row.
    found : Ranges, optional
        Least-squares ranges that replace the ranges of a lifted row.
    to : Coordinates
        Scaled coordinates.
    """
    model = MODELS[rows.kind]
    if model.ranges is not None or model.lifted is None:
        return None
    a, b = (_point(problem, rows, index, to) for index in (rows.a, rows.b))
    m = rows.z - rows.correction
    azimuth, paired = _azimuth_beside(problem, rows) if rows.kind == "elevation" else (None, None)
    if azimuth is not None and (found is None or bool(np.all(paired))):
        made: Row | None = _paired_elevation(m, azimuth, a)
    else:
        lifted = lifted_row(model, m, a, b)
        assert lifted is not None
        made, paired = _substituted(lifted, rows, a, b, found, to), None
    if made is None:
        return None
    row, right, factor = made
    size = problem.batch_shape[0]
    row, right = np.broadcast_to(row, (size, *row.shape[-2:])), np.broadcast_to(right, (size, right.shape[-1]))
    weight = np.broadcast_to(rows.weight, right.shape)
    present = (weight > 0.0) & (True if paired is None else paired)
    sigma = np.sqrt(variances(problem.noise, problem.count)[..., start : start + rows.count])
    sigma = sigma / np.sqrt(np.where(present, weight, 1.0))
    return Lifted(np.where(present[..., None], row, 0.0), np.where(present, right, 0.0), sigma, factor)


def _point(problem: Problem, rows: Rows, index: Array, to: Coordinates) -> Point:
    stations, still = problem.stations, np.zeros_like(rows.epoch)
    epoch = rows.epoch if stations.position.shape[-3] > 1 else still
    place = (stations.position[..., epoch, index, :] - to.origin[:, None]) / to.scale[:, None, None]
    components = tuple(place[..., c] for c in range(place.shape[-1]))
    if stations.axes is None:
        return Point(components)
    epoch = rows.epoch if stations.axes.shape[-4] > 1 else still
    axes = stations.axes[..., epoch, index, :, :]
    d = range(axes.shape[-1])
    return Point(components, None, tuple(tuple(axes[..., i, c] for c in d) for i in d))


def _azimuth_beside(problem: Problem, rows: Rows) -> tuple[Array | None, Array | None]:
    """Return the azimuth beside each elevation (same station, target and epoch), (..., m), and where it is present.

    None if any has no such row. An absent elevation is taken for present: it needs no azimuth.
    """
    for other in problem.rows:
        if other.kind != "azimuth":
            continue
        keys = list(zip(other.a.tolist(), other.epoch.tolist(), other.target.tolist(), strict=True))
        wanted = list(zip(rows.a.tolist(), rows.epoch.tolist(), rows.target.tolist(), strict=True))
        pick = [keys.index(key) for key in wanted if key in keys]
        if len(pick) == len(wanted):
            there = (other.weight[..., pick] > 0.0) | (rows.weight == 0.0)
            return np.asarray(other.z[..., pick] - other.correction[..., pick]), np.asarray(there)
    return None, None


def _paired_elevation(m: Array, azimuth: Array, a: Point) -> Row:
    """Return [sin E cos A, sin E sin A, -cos E] . (x - s) = 0 in the station's axes; its error is range times n_E."""
    local = (np.sin(m) * np.cos(azimuth), np.sin(m) * np.sin(azimuth), -np.cos(m))
    basis = a.axes or tuple(tuple(float(i == j) for j in range(3)) for i in range(3))
    normal = [sum(local[i] * basis[i][c] for i in range(3)) for c in range(3)]
    place = np.stack(np.broadcast_arrays(*a.position), axis=-1)
    row = np.stack(np.broadcast_arrays(*normal), axis=-1)

    def factor(point: Array | None) -> Array:
        return np.ones(1) if point is None else np.asarray(np.linalg.norm(point[:, None] - place, axis=-1))

    return np.concatenate([row, np.zeros((*row.shape[:-1], 1))], axis=-1), (row * place).sum(-1), factor


def _substituted(
    lifted: LiftedRow, rows: Rows, a: Point, b: Point, found: Ranges | None, to: Coordinates
) -> Row | None:
    """Return a lifted row with its ranges replaced by c + sign t, or None where a range stays unknown."""
    d = len(a.position)

    def factor(point: Array | None) -> Array:
        if point is None:
            return np.ones(1)
        return np.asarray(lifted.factor(Point(tuple(point[:, None, c] for c in range(d))), a, b))

    shape = np.broadcast_shapes(*(np.shape(v) for v in (*a.position, lifted.ra, lifted.rb, lifted.constant)))
    x = [np.broadcast_to(v, shape) for v in (lifted.x or (0.0,) * d)]
    last, constant = np.zeros(shape), np.broadcast_to(lifted.constant, shape)
    terms = [(c, index) for c, index in ((lifted.ra, rows.a), (lifted.rb, rows.b)) if np.any(c != 0.0)]
    if terms and found is None:
        return _squared_ratio(lifted, a, b, factor) if lifted.x is None else None
    for coefficient, index in terms:
        assert found is not None
        node = [_node(found, int(s), int(e)) for s, e in zip(index, rows.epoch, strict=True)]
        if min(node) < 0:
            return None
        last = last + coefficient * found.sign[:, node] * to.on_cone
        constant = constant + coefficient * found.offset[:, node] / to.scale[:, None]
    return np.stack([*x, last], axis=-1), -constant, factor


def _node(found: Ranges, station: int, epoch: int) -> int:
    at = np.flatnonzero((found.station == station) & ((found.epoch == epoch) | (found.epoch.max(initial=0) == 0)))
    return int(at[0]) if len(at) and found.inside[:, at[0]].all() else -1


def _squared_ratio(lifted: LiftedRow, a: Point, b: Point, factor: Factor) -> Row:
    """Square ``ra r_a + rb r_b = 0``: linear in (x, |x|^2)."""
    p, q = np.asarray(lifted.ra) ** 2, np.asarray(lifted.rb) ** 2
    at_a, at_b = (sum(v * v for v in point.position) for point in (a, b))
    x = [-2.0 * (p * u - q * v) for u, v in zip(a.position, b.position, strict=True)]

    def squared(point: Array | None) -> Array:
        if point is None:
            return np.ones(1)
        r_b = np.sqrt(sum((point[:, None, c] - v) ** 2 for c, v in enumerate(b.position)))
        return np.asarray(2.0 * np.sqrt(q) * r_b * np.abs(factor(point)))

    return np.stack(np.broadcast_arrays(*x, p - q), axis=-1), np.asarray(q * at_b - p * at_a), squared
