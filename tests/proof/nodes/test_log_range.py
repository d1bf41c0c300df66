"""Bounds of logarithms of ranges over boxes hold in every sample; one without an end still bounds a residual."""

import numpy as np
import pytest
from proof.costs import WIDTH
from proof.sampling import bounded, changes, curved, differences, numbers, remainders, samples, value

from optloc.models import MODELS, Point
from optloc.proof.box import bound_nodes, least_residual, linearise_rows
from optloc.proof.nodes.log_range import bound_logarithm, curve_logarithm
from optloc.proof.nodes.node import LOG_RANGE, RATIO
from optloc.proof.search_space import empty_box

pytestmark = pytest.mark.usefixtures("form")


@pytest.mark.parametrize("d", [2, 3])
def test_values_gradients_and_hessians_are_those_of_a_range(d):
    rng = np.random.default_rng(1)
    for _ in range(50):
        data, x = numbers("log range", d, rng), np.zeros(3)
        x[:d] = rng.normal(size=d) * 5e3
        own = bounded("log range", data, x, np.eye(3), np.zeros(3))[0]
        assert own == pytest.approx(value("log range", d, data, x), rel=1e-12)
        assert max(differences("log range", d, rng)) < 1e-5


@pytest.mark.parametrize("d", [2, 3])
def test_a_signal_strength_is_a_multiple_of_its_difference(d):
    rng, model = np.random.default_rng(4), MODELS["rss_difference"]
    place, x = rng.normal(size=(2, d)), rng.normal(size=d)
    ((factor, _),) = model.nodes
    logarithms = np.log(np.linalg.norm(x - place, axis=-1))
    h = model.h(*(Point(tuple(at)) for at in (x, *place)))
    assert h == pytest.approx(factor * (logarithms[0] - logarithms[1]), rel=1e-12)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("near", [False, True])
def test_no_sample_leaves_its_enclosure(d, near):
    """Boxes from a thousandth to thrice the distance, so that some hold a station."""
    rng = np.random.default_rng(2)
    results = np.array([remainders("log range", d, rng, 10 ** rng.uniform(-3.0, 0.5), near) for _ in range(60)])
    assert results[:, 0].max() <= 0.0
    assert np.nanmedian(results[:, 1]) < 2.5


@pytest.mark.parametrize("d", [2, 3])
def test_gradients_and_hessians_change_no_more_than_bounded(d):
    rng = np.random.default_rng(3)
    results = np.array([changes("log range", d, rng, 10 ** rng.uniform(-2.5, -0.3)) for _ in range(60)])
    assert np.isfinite(results[:, 0]).mean() > 0.8
    assert np.nanmax(results) <= 1.0
    assert np.nanmedian(results[:, 0]) > 0.1


def test_around_its_station_a_logarithm_has_no_lower_end():
    data, x, half = np.zeros(WIDTH), np.array([1.0, 0.5, 0.0]), np.array([2.0, 2.0, 0.0])
    middle, slope, low, high = bounded("log range", data, x, np.eye(3), half)
    assert low == -np.inf
    assert not slope.any()
    assert middle + high >= value("log range", 2, data, x + samples(half, 5000, np.random.default_rng(4))).max()
    assert curved("log range", data, x, np.eye(3), half)[2] == np.inf


@pytest.mark.parametrize("kind", [LOG_RANGE, RATIO])
@pytest.mark.parametrize("shared", [False, True], ids=["a row each", "a row for all"])
def test_what_has_no_end_bounds_a_residual_from_the_other_side(kind, shared):
    """Boxes around stations: no sample has a shorter residual, and small boxes are told from where the target is."""
    rng, told, half = np.random.default_rng(5), 0, np.array([1.0, 1.0, 0.0])
    for _ in range(200):
        size = 10.0 ** rng.uniform(-2.0, 1.0)
        data = np.zeros((3, WIDTH))
        data[:, :2], data[:, 3:5] = rng.uniform(-100.0, 100.0, (2, 3, 2))
        station = data[0, :2] if kind == LOG_RANGE else data[0, 3:5]
        kinds, sense = np.full(3, kind), np.diag([size, size, 0.0])
        K = np.eye(3) / 0.05
        K = np.linalg.qr(rng.normal(size=(3, 3)))[0] @ K if shared else K
        x = np.append(station + size * rng.uniform(-1.0, 1.0, 2), 0.0)
        name = {LOG_RANGE: "log range", RATIO: "groa"}[kind]
        truth = np.append(rng.uniform(-100.0, 100.0, 2), 0.0)
        w = K @ [value(name, 2, each, truth) for each in data]
        box, weight = empty_box(3, 3), np.linalg.norm(K, axis=0)
        bound_nodes(kinds, data, x, sense, sense @ sense, half, box.line, box.nodes)
        linearise_rows(K, w, box.nodes, box.rows)
        low = least_residual(K, weight, 0.0, half, box.nodes, box.rows)
        points = x + samples(half, 500, rng) @ sense.T
        phi = np.stack([value(name, 2, each, points) for each in data], axis=-1)
        assert low <= np.linalg.norm(phi @ K.T - w, axis=-1).min() * (1.0 + 1e-9)
        assert np.isfinite(low)
        told += low > 1.0
    assert told > 100


def test_logarithm_and_slope_of_a_point_are_those_of_the_range(plainly):
    line, sense, half, slope = np.array([3.0, 4.0, 0.0]), np.diag([1.0, 2.0, 0.0]), np.zeros(3), np.zeros(3)
    value, low, high = bound_logarithm(np.zeros(WIDTH), line, sense, half, slope)
    assert value == pytest.approx(np.log(5.0))
    np.testing.assert_allclose(slope, [3.0 / 25.0, 8.0 / 25.0, 0.0])
    assert low <= 0.0 <= high < 1e-12
    hessian, turn = np.zeros((3, 3)), np.zeros(3)
    assert curve_logarithm(np.zeros(WIDTH), line, sense, half, hessian, turn) < 1e-12
    n = line[:2] / 5.0
    np.testing.assert_allclose(hessian[:2, :2], sense[:2, :2] @ (np.eye(2) - 2.0 * np.outer(n, n)) @ sense[:2, :2] / 25)
