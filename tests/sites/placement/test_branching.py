"""Nodes of the search for sites: what rules fix is what all sets have in common, and scores are those of numpy."""

from itertools import product

import numpy as np
import pytest
from sites.placement.scenes import design, every_set

from optloc.kernels.jit import plain
from optloc.sites.placement.branching import FREE, IN, OUT, number_left, propagate, score, settle


def sets_of(rules, limits, state):
    """Return all sets that meet rules and leave what is fixed."""
    every = np.array(list(product((OUT, IN), repeat=rules.shape[1])))
    fits = (every @ rules.T <= limits + 1e-9).all(axis=1) & ((state == FREE) | (every == state)).all(axis=1)
    return every[fits]


def test_what_rules_fix_is_common_to_all_sets_or_harmless(seed):
    rng = np.random.default_rng(seed + 11)
    for _ in range(40):
        rules = rng.integers(-2, 4, (3, 6)).astype(float)
        rules[0] = np.abs(rules[0])
        limits, state = rng.integers(0, 6, 3).astype(float), rng.choice([FREE, FREE, FREE, OUT, IN], 6)
        before, after = sets_of(rules, limits, state), state.copy()
        with plain():
            left = propagate(rules, limits, after)
        if not len(before):
            continue  # some nodes without a set are found out later
        assert left
        kept = sets_of(rules, limits, after)
        # What is taken because all fit may leave out sets, but each of them is part of a set that stays.
        assert all((kept >= one).all(axis=1).any() for one in before)


def test_so_many_sites_are_left_as_the_cheapest_allow():
    rule = np.array([3.0, 1.0, 2.0, 5.0, 1.0])
    state = np.array([IN, FREE, FREE, FREE, OUT])
    with plain():
        numbers = [number_left(rule, limit, state) for limit in (3.0, 4.0, 6.0, 11.0)]
    assert numbers == [0, 1, 2, 3]


def test_a_site_is_settled_where_its_other_value_lifts_the_bound_to_enough():
    state = np.array([FREE, FREE, FREE, IN])
    with plain():
        assert settle(1.0, np.array([1.0, -1.0, 0.5, 9.0]), 2.0, state) == 2
    assert state.tolist() == [OUT, IN, FREE, IN]


@pytest.mark.parametrize("worst", [False, True])
def test_the_score_of_a_set_is_the_trace_of_its_covariance(worst):
    one, sets = design(3, 5, 2), every_set(5, 4)
    with plain():
        found = score(one.rows, one.prior, one.weight, one.dimension, 0, int(worst), 0, sets)
    for chosen, value in zip(sets, found, strict=True):
        lines = one.rows[:, 0, :, chosen == IN]  # (4, P, m)
        matrix = one.prior + np.einsum("npi,npk->pik", lines, lines)
        traces = np.trace(np.linalg.inv(matrix)[:, :3, :3], axis1=1, axis2=2)
        assert value == pytest.approx(traces.max() if worst else traces.mean(), rel=1e-9)
