"""The search for a set of sites: enumeration, other solvers, rules, and mistakes that a test must catch."""

from dataclasses import replace

import numpy as np
import pytest
from often import few
from sites.placement.scenes import CASES, CRITERIA, every_set, task

import formulations.placement as theory
from optloc.sites.placement import best_set
from optloc.sites.placement.best_set import exchanged, random_sets, search


@pytest.fixture
def tree(monkeypatch):
    """Nothing is small enough to be looked at set by set: bounds alone decide."""
    monkeypatch.setattr(best_set, "_FEW", 0)
    monkeypatch.setattr(best_set, "_FEW_FAIL", 0)


def proven(one, gap=1e-6, **more):
    found = search(one, gap=gap, seconds=60.0, **more)
    assert found.closed
    return found


@pytest.mark.parametrize(("criterion", "worst", "fail"), CASES)
def test_the_set_is_that_of_enumeration(criterion, worst, fail, seed, tree):
    one = task(seed, 11, 4, 4, criterion, worst, fail)
    best = one.score(every_set(11, 4)).min()
    found = proven(one)
    assert found.best[0][0] == pytest.approx(best, rel=1e-9)
    assert found.bound <= best
    assert found.root <= best


def test_alternatives_are_sets_in_order_of_their_values():
    one = task(0, 11, 4, 4)
    found = proven(one, keep=4)
    values = [value for value, _ in found.best]
    assert values == sorted(values)
    assert len({chosen.tobytes() for _, chosen in found.best}) == len(values) == 4
    assert np.allclose([one.score(chosen[None])[0] for _, chosen in found.best], values)


def test_a_search_that_is_stopped_says_what_it_knows():
    one = task(1, 24, 8, 6, fail=True)
    found = search(one, gap=1e-9, seconds=0.02)
    assert not found.closed
    assert found.root <= found.bound < found.best[0][0]
    assert (np.diff(found.course[:, 1]) >= -1e-12).all()
    assert (np.diff(found.course[:, 2]) <= 1e-12).all()


def groups(n, seed):
    """Return rules: a budget, at most one of each three neighbours, at least two of the last half."""
    rng = np.random.default_rng(seed)
    cost = rng.uniform(0.2, 1.0, n)
    thirds = np.array([np.isin(np.arange(n), np.arange(i, i + 3)) for i in range(0, n, 3)], dtype=float)
    rules = np.vstack([np.ones(n), cost, thirds, -(np.arange(n) >= n // 2).astype(float)])
    return rules, np.concatenate([[4.0, 2.2], np.ones(len(thirds)), [-2.0]])


@pytest.mark.parametrize("few", [0, 20, 2000])
@pytest.mark.parametrize("criterion", CRITERIA)
def test_rules_are_met_and_the_set_is_the_best_of_those_that_do(criterion, few, seed, monkeypatch):
    monkeypatch.setattr(best_set, "_FEW", few)
    rules, limits = groups(12, seed)
    one = task(seed + 10, 12, 4, 4, criterion, rules=rules, limits=limits)
    sets = np.vstack([every_set(12, k) for k in range(2, 5)])
    allowed = sets[(sets @ rules.T <= limits + 1e-9).all(1)]
    found = proven(one)
    assert found.best[0][0] == pytest.approx(one.score(allowed).min(), rel=1e-9)
    assert one.fits(found.best[0][1][None])[0]


@pytest.mark.parametrize("fail", [False, True])
def test_a_budget_alone_is_a_rule(fail, seed):
    cost = np.random.default_rng(seed).uniform(0.3, 1.0, 11)
    one = task(seed, 11, 0, 4, fail=fail, rules=cost[None], limits=np.array([2.0]))
    sets = np.array(np.meshgrid(*[[0, 1]] * 11)).reshape(11, -1).T
    allowed = sets[sets @ cost <= 2.0]
    assert proven(one).best[0][0] == pytest.approx(one.score(allowed).min(), rel=1e-9)


def test_rules_that_allow_no_set_are_told():
    rules = np.array([np.ones(9), -np.ones(9)])
    found = search(task(0, 9, 3, 2, rules=rules, limits=np.array([3.0, -4.0])))
    assert found.best == ()


@pytest.mark.parametrize("worst", few([True, False], 1))
@pytest.mark.parametrize("criterion", CRITERIA)
def test_outer_approximation_agrees(criterion, worst):
    """Another method, another language of the functions, another solver."""
    one = task(3, 8, 4, 3, criterion, worst)
    found = theory.outer_approximation(
        one.design, one.rules, one.limits, criterion, worst=worst, close=lambda bound, v: v - bound <= 0.02 * abs(v)
    )
    best = one.score(every_set(8, 4)).min()
    assert found.value == pytest.approx(best, rel=0.02)
    assert found.bound <= best + 1e-6 * abs(best)
    assert proven(one).best[0][0] == pytest.approx(best, rel=1e-9)


@pytest.mark.parametrize("fail", few([True, False], 1))
def test_no_exchanged_random_set_is_below_the_bound(fail, seed):
    for criterion in CRITERIA:
        one = task(seed + 5, 20, 6, 6, criterion, fail=fail)
        found = search(one, seconds=60.0)
        values = [exchanged(one, chosen)[0] for chosen in random_sets(one, 20, seed)]
        assert min(values) >= found.bound


def test_permuted_sites_give_the_same_set():
    one, order = task(4, 11, 4, 4), np.random.default_rng(0).permutation(11)
    other = replace(one, design=replace(one.design, rows=one.design.rows[..., order]))
    mine, theirs = proven(one).best[0], proven(other).best[0]
    assert mine[0] == pytest.approx(theirs[0], rel=1e-12)
    assert (mine[1][order] == theirs[1]).all()


def test_another_candidate_never_makes_it_worse():
    whole = task(6, 12, 4, 4)
    part = replace(
        whole,
        design=replace(whole.design, rows=whole.design.rows[..., :10]),
        rules=whole.rules[:, :10],
        state=whole.state[:10],
    )
    assert proven(whole).best[0][0] <= proven(part).best[0][0] * (1 + 1e-12)


# Mistakes that tests of this page notice: each is made here, and seen.


def test_a_bound_with_the_gradients_sign_turned_would_be_seen():
    one = task(0, 9, 4, 3)
    w = np.full(9, 4 / 9)
    value, slope = theory.gradients(one.design, w, "A")
    sets = every_set(9, 4)
    right = one.design.weight @ value + (sets - w) @ (one.design.weight @ slope)
    wrong = one.design.weight @ value - (sets - w) @ (one.design.weight @ slope)
    scores = one.score(sets)
    assert (right <= scores).all()
    assert not (wrong <= scores).all()


def test_the_bound_is_not_the_incumbent():
    found = search(task(1, 20, 6, 6), seconds=60.0)
    assert found.bound < found.best[0][0]


def test_three_sites_need_the_prior():
    one = task(0, 9, 3, 3)
    assert np.isfinite(search(one, seconds=30.0).best[0][0])
    bare = replace(one, design=replace(one.design, prior=0.0 * one.design.prior))
    assert bare.score(every_set(9, 3)).min() > 1e12  # singular but for rounding


def test_a_leaf_that_fixing_leaves_is_scored(tree):
    """With one site to take every child is a leaf, and nothing is left to branch."""
    for k in (1, 8):
        one = task(2, 9, k, 3)
        assert proven(one).best[0][0] == pytest.approx(one.score(every_set(9, k)).min(), rel=1e-9)
