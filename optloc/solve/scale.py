"""The size of a problem: numbers of order one are what solvers need."""

from __future__ import annotations

import numpy as np

from optloc.problem import Problem
from optloc.types import Array


def spread_of(problem: Problem) -> tuple[Array, Array]:
    """Return the centre of the stations (N or 1, d) and their greatest distance from it (N or 1,), metres."""
    stations = problem.stations.position.reshape(*problem.stations.position.shape[:-3], -1, problem.dimension)
    stations = stations if stations.ndim == 3 else stations[None]
    centre = stations.mean(-2)
    spread = np.linalg.norm(stations - centre[:, None], axis=-1).max(-1)
    return centre, np.where(spread > 0.0, spread, 1.0)


def distance_of(problem: Problem, position: Array) -> Array:
    """Return how far positions (N, ..., d) are from the stations, in units of their spread."""
    centre, spread = spread_of(problem)
    extra = (1,) * (position.ndim - 2)
    with np.errstate(over="ignore", invalid="ignore"):
        away = position - centre.reshape(-1, *extra, centre.shape[-1])
        return np.asarray(np.sqrt((away**2).sum(-1)) / spread.reshape(-1, *extra))
