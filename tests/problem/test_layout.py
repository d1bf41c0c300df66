"""Parameter vectors: shared unknowns first, then those of each epoch."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.base.types import Bias, Motion, Stations
from optloc.problem.layout import emission_name, layout, state_names

STATIONS = Stations(np.zeros((1, 3, 2)), ("A", "B", "C"), covariance=np.tile(np.eye(2), (3, 1, 1)))
CLOCK = Bias("clock", ("B", "C"), np.array([0, 1]), np.array([0, 1]), np.ones(2))
BOTH = layout(STATIONS, (Motion(1), Motion(span="epoch")), (CLOCK,), (0,), 4, ("m",))


def test_unknowns_of_the_run_come_first_and_those_of_an_epoch_in_their_order():
    assert [(slot.name, slot.start, slot.size, slot.unit) for slot in BOTH.shared] == [
        ("position[0]", 0, 2, "m"),
        ("velocity[0]", 2, 2, "m/s"),
        ("clock", 4, 2, "m"),
    ]
    assert [(slot.name, slot.start, slot.size) for slot in BOTH.local] == [
        ("position[1]", 0, 2),
        ("emission[0]", 2, 1),
        ("stations", 3, 6),
    ]
    assert (BOTH.n_shared, BOTH.n_local, BOTH.size) == (6, 9, 6 + 4 * 9)


def test_parts_are_taken_by_name():
    x = np.arange(2.0 * BOTH.size).reshape(2, -1)
    shared, local = BOTH.split(x)
    assert (shared.shape, local.shape) == ((2, 6), (2, 4, 9))
    assert BOTH.take(x, "clock")[0].tolist() == [4.0, 5.0]
    assert BOTH.take(x, "emission[0]")[0, :, 0].tolist() == [8.0, 17.0, 26.0, 35.0]
    assert np.concatenate([shared[1], local[1].ravel()]).tolist() == x[1].tolist()


def test_labels_name_coordinates_and_members():
    assert BOTH.labels() == ("position[0] x", "position[0] y", "velocity[0] x", "velocity[0] y", "clock B", "clock C")
    assert BOTH.local[2].entries == ("A x", "A y", "B x", "B y", "C x", "C y")


def test_station_errors_of_a_run_are_shared_and_noise_is_no_unknown():
    for span, names in (("run", ["position", "stations"]), ("noise", ["position"])):
        stations = Stations(STATIONS.position, STATIONS.names, covariance=STATIONS.covariance, span=span)
        assert [slot.name for slot in layout(stations, (Motion(),), (), (), 1).shared] == names


def test_a_single_target_has_names_without_a_number():
    assert state_names(0, 1, 2) == ("position", "velocity", "acceleration")
    assert (emission_name(0, 1), emission_name(1, 2)) == ("emission", "emission[1]")


def test_a_name_that_is_not_there_is_refused_with_those_that_are():
    assert BOTH.shares("clock")
    assert not BOTH.shares("stations")
    with pytest.raises(InvalidProblem, match=r"there is no unknown 'speed'.*clock"):
        BOTH.find("speed")
