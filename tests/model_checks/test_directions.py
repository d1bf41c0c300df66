"""The cost over direction and inverse range, against ranges written down plainly."""

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc.model_checks.directions import DirectionCost, _false_position, minima_of


def cost(place):
    away = np.linalg.norm(np.asarray(place)[:, None] - SQUARE, axis=-1) - np.linalg.norm(PLACE - SQUARE, axis=-1)
    return ((away / 5.0) ** 2).sum(-1)


def test_a_look_in_a_direction_is_the_cost_at_its_place_and_its_slope():
    view = DirectionCost.of(ranges_to(PLACE, 5.0))
    turn, v = np.array([0.3, 2.0, 4.5]), np.array([0.2, 0.7, 2.0])

    def at(turn, v):
        u = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        return u, cost(view.centre + view.spread / v[:, None] * u)

    u, expected = at(turn, v)
    found, _, vector = view.evaluate(u, v)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    slope = (at(turn, v + 1e-6)[1] - at(turn, v - 1e-6)[1]) / 2e-6
    np.testing.assert_allclose(-2.0 * vector[:, -1], slope, rtol=1e-5)


def test_the_least_minimum_of_exact_ranges_is_the_target():
    view = DirectionCost.of(ranges_to(PLACE, 5.0))
    found = minima_of(view, 1.0)
    assert found.cost[0] == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(view.positions(found.u[:1], found.v[:1])[0], PLACE, atol=1e-2)


def test_false_positions_end_at_the_zeros_of_functions():
    goal = np.array([2.0, 9.0])

    def at(x, guess):
        return x**2 - goal, guess

    low, high = np.zeros(2), np.full(2, 10.0)
    root = _false_position(at, (low, -goal), (high, 100.0 - goal), low)
    assert np.abs(root**2 - goal).max() <= 1e-2
