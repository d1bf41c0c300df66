"""Placements: the best of all sets by enumeration, what each answer tells, and sets that are not to come again."""

from dataclasses import replace

import numpy as np
import pytest
from sites.placement.scenes import every_set, hall

from formulations.placement import covariances
from optloc import place
from optloc.sites.placement import CountGroup, SiteSelection
from optloc.sites.placement.chosen import _ban_sets, _bounds_after_loss, _next_sites, _swaps, task_of
from optloc.sites.placement.sites import candidates_of


@pytest.fixture(scope="module")
def selection():
    problem, places = hall(n=7, places=3)
    return SiteSelection(problem, places, choose=4, gap=1e-6)


@pytest.fixture(scope="module")
def found(selection):
    return place(selection)


def variances_of(selection, sets):
    design = candidates_of(selection).design
    return np.trace(covariances(design, sets), axis1=-2, axis2=-1)


def test_the_best_set_is_that_of_enumeration(selection, found):
    sets = every_set(7, 4)
    values = variances_of(selection, sets) @ np.full(3, 1 / 3)
    assert found.value == pytest.approx(values.min(), rel=1e-9)
    assert found.bound <= found.value
    assert found.closed
    names = np.array(selection.problem.stations.names)
    assert set(found.chosen) == set(names[sets[values.argmin()] == 1])
    known = {frozenset(names[one == 1]): value for one, value in zip(sets, values, strict=True)}
    for chosen, value in found.alternatives:
        assert value == pytest.approx(known[frozenset(chosen)], rel=1e-9)


def test_an_answer_has_the_bound_of_each_place(selection, found):
    names = np.array(selection.problem.stations.names)
    chosen = np.isin(names, found.chosen).astype(float)
    assert found.per_place == pytest.approx(np.sqrt(variances_of(selection, chosen)), rel=1e-9)
    assert found.sigma == pytest.approx(np.sqrt((found.per_place**2).mean()), rel=1e-9)


def test_what_each_loss_costs_and_each_addition_gains_are_sets_of_their_own(selection):
    candidates = candidates_of(selection)
    task, chosen, names = task_of(candidates), np.array([1, 1, 1, 1, 1, 0, 0]), candidates.names
    lost = np.array([np.where(np.arange(7) == i, 0, chosen) for i in range(5)])
    each = variances_of(selection, lost)
    assert _bounds_after_loss(candidates, chosen) == pytest.approx(np.sqrt(each.max(axis=0)), rel=1e-9)
    costs = {swap.name: swap.value for swap in _swaps(candidates, chosen)}
    assert [costs[name] for name in names[:5]] == pytest.approx(each.mean(axis=1), rel=1e-9)
    more = np.array([np.where(np.arange(7) == i, 1, chosen) for i in (5, 6)])
    gained = dict(_next_sites(task, names, chosen))
    assert [gained[name] for name in names[5:]] == pytest.approx(variances_of(selection, more).mean(axis=1), rel=1e-9)


def test_a_banned_set_is_the_only_one_that_is_not_allowed(selection):
    task, sets = task_of(candidates_of(selection)), every_set(7, 4)
    assert task.fits(sets).all()
    left = _ban_sets(task, [sets[3], sets[8]]).fits(sets)
    assert np.flatnonzero(~left).tolist() == [3, 8]


def test_a_lost_station_that_was_kept_has_a_replacement_beyond_the_new_sites(selection):
    """Four kept stations and one new site: the replacement of a kept station is the best other candidate."""
    names = selection.problem.stations.names
    own = replace(selection, kept=names[:4], choose=1)
    swaps = {swap.name: swap for swap in place(own).swaps}
    new = next(name for name in swaps if name not in own.kept)
    left = [name for name in names[4:] if name != new]
    for name in own.kept:
        sets = np.array([np.isin(names, [*(set(swaps) - {name}), other]).astype(int) for other in left])
        each = variances_of(own, sets).mean(axis=1)
        assert swaps[name].replacement == left[each.argmin()]
        assert swaps[name].replaced == pytest.approx(each.min(), rel=1e-9)
    full = replace(own, groups=(CountGroup(names, most=5),))
    assert all(swap.replacement for swap in place(full).swaps)
    closed = replace(own, groups=(CountGroup(left, most=0),))
    assert [swap.replacement for swap in place(closed).swaps] == [""] * 5
