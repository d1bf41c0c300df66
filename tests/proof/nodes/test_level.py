"""Bounds of the geodetic height over boxes hold in every sample, and its compiled form is the model's."""

import numpy as np
import pytest
from proof.sampling import bounded, changes, curved, differences, numbers, remainders, samples, value

from optloc.models.primitives import WGS84_A, WGS84_F, geodetic_height
from optloc.proof.nodes.level import LEAST_RADIUS, geodetic

pytestmark = pytest.mark.usefixtures("form")

B = WGS84_A * (1.0 - WGS84_F)


def test_the_compiled_height_is_that_of_the_model():
    rng = np.random.default_rng(1)
    for height in (-1e6, -5e3, 0.0, 1e3, 1e6, 4e7):
        for _ in range(20):
            v = rng.normal(size=3)
            x = v / np.linalg.norm(v) * (6.37e6 + height)
            assert geodetic(*x)[0] == pytest.approx(geodetic_height(tuple(x)), rel=1e-12, abs=2e-9)


@pytest.mark.parametrize(("place", "height"), [((WGS84_A + 7.0, 0.0, 0.0), 7.0), ((0.0, 0.0, B + 9.0), 9.0)])
def test_heights_above_equator_and_pole_are_known(place, height):
    assert geodetic(*place)[0] == pytest.approx(height, abs=1e-8)


def test_gradient_and_hessian_are_those_of_the_model():
    errors = np.array([differences("height", 3, np.random.default_rng(i)) for i in range(20)])
    assert errors.max() < 1e-5


def test_no_sample_leaves_its_enclosure():
    rng = np.random.default_rng(2)
    results = np.array([remainders("height", 3, rng, 10 ** rng.uniform(-3.0, 0.3), near=False) for _ in range(60)])
    assert results[:, 0].max() <= 0.0
    assert np.nanmedian(results[:, 1]) < 1.5


def test_gradients_and_hessians_change_no_more_than_bounded():
    rng = np.random.default_rng(3)
    results = np.array([changes("height", 3, rng, 10 ** rng.uniform(-2.5, -0.3)) for _ in range(60)])
    assert np.isfinite(results[:, 0]).mean() > 0.8
    assert np.nanmax(results) <= 1.0
    assert np.nanmedian(results[:, 0]) > 0.2


def test_the_remainder_is_that_of_a_ball_of_the_least_curvature_at_most():
    """Along the ground near the pole's meridian and across it: between nothing and s^2 / (2 (b^2/a + h))."""
    rng = np.random.default_rng(4)
    data = numbers("height", 3, rng)
    x, half = np.zeros(3), np.full(3, 1e4)
    _, _, low, high = bounded("height", data, x, np.eye(3), half)
    assert low == pytest.approx(0.0, abs=1e-7)
    assert high < 1.01 * 3e8 / (2.0 * (LEAST_RADIUS - 4e4))


def test_deep_in_the_earth_there_is_an_enclosure_and_no_slope():
    rng = np.random.default_rng(5)
    data = numbers("height", 3, rng)
    x = -(data[6:15].reshape(3, 3).T @ data[3:6]) * 0.9
    half = np.full(3, 4e5)
    middle, slope, low, high = bounded("height", data, x, np.eye(3), half)
    heights = value("height", 3, data, x + samples(half, 5000, rng))
    assert not slope.any()
    assert curved("height", data, x, np.eye(3), half)[2] == np.inf
    assert middle + low <= heights.min()
    assert heights.max() <= middle + high < -4.5e6
