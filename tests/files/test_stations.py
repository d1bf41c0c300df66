"""Stations of a table: units, frames, axes, and positions between the times of their rows."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.base.frames import ECEF
from optloc.files.row_epochs import Epochs
from optloc.files.schema import FrameTable, StationsTable
from optloc.files.stations import over_epochs, survey
from optloc.files.table import of_rows


def surveyed(rows, frame=None, **section):
    return survey(StationsTable(file="s.csv", **section), of_rows(rows, "s.csv", {}), frame or FrameTable(), "x.toml")


def test_kilometres_become_metres_and_sigma_may_be_a_column_or_a_key():
    found, frame = surveyed([{"name": "A", "x": 1.0, "y": 2.0, "sigma": 0.5}], unit="km")
    assert frame.kind == "cartesian"
    assert found.position.tolist() == [[1000.0, 2000.0]]
    assert found.sigma.tolist() == [500.0]
    assert surveyed([{"name": "A", "x": 1.0, "y": 2.0}], sigma="3 m")[0].sigma.tolist() == [3.0]


def test_latitudes_are_places_of_ecef():
    found, frame = surveyed(
        [{"name": "A", "lat_deg": 0.0, "lon_deg": 90.0, "height": 10.0}], FrameTable(kind="geodetic")
    )
    assert frame == ECEF
    assert found.position[0] == pytest.approx([0.0, 6378147.0, 0.0], abs=1e-6)


def test_a_heading_turns_the_axes_clockwise():
    found, _ = surveyed([{"name": "A", "x": 0.0, "y": 0.0, "heading_deg": 90.0}])
    # The station's x axis points where its frame has -y.
    assert found.axes[0] == pytest.approx(np.array([[0.0, -1.0], [1.0, 0.0]]), abs=1e-12)


def epochs(*times):
    k = len(times)
    return Epochs(np.arange(k), np.zeros(k, int), tuple(map(str, range(k))), np.array(times), ("target",))


def test_a_moving_station_is_interpolated_and_never_extrapolated():
    rows = [{"name": "A", "time": t, "x": 10.0 * t, "y": 1.0} for t in (0.0, 4.0)]
    found, _ = surveyed(rows)
    section, used = StationsTable(file="s.csv"), [np.array([[0, 0]])]
    made = over_epochs(found, section, epochs(1.0, 3.0), used)
    assert made.position[:, 0].tolist() == [[10.0, 1.0], [30.0, 1.0]]
    with pytest.raises(InvalidProblem, match="no position at epoch '0'"):
        over_epochs(found, section, epochs(5.0), used)


@pytest.mark.parametrize(
    ("rows", "frame", "words"),
    [
        ([{"name": "A", "x": 0.0, "y": 0.0}] * 2, None, "used twice"),
        ([{"name": "A", "x": 0.0, "lat_deg": 0.0, "lon_deg": 0.0}], None, "mix"),
        ([{"name": "A", "lat_deg": 0.0, "lon_deg": 0.0}], None, "do not fit a cartesian frame"),
        ([{"name": "A", "x": 0.0, "y": 0.0}], FrameTable(kind="enu"), "needs an origin"),
        ([{"name": "A", "x": 0.0, "y": 0.0, "sigma": 0.0}], None, "not positive"),
    ],
)
def test_stations_without_one_place_are_refused(rows, frame, words):
    with pytest.raises(InvalidProblem, match=words):
        surveyed(rows, frame)
