"""Fixes by a plan: those of the stages, item by item."""

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE

from optloc import Status, assemble, measured
from optloc.solvers.planned import PlannedStages
from optloc.solvers.pool import begin
from optloc.solvers.stages import gtrs, lsr

A = np.arange(5)


@pytest.mark.parametrize(("kind", "alone"), [("range", False), ("tdoa", False), ("tdoa", True)])
def test_a_plan_fixes_what_the_stages_fix(kind, alone):
    rng = np.random.default_rng(0)
    r = np.linalg.norm(PLACE - SQUARE, axis=1)
    z = r + rng.standard_normal((40, 5)) if kind == "range" else r[1:] - r[0] + rng.standard_normal((40, 4))
    rows = measured("range", z, a=A, sigma=1.0) if kind == "range" else measured("tdoa", z, a=A[1:], b=0, sigma=1.0)
    problem = assemble(SQUARE, rows).flat()
    pool, staged = PlannedStages(alone)(problem, None), lsr(problem, gtrs(problem, None))
    good = staged.code[:, 0] == Status.OK
    assert good.sum() > 30
    np.testing.assert_allclose(pool.cost[good, 0], staged.cost[good, 0], rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(pool.x[good, 0], staged.x[good, 0], atol=1e-2)
    assert pool.refined


def test_given_starts_are_refined_by_the_stages():
    problem = assemble(SQUARE, measured("range", np.linalg.norm(PLACE - SQUARE, axis=1), a=A, sigma=1.0)).flat()
    pool = PlannedStages()(problem, begin(problem, PLACE[None] + 20.0))
    np.testing.assert_allclose(pool.x[0, 0], PLACE, atol=1e-3)
