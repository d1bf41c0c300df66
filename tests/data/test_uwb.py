"""UWB range differences of two flights: fixes without a guess against least squares started at the truth."""

from functools import cache

import numpy as np
import pytest
from data.windows import judge, judge_consistency
from often import few

from optloc import solve
from optloc.lab.datasets import uwb

pytestmark = pytest.mark.data

# Flight: windows, then median and 95 % error of 3-D plain least squares in the set's README, metres.
README = {"F01": (84, 0.18, 0.33), "F03": (105, 0.18, 0.46)}


@pytest.fixture(scope="module")
def folder(data_dir):
    return data_dir / "util_uwb_tdoa"


@pytest.fixture(scope="module")
def solved(folder):
    """Return data and fix of a flight, each solved once."""

    @cache
    def make(flight, *, shared):
        data = uwb.load(folder, flight, shared=shared)
        return data, solve(data.problem)

    return make


@pytest.mark.parametrize("flight", README)
def test_plain_least_squares_reaches_the_published_accuracy(solved, flight):
    data, fix = solved(flight, shared=False)
    count, median, high = README[flight]
    assert abs(len(data.windows) - count) <= 1
    assert judge(data, fix) == pytest.approx((median, high), abs=0.01)


@pytest.mark.parametrize("flight", few(README, 1))
def test_with_the_noise_of_the_data_fixes_know_how_right_they_are(solved, flight):
    data, fix = solved(flight, shared=True)
    _, median, high = README[flight]
    assert judge(data, fix) == pytest.approx((median, high), abs=0.04)
    judge_consistency(data, fix)


def test_independent_rows_would_promise_too_much(solved):
    with pytest.raises(AssertionError, match="beyond 5 own sigma"):
        judge_consistency(*solved("F01", shared=False))


def test_the_wrong_sign_is_a_wrong_place(solved):
    # The hall is nearly symmetric about its centre: the other sign gives the mirrored place, and a good chi-square.
    data, _ = solved("F01", shared=False)
    other = solve(data.problem.with_rows(z=-data.problem.z))
    assert np.nanmedian(np.linalg.norm(other.position - data.truth, axis=1)) > 2.0


def test_a_wild_value_is_seen_by_the_chi_square(solved):
    data, fix = solved("F03", shared=True)
    wild = [k for k, window in enumerate(data.windows) if np.abs(_residual(data, window)).max() > 5.0]
    assert wild
    assert np.all(fix.p_value[wild] < 1e-6)


def _residual(data, window):
    distance = np.linalg.norm(window.truth - data.stations, axis=1)
    return window.z - (distance[window.a] - distance[window.b])
