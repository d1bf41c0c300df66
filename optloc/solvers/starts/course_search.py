"""Starts of a target on a course: a seeded search from many trial courses around the stations.

Other starts fit a polynomial to the fixes of single epochs, or start from targets at rest around the stations. Both
miss the course if epochs have two positions that fit and the target moves far. Trial courses pass through random
places, so their speeds fit the size of the geometry and the duration of the run.

Letters: N problems, q courses of each, d coordinates, n shared unknowns, `size` numbers of a parameter vector.
"""

from __future__ import annotations

from math import factorial

import numpy as np

from optloc.base.types import Array
from optloc.kernels.least_squares import refine
from optloc.linear.constraints import exact
from optloc.linear.courses import elapsed
from optloc.linear.mirror import one_position
from optloc.linear.vectors import complete, vectors
from optloc.problem.epochs import some_epochs, without_epoch_correlation
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem
from optloc.solvers.policy import LISTED_GAP
from optloc.solvers.pool import chunk_size
from optloc.solvers.starts.position import spread_of

TRIALS = 192
"""Trial courses of a search: with 48 to 384 of them a search lost at most 1 of 139 random courses."""
# Steps that rank the trial courses, and the cheapest of them, which are refined with the greatest number of steps.
_FEW, _CHEAPEST, _STEPS = 8, 32, 60
# Different minima that are kept: the stage after the search refines each of them on all rows.
_MOST = 8
# Rows of a long run that the search uses, so that it takes as long as for a short run.
_ROWS = 200
_SEED = 20261130  # arbitrary: the same problem always gets the same trial courses
# Movements of the trial courses, as shares of their distance from the stations. Some are zero, since a slow target
# needs a start at rest: its velocity is then an almost linear unknown.
_MOVES = (0.0, 0.3, 1.0, 2.0)
# Two refinements end at one minimum if their costs differ by this share, and their positions by this share of the
# spread of the stations.
_SAME_COST, _SAME_PLACE = 1e-4, 1e-2


def has_course(problem: Problem) -> bool:
    """Return whether the only target is unknown and has one state for a whole run, and not only a position."""
    motion = problem.motions[0]
    return len(problem.motions) == 1 and motion.known is None and motion.span == "run" and not one_position(problem)


def course_search(problem: Problem, known: Array | None = None) -> Array:
    """Return the cheapest minima (N, q, size) that refinements of trial courses reach; NaN after the last.

    A long run is searched in some of its epochs only, so its minima are approximate. Minima are then left out if they
    are the known minimum, or if they cost much more in these epochs.

    Parameters
    ----------
    problem : Problem
        N problems for which `has_course` is true.
    known : array (N, size), optional
        Known minima; NaN without one.
    """
    few = _some_epochs(problem.straightened())
    known = np.full((problem.batch_shape[0], problem.layout.size), np.nan) if known is None else known
    # in parts, so that the memory stays small, as for a pool with dozens of candidates
    count, part = len(known), max(1, chunk_size(few) * _CHEAPEST // TRIALS)
    out = np.full((count, _MOST, few.layout.n_shared), np.nan)
    for first in range(0, count, part):
        items = np.arange(first, min(first + part, count))
        out[items] = _search(few.take(items), known[items], few.epochs < problem.epochs)
    return complete(problem, out)


def _search(problem: Problem, known: Array, thinned: bool) -> Array:
    """Return the shared unknowns (N, q, n) of the cheapest minima; NaN after the last.

    `known` (N, size) are the minima of the whole run, and `thinned` is true if the problem has a part of it.
    """
    x, _ = _cheapest(problem, _trials(problem), _FEW, _CHEAPEST)
    x, cost = _cheapest(problem, x, _STEPS, _CHEAPEST)
    size, n = len(x), problem.layout.n_shared
    if thinned:
        there, least = _cheapest(problem, complete(problem, known[:, None, :n]), _STEPS, 1)
        # the known minimum comes first, so that the search keeps no minimum at the same place
        x, cost = np.concatenate([there, x], axis=1), np.concatenate([least, cost], axis=1)
        cost = np.where(cost <= least + LISTED_GAP, cost, np.inf)
    out, spread = np.full((size, _MOST, n), np.nan), np.broadcast_to(spread_of(problem)[1], size)
    place = problem.layout.take(x, "position")
    for i in range(size):
        kept = [k for k in _different(cost[i], place[i] / spread[i]) if k >= int(thinned)][:_MOST]
        out[i, : len(kept)] = x[i, kept, :n]
    return out


def _some_epochs(problem: Problem) -> Problem:
    """Return some epochs of a long run as a run; a short run is returned unchanged."""
    # epochs enough for a course that accelerates, also if an epoch has very many rows
    kept = max(_ROWS * problem.epochs // max(problem.count, 1), 8)
    if kept >= problem.epochs:
        return problem
    # the choice is random, since epochs may alternate between stations
    epochs = np.random.default_rng(_SEED).permutation(problem.epochs)[:kept]
    few = some_epochs(without_epoch_correlation(problem), np.sort(epochs))
    # unknowns of single epochs that all epochs share would be lost
    return few if few.layout.n_shared == problem.layout.n_shared else problem


def _trials(problem: Problem) -> Array:
    """Return vectors (N, q, size) of trial courses."""
    d, order, n = problem.dimension, problem.motions[0].order, problem.layout.n_shared
    rng, (centre, spread) = np.random.default_rng(_SEED), spread_of(problem)
    direction = rng.standard_normal((TRIALS, 1, d))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    # a tenth of the spread is between the stations; from thirty spreads the shape of wave fronts hardly changes
    away = 10.0 ** rng.uniform(-1.0, 1.5, (TRIALS, 1, 1))
    moves = np.resize(_MOVES, TRIALS)[:, None, None] * rng.standard_normal((TRIALS, order + 1, d))
    # polynomials through places at equal steps of time, in spreads
    since = elapsed(problem, 0)
    when = np.linspace(since.min(), since.max(), order + 1) if order else since[:1]
    powers = np.stack([when**j / factorial(j) for j in range(order + 1)], axis=-1)
    state = np.linalg.solve(powers, away * (direction + moves)) if order else away * (direction + moves)
    shared = np.repeat(vectors(problem, None)[:, None, :n], TRIALS, axis=1)
    for j, name in enumerate(state_names(0, 1, order)):
        slot, _ = problem.layout.find(name)
        middle = centre[:, None] if j == 0 else 0.0
        shared[..., slot.start : slot.start + d] = middle + spread[:, None, None] * state[:, j]
    return complete(problem, shared)


def _cheapest(problem: Problem, x: Array, limit: int, kept: int) -> tuple[Array, Array]:
    """Return the cheapest vectors (N, kept, size) after at most `limit` steps from vectors x (N, q, size), and costs.

    A vector without a finite cost has an infinite cost.
    """
    count, q = x.shape[:2]
    found, cost = np.array(x), np.full((count, q), np.inf)
    item, slot = np.nonzero(np.isfinite(x).all(-1))
    if len(item):
        with np.errstate(all="ignore"):
            done = refine(problem, x[item, slot], item=item, limit=limit, face=exact(problem))
        found[item, slot], cost[item, slot] = done.x, np.where(np.isfinite(done.cost), done.cost, np.inf)
    order = np.argsort(cost, axis=1, kind="stable")[:, :kept]
    return np.take_along_axis(found, order[..., None], axis=1), np.take_along_axis(cost, order, axis=1)


def _different(cost: Array, place: Array) -> list[int]:
    """Return the numbers of different minima among q with finite costs (q,); `place` (q, d) is in spreads."""
    kept: list[int] = []
    for i in np.flatnonzero(np.isfinite(cost)).tolist():
        alike = [j for j in kept if abs(cost[i] - cost[j]) <= _SAME_COST * (1.0 + cost[j])]
        if all(np.linalg.norm(place[i] - place[j]) > _SAME_PLACE for j in alike):
            kept.append(i)
    return kept
