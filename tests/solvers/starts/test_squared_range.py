"""Squared-range rows: exact data satisfy them, whatever their kind, and all picks find the target."""

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE

from optloc import assemble, measured
from optloc.linear.least_squares_ranges import ranges
from optloc.solvers.starts.squared_range import candidates, hull, minimum, shor, squared_rows, stationary_points

A = np.arange(5)
R = np.linalg.norm(PLACE - SQUARE, axis=1)
AZIMUTH = np.arctan2(*(PLACE - SQUARE).T[::-1])
ROWS = {
    "range": lambda: [measured("range", R, a=A, sigma=1.0)],
    "tdoa": lambda: [measured("tdoa", R[1:] - R[0], a=A[1:], b=0, sigma=1.0)],
    "toa": lambda: [measured("toa", R + 500.0, a=A, sigma=1.0)],
    "range_sum": lambda: [measured("range_sum", R[1:] + R[0], a=A[1:], b=0, sigma=1.0)],
    "azimuth": lambda: [measured("azimuth", AZIMUTH, a=A, sigma=0.01)],
    "tdoa+azimuth": lambda: [*ROWS["tdoa"](), measured("azimuth", AZIMUTH[[2]], a=[2], sigma=0.01)],
    "tdoa+groa": lambda: [*ROWS["tdoa"](), measured("groa", R[1:] / R[0], a=A[1:], b=0, sigma=0.01)],
}


@pytest.mark.parametrize("kinds", list(ROWS))
def test_the_target_of_exact_data_satisfies_all_rows(kinds):
    problem = assemble(SQUARE, *ROWS[kinds]()).flat()
    found = ranges(problem)
    squared = squared_rows(problem, found)
    y = (PLACE - squared.origin[0]) / squared.scale[0]
    last = np.linalg.norm(y) if squared.quadric.shape == "cone" else y @ y
    full = np.append(y, last)
    np.testing.assert_allclose(squared.ranged[0] @ full, squared.ranged_right[0], atol=1e-9)
    for other in squared.others:
        np.testing.assert_allclose(other.row[0] @ full, other.right[0], atol=1e-9)
    points = candidates(problem, found, stationary_points)[0]
    assert np.nanmin(np.linalg.norm(points - PLACE, axis=-1)) < 1e-4


@pytest.mark.parametrize("pick", [minimum, shor, hull])
def test_each_pick_finds_the_target_of_exact_differences(pick):
    problem = assemble(SQUARE, *ROWS["tdoa"]()).flat()
    points = candidates(problem, ranges(problem), pick)[0]
    assert np.nanmin(np.linalg.norm(points - PLACE, axis=-1)) < 1.0


def test_a_row_less_than_unknowns_leaves_two_points():
    problem = assemble(SQUARE[:2], measured("range", R[:2], a=A[:2], sigma=1.0)).flat()
    points = candidates(problem, ranges(problem), minimum)[0]
    np.testing.assert_allclose(np.sort(points[:, 1]), [-PLACE[1], PLACE[1]], atol=1e-6)
