"""Fixes from outside: as a pool they have the verdict that they came with."""

import numpy as np
import pytest
from cases import CASES

import optloc
from optloc.solvers.outside import accept
from optloc.solvers.verdict.judge import judge


@pytest.mark.parametrize("method", ["gtrs", "gtrs+lsr", "cauchy", "robust"])
@pytest.mark.parametrize("name", ["tdoa-3d", *list(CASES)[:2]])
def test_a_fix_that_is_accepted_is_judged_as_it_was(name, method):
    case = CASES[name]
    problem = optloc.simulate(case.problem, truth=np.tile(np.asarray(case.truth), (3, 1)), seed=4)
    fix = optloc.solve(problem, method)
    again = judge(problem, accept(problem, fix))
    assert again.code.tolist() == fix.code.tolist()
    np.testing.assert_array_equal(again.x, fix.x)
