"""Cones, bearings and wedges of what data determine."""

import numpy as np
import pytest

from optloc.problem.determined import Determined, Direction, Quantity, angles_off_axis, bearing_of, is_in_cone

UP = np.array([0.0, 0.0, 1.0])


def cone(half, axis=UP, count=60):
    """Return unit vectors on a circle around the upward axis."""
    turn = 2.0 * np.pi * np.arange(count) / count
    return np.stack([np.sin(half) * np.cos(turn), np.sin(half) * np.sin(turn), np.full(count, np.cos(half))], axis=-1)


def level(azimuth, low, high, near=0.0, far=np.inf):
    """Return a direction in the plane."""
    ends = np.array([low, high])
    rim = np.stack([np.cos(ends), np.sin(ends)], axis=-1)
    vector = np.array([np.cos(azimuth), np.sin(azimuth)])
    return Direction(
        vector, (azimuth, low, high), (), np.array([0.5 * (high - low)]), vector[:, None], rim, (near, near, far)
    )


def test_angles_off_an_axis_are_the_angles_between_vectors():
    rng = np.random.default_rng(1)
    vectors = rng.standard_normal((50, 3))
    size = np.linalg.norm(angles_off_axis(UP, vectors), axis=1)
    np.testing.assert_allclose(size, np.arccos(vectors[:, 2] / np.linalg.norm(vectors, axis=1)), atol=1e-12)
    assert angles_off_axis(UP, 5.0 * UP).tolist() == [0.0, 0.0]


def test_a_cone_holds_the_vectors_within_its_half_angle():
    found = is_in_cone(UP, cone(0.3), np.concatenate([cone(0.29), cone(0.31), cone(2.0)]))
    assert found.tolist() == [True] * 60 + [False] * 120
    edge = level(0.5, 0.4, 0.7)
    assert edge.covers([[np.cos(a), np.sin(a)] for a in (0.39, 0.41, 0.69, 0.71)]).tolist() == [
        False,
        True,
        True,
        False,
    ]


@pytest.mark.parametrize(("azimuth", "bearing"), [(0.0, 90.0), (90.0, 0.0), (-90.0, 180.0), (100.0, 350.0)])
def test_a_bearing_is_clockwise_from_north_with_its_ends_in_order(azimuth, bearing):
    found = bearing_of(tuple(np.radians([azimuth, azimuth - 20.0, azimuth + 5.0])))
    assert found == pytest.approx((bearing, bearing - 5.0, bearing + 20.0))


def test_a_wedge_goes_from_the_least_range_to_the_greatest_within_the_interval():
    one = level(0.5, 0.4, 0.7, 10.0, 30.0)
    found = Determined(np.array([5.0, 6.0]), np.eye(2), directions=(one,))
    away = found.wedge(one, 100.0) - found.origin
    size, turn = np.linalg.norm(away, axis=1), np.arctan2(away[:, 1], away[:, 0])
    assert (size.min(), size.max()) == pytest.approx((10.0, 30.0))
    assert (turn.min(), turn.max()) == pytest.approx((0.4, 0.7))
    assert np.linalg.norm(found.ray(one, 100.0)[1] - found.origin) == pytest.approx(30.0)
    endless = level(0.5, 0.4, 0.7, 10.0)
    assert not endless.mixed
    assert np.linalg.norm(found.wedge(endless, 100.0) - found.origin, axis=1).max() == pytest.approx(100.0)


def test_a_dictionary_has_degrees_bearings_and_no_infinities():
    quantity = Quantity("distance from line", 3.0, 1.0, np.inf, "m")
    found = Determined(np.zeros(2), np.eye(2), True, (level(0.0, -0.1, 0.2, 10.0),), (quantity,))
    text = found.to_dict()
    assert text["quantities"] == [{"name": "distance from line", "value": 3.0, "interval": [1.0, None], "unit": "m"}]
    (one,) = text["directions"]
    assert one["azimuth_interval_deg"] == pytest.approx(np.degrees([-0.1, 0.2]).tolist())
    assert one["bearing_deg"] == pytest.approx(90.0)
    assert one["range_interval"] == [10.0, None]


def test_nothing_determined_is_false():
    assert not Determined(np.zeros(2), np.eye(2))
    assert Determined(np.zeros(2), np.eye(2), curve=np.zeros((2, 2)))
