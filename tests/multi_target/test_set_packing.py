"""Sets of least cost that share no row, against a search through all of them, and the bound of their prices."""

import numpy as np
import pytest
from multi_target.brute import packed

from optloc.multi_target.set_packing import cheapest_sets, price_rows
from optloc.multi_target.sets import Tuples


def test_the_packing_is_the_best_and_its_prices_bound_it():
    rng = np.random.default_rng(0)
    picks = np.array([[rng.integers(-1, 3) for _ in range(4)] for _ in range(60)])
    picks = np.unique(picks[(picks >= 0).sum(-1) > 1], axis=0)
    cost = rng.normal(-3.0, 4.0, len(picks))
    tuples = Tuples(picks, np.zeros((len(picks), 2)), cost)
    numbered = np.where(picks >= 0, picks + 3 * np.arange(4), -1)
    taken, total = cheapest_sets(tuples, 3, None)
    assert total == pytest.approx(packed(numbered, cost)[0])
    for count in (None, 1, 2):
        taken, total = cheapest_sets(tuples, 3, count)
        prices = price_rows(tuples, taken, np.ones((4, 3)), count)
        reduced = prices.reduced(tuples).min()
        assert reduced > -1e-6
        assert prices.bound(count, 6, reduced) <= total + 1e-6
