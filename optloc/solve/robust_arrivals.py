"""Range differences doubted as what they are made of: one arrival time for each station."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from optloc.fix import Alternatives, Fix
from optloc.problem import Problem
from optloc.solve.arrivals import Arrivals, as_arrivals, original
from optloc.solve.freedom import degrees_of_freedom
from optloc.solve.robust_weights import residuals
from optloc.solve.stages import packed, pooled
from optloc.types import Array

Minimise = Callable[[Problem, Array | None], Fix]
"""Maps a flat batch of problems and starting vectors (N, q, size), or None, to robust fixes."""


def by_arrivals(problem: Problem, fix: Fix | None, minimise: Minimise) -> Fix:
    """Return robust fixes; differences of arrival times are taken apart first, where that is the same problem.

    An error of one arrival is in every difference that it is part of, with either sign: no loss of the differences
    names it, whereas among the arrivals it is one bad row. A difference then has the lesser weight of its two arrivals.

    Parameters
    ----------
    problem : Problem
        N problems.
    fix : Fix or None
        Whose candidates are the starts.
    minimise : callable
        Finds the robust fixes.
    """
    start = None if fix is None else packed(pooled(fix)[0])
    taken = as_arrivals(problem) if problem.epochs == 1 and not problem.layout.n_local else None
    if taken is None:
        return minimise(problem, start)
    found = minimise(taken.problem, None if start is None else _emitted(taken.problem, start))
    others = found.alternatives
    return replace(
        found,
        x=original(problem, taken.problem, found.x),
        alternatives=Alternatives(original(problem, taken.problem, others.x), others.gap),
        layout=problem.layout,
        dof=degrees_of_freedom(problem),
        weights=_weights(problem, taken, found),
    )


def _emitted(problem: Problem, x: Array) -> Array:
    """Return vectors (N, q, size) with the emission time that the median arrival gives, of vectors without it."""
    whole = np.concatenate([x, np.zeros((*x.shape[:-1], problem.layout.size - x.shape[-1]))], axis=-1)
    item, slot = np.nonzero(np.isfinite(x).all(-1))
    if len(item):
        arrivals = problem.rows[0].count
        left = residuals(problem.take(item), whole[item, slot])[:, :arrivals]
        whole[item, slot, -1] = np.median(left, axis=-1)
    known = np.asarray(np.isfinite(x).all(-1))
    return np.where(known[..., None], whole, np.nan)


def _weights(problem: Problem, taken: Arrivals, fix: Fix) -> Array:
    """Return the weight (N, m) of each row: the least of those of the rows that were made from it."""
    weights = np.array(np.broadcast_to(problem.weight, (len(fix), problem.count)))
    for row, origin in enumerate(taken.origin):
        weights[:, origin] = np.minimum(weights[:, origin], fix.weights[:, row, None])
    return weights
