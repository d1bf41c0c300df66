"""Points from which samples are drawn: a Student distribution, spread evenly."""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array

# Student's degrees of freedom: tails heavier than those of a Gaussian keep the weights of what lies there small.
_DEGREES = 5.0


def student(d: int, n: int, seed: int) -> tuple[Array, Array, Array]:
    """Return evenly spread points of a Student distribution and one more number each.

    Parameters
    ----------
    d, n : int
        Dimensions and number of points.
    seed : int
        Decides the draw.

    Returns
    -------
    spare : array (n,)
        Numbers between 0 and 1, spread evenly together with the points.
    points : array (n, d)
        Of scale one.
    log_density : array (n,)
        Logarithm of the density there but for a constant.
    """
    from scipy.special import gammaincinv, ndtri
    from scipy.stats import qmc

    # Of any number, not only powers of two: the balance that is lost then is nothing beside the weights.
    spaced = qmc.Sobol(d + 2, rng=np.random.default_rng(seed)).random_base2(int(np.ceil(np.log2(max(n, 2)))))[:n]
    spaced = np.clip(spaced, np.finfo(float).eps, 1.0 - np.finfo(float).eps)
    stretch = np.sqrt(_DEGREES / (2.0 * gammaincinv(0.5 * _DEGREES, spaced[:, 1])))
    points = ndtri(spaced[:, 2:]) * stretch[:, None]
    return spaced[:, 0], points, -0.5 * (_DEGREES + d) * np.log1p((points**2).sum(-1) / _DEGREES)
