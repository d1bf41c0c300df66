"""Starts of a target on a course: a seeded search from many trial courses around the stations.

A closed form for each epoch, and a polynomial through its fixes, misses a course if epochs have two positions that fit:
the polynomial then mixes positions of both sides. Trial courses pass through random places, so their speeds fit the
size of the geometry and the duration of the run.

Letters: N problems, q trial courses of each, k epochs, d coordinates, `size` numbers of a parameter vector.
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
from optloc.problem.epochs import some_epochs
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem
from optloc.solvers.starts.position import spread_of

# Trial courses, steps that rank them, and the cheapest of them that are refined to the end. Of 1 000 random problems
# (TODO)
TRIALS, _FEW, _CHEAPEST = 192, 8, 32
# Different minima that are kept.
_MOST = 8
# Rows of a run that the search uses: all minima of a long run appear in a few of its epochs.
_ROWS = 200
_SEED = 20261130  # arbitrary: the same problem always gets the same trial courses
# Shares of its distance from the stations by which a trial course moves. Slow targets need courses at rest, since
# the velocity is then the easy part.
_MOVES = (0.0, 0.3, 1.0, 2.0)
# Relative difference of costs, and absolute difference, below which two ends of a refinement are the same minimum.
_SAME = 1e-4


def has_course(problem: Problem) -> bool:
    """Return whether one unknown target has one state for all epochs of a run, and its position is not the only one."""
    motion = problem.motions[0]
    return len(problem.motions) == 1 and motion.known is None and motion.span == "run" and not one_position(problem)


def course_search(problem: Problem) -> Array:
    """Return the cheapest minima (N, q, size) that a search from trial courses finds; NaN after the last.

    A long run is searched in some of its epochs only, so its minima are approximate.

    Parameters
    ----------
    problem : Problem
        N problems for which `has_course` is true.
    """
    few = _thinned(problem)
    size, trials = problem.batch_shape[0], _trials(few)
    x, _ = _cheapest(few, trials, _FEW, _CHEAPEST)
    x, cost = _cheapest(few, x, 60, _CHEAPEST)
    out = np.full((size, _MOST, few.layout.n_shared), np.nan)
    for i in range(size):
        places = _different(cost[i])[:_MOST]
        out[i, : len(places)] = x[i, places, : out.shape[-1]]
    return complete(problem, out)


def _thinned(problem: Problem) -> Problem:
    """Return some epochs of a long run as a run; a short run is returned unchanged."""
    kept = max(_ROWS * problem.epochs // max(problem.count, 1), 2 * len(_MOVES))
    if kept >= problem.epochs:
        return problem
    # The choice is random, since epochs may alternate between stations.
    rng = np.random.default_rng(_SEED)
    few = some_epochs(problem, np.sort(rng.permutation(problem.epochs)[:kept]))
    return few if few.layout.n_shared == problem.layout.n_shared else problem


def _trials(problem: Problem) -> Array:
    """Return vectors (N, q, size) of trial courses; the same problem always gets the same ones."""
    d, order = problem.dimension, problem.motions[0].order
    rng, (centre, spread) = np.random.default_rng(_SEED), spread_of(problem)
    direction = rng.standard_normal((TRIALS, 1, d))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    # a tenth of the spread is between the stations; directions change little beyond thirty spreads
    away = 10.0 ** rng.uniform(-1.0, 1.5, (TRIALS, 1, 1))
    moves = np.resize(_MOVES, TRIALS)[:, None, None] * rng.standard_normal((TRIALS, order + 1, d))
    places = away * (direction + moves)
    # the polynomials through these places, at equal steps of time
    since = elapsed(problem, 0)
    when = np.linspace(since.min(), since.max(), order + 1) if order else np.zeros(1)
    state = np.linalg.solve(np.stack([when**j / factorial(j) for j in range(order + 1)], axis=-1), places)
    shared = np.repeat(vectors(problem, None)[:, None, : problem.layout.n_shared], TRIALS, axis=1)
    for j, name in enumerate(state_names(0, 1, order)):
        slot, _ = problem.layout.find(name)
        middle = centre[:, None] if j == 0 else 0.0
        shared[..., slot.start : slot.start + d] = middle + spread[:, None, None] * state[:, j]
    return complete(problem, shared)


def _cheapest(problem: Problem, x: Array, limit: int, kept: int) -> tuple[Array, Array]:
    """Return the cheapest vectors (N, kept, size) after refinements of vectors x (N, q, size), and their costs."""
    count, q = x.shape[:2]
    done = refine(
        problem, x.reshape(-1, x.shape[-1]), item=np.repeat(np.arange(count), q), limit=limit, face=exact(problem)
    )
    cost = np.where(np.isfinite(done.cost), done.cost, np.inf).reshape(count, q)
    order = np.argsort(cost, axis=1, kind="stable")[:, :kept]
    ends = done.x.reshape(count, q, -1)
    return np.take_along_axis(ends, order[..., None], axis=1), np.take_along_axis(cost, order, axis=1)


def _different(cost: Array) -> Array:
    """Return the numbers of different minima among ascending costs (q,)."""
    finite = cost[np.isfinite(cost)]
    return np.flatnonzero(np.diff(finite, prepend=-np.inf) > _SAME * (1.0 + finite))
