"""Radii that hold a share of a Gaussian: circular and spherical errors, exact for any ellipse or ellipsoid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from optloc.base.types import Array

# Nodes of Gauss and Legendre over half a circle, and normal numbers that count as outside beyond: 1e-9 of the
# probability.
_NODES, _FAR = 64, 9.0
# Share of the largest axis that the others have at least: a needle is one normal number.
_THIN = 1e-9
# Steps of the search for a radius: eight are usual. It ends with this relative step, or this error of a probability.
_STEPS = 60
_CLOSE, _EXACT = 1e-10, 1e-13


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Radii around the mean of Gaussians, metres, as data sheets give them.

    Parameters
    ----------
    cep50, cep95 : array (...)
        Circles in the plane of the first two coordinates that hold a half and 95 %: circular errors probable.
    sep50, sep95 : array (...)
        Spheres that hold as much; NaN in the plane.
    vertical95 : array (...)
        Half the height of the layer around the third coordinate that holds 95 %; NaN in the plane.
    """

    cep50: Array
    cep95: Array
    sep50: Array
    sep95: Array
    vertical95: Array


def accuracy(covariance: Array) -> Accuracy:
    """Return the radii that data sheets give of covariances (..., d, d) in level axes, the third one upwards.

    A circle of a half is a median: a fix is off by more as often as by less.
    """
    covariance = np.asarray(covariance, dtype=float)
    level, none = covariance[..., :2, :2], np.full(covariance.shape[:-2], np.nan)
    if covariance.shape[-1] == 2:
        return Accuracy(radius(level, 0.5), radius(level, 0.95), none, none, none)
    return Accuracy(
        radius(level, 0.5),
        radius(level, 0.95),
        radius(covariance, 0.5),
        radius(covariance, 0.95),
        radius(covariance[..., 2:, 2:], 0.95),
    )


def radius(covariance: Array, level: float) -> Array:
    """Return radii (...) of balls around the mean that hold a share of Gaussians of covariances (..., d, d).

    Parameters
    ----------
    covariance : array (..., d, d)
        One to three dimensions; NaN where there is none.
    level : float
        Probability inside, above 0 and below 1.

    Notes
    -----
    The quantile of a sum of squares of independent normal numbers of different variances (a generalised chi-square),
    by quadrature of the probability and a search.
    """
    from scipy.special import gammaincinv

    known = np.asarray(np.isfinite(covariance).all((-1, -2)))
    values = np.linalg.eigvalsh(np.where(known[..., None, None], covariance, 0.0))
    sigma = np.sqrt(np.maximum(values, 0.0))
    largest = sigma[..., -1:]
    shape = np.maximum(sigma / np.where(largest > 0.0, largest, 1.0), _THIN)
    shape[..., -1] = 1.0
    d = shape.shape[-1]
    # Between a needle and a ball: one normal number, and d of the same variance.
    low = np.full(shape.shape[:-1], np.sqrt(2.0 * gammaincinv(0.5, level)))
    high = np.full(shape.shape[:-1], np.sqrt(2.0 * gammaincinv(0.5 * d, level)))
    found = low if d == 1 else _between(shape, level, low, high)
    return np.where(known, found * largest[..., 0], np.nan)


def _between(sigma: Array, level: float, first: Array, last: Array) -> Array:
    """Return radii (...) between two at which the probability is a level, by the secant rule of the Illinois method.

    Notes
    -----
    M. Dowell, P. Jarratt, "A modified regula falsi method", BIT 11 (1971): a bound that stays twice counts half.
    """
    below, above = probability(sigma, first) - level, probability(sigma, last) - level
    for _ in range(_STEPS):
        rise = above - below
        at = last - above * (last - first) / np.where(rise != 0.0, rise, 1.0)
        value = probability(sigma, at) - level
        stays = value * above > 0.0
        first, below = np.where(stays, first, last), np.where(stays, 0.5 * below, above)
        moved, last, above = np.abs(at - last), at, value
        if ((moved <= _CLOSE * at) | (np.abs(value) <= _EXACT)).all():
            break
    return last


def probability(sigma: Array, reach: Array) -> Array:
    """Return the probability (...) that independent normal numbers of sigmas (..., d), ascending, lie in a ball.

    With the largest first, ``z = (R / sigma) sin t``, the others are inside the ball that is left. The substitution
    takes the roots off the ends.

    Parameters
    ----------
    sigma : array (..., d)
        Standard deviations, ascending, the last one positive.
    reach : array (...)
        Radius R of the ball.
    """
    from scipy.special import erf

    if sigma.shape[-1] == 1:
        return np.asarray(erf(reach / (np.sqrt(2.0) * sigma[..., 0])))
    nodes, weights = _quadrature()
    turn = 0.5 * np.pi * nodes
    most = np.minimum(reach / sigma[..., -1], _FAR)[..., None]
    z = most * np.sin(turn)
    density = np.exp(-0.5 * z**2) * most * np.cos(turn) / np.sqrt(2.0 * np.pi)
    left = np.sqrt(np.maximum(reach[..., None] ** 2 - (sigma[..., -1:] * z) ** 2, 0.0))
    rest = probability(sigma[..., None, :-1], left)
    return np.asarray(0.5 * np.pi * (density * rest * weights).sum(-1))


@cache
def _quadrature() -> tuple[Array, Array]:
    """Return nodes and weights of Gauss and Legendre: an eigenvalue problem, solved once."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    return np.asarray(nodes), np.asarray(weights)
