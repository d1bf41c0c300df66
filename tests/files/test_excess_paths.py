"""Excess paths become path sums: the distance of the two stations is added to present rows."""

import numpy as np
import pytest

from optloc.base.units import SPEED_OF_LIGHT
from optloc.files.excess_paths import with_baseline, with_station_distance
from optloc.files.measurements import Context, chunks_of
from optloc.files.schema import MeasurementsTable
from optloc.files.table import of_rows
from optloc.problem.build import station_array

ROWS = [
    {"a": "A", "b": "B", "z": 5.0, "sigma": 1.0, "weight": 1.0},
    {"a": "A", "b": "C", "z": 5.0, "sigma": 1.0, "weight": 0.0},
]
PLACES = station_array([[0.0, 0.0], [30.0, 40.0], [3.0, 4.0]])


def chunk(excess):
    """Return the chunk of two path sums, the second absent."""
    section = MeasurementsTable(kind="range_sum", excess=excess)
    table = of_rows(ROWS, "rows", {})
    (one,) = chunks_of(Context(section, table, ("A", "B", "C"), "rows", SPEED_OF_LIGHT, True))
    return one


def test_the_distance_is_added_to_present_rows_only():
    one = chunk(excess=True)
    assert with_baseline(one, np.array([10.0, 20.0])).z.tolist() == [15.0, one.z[1]]


@pytest.mark.parametrize(("excess", "first"), [(True, 55.0), (False, 5.0)])
def test_only_excess_paths_change(excess, first):
    found = with_station_distance(chunk(excess), np.zeros(2, dtype=int), PLACES)
    assert found.z[0] == pytest.approx(first)
