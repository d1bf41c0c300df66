"""Elementwise functions of points, with derivatives by jets against differences of plain numbers."""

import math

import numpy as np
import pymap3d
import pytest
from cases import turn_matrix

from optloc.models.primitives import (
    Jet,
    Point,
    atan2,
    differential,
    distance,
    geodetic_height,
    geodetic_normal,
    hypot,
    local,
    namespace,
    range_rate,
    rotate,
    within,
    wrap,
)

STEP = 1e-6


def jets(*values):
    return [Jet(np.array(value), {i: np.array(1.0)}) for i, value in enumerate(values)]


def test_a_range_is_the_length_of_the_difference_and_its_rate_the_speed_along_it():
    target = Point((3.0, 4.0), (6.0, 8.0))
    station = Point((0.0, 0.0), (1.0, 0.0))
    assert distance(target, station) == 5.0
    assert range_rate(target, station) == pytest.approx((5.0 * 3.0 + 8.0 * 4.0) / 5.0)


def test_a_line_of_sight_is_in_the_axes_of_the_station():
    axes = ((0.0, 1.0), (-1.0, 0.0))  # the first axis points along y
    assert local(Point((1.0, 7.0)), Point((1.0, 2.0), axes=axes)) == (5.0, 0.0)
    assert within((1.0, 2.0), Point((0.0, 0.0))) == (1.0, 2.0)


@pytest.mark.parametrize("angle", [0.3, 3.0 + 2 * math.pi, -7.0])
def test_a_wrapped_angle_has_the_same_direction_within_half_a_turn(angle):
    found = wrap(angle)
    assert abs(found) <= math.pi
    assert (math.cos(found), math.sin(found)) == pytest.approx((math.cos(angle), math.sin(angle)), abs=1e-15)


@pytest.mark.parametrize("place", [(47.0, 11.0, 900.0), (-80.0, 170.0, -3e3), (2.0, -60.0, 4e5)])
def test_heights_and_normals_of_the_ellipsoid_are_those_of_another_library(place):
    lat, lon = np.radians(place[:2])
    ecef = pymap3d.geodetic2ecef(*place)
    assert geodetic_height(ecef) == pytest.approx(place[2], abs=1e-6)
    normal = (np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat))
    assert geodetic_normal(ecef) == pytest.approx(normal, abs=1e-12)
    for i, found in enumerate(geodetic_normal(tuple(jets(*ecef)))):
        for j in range(3):
            ahead, behind = (geodetic_normal(tuple(np.array(ecef) + sign * 10.0 * np.eye(3)[j])) for sign in (1, -1))
            assert found.partials[j] == pytest.approx((ahead[i] - behind[i]) / 20.0, abs=1e-13)


def test_a_turn_is_the_rotation_of_half_of_its_tangent():
    for turn in (np.array([0.7, -0.4, 1.1]), np.array([0.6])):
        axes = tuple(map(tuple, np.eye(max(len(turn), 2))))
        np.testing.assert_allclose(rotate(axes, tuple(turn)), turn_matrix(turn), atol=1e-14)


def test_axes_turn_by_a_small_vector_as_its_cross_product_does():
    turn = np.array([1e-4, -2e-4, 3e-4])
    axes = tuple(map(tuple, np.eye(3)))
    expected = np.eye(3) + np.cross(turn, np.eye(3))
    np.testing.assert_allclose(rotate(axes, tuple(turn)), expected, atol=1e-7)


@pytest.mark.parametrize(
    "function",
    [
        lambda u, v: u / v + 2.0 / u - v * u,
        lambda u, v: namespace(u).exp(namespace(u).sin(u)) * namespace(v).log(v),
        lambda u, v: hypot(u, v) if isinstance(u, Jet) else math.hypot(u, v),
        lambda u, v: atan2(u, v) if isinstance(u, Jet) else math.atan2(u, v),
        lambda u, v: geodetic_height((u * 6e6, v * 2e6, 1e6)),
    ],
)
def test_partials_of_jets_are_differences(function):
    u, v = 0.7, 1.9
    found = function(*jets(u, v))
    slopes = [
        (function(u + STEP, v) - function(u - STEP, v)) / (2 * STEP),
        (function(u, v + STEP) - function(u, v - STEP)) / (2 * STEP),
    ]
    assert found.value == pytest.approx(function(u, v), rel=1e-14)
    assert [found.partials[0], found.partials[1]] == pytest.approx(slopes, rel=1e-7)


def test_a_differential_follows_the_chain_rule_and_a_number_has_none():
    u, v = jets(2.0, 3.0)
    found = differential(10.0, [(u * v, 4.0), (1.5, 9.0)])
    assert found.partials == {0: 12.0, 1: 8.0}
    assert differential(10.0, [(1.5, 9.0)]) == 10.0
