"""Findings against answers: each number decides by its threshold, and nothing else makes an answer ok."""

from types import SimpleNamespace

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to
from scipy.stats import chi2

from optloc import Status, solve
from optloc.problem.chart import CARTESIAN, CURVED, INVERSE_RANGE
from optloc.problem.claims import GLOBAL
from optloc.solvers.verdict.findings import (
    FINDINGS,
    Finding,
    ambiguity,
    centre_of,
    chart_kind,
    is_improbable,
    is_proof_of_one,
    marks_of,
    objections,
    reach_of,
)

CLEAN = {"improbable": False, "infinity": np.nan, "region": 6.0, "gap": np.inf, "kappa": 0.1, "unique": True}


@pytest.mark.parametrize(
    ("changed", "status"),
    [
        ({"improbable": True}, Status.MISFIT),
        ({"infinity": 5.9}, Status.UNBOUNDED),
        ({"gap": 8.9}, Status.AMBIGUOUS),
        ({"searched": True, "unique": False}, Status.SEARCHED),
        ({"unique": False}, Status.UNPROVEN),
        ({"blind": True}, Status.UNPROVEN),
        ({"kappa": 0.4}, Status.CURVED),
        ({"kappa": 0.4, "held": True}, Status.TAILS),
        ({"robust": True}, Status.ROBUST),
    ],
)
def test_each_number_is_one_finding(changed, status):
    values = CLEAN | {"searched": False, "blind": False, "held": False, "robust": False} | changed
    assert marks_of(*values.values()) == status.mark


def test_nothing_speaks_against_a_clean_answer():
    assert marks_of(*CLEAN.values(), False, False, False, False) == 0
    assert marks_of(*(CLEAN | {"infinity": 6.1, "gap": 9.0}).values(), False, False, False, False) == 0
    assert len({finding.status for finding in FINDINGS}) == len(FINDINGS)


def test_objections_come_in_the_order_of_statuses():
    table = [
        Finding(Status.CURVED, lambda e: e > 1, lambda e: ["bent"]),
        Finding(Status.MISFIT, lambda e: e > 2, lambda e: ["large"]),
    ]
    assert objections(table, 3) == [(Status.MISFIT, "large"), (Status.CURVED, "bent")]
    assert objections(table, 2) == [(Status.CURVED, "bent")]


def test_costs_are_improbable_beyond_the_quantile_of_chi_square():
    dof = np.array([0, 1, 5, 5])
    limit = chi2.isf(1e-4, 5)
    found = is_improbable(np.array([1e9, chi2.isf(1e-4, 1) + 0.01, limit - 0.01, limit + 0.01]), dof, 1e-4)
    assert found.tolist() == [False, True, False, True]
    alike = np.broadcast_to(np.array(5), (2,))
    assert is_improbable(np.array([limit - 0.01, limit + 0.01]), alike, 1e-4).tolist() == [False, True]


def test_the_chart_is_the_first_in_which_the_cost_is_gaussian():
    kinds = chart_kind(np.array([0.1, 0.5, 0.5, np.nan]), np.array([0.9, 0.1, 0.9, np.nan]))
    assert kinds.tolist() == [CARTESIAN, INVERSE_RANGE, CURVED, CURVED]


def test_a_proof_of_one_minimum_needs_the_whole_gap_or_infinity_before_it():
    def told(unique, margin):
        return SimpleNamespace(unique=unique, margin=margin, proof=np.array([GLOBAL]), asked=np.array([False]))

    one, short = told(np.array([True]), np.array([9.0])), told(np.array([True]), np.array([4.0]))
    assert is_proof_of_one(one, np.zeros(1)).tolist() == [True]
    assert is_proof_of_one(short, np.zeros(1)).tolist() == [False]
    assert is_proof_of_one(short, np.array([4.0])).tolist() == [True]
    assert is_proof_of_one(told(np.array([False]), np.array([9.0])), np.zeros(1)).tolist() == [False]


def test_the_centre_is_of_stations_with_rows():
    problem = ranges_to(PLACE, 1.0).with_rows(weight=np.array([[1.0, 1.0, 1.0, 1.0, 0.0]]))
    np.testing.assert_allclose(centre_of(problem), [SQUARE[:4].mean(0)])
    spread = np.linalg.norm(SQUARE - SQUARE.mean(0), axis=1).max()
    assert reach_of(problem, PLACE[None])[0] == pytest.approx(spread)


def test_a_rival_is_told_with_its_gap():
    problem = ranges_to(PLACE, 1.0)
    assert ambiguity(problem, 0.0) == "another position fits equally well"
    assert ambiguity(problem, 2.34) == "another position raises chi-square by only 2.3"
    two = solve(ranges_to(PLACE, 1.0, stations=SQUARE[:2]))
    assert two.has(Status.AMBIGUOUS)[0]
