"""Runs of a free target inside a ring of stations."""

import numpy as np

from optloc import Motion, assemble, measured

FREE = (Motion(span="epoch"),)
RING = 1e3 * np.array([[3, 0], [2, 2], [0, 3], [-2, 2.5], [-3, 0], [-2, -2], [0, -3.5], [2.5, -2]])
SIGMA = np.array([5.0, 10.0, 10.0, 20.0, 10.0, 40.0, 10.0, 20.0])


def ranged(rng, epochs, sigma=SIGMA, *, kind="toa", stated=10.0, gross=0.0):
    """Return a run of a free target inside a ring of stations, each with its own noise."""
    s = len(sigma)
    target = rng.uniform(-1500.0, 1500.0, (epochs, 2))
    error = sigma * rng.standard_normal((epochs, s))
    error += np.where(rng.random((epochs, s)) < gross, rng.uniform(300.0, 3000.0, (epochs, s)), 0.0)
    z = np.linalg.norm(target[:, None] - RING[:s], axis=-1) + error
    z = z + (rng.uniform(0.0, 500.0, (epochs, 1)) if kind == "toa" else 0.0)
    a, epoch = np.tile(np.arange(s), epochs), np.repeat(np.arange(epochs), s)
    return assemble(RING[:s], measured(kind, z.ravel(), a=a, sigma=stated, epoch=epoch), motions=FREE)
