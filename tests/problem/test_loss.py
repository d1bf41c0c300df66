"""Losses: their weights are the derivative of their cost, their constants give what they promise."""

import numpy as np
import pytest
from scipy.integrate import quad

from optloc.problem.loss import LOSSES

GRID = np.linspace(-30.0, 30.0, 6001) + 1e-4


@pytest.fixture(params=LOSSES.values(), ids=list(LOSSES))
def loss(request):
    return request.param


def _normal(u):
    return np.exp(-0.5 * u**2) / np.sqrt(2.0 * np.pi)


def _expected(function, loss):
    kinks = [-loss.constant, 0.0, loss.constant]
    return quad(lambda u: function(u) * _normal(u), -10.0, 10.0, points=kinks, limit=400)[0]


def test_the_weight_is_half_the_slope_of_the_cost_over_the_residual(loss):
    away = np.abs(np.abs(GRID) - loss.constant) > 1e-3
    slope = (loss.rho(GRID + 1e-6) - loss.rho(GRID - 1e-6)) / 2e-6
    np.testing.assert_allclose((0.5 * slope / GRID)[away], loss.weight(GRID)[away], atol=1e-6)


def test_small_residuals_cost_their_square_and_no_residual_costs_more(loss):
    assert loss.rho(np.array(1e-3)) == pytest.approx(1e-6, rel=1e-5)
    assert np.all(loss.rho(GRID) <= GRID**2 + 1e-12)
    assert np.all((loss.weight(GRID) >= 0.0) & (loss.weight(GRID) <= 1.0))


def test_a_wild_residual_hardly_pulls(loss):
    # Of a residual of a thousand sigma least squares would make a pull of a thousand.
    assert loss.weight(np.array(1e3)) * 1e3 <= 1.5


def test_only_late_arrivals_are_doubted():
    assert LOSSES["late"].weight(np.array(-50.0)) == 1.0
    assert LOSSES["late"].weight(np.array(50.0)) < 0.01
    assert [name for name, loss in LOSSES.items() if loss.one_sided] == ["late"]


def test_clean_data_lose_a_few_percent(loss):
    psi_squared = _expected(lambda u: (loss.weight(u) * u) ** 2, loss)
    slope = _expected(lambda u: loss.weight(u) * u * u, loss)
    assert slope**2 / psi_squared == pytest.approx(0.99 if loss.name == "truncated" else 0.95, abs=2e-4)
    assert loss.efficiency == pytest.approx(slope**2 / psi_squared, rel=1e-6)
    assert loss.psi_squared == pytest.approx(psi_squared, rel=1e-6)
    assert loss.slope == pytest.approx(slope, rel=1e-6)


def test_the_expected_slope_is_that_of_psi_where_it_has_one():
    for name in ("huber", "cauchy", "late"):
        loss = LOSSES[name]
        slope = _expected(
            lambda u, k=loss: ((u + 1e-6) * k.weight(u + 1e-6) - (u - 1e-6) * k.weight(u - 1e-6)) / 2e-6, loss
        )
        assert loss.slope == pytest.approx(slope, rel=1e-5)


def test_the_mean_of_many_clean_values_has_the_promised_spread(loss):
    rng = np.random.default_rng(3)
    values, mean = rng.standard_normal((4000, 25)), np.zeros((4000, 1))
    for _ in range(60):
        weight = loss.weight(values - mean)
        mean = (weight * values).sum(1, keepdims=True) / weight.sum(1, keepdims=True)
    promised = (loss.spread / weight.sum(1)).mean()
    # A loss that doubts one side only is off by -E psi / E psi' when nothing is late, however many rows there are.
    bias = _expected(lambda u: loss.weight(u) * u, loss) / loss.slope
    assert abs(bias) < (0.12 if loss.one_sided else 1e-9)
    assert mean.mean() == pytest.approx(bias, abs=0.015)
    assert (mean[:, 0] ** 2).mean() <= 1.1 * promised + bias**2
    assert mean.var() == pytest.approx(promised, rel=0.15)
