"""Boxes that cover a region: no point below the level is left out, and none above it is inside."""

import numpy as np
import pytest
from proof.costs import random_case

from optloc.proof.subpaving import cover_region

pytestmark = pytest.mark.usefixtures("plainly")

MOST = 40


def test_every_cheap_point_is_in_a_box_and_inner_boxes_hold_cheap_points_alone():
    rng = np.random.default_rng(7)
    case, truth = random_case(rng, 2, sigma=30.0)
    cost, box = case.tables
    x = case.minimum(truth)
    base, cells, ends = np.zeros(3), np.zeros((2 * MOST, 3, 3)), np.zeros(2 * MOST)
    count, inside, level = cover_region(cost, box, x, 9.0, MOST, False, base, cells, ends)
    assert 0 < inside < count <= 2 * MOST
    assert level == pytest.approx(case.cost(x) + 9.0)
    centre, edges = base[:2] + cells[:count, 0, :2], np.swapaxes(cells[:count, 1:, :2], 1, 2)
    corners = centre[:inside, None] + np.array([[1, 1], [1, -1], [-1, 1], [-1, -1.0]]) @ np.swapaxes(
        edges[:inside], 1, 2
    )
    assert case.cost(corners).max() <= level
    # points of a ring about the fix, of which some are cheap
    scatter = np.linalg.inv(np.linalg.cholesky(case.derivatives(x)[1])).T
    points = x + rng.uniform(-4.0, 4.0, (2000, 2)) @ scatter.T
    cheap = points[case.cost(points) <= level]
    assert 100 < len(cheap) < 2000
    s = np.linalg.solve(edges[None], (cheap[:, None] - centre)[..., None])[..., 0]
    assert (np.abs(s).max(-1).min(1) <= 1.0 + 1e-9).all()
