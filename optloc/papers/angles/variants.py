"""What the paper and its source print, kept for comparison: never use these to track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.track import Dynamics, current_statistical
from optloc.track.dynamics import correlated
from optloc.types import Array


def printed_transition(time_constant: float, limit: float) -> Dynamics:
    """Return the current statistical model with the printed f33 = 1 - exp(-alpha T) in the place of exp(-alpha T).

    Parameters
    ----------
    time_constant : float
        Seconds.
    limit : float
        Largest acceleration of an axis, m/s^2.
    """
    right = current_statistical(time_constant, limit)

    def step(dt: float, mean: Array, d: int) -> tuple[Array, Array, Array]:
        F, Q, drive = right.step(dt, mean, d)
        F = F.copy()
        F[2 * d :, 2 * d :] = (1.0 - np.exp(-dt / time_constant)) * np.eye(d)
        return F, Q, drive

    return replace(right, name="printed f33", step=step)


def printed_variance(time_constant: float, limit: float) -> Dynamics:
    """Return the current statistical model with the variance as published: (4 - pi)/pi (limit - abs(a))^2, no clamp.

    The variance vanishes where the acceleration comes near its limit, and grows without bound beyond it.

    Parameters
    ----------
    time_constant : float
        Seconds.
    limit : float
        Largest acceleration of an axis, m/s^2.
    """
    right = current_statistical(time_constant, limit)

    def step(dt: float, mean: Array, d: int) -> tuple[Array, Array, Array]:
        F, _, drive = right.step(dt, mean, d)
        _, Q, _ = correlated(1.0 / time_constant, dt)
        variance = (4.0 - np.pi) / np.pi * (limit - np.abs(mean[..., 2 * d :])) ** 2
        noise = np.einsum("ij,...c,cb->...icjb", Q, variance, np.eye(d))
        return F, noise.reshape(*mean.shape, mean.shape[-1]), drive

    return replace(right, name="no clamp", step=step)
