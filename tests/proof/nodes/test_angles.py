"""Bounds of azimuth and elevation over boxes hold in every sample, and are tight enough to be of use."""

import numpy as np
import pytest
from proof.sampling import axes, bounded, changes, curved, differences, halves, numbers, remainders, samples, value

from optloc.proof.nodes.angles import ALONE

pytestmark = pytest.mark.usefixtures("form")

KINDS = [("azimuth", 2), ("azimuth", 3), ("elevation", 3)]


@pytest.mark.parametrize(("kind", "d"), KINDS)
def test_values_are_those_of_the_model(kind, d):
    rng = np.random.default_rng(1)
    for _ in range(100):
        data, x = numbers(kind, d, rng), np.zeros(3)
        x[:d] = rng.normal(size=d) * 5e3
        assert bounded(kind, data, x, np.eye(3), np.zeros(3))[0] == pytest.approx(value(kind, d, data, x), abs=1e-12)


@pytest.mark.parametrize(("kind", "d"), KINDS)
def test_gradient_and_hessian_are_those_of_the_model(kind, d):
    errors = np.array([differences(kind, d, np.random.default_rng(i)) for i in range(20)])
    assert errors.max() < 1e-5


@pytest.mark.parametrize(("kind", "d"), KINDS)
@pytest.mark.parametrize("near", [False, True])
def test_no_sample_leaves_its_enclosure(kind, d, near):
    """Boxes from a thousandth to twice the distance, so that some hold the station, the vertical or the cut."""
    rng = np.random.default_rng(2)
    results = np.array([remainders(kind, d, rng, 10 ** rng.uniform(-3.0, 0.3), near) for _ in range(60)])
    assert results[:, 0].max() <= 0.0
    assert np.nanmedian(results[:, 1]) < 2.0


@pytest.mark.parametrize(("kind", "d"), KINDS)
def test_gradients_and_hessians_change_no_more_than_bounded(kind, d):
    rng = np.random.default_rng(3)
    results = np.array([changes(kind, d, rng, 10 ** rng.uniform(-2.5, -0.3)) for _ in range(60)])
    assert np.isfinite(results[:, 0]).mean() > 0.8
    assert np.nanmax(results) <= 1.0
    assert np.nanmedian(results[:, 0]) > 0.1


@pytest.mark.parametrize(("kind", "d"), KINDS)
def test_bounds_of_change_shrink_at_least_like_the_box(kind, d):
    rng = np.random.default_rng(4)
    for _ in range(40):
        data, x = numbers(kind, d, rng), rng.normal(size=3) * 3e3
        x[d:] = 0.0
        sense, half = axes(d, 1e3, rng), halves(d, rng)
        _, turn, chi = curved(kind, data, x, sense, half)
        if chi == np.inf:
            continue
        for t in (0.9, 0.5, 0.1):
            _, less, smaller = curved(kind, data, x, sense, t * half)
            assert smaller <= t * chi * (1.0 + 1e-12)
            assert (less <= t * turn * (1.0 + 1e-12)).all()


def behind(sign):
    """Return an azimuth measured along x, and a point behind the station on one side of the cut."""
    data = numbers("azimuth", 2, np.random.default_rng(0))
    data[:3], data[6:15], data[15] = 0.0, np.eye(3).ravel(), 0.0
    return data, np.array([-100.0, 3.0 * sign, 0.0])


def test_an_azimuth_that_jumps_in_the_box_has_no_slope():
    data, x = behind(1.0)
    middle, slope, low, high = bounded("azimuth", data, x, np.eye(3), np.full(3, 5.0))
    assert not slope.any()
    assert (middle + low, middle + high) == (pytest.approx(-np.pi), pytest.approx(np.pi))
    assert curved("azimuth", data, x, np.eye(3), np.full(3, 5.0))[2] == np.inf


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_azimuth_alone_is_folded_at_the_jump(sign):
    """The absolute value is bounded away from zero, where the wrapped angle is not, and holds in every sample."""
    data, x = behind(sign)
    data[ALONE] = 1.0
    half = np.array([20.0, 5.0, 0.0])
    middle, slope, low, high = bounded("azimuth", data, x, np.eye(3), half)
    angle = np.abs(value("azimuth", 2, data, x + samples(half, 10000, np.random.default_rng(5))))
    assert not slope.any()
    assert middle + low <= angle.min()
    assert angle.max() <= middle + high + 1e-15
    assert middle + low == pytest.approx(angle.min(), abs=0.02)
    assert middle == pytest.approx(abs(value("azimuth", 2, data, x)))


def test_the_product_of_reaches_would_be_three_times_as_wide():
    """A diagonal line of sight: squares of a coordinate have a sign, which the bound uses."""
    data, x = behind(1.0)
    half, x = np.array([5.0, 5.0, 0.0]), np.array([100.0, 100.0, 0.0])
    _, _, low, high = bounded("azimuth", data, x, np.eye(3), half)
    reach = 10.0 / np.hypot(100.0, 100.0) / np.sqrt(2.0)
    assert high - low < 2.0 * reach**2 / 3.0
