"""Error ellipses and ellipsoids of covariances."""

from __future__ import annotations

import numpy as np

from optloc.types import Array


def error_ellipse(covariance: Array, probability: float = 0.95) -> tuple[Array, Array]:
    """Return the ellipse or ellipsoid that holds a Gaussian with a given probability.

    Parameters
    ----------
    covariance : array (..., d, d)
        Square metres; NaN where there is none.
    probability : float
        Between 0 and 1.

    Returns
    -------
    semi_axes : array (..., d)
        Lengths in metres, ascending; NaN where there is no covariance.
    directions : array (..., d, d)
        Unit vectors of the axes in columns.
    """
    from scipy.special import gammaincinv

    known = np.asarray(np.isfinite(covariance).all((-1, -2)))
    values, vectors = np.linalg.eigh(np.where(known[..., None, None], covariance, 0.0))
    scale = np.sqrt(2.0 * gammaincinv(covariance.shape[-1] / 2, probability))
    axes = scale * np.sqrt(np.maximum(values, 0.0))
    return np.where(known[..., None], axes, np.nan), np.where(known[..., None, None], vectors, np.nan)
