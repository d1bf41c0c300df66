"""A small run in the plane: ranges from three stations to a target at rest or in uniform motion."""

import numpy as np

from optloc import Motion, assemble, measured

STATIONS, SIGMA, EPOCHS = np.array([[0.0, 0.0], [4e3, 500.0], [1e3, 3e3]]), 5.0, 5
TIMES = 10.0 * np.arange(EPOCHS)
STATE = np.array([1.5e3, 1.0e3, 20.0, -10.0])
A, EPOCH = np.tile(np.arange(3), EPOCHS), np.repeat(np.arange(EPOCHS), 3)
ERROR = SIGMA * np.random.default_rng(0).standard_normal(len(A))


def residual(state):
    """Return whitened residuals at positions and velocities (..., 4), the state at time zero."""
    state = np.asarray(state, dtype=float)
    return (z_of(state) - z_of(STATE) - ERROR) / SIGMA


def z_of(state):
    place = state[..., None, :2] + TIMES[EPOCH, None] * state[..., None, 2:]
    return np.linalg.norm(place - STATIONS[A], axis=-1)


def course():
    """Return a flat batch of one problem of a target that moves."""
    rows = measured("range", z_of(STATE) + ERROR, a=A, sigma=SIGMA, epoch=EPOCH)
    return assemble(STATIONS, rows, times=TIMES, motions=(Motion(1),)).flat()


def at_rest():
    """Return the same of one that stays."""
    z = np.linalg.norm(STATE[:2] - STATIONS[A], axis=-1) + ERROR
    return assemble(STATIONS, measured("range", z, a=A, sigma=SIGMA, epoch=EPOCH), times=TIMES).flat()


def residual_at_rest(place):
    """Return whitened residuals at positions (..., 2)."""
    line = np.asarray(place)[..., None, :] - STATIONS[A]
    return (np.linalg.norm(line, axis=-1) - np.linalg.norm(STATE[:2] - STATIONS[A], axis=-1) - ERROR) / SIGMA
