"""The scene of the paper, as printed: receiver at the origin, illuminator on the x axis, a target 81 km away."""

from __future__ import annotations

import numpy as np

from optloc.build import assemble, measured
from optloc.evaluate import predict
from optloc.problem import Problem
from optloc.simulate import simulate
from optloc.types import Array, Motion
from optloc.units import SPEED_OF_LIGHT

BASELINE = 150e3
"""Distance of the illuminator, metres."""

RANGE, AZIMUTH, ELEVATION = 81.2e3, 1.446, 0.123
"""Place of the target at t = 0: metres and radians."""

COURSE = np.array([4.0, 10.0, 6.0])
"""Velocity of the slow target, metres per second; signs as printed, so that its range grows by 11 m/s."""

PATH = 20e-9 * SPEED_OF_LIGHT
"""Standard deviation of the excess path, metres: 20 ns."""

ANGLE = float(np.radians(1.0))
"""Standard deviation of both angles, radians."""

EPOCHS = 200
"""Epochs, one a second."""


def place(distance: float = RANGE, azimuth: float = AZIMUTH, elevation: float = ELEVATION) -> Array:
    """Return a position (3,) in metres."""
    ahead = (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
    return distance * np.array(ahead)


def problem(epochs: int, *, order: int = 0, path: float = PATH, reference: float | None = None) -> Problem:
    """Return the estimation problem of the first epochs, without measurements.

    Parameters
    ----------
    epochs : int
        Number of epochs.
    order : 0 or 1
        A target that stays, or one that moves uniformly.
    path : float
        Standard deviation of the excess path, metres.
    reference : float, optional
        Second at which the state holds; 0 by default.
    """
    epoch = np.arange(epochs)
    return assemble(
        np.array([[0.0, 0.0, 0.0], [BASELINE, 0.0, 0.0]]),
        measured("range_sum", a=0, b=1, epoch=epoch, sigma=path),
        measured("azimuth", a=0, epoch=epoch, sigma=ANGLE),
        measured("elevation", a=0, epoch=epoch, sigma=ANGLE),
        motions=[Motion(order, reference=reference)],
    )


def draw(
    epochs: int, trials: int, sequence: np.random.SeedSequence, *, slow: bool = False, path: float = PATH
) -> Problem:
    """Return measured runs (trials,) of the target that stays, or of the slow one."""
    start = np.concatenate([place(), COURSE]) if slow else place()
    return simulate(problem(epochs, order=int(slow), path=path), start, sequence, trials)


def truth(epochs: int, *, slow: bool = False) -> Array:
    """Return the true positions (epochs, 3), metres."""
    return place() + np.arange(epochs)[:, None] * (COURSE if slow else 0.0)


_ONE = problem(1)


def polar(position: Array) -> Array:
    """Return range, azimuth and elevation (..., 3) of positions (..., 3)."""
    angles = predict(_ONE, position)[..., 1:]
    return np.concatenate([np.linalg.norm(position, axis=-1)[..., None], angles], axis=-1)
