"""What explanations of contradicting data mean for status and sentence."""

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import Status, solve
from optloc.problem.explanations import Explanation, Suspect
from optloc.solvers.verdict.conclusion import Conclusion, conclude, list_names

MORE = np.concatenate([SQUARE, [[-400.0, 500.0], [1300.0, 300.0], [600.0, 1500.0]]])


@pytest.fixture
def problem():
    return ranges_to(PLACE, 1.0, np.array([0.5, -1.0, 60.0, -0.5, 1.0, 0.3, -0.8, 0.2]), MORE)


@pytest.fixture
def rest(problem):
    return solve(problem.with_rows(weight=(np.arange(8) != 2) * 1.0))[0]


def explanation(rest, row=2, group="row"):
    suspect = Suspect(f"range of S{row}", group, (row,), np.array([60.0]), np.array([1.2]), 1e-20, 0.5)
    return Explanation((suspect,), rest.x, float(rest.cost), int(rest.dof), 0.5, 20.0)


def test_one_explanation_is_taken_and_named(problem, rest):
    fix = conclude(problem, Conclusion((explanation(rest),), rest, rest.alternatives, spent=1))
    assert fix.code[0] == Status.OK
    assert fix.weights[0].tolist() == [1, 1, 0, 1, 1, 1, 1, 1]
    assert fix.reason[0] == "left out: range of S2 (error +60, sigma 1.2); p = 1e-20 with, 0.5 without"


def test_little_redundancy_makes_it_unproven(problem, rest):
    fix = conclude(problem, Conclusion((explanation(rest),), rest, rest.alternatives, spent=5))
    assert fix.code[0] == Status.UNPROVEN
    assert "too small to exclude another explanation" in fix.reason[0]


def test_several_explanations_elsewhere_are_ambiguous(problem, rest):
    both = (explanation(rest), explanation(rest, 3))
    fix = conclude(problem, Conclusion(both, rest, rest.alternatives, spent=1, several=True))
    assert fix.code[0] == Status.AMBIGUOUS
    assert fix.reason[0] == "several explanations pass: range of S2 or range of S3"


def test_a_common_offset_has_to_be_stated(problem, rest):
    fix = conclude(problem, Conclusion((explanation(rest, group="offset"),), rest, rest.alternatives, spent=1))
    assert fix.code[0] == Status.UNPROVEN
    assert 'per = "kind"' in fix.reason[0]


def test_no_explanation_is_a_contradiction_without_a_covariance(problem, rest):
    fix = conclude(problem, Conclusion((), rest, rest.alternatives, tried="nobody alone explains it"))
    assert fix.code[0] == Status.CONTRADICTORY
    assert fix.reason[0] == "nobody alone explains it"
    assert np.isnan(fix.cov).all()


def test_names_are_listed_as_a_sentence_has_them():
    assert list_names(["a"]) == "a"
    assert list_names(["a", "b", "c"]) == "a, b and c"
    assert list_names(list("abcdef")) == "a, b, c, d and 2 more"
