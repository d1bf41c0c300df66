"""Noisy ranges up to a common unknown, and their best point by SciPy."""

import numpy as np
from scipy.optimize import least_squares

from formulations.range_enclosure import Ranged


def drawn(rng, kind: str, count: int, d: int, sigma: float) -> tuple[Ranged, np.ndarray]:
    """Stations in a box of order one, an emitter inside or outside, and noisy ranges."""
    station = rng.uniform(-1.0, 1.0, (count, d)) * np.array([1.0, 1.0, 0.6])[:d]
    way = rng.normal(size=d)
    truth = rng.uniform(-1.0, 1.0, d) if rng.random() < 0.5 else way / np.linalg.norm(way) * rng.uniform(1.5, 4.0)
    r = np.linalg.norm(truth - station, axis=1)
    if "range" in kind:
        mixed = rng.normal(size=(count, count)) if kind == "correlated range" else np.zeros((count, count))
        covariance = sigma**2 * (np.eye(count) + 0.3 * mixed @ mixed.T)
        measured = r + np.linalg.cholesky(covariance) @ rng.normal(size=count)
        return Ranged(station, np.zeros(count), measured, covariance, free=False), truth
    sign = np.ones(count)
    sign[1 if kind == "sum" else 2 :: 1 if kind == "sum" else 2] = 1.0 if kind == "difference" else -1.0
    covariance = np.zeros((count, count))
    covariance[1:, 1:] = 0.5 * sigma**2 * (np.eye(count - 1) + 1.0)
    offset = r - sign * r[0]
    offset[1:] += np.linalg.cholesky(covariance[1:, 1:]) @ rng.normal(size=count - 1)
    offset[0] = 0.0
    return Ranged(station, sign, offset, covariance, free=True), truth


def whitened(ranged: Ranged, point: np.ndarray) -> np.ndarray:
    """Residuals written a second time."""
    r = np.linalg.norm(point - ranged.station, axis=1)
    if not ranged.free:
        return np.linalg.inv(np.linalg.cholesky(ranged.covariance)) @ (r - ranged.offset)
    error = r[1:] - ranged.sign[1:] * r[0] - ranged.offset[1:]
    return np.linalg.inv(np.linalg.cholesky(ranged.covariance[1:, 1:])) @ error


def minimum(ranged: Ranged, truth: np.ndarray, rng) -> tuple[np.ndarray, float]:
    """The best of several local solutions by SciPy."""
    starts = [truth, *(rng.uniform(-3.0, 3.0, (6, len(truth))))]
    found = [least_squares(lambda p: whitened(ranged, p), x, xtol=1e-15, ftol=1e-15, gtol=1e-15) for x in starts]
    best = min(found, key=lambda one: one.cost)
    return best.x, 2.0 * best.cost
