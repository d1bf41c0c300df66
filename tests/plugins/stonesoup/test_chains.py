"""Chains of detections: problems of runs, fixes of single scans, gates, and longer chains within a bound of work."""

import datetime as dt

import numpy as np
import pytest

pytest.importorskip("stonesoup", reason="Stone Soup is not installed: pip install 'optloc[stonesoup]'")

from plugins.stonesoup.test_stonesoup import PLACE, RATE, TRUTH, ZERO, detections

from optloc import solve
from optloc.engine import predict
from optloc.plugins.stonesoup.chains import (
    ChainTerms,
    ChainWork,
    DetectionChain,
    _group_indices,
    _predict,
    _starts,
    alone,
    grown,
    is_flat,
    near,
    posed,
)

TERMS = ChainTerms(1, 100.0, 1e-3)


@pytest.fixture(scope="module")
def scans():
    """Return three scans of one target, a second apart."""
    return [detection for _, _, detection in detections(np.random.default_rng(1), TRUTH, 3)]


def test_work_is_taken_until_none_is_left():
    work = ChainWork(3.0)
    assert [work.take(2.0), work.take(2.0), work.take(2.0)] == [True, True, False]


def test_the_problem_of_a_run_has_its_state_at_the_last_scan(scans):
    problem, z = posed([scans], TERMS)
    state = np.concatenate([TRUTH[PLACE, 0] + 2.0 * TRUTH[RATE, 0], TRUTH[RATE, 0]])
    assert z.shape == (1, 15)
    assert np.abs(predict(problem, state) - z[0]).max() < 60.0  # six deviations of 10 m
    assert problem.times.tolist() == [-2.0, -1.0, 0.0]
    assert problem.priors[0].name == "velocity"


def test_a_detection_alone_is_a_chain_with_the_fix_of_its_rows(scans):
    (chain,) = alone(scans[:1], TERMS)
    model = scans[0].measurement_model
    fix = solve(model.problem.with_rows(z=np.asarray(scans[0].state_vector, dtype=float)[:, 0]))
    np.testing.assert_allclose(chain.x[0, :3], fix.position, atol=1e-3)
    assert chain.x[0, 3:].tolist() == [0.0, 0.0, 0.0]
    np.testing.assert_allclose(chain.cov[3:, 3:], 100.0**2 * np.eye(3))
    assert (len(chain), chain.last) == (1, ZERO)


def test_two_scans_give_the_velocity_between_their_places(scans):
    first, second = alone(scans[:1], TERMS)[0], alone(scans[2:], TERMS)[0]
    starts = _starts(first, second, TERMS)
    np.testing.assert_allclose(starts[-1, :3], second.x[0, :3])
    np.testing.assert_allclose(starts[-1, 3:], (second.x[0, :3] - first.x[0, :3]) / 2.0)
    ahead = _predict(first.x + np.array([0, 0, 0, 7.0, 0, 0]), first, scans[2], 3)
    np.testing.assert_allclose(ahead[0, :3], first.x[0, :3] + np.array([14.0, 0.0, 0.0]))


def test_a_detection_is_near_a_chain_that_predicts_it_and_no_other(scans):
    chain, single = alone(scans[:1], TERMS)[0], alone(scans[1:2], TERMS)[0]
    away = DetectionChain(chain.detections, chain.x + np.array([2000.0, 0, 0, 0, 0, 0]), chain.cov, 1.0)
    blind = DetectionChain(chain.detections, chain.x, None, 1.0)
    found = {i: share for share, i in near([chain, away, blind, single], single, TERMS)}
    assert set(found) == {0, 2}  # a chain that ends with the scan itself is no beginning of it
    assert found[0] < 0.5
    assert found[2] == 1.0


def test_a_longer_chain_is_the_fix_of_all_its_scans(scans):
    chain = alone(scans[:1], TERMS)[0]
    for detection in scans[1:]:
        ((chain, _, _),) = grown([(chain, alone([detection], TERMS)[0])], TERMS, ChainWork(1e3))
    problem, z = posed([scans], TERMS)
    fix = solve(problem.with_rows(z=z[0]))
    np.testing.assert_allclose(chain.x[0], fix.x, atol=1e-2)
    np.testing.assert_allclose(chain.cov, fix.cov, rtol=1e-3)
    assert chain.p == pytest.approx(float(fix.p_value), rel=1e-3)


def test_without_work_no_chain_grows(scans):
    first, second = alone(scans[:1], TERMS)[0], alone(scans[1:2], TERMS)[0]
    assert grown([(first, second)], TERMS, ChainWork(0.0)) == []


def test_a_covariance_is_flat_where_it_is_small_against_the_range(scans):
    position = scans[0].measurement_model.stations[0] + np.array([0.0, 0.0, 100.0])
    assert is_flat(4.9**2 * np.eye(3), position, scans[0])
    assert not is_flat(5.1**2 * np.eye(3), position, scans[0])
    assert not is_flat(np.full((3, 3), np.nan), position, scans[0])


def test_equal_keys_are_grouped_in_their_order():
    step = dt.timedelta(seconds=1)
    assert _group_indices([step, "b", step, "c", "b"]) == [[0, 2], [1, 4], [3]]
