"""Gross rows of networks: weights, truncated costs, and rows that are found without a guess."""

import numpy as np
import pytest
from sites.calibration.scenes import hall

from optloc.sites.calibration import network_of, outliers as module
from optloc.sites.calibration.likelihood import likelihood
from optloc.sites.calibration.outliers import PRICE, outliers, reweighted, truncated, weights


def spoilt(seed=3, m=8, n=14, sigma=0.03):
    truth, z = hall(seed, m, n, sigma)
    wrong = np.zeros(z.shape, dtype=bool)
    wrong[2, 3] = wrong[7, 0] = wrong[11, 5] = True
    return truth, network_of(z + 3.0 * wrong, sigma), wrong


def test_weights_fall_with_the_fourth_power_beyond_the_median():
    given = np.ones((1, 5), dtype=bool)
    given[0, 4] = False
    found = weights(np.array([[[0.0, 1.0, 2.0, 300.0, 7.0]]]), given)[0, 0]
    assert found[:4] == pytest.approx((1.0 + (np.array([0.0, 1.0, 2.0, 300.0]) / 3.0) ** 2) ** -2.0)
    wide = weights(np.full((1, 1, 4), 10.0), np.ones((1, 4), dtype=bool))  # twice the median is 20
    assert wide == pytest.approx((1.0 + 0.25) ** -2.0)


def test_a_truncated_cost_has_a_price_for_each_gross_row():
    truth, net, wrong = spoilt()
    lik = likelihood(net)
    at, cost = truncated(lik, truth)
    square = lik.residual(at)[0] ** 2
    assert (square[wrong] > PRICE).all()
    assert cost[0] == pytest.approx(np.minimum(square, PRICE).sum(), rel=1e-9)
    clean = lik.refine(truth)[1][0]
    assert cost[0] < clean  # with all rows the gross ones bend the network


def test_rounds_of_weights_keep_a_network_that_most_rows_agree_with():
    truth, net, wrong = spoilt()
    lik = likelihood(net)
    at = reweighted(lik, truth, 5)
    assert (np.abs(lik.residual(at)[0][wrong]) > 50.0).all()


def test_gross_rows_are_found_without_a_guess(monkeypatch):
    # A few starts suffice for one gross row of a small hall.
    for name, count in (("_STARTS", 8), ("_BEST", 1), ("_SWEEPS", 1), ("_PLACES", 10)):
        monkeypatch.setattr(module, name, count)
    _, z = hall(3, 7, 8, 0.03)
    wrong = np.zeros(z.shape, dtype=bool)
    wrong[2, 3] = True
    np.testing.assert_array_equal(outliers(network_of(z + 3.0 * wrong, 0.03), 0), wrong)
