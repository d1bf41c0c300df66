"""Lines of marks: NMEA with its checksum and minutes that roll over, poses of ROS, and information of g2o."""

import json
from functools import reduce
from operator import xor

import numpy as np
import pytest
from show.ranging import ENU, ranged

from optloc.show.columns import fix_columns
from optloc.show.formats.marks import Results, mark_of
from optloc.show.formats.sentences import _angle, g2o, nmea, ros, sentences


@pytest.mark.parametrize(
    ("degrees", "digits", "text"),
    [
        (12.5, 2, "1230.0000000"),
        (-8.25, 3, "00815.0000000"),
        (59.999999999999, 2, "6000.0000000"),
        (0.0, 3, "00000.0000000"),
    ],
)
def test_minutes_never_reach_sixty(degrees, digits, text):
    assert _angle(degrees, digits) == text


def mark(status="ok"):
    cov = np.diag([9.0, 4.0, 1.0])
    return mark_of(ENU, np.array([0.0, 0.0, 7.0]), cov, status, name="m", target="m", time=1_700_000_000.25, dated=True)


def test_sentences_have_their_checksum_place_and_errors():
    gga, gst = sentences(mark()).splitlines()
    for line in (gga, gst):
        body, _, sum_ = line[1:].partition("*")
        assert int(sum_, 16) == reduce(xor, body.encode())
    fields = gga.split(",")
    assert fields[1:7] == ["221320.25", "4700.0000000", "N", "00800.0000000", "E", "1"]
    assert fields[9] == "407.000"
    # The long axis is east: 3 m at 90 degrees; then north, east and up.
    assert gst.split("*")[0].split(",")[3:] == ["3.000", "2.000", "90.0", "2.000", "3.000", "1.000"]


def test_what_is_not_sure_has_no_place():
    assert sentences(mark("ambiguous")).split(",")[2:7] == ["", "", "", "", "0"]


def results():
    problem, fix = ranged()
    return Results(fix_columns(fix), ENU, (fix,), problem)


def test_a_pose_has_the_covariance_of_the_fix():
    _, fix = ranged()
    message = json.loads(next(line for line in ros(results()).splitlines() if line.startswith("{")))
    assert list(message["pose"]["pose"]["position"].values()) == [*fix.position.tolist(), 0.0]
    assert np.reshape(message["pose"]["covariance"], (6, 6))[:2, :2] == pytest.approx(fix.covariance())
    assert message["header"]["frame_id"] == "map"


def test_a_prior_has_the_inverse_of_the_covariance():
    _, fix = ranged()
    line = next(line for line in g2o(results()).splitlines() if line.startswith("EDGE_PRIOR_XY"))
    a, b, c = (float(word) for word in line.split()[-3:])
    assert np.array([[a, b], [b, c]]) == pytest.approx(np.linalg.inv(fix.covariance()), rel=1e-9)
    assert nmea(results()).startswith("$GNGGA")
