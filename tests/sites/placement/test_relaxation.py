"""Parts of the relaxed choice against linear programmes, their definitions, and sets one by one."""

import numpy as np
import pytest
from scipy.optimize import linprog
from sites.placement.scenes import every_set, task

from formulations.placement import covariances, gradients, of_places
from optloc.kernels.jit import plain
from optloc.sites.placement.relaxation import advance, barrier_weights, begin, bound_at, cheapest, meets, product


def test_the_cheapest_weights_are_those_of_a_linear_programme(seed):
    rng = np.random.default_rng(seed + 5)
    for _ in range(30):
        cost, size = rng.standard_normal(7), rng.choice([0.0, 0.5, 1.0, 2.0], 7)
        most, at = rng.uniform(0.0, 5.0), np.empty(7)
        with plain():
            least, multiplier = cheapest(cost, size, most, at)
        wanted = linprog(cost, size[None], [most], bounds=(0.0, 1.0))
        assert least == pytest.approx(wanted.fun, abs=1e-9)
        assert cost @ at == pytest.approx(least, abs=1e-12)
        assert size @ at <= most + 1e-12
        # Duality: with the right multiplier the rule may be left out.
        assert np.minimum(cost + multiplier * size, 0.0).sum() - multiplier * most == pytest.approx(least, abs=1e-9)


def test_multipliers_of_a_smoothed_maximum_are_shares_that_favour_the_largest():
    values, weights = np.array([1.0, 3.0, 2.9, -4.0]), np.empty(4)
    with plain():
        barrier_weights(values, 0.1, weights)
    assert weights.sum() == pytest.approx(1.0)
    assert np.argsort(weights).tolist() == [3, 0, 2, 1]
    # mu / (t - f) with one t for all
    assert np.ptp(values + 0.1 / weights) < 1e-9


def test_a_node_begins_with_equal_products_of_slacks_and_multipliers():
    w, rules, limits = np.array([0.2, 0.7, 0.5]), np.array([[1.0, 1.0, 1.0]]), np.array([2.0])
    left, duals = np.empty(1), np.empty(7)
    with plain():
        begin(w, left, duals, rules, limits, 0.3)
        mean = product(w, left, duals, 0.0, np.zeros(1), np.ones(1))
        assert meets(w, rules, limits)
        assert not meets(w + 0.3, rules, limits)
    assert left == pytest.approx([0.6])
    assert np.concatenate([duals[:3] * w, duals[3:6] * (1.0 - w), duals[6:] * left]) == pytest.approx([0.3] * 7)
    assert mean == pytest.approx(0.3)


def test_multipliers_stay_positive():
    duals = np.array([1.0, 2.0])
    with plain():
        advance(duals, np.array([-4.0, 1.0]))
    assert duals == pytest.approx([0.1, 2.225])  # nine tenths of the way to zero


@pytest.mark.parametrize("criterion", ["A", "D"])
def test_a_tangent_with_any_multipliers_is_below_every_set(criterion, seed):
    rng = np.random.default_rng(seed + 3)
    one = task(
        seed + 3, 6, 3, 2, criterion, rules=np.array([[1.0] * 6, [0.0, 0, 0, 1, 1, 1]]), limits=np.array([3.0, 2])
    )
    sets = every_set(6, 3)
    sets = sets[sets @ one.rules[1] <= 2.0]
    w = rng.uniform(0.2, 0.8, 6)
    each, slopes = gradients(one.design, w, criterion)
    low, slope = float(one.design.weight @ each), one.design.weight @ slopes
    duals, reduced, at = np.concatenate([np.zeros(13), [rng.uniform(0.0, 0.5)]]), np.empty(6), np.empty(6)
    with plain():
        bound = bound_at(w, low, slope, duals, one.rules, one.limits, reduced, at)
    values = of_places(covariances(one.design, sets), criterion) @ one.design.weight
    assert bound < values.min()
