"""Whether a fix is the best one: branch and bound over all positions, and what it finds on the way."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.records import present
from optloc.base.types import Array
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.fix import Fix, Stage
from optloc.problem.problem import Problem
from optloc.proof.scope import unsupported
from optloc.solvers.certify.rounds import unknown
from optloc.solvers.outside import accept
from optloc.solvers.policy import LISTED_GAP
from optloc.solvers.pool import Pool
from optloc.solvers.verdict.judge import judge
from optloc.solvers.verdict.status import fill

# Who asks for a proof gives it more time than a method that goes on without one.
_EFFORT = 4


def certify(
    problem: Problem, fix: Fix, region: tuple[Array, Array] | None = None, *, margin: float = LISTED_GAP
) -> Fix:
    """Return a fix with a certificate of what is proven about it, and with every better or other minimum met.

    The proof encloses all positions that could cost less, shows that the cost is convex around the fix, and splits
    the rest into boxes until a lower bound excludes each. A better position replaces the fix, which is then proven
    again; other minima with a cost within 25 are listed as alternatives.

    Parameters
    ----------
    problem : Problem
        Batch (...) of problems.
    fix : Fix
        Their fixes, refined.
    region : (lower, upper), optional
        Corners (d,) of the box to which the claim may be limited, in the problem's frame, metres; None: all positions,
        or where that cannot be bounded a box around the stations that the certificate names.
    margin : float
        Gap between the cost of the fix and that of any other minimum that is tried to prove first; where the proof is
        not finished, 9, the gap of `ambiguous`, and the value alone follow. 0 asks for the value alone: quicker.

    Returns
    -------
    Fix
        Like `fix`. Fixes without an answer stay as they are; what cannot be proven has the certificate "unknown" with
        the reason.

    Raises
    ------
    InvalidProblem
        For a fix of another shape, corners that do not bound a box, or a negative margin.
    """
    if separable(problem):
        problem = by_epoch(problem)
    shape, flat = problem.batch_shape, problem.flat()
    if fix.shape != shape:
        raise InvalidProblem(
            f"a fix of shape {fix.shape} for problems of shape {shape}", "fix", "give the fix of this problem"
        )
    if not 0.0 <= margin < np.inf:
        raise InvalidProblem(f"the margin is {margin}", "margin", "give 0 or a positive number")
    corners = None if region is None else _corners(problem, region)
    pool = certified(flat, accept(flat, fix.reshape((flat.batch_shape[0],))), corners, margin, _EFFORT)
    return judge(flat, pool).reshape(shape)


def value_certified(problem: Problem, pool: Pool | None) -> Pool:
    """Return the pools of a flat batch of problems with a proof that nothing costs less: the stage "value"."""
    return certified(problem, pool, margin=0.0)


def certified(
    problem: Problem, pool: Pool | None, region: Array | None = None, margin: float = LISTED_GAP, effort: int = 1
) -> Pool:
    """Return the pools of a flat batch with certificates: the stage "certify"; region (2, d) as of `certify`.

    `effort` multiplies the boxes that a proof may take.
    """
    if pool is None:
        raise InvalidProblem("certify examines a fix", "method", "put it behind a refinement")
    began = perf_counter()
    fix = judge(problem, pool)
    answered = fix.answered & np.isfinite(fix.cost)
    if pool.conclusion is not None:
        answered &= ~present(pool.conclusion)  # the rows are not all there
    why = unsupported(problem)
    if why or not answered.any():
        certificate = fill(len(pool), None) if pool.certificate is None else np.array(pool.certificate)
        certificate[answered] = unknown(why)
        return replace(pool, certificate=certificate, stages=(*pool.stages, _stage(why or "nothing to prove", began)))
    from optloc.solvers.certify.rounds import Work, settle  # machine code is loaded when it is used

    work = settle(Work.begin(problem, pool, fix, answered, region, margin, effort))
    stages = (*pool.stages, _stage(work.summary(), began))
    return replace(work.pool, certificate=work.certificate, stages=stages)


def _stage(detail: str, began: float) -> Stage:
    return Stage("certify", detail, perf_counter() - began)


def _corners(problem: Problem, region: tuple[Array, Array]) -> Array:
    """Return the corners (2, d) of a region that is a box."""
    corners = np.array([np.asarray(corner, dtype=float) for corner in region])
    if corners.shape != (2, problem.dimension) or not np.isfinite(corners).all() or (corners[0] >= corners[1]).any():
        raise InvalidProblem(
            "the region is no box", "region", f"give (lower, upper) with {problem.dimension} finite coordinates each"
        )
    return corners
