"""From rows of any kind to squared-range rows: linear in (x, t) on a cone, or in (x, |x|^2) on a paraboloid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from formulations.squared_range import Quadric, cone, minimiser, paraboloid, stationary
from optloc.base import linalg
from optloc.base.linalg import centre_and_spread
from optloc.base.threads import WORTH, mapped
from optloc.base.types import Array, Rows
from optloc.models import MODELS, LiftedRow, Point, lifted_row
from optloc.problem.noise import variances
from optloc.problem.problem import Problem
from optloc.solvers.starts.least_squares_ranges import Ranges

Factor = Callable[[Array | None], Array]
"""Maps points (N, d), or None, to the error of a row per unit of error of its measurement, (N, m)."""

Row = tuple[Array, Array, Factor]
"""Coefficients (N or 1, m, d + 1), right sides (N or 1, m), and factor of the rows of one kind."""

# Scaled distance, and factor, below which a row is weighed as if it were there: an answer on a station, or on the line
# of a bearing's singularity, must not give one row all the weight. A thousandth of the network is nearer than any start
# has to be right.
_NEAR = 1e-3

Pick = Callable[[Array, Array, Quadric], tuple[Array, Array]]
"""Maps rows (N, m, n), right sides (N, m) and the quadric to points (N, q, n), and which of them exist (N, q)."""


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
    first = _pick(squared, np.ones(squared.ranged_right.shape), None, pick)
    point = np.where(np.isfinite(first[:, 0]), first[:, 0], 0.0)
    distance = np.maximum(np.sqrt(((point[:, None, :] - squared.place) ** 2).sum(-1)), _NEAR)
    second = _pick(squared, distance, point, pick)
    # both weightings have stationary points of their own; of a single answer the better weighted one is enough
    points = np.concatenate([second, first], axis=1) if pick is every else second
    return points * squared.scale[:, None, None] + squared.origin[:, None, :]


def _pick(squared: Squared, distance: Array, point: Array | None, pick: Pick) -> Array:
    rows, right = _weigh(squared, distance, point)
    # bearings alone: no row holds the last coordinate, and the quadric would only invent one
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
    # missing data: the solver is not asked
    usable = np.isfinite(rows).all((-1, -2)) & np.isfinite(right).all(-1)
    y = np.full((len(rows), 1, quadric.size), np.nan)

    def solve_one(i: int) -> None:
        y[i, 0] = relax(rows[i], right[i], quadric, bound=False).y

    mapped(solve_one, np.flatnonzero(usable).tolist(), least=WORTH)
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
    centre, spread = centre_and_spread(place, inside)
    origin = centre
    if on_cone:
        assert found is not None
        # the cone stands on the reference station: t is the distance from the origin
        origin = place[np.arange(size), found.reference]
    if found is not None and not on_cone:
        # ranges much longer than the network: the unknowns are of their size, and numbers of order one are wanted
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
        if (other := lift_rows(problem, rows, start, found, Coordinates(origin, scale, on_cone))) is not None
    )
    return Squared(quadric, origin, scale, ranged, right, whiten, place, others)


def _station_nodes(problem: Problem, found: Ranges | None) -> tuple[Array, Array]:
    position = np.broadcast_to(
        problem.stations.position, (problem.batch_shape[0], *problem.stations.position.shape[-3:])
    )
    if found is None:
        used = sorted({int(s) for rows in problem.rows for s in (*rows.a, *rows.b) if s >= 0})
        used = used or list(range(problem.stations.count))  # heights alone name none, and are no start
        nodes = position[:, 0, used]
        return nodes, np.ones(nodes.shape[:2], dtype=bool)
    return position[:, found.epoch, found.station], found.inside


def _range_rows(found: Ranges, place: Array, scale: Array, on_cone: bool) -> tuple[Array, Array]:
    """Square r_i = c_i + sign_i t: subtract t^2 = |y|^2 on the cone, keep |y|^2 as unknown on the paraboloid."""
    c = found.offset / scale[:, None]
    squares = (place**2).sum(-1)
    usable = found.inside
    if on_cone:
        # the reference's own row says t = t
        usable = usable & (found.sign != 0) & (np.arange(place.shape[1]) != found.reference[:, None])
        rows = np.concatenate([2.0 * place, (2.0 * found.sign * c)[..., None]], axis=-1)
        right = squares - c**2
    else:
        rows = np.concatenate([-2.0 * place, np.ones((*c.shape, 1))], axis=-1)
        right = c**2 - squares
    return np.where(usable[..., None], rows, 0.0), np.where(usable, right, 0.0)


def _weigh(squared: Squared, distance: Array, point: Array | None) -> tuple[Array, Array]:
    """Divide each row by the error it inherits from the measurements at an approximate point."""
    # d(r^2) = 2 r dr: over twice the range a squared range has the error of the range, here in metres
    factor = 0.5 * squared.scale[:, None] / distance
    stacked = np.concatenate([squared.ranged, squared.ranged_right[..., None]], axis=-1)
    parts = [squared.whiten @ (factor[..., None] * stacked)]
    for other in squared.others:
        error = np.maximum(np.abs(other.factor(point)), _NEAR) * other.sigma
        parts.append(np.concatenate([other.row, other.right[..., None]], axis=-1) / error[..., None])
    joined = np.concatenate([np.broadcast_to(p, (len(distance), *p.shape[-2:])) for p in parts], axis=-2)
    return joined[..., :-1], joined[..., -1]


# Rows of other kinds than ranges beside them: bearings and gain ratios are linear in the same coordinates.


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


def lift_rows(problem: Problem, rows: Rows, start: int, found: Ranges | None, to: Coordinates) -> Lifted | None:
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
    # without ranges the paired form is the only linear one; with some, only where every elevation has its azimuth
    if azimuth is not None and (found is None or bool(np.all(paired))):
        made: Row | None = _pair_elevation(m, azimuth, a)
    else:
        lifted = lifted_row(model, m, a, b)
        assert lifted is not None
        made, paired = _substitute(lifted, rows, a, b, found, to), None
    if made is None:
        return None
    row, right, factor = made
    size = problem.batch_shape[0]
    row, right = np.broadcast_to(row, (size, *row.shape[-2:])), np.broadcast_to(right, (size, right.shape[-1]))
    weight = np.broadcast_to(rows.weight, right.shape)
    present = (weight > 0.0) & (True if paired is None else paired)
    sigma = np.sqrt(variances(problem.noise, problem.count)[..., start : start + rows.count])
    # a row of weight w counts as one of variance sigma^2 / w; absent ones have zero coefficients
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


def _pair_elevation(m: Array, azimuth: Array, a: Point) -> Row:
    """Return [sin E cos A, sin E sin A, -cos E] . (x - s) = 0 in the station's axes; its error is range times n_E."""
    # the normal of the cone of elevation m in the measured azimuth: at right angles to the line of sight
    local = (np.sin(m) * np.cos(azimuth), np.sin(m) * np.sin(azimuth), -np.cos(m))
    basis = a.axes or tuple(tuple(float(i == j) for j in range(3)) for i in range(3))
    normal = [sum(local[i] * basis[i][c] for i in range(3)) for c in range(3)]
    place = np.stack(np.broadcast_arrays(*a.position), axis=-1)
    row = np.stack(np.broadcast_arrays(*normal), axis=-1)

    def factor(point: Array | None) -> Array:
        return np.ones(1) if point is None else np.asarray(np.linalg.norm(point[:, None] - place, axis=-1))

    return np.concatenate([row, np.zeros((*row.shape[:-1], 1))], axis=-1), (row * place).sum(-1), factor


def _substitute(lifted: LiftedRow, rows: Rows, a: Point, b: Point, found: Ranges | None, to: Coordinates) -> Row | None:
    """Return a lifted row with its ranges replaced by c + sign t, or None where a range stays unknown."""
    d = len(a.position)

    def factor(point: Array | None) -> Array:
        if point is None:
            return np.ones(1)
        return np.asarray(lifted.factor(Point(tuple(point[:, None, c] for c in range(d))), a, b))

    shape = np.broadcast_shapes(*(np.shape(v) for v in (*a.position, lifted.ra, lifted.rb, lifted.constant)))
    # a gain ratio has no term in x: only its ranges tell of the place
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
        # on the paraboloid ranges are known (sign 0), and the last coordinate is no range
        last = last + coefficient * found.sign[:, node] * to.on_cone
        constant = constant + coefficient * found.offset[:, node] / to.scale[:, None]
    return np.stack([*x, last], axis=-1), -constant, factor


def _node(found: Ranges, station: int, epoch: int) -> int:
    at = np.flatnonzero((found.station == station) & ((found.epoch == epoch) | (found.epoch.max(initial=0) == 0)))
    return int(at[0]) if len(at) and found.inside[:, at[0]].all() else -1


def _squared_ratio(lifted: LiftedRow, a: Point, b: Point, factor: Factor) -> Row:
    """Square ``ra r_a + rb r_b = 0``: linear in (x, |x|^2)."""
    # ra r_a = -rb r_b, so p r_a^2 = q r_b^2: exact, as both sides are positive; p = q is a plane
    p, q = np.asarray(lifted.ra) ** 2, np.asarray(lifted.rb) ** 2
    at_a, at_b = (sum(v * v for v in point.position) for point in (a, b))
    x = [-2.0 * (p * u - q * v) for u, v in zip(a.position, b.position, strict=True)]

    def squared_factor(point: Array | None) -> Array:
        if point is None:
            return np.ones(1)
        r_b = np.sqrt(sum((point[:, None, c] - v) ** 2 for c, v in enumerate(b.position)))
        # d(p r_a^2 - q r_b^2) = (sqrt p r_a + sqrt q r_b) d(...), and both terms are equal at the place
        return np.asarray(2.0 * np.sqrt(q) * r_b * np.abs(factor(point)))

    return np.stack(np.broadcast_arrays(*x, p - q), axis=-1), np.asarray(q * at_b - p * at_a), squared_factor
