"""What places of stations and numbers of rows leave open, in scenes where everybody can see it."""

import numpy as np
import pytest
from model_checks.small import PLACE, ranges_to

from optloc.advice.geometry import advise_on_geometry

LINE = np.array([[0.0, 0.0], [500.0, 0.0], [1000.0, 0.0], [1500.0, 0.0]])
FLOOR = np.array([[0.0, 0.0, 0.0], [1e3, 0.0, 0.0], [0.0, 1e3, 0.0], [1e3, 1e3, 0.0], [500.0, 300.0, 0.0]])
SPACE = FLOOR + np.array([0.0, 0.0, 1.0]) * np.array([[0.0], [400.0], [900.0], [100.0], [600.0]])


@pytest.mark.parametrize(
    ("stations", "place", "cause"),
    [
        (LINE, PLACE, ["line"]),
        (FLOOR, [300.0, 650.0, 200.0], ["plane"]),
        (SPACE, [300.0, 650.0, 200.0], []),
        (np.pad(LINE, ((0, 0), (0, 1))), [300.0, 650.0, 200.0], ["redundancy", "line"]),
    ],
)
def test_stations_on_a_line_or_plane_are_named(stations, place, cause):
    problem = ranges_to(place, 1.0, stations=stations)
    found = list(advise_on_geometry(problem, np.asarray(place)[None]))
    assert [one.cause for one in found] == cause


def test_the_side_of_a_level_plane_is_asked_for_as_a_box():
    problem = ranges_to([300.0, 650.0, 200.0], 1.0, stations=FLOOR)
    (one,) = advise_on_geometry(problem, np.full((1, 3), np.nan))
    assert "min = [-inf, -inf, 0]" in one.toml


@pytest.mark.parametrize(("count", "words"), [(1, "1 measurement fewer"), (2, "no redundancy"), (3, "redundancy of 1")])
def test_too_few_rows_are_counted(count, words):
    stations = np.array([[0.0, 0.0], [1000.0, 0.0], [300.0, 900.0]])[:count]
    found = list(advise_on_geometry(ranges_to(PLACE, 1.0, stations=stations), np.full((1, 2), np.nan)))
    assert words in found[0].seen
