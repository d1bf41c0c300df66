"""Boxes on the surface of a height: bounds of the surface, and of a cost along it, hold at every sampled point."""

import numpy as np
import pytest
from proof.sampling import many

from optloc import Frame, assemble, measured
from optloc.linear.constraints import height
from optloc.proof.box import cost_at, least_residual, linearise_rows
from optloc.proof.nodes.node import PHI, RANGE, SLOPE0
from optloc.proof.search_space import axes_of_next_piece, chart_on, cost_of, empty_box, is_bounded
from optloc.proof.surface import SAG, SIDES, SLIP
from optloc.solvers.certificates.position_cost import surfaces_of

pytestmark = pytest.mark.usefixtures("form")
EARTH = Frame("ecef")


def scene(rng, level):
    """Return the cost of arrival differences of four stations over a height, a place there, and its surface."""
    lat, lon = rng.uniform(-1.4, 1.4), rng.uniform(-3.1, 3.1)
    x = EARTH.from_geodetic(lat, lon, level)
    way = rng.standard_normal((4, 3))
    far = 10.0 ** rng.uniform(4.0, 7.3)  # from masts to navigation satellites
    stations = x / np.linalg.norm(x) * (np.linalg.norm(x) + far) + 0.5 * far * way
    K = np.hstack([-np.ones((3, 1)), np.eye(3)]) / 20.0
    w = K @ np.linalg.norm(stations - x, axis=-1)
    rows = measured("tdoa", a=[1, 2, 3], b=0, sigma=20.0)
    problem = assemble(stations, rows, frame=EARTH, constraints=height(exactly=level))
    surface = surfaces_of(problem.flat(), x[None])[1][0]
    return cost_of(np.full(4, RANGE), stations.copy(), K, w), x, surface


def on_surface(chart, centre, level, rng, half, sense, count):
    """Return points of a surface above those of a box in its chart's plane."""
    up = chart.surface[-3:]
    s = rng.uniform(-1.0, 1.0, (count, 2)) * half[:2]
    s[: count // 5] = np.sign(s[: count // 5]) * half[:2]
    points = centre + s @ sense[:, :2].T
    for _ in range(50):  # Newton's steps along the upward axis, by the package's own heights
        h = EARTH.to_geodetic(points)[2]
        ahead = EARTH.to_geodetic(points + 1.0 * up)[2]
        points = points - ((h - level) / (ahead - h))[:, None] * up
    return s, points


@pytest.mark.parametrize("level", [0.0, 800e3])
def test_no_point_of_the_surface_leaves_what_is_said_of_it(level):
    rng = np.random.default_rng(3)
    laid = 0
    for _ in range(many(300, 30)):
        cost, x, surface = scene(rng, level)
        box = empty_box(3, 4)
        around, good = chart_on(cost, x, box, np.empty((0, 3)), surface)
        assert good
        chart = axes_of_next_piece(cost, around, int(rng.integers(1, SIDES)))
        box.at[:2], box.at[2] = rng.uniform(-0.6, 0.6, 2), 0.0
        box.half[:2], box.half[2] = 0.3 * 10.0 ** rng.uniform(-3.0, 0.0, 2), 0.0
        if not is_bounded(cost, chart, box):
            continue
        laid += 1
        linearise_rows(cost.K, cost.w, box.nodes, box.rows)
        low = least_residual(cost.K, cost.weight, chart.floor, box.half, box.nodes, box.rows)
        s, points = on_surface(chart, box.centre, level, rng, box.half, box.sense, 60)
        # the tangent plane is above the surface, by the sag at most
        up = chart.surface[-3:]
        above = (box.centre + s @ box.sense[:, :2].T - points) @ up
        assert above.min() >= -box.graph[SLIP] - 1e-5
        assert above.max() <= box.graph[SAG] + box.graph[SLIP] + 1e-5
        phi = np.linalg.norm(points[:, None] - cost.data[:, :3], axis=-1)
        residual = phi @ cost.K.T - cost.w
        assert low <= np.linalg.norm(residual, axis=-1).min() + 1e-6
        # rows are linear in the box but for what their nodes' remainders say
        centre = cost.K @ box.nodes[:, PHI] - cost.w
        slope = cost.K @ box.nodes[:, SLOPE0 : SLOPE0 + 2]
        rest = residual - centre - s @ slope.T
        wide = np.abs(cost.K) @ np.maximum(np.abs(box.nodes[:, 4]), np.abs(box.nodes[:, 5]))
        assert (np.abs(rest) <= wide + 1e-5).all()
        assert cost_at(cost.K, cost.w, box.nodes) == pytest.approx((centre**2).sum())
    assert laid > 0.4 * many(300, 30)
