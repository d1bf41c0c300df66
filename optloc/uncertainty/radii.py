"""Radii that contain a share of a Gaussian: circular and spherical errors, exact for any ellipse or ellipsoid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from optloc.base.types import Array

# Nodes of the contour, half of which are conjugates. 24 nodes give 7e-14 of the probability in one to three dimensions,
# 20 give 1e-11, and 32 give 1e-12 because terms cancel.
_NODES = 24
# Most steps of the search for a radius: two are usual, because the start is within some percent. The search ends at
# this relative step of the squared radius, and the remaining error is the cube of the step.
_STEPS, _CLOSE = 60, 1e-3
# Bounds of the logarithm of a step, and of its correction by the curvature: far out the probability is flat.
_LEAP, _BEND = 2.0, 0.5
# Least start relative to the mean square: the approximation is negative for small levels.
_LEAST = 1e-3


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Radii around the mean of Gaussians, metres, as in data sheets.

    Parameters
    ----------
    cep50, cep95 : array (...)
        Radii of circles in the plane of the first two coordinates that contain 50 % and 95 %: circular error probable.
    sep50, sep95 : array (...)
        Radii of spheres that contain 50 % and 95 %: spherical error probable; NaN in the plane.
    vertical95 : array (...)
        Half the height of the layer around the third coordinate that contains 95 %; NaN in the plane.
    """

    cep50: Array
    cep95: Array
    sep50: Array
    sep95: Array
    vertical95: Array


def accuracy(covariance: Array) -> Accuracy:
    """Return the radii of data sheets for covariances (..., d, d) in level axes, the third one upwards.

    The 50 % circle is a median: half of the errors are larger.
    """
    covariance = np.asarray(covariance, dtype=float)[..., None, None, :, :]
    if covariance.shape[-1] == 2:
        cep = radius(covariance[..., 0, :, :, :], (0.5, 0.95))
        none = np.full(cep.shape[:-1], np.nan)
        return Accuracy(cep[..., 0], cep[..., 1], none, none, none)
    # A circle is a ball of a Gaussian whose third coordinate is zero, so one search finds all radii.
    found = radius(covariance * _PARTS, (0.5, 0.95))
    return Accuracy(*(found[..., part, level] for part, level in ((0, 0), (0, 1), (1, 0), (1, 1), (2, 1))))


# Masks of a covariance in space: its level coordinates, all coordinates, and its height.
_PARTS = np.array([np.outer(kept, kept) for kept in ((1.0, 1.0, 0.0), (1.0, 1.0, 1.0), (0.0, 0.0, 1.0))])[:, None]


def radius(covariance: Array, level: ArrayLike) -> Array:
    """Return radii (...) of balls around the mean that contain a share of Gaussians with covariances (..., d, d).

    Parameters
    ----------
    covariance : array (..., d, d)
        Any number of dimensions; NaN for a missing covariance gives NaN.
    level : float or array (...)
        Probability inside, above 0 and below 1; it broadcasts against the covariances.

    Notes
    -----
    The radius is the root of a quantile of a sum of squares of independent normal numbers with different variances (a
    generalised chi-square). Halley's rule finds the logarithm of the squared radius.
    """
    known = np.asarray(np.isfinite(covariance).all((-1, -2)))
    values = np.maximum(np.linalg.eigvalsh(np.where(known[..., None, None], covariance, 0.0)), 0.0)
    mean = values.sum(-1)
    variance = values / np.where(mean > 0.0, mean, 1.0)[..., None]
    variance[..., -1] += mean == 0.0  # a point has the radius zero with any shape
    square = _first_guess(variance, np.asarray(level))
    for _ in range(_STEPS):
        inside, slope, curvature = probability(variance, square)
        step = np.maximum(np.minimum((level - inside) / np.maximum(slope, 1e-300), _LEAP), -_LEAP)
        step /= 1.0 + np.maximum(np.minimum(0.5 * step * curvature / slope, _BEND), -_BEND)
        square = square * np.exp(step)
        if np.abs(step).max(initial=0.0) <= _CLOSE:
            break
    return np.where(known, np.sqrt(mean * square), np.nan)


def _first_guess(variance: Array, level: Array) -> Array:
    """Return approximate squared radii (...) from the moments of the sum of squares, for variances (..., d) with sum 1.

    `level` is the probability inside the radius.

    Notes
    -----
    F. E. Satterthwaite (1946) replaces the sum by a chi-square of the same variance, and E. B. Wilson, M. M. Hilferty
    (1931) replace a chi-square by the cube of a normal number.
    """
    from scipy.special import ndtri

    spread = 2.0 / 9.0 * (variance * variance).sum(-1)
    root = np.maximum(1.0 - spread + ndtri(level) * np.sqrt(spread), _LEAST ** (1.0 / 3.0))
    return np.asarray(root * root * root)


def probability(variance: Array, square: Array) -> tuple[Array, Array, Array]:
    """Return the probability (...) that independent normal numbers are in a ball, its slope and its curvature.

    Slope and curvature, also (...), are the first and second derivative to the logarithm of the squared radius.

    Parameters
    ----------
    variance : array (..., d)
        Variances of the numbers.
    square : array (...)
        Squared radius of the ball, positive.

    Notes
    -----
    The Laplace transform of the density of the sum of squares is ``prod_i (1 + 2 variance_i p)^(-1/2)``. Its
    singularities are negative for every shape, so a few nodes on Talbot's contour around them invert it: L. N.
    Trefethen, J. A. C. Weideman, T. Schmelzer, "Talbot quadratures and rational approximations", BIT 46 (2006).
    """
    nodes, weights = _contour()
    factors = 1.0 + (2.0 * variance / square[..., None])[..., None] * nodes
    # Roots of the single factors: the angle of their product may exceed half a turn.
    found = ((1.0 / np.sqrt(factors).prod(-2)) @ weights).real
    return found[..., 0], found[..., 1], found[..., 2]


@cache
def _contour() -> tuple[Array, Array]:
    """Return nodes (n,) of the upper half of Talbot's contour, and weights (n, 3) for the results of `probability`.

    All are complex numbers.
    """
    # The constants are from the article: they balance the errors of truncation and of the step.
    turn = np.pi * np.arange(1, _NODES, 2) / _NODES
    cot, sine = 1.0 / np.tan(0.6407 * turn), np.sin(0.6407 * turn)
    nodes = _NODES * (0.5017 * turn * cot - 0.6122 + 0.2645j * turn)
    along = 0.5017 * cot - 0.5017 * 0.6407 * turn / sine**2 + 0.2645j
    slope = -2.0j * np.exp(nodes) * along
    # An integral is the transform over p, a derivative is p times the transform.
    return nodes, np.stack([slope / nodes, slope, slope * (1.0 + nodes)], axis=-1)
