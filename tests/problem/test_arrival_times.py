"""Range differences as arrival times."""

import numpy as np
import pytest
from cases import CASES, STATIONS, TARGET

from optloc import assemble, measured, with_bias
from optloc.problem.arrival_times import as_arrivals, restore_order, shared_places

SIGMA = np.array([2.0, 3.0, 4.0, 5.0, 6.0, 7.0])
A, B = np.triu_indices(6, 1)  # all pairs: five of fifteen are independent


def differences(**more):
    arrival = np.linalg.norm(STATIONS[2] - TARGET[2], axis=1) + np.array([3.0, -1.0, 2.0, 0.0, -4.0, 5.0])
    z = (arrival[A] - arrival[B])[None]
    return assemble(STATIONS[2], measured("tdoa", z, a=A, b=B, **more))


def cost(rows, covariance):
    return rows @ np.linalg.pinv(covariance, rcond=1e-12, hermitian=True) @ rows


def test_arrivals_cost_as_much_as_their_differences_with_the_best_emission_time():
    problem = differences(arrival_sigma=SIGMA)
    found = as_arrivals(problem)
    assert [rows.kind for rows in found.problem.rows] == ["toa"]
    design = np.eye(6)[A] - np.eye(6)[B]
    for place in ([3.1e3, 6.2e3], [0.0, 500.0], [-2e4, 9e3]):
        r = np.linalg.norm(STATIONS[2] - place, axis=1)
        one = cost(problem.z[0] - design @ r, design @ np.diag(SIGMA**2) @ design.T)
        left, weight = found.problem.z[0] - r, SIGMA**-2.0
        best = (weight * left).sum() / weight.sum()
        assert (weight * (left - best) ** 2).sum() == pytest.approx(one, rel=1e-9)


def test_an_arrival_comes_from_all_differences_of_its_station():
    found = as_arrivals(differences(arrival_sigma=SIGMA))
    assert [rows.tolist() for rows in found.origin] == [np.flatnonzero((s == A) | (s == B)).tolist() for s in range(6)]


@pytest.mark.parametrize(
    "problem",
    [
        differences(sigma=5.0),  # independent differences are no arrivals
        differences(arrival_sigma=SIGMA, weight=np.r_[0.5, np.ones(14)]),
        with_bias(differences(arrival_sigma=SIGMA), "clock", members=["S1"]),
        CASES["range-2d"].problem.flat(),
    ],
)
def test_other_noise_part_weights_biases_and_kinds_have_no_arrivals(problem):
    assert as_arrivals(problem) is None


def test_rows_of_other_kinds_are_kept_behind_the_arrivals():
    case = CASES["tdoa+azimuth-2d"]
    found = as_arrivals(case.problem.flat())
    assert [rows.kind for rows in found.problem.rows] == ["toa", "azimuth"]
    assert [rows.tolist() for rows in found.origin[-2:]] == [[5], [6]]
    assert found.problem.rows[1].z.tolist() == case.problem.flat().rows[1].z.tolist()


def test_vectors_return_to_the_order_of_a_layout_with_fewer_unknowns():
    problem = differences(arrival_sigma=SIGMA)
    layout, other = problem.layout, as_arrivals(problem).problem.layout
    assert [slot.name for slot in other.local] == ["emission"]
    assert restore_order(layout, other, np.array([[7.0, 8.0, 9.0]])).tolist() == [[7.0, 8.0]]
    assert shared_places(layout, other).tolist() == [0, 1]
