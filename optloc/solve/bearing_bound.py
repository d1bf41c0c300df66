"""The cost of a fix of angles against the lower bound of a relaxation over all positions."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np

from optloc.errors import InvalidProblem
from optloc.fix import Fix, Stage
from optloc.problem import Problem
from optloc.solve.angles import angle_bounds, bearings
from optloc.solve.pieces import one_position
from optloc.status import Certificate

_TIGHT = 1e-3


def bearing_bound(problem: Problem, fix: Fix | None) -> Fix:
    """Return a fix of angles whose certificate compares its cost with a lower bound over all positions."""
    if fix is None:
        raise InvalidProblem("bound examines a fix", "method", "put it behind a refinement")
    angles_only = all(rows.kind in ("azimuth", "elevation") for rows in problem.rows)
    if not angles_only or not one_position(problem) or problem.layout.size != 3 or problem.priors:
        return fix
    began = perf_counter()
    seen = bearings(problem)
    independent = all(block.row.shape[1] == 1 for block in problem.noise.blocks)
    if seen is None or not independent:
        return fix
    bound = angle_bounds(seen, np.where(fix.answered[:, None], fix.position, np.nan))
    certificate = np.array(fix.certificate)
    for i in np.flatnonzero(np.isfinite(bound)):
        certificate[i] = _proof(float(fix.cost[i]), float(bound[i]))
    proven = sum(c.proof == "global" for c in certificate)
    stage = Stage("bound", f"{proven} of {len(certificate)} proven", perf_counter() - began)
    return replace(fix, certificate=certificate, stages=(*fix.stages, stage))


def _proof(cost: float, bound: float) -> Certificate:
    gap = cost - bound
    tight = gap <= _TIGHT * (1.0 + cost)
    reason = "no position costs less" if tight else f"a lower bound leaves a gap of {gap:.2g}"
    proof = "global" if tight else "local"
    return Certificate(
        proof, f"{reason}; other minima were searched for, not excluded", "direction relaxation", bound, gap
    )
