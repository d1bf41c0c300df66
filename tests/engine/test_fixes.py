"""Fixes of the compiled call: wrong ones have a rival, and rivals are those of the stages."""

import numpy as np
import pytest
from engine.networks import flat

from optloc import Status, solve
from optloc.kernels.jit import enabled
from optloc.solvers import policy
from optloc.solvers.stages import gtrs, lsr_with_mirror
from optloc.solvers.verdict.judge import verdict

pytestmark = pytest.mark.skipif(not enabled(), reason="there is no direct way without machine code")


@pytest.mark.parametrize(
    ("kind", "s", "height", "caught"),
    [("tdoa", 5, 30, 0.97), ("tdoa", 6, 30, 0.9), pytest.param("tdoa", 5, 100, 0.85, marks=pytest.mark.full)],
)
def test_wrong_fixes_have_a_rival(kind, s, height, caught):
    """Fixes with the truth beyond 99.99 %: their other minimum is listed within the gap that makes them ambiguous."""
    made = flat(kind, s, height, 800)
    fix = solve(made.problem, "gtrs+lsr")
    error = fix.position - made.truth
    away = np.einsum("Ni,Nij,Nj->N", error, np.linalg.pinv(fix.covariance()), error)
    wrong = fix.answered & (away > 21.1)  # of chi-square with three degrees of freedom
    assert wrong.sum() > 5
    told = fix.alternatives.gap.min(-1) < policy.AMBIGUOUS_GAP
    assert (told | ~np.isin(fix.code, (Status.OK, Status.UNPROVEN)))[wrong].mean() >= caught
    assert told[wrong].mean() >= caught - 0.1


def test_the_stages_find_the_same_rivals():
    made = flat("tdoa", 6, 100, 200)
    problem = made.problem
    fix, other = solve(problem, "gtrs+lsr"), verdict(problem, lsr_with_mirror(problem, gtrs(problem, None)))
    apart = fix.code != other.code
    assert apart.sum() <= 2
    assert (fix.code == Status.AMBIGUOUS).sum() >= 1
    few = solve(problem.take(np.arange(10)), "gtrs+lsr")  # too few for the compiled call
    assert np.array_equal(few.code, other.code[:10])


def test_thresholds_are_those_of_the_policy():
    from optloc.engine.images import LISTED, SAME
    from optloc.engine.shape import STRAIGHT
    from optloc.model_checks.shape import BENT

    assert (LISTED, SAME, STRAIGHT) == (policy.LISTED_GAP, policy.SAME_PLACE, BENT)
