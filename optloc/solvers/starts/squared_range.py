"""From rows of any kind to squared-range rows: linear in (x, t) on a cone, or in (x, |x|^2) on a paraboloid.

If all ranges share an unknown, t is the range to the reference station, and ``t = |x|`` is a cone. If ranges are known,
the last unknown is |x|^2. Both surfaces are quadrics.

A *lifted* row is a row of a kind without ranges, such as a bearing, in linear form in the same unknowns. A *node* is
the position of a station at an epoch. A *whitening* matrix W turns correlated rows into rows with unit covariance.

Letters: N problems, m rows, s stations with ranges, n = d + 1 unknowns y, d coordinates, q points of a problem. The
range of station i is r_i = c_i + sign_i t. A squared-range problem is ``rows . y = right`` in least squares, with y on
the quadric: rows (N, m, n), right (N, m). `found` are the least-squares ranges of the problems: c_i is their offset.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from formulations.squared_range import Quadric, cone, minimiser, paraboloid, stationary
from optloc.base import linalg
from optloc.base.linalg import centre_and_spread
from optloc.base.threads import WORTH, map_on_threads
from optloc.base.types import Array, Rows
from optloc.engine.lifts import KnownLift, LiftEntry, azimuths_beside, enter, pair_elevation
from optloc.linear.least_squares_ranges import Ranges
from optloc.models import MODELS, Point
from optloc.problem.noise import variances
from optloc.problem.problem import Problem

Factor = Callable[[Array | None], Array]
"""Maps points (N, d), or None, to the error of a row per unit of error of its measurement, (N, m)."""

# Least scaled distance, and least factor, for the weight of a row. Otherwise a point on a station, or on the singular
# line of a bearing, would give one row all the weight. No start needs an accuracy of a thousandth of the network.
_NEAR = 1e-3

# Rounding error of equal costs, as a share of the squares of the right sides.
_ALIKE = 1e-12

Pick = Callable[[Array, Array, Quadric], tuple[Array, Array]]
"""Maps rows (N, m, n), right sides (N, m) and the quadric to points (N, q, n), and flags (N, q) of valid ones."""


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
        One row for each station; zero for a station without one.
    whiten : array (N or 1, s, s)
        Whitening matrix of the least-squares ranges, 1/metres.
    place : array (N, s, d)
        Scaled positions of the stations of `ranged`.
    others : tuple of LiftedRows
        Rows of other kinds.
    """

    quadric: Quadric
    origin: Array
    scale: Array
    ranged: Array
    ranged_right: Array
    whiten: Array
    place: Array
    others: tuple[LiftedRows, ...]


def candidates(problem: Problem, found: Ranges | None, pick: Pick) -> Array:
    """Return starting positions (N, q, d) of a flat batch of problems with one static target; NaN in empty slots.

    There are two weightings. The first gives all ranges equal weight. The second divides by twice the ranges to the
    first point, which turns the error of a squared range into the error of a range.

    Parameters
    ----------
    problem : Problem
        N problems.
    found : Ranges, optional
        Its least-squares ranges.
    pick : callable
        Selects points of a squared-range problem: `minimum`, `stationary_points`, `shor` or `hull`.

    References
    ----------
    A. Beck, P. Stoica, J. Li, "Exact and approximate solutions of source localization problems", IEEE Trans.
    Signal Process. 56 (2008), section IV for range differences.
    """
    squared = squared_rows(problem, found)
    first, distance, point = _first_pass(squared, pick)
    second = _pick(squared, distance, point, pick)
    # the two weightings have different stationary points; for a single point the second weighting is enough
    points = np.concatenate([second, first], axis=1) if pick is stationary_points else second
    return points * squared.scale[:, None, None] + squared.origin[:, None, :]


def _first_pass(squared: Squared, pick: Pick) -> tuple[Array, Array, Array]:
    """Return the points (N, q, d) of the first weighting, and distances (N, s) and points (N, d) for the second one."""
    first = _pick(squared, np.ones(squared.ranged_right.shape), None, pick)
    point = np.where(np.isfinite(first[:, 0]), first[:, 0], 0.0)
    distance = np.maximum(np.sqrt(((point[:, None, :] - squared.place) ** 2).sum(-1)), _NEAR)
    return first, distance, point


def last_weighting(problem: Problem, found: Ranges | None, pick: Pick) -> tuple[Squared, Array, Array]:
    """Return the squared-range problem whose solutions `candidates` returns; arguments as of `candidates`.

    Returns
    -------
    squared : Squared
        Coordinates and quadric.
    rows : array (N, m, n)
        Whitened rows of the second weighting.
    right : array (N, m)
        Their right sides.
    """
    squared = squared_rows(problem, found)
    _, distance, point = _first_pass(squared, pick)
    return squared, *_weigh(squared, distance, point)


def _pick(squared: Squared, distance: Array, point: Array | None, pick: Pick) -> Array:
    """Return the picked points (N, q, d), scaled, of the rows weighted by distances (N, s).

    `point` (N, d) is an approximate position for the weights of other rows; None means one scale away.
    """
    rows, right = _weigh(squared, distance, point)
    # with bearings only, no row contains the last coordinate, and the quadric would add false information
    linear = squared.quadric.shape == "paraboloid" and not rows[..., -1].any()
    y, valid = _linear(rows[..., :-1], right) if linear else pick(rows, right, squared.quadric)
    return np.where(valid[..., None], y[..., :-1], np.nan)


def minimum(rows: Array, right: Array, quadric: Quadric) -> tuple[Array, Array]:
    """Return the exact minimisers (N, 1 or 2, n) of squared-range problems, and flags (N, 1 or 2) of valid ones.

    A minimal set of rows has two points that fit equally well.
    """
    positive = quadric.shape == "cone"
    y, ok = minimiser(rows, right, quadric, positive=positive)
    # with one row less than unknowns, the line of points that fit meets the quadric twice
    few = np.flatnonzero((rows != 0.0).any(-1).sum(-1) < quadric.size)
    if not len(few):
        return y[:, None], ok[:, None]
    both, valid = np.stack([y, np.full_like(y, np.nan)], axis=1), np.stack([ok, np.zeros_like(ok)], axis=1)
    points, cost, real = stationary(rows[few], right[few], quadric, positive=positive)
    more = _ALIKE * (1.0 + (right[few] ** 2).sum(-1, keepdims=True))
    both[few], valid[few] = points[:, :2], real[:, :2] & (cost[:, :2] <= cost[:, :1] + more)
    return both, valid


def stationary_points(rows: Array, right: Array, quadric: Quadric) -> tuple[Array, Array]:
    """Return all real stationary points (N, q, n), best first, of squared-range problems, and flags (N, q)."""
    y, _, valid = stationary(rows, right, quadric, positive=quadric.shape == "cone")
    return y, valid


def shor(rows: Array, right: Array, quadric: Quadric) -> tuple[Array, Array]:
    """Return the points (N, 3, n) of Shor's semidefinite relaxation, over threads: see `_one_by_one`."""
    from formulations.squared_range_conic import shor as relax

    return _one_by_one(relax, rows, right, quadric)


def hull(rows: Array, right: Array, quadric: Quadric) -> tuple[Array, Array]:
    """Return the points (N, 3, n) of the second-order cone relaxation, over threads: see `_one_by_one`."""
    from formulations.squared_range_conic import hull as relax

    return _one_by_one(relax, rows, right, quadric)


def _one_by_one(relax: Callable[..., Any], rows: Array, right: Array, quadric: Quadric) -> tuple[Array, Array]:
    """Return three points (N, 3, n) of a relaxation for each problem, and flags (N, 3) of valid ones.

    The first is the relaxed point. If the solution is not unique, the others are the points of the quadric on both
    sides of it. `relax` solves one problem.
    """
    # problems with missing data are skipped
    usable = np.isfinite(rows).all((-1, -2)) & np.isfinite(right).all(-1)
    y = np.full((len(rows), 3, quadric.size), np.nan)

    def solve_one(i: int) -> None:
        found = relax(rows[i], right[i], quadric, bound=False)
        y[i, 0], y[i, 1:] = found.y, found.points

    map_on_threads(solve_one, np.flatnonzero(usable).tolist(), least=WORTH)
    return y, np.isfinite(y).all(-1)


def _linear(rows: Array, right: Array) -> tuple[Array, Array]:
    """Return the plain least-squares points (N, 1, n) of rows without ranges, and flags (N, 1) of valid ones.

    The last entry of a point, which no row contains, is zero.
    """
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
        # the apex of the cone is the reference station: t is the distance from the origin
        origin = place[np.arange(size), found.reference]
    if found is not None and not on_cone:
        # If ranges are much longer than the network, they set the scale, so that the unknowns are of order one.
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
    """Return the positions (N, s, d), metres, of the nodes with ranges, and flags (N, s) of nodes in use.

    Without ranges the result has all stations with rows, at the first epoch.
    """
    position = np.broadcast_to(
        problem.stations.position, (problem.batch_shape[0], *problem.stations.position.shape[-3:])
    )
    if found is None:
        used = sorted({int(s) for rows in problem.rows for s in (*rows.a, *rows.b) if s >= 0})
        used = used or list(range(problem.stations.count))  # heights alone have no stations, and are no start
        nodes = position[:, 0, used]
        return nodes, np.ones(nodes.shape[:2], dtype=bool)
    return position[:, found.epoch, found.station], found.inside


def _range_rows(found: Ranges, place: Array, scale: Array, on_cone: bool) -> tuple[Array, Array]:
    """Return squared rows (N, s, n) of the ranges r_i = c_i + sign_i t, and their right sides (N, s).

    ``|x - place_i|^2 = r_i^2`` contains |x|^2. On the cone this cancels with t^2; on the paraboloid it is the last
    unknown. Rows without a range are zero. `place` is scaled.
    """
    c = found.offset / scale[:, None]
    squares = (place**2).sum(-1)
    usable = found.inside
    if on_cone:
        # the row of the reference is t = t
        usable = usable & (found.sign != 0) & (np.arange(place.shape[1]) != found.reference[:, None])
        rows = np.concatenate([2.0 * place, (2.0 * found.sign * c)[..., None]], axis=-1)
        right = squares - c**2
    else:
        rows = np.concatenate([-2.0 * place, np.ones((*c.shape, 1))], axis=-1)
        right = c**2 - squares
    return np.where(usable[..., None], rows, 0.0), np.where(usable, right, 0.0)


def _weigh(squared: Squared, distance: Array, point: Array | None) -> tuple[Array, Array]:
    """Return rows (N, m, n) and right sides (N, m), each divided by its standard deviation at an approximate point.

    `distance` (N, s) are scaled ranges for the weights, and `point` (N, d) the scaled point, None for one scale away.
    """
    # d(r^2) = 2 r dr: divided by twice the range, a squared range has the error of the range, here in metres
    factor = 0.5 * squared.scale[:, None] / distance
    stacked = np.concatenate([squared.ranged, squared.ranged_right[..., None]], axis=-1)
    parts = [squared.whiten @ (factor[..., None] * stacked)]
    for other in squared.others:
        error = np.maximum(np.abs(other.factor(point)), _NEAR) * other.sigma
        parts.append(np.concatenate([other.row, other.right[..., None]], axis=-1) / error[..., None])
    joined = np.concatenate([np.broadcast_to(p, (len(distance), *p.shape[-2:])) for p in parts], axis=-2)
    return joined[..., :-1], joined[..., -1]


# Rows of other kinds than ranges: bearings and gain ratios are linear in the same coordinates.


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
class LiftedRows:
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
        Maps points (N, d), or None for "one scale away", to the error of the row per unit of measurement error (N, m).
    """

    row: Array
    right: Array
    sigma: Array
    factor: Factor


def lift_rows(problem: Problem, rows: Rows, start: int, found: Ranges | None, to: Coordinates) -> LiftedRows | None:
    """Return the linear rows of one kind, or None if it has no linear form.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems.
    rows : Rows
        Rows of one kind.
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
    m, paired = rows.z - rows.correction, None
    # row number of the azimuth of each elevation; None if one of them has no azimuth
    beside = azimuths_beside(problem, rows) if rows.kind == "elevation" else None
    if beside is not None:
        # an absent elevation counts as present, since it needs no azimuth
        paired = (problem.weight[..., beside] > 0.0) | (rows.weight == 0.0)
        # Without ranges the paired form is the only linear one. With ranges it is used only if every elevation has its
        # azimuth.
        paired = paired if found is None or bool(np.all(paired)) else None
    if paired is not None:
        entry: LiftEntry | None = pair_elevation(m, problem.observed[..., beside], a)
    else:
        known = None if found is None else _known(found, rows, to)
        entry = enter(model, m, a, b, known)
        if known is not None and entry is not None and _stays_unknown(entry, known):
            return None
    if entry is None:
        return None
    size = problem.batch_shape[0]
    row, right = (
        _as_columns([*entry.x, entry.last], size, rows.count),
        _as_columns([entry.right], size, rows.count)[..., 0],
    )
    weight = np.broadcast_to(rows.weight, right.shape)
    present = (weight > 0.0) & (True if paired is None else paired)
    sigma = np.sqrt(variances(problem.noise, problem.count)[..., start : start + rows.count])
    # a row of weight w counts like one of variance sigma^2 / w; absent rows have zero coefficients
    sigma = sigma / np.sqrt(np.where(present, weight, 1.0))

    def factor(point: Array | None) -> Array:
        if point is None:
            return np.ones(1)
        return np.asarray(entry.factor(Point(tuple(point[:, None, c] for c in range(point.shape[-1])))))

    return LiftedRows(np.where(present[..., None], row, 0.0), np.where(present, right, 0.0), sigma, factor)


def _as_columns(parts: list[Any], size: int, count: int) -> Array:
    """Return scalars and arrays as the last axis of one array (N, m, parts); `size` is N and `count` is m."""
    return np.stack([np.broadcast_to(part, (size, count)) for part in parts], axis=-1)


def _point(problem: Problem, rows: Rows, index: Array, to: Coordinates) -> Point:
    """Return the scaled positions and axes of the stations `index` (m,) of rows, component by component."""
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


def _stays_unknown(entry: LiftEntry, known: tuple[KnownLift, KnownLift]) -> bool:
    """Return whether a row contains a range that is unknown even up to t: it then has no linear form.

    `entry` is the linear form of the rows, and `known` has the ranges at their two stations.
    """
    lost = np.isnan(known[0].sign) | np.isnan(known[1].sign)
    return bool((np.isnan(entry.last) & lost).any())


def _known(found: Ranges, rows: Rows, to: Coordinates) -> tuple[KnownLift, KnownLift]:
    """Return the scaled ranges at the stations a and b of rows; NaN for an unknown range."""
    both = []
    for index in (rows.a, rows.b):
        node = np.array([_node(found, int(s), int(e)) for s, e in zip(index, rows.epoch, strict=True)])
        offset = np.where(node >= 0, found.offset[:, node], np.nan) / to.scale[:, None]
        # on the paraboloid ranges are known (sign 0), and the last coordinate is not a range
        both.append(KnownLift(offset, np.where(node >= 0, found.sign[:, node] * to.on_cone, np.nan)))
    return both[0], both[1]


def _node(found: Ranges, station: int, epoch: int) -> int:
    """Return the index of a station and epoch among the ranges; -1 if some problem lacks its range."""
    at = np.flatnonzero((found.station == station) & ((found.epoch == epoch) | (found.epoch.max(initial=0) == 0)))
    return int(at[0]) if len(at) and found.inside[:, at[0]].all() else -1
