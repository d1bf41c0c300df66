"""Quantities that constraints bound."""

import numpy as np
import pymap3d
import pytest

from optloc import assemble, constraints, measured, solve
from optloc.models.primitives import Point
from optloc.models.surfaces import SURFACES, Surface
from optloc.models.terrain import Terrain

PLACE = pymap3d.geodetic2ecef(47.0, 11.0, 900.0)


def test_a_plane_is_a_linear_form_of_the_position():
    assert SURFACES["plane"].g(Point((1.0, 2.0, 3.0)), (0.5, -1.0, 2.0)) == 4.5


def test_a_speed_is_the_length_of_the_velocity():
    assert SURFACES["speed"].g(Point((0.0, 0.0), (30.0, -40.0)), ()) == 50.0


def test_a_height_is_geodetic():
    assert SURFACES["height"].g(Point(PLACE, ecef=PLACE), ()) == pytest.approx(900.0, abs=1e-6)


@pytest.mark.parametrize("elevation", [-20.0, 5.0, 80.0])
def test_a_visible_point_has_the_sine_of_its_elevation_above_the_horizon(elevation):
    satellite = pymap3d.aer2ecef(130.0, elevation, 2e7, 47.0, 11.0, 900.0)
    found = SURFACES["visible"].g(Point(PLACE, ecef=PLACE), satellite)
    assert found == pytest.approx(np.sin(np.radians(elevation)), abs=1e-9)


def test_points_carry_what_the_table_says_that_each_surface_takes():
    ground = Terrain([0.0, 4e3], [0.0, 4e3], np.ones((2, 2)))
    for surface in SURFACES.values():
        point = Point(
            (1e3, 2e3, 3e3),
            (1.0, 2.0, 2.0) if surface.velocity else None,
            ecef=PLACE if surface.ecef else None,
            acceleration=(0.1, 0.2, 0.3) if surface.acceleration else None,
            span=(0.0, 5.0) if surface.along else None,
            other=Point((0.0, 0.0, 0.0)) if surface.other else None,
        )
        for count in surface.counts(3):
            coefficients = (1.0, 2.0, 3.0, 5.0, 8.0, 13.0)[:count]
            assert np.isfinite(surface.g(point, (*coefficients, ground) if surface.table else coefficients))


def test_a_distance_is_in_the_plan_if_its_point_has_two_coordinates():
    target = Point((3.0, 4.0, 12.0))
    assert SURFACES["distance"].g(target, (0.0, 0.0)) == 5.0
    assert SURFACES["distance"].g(target, (0.0, 0.0, 0.0)) == 13.0


@pytest.mark.parametrize(("place", "distance"), [((5.0, 3.0), 3.0), ((-3.0, 4.0), 5.0), ((13.0, -4.0), 5.0)])
def test_the_distance_from_a_segment_ends_at_its_ends(place, distance):
    assert SURFACES["segment"].g(Point(place), (0.0, 0.0, 10.0, 0.0)) == pytest.approx(distance)


def test_extremes_over_a_run_are_those_of_many_times():
    rng = np.random.default_rng(1)
    times = np.linspace(-3.0, 7.0, 20001)
    for _ in range(50):
        v, a, line, rate = rng.standard_normal((4, 2))
        at = v + times[:, None] * a
        rates = (at[:, 0] * a[1] - at[:, 1] * a[0]) / (at**2).sum(-1)
        target = Point((0.0, 0.0), tuple(v), acceleration=tuple(a), span=(-3.0, 7.0))
        extreme = rates[np.abs(rates).argmax()]
        assert 1.0 / SURFACES["turn_rate"].g(target, ()) == pytest.approx(1.0 / extreme, rel=1e-3, abs=1e-4)
        assert SURFACES["least speed"].g(target, ()) == pytest.approx(np.hypot(*at.T).min(), abs=1e-3)
        pair = Point(tuple(line), tuple(rate), span=(-3.0, 7.0), other=Point((0.0, 0.0), (0.0, 0.0)))
        apart = np.hypot(*(line + times[:, None] * rate).T).min()
        assert SURFACES["least separation"].g(pair, ()) == pytest.approx(apart, abs=1e-3)


@pytest.mark.parametrize(
    ("kind", "c"),
    [
        ("distance", (3.0, -4.0)),
        ("distance", (3.0, -4.0, 5.0)),
        ("segment", (0.0, 0.0, 400.0, 300.0)),
        ("segment", (0.0, 0.0, 7.0, 400.0, 300.0, 9.0)),
        ("terrain", (Terrain(np.arange(5.0) * 99.0, np.arange(4.0) * 99.0, np.sin(np.arange(20.0)).reshape(5, 4)),)),
    ],
)
@pytest.mark.parametrize("bound", [0.5, 20.0])
def test_points_around_a_surface_are_on_it(kind, c, bound):
    points = SURFACES[kind].around(c, bound)
    places = np.column_stack([points, np.zeros((len(points), 3 - points.shape[1]))])
    assert SURFACES[kind].g(Point(tuple(places.T)), c) == pytest.approx(bound, abs=1e-9)


def test_another_package_adds_a_quantity(monkeypatch):
    monkeypatch.setitem(SURFACES._own, "north", Surface(lambda t, c: t.position[1], "northing", "m"))
    stations = np.array([[0.0, 0.0], [900.0, 0.0], [0.0, 900.0], [900.0, 900.0]])
    z = np.linalg.norm(stations - [300.0, 400.0], axis=1)
    limits = constraints.quantity("north", upper=350.0)
    fix = solve(assemble(stations, measured("range", z, a=range(4), sigma=9.0), constraints=limits))
    assert fix.position[1] == pytest.approx(350.0, abs=1e-6)
    assert fix.active[()][0].name == "north upper"
