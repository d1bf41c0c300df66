"""Independent answers to many small problems at once: damped Gauss-Newton in plain numpy, and how it judges a fix.

Nothing of optloc computes here. Residuals are functions of free coordinates (N, n), where nuisances are already taken
out: an emission time or a system offset by centring, an exact height by turning latitude and longitude into ECEF.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from data.windows import quantiles, report, statuses
from verdicts import alone

from optloc import Fix

Residual = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Reference:
    """Positions (N, d) and costs (N,) of the minima that the truth leads to."""

    position: np.ndarray
    cost: np.ndarray


def descend(residual: Residual, start: np.ndarray, step: float, limit: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Return minima (N, n) and costs (N,) of the sums of squares reached from `start` by steps that lower the cost.

    Jacobians are central differences over `step`.
    """
    x, damping = np.array(start), np.full(len(start), 1e-6)
    r = residual(x)
    cost = (r**2).sum(-1)
    size, done = x.shape[-1], np.zeros(len(x), dtype=bool)
    for _ in range(limit):
        columns = [(residual(x + h) - residual(x - h)) / (2.0 * step) for h in step * np.eye(size)]
        J = np.stack(columns, axis=-1)
        normal, gradient = np.swapaxes(J, -1, -2) @ J, (np.swapaxes(J, -1, -2) @ r[..., None])
        scale = np.einsum("kii->ki", normal) + 1e-300
        damped = normal + damping[:, None, None] * scale[:, None, :] * np.eye(size)
        move = -(np.linalg.pinv(damped) @ gradient)[..., 0]
        further = residual(x + move)
        reached = (further**2).sum(-1)
        better = reached < cost
        x[better], r[better] = (x + move)[better], further[better]
        done |= (better & (cost - reached <= 1e-12 * (1.0 + cost)) & (damping < 1e-3)) | (damping > 1e10)
        cost = np.where(better, reached, cost)
        damping = np.where(better, np.maximum(0.1 * damping, 1e-12), np.minimum(10.0 * damping, 1e15))
        if done.all():
            break
    return x, cost


def centred(residual: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return residuals (N, m) less the mean of those present: an unknown common to equally good rows is eliminated."""
    mean = (residual * weight).sum(-1, keepdims=True) / np.maximum(weight.sum(-1, keepdims=True), 1.0)
    return (residual - mean) * weight


def ecef(coordinates: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return ECEF positions (N, 3) of latitudes and longitudes (N, 2), radians, at heights (N,) above WGS 84."""
    a, e2 = 6378137.0, 6.69437999014e-3
    lat, lon = coordinates[..., 0], coordinates[..., 1]
    across = a / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    plan = (across + height) * np.cos(lat)
    up = (across * (1.0 - e2) + height) * np.sin(lat)
    return np.stack([plan * np.cos(lon), plan * np.sin(lon), up], axis=-1)


def horizontal(position: np.ndarray, truth: np.ndarray, lat: np.ndarray, lon: np.ndarray) -> np.ndarray:
    """Return the horizontal error (...) of ECEF positions at the true latitudes and longitudes, radians."""
    normal = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    error = position - truth
    return np.linalg.norm(error - (error * normal).sum(-1, keepdims=True) * normal, axis=-1)


def listed(fix: Fix, error: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return the least error (N,) of a fix and its alternatives; `error` maps positions (q, N, d) to (q, N)."""
    slot, _ = fix.layout.find("position")
    others = np.moveaxis(fix.alternatives.x[..., slot.start : slot.start + slot.size], 1, 0)
    return np.nanmin(error(np.concatenate([fix.position[None], others])), axis=0, initial=np.inf)


def law(
    name: str, fix: Fix, ours: np.ndarray, theirs: np.ndarray, reference: Reference, *, answered: float = 0.99
) -> tuple[float, float]:
    """Assert what must hold for fixes made without a guess; print and return median and 95 % of `ours`.

    `ours` and `theirs` are errors (N,) of the fixes and of the reference.
    """
    good = fix.answered
    mine, other = quantiles(ours[good]), quantiles(theirs[good])
    seconds = sum(stage.seconds for stage in fix.stages)
    report(
        f"{name}: {len(fix)} fixes ({statuses(fix)}), error median {mine[0]:.3f} m, 95 % {mine[1]:.3f} m; started at "
        f"the truth {other[0]:.3f} / {other[1]:.3f} m; {1e3 * seconds / len(fix):.2f} ms a fix"
    )
    assert good.mean() >= answered, f"{name}: {statuses(fix)}"
    assert mine[0] <= 1.05 * other[0], name
    assert mine[1] <= 1.05 * other[1], name
    never_a_worse_minimum(name, fix, reference)
    return mine


def never_a_worse_minimum(name: str, fix: Fix, reference: Reference) -> None:
    """Assert that no answer costs more than the minimum that the truth leads to."""
    excess = fix.cost - reference.cost * (1.0 + 1e-6)
    worse = np.flatnonzero(fix.answered & (excess > 1e-6))
    silent = worse[alone(fix)[worse]]
    assert not len(worse), f"{name}: the truth leads to a better minimum in {worse}, {len(silent)} of them silent"
