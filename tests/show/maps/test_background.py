"""Background of maps: borders and cities at known places, also beyond the antimeridian."""

import numpy as np
import pytest

from optloc.show.maps.background import border_lines, borders, cities, cities_of, land
from optloc.show.maps.projection import Plane


def test_borders_pass_known_places():
    corners = np.concatenate(border_lines())
    # Strait-free borders: the Rhine at Kehl, the Brenner pass, the 49th parallel.
    for lon, lat in ((7.80, 48.58), (11.50, 47.00)):
        assert np.hypot(*(corners - [lon, lat]).T).min() < 0.15
    north = corners[(corners[:, 0] > -120.0) & (corners[:, 0] < -100.0) & (np.abs(corners[:, 1] - 49.0) < 0.05)]
    assert len(north) > 3
    assert borders((-30.0, -29.0, 30.0, 31.0)) == []
    assert len(borders((6.0, 9.0, 47.0, 49.0))) > 2


def test_cities_are_sorted_by_size():
    found = cities()
    assert len(found.names) == len(found.place) == len(found.population) > 30_000
    assert (np.diff(found.population) <= 0).all()
    assert found.place[found.names.index("Munich")] == pytest.approx([11.575, 48.137], abs=0.01)


def test_a_map_has_the_largest_cities_of_its_window():
    found = cities_of(Plane(10.0, 13.0, 47.0, 49.0))
    assert found.names[0] in {"Munich", "Milan", "Vienna", "Prague"}
    assert "Munich" in found.names
    assert len(found.names) <= 160
    across = cities_of(Plane(175.0, 185.0, -22.0, -12.0))
    assert "Suva" in across.names
    assert (np.abs(across.place[:, 0] - 180.0) < 40.0).all()


def test_land_is_clipped_to_the_window():
    window = (5.0, 15.0, 45.0, 50.0)
    for ring in land(window):
        assert (ring.min(0) >= [5.0, 45.0]).all()
        assert (ring.max(0) <= [15.0, 50.0]).all()
