"""The thresholds of a verdict agree with each other and with the laws that they stand for."""

import numpy as np
import pytest
from scipy.stats import chi2, norm

from optloc.solvers import policy
from optloc.solvers.policy import equal_cost


def test_gaps_are_those_of_three_and_five_sigma_of_one_number():
    assert policy.AMBIGUOUS_GAP == pytest.approx(chi2.isf(2.0 * norm.sf(3.0), 1))
    assert policy.LISTED_GAP == pytest.approx(chi2.isf(2.0 * norm.sf(5.0), 1))


def test_what_is_refuted_is_doubted_and_noticed_before():
    assert 0.0 < policy.P_MISFIT < policy.P_SUSPECT < policy.P_OUTLIER < 1.0 - policy.REGION_LEVEL
    assert policy.FAR < policy.FLAT


def test_costs_are_equal_to_a_millionth_of_themselves():
    np.testing.assert_allclose(equal_cost(np.array([0.0, 1.0, 1e6])), [1e-6, 2e-6, 1.000001])
