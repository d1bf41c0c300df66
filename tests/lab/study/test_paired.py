"""Pairs of methods: the interval of a median, and who alone is right on rows that were made by hand."""

import numpy as np
import pytest
from lab.study.rows import hand_made
from scipy.stats import quantile_test

from optloc.base.errors import InvalidProblem
from optloc.lab.study.paired import median_of, paired


@pytest.mark.parametrize("count", [1, 5, 6, 25, 200])
def test_the_interval_of_a_median_is_that_of_order_statistics(count, seed):
    values = np.random.default_rng(seed).standard_normal(count) + 0.2
    found, test = median_of(values), quantile_test(values, q=0.0, p=0.5)
    low, high = test.confidence_interval(0.95)
    assert found.value == np.median(values)
    expected = [-np.inf if np.isnan(low) else low, np.inf if np.isnan(high) else high]
    assert [found.low, found.high] == pytest.approx(expected)
    assert found.p == pytest.approx(test.pvalue, abs=1e-12)


def test_of_differences_that_are_all_zero_either_sign_is_as_likely():
    assert median_of(np.zeros(7)) == (0.0, 0.0, 0.0, 1.0)
    assert np.isnan(median_of(np.array([np.nan]))).all()


def test_a_pair_counts_trials_in_which_one_alone_is_right():
    (one,) = paired(hand_made(), "a")
    assert (one.method, one.against, one.trials) == ("b", "a", 4)
    assert (one.alone, one.other_alone, one.share) == (1, 1, 0.5)  # trial 3, and trial 1
    assert one.p == pytest.approx(1.0)
    assert one.time.value == pytest.approx(2.0)  # b takes twice as long in every trial
    assert one.error.value == 0.0


def test_a_method_that_is_not_there_is_refused():
    with pytest.raises(InvalidProblem, match="no method is called 'c'"):
        paired(hand_made(), "c")
