"""Small problems for tests of single checks, with costs and derivatives of their own."""

import numpy as np

from optloc import assemble, measured
from optloc.model_checks.elements import Elements

SQUARE = np.array([[0.0, 0.0], [1000.0, 0.0], [1000.0, 1000.0], [0.0, 1000.0], [400.0, -300.0]])
PLACE = np.array([300.0, 650.0])


def ranges_to(place, sigma, error=0.0, stations=SQUARE):
    """Return a flat batch of one problem of ranges, whose errors (s,) are known."""
    z = np.linalg.norm(np.asarray(place) - stations, axis=1) + error
    return assemble(stations, measured("range", z, a=np.arange(len(stations)), sigma=sigma)).flat()


def least_cost(residual, columns):
    """Return the cost of a whitened residual (m,) after a fit by columns (m, p)."""
    fitted = columns @ np.linalg.lstsq(columns, residual, rcond=None)[0]
    return float(((residual - fitted) ** 2).sum())


def means(errors, groups=None):
    """Return N problems of one unknown each, the mean of m rows (N, m) of unit variance; groups (m,) of the rows."""
    n, m = errors.shape
    group = np.zeros(m, dtype=int) if groups is None else np.asarray(groups)
    count = int(group.max()) + 1
    eye = np.broadcast_to(np.eye(m), (n, m, m))
    return Elements(
        tuple(f"group {g}" for g in range(count)),
        errors,
        np.ones((n, m, 1)),
        eye.copy(),
        np.broadcast_to((group[:, None] == np.arange(count)).astype(float), (n, m, count)).copy(),
        np.zeros((n, m, m)),
        np.ones((n, m)),
        np.broadcast_to(group, (n, m)).copy(),
        np.broadcast_to(np.arange(count), (n, count)).copy(),
        np.full((n, count), np.nan),
    )
