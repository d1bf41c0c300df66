"""Intervals, ratios, profiles and means against published values, definitions and sampling."""

import numpy as np
import pytest
from scipy.stats import binom, binomtest

from optloc.lab.study.summary import (
    clopper_pearson,
    distribution,
    over_bound,
    performance_profile,
    shifted_mean,
    wilson,
)


@pytest.mark.parametrize(("hits", "count"), [(0, 10), (1, 10), (81, 263), (15, 148), (0, 20), (29, 29), (500, 1000)])
def test_intervals_of_shares_are_those_of_scipy(hits, count):
    for ours, name in ((wilson, "wilson"), (clopper_pearson, "exact")):
        wanted = binomtest(hits, count).proportion_ci(0.95, name)
        assert np.allclose(ours(hits, count), (wanted.low, wanted.high), atol=1e-12)


def test_wilson_has_the_values_of_newcombe():
    # R. G. Newcombe, "Two-sided confidence intervals for the single proportion", Stat. Med. 17 (1998), table I.
    for hits, count, low, high in ((81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (1, 29, 0.0061, 0.1718)):
        assert np.allclose(wilson(hits, count), (low, high), atol=6e-5)


def test_the_exact_interval_covers_at_least_its_level_and_nothing_of_nothing_is_unknown():
    count, hits = 30, np.arange(31)
    low, high = clopper_pearson(hits, np.full(31, count))
    for share in np.linspace(0.01, 0.99, 50):
        assert binom.pmf(hits, count, share)[(low <= share) & (share <= high)].sum() >= 0.95
    assert np.isnan([wilson(0, 0), clopper_pearson(0, 0)]).all()


def test_the_ratio_to_the_bound_covers_the_truth():
    rng, inside = np.random.default_rng(3), 0
    for _ in range(400):
        bound = rng.uniform(1.0, 3.0, 200)
        error = np.linalg.norm(rng.standard_normal((200, 3)), axis=1) / np.sqrt(3.0) * bound * 1.2
        error[0], bound[1] = np.nan, np.nan
        ratio, half = over_bound(error, bound)
        inside += abs(ratio - 1.2) < half
    assert 0.91 < inside / 400 < 0.985
    assert np.isnan(over_bound(np.array([np.nan]), np.ones(1))).all()


def test_a_profile_is_that_of_its_definition():
    times = np.array([[1.0, 4.0, 1.0, 7.0], [2.0, 2.0, 9.0, 7.0]])
    solved = np.array([[True, True, True, False], [True, True, False, False]])
    shares = performance_profile(times, solved, np.array([1.0, 1.99, 2.0, 100.0]))
    assert shares.tolist() == [[0.5, 0.5, 0.75, 0.75], [0.25, 0.25, 0.5, 0.5]]


def test_the_shifted_mean_is_between_geometric_and_arithmetic():
    times = np.array([1e-3, 1.0, 50.0])
    assert shifted_mean(times, 0.0) == pytest.approx(np.exp(np.log(times).mean()))
    assert shifted_mean(times, 0.0) < shifted_mean(times, 1.0) < shifted_mean(times, 1e6) < times.mean()
    assert shifted_mean(np.full(5, 0.25), 10.0) == pytest.approx(0.25)


def test_a_distribution_keeps_its_ends_and_counts_what_is_missing():
    values = np.concatenate([np.arange(1.0, 1001.0), [np.nan] * 1000])
    x, share = distribution(values, 2000, points=50)
    assert len(x) <= 50
    assert (x[0], x[-1], share[-1]) == (1.0, 1000.0, 0.5)
    assert np.allclose(share, x / 2000)
    assert not len(distribution(np.array([np.nan]), 1)[0])
