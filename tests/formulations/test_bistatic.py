"""One receiver and one illuminator: closed-form range, its bound, and the linear start of a moving target."""

import numpy as np
import pytest

from formulations.bistatic import course, range_of, triad

C, D = 299792458.0, 150e3
A = np.array([1.0, 0.0, 0.0])
DEGREE = np.radians(1.0)
PATH = C * 20e-9 / D


def excess(p, illuminator=A):
    r, reach = np.linalg.norm(p, axis=-1), np.linalg.norm(p - illuminator, axis=-1)
    return r + reach - np.linalg.norm(illuminator, axis=-1)


def covariance(axes, elevation, sigma=DEGREE):
    first, second = sigma * np.cos(elevation) * axes[0], sigma * axes[1]
    return np.outer(first, first) + np.outer(second, second)


def test_closed_form_is_the_truth():
    rng = np.random.default_rng(0)
    u, r = (
        triad(rng.uniform(0.3, 2 * np.pi - 0.3, 5000), rng.uniform(-1.5, 1.5, 5000))[:, 2],
        rng.uniform(0.1, 10, 5000),
    )
    found = range_of(excess(r[:, None] * u), u, A)
    assert found.valid.all()
    assert np.abs(found.range / r - 1).max() < 6e-14


def test_any_illuminator_and_batch_shapes():
    rng = np.random.default_rng(1)
    p, where = rng.normal(size=(4, 1, 3)), rng.normal(size=(5, 3))
    r = np.linalg.norm(p, axis=-1)
    found = range_of(excess(p, where), p / r[..., None], where)
    assert found.range.shape == (4, 5)
    np.testing.assert_allclose(found.range, np.broadcast_to(r, (4, 5)), rtol=1e-11)
    step = 1e-6
    further = range_of(excess(p, where) + step, p / r[..., None], where)
    np.testing.assert_allclose((further.range - found.range) / step, 1 / found.slope, rtol=1e-4)


def test_printed_partials():
    axes = triad(1.446, 0.123)
    p = 81.2e3 / D * axes[2]
    np.testing.assert_allclose(p * D, [10031, 79960, 9962], atol=1)
    assert excess(p) * D / C == pytest.approx(309.234e-6, rel=1e-5)
    found = range_of(excess(p), axes[2], A)
    assert found.slope == pytest.approx(1.38804, abs=1e-5)
    assert found.turn @ axes[0] * np.cos(0.123) * D / 1e3 == pytest.approx(74.2633, abs=1e-4)
    assert found.turn @ axes[1] * D / 1e3 == pytest.approx(1.15171, abs=1e-5)
    assert abs(found.turn @ axes[2]) < 1e-15
    assert found.deviation(PATH, covariance(axes, 0.123)) * D == pytest.approx(934, abs=0.5)


@pytest.mark.parametrize(
    ("azimuth", "km"),
    [(0.05, 9.83), (0.2, 5.59), (0.5, 2.64), (1.0, 1.40), (1.446, 0.934), (2.0, 0.563), (2.6, 0.257), (3.1, 0.060)],
)
def test_bound_against_azimuth(azimuth, km):
    axes = triad(azimuth, 0.123)
    found = range_of(excess(81.2e3 / D * axes[2]), axes[2], A)
    assert found.deviation(PATH, covariance(axes, 0.123)) * D / 1e3 == pytest.approx(km, rel=5e-3)


def test_towards_the_illuminator_there_is_no_range():
    # between the two the excess path vanishes, and with it the slope
    for off, valid in ((0.0, False), (1e-9, False), (5e-4, False), (1e-2, True)):
        axes = triad(off, 0.0)
        found = range_of(excess(0.5 * axes[2]), axes[2], A)
        assert found.valid == valid
        assert np.isfinite(found.deviation(PATH, covariance(axes, 0.0))) == valid
        if off >= 5e-4:
            assert found.slope == pytest.approx(2 * off**2, rel=1e-3)
    # behind the receiver it is an ordinary radar, and beyond the illuminator too
    assert range_of(excess(-0.5 * A), -A, A).range == pytest.approx(0.5)
    assert range_of(excess(1.5 * A), A, A).range == pytest.approx(1.5)


def test_bad_input_is_not_valid():
    u = triad(1.0, 0.1)[2]
    found = range_of(np.array([0.0, -0.1, np.nan, np.inf, 0.2]), u, A)
    np.testing.assert_array_equal(found.valid, [False, False, False, False, True])
    np.testing.assert_array_equal(np.isnan(found.range), ~found.valid)
    assert not range_of(0.2, u * np.nan, A).valid
    assert range_of(0.2, u, A, least=1.9).valid == (range_of(0.2, u, A).slope >= 1.9)


def moving(epochs, order=1):
    time = np.arange(epochs) + 100.0
    c = np.array([81.2e3 * triad(1.446, 0.123)[2], [4.0, 10.0, 6.0], [0.01, -0.02, 0.005]])[: order + 1] / D
    return time, c, (time[:, None] ** np.arange(order + 1.0)) @ c


def measured(p, count=None, rng=None, sigma=DEGREE):
    r = np.linalg.norm(p, axis=-1)
    azimuth, elevation, path = np.arctan2(p[:, 1], p[:, 0]), np.arcsin(p[:, 2] / r), excess(p)
    deviation = np.stack([sigma * np.cos(elevation), np.full(len(p), sigma), np.full(len(p), PATH)], -1)
    if rng is None:
        return path, triad(azimuth, elevation), deviation
    noise = rng.normal(size=(3, count, len(p)))
    axes = triad(azimuth + sigma * noise[0], elevation + sigma * noise[1])
    return path + PATH * noise[2], axes, deviation


@pytest.mark.parametrize("order", [0, 1, 2])
def test_course_without_noise_is_the_truth(order):
    time, c, p = moving(30, order)
    path, axes, sigma = measured(p)
    found = course(path, axes, A, time, sigma, order=order)
    assert found.valid
    np.testing.assert_allclose(time[:, None] ** np.arange(order + 1.0) @ found.coefficients, p, atol=1e-11)
    np.testing.assert_allclose(found.coefficients, c, atol=1e-8)


def test_course_of_the_slow_target():
    time, _, p = moving(200)
    path, axes, sigma = measured(p, 400, np.random.default_rng(2))
    found = course(path, axes, A, time, sigma)
    assert found.valid.all()
    end = np.linalg.norm(found.coefficients[:, 0] + found.coefficients[:, 1] * time[-1], axis=-1)
    rmse = np.sqrt(np.mean((end - np.linalg.norm(p[-1])) ** 2)) * D
    # bound 110 m; pseudo-linear, published weights, 152 m
    assert 110 < rmse < 165


def test_absent_rows_change_nothing_but_their_own():
    time, _, p = moving(20)
    path, axes, sigma = measured(p, 3, np.random.default_rng(3))
    sigma = np.tile(sigma, (3, 1, 1))
    gone = path.copy()
    sigma[1, 4], gone[1, 4] = np.inf, np.nan
    found = course(gone, axes, A, time, sigma)
    fewer = np.delete(np.arange(20), 4)
    other = course(path[1, fewer], axes[1, fewer], A, time[fewer], sigma[1, fewer])
    np.testing.assert_allclose(found.coefficients[1], other.coefficients, rtol=1e-9, atol=1e-12)
    whole = course(path, axes, A, time, sigma[0])
    np.testing.assert_array_equal(found.coefficients[[0, 2]], whole.coefficients[[0, 2]])
    # delay alone, or angles alone, on some epochs
    sigma[0, ::2, 2] = np.inf
    sigma[0, 1::2, :2] = np.inf
    assert course(path, axes, A, time, sigma).valid[0]


def test_what_does_not_determine_a_course_is_not_valid():
    time, _, p = moving(5)
    path, axes, sigma = measured(p)
    assert not course(path[:1], axes[:1], A, time[:1], sigma[:1]).valid
    assert course(path[:1], axes[:1], A, time[:1], sigma[:1], order=0).valid
    assert not course(path, axes, A, np.zeros(5), sigma).valid
    assert not course(path * np.nan, axes, A, time, sigma).valid
    # rays that point away from where the delay puts the target
    back = course(path, axes * [[[1], [1], [-1]]], A, time, sigma)
    assert not back.valid or (back.coefficients[0] @ axes[0, 2] < 0)
    assert np.isnan(course(path, axes, np.array([np.nan, 0, 0]), time, sigma).coefficients).all()
