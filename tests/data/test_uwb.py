"""UWB range differences of two flights: fixes without a guess against least squares started at the truth."""

import numpy as np
import pytest
from data import uwb
from data.windows import judge, judge_consistency

from optloc import Status, solve

pytestmark = pytest.mark.data

# Flight: windows, then median and 95 % error of 3-D plain least squares in the set's README, metres.
README = {"F01": (84, 0.18, 0.33), "F03": (105, 0.18, 0.46)}


@pytest.fixture(scope="module")
def folder(data_dir):
    return data_dir / "util_uwb_tdoa"


@pytest.mark.parametrize("flight", README)
def test_plain_least_squares_reaches_the_published_accuracy(folder, flight):
    data = uwb.load(folder, flight, shared=False)
    count, median, high = README[flight]
    assert abs(len(data.windows) - count) <= 1
    ours = judge(data, solve(data.problem))
    assert ours == pytest.approx((median, high), abs=0.01)


@pytest.mark.parametrize("flight", README)
def test_fixes_with_the_noise_of_the_data_are_right_and_know_how_right(folder, flight):
    data = uwb.load(folder, flight)
    fix = solve(data.problem)
    _, median, high = README[flight]
    ours = judge(data, fix)
    assert ours == pytest.approx((median, high), abs=0.04)
    judge_consistency(data, fix)


def test_independent_rows_would_promise_too_much(folder):
    data = uwb.load(folder, "F01", shared=False)
    fix = solve(data.problem)
    with pytest.raises(AssertionError, match="beyond 5 own sigma"):
        judge_consistency(data, fix)


def test_the_sign_of_the_file_is_the_other_one(folder):
    data = uwb.load(folder, "F01", shared=False)
    wrong = solve(data.problem.with_rows(z=-data.problem.z))
    plausible = (wrong.code == Status.OK) & (wrong.p_value > 1e-3)
    assert not plausible.any()


def test_a_wild_value_is_seen_by_the_chi_square(folder):
    data = uwb.load(folder, "F03")
    fix = solve(data.problem)
    wild = [k for k, w in enumerate(data.windows) if np.abs(_residual(data, k, w)).max() > 5.0]
    assert wild
    assert np.all(fix.p_value[wild] < 1e-6)


def _residual(data, k, w):
    distance = np.linalg.norm(w.truth - data.stations, axis=1)
    return w.z - (distance[w.a] - distance[w.b])
