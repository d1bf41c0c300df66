"""The cost with other unknowns at their best, its departure from a Gaussian, and infinity, against plain formulas."""

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import assemble, measured, with_bias
from optloc.model_checks.shape import cost_at_infinity, departure, profile


def test_the_profile_over_an_emission_time_is_the_scatter_of_the_residuals():
    z = np.linalg.norm(PLACE - SQUARE, axis=1) + 700.0 + np.array([1.0, -2.0, 0.5, 3.0, -1.0])
    problem = assemble(SQUARE, measured("toa", z, a=np.arange(5), sigma=2.0)).flat()
    there = np.array([[350.0, 600.0], [100.0, 900.0]])
    x = np.concatenate([there, np.zeros((2, problem.layout.size - 2))], axis=1)[:, None]
    cost, _, vector = profile(problem, x, x[0])

    def plain(place):
        left = (z - np.linalg.norm(place - SQUARE, axis=1)) / 2.0
        return ((left - left.mean()) ** 2).sum()

    np.testing.assert_allclose(cost[:, 0], [plain(place) for place in there], rtol=1e-9)
    step = 1e-3 * np.eye(2)
    slope = [(plain(there[0] + one) - plain(there[0] - one)) / 2e-3 for one in step]
    np.testing.assert_allclose(-2.0 * vector[0, 0], slope, rtol=1e-6)


def test_a_common_bias_is_projected_out_of_slope_and_information():
    z = np.linalg.norm(PLACE - SQUARE, axis=1) + np.array([1.0, -2.0, 0.5, 3.0, -1.0])
    problem = assemble(SQUARE, measured("range", z, a=np.arange(5), sigma=2.0))
    problem = with_bias(problem, "late", form="offset", per="kind").flat()
    there = np.array([350.0, 600.0])
    cost, information, vector = profile(problem, np.append(there, 0.0)[None, None], np.zeros((1, 3)))
    line = there - SQUARE
    r = np.linalg.norm(line, axis=1)
    J, left = line / r[:, None] / 2.0, (z - r) / 2.0
    J, left = J - J.mean(0), left - left.mean()
    assert cost[0, 0] == pytest.approx(left @ left)
    np.testing.assert_allclose(information[0, 0], J.T @ J, rtol=1e-9)
    np.testing.assert_allclose(vector[0, 0], J.T @ left, rtol=1e-9)


def test_a_fine_fix_is_more_gaussian_than_a_coarse_one():
    J = (PLACE - SQUARE) / np.linalg.norm(PLACE - SQUARE, axis=1, keepdims=True)
    centre = SQUARE.mean(0)[None]

    def departs(sigma):
        covariance = sigma**2 * np.linalg.inv(J.T @ J)[None]
        return departure(ranges_to(PLACE, sigma), PLACE[None], covariance, (), centre)[0, 0]

    assert departs(0.1) < 0.01 < departs(10.0) < departs(100.0)


def test_infinity_costs_what_the_best_plane_wave_does():
    z = np.array([-800.0, -900.0, 100.0, -300.0])
    problem = assemble(SQUARE, measured("tdoa", z, a=np.arange(1, 5), b=0, sigma=50.0)).flat()
    turn = np.linspace(0.0, 2.0 * np.pi, 20001)
    waves = -np.stack([np.cos(turn), np.sin(turn)], axis=-1) @ (SQUARE[1:] - SQUARE[0]).T
    least = (((z - waves) / 50.0) ** 2).sum(-1).min()
    assert cost_at_infinity(problem, PLACE[None])[0] == pytest.approx(least, rel=1e-3)
