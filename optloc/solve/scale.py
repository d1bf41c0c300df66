"""The size of a problem: numbers of order one are what solvers need."""

from __future__ import annotations

import numpy as np

from optloc.problem import Problem
from optloc.types import Array


def length_scale(problem: Problem) -> tuple[Array, float]:
    """Return the centre (d,) of all stations of a single problem and their greatest distance from it, metres."""
    position = problem.stations.position.reshape(-1, problem.dimension)
    centre = position.mean(0)
    spread = float(np.linalg.norm(position - centre, axis=-1).max())
    return centre, spread if spread > 0.0 else 1.0
