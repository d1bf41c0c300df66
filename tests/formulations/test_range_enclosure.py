"""Boxes that hold every point of low cost: sampling, tightness, and rows that enclose nothing."""

import numpy as np
import pytest
from often import few
from ranged import drawn, minimum

from formulations.range_enclosure import Ranged, ball, enclosure

KINDS = ("difference", "sum", "both", "range", "correlated range")


def sublevel(ranged: Ranged, start: np.ndarray, level: float, rng, steps: int = 200) -> np.ndarray:
    """Points of cost at most `level`: a walk that goes as far as it can along random lines, both ways."""
    points, x = [], start
    spread = 4.0 * np.sqrt(level) * 0.1
    for _ in range(steps):
        way = rng.normal(size=len(x))
        length = spread * 10.0 ** rng.uniform(-3.0, 2.0)
        for far in np.linspace(0.0, 1.0, 12)[1:] * length:
            trial = x + far * way
            if ranged.cost(trial) <= level:
                points.append(trial)
        if points and rng.random() < 0.7:
            x = points[rng.integers(len(points))]
    return np.array(points)


@pytest.mark.parametrize("d", few([3, 2], 1))
@pytest.mark.parametrize("kind", few(KINDS, 3))
def test_no_point_of_low_cost_lies_outside(kind, d):
    rng = np.random.default_rng([KINDS.index(kind), d])
    reached, enclosed = [], 0
    for _ in range(4):
        ranged, truth = drawn(rng, kind, d + 3, d, 10.0 ** rng.uniform(-3.5, -2.0))
        x, cost = minimum(ranged, truth, rng)
        assert ranged.cost(x) == pytest.approx(cost, rel=1e-9, abs=1e-9)
        level = cost + 2.0
        box = enclosure(ranged, x, level)
        if box is None:
            continue
        enclosed += 1
        points = sublevel(ranged, x, level, rng)
        inside = np.abs(np.linalg.solve(box.axes, (points - box.centre).T))
        r = np.linalg.norm(points - ranged.station[0], axis=1)
        assert inside.max() <= 1.0
        assert box.low <= r.min()
        assert r.max() <= box.high
        reached.append(inside.max())
    assert enclosed >= 3
    # the boxes are no larger than they need to be: points come near their faces
    assert np.median(reached) > (0.5 if "range" not in kind else 0.2)


def test_the_axes_come_from_any_point():
    rng = np.random.default_rng(5)
    ranged, truth = drawn(rng, "difference", 6, 3, 2e-3)
    x, cost = minimum(ranged, truth, rng)
    points = sublevel(ranged, x, cost + 1.0, rng)
    for _ in range(20):
        box = enclosure(ranged, rng.normal(size=3), cost + 1.0)
        if box is not None:
            assert np.abs(np.linalg.solve(box.axes, (points - box.centre).T)).max() <= 1.0


def test_too_few_rows_and_too_much_noise_enclose_nothing():
    rng = np.random.default_rng(6)
    few, truth = drawn(rng, "difference", 4, 3, 1e-3)
    assert enclosure(few, truth, 1.0) is None
    loud, truth = drawn(rng, "difference", 6, 3, 1e-3)
    assert enclosure(loud, truth, 1e8) is None


def test_few_ranges_are_enclosed_by_the_first():
    rng = np.random.default_rng(7)
    ranged, truth = drawn(rng, "range", 2, 3, 1e-2)
    box = enclosure(ranged, truth, 4.0)
    assert box is not None
    assert box.high == pytest.approx(ranged.offset[0] + 2.0 * 1e-2, rel=1e-6)
    np.testing.assert_allclose(box.centre, ranged.station[0])


def test_a_ball_holds_its_points():
    rng = np.random.default_rng(8)
    ranged, _ = drawn(rng, "difference", 5, 3, 1e-3)
    centre = np.array([0.3, -0.2, 0.1])
    box = ball(ranged, centre, 2.5)
    way = rng.normal(size=(500, 3))
    points = centre + 2.5 * way / np.linalg.norm(way, axis=1, keepdims=True) * rng.random((500, 1))
    r = np.linalg.norm(points - ranged.station[0], axis=1)
    assert (np.abs(np.linalg.solve(box.axes, (points - box.centre).T)) <= 1.0).all()
    assert box.low <= r.min() <= r.max() <= box.high
