"""The structure of noise from data: against the likelihood by definition, and on simulated errors of each structure."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from optloc import InvalidProblem, assemble, measured, solve
from optloc.base.types import Motion, Status
from optloc.model_checks.elements import batch_of, elements
from optloc.model_checks.variance_components import deviance
from optloc.station_health import noise_structure
from optloc.station_health.levels import fitted
from optloc.station_health.structure import with_estimated_noise

MARKS = np.array([[0.0, 0.0], [8.0, 1.0], [7.0, 9.0], [-1.0, 8.0], [3.0, -2.0], [10.0, 5.0]])
# Marks on one side: fixes follow most of a heading.
AHEAD = np.array([[9.0, 0.0], [10.0, 3.0], [10.0, 6.0], [9.0, 9.0]])
FREE = (Motion(span="epoch"),)
SIGMA = np.deg2rad(1.0)


def bearings(rng, row, epoch, marks=MARKS):
    """Return fixes by bearings whose errors are row (n, s) + epoch (n,), radians, and the places."""
    count = len(row)
    place = rng.uniform([1.0, 1.0], [6.0, 7.0], (count, 2))
    ahead = place[:, None] - marks
    z = np.arctan2(ahead[..., 1], ahead[..., 0]) + row + epoch[:, None]
    number = np.repeat(np.arange(count), len(marks))
    rows = measured("azimuth", z.ravel(), a=np.tile(np.arange(len(marks)), count), sigma=SIGMA, epoch=number)
    return assemble(marks, rows, motions=FREE), place


def walk(rng, shape, correlation):
    """Return unit errors (n, ...) that are correlated from one epoch to the next."""
    found = rng.standard_normal(shape)
    for k in range(1, shape[0]):
        found[k] = correlation * found[k - 1] + np.sqrt(1.0 - correlation**2) * found[k]
    return found


def share_beyond(problem, place, size=5.0):
    """Return the share of the fixes that are ok and likely whose error exceeds some of their own sigma."""
    fix = solve(batch_of(problem))
    good = (fix.code == Status.OK) & (fix.p_value > 0.01)
    error, cov = (fix.position - place)[good], fix.gaussian()[1][good]
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)
    return float((squared > size**2).mean())


def test_the_deviance_is_the_likelihood_of_what_the_fixes_leave():
    rng = np.random.default_rng(1)
    problem, _ = bearings(rng, SIGMA * rng.standard_normal((20, 6)), np.zeros(20))
    batch = batch_of(problem)
    made = elements(batch, solve(batch).x, "station")
    found, _ = fitted(made, None)
    variance = found.variance[made.of_effect]
    expected = 0.0
    for k in range(20):
        left = np.linalg.svd(made.jacobian[k])[0][:, 2:].T
        covariance = left @ (made.effect[k] * variance[k]) @ made.effect[k].T @ left.T
        expected -= 2.0 * multivariate_normal(np.zeros(4), covariance).logpdf(left @ made.residual[k])
    constant = 20 * 4 * np.log(2.0 * np.pi)
    assert not found.gross.any()
    assert deviance(made, found) == pytest.approx(expected - constant, rel=1e-9)


def test_white_errors_have_one_level_and_nothing_lasts():
    rng = np.random.default_rng(2)
    problem, _ = bearings(rng, 2.0 * SIGMA * rng.standard_normal((300, 6)), np.zeros(300))
    _, levels = with_estimated_noise(problem)
    found = noise_structure(problem)
    assert (found.option, found.lasting) == ("kind", {})
    assert levels.names == ("azimuth",)
    assert levels.low[0] < 2.0 < levels.high[0]
    assert levels.tails[0] == 1.0


def test_stations_of_different_noise_have_levels_of_their_own():
    rng = np.random.default_rng(3)
    size = SIGMA * np.array([0.5, 1.0, 2.0, 1.0, 0.5, 1.0])
    problem, _ = bearings(rng, size * rng.standard_normal((300, 6)), np.zeros(300))
    assert noise_structure(problem).option == "station"
    _, levels = with_estimated_noise(problem)
    np.testing.assert_allclose(levels.factor, size / SIGMA, rtol=0.2)


def test_a_heading_of_each_epoch_is_found_and_fixes_take_it():
    rng = np.random.default_rng(4)
    heading = 2.0 * SIGMA * rng.standard_normal(300)
    problem, place = bearings(rng, 0.2 * SIGMA * rng.standard_normal((300, 4)), heading, AHEAD)
    learnt, levels = with_estimated_noise(problem)
    assert noise_structure(problem).option == "kind+epoch"
    assert levels.names == ("azimuth", "azimuth common")
    assert ((levels.low < [0.2, 2.0]) & ([0.2, 2.0] < levels.high)).all()
    by_kind, _ = with_estimated_noise(problem, "kind")
    assert share_beyond(by_kind, place) > 0.1
    assert share_beyond(learnt, place) == 0.0


def test_errors_that_last_are_found_and_widen_the_intervals():
    rng = np.random.default_rng(5)
    heading = 2.0 * SIGMA * walk(rng, (300,), 0.8)
    problem, _ = bearings(rng, 0.2 * SIGMA * rng.standard_normal((300, 6)), heading)
    found = noise_structure(problem)
    assert found.lasting == {"azimuth common": pytest.approx(0.8, abs=0.15)}
    assert any("last" in sentence for sentence in found.sentences)
    _, levels = with_estimated_noise(problem)
    _, plain = with_estimated_noise(problem, "kind", common="kind")
    width, narrow = (np.log(one.high / one.low) for one in (levels, plain))
    assert width[1] > 1.5 * narrow[1]
    assert width[0] < 1.2 * narrow[0]


def test_stations_whose_errors_last_have_no_level_of_their_own():
    # Residuals of stations are then alike for many epochs, and a level of each would be that of a few errors.
    rng = np.random.default_rng(6)
    problem, _ = bearings(rng, SIGMA * walk(rng, (300, 6), 0.98), np.zeros(300))
    found = noise_structure(problem)
    assert found.by == "kind"
    assert found.lasting["azimuth"] > 0.9
    with pytest.raises(InvalidProblem, match=r"hardly change .* measure at a known position"):
        with_estimated_noise(problem)


def test_long_tails_enlarge_the_sigma_until_five_of_it_hold_the_errors():
    rng = np.random.default_rng(7)
    heading = SIGMA * rng.standard_normal(400) * np.where(rng.uniform(size=400) < 0.08, 6.0, 1.0)
    problem, place = bearings(rng, 0.2 * SIGMA * rng.standard_normal((400, 4)), heading, AHEAD)
    learnt, levels = with_estimated_noise(problem)
    assert levels.tails[1] > 1.2
    assert any("long tails" in sentence for sentence in levels.sentences)
    assert share_beyond(learnt, place) <= 0.005


def test_one_fix_alone_cannot_show_a_structure_that_lasts():
    rng = np.random.default_rng(8)
    problem, _ = bearings(rng, SIGMA * rng.standard_normal((12, 6)), np.zeros(12))
    assert noise_structure(problem).lasting == {}


def test_an_error_in_common_that_fixes_follow_is_not_sized_by_chance():
    # Ranges from one side: a common error moves the fix and leaves a thousandth of itself in the residuals.
    rng = np.random.default_rng(9)
    place = rng.uniform([1.0, 3.0], [3.0, 6.0], (300, 2))
    distance = np.linalg.norm(place[:, None] - AHEAD, axis=-1)
    error = np.where(rng.uniform(size=distance.shape) < 0.05, 5.0, 1.0) * rng.standard_normal(distance.shape)
    number = np.repeat(np.arange(300), len(AHEAD))
    rows = measured("range", (distance + 0.1 * error).ravel(), a=np.tile(np.arange(4), 300), sigma=0.1, epoch=number)
    problem = assemble(AHEAD, rows, motions=FREE)
    assert noise_structure(problem).common is None
