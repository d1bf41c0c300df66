"""Small cases for tests of single modules of the advice."""

import numpy as np

from optloc import Motion, assemble, measured, station_array
from optloc.advice.cases import case_of

PLACES = np.array([[0.0, 0.0], [9e3, 1e3], [8e3, 9e3], [1e3, 8e3], [5e3, 12e3], [-3e3, 4e3], [-4e3, 10e3]])
TRUTHS = np.array([[4e3, 3e3], [2e3, 6e3], [6e3, 5e3], [3e3, 9e3]])
NAMES = tuple(f"S{i}" for i in range(7))


def range_case(error=0.0, epochs=1, sigma=3.0, seed=1, kind="range"):
    """Return the case of ranges with noise and an error (k, 7), and its problem."""
    right = np.linalg.norm(TRUTHS[:epochs, None] - PLACES, axis=-1)
    z = right + sigma * np.random.default_rng(seed).normal(size=right.shape) + error
    rows = measured(
        kind, z.ravel(), a=np.tile(np.arange(7), epochs), epoch=np.repeat(np.arange(epochs), 7), sigma=sigma
    )
    motion = Motion(span="epoch" if epochs > 1 else "run")
    problem = assemble(station_array(PLACES, NAMES), rows, times=10.0 * np.arange(epochs), motions=(motion,))
    case = case_of(problem.flat(), np.full((1, problem.layout.size), np.nan))
    return case, problem


def at(i, amount):
    """Return an error (7,) of one station."""
    return amount * (np.arange(7) == i)
