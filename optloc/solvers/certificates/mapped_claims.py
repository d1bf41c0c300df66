"""Claims that were proven in another problem with the same cost: which ones are kept, and which fixes it improves."""

from __future__ import annotations

import numpy as np

from optloc.base.records import take
from optloc.base.types import Array
from optloc.problem.claims import Claims
from optloc.problem.fix import Fix
from optloc.solvers.certificates.branch_and_bound import LOST, claims_before, count_listed, unknown_claim
from optloc.solvers.policy import equal_cost
from optloc.solvers.pool import Pool


def claims_so_far(pool: Pool, proven_before: Array) -> Claims:
    """Return the claims (N,) of a pool, with the earlier claims that are still valid, flags `proven_before` (N,)."""
    claims = claims_before(pool)
    if pool.tried_before is not None:
        claims.write(proven_before, take(pool.tried_before.proven, proven_before))
    return claims


def improved(old: Fix, new: Fix) -> Array:
    """Return the numbers of the fixes (N,) that have a lower cost, or list more other minima, than before."""
    with np.errstate(invalid="ignore"):
        return np.flatnonzero((new.cost < old.cost - equal_cost(old.cost)) | (count_listed(new) > count_listed(old)))


def drop_lost(claims: Claims, fix: Fix, found: Fix, constant: float = 0.0) -> None:
    """Replace the claims (N,) about fixes that do not correspond to the proven fixes `found` by unknown claims.

    They correspond if their costs differ by `constant`, and both list the same number of other minima.
    """
    same = np.abs(fix.cost - found.cost - constant) <= equal_cost(fix.cost)
    same &= fix.answered & (count_listed(fix) == count_listed(found))
    claims.write(~same, unknown_claim(LOST))
