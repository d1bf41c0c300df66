"""Stages by themselves: starts of exact data, refinement, and what each refuses."""

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to
from scipy.optimize import least_squares

from optloc import InvalidProblem, Status, assemble, measured
from optloc.solvers.pool import begin
from optloc.solvers.stages import (
    add_candidates,
    fix_by,
    gtrs,
    lsr,
    lsr_with_mirror,
    roots,
    search,
    search_widely,
    taylor,
)

ERROR = np.array([0.5, -1.0, 2.0, -0.5, 1.0])


@pytest.mark.parametrize("start", [gtrs, roots])
def test_closed_forms_start_exact_data_at_the_target(start):
    problem = ranges_to(PLACE, 1.0)
    pool = start(problem, None)
    assert np.nanmin(np.linalg.norm(pool.x[0] - PLACE, axis=-1)) < 1e-6
    assert np.isnan(pool.cost).all()


@pytest.mark.parametrize("refinement", [lsr, taylor])
def test_refinement_ends_at_the_least_squares_point(refinement):
    problem, r = ranges_to(PLACE, 2.0, ERROR), np.linalg.norm(PLACE - SQUARE, axis=1)
    pool = refinement(problem, begin(problem, PLACE[None] + 5.0))
    best = least_squares(lambda x: (np.linalg.norm(x - SQUARE, axis=1) - r - ERROR) / 2.0, PLACE, xtol=1e-15)
    np.testing.assert_allclose(pool.x[0, 0], best.x, atol=1e-4)
    assert pool.code[0, 0] == Status.OK
    assert lsr(problem, pool) is pool or refinement is taylor


def test_a_mirror_image_is_found_beside_a_start():
    # two stations leave two places
    problem = ranges_to(PLACE, 1.0, stations=SQUARE[:2])
    pool = lsr_with_mirror(problem, begin(problem, PLACE[None] + 5.0))
    np.testing.assert_allclose(np.sort(pool.x[0, :2, 1]), [-650.0, 650.0], atol=1e-2)
    wide = add_candidates(problem, lsr(problem, begin(problem, PLACE[None])))
    assert (np.abs(wide.x[0] - PLACE * [1.0, -1.0]).max(-1) < 1.0).any()


def test_levels_that_no_closed_form_starts_are_searched():
    r = np.linalg.norm(PLACE - SQUARE, axis=1)
    rows = measured("rss_difference", -20.0 * np.log10(r[1:] / r[0]), a=np.arange(1, 5), b=0, sigma=0.1)
    pool = search_widely(assemble(SQUARE, rows).flat())
    np.testing.assert_allclose(pool.x[0, 0], PLACE, atol=0.1)


def test_a_fix_by_a_start_is_judged():
    fix = fix_by(ranges_to(PLACE, 2.0, ERROR), lambda one: begin(one, PLACE[None]))
    assert fix.code[0] == Status.UNPROVEN
    assert fix.dof[0] == 3


@pytest.mark.parametrize("stage", [lsr, add_candidates, search])
def test_a_stage_that_needs_something_before_it_says_so(stage):
    with pytest.raises(InvalidProblem, match=r"(lsr needs a start|needs a fix)"):
        stage(ranges_to(PLACE, 1.0), None)
