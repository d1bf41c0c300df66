"""Problems put together from arrays."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.problem.build import assemble, measured, station_array
from optloc.problem.noise import dense

PLACES = np.array([[0.0, 0.0], [9.0, 1.0], [10.0, 9.0], [1.0, 10.0]])


def test_single_numbers_stand_for_all_rows():
    rows = measured("tdoa", [1.0, 2.0], a=[1, 2], b=0, sigma=3.0, weight=0.5, epoch=1).rows
    assert (rows.b.tolist(), rows.epoch.tolist(), rows.target.tolist()) == ([0, 0], [1, 1], [0, 0])
    assert (rows.weight.tolist(), rows.correction.tolist()) == ([0.5, 0.5], [0.0, 0.0])


def test_rows_without_values_are_to_be_simulated_and_kinds_without_stations_have_none():
    rows = measured("height", sigma=1.0).rows
    assert np.isnan(rows.z).all()
    assert (rows.a.tolist(), rows.b.tolist()) == ([-1], [-1])


def test_arrivals_correlate_the_differences_of_a_station():
    problem = assemble(
        PLACES, measured("tdoa", [1.0, 2.0], a=[1, 2], b=0, sigma=0.5, arrival_sigma=[2.0, 3.0, 4.0, 5.0])
    )
    assert dense(problem.noise, np.arange(2)).tolist() == [[4 + 9 + 0.25, 4], [4, 4 + 16 + 0.25]]


def test_arguments_are_copied():
    z, places = np.array([1.0, 2.0, 3.0, 4.0]), PLACES.copy()
    problem = assemble(places, measured("range", z, a=np.arange(4), sigma=1.0))
    z[:] = 0.0
    assert problem.z.tolist() == [1.0, 2.0, 3.0, 4.0]


def test_problems_of_one_structure_share_their_noise_and_not_their_values():
    one, two = (assemble(PLACES, measured("range", np.full(4, z), a=np.arange(4), sigma=1.0)) for z in (1.0, 2.0))
    assert one.noise is two.noise
    assert (one.z.tolist(), two.z.tolist()) == ([1.0] * 4, [2.0] * 4)


def test_stations_that_stay_have_one_epoch_and_names_of_their_own():
    stations = station_array(PLACES, velocity=0.0 * PLACES)
    assert stations.position.shape == stations.velocity.shape == (1, 4, 2)
    assert stations.names == ("S0", "S1", "S2", "S3")
    assert station_array(np.zeros((5, 4, 3)), list("ABCD")).position.shape == (5, 4, 3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"kind": "bearing", "sigma": 1.0, "a": 0}, "a bearing is in degrees from north"),
        ({"kind": "range", "sigma": 1.0}, "range needs station a"),
        ({"kind": "range", "a": 0}, "must be given once"),
        ({"kind": "range", "a": 0, "sigma": 1.0, "covariance": np.eye(1)}, "must be given once"),
        ({"kind": "range", "a": 0, "signal": 3.0}, "it is a float"),
        ({"kind": "range", "a": [0, 1], "z": [1.0, 2.0, 3.0], "sigma": 1.0}, r"have \[2, 3\] rows"),
        ({"kind": "range", "a": [0, 1], "covariance": np.ones((3, 2))}, "has shape"),
    ],
)
def test_measurements_that_do_not_fit_are_refused(arguments, words):
    with pytest.raises(InvalidProblem, match=words):
        measured(**arguments)


def test_a_problem_needs_measurements_and_places():
    with pytest.raises(InvalidProblem, match="there are no measurements"):
        assemble(PLACES)
    with pytest.raises(InvalidProblem, match="give an array"):
        station_array(np.zeros(3))
    with pytest.raises(InvalidProblem, match="joint covariance has shape"):
        assemble(PLACES, measured("range", a=[0, 1], sigma=1.0), covariance=np.eye(3))
    with pytest.raises(InvalidProblem, match="is not a sum of measurements of single stations"):
        assemble(PLACES, measured("groa", a=1, b=0, arrival_sigma=1.0))
