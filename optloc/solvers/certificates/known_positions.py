"""Proofs of fixes whose targets are all at known positions, such as a calibration with a beacon.

The unknowns are then clock errors, other biases and emission times. If each row is linear in them, the cost is a convex
quadratic function. Such a function has one minimum (S. Boyd and L. Vandenberghe, Convex Optimization, 2004, section
4.2.2), so a converged fix has the least cost. A singular normal matrix, whose minimum is not unique, is a finding of
`optloc.solvers.verdict.judge`.
"""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np

from optloc.base.records import take
from optloc.models import MODELS
from optloc.problem.forms import form_of
from optloc.problem.layout import emission_name
from optloc.problem.problem import Problem
from optloc.solvers.certificates.branch_and_bound import certify_stage, claims_before, fixes_to_prove, state_claims
from optloc.solvers.pool import Pool
from optloc.solvers.verdict.judge import judge

REASON = "proven best: the positions are known, and the rows are linear in the other unknowns"


def is_linear(problem: Problem) -> bool:
    """Return whether all targets are at known positions and all rows are linear in all unknowns."""
    if any(motion.known is None for motion in problem.motions) or problem.constraints or problem.fences:
        return False
    # Angles repeat after a whole turn, so their residuals are not linear in an offset.
    if any(MODELS[rows.kind].period is not None for rows in problem.rows):
        return False
    # Turned axes and displaced stations change the geometry. The value of a scale is multiplied by a known quantity.
    linear = {bias.name for bias in problem.biases if form_of(bias).enters in ("adds", "scales")}
    linear |= {emission_name(target, len(problem.motions)) for target in range(len(problem.motions))}
    return {slot.name for slot in (*problem.layout.shared, *problem.layout.local)} <= linear


def certified_linear(problem: Problem, pool: Pool, margin: float) -> Pool:
    """Return the pools of a flat batch of linear problems with certificates: no other values have a lower cost.

    `margin` is the gap of cost to other minima, which the certificate states. Linear problems have no other minima.
    """
    began, fix = perf_counter(), judge(problem, pool)
    asked, proven_before = fixes_to_prove(pool, fix)
    proven = claims_before(pool)
    if pool.tried_before is not None:
        proven.write(proven_before, take(pool.tried_before.proven, proven_before))
    items = asked & ~proven_before
    cost, none = fix.cost[items], np.zeros(int(items.sum()), dtype=int)
    claims = state_claims(cost, cost, np.full(len(cost), margin), none, none)
    claims.reason[:] = REASON
    proven.write(items, claims)
    return replace(pool, proven=proven, stages=(*pool.stages, certify_stage("linear", began)))
