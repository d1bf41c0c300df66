"""A best-first search from nothing, against minima found from many starts."""

import numpy as np
import pytest
from proof.costs import random_case

from optloc.proof.best_first import FoundPlaces, SearchGoal, _is_due, _least, find_minima

pytestmark = pytest.mark.usefixtures("plainly")


def nowhere(x):
    region = np.stack([x - 1e5, x + 1e5])[None]
    return FoundPlaces(x[None], region, np.empty((1, 0, 3)), np.empty((1, 0)))


@pytest.mark.parametrize("kind", ["tdoa", "prior"])
def test_the_search_meets_the_least_minimum(kind):
    rng = np.random.default_rng(4)
    case, _ = random_case(rng, 2, kind=kind)
    best = case.minima(rng, starts=30)[0]
    points, boxes = find_minima(case.batch, nowhere(np.zeros(2)), 9.0, 120, 3)
    np.testing.assert_allclose(points[0, 0], best, atol=1e-2)
    assert boxes[0] <= 120
    costs = case.cost(points[0][np.isfinite(points[0, :, 0])])
    assert (np.diff(costs) >= 0.0).all()


def test_centres_descend_ever_more_seldom():
    assert [n for n in range(1, 20) if _is_due(n, True, 3)] == [1, 2, 4, 8, 16]
    assert [n for n in range(1, 20) if _is_due(3, True, n)] == [1, 2, 4, 8, 16]


def test_the_best_of_no_minima_costs_without_end():
    aim = SearchGoal(np.empty((0, 3)), np.empty(0), 9.0, 1e6, np.zeros((3, 2)), np.array([5.0, 2.0, 1.0]))
    assert _least(aim, 0) == np.inf
    assert _least(aim, 2) == 2.0
