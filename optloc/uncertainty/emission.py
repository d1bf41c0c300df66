"""Emission times of fixes, and their standard deviations."""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array
from optloc.linear.normal import linearise, local_covariance, normal, with_priors
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem

_NAME = "emission"


def emissions(problem: Problem, fix: Fix) -> tuple[Array, Array]:
    """Return the emission times (N, k) of N fixes at k epochs, and their standard deviations (N, k), metres.

    A time is multiplied by the speed that converts times to metres. Both are NaN for fixes without an answer, and
    without unknown emission times. The standard deviations contain the errors of the position.

    Parameters
    ----------
    problem : Problem
        The problem, or batch of problems, of the fixes.
    fix : Fix
        Their fixes.
    """
    flat, problem = fix.flat(), problem.flat()
    layout, n, k = problem.layout, len(flat.x), problem.epochs
    found = np.full((2, n, k), np.nan)
    items = np.flatnonzero(flat.answered & np.isfinite(flat.x).all(-1))
    slot = next((one for one in layout.local if one.name == _NAME), None)
    if slot is None or not len(items):
        return found[0], found[1]
    part = problem.take(items)
    part = part.with_rows(weight=np.broadcast_to(flat.weights[items], (len(items), part.count)))
    x = flat.x[items]
    equations = with_priors(part, x, normal(linearise(part, x), k))
    covariance = local_covariance(equations, flat.cov[items], layout.n_local)
    found[0, items] = layout.take(x, _NAME)[..., 0]
    with np.errstate(invalid="ignore"):
        found[1, items] = np.sqrt(covariance[..., slot.start, slot.start])
    return found[0], found[1]
