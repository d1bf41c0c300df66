"""Bounds of gain ratios over boxes hold in every sample, and are tight enough to be of use."""

import numpy as np
import pytest
from proof.costs import WIDTH
from proof.sampling import bounded, changes, curved, differences, numbers, remainders, samples, value

from optloc.proof.nodes.angles import ALONE
from optloc.proof.nodes.node import AZIMUTH, RANGE
from optloc.proof.nodes.ratio import RATIO_OF_RANGES, bound_ratio
from optloc.proof.position_costs import mark_alone

pytestmark = pytest.mark.usefixtures("form")


@pytest.mark.parametrize("d", [2, 3])
def test_values_gradients_and_hessians_are_those_of_the_model(d):
    rng = np.random.default_rng(1)
    for _ in range(50):
        data, x = numbers("groa", d, rng), np.zeros(3)
        x[:d] = rng.normal(size=d) * 5e3
        own = bounded("groa", data, x, np.eye(3), np.zeros(3))[0]
        assert own == pytest.approx(value("groa", d, data, x), rel=1e-12)
        assert max(differences("groa", d, rng)) < 1e-5


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("near", [False, True])
def test_no_sample_leaves_its_enclosure(d, near):
    """Boxes from a thousandth to twice the distance, so that some hold a station."""
    rng = np.random.default_rng(2)
    results = np.array([remainders("groa", d, rng, 10 ** rng.uniform(-3.0, 0.3), near) for _ in range(60)])
    assert results[:, 0].max() <= 0.0
    assert np.nanmedian(results[:, 1]) < 2.5


@pytest.mark.parametrize("d", [2, 3])
def test_gradients_and_hessians_change_no_more_than_bounded(d):
    rng = np.random.default_rng(3)
    results = np.array([changes("groa", d, rng, 10 ** rng.uniform(-2.5, -0.3)) for _ in range(60)])
    assert np.isfinite(results[:, 0]).mean() > 0.8
    assert np.nanmax(results) <= 1.0
    assert np.nanmedian(results[:, 0]) > 0.1


def around_second_station():
    data = np.zeros(WIDTH)
    data[0], data[3] = 100.0, -100.0
    return data, np.array([-98.0, 1.0, 0.0]), np.array([5.0, 5.0, 0.0])


def test_around_the_second_station_a_ratio_has_no_upper_end():
    data, x, half = around_second_station()
    middle, slope, low, high = bounded("groa", data, x, np.eye(3), half)
    assert high == np.inf
    assert not slope.any()
    ratios = value("groa", 2, data, x + samples(half, 5000, np.random.default_rng(4)))
    assert 15.0 < middle + low <= ratios.min()
    assert curved("groa", data, x, np.eye(3), half)[2] == np.inf


def test_rows_that_nodes_share_are_told_from_rows_of_their_own():
    kinds = np.array([AZIMUTH, AZIMUTH, AZIMUTH, RANGE])
    K = np.array([[50.0, 0, 0, 0], [0, 10.0, 0, 0], [0, 0, 10.0, 0.5], [0, 0, 0, 1.0]])
    w = np.array([[0.0, 13.0, 9.0, 4.0], [0.0, 12.0, 8.0, 4.0]])
    turned = np.linalg.qr(np.random.default_rng(5).normal(size=(4, 4)))[0]
    for rows, right in ((K, w), (turned @ K, w @ turned.T)):
        out = mark_alone(kinds, np.zeros((1, 4, WIDTH)), rows[None], right)
        # the second is alone as well, but its least cost is not at zero
        assert out[:, :, ALONE].tolist() == [[1.0, 0.0, 0.0, 0.0]]
    shifted = w + np.eye(4)[0]
    assert mark_alone(kinds, np.zeros((1, 4, WIDTH)), K[None], shifted)[0, 0, ALONE] == 0.0


def test_ratio_and_slope_of_a_point_are_those_of_the_ranges(plainly):
    a, b, sense, half, slope = np.array([3.0, 4.0, 0]), np.array([0.0, 4.0, 0]), np.eye(3), np.zeros(3), np.zeros(3)
    value, low, high = bound_ratio(np.zeros(WIDTH), a, sense, b, sense, half, slope)
    assert value == pytest.approx(5.0 / 4.0)
    np.testing.assert_allclose(slope, a / (5.0 * 4.0) - 5.0 * b / 4.0**3, atol=1e-12)
    assert low <= 0.0 <= high < 1e-12


def test_points_twice_as_near_to_one_station_fill_the_ball_of_apollonius(plainly):
    data = np.zeros(WIDTH)
    data[3] = 3.0  # the other station
    x, y, z, radius = RATIO_OF_RANGES.ball(data, 0.0, 0.5)
    assert (x, y, z, radius) == pytest.approx((-1.0, 0.0, 0.0, 2.0))
    assert RATIO_OF_RANGES.ball(data, 0.5, 2.0)[3] == np.inf
