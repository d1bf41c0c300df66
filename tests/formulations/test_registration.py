"""Registration in closed form: exact without noise, near the bound with it, both branches where there are two."""

from dataclasses import replace

import numpy as np
import pytest
from runs import DELAYS, FIXED, MOVING, PLACES, SPATIAL, SPEEDS

from formulations.registration import RegistrationCourse, candidates

UNIT = 1e5


def course(epochs, *, places=PLACES, state=FIXED, sigma=None, noise=0.0, seed=0, span=600.0, prior=np.inf, bias=DELAYS):
    """Return range differences at equally spaced times, in units of 100 km, written from the definitions."""
    time = np.linspace(0.0, span, epochs)
    station = places + SPEEDS[: len(places)] * time[:, None, None]
    target = state[:3] + (state[3:] if len(state) > 3 else 0.0) * time[:, None]
    ranges = np.linalg.norm(target[:, None] - station, axis=-1)
    rng = np.random.default_rng(seed)
    error = noise * rng.standard_normal((1, epochs, len(places)))
    s = len(places) - 1
    offset = ranges[:, 1:] - ranges[:, :1] + bias[:s] + error[..., 1:] - error[..., :1]
    whiten = np.linalg.inv(np.linalg.cholesky((np.eye(s) + 1.0) * (sigma or 1.0) ** 2))
    return RegistrationCourse(
        time / span,
        station[None] / UNIT,
        offset / UNIT,
        np.ones(s),
        np.broadcast_to(np.eye(s), (1, epochs, s, s)),
        whiten[None, None] * UNIT,
        np.zeros(s),
        np.full(s, prior / UNIT),
    ), span


def nearest(found, span, state):
    """Return the candidate next to a state, in metres and seconds."""
    scale = UNIT / span ** np.arange(found.shape[2])[:, None]
    points = found[0] * scale
    error = np.linalg.norm(points[:, 0] - state[:3], axis=-1)
    return points[np.nanargmin(error)], np.nanmin(error)


@pytest.mark.parametrize("epochs", [12, 30, 200])
@pytest.mark.parametrize("places", [PLACES, SPATIAL], ids=["plane", "space"])
def test_exact_without_noise(epochs, places):
    problem, span = course(epochs, places=places)
    state, bias = candidates(problem)
    _, error = nearest(state, span, FIXED)
    assert error < 1.0
    assert np.abs(bias[0] * UNIT - DELAYS).max() < 0.1


def test_moving_target_in_space_is_exact_without_noise():
    problem, span = course(40, places=SPATIAL, state=MOVING)
    state, bias = candidates(problem, 1)
    point, error = nearest(state, span, MOVING)
    assert error < 20.0
    assert np.abs(point[1] - MOVING[3:]).max() < 0.2
    assert np.abs(bias[0] * UNIT - DELAYS).max() < 0.1


def test_a_plane_of_stations_gives_both_branches_of_a_moving_target():
    """Reflected in the moving plane of the stations the target makes the same range differences."""
    normal = np.array([0.0, 1.0, 3.0]) / np.sqrt(10.0)
    drift = normal * (normal @ SPEEDS[0])

    def reflect(v):
        return v - 2.0 * (v @ normal) * normal

    mirror = np.concatenate([reflect(MOVING[:3] - PLACES[0]) + PLACES[0], reflect(MOVING[3:] - drift) + drift])
    np.testing.assert_allclose(mirror, [200e3, 243e3, -166e3, -100.0, 60.0, 180.0], atol=1e-6)
    problem, span = course(40, state=MOVING)
    again, _ = course(40, state=mirror)
    np.testing.assert_allclose(problem.offset, again.offset, atol=1e-12)
    state, _ = candidates(problem, 1)
    for truth in (MOVING, mirror):
        _, error = nearest(state, span, truth)
        assert error < 100.0


def test_the_plane_case_works_in_two_dimensions():
    places = 1e3 * np.array([[0.0, 0.0], [-12.0, 5.0], [15.0, -3.0], [4.0, 20.0]])
    speeds = np.array([[120.0, 30.0], [100.0, -20.0], [90.0, 60.0], [110.0, 0.0]])
    span, target = 300.0, np.array([80e3, 60e3])
    time = np.linspace(0.0, span, 25)
    station = places + speeds * time[:, None, None]
    ranges = np.linalg.norm(target - station, axis=-1)
    offset = (ranges[:, 1:] - ranges[:, :1] + np.array([20.0, -10.0, 5.0]))[None]
    eye = np.broadcast_to(np.eye(3), (1, 25, 3, 3))
    free = np.full(3, np.inf)
    problem = RegistrationCourse(
        time / span, station[None] / UNIT, offset / UNIT, np.ones(3), eye, eye[:, :1] * UNIT, np.zeros(3), free
    )
    state, bias = candidates(problem)
    assert np.nanmin(np.linalg.norm(state[0, :, 0] * UNIT - target, axis=-1)) < 5.0
    np.testing.assert_allclose(bias[0] * UNIT, [20.0, -10.0, 5.0], atol=0.05)


def test_a_prior_of_the_biases_steadies_short_records():
    loose, tight = [], []
    for seed in range(20):
        for prior, errors in ((np.inf, loose), (100.0, tight)):
            problem, _ = course(30, sigma=1.5, noise=1.5, seed=seed, span=60.0, prior=prior)
            best = candidates(problem)[0][0, 0, 0] * UNIT
            errors.append(np.linalg.norm(best - FIXED))
    assert np.median(tight) < 0.5 * np.median(loose)
    assert np.max(tight) < 10e3 < np.max(loose)


def test_silent_stations_do_not_matter():
    problem, span = course(30)
    whiten = np.broadcast_to(problem.whiten, (1, 30, 4, 4)).copy()
    offset = problem.offset.copy()
    for k in range(0, 30, 3):  # every third epoch one station is not heard; its offset is nonsense
        i = k % 4
        heard = np.arange(4) != i
        covariance = np.linalg.inv(problem.whiten[0, 0].T @ problem.whiten[0, 0])[np.ix_(heard, heard)]
        whiten[0, k] = 0.0
        whiten[0, k][np.ix_(heard, heard)] = np.linalg.inv(np.linalg.cholesky(covariance))
        offset[0, k, i] = 7.0
    patchy = replace(problem, offset=offset, whiten=whiten)
    assert nearest(candidates(patchy)[0], span, FIXED)[1] < 1.0


def test_numbers_that_are_not_finite_spoil_only_their_own_item():
    one, span = course(30)
    offset = np.concatenate([one.offset, one.offset])
    offset[1, 3, 2] = np.nan
    both = replace(one, offset=offset)
    state, _ = candidates(both)
    assert nearest(state[:1], span, FIXED)[1] < 1.0
    assert np.isnan(state[1]).all(-1).all(-1).any()


def test_without_biases():
    one, span = course(30, bias=0.0 * DELAYS)
    none = replace(one, bias=np.zeros((1, 30, 4, 0)), mean=np.zeros(0), sigma=np.zeros(0))
    assert nearest(candidates(none)[0], span, FIXED)[1] < 1.0
