"""Random problems with one constraint, and a judge that samples the admitted positions without any code of optloc."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from optloc import Status, assemble, constraints, measured, solve


@dataclass(frozen=True)
class Case:
    """One problem and, written apart: its cost, and by how many metres points break its constraint."""

    problem: object
    cost: Callable
    outside: Callable
    low: np.ndarray
    high: np.ndarray
    sigma: float


def drawn(rng, d):
    """Return stations, the truth, rows and the cost of a problem of ranges, differences of ranges, or bearings."""
    count = int(rng.integers(4, 7)) + (d == 3)
    stations = rng.uniform(0.0, 1000.0, (count, d))
    if d == 3:
        stations[:, 2] = rng.uniform(0.0, 300.0, count)
    truth = np.append(rng.uniform(0.0, 1000.0, 2), rng.uniform(20.0, 300.0, d - 2))
    sigma, angle = rng.uniform(4.0, 20.0), rng.uniform(0.005, 0.03)
    kinds = [("range",), ("tdoa",), ("tdoa", "azimuth"), ("range", "azimuth"), ("azimuth",)][
        rng.integers(5 if d == 2 else 3)
    ]
    rows, parts = [], []
    for kind in kinds:
        if kind == "tdoa":
            a, b = np.arange(1, count), np.zeros(count - 1, dtype=int)
            z = _ranges(truth[None], stations)[0]
            z = z[a] - z[b] + sigma * rng.standard_normal(count - 1)
            rows.append(measured("tdoa", z, a=a, b=b, sigma=sigma))
            parts.append(lambda p, z=z: ((z - _ranges(p, stations)[:, 1:] + _ranges(p, stations)[:, :1]) / sigma) ** 2)
        elif kind == "range":
            few = np.arange(count if len(kinds) == 1 else 2)
            z = _ranges(truth[None], stations)[0, few] + sigma * rng.standard_normal(len(few))
            rows.append(measured("range", z, a=few, sigma=sigma))
            parts.append(lambda p, z=z, few=few: ((z - _ranges(p, stations)[:, few]) / sigma) ** 2)
        else:
            few = np.arange(count if len(kinds) == 1 else 2)
            z = _azimuths(truth[None], stations)[0, few] + angle * rng.standard_normal(len(few))
            rows.append(measured("azimuth", z, a=few, sigma=angle))

            def squares(p, z=z, few=few):
                off = z - _azimuths(p, stations)[:, few]
                return ((np.mod(off + np.pi, 2.0 * np.pi) - np.pi) / angle) ** 2

            parts.append(squares)
    return stations, truth, rows, lambda p: sum(part(p).sum(1) for part in parts)


def _ranges(points, stations):
    return np.sqrt(((points[:, None] - stations) ** 2).sum(-1))


def _azimuths(points, stations):
    line = points[:, None] - stations
    return np.arctan2(line[..., 1], line[..., 0])


def _near(rng, truth, size=40.0):
    """Return a random point of the plan, a few standard deviations from the truth."""
    return truth[:2] + size * rng.standard_normal(2)


def _circle(rng, truth, out):
    """Return the centre and the radius of a circle in the plan whose rim is near the truth."""
    radius = float(rng.uniform(20.0, 250.0))
    way = _unit(rng, 2)
    return truth[:2] + way * (radius + rng.uniform(-25.0, 35.0) * (-1.0 if out else 1.0)), radius


def _unit(rng, d):
    way = rng.standard_normal(d)
    return way / np.sqrt((way**2).sum())


def _plan(point):
    return lambda p: np.sqrt(((p[:, :2] - point) ** 2).sum(1))


def half_plane(rng, truth):
    normal = _unit(rng, len(truth))
    offset = float(normal @ truth + rng.uniform(-30.0, 20.0))
    return constraints.half_plane(3.0 * normal, 3.0 * offset), lambda p: p @ normal - offset


def band(rng, truth):
    normal = _unit(rng, len(truth))
    low = float(normal @ truth + rng.uniform(-60.0, 30.0))
    high = low + float(rng.uniform(5.0, 40.0))
    return constraints.band(normal, low, high), lambda p: np.maximum(p @ normal - high, low - p @ normal)


def disc(rng, truth):
    centre, radius = _circle(rng, truth, False)
    return constraints.disc(centre, radius), lambda p: _plan(centre)(p) - radius


def annulus(rng, truth):
    centre, outer = _circle(rng, truth, False)
    inner = outer - float(rng.uniform(4.0, 19.0))
    return constraints.annulus(centre, inner, outer), lambda p: np.maximum(
        _plan(centre)(p) - outer, inner - _plan(centre)(p)
    )


def keep_out_disc(rng, truth):
    centre, radius = _circle(rng, truth, True)
    return constraints.keep_out_disc(centre, radius), lambda p: radius - _plan(centre)(p)


def ball(rng, truth):
    radius = float(rng.uniform(20.0, 250.0))
    centre = truth + _unit(rng, len(truth)) * (radius + rng.uniform(-25.0, 35.0))
    return constraints.ball(centre, radius), lambda p: np.sqrt(((p - centre) ** 2).sum(1)) - radius


def keep_out_ball(rng, truth):
    radius = float(rng.uniform(20.0, 150.0))
    centre = truth + _unit(rng, len(truth)) * (radius + rng.uniform(-35.0, 25.0))
    return constraints.keep_out_ball(centre, radius), lambda p: radius - np.sqrt(((p - centre) ** 2).sum(1))


def _ring(rng, truth):
    """Return the corners of a simple polygon that need not be convex: a star around a point near the truth."""
    count = int(rng.integers(3, 7))
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, count))
    while np.diff([*angle, angle[0] + 2.0 * np.pi]).max() > 0.95 * np.pi:
        angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, count))
    reach = rng.uniform(15.0, 120.0, count)
    corners = _near(rng, truth) + reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return corners if rng.random() < 0.5 else corners[::-1]


def _depth(corners, p):
    """Return how deep points are in a polygon, metres: positive inside, by winding numbers."""
    a, b = corners, np.roll(corners, -1, axis=0)
    to, on = a - p[:, None, :2], b - p[:, None, :2]
    turn = np.arctan2(to[..., 0] * on[..., 1] - to[..., 1] * on[..., 0], (to * on).sum(-1)).sum(1)
    return np.where(np.abs(turn) > np.pi, 1.0, -1.0) * _from_line(a, b, p[:, :2])


def _from_line(a, b, p):
    """Return the distances of points from the nearest of several segments, metres."""
    along = b - a
    share = np.clip(((p[:, None] - a) * along).sum(-1) / (along**2).sum(-1), 0.0, 1.0)
    return np.sqrt(((p[:, None] - a - share[..., None] * along) ** 2).sum(-1)).min(1)


def polygon(rng, truth):
    corners = _ring(rng, truth)
    return constraints.polygon(corners), lambda p: -_depth(corners, p)


def keep_out_polygon(rng, truth):
    corners = _ring(rng, truth)
    return constraints.keep_out_polygon(corners), lambda p: _depth(corners, p)


def polyhedron(rng, truth):
    count = int(rng.integers(2, 5)) + len(truth) - 2
    normals = np.array([_unit(rng, len(truth)) for _ in range(count)])
    inner = truth + 30.0 * rng.standard_normal(len(truth))
    offsets = normals @ inner + rng.uniform(5.0, 60.0, count)
    return constraints.polyhedron(normals, offsets), lambda p: (p @ normals.T - offsets).max(1)


def polyline(rng, truth):
    count, width = int(rng.integers(2, 6)), float(rng.uniform(2.0, 20.0))
    start = _near(rng, truth, 150.0)
    points = start + np.cumsum(rng.uniform(-200.0, 200.0, (count, 2)), axis=0)
    points += _near(rng, truth, 30.0) - points[count // 2]
    return constraints.polyline(points, width), lambda p: _from_line(points[:-1], points[1:], p[:, :2]) - width


def road_in_space(rng, truth):
    count, width = int(rng.integers(2, 5)), float(rng.uniform(3.0, 20.0))
    points = np.cumsum(rng.uniform(-200.0, 200.0, (count, 3)), axis=0)
    points += truth + 30.0 * rng.standard_normal(3) - points[count // 2]
    return constraints.polyline(points, width), lambda p: _from_line(points[:-1], points[1:], p) - width


def any_of(rng, truth):
    """Return a union of two to four regions of several kinds, some of which have corners."""
    from optloc.base.types import AnyOf

    makers, members, outside = [disc, half_plane, polyhedron, annulus], [], []
    for _ in range(int(rng.integers(2, 5))):
        member, depth = makers[rng.integers(4)](
            rng, truth + np.append(60.0 * rng.standard_normal(2), [0.0] * (len(truth) - 2))
        )
        members.append(tuple(member))
        outside.append(depth)
    return (AnyOf(tuple(members)),), lambda p: np.min([depth(p) for depth in outside], axis=0)


def _ground(rng):
    """Return the axes and the heights of a hilly ground, and its height as a function, by another spline."""
    from scipy.interpolate import RectBivariateSpline

    x, y = np.linspace(-400.0, 1400.0, 19), np.linspace(-300.0, 1300.0, 17)
    waves = [(rng.uniform(0.002, 0.012, 2), rng.uniform(0.0, 6.0), rng.uniform(10.0, 60.0)) for _ in range(3)]
    height = 80.0 + sum(h * np.sin(w[0] * x[:, None] + w[1] * y + phase) for w, phase, h in waves)
    spline = RectBivariateSpline(x, y, height, s=0)
    return x, y, height, lambda p: spline.ev(np.clip(p[:, 0], x[0], x[-1]), np.clip(p[:, 1], y[0], y[-1]))


def above_terrain(rng, truth):
    x, y, height, at = _ground(rng)
    low = float(truth[2] - at(truth[None])[0] + rng.uniform(-20.0, 30.0))
    high = low + float(rng.uniform(5.0, 60.0))
    return constraints.terrain(x, y, height, lower=low, upper=high), lambda p: np.maximum(
        p[:, 2] - at(p) - high, low - p[:, 2] + at(p)
    )


def keep_out_and_box(rng, truth):
    """Return two keep-out discs in a box: corners of curved and plane bounds."""
    first, one = keep_out_disc(rng, truth)
    second, two = keep_out_disc(rng, truth)
    low, high = truth[:2] - rng.uniform(5.0, 60.0, 2), truth[:2] + rng.uniform(5.0, 60.0, 2)
    box = constraints.box(low, high)
    return (*first, *second, *box), lambda p: np.max(
        [one(p), two(p), (p[:, :2] - high).max(1), (low - p[:, :2]).max(1)], axis=0
    )


PLANE = {
    maker.__name__: maker
    for maker in (
        half_plane,
        band,
        disc,
        annulus,
        keep_out_disc,
        ball,
        keep_out_ball,
        polygon,
        keep_out_polygon,
        polyhedron,
        polyline,
        any_of,
        keep_out_and_box,
    )
}
SPACE = {
    f"{maker.__name__} in space": maker
    for maker in (
        half_plane,
        disc,
        keep_out_disc,
        ball,
        keep_out_ball,
        keep_out_polygon,
        polyhedron,
        polyline,
        road_in_space,
        above_terrain,
        any_of,
    )
}
ALL = {name: (maker, 2) for name, maker in PLANE.items()} | {name: (maker, 3) for name, maker in SPACE.items()}


def case_of(name, seed):
    """Return a random problem with the named constraint."""
    maker, d = ALL[name]
    rng = np.random.default_rng([seed, sum(map(ord, name))])
    stations, truth, rows, cost = drawn(rng, d)
    limits, outside = maker(rng, truth)
    low, high = np.minimum(stations.min(0), truth) - 400.0, np.maximum(stations.max(0), truth) + 400.0
    return Case(assemble(stations, *rows, constraints=limits), cost, outside, low, high, 10.0)


def best_by_sampling(case, rng, grid=None, count=None, nodes=None):
    """Return the least cost and the point found by sampling the admitted points ever more finely.

    The samples are a grid, and around its best separate points finer ones, each a little smaller than the last.
    """
    d = len(case.low)
    grid, count, nodes = grid or (150 if d == 2 else 34), count or 8, nodes or (13 if d == 2 else 7)
    axes = [np.linspace(a, b, grid) for a, b in zip(case.low, case.high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, d)
    # a thin region has no point of the grid: every point is moved to it along the way that its own depth shows
    value, good = case.cost(points), case.outside(points) <= 0.0
    step = (case.high - case.low) / (grid - 1)
    if not (good.sum() > 50):
        points = _moved_inside(case, points[case.outside(points) < 3.0 * step.max()])
        value, good = case.cost(points), case.outside(points) <= 0.0
    points, value = points[good], value[good]
    best, where = np.inf, None
    offsets = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, nodes)] * d, indexing="ij"), axis=-1).reshape(-1, d)
    for _ in range(count):
        if not len(value):
            break
        first = int(value.argmin())
        here, least, size = points[first], value[first], 2.0 * step
        far = np.abs(points - here).max(1) > 3.0 * step.max()
        points, value = points[far], value[far]
        while size.max() > 1e-8:
            around = here + size * offsets * rng.uniform(0.5, 1.0)
            around = np.concatenate([around, _moved_inside(case, around)])
            costs = np.where(case.outside(around) <= 0.0, case.cost(around), np.inf)
            k = int(costs.argmin())
            if costs[k] < least:
                moved = np.abs(around[k] - here) / size
                here, least = around[k], costs[k]
                size = size * (1.0 if moved.max() > 0.7 else 0.6)
            else:
                size = size * 0.5
        if least < best:
            best, where = float(least), here
    return best, where


def _moved_inside(case, points):
    """Return points moved by Newton steps to the boundary where they are outside, with slopes by differences."""
    points = np.array(points)
    for _ in range(6):
        off = case.outside(points)
        out = off > 0.0
        if not out.any():
            break
        p, h = points[out], 1e-5
        slope = np.stack([(case.outside(p + h * e) - off[out]) / h for e in np.eye(p.shape[1])], axis=1)
        size = np.maximum((slope**2).sum(1), 1e-12)
        points[out] = p - ((off[out] + 1e-9) / size)[:, None] * slope
    return points


def is_local_minimum(case, point, rng, radius=1e-3):
    """Return whether no admitted sample close to a point costs less than it."""
    d = len(point)
    ways = rng.standard_normal((4000, d))
    ways *= radius * rng.random((4000, 1)) / np.sqrt((ways**2).sum(1, keepdims=True))
    around = point + ways
    around = np.concatenate([around, _moved_inside(case, around)])
    costs = np.where(case.outside(around) <= 1e-9, case.cost(around), np.inf)
    here = float(case.cost(point[None])[0])
    # the point itself may be outside by the tolerance, and its cost lower by the slope times it
    return bool(costs.min() >= here - 1e-7 * (1.0 + here))


def others_of(fix):
    """Return the positions of the alternatives of one fix."""
    x = np.asarray(fix.alternatives.x)[..., : fix.position.shape[-1]].reshape(-1, fix.position.shape[-1])
    return x[np.isfinite(x).all(-1)]


def verdict(name, seed, method="auto"):
    """Return what is wrong with the fix of one random problem: "" for nothing; and whether a bound was active."""
    case = case_of(name, seed)
    rng = np.random.default_rng(seed)
    best, where = best_by_sampling(case, rng)
    fix = solve(case.problem, method)
    x = fix.position
    if not np.isfinite(x).all():
        # the sampling is bounded: a cost that keeps falling beyond it is right to have no position
        escapes = fix.status == Status.UNBOUNDED and float(fix.cost) < best
        return ("" if where is None or escapes else f"no position ({fix.status}) with {best:.6g} at {where}"), False
    cost, off = float(case.cost(x[None])[0]), float(case.outside(x[None])[0])
    active = bool(fix.active[()])
    wrong = []
    if off > 1e-6 * 1000.0:
        wrong.append(f"outside by {off:.3g} m")
    if cost > best * (1.0 + 1e-6) + 1e-6:
        wrong.append(f"missed: {cost:.9g} at {x}, {best:.9g} at {where} ({fix.status}, {fix.active[()]})")
    if fix.status == Status.AMBIGUOUS:
        false = [other for other in others_of(fix) if not is_local_minimum(case, other, rng)]
        wrong += [f"no minimum: alternative {other}" for other in false]
    return "; ".join(wrong), active
