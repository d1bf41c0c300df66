"""The status that a pool deserves: what is missing comes first, and ok only what is proven and fits."""

from dataclasses import replace

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import Status, assemble, measured
from optloc.solvers.certificates.admitted import certified
from optloc.solvers.pool import begin
from optloc.solvers.stages import gtrs, lsr
from optloc.solvers.verdict.judge import (
    decide_statuses,
    failed_fixes,
    filled_objects,
    judge,
    surviving_candidates,
    verdict,
)

ERROR = np.array([0.5, -1.0, 2.0, -0.5, 1.0])


def settled(problem):
    return lsr(problem, gtrs(problem, None))


def test_a_fix_that_fits_is_ok_only_with_a_proof():
    problem = ranges_to(PLACE, 2.0, ERROR)
    pool = settled(problem)
    assert verdict(problem, pool).code[0] == Status.UNPROVEN
    assert verdict(problem, certified(problem, pool)).code[0] == Status.OK


def test_starts_are_unrefined():
    problem = ranges_to(PLACE, 2.0)
    fix = judge(problem, begin(problem, PLACE[None]))
    assert fix.code[0] == Status.UNREFINED
    np.testing.assert_array_equal(fix.x[0], PLACE)
    assert np.isnan(fix.cov).all()


@pytest.mark.parametrize(
    ("change", "status", "words"),
    [
        (lambda p: p.with_rows(z=np.where(np.arange(5) == 1, np.nan, p.z)), Status.REJECTED, ""),
        (lambda p: p.with_rows(weight=(np.arange(5) < 1) * 1.0), Status.TOO_FEW_ROWS, "1 measurement fewer"),
        (lambda p: p.with_rows(z=p.z + np.array([0, 0, 500.0, 0, 0])), Status.MISFIT, "larger than the noise allows"),
    ],
)
def test_what_is_wrong_is_named(change, status, words):
    problem = change(ranges_to(PLACE, 2.0, ERROR)).flat()
    fix = judge(problem, settled(problem))
    assert fix.code[0] == status
    assert words in fix.reason[0]


def test_stations_without_a_common_row_are_disconnected():
    a, b = np.array([1, 3]), np.array([0, 2])
    problem = assemble(SQUARE[:4], measured("tdoa", [100.0, -50.0], a=a, b=b, sigma=1.0)).flat()
    fix = judge(problem, settled(problem))
    assert fix.code[0] == Status.DISCONNECTED
    assert fix.reason[0].startswith("no measurement links {")


def test_a_ruling_hides_what_has_no_place():
    problem = ranges_to(PLACE, 2.0, ERROR)
    pool = settled(problem)
    ruling = decide_statuses(problem, pool, np.full((1, 0), np.inf))
    assert not ruling.no_position[0]
    assert ruling.marks[0] & Status.UNPROVEN.mark
    short = replace(pool, dof=np.array([-1]))
    assert decide_statuses(problem, short, np.full((1, 0), np.inf)).no_position[0]
    fix = judge(problem, short)
    assert np.isnan(fix.x).all()
    assert np.isnan(surviving_candidates(short, fix)[:, 0]).all()
    np.testing.assert_array_equal(surviving_candidates(pool, judge(problem, pool)), pool.x)


def test_a_numerical_failure_is_a_status_with_its_cause():
    fix = failed_fixes(ranges_to(PLACE, 2.0), "lsr: Singular matrix")
    assert fix.code[0] == Status.NUMERICAL
    assert fix.reason[0] == "lsr: Singular matrix"
    assert filled_objects(3, ()).tolist() == [(), (), ()]
