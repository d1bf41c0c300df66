"""Sets of a node looked at one by one: enumeration, rules, rounding where little is known, mistakes."""

from dataclasses import replace

import numpy as np
import pytest
from sites.placement.scenes import CASES, every_set, task

from optloc.sites.placement.best_set import _enumerate, exchanged, random_sets
from optloc.sites.placement.completions import CompletionRequest

ALL = np.array(np.meshgrid(*[[0, 1]] * 9)).reshape(9, -1).T


def least(one, state, sets):
    """Return the least score of the sets that a node and the rules allow; infinite without one."""
    mine = (sets[:, state == 1] == 1).all(1) & (sets[:, state == 0] == 0).all(1) & one.fits(sets)
    return one.score(sets[mine]).min() if mine.any() else np.inf


@pytest.mark.parametrize(("criterion", "worst", "fail"), CASES)
def test_nodes_are_exhausted_as_enumeration_says(criterion, worst, fail, seed):
    one, rng = task(seed + 60, 10, 5, 3, criterion, worst, fail), np.random.default_rng(seed)
    sets, asked = every_set(10, 5), one.asked()
    for _ in range(30):
        order = rng.permutation(10)
        state, inside = np.full(10, -1), rng.integers(0, 5)
        state[order[:inside]], state[order[inside : inside + rng.integers(0, 6)]] = 1, 0
        best = least(one, state, sets)
        value, found = _enumerate(asked, state, rng.random(10), np.inf)
        if (state >= 0).all() or not np.isfinite(best):
            continue
        assert value == pytest.approx(best, rel=1e-9)
        assert one.score(found[None])[0] == pytest.approx(best, rel=1e-9)
        assert one.fits(found[None])[0]
        # a limit just above the best lets it pass, one just below does not
        step = 1e-7 * abs(best)
        assert _enumerate(asked, state, rng.random(10), best + step)[0] == pytest.approx(best, rel=1e-9)
        assert not _enumerate(asked, state, rng.random(10), best - step)[1].any()


@pytest.mark.parametrize("fail", [False, True])
def test_budgets_groups_and_demands_are_met(fail, seed):
    rng = np.random.default_rng(seed)
    cost = rng.uniform(0.2, 1.0, 9)
    rules = np.vstack([cost, np.arange(9) % 3 == 0, -(np.arange(9) > 5).astype(float)])
    one = task(seed, 9, 0, 3, fail=fail, rules=rules, limits=np.array([2.5, 1.0, -2.0]))
    for _ in range(20):
        state = np.where(rng.random(9) < 0.2, rng.integers(0, 2, 9), -1)
        best = least(one, state, ALL)
        value, found = _enumerate(one.asked(), state, rng.random(9), np.inf)
        if np.isfinite(best) and (state == -1).any():
            # without an addition that fits, the node itself is the set: that is not asked of it
            own = least(one, np.where(state == -1, 0, state), ALL)
            assert min(value, own) == pytest.approx(best, rel=1e-9)
        else:
            assert not found.any()


@pytest.mark.parametrize("wide", [1e3, 1e7])
@pytest.mark.parametrize("fail", [False, True])
def test_priors_that_know_nothing_leave_no_rounding(wide, fail):
    """Three of four unknowns measured: an update then takes differences of very large numbers."""
    one = task(4, 9, 4, 3, fail=fail)
    prior = np.tile(np.diag([wide**-2] * 3 + [0.01 * wide**-2]), (3, 1, 1))
    one = replace(one, design=replace(one.design, prior=prior))
    value, _ = _enumerate(one.asked(), np.full(9, -1), np.zeros(9), np.inf)
    assert value == pytest.approx(one.score(every_set(9, 4)).min(), rel=1e-7)


def test_sites_with_several_rows_are_updated_row_by_row():
    one = task(5, 9, 4, 3)
    rows = np.random.default_rng(1).normal(size=(3, 2, 4, 9)) * 0.5
    for fail in (False, True):
        two = replace(one, fail=fail, design=replace(one.design, rows=rows))
        value, _ = _enumerate(two.asked(), np.full(9, -1), np.zeros(9), np.inf)
        assert value == pytest.approx(two.score(every_set(9, 4)).min(), rel=1e-9)


def test_no_exchange_improves_what_was_exchanged(seed):
    one = task(seed, 12, 5, 4, fail=True)
    for start in random_sets(one, 3, seed):
        value, chosen = exchanged(one, start)
        assert value == pytest.approx(one.score(chosen[None])[0], rel=1e-12)
        out, into = np.flatnonzero(chosen == 1), np.flatnonzero(chosen == 0)
        tries = np.repeat(chosen[None], len(out) * len(into), axis=0)
        number = np.arange(len(tries))
        tries[number, np.repeat(out, len(into))], tries[number, np.tile(into, len(out))] = 0, 1
        assert one.score(tries).min() >= value * (1 - 1e-9)


def test_a_last_site_that_is_not_lost_would_be_seen():
    """The pruning of pairs rests on the loss of the last: without losses, few of the sets that it drops are bad."""
    one = task(3, 10, 5, 3, fail=True)
    spared = CompletionRequest(*one.asked()[:7], 0, *one.asked()[8:])
    sets = every_set(10, 5)
    assert _enumerate(spared, np.full(10, -1), np.zeros(10), np.inf)[0] < 0.95 * one.score(sets).min()
