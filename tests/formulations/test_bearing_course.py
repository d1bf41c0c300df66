"""Pseudo-linear courses: exact without noise, in any axes and batch; absent, singular and backward bearings."""

import numpy as np
import pytest

from formulations.bearing_course import sight_courses

RNG = np.random.default_rng(3)
TIMES = np.arange(12.0) + 40.0
COURSE = np.array([[0.4, 1.5, 0.3], [0.03, -0.02, 0.01], [1e-3, 2e-3, -1e-3]])
PLACES = np.stack([0.3 * np.cos(TIMES), 0.3 * np.sin(1.3 * TIMES), 0.1 * np.cos(0.7 * TIMES)], axis=-1)


def path(course, times=TIMES):
    return sum(c * times[:, None] ** j for j, c in enumerate(course))


def angles(line, axes=None):
    own = line if axes is None else np.einsum("...ij,...j->...i", axes, line)
    return np.arctan2(own[..., 1], own[..., 0]), np.arctan2(own[..., 2], np.hypot(own[..., 0], own[..., 1]))


def seen(order, axes=None, d=3):
    """Return the arguments of a run of one moving station, as a batch of one."""
    line = path(COURSE[: order + 1, :d]) - PLACES[:, :d]
    line = line if d == 3 else np.concatenate([line, np.zeros((len(line), 1))], axis=1)
    A, E = angles(line, axes)
    ones = np.full((1, len(TIMES)), 1e3)
    more = {} if d == 2 else {"elevation": E[None], "elevation_weight": ones}
    return (A[None], PLACES[None, :, :d], TIMES, ones), more


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("turned", [False, True])
def test_exact_bearings_of_one_moving_station_give_the_course(order, turned):
    axes = np.linalg.qr(RNG.standard_normal((12, 3, 3)))[0] if turned else None
    args, more = seen(order, axes)
    found = sight_courses(*args, **more, axes=None if axes is None else axes[None], order=order)
    assert found.ahead.all()
    for course in (found.plain, found.weighted, found.instrumental):
        where = path(course[0]) - path(COURSE[: order + 1])
        assert np.abs(where).max() < 1e-8


def test_azimuths_give_a_course_in_the_plane():
    args, _ = seen(1, d=2)
    found = sight_courses(*args, order=1)
    assert path(found.instrumental[0]) == pytest.approx(path(COURSE[:2, :2]), abs=1e-9)


def test_absent_angles_are_not_read_and_a_batch_is_one_by_one():
    args, more = seen(1)
    A, S, t, w = (np.repeat(v, 3, axis=0) if v.ndim > 1 else v for v in args)
    E, v = (np.repeat(value, 3, axis=0) for value in more.values())
    A[0, 3], w[0, 3] = np.nan, 0.0
    E[1, 5], v[1, 5] = np.nan, 0.0
    A[2, 0] = np.nan
    found = sight_courses(A, S, t, w, elevation=E, elevation_weight=v, order=1)
    assert found.ok.tolist() == [True, True, False]
    assert np.isnan(found.instrumental[2]).all()
    for i in (0, 1):
        assert path(found.instrumental[i]) == pytest.approx(path(COURSE[:2]), abs=1e-8)


def test_what_the_bearings_leave_open_is_nan():
    still = np.zeros((1, 12, 3))
    A, E = angles(path(COURSE[:2]))
    ones = np.ones((1, 12))
    one_place = sight_courses(A[None], still, TIMES, ones, elevation=E[None], elevation_weight=ones, order=1)
    assert not one_place.ok.any()
    args, more = seen(1)
    no_heights = sight_courses(*args, order=1)
    assert not no_heights.ok.any()
    few = [value[:, :2] if np.ndim(value) > 1 else value[:2] for value in args]
    two_epochs = sight_courses(*few, **{name: value[:, :2] for name, value in more.items()}, order=2)
    assert not two_epochs.ok.any()
    assert np.isnan(two_epochs.plain).all()


def test_bearings_from_behind_are_not_ahead():
    args, more = seen(0)
    back = sight_courses(args[0] + np.pi, *args[1:], elevation=-more["elevation"], elevation_weight=args[3], order=0)
    assert back.ok.all()
    assert not back.ahead.any()


def test_many_rays_bias_least_squares_and_not_the_instrumental_course():
    trials, sigma = 300, 0.02
    times = np.linspace(40.0, 52.0, 120)
    places = np.stack([0.3 * np.cos(times), 0.3 * np.sin(1.3 * times), 0.1 * np.cos(0.7 * times)], axis=-1)
    A, E = angles(path(COURSE[:2], times) - places)
    ones = np.full((trials, 120), 1.0 / sigma)
    found = sight_courses(
        A + sigma * RNG.standard_normal((trials, 120)),
        np.broadcast_to(places, (trials, 120, 3)),
        times,
        ones,
        elevation=E + sigma * RNG.standard_normal((trials, 120)),
        elevation_weight=ones,
        order=1,
    )
    middle = np.array([1.0, 46.0])
    bias = {
        name: np.linalg.norm((middle[:, None] * (getattr(found, name) - COURSE[:2])).sum(1).mean(0))
        for name in ("plain", "weighted", "instrumental")
    }
    assert bias["instrumental"] < 0.1 * min(bias["plain"], bias["weighted"])
