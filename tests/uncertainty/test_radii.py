"""Radii of data sheets: exact for circles, spheres and needles, and by draws for the rest."""

import numpy as np
import pytest
from scipy.stats import chi2, norm

from optloc.uncertainty import accuracy
from optloc.uncertainty.radii import probability, radius


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("level", [0.5, 0.95, 0.999])
def test_balls_are_chi_square(d, level):
    assert radius(4.0 * np.eye(d), level) == pytest.approx(2 * np.sqrt(chi2.ppf(level, d)), rel=1e-7)


@pytest.mark.parametrize("d", [2, 3])
def test_a_needle_is_one_normal_number(d):
    way = np.arange(1.0, d + 1) / np.linalg.norm(np.arange(1.0, d + 1))
    assert radius(9.0 * np.outer(way, way), 0.95) == pytest.approx(3 * norm.ppf(0.975), rel=1e-6)
    assert radius(np.zeros((d, d)), 0.5) == 0.0


def inside_a_circle(sigma, reach):
    """Return the probability of circles (n,): of the angle of the whitened point, the radius is integrated exactly."""
    turn = np.linspace(0.0, np.pi / 2.0, 20_001)
    square = (sigma[0] * np.cos(turn)) ** 2 + (sigma[1] * np.sin(turn)) ** 2
    outside = np.exp(-0.5 * np.square(reach)[:, None] / square)
    return 1.0 - np.trapezoid(outside, turn) / (np.pi / 2.0)


def inside_a_sphere(sigma, reach):
    """Return the probability of a sphere: each slice across the largest axis is a circle."""
    nodes, weights = np.polynomial.legendre.leggauss(200)
    turn = 0.25 * np.pi * (nodes + 1.0)
    z = reach * np.sin(turn)
    slices = 2.0 * norm.pdf(z / sigma[0]) / sigma[0] * inside_a_circle(sigma[1:], reach * np.cos(turn))
    return float((slices * reach * np.cos(turn) * 0.25 * np.pi) @ weights)


@pytest.mark.parametrize(
    "sigma", [(3.0, 2.0), (1.0, 1e-2), (1.0, 1e-5), (1.0, 0.9, 0.8), (1.0, 0.99, 0.05), (2.0, 0.1, 0.05)]
)
@pytest.mark.parametrize("level", [0.5, 0.95])
def test_radii_are_those_of_integrals(sigma, level):
    found = float(radius(np.diag(np.square(sigma)), level))
    share = inside_a_sphere(sigma, found) if len(sigma) == 3 else inside_a_circle(sigma, np.array([found]))[0]
    assert share == pytest.approx(level, abs=1e-9)


@pytest.mark.parametrize("sigma", [(1.0,), (3.0, 2.0), (1.0, 1e-4), (2.0, 1.0, 0.1)])
def test_slope_and_curvature_are_those_of_differences(sigma):
    variance, step = np.square(sigma), 1e-3
    for square in (0.1, 1.0, 10.0):
        low, at, high = (probability(variance, np.asarray(square * np.exp(k * step))) for k in (-1, 0, 1))
        assert at[1] == pytest.approx((high[0] - low[0]) / (2.0 * step), abs=1e-6)
        assert at[2] == pytest.approx((high[0] - 2.0 * at[0] + low[0]) / step**2, abs=1e-6)


@pytest.mark.parametrize("level", [1e-6, 1e-3, 1.0 - 1e-6])
def test_small_and_large_shares(level):
    assert radius(np.eye(3), level) == pytest.approx(np.sqrt(chi2.ppf(level, 3)), rel=1e-8)


def test_any_ellipsoid_against_draws():
    rng, n = np.random.default_rng(1), 400_000
    covariances = np.stack([np.diag([1.0, 0.3, 0.1]), np.diag([5.0, 4.9, 0.01]), np.diag([1.0, 1e-3, 1e-5])])
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    covariances = turn @ covariances @ turn.T
    found = accuracy(covariances)
    for i, covariance in enumerate(covariances):
        x = rng.standard_normal((n, 3)) @ np.linalg.cholesky(covariance).T
        flat, whole, high = np.hypot(x[:, 0], x[:, 1]), np.linalg.norm(x, axis=1), np.abs(x[:, 2])
        for size, values, level in (
            (found.cep50, flat, 0.5),
            (found.cep95, flat, 0.95),
            (found.sep50, whole, 0.5),
            (found.sep95, whole, 0.95),
            (found.vertical95, high, 0.95),
        ):
            assert (values < size[i]).mean() == pytest.approx(level, abs=5 * np.sqrt(level * (1 - level) / n))


def test_the_plane_and_what_is_not_known():
    found = accuracy(np.stack([np.eye(2), np.full((2, 2), np.nan)]))
    assert found.cep50 == pytest.approx([np.sqrt(2 * np.log(2)), np.nan], nan_ok=True)
    assert np.isnan(found.sep50).all()
    assert np.isnan(found.vertical95).all()
