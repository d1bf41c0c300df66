"""The inverse-range chart: exact maps, derivatives against differences, Gaussians drawn in it."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.base.records import join, take
from optloc.problem.chart import (
    CARTESIAN,
    CURVED,
    INVERSE_RANGE,
    Chart,
    basis,
    jacobian,
    log_volume,
    quantile,
    to_position,
)

# Straight down and almost so: where a construction of a basis by a cross product fails.
DIRECTIONS = [
    [0.0, 0.0, 1.0],
    [0.0, 0.0, -1.0],
    [1e-9, 0.0, -1.0],
    [1.0, 0.0, 0.0],
    [-0.6, 0.48, 0.64],
    [3.0, 1.0, -2.0],
]


def some(kind, d=3, n=None, seed=5, far=80e3, sigma=2e3):
    """Return a chart of fixes some 80 km off whose range is ten times worse than across."""
    rng = np.random.default_rng(seed)
    shape = () if n is None else (n,)
    centre, position = rng.normal(0, 1e3, (*shape, d)), rng.normal(0, far, (*shape, d))
    u = (position - centre) / np.linalg.norm(position - centre, axis=-1, keepdims=True)
    cov = (0.1 * sigma) ** 2 * np.eye(d) + 0.99 * sigma**2 * u[..., :, None] * u[..., None, :]
    return Chart(np.full(shape, kind, dtype=np.int8), position, cov, centre)


@pytest.mark.parametrize("d", [2, 3])
def test_a_basis_is_orthonormal_and_across(d):
    u = np.array(DIRECTIONS)[:, 3 - d :]
    u = u[np.linalg.norm(u, axis=1) > 0.1]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    full = np.concatenate([basis(u), u[..., None]], axis=-1)
    np.testing.assert_allclose(np.swapaxes(full, -1, -2) @ full, np.broadcast_to(np.eye(d), full.shape), atol=1e-14)


@pytest.mark.parametrize("d", [2, 3])
def test_points_come_back_and_the_fix_is_the_middle(d):
    chart, rng = some(INVERSE_RANGE, d, n=7), np.random.default_rng(1)
    y = np.concatenate([rng.normal(0, 2, (40, 7, d - 1)), rng.uniform(1e-3, 5, (40, 7, 1))], axis=-1)
    np.testing.assert_allclose(chart.to_chart(chart.to_position(y)), y, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(chart.to_chart(chart.position), chart.mean, atol=1e-12)
    assert (chart.to_chart(2 * chart.centre - chart.position)[..., -1] < 0).all()


@pytest.mark.parametrize("d", [2, 3])
def test_derivatives_agree_with_differences(d):
    position, centre, rng = np.full(d, 4e3), np.arange(d) * 100.0, np.random.default_rng(2)
    y, step = np.append(rng.normal(0, 1, d - 1), 0.7), 1e-6
    columns = [
        (to_position(y + step * e, position, centre) - to_position(y - step * e, position, centre)) / (2 * step)
        for e in np.eye(d)
    ]
    G = jacobian(y, position, centre)
    np.testing.assert_allclose(G, np.stack(columns, -1), rtol=1e-8, atol=1e-4)
    assert log_volume(y, position, centre) == pytest.approx(np.linalg.slogdet(G)[1])


@pytest.mark.parametrize("d", [2, 3])
def test_gradient_and_spread_at_the_fix(d):
    chart = some(INVERSE_RANGE, d, n=4)
    u0 = chart.direction
    assert chart.gradient == pytest.approx(
        chart.distance[:, None, None] * np.concatenate([chart.basis, -u0[..., None]], axis=-1), rel=1e-12
    )
    back = np.linalg.inv(chart.gradient)
    np.testing.assert_allclose(chart.spread, back @ chart.covariance @ np.swapaxes(back, -1, -2), rtol=1e-8, atol=1e-16)


@pytest.mark.parametrize("kind", [CARTESIAN, INVERSE_RANGE])
@pytest.mark.parametrize("d", [2, 3])
def test_regions_and_intervals_hold_what_is_drawn_from_the_gaussian(kind, d):
    chart, rng, n = some(kind, d, sigma=9e3), np.random.default_rng(3), 20000
    mean, cov = (chart.position, chart.covariance) if kind == CARTESIAN else (chart.mean, chart.spread)
    drawn = mean + rng.normal(size=(n, d)) @ np.linalg.cholesky(cov).T
    truth = drawn if kind == CARTESIAN else chart.to_position(drawn)
    away = truth - chart.centre
    numbers = {
        "range": away @ chart.direction,
        "bearing": np.arctan2(away[:, 1], away[:, 0]),
        "elevation": np.arctan2(away[:, -1], np.hypot(away[:, 0], away[:, 1])),
        "height": truth[:, -1],
    }
    for level in (0.68, 0.95):
        width = 5 * np.sqrt(level * (1 - level) / n)
        assert chart.covers(truth, level).mean() == pytest.approx(level, abs=width)
        extents = ["range", "bearing", *(["elevation"] if d == 3 else [])]
        for extent in extents + (["height"] if d == 3 and kind == CARTESIAN else []):
            low, high = chart.interval(extent, level)
            # Metres become ranges and angles to first order: at a spread of some per cent, to some thousandths.
            inside = (numbers[extent] >= low) & (numbers[extent] <= high)
            assert inside.mean() == pytest.approx(level, abs=width + 0.005), extent


def test_what_is_behind_the_centre_is_outside_and_infinity_may_be_inside():
    chart = some(INVERSE_RANGE, sigma=60e3)
    far = chart.centre + 1e6 * (chart.position - chart.centre)
    behind = 2 * chart.centre - chart.position
    assert chart.covers(np.stack([far, behind, chart.centre, chart.position]), 0.999).tolist() == [1, 0, 0, 1]
    low, high = chart.interval("range", 0.999)
    assert 0 < low < chart.distance
    assert high == np.inf


def test_a_curved_fix_has_no_gaussian_and_says_where_to_ask():
    chart = some(np.array(CURVED))
    for ask in (chart.covers, lambda _: chart.interval("range")):
        with pytest.raises(InvalidProblem, match="likelihood_region"):
            ask(np.zeros(3))
    with pytest.raises(InvalidProblem, match="likelihood_region"):
        some(INVERSE_RANGE).interval("height")
    with pytest.raises(InvalidProblem, match="plane"):
        some(CARTESIAN, d=2).interval("elevation")
    with pytest.raises(InvalidProblem, match="did you mean 'range'"):
        some(CARTESIAN).interval("rang")
    with pytest.raises(InvalidProblem, match="probability"):
        some(CARTESIAN).covers(np.zeros(3), 1.5)


def test_a_fix_at_the_centre_has_no_chart_but_a_region():
    base = some(CARTESIAN)
    chart = Chart(base.kind, base.centre, base.covariance, base.centre)
    assert np.isnan(chart.to_chart(base.position)).all()
    assert chart.covers(base.centre)
    assert not chart.covers(base.centre + 10e3)
    low, high = chart.interval("bearing")
    assert high - low == pytest.approx(2 * np.pi)
    assert chart.interval("range")[0] == 0


def test_charts_are_records():
    charts = some(CARTESIAN, n=5)
    both = join([take(charts, slice(0, 2)), take(charts, slice(2, 5))], 5)
    assert both.name.tolist() == ["cartesian"] * 5
    assert (both.position == charts.position).all()
    assert take(charts, 0).name == "cartesian"
    mixed = Chart(np.array([0, 1, 0, 1, 2], np.int8), charts.position, charts.covariance, charts.centre)
    assert np.isnan(mixed.distance_squared(charts.position)).tolist() == [0, 0, 0, 0, 1]
    with pytest.raises(InvalidProblem, match="1 of 5"):
        mixed.covers(charts.position)


def test_quantiles_are_those_of_chi_square():
    from scipy.stats import chi2

    assert [quantile(p, d) for p in (0.5, 0.999) for d in (1, 2, 3)] == pytest.approx(
        [chi2.ppf(p, d) for p in (0.5, 0.999) for d in (1, 2, 3)]
    )
