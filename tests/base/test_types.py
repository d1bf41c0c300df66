"""Values of problems, and the words and the order of statuses."""

import numpy as np
import pytest

from optloc import measured
from optloc.base.types import ANSWERED, HAS_ANSWER, NOTES, PRECEDENCE, Stations, Status, first_status, statuses_of

PLACE = np.arange(12.0).reshape(2, 2, 3)  # two epochs of two stations


def test_every_status_is_either_a_note_or_has_a_place_in_the_order():
    assert sorted([*PRECEDENCE, *NOTES]) == sorted(Status)
    assert PRECEDENCE[-1] is Status.OK
    assert [Status(i) for i in np.flatnonzero(HAS_ANSWER)] == sorted(ANSWERED)


def test_the_first_of_all_that_applies_is_the_status():
    marks = [[Status.AMBIGUOUS, Status.MISFIT, Status.TAILS], [Status.UNCHECKED], [], [Status.CURVED, Status.UNPROVEN]]
    code = first_status([sum(one.mark for one in each) for each in marks])
    assert statuses_of(code).tolist() == [Status.MISFIT, Status.OK, Status.OK, Status.UNPROVEN]


def test_marks_are_bits_of_their_own():
    assert sum(status.mark for status in Status) == (1 << len(Status)) - 1


def test_a_status_prints_as_its_label_and_has_a_sentence():
    assert f"{Status.TOO_FEW_ROWS}" == str(Status.TOO_FEW_ROWS) == "too few rows"
    assert f"{Status.TOO_FEW_ROWS:02d}" == "06"
    assert len({status.sentence for status in Status}) == len(Status)
    assert all(status.sentence.endswith(".") for status in Status)


def test_moving_stations_have_places_at_all_epochs():
    stations = Stations(PLACE, ("A", "B"))
    assert (stations.count, stations.dimension) == (2, 3)
    assert stations.places.tolist() == PLACE.reshape(4, 3).tolist()
    assert stations.errors == ()


@pytest.mark.parametrize(("span", "unknown", "weighed"), [("epoch", "epoch", False), ("noise", None, True)])
def test_station_errors_are_unknowns_or_noise(span, unknown, weighed):
    stations = Stations(PLACE, ("A", "B"), covariance=np.tile(4.0 * np.eye(3), (2, 1, 1)), span=span)
    assert (stations.unknown_for, stations.weighed, stations.isotropic) == (unknown, weighed, True)
    assert stations.with_noise().weighed
    assert not Stations(PLACE, ("A", "B"), covariance=np.tile(np.diag([4.0, 4.0, 9.0]), (2, 1, 1))).isotropic


def test_compass_rows_report_errors_with_the_opposite_sign():
    rows = measured("azimuth", [0.1], a=[0], sigma=0.01).rows
    assert (rows.sense, rows.clockwise().sense) == (1.0, -1.0)
    assert rows.clockwise().z is rows.z
