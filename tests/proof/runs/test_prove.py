"""Proofs of runs by machine code: a minimum is unique, a slope is none; without machine code nothing is claimed."""

import numpy as np
import pytest
from proof.costs import down_from
from proof.runs.small import STATE, at_rest, course, residual, residual_at_rest
from scipy.optimize import least_squares

from optloc.kernels.jit import enabled, plain
from optloc.proof.batch import ProofRequest
from optloc.proof.global_search import UNBOUNDED
from optloc.proof.local_search import (
    ANOTHER,
    BETTER,
    BUDGET,
    CHEAPER,
    CLEAR,
    INFINITE,
    OTHER,
    SPENT,
    STATIONARY,
    UNIQUE,
    VALUE,
    Goal,
)
from optloc.proof.runs.prove import _verdict, prove_courses, prove_runs, runs_lack_code
from optloc.proof.runs.run_costs import course_costs, run_costs


def asked(x, low, high):
    n, d = x.shape
    region, none = np.tile(np.stack([low, high]), (n, 1, 1)), np.zeros(n, dtype=np.int64)
    gaps, nothing = np.tile(down_from(9.0), (n, 1)), np.zeros((n, 0, d))
    planes, surface = np.zeros((n, 0, 3)), np.zeros((n, 0))
    eps, budget = np.full(n, 1e-6), np.full(n, 400)
    return ProofRequest(x, nothing, none, none, gaps, eps, region, region, budget, planes, surface)


@pytest.mark.skipif(not enabled(), reason="runs are proven by machine code")
def test_the_minimum_of_a_run_is_proven_and_a_slope_is_not():
    best = least_squares(residual_at_rest, STATE[:2], xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    found = prove_runs(run_costs(at_rest()), asked(best[None], np.full(2, -1e4), np.full(2, 1e4)))
    assert found.verdict[0] == UNIQUE
    assert found.bound[0] == pytest.approx((residual_at_rest(best) ** 2).sum(), abs=1e-5)
    slope = prove_runs(run_costs(at_rest()), asked(best[None] + 100.0, np.full(2, -1e4), np.full(2, 1e4)))
    assert slope.verdict[0] in (STATIONARY, BETTER)


@pytest.mark.skipif(not enabled(), reason="runs are proven by machine code")
def test_the_minimum_of_a_course_is_proven_in_its_region():
    best = least_squares(residual, STATE, x_scale=[1.0, 1.0, 0.01, 0.01], xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    low, high = np.array([-1e4, -1e4, -50.0, -50.0]), np.array([1e4, 1e4, 50.0, 50.0])
    found = prove_courses(course_costs(course()), asked(best[None], low, high))
    assert found.verdict[0] == UNIQUE
    assert not found.everywhere[0]


def test_without_machine_code_nothing_is_claimed():
    with plain():
        costs = run_costs(at_rest())
        found = prove_runs(costs, asked(STATE[None, :2], np.full(2, -1e4), np.full(2, 1e4)))
        assert not runs_lack_code(costs, 1)  # there is none to wait for
    assert found.verdict[0] == BUDGET
    assert found.bound[0] == -np.inf


def test_outcomes_of_a_search_are_verdicts_on_the_fix():
    with plain():
        gap, value = Goal(9.0, 1.0, 1.0, False, 0, 0), Goal(1.0, 1.0, 1.0, False, 0, 0)
        assert (_verdict(CLEAR, gap), _verdict(CLEAR, value)) == (UNIQUE, VALUE)
        pairs = {SPENT: BUDGET, INFINITE: UNBOUNDED, CHEAPER: BETTER, ANOTHER: OTHER}
        assert {outcome: _verdict(outcome, gap) for outcome in pairs} == pairs
