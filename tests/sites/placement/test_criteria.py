"""Criteria, gradients and bounds of a relaxed choice: differences, other code paths, a semidefinite programme."""

import numpy as np
import pytest
from sites.placement.scenes import CASES, CRITERIA, design, every_set, task

import formulations.placement as theory
from optloc.sites.placement.branching import expand, propagate, settle


def relaxed(one, steps=80, enough=np.nan, state=None):
    """Return bound, criterion, weights and costs of the relaxation."""
    n = len(one.state)
    state = np.array(one.state if state is None else state)
    w, cost, d = np.full(n, 0.5), np.empty(n), one.design
    head = (np.ascontiguousarray(d.rows), d.prior, d.weight, d.dimension, one.rules, one.limits)
    bound, value, _ = expand(*head, one.kind, int(one.worst), int(one.fail), state, w, enough, steps, cost)
    return bound, value, w, cost


@pytest.mark.parametrize("criterion", CRITERIA)
def test_gradients_are_those_of_differences_and_tangents_lie_below(criterion):
    one, rng, h = design(3, 9, 3), np.random.default_rng(0), 1e-6
    w = rng.uniform(0.1, 1.0, 9)
    value, slope = theory.gradients(one, w, criterion)
    steps = w + h * np.vstack([np.eye(9), -np.eye(9)])
    ahead = theory.of_places(theory.covariances(one, steps), criterion)
    assert np.allclose((ahead[:9] - ahead[9:]).T / (2 * h), slope, rtol=3e-5, atol=1e-7)
    others = rng.uniform(0.0, 1.0, (2000, 9))
    reached = theory.of_places(theory.covariances(one, others), criterion)
    below = value + (others - w) @ slope.T
    assert (reached >= below - 1e-9 * np.abs(reached)).all()


def test_the_linear_cut_of_the_least_eigenvalue_holds():
    """With S v = lambda v and y = [v; -M_oo^-1 M_ox v]: lambda_min(w) <= y'M(w)y for any w, exact at the point."""
    one, rng = design(5, 9, 1), np.random.default_rng(1)

    def information(w):
        return one.prior[0] + np.einsum("mn,n,kn->mk", one.rows[0, 0], w, one.rows[0, 0])

    w = rng.uniform(0.1, 1.0, 9)
    m = information(w)
    schur = np.linalg.inv(np.linalg.inv(m)[:3, :3])
    values, vectors = np.linalg.eigh(schur)
    v = vectors[:, 0]
    y = np.append(v, -m[3, :3] @ v / m[3, 3])
    assert y @ m @ y == pytest.approx(values[0], rel=1e-9)
    for other in rng.uniform(0.0, 1.0, (2000, 9)):
        least = np.linalg.eigvalsh(np.linalg.inv(np.linalg.inv(information(other))[:3, :3]))[0]
        assert least <= y @ information(other) @ y * (1 + 1e-9)


@pytest.mark.parametrize(("criterion", "worst", "fail"), CASES)
def test_machine_code_scores_sets_as_numpy_does(criterion, worst, fail):
    one = task(2, 8, 4, 3, criterion, worst, fail)
    sets = every_set(8, 4)
    assert np.allclose(one.score(sets), theory.value(one.design, sets, criterion, worst=worst, fail=fail), rtol=1e-9)


@pytest.mark.parametrize(("criterion", "worst", "fail"), CASES)
def test_the_bound_of_a_relaxation_is_never_above_a_set(criterion, worst, fail, seed):
    """At every number of steps, so that multipliers that are far from right are tried too; and in nodes."""
    one = task(seed + 40, 8, 4, 3, criterion, worst, fail)
    sets = every_set(8, 4)
    scores = one.score(sets)
    for steps in (1, 2, 3, 5, 60):
        bound, _, _, cost = relaxed(one, steps)
        assert bound <= scores.min()
        # what fixing says: the bound with a site the other way round
        lifted = [scores[sets[:, j] == (1 if cost[j] > 0 else 0)].min() for j in range(8)]
        assert (bound + np.abs(cost) <= np.array(lifted) * (1 + 1e-9) + 1e-9).all()
    state = np.full(8, -1)
    state[0], state[1] = 1, 0
    bound, _, _, _ = relaxed(one, state=state)
    assert bound <= scores[(sets[:, 0] == 1) & (sets[:, 1] == 0)].min()


@pytest.mark.parametrize("worst", [False, True])
@pytest.mark.parametrize("criterion", CRITERIA)
def test_the_relaxation_is_that_of_the_semidefinite_programme(criterion, worst):
    one = task(7, 14, 6, 5, criterion, worst)
    bound, value, _, _ = relaxed(one)
    exact, w = theory.semidefinite(one.design, one.rules, one.limits, criterion, worst=worst)
    assert float(theory.value(one.design, np.clip(w, 0, 1), criterion, worst=worst)) == pytest.approx(exact, rel=1e-3)
    # the largest eigenvalue is smoothed: its bound is lower by half a per cent at the most
    assert bound == pytest.approx(exact, rel=6e-3 if criterion == "E" else 1e-3)
    assert bound <= exact * (1 + 1e-6 * np.sign(exact)) + 1e-6
    assert value >= exact - 1e-3 * abs(exact)


def test_a_failure_among_all_is_one_among_the_chosen():
    one, rng = design(9, 10, 4), np.random.default_rng(2)
    sets = (rng.random((200, 10)) < 0.5).astype(int)
    whole = theory.value(one, sets, "A", fail=True)
    for chosen, value in zip(sets, whole, strict=True):
        lost = np.repeat(chosen[None], max(1, chosen.sum()), 0)
        if chosen.any():
            lost[np.arange(len(lost)), np.flatnonzero(chosen)] = 0
        assert theory.value(one, lost, "A").max() == pytest.approx(value, rel=1e-9)


def test_rules_fix_what_they_leave_no_choice_of():
    rules = np.array([[1.0, 1, 1, 1], [0, 0, -1, -1], [1, 1, 0, 0]])
    state = np.array([-1, -1, -1, 0])
    assert propagate(rules, np.array([2.0, -1, 1]), state)  # one of the last two, and only the third is left
    assert state.tolist() == [-1, -1, 1, 0]
    assert not propagate(rules, np.array([2.0, -2, 1]), np.array([-1, -1, -1, 0]))
    assert settle(1.0, np.array([0.5, -0.5, 2.0, -2.0]), 2.0, free := np.full(4, -1)) == 2
    assert free.tolist() == [-1, -1, 0, 1]
