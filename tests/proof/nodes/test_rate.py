"""Bounds of range rates over boxes hold in every sample; fixes by Doppler are what an independent search finds."""

import numpy as np
import pytest
from proof.costs import WIDTH
from proof.sampling import bounded, changes, differences, numbers, remainders, value

from optloc.proof.nodes.rate import VELOCITY

pytestmark = pytest.mark.usefixtures("form")


@pytest.mark.parametrize("d", [2, 3])
def test_values_gradients_and_hessians_are_those_of_the_model(d):
    rng = np.random.default_rng(1)
    for _ in range(50):
        data, x = numbers("range_rate", d, rng), np.zeros(3)
        x[:d] = rng.normal(size=d) * 5e3
        own = bounded("range_rate", data, x, np.eye(3), np.zeros(3))[0]
        assert own == pytest.approx(value("range_rate", d, data, x), rel=1e-9)
        assert max(differences("range_rate", d, rng)) < 1e-5


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("near", [False, True])
def test_no_sample_leaves_its_enclosure(d, near):
    """Boxes from a thousandth to thrice the distance, so that some hold a station."""
    rng = np.random.default_rng(2)
    results = np.array([remainders("range_rate", d, rng, 10 ** rng.uniform(-3.0, 0.5), near) for _ in range(60)])
    assert results[:, 0].max() <= 0.0
    assert np.nanmedian(results[:, 1]) < 2.5


@pytest.mark.parametrize("d", [2, 3])
def test_gradients_and_hessians_change_no_more_than_bounded(d):
    rng = np.random.default_rng(3)
    results = np.array([changes("range_rate", d, rng, 10 ** rng.uniform(-2.5, -0.3)) for _ in range(60)])
    assert np.isfinite(results[:, 0]).mean() > 0.8
    assert np.nanmax(results) <= 1.0
    assert np.nanmedian(results[:, 0]) > 0.1


def test_of_directions_alone_the_bound_is_attained():
    """A box beside the station whose cone holds the velocity: the rate reaches the speed, and falls to the far edge."""
    data, half = np.zeros(WIDTH), np.array([0.0, 0.5, 0.0])
    data[VELOCITY] = 7500.0
    middle, slope, low, high = bounded("range_rate", data, np.array([1.0, 0.0, 0.0]), np.eye(3), half)
    assert middle + high >= 7500.0
    assert middle + low <= 7500.0 * np.cos(np.arctan(0.5))
    # Around the station itself nothing is known but the speed.
    middle, slope, low, high = bounded("range_rate", data, np.array([0.1, 0.0, 0.0]), np.eye(3), half + 0.5)
    assert not slope.any()
    assert (middle + low, middle + high) == (-7500.0, 7500.0)
