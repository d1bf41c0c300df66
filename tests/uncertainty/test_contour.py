"""Contours of functions of two coordinates: areas known in closed form, holes, parts, thin and bent sets."""

import numpy as np
import pytest

from optloc.uncertainty.contour import area, holds, trace, trace_nodes

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])


def cells_around(value, low, high, count, level=0.5):
    """Return the squares of a grid in which a function is low anywhere."""
    step = (high - low) / count
    corners = low + step * np.stack(np.meshgrid(np.arange(count), np.arange(count)), axis=-1).reshape(-1, 2)
    inner = step * np.stack(np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, 5)), axis=-1).reshape(-1, 2)
    near = value((corners[:, None] + inner).reshape(-1, 2)).reshape(len(corners), -1).min(1) < level
    return corners[near, None] + step * SQUARE


def turned(points, angle):
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, -s], [s, c]])


def total(polygons):
    return sum(area(line) for polygon in polygons for line in polygon)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e7])
@pytest.mark.parametrize(("ratio", "angle"), [(1.0, 0.0), (3.0, 0.7), (40.0, 2.0)])
def test_ellipses_of_any_size_and_shape(scale, ratio, angle):
    centre = np.array([5.0, -3.0]) * scale

    def value(points):
        return (turned((points - centre) / scale, angle) ** 2 * [1.0 / ratio**2, 1.0]).sum(1) - 1.0

    box = turned(2.0 * (SQUARE - 0.5) * [1.3 * ratio, 1.3], -angle) * scale + centre
    (polygon,) = trace(value, box[None])
    (line,) = polygon
    assert (line[0] == line[-1]).all()
    assert area(line) == pytest.approx(np.pi * ratio * scale**2, rel=5e-3)
    assert value(line) == pytest.approx(0.0, abs=2e-3)
    assert holds(line, centre)
    assert not holds(line, centre + 2.0 * ratio * scale)


def test_a_ring_has_a_hole():
    def value(points):
        return np.abs(np.linalg.norm(points, axis=1) - 10.0) - 1.0

    (polygon,) = trace(value, cells_around(value, -15.0, 15.0, 30))
    around, hole = polygon
    assert area(around) == pytest.approx(np.pi * 121.0, rel=5e-3)
    assert area(hole) == pytest.approx(-np.pi * 81.0, rel=5e-3)


def test_parts_far_apart_are_as_fine_as_one():
    def value(points):
        return np.minimum(((points - [1e4, 500.0]) ** 2).sum(1) / 4.0, (points**2).sum(1)) - 1.0

    cells = np.concatenate([4.0 * (SQUARE - 0.5)[None], 8.0 * (SQUARE - 0.5)[None] + [1e4, 500.0]])
    large, small = trace(value, cells)
    assert (area(large[0]), area(small[0])) == pytest.approx((4.0 * np.pi, np.pi), rel=5e-3)


@pytest.mark.parametrize("width", [0.3, 0.05])
def test_a_thin_bent_set_is_one_part(width):
    def value(points):
        r, turn = np.linalg.norm(points, axis=1), np.arctan2(points[:, 1], points[:, 0])
        return ((r - 100.0) / (100.0 * width)) ** 2 + (turn / 2.0) ** 2 - 1.0

    (polygon,) = trace(value, cells_around(value, -140.0, 140.0, 60))
    assert total([polygon]) == pytest.approx(np.pi * 100.0 * width * 2.0 * 100.0, rel=5e-3)


def test_what_ends_at_infinite_values_and_what_is_empty():
    def value(points):
        return np.where(points[:, 0] > 0.0, np.inf, (points**2).sum(1) - 1.0)

    assert total(trace(value, 3.0 * (SQUARE - 0.5)[None])) == pytest.approx(0.5 * np.pi, rel=5e-3)
    assert trace(lambda points: np.full(len(points), np.nan), SQUARE[None]) == []
    assert trace(lambda points: np.ones(len(points)), SQUARE[None]) == []


def test_nodes_of_a_grid():
    def value(points):
        return ((points - 0.3) ** 2 * [1.0, 0.25]).sum(1) - 1.0

    step = 0.2
    nodes = np.argwhere(np.ones((24, 24))) - 12
    nodes = nodes[value(nodes * step) < 0.0]
    assert total(trace_nodes(value, nodes, step)) == pytest.approx(2.0 * np.pi, rel=1e-2)


def test_random_sums_of_bumps_as_counted_on_a_grid():
    rng = np.random.default_rng(7)
    for _ in range(2):
        place, size = rng.uniform(-3.0, 3.0, (5, 2)), rng.uniform(0.4, 1.5, 5)

        def value(points, place=place, size=size):
            away = ((points[:, None] - place) ** 2).sum(-1) / size**2
            return 0.5 - np.exp(-away).sum(1)

        side = np.linspace(-6.0, 6.0, 601)
        grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
        counted = (value(grid) < 0.0).sum() * 4e-4
        found = trace(value, 12.0 * (SQUARE - 0.5)[None])
        assert total(found) == pytest.approx(counted, rel=1e-2)
        assert all(any(holds(polygon[0], p) for polygon in found) for p in place)
