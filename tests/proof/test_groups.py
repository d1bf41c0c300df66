"""Groups of nodes that rows tie to each other, for ranges measured one by one, as differences and as sums."""

import numpy as np
import pytest
from proof.costs import random_case

from optloc.proof.groups import LOOSE, NONE, empty_groups, set_groups
from optloc.proof.nodes.node import LINEAR, RANGE

pytestmark = pytest.mark.usefixtures("plainly")


def grouped(kinds, A):
    groups = empty_groups(len(A))
    set_groups(np.asarray(kinds), A, groups)
    return groups


def test_independent_ranges_are_groups_of_one_with_their_own_variances():
    groups = grouped([RANGE] * 3, np.diag([4.0, 1.0, 0.25]))
    assert groups.order[1].tolist() == [1, 1, 1]
    assert groups.order[2].tolist() == [NONE] * 3
    np.testing.assert_allclose(np.diagonal(groups.R), [0.25, 1.0, 4.0])


@pytest.mark.parametrize(("kind", "tie"), [("tdoa", 1.0), ("sum", -1.0)])
def test_differences_and_sums_follow_one_reference_range(kind, tie):
    case, _ = random_case(np.random.default_rng(3), 3, kind=kind)
    groups, n = grouped(case.kinds, case.K.T @ case.K), len(case.stations)
    assert groups.order[1, :2].tolist() == [n, 0]
    reference = groups.order[2, 0]
    others = groups.order[0, : n - 1]
    assert reference not in others
    # of a sum r_0 + r_j with reference r_0 all follow with -1; two sums less each other follow with +1
    assert set(np.abs(groups.tie[others])) == {1.0}
    assert groups.tie[others[-1]] == tie
    expected = np.linalg.inv((case.K.T @ case.K)[np.ix_(others, others)])
    np.testing.assert_allclose(groups.R[: n - 1, : n - 1], expected, rtol=1e-9)


def test_a_multiple_that_is_no_sign_leaves_a_group_loose():
    K = np.array([[1.0, 2.0]])
    assert grouped([RANGE, RANGE], K.T @ K).order[2, 0] == LOOSE
    assert grouped([LINEAR, LINEAR], K.T @ K).order[2, 0] == LOOSE
