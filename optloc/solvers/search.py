"""The last resort: a seeded search from many places, for mixtures that no closed form starts."""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array
from optloc.linear.constraints import exact
from optloc.problem.problem import Problem
from optloc.solvers.refine import refine
from optloc.solvers.starts.position import vectors

PLACES = 96
_KEPT = 12
_SEED = 20261121


def searched_starts(problem: Problem) -> Array:
    """Return the best starting positions (N, q, d) of a flat batch among places around the stations.

    Directions are uniform, distances log-uniform from a tenth of the stations' spread to a hundred times it; every
    place is refined for a few steps and the cheapest are kept. The same problem always gets the same places.

    Parameters
    ----------
    problem : Problem
        N problems with one target.
    """
    size, d = problem.batch_shape[0], problem.dimension
    stations = problem.stations.position.reshape(*problem.stations.position.shape[:-3], -1, d)
    centre = np.broadcast_to(stations.mean(-2), (size, d))
    spread = np.linalg.norm(stations - stations.mean(-2, keepdims=True), axis=-1).max(-1)
    spread = np.broadcast_to(np.where(spread > 0.0, spread, 1.0), (size,))
    places = centre[:, None] + spread[:, None, None] * _directions(d)
    x = vectors(problem, places)
    item = np.repeat(np.arange(size), PLACES)
    done = refine(problem, x.reshape(-1, x.shape[-1]), item=item, limit=8, face=exact(problem))
    cost = np.where(np.isfinite(done.cost), done.cost, np.inf).reshape(size, PLACES)
    order = np.argsort(cost, axis=1, kind="stable")[:, :_KEPT]
    slot, _ = problem.layout.find("position")
    refined = done.x.reshape(size, PLACES, -1)[..., slot.start : slot.start + d]
    return np.take_along_axis(refined, order[..., None], axis=1)


def _directions(d: int) -> Array:
    rng = np.random.default_rng(_SEED)
    direction = rng.standard_normal((PLACES, d))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * 10.0 ** rng.uniform(-1.0, 2.0, (PLACES, 1))
