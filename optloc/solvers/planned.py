"""Fixes by plans; what is not plainly good takes the stages of the long way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from optloc.base.records import take
from optloc.base.types import Array, Status
from optloc.compute.sums import equations_at
from optloc.engine.memory import COST_OF_FIX, COST_OF_RIVAL, KAPPA, Answer
from optloc.engine.plan import Load, Plan, plan_of
from optloc.problem.fix import Active, Stage
from optloc.problem.problem import Problem
from optloc.solvers.policy import equal_cost
from optloc.solvers.pool import Curvature, Pool, in_parts
from optloc.solvers.stages import gtrs, lsr, lsr_with_mirror
from optloc.solvers.verdict.minima import likelihood_of, measure_curvature


@dataclass(frozen=True, slots=True)
class Quick:
    """The stages "gtrs" and "lsr" as one, by a plan where there is one.

    Parameters
    ----------
    alone : bool
        Whether nothing follows: then the mirror image of the start is refined on the way of the stages, too. What
        follows otherwise looks for other minima by itself.
    """

    alone: bool = False

    def __call__(self, problem: Problem, pool: Pool | None) -> Pool:
        """Return the settled pools of a flat batch of problems."""
        count, start = problem.batch_shape[0], pool
        plan = plan_of(problem) if pool is None else None
        refinement: Callable[[Problem, Pool], Pool] = lsr_with_mirror if self.alone else lsr
        if plan is None or not plan.at_hand(count):

            def work(some: Problem, part: slice) -> Pool:
                return refinement(some, gtrs(some, None if start is None else take(start, part)))

            return in_parts(problem, work)
        z = problem.z if len(problem.rows) > 1 else problem.rows[0].z
        z = z if z.ndim == 2 and len(z) == count else np.broadcast_to(z, (count, problem.count))
        return settle_directly(plan, plan.load(problem), z, problem.take, refinement)


def settle_directly(
    plan: Plan,
    load: Load,
    z: Array,
    problems_at: Callable[[Array], Problem],
    refinement: Callable[[Problem, Pool], Pool] = lsr_with_mirror,
    threads: int | None = None,
) -> Pool:
    """Return the settled pools of measurements: by a plan where the answer is plain, else by other means.

    Parameters
    ----------
    plan : Plan
        Of the problems.
    load : Load
        Of the plan.
    z : array (N, m)
        Measurements.
    problems_at : callable
        Maps the numbers of problems whose answer is not plain to the problems.
    refinement : callable
        What takes the starts of those that are not plain by any means.
    threads : int, optional
        At most so many; as many as `optloc.base.threads.thread_count` says if absent.
    """
    began = perf_counter()
    answer, steps = plan.run(load, z, threads)
    left = np.flatnonzero(~answer.settled)
    if not len(left):
        return _pool(plan, _preferred(answer, problems_at), steps, began)
    # most of what is left lacks nothing but a start: the eigenvalues of its pencil give one
    some = problems_at(left)
    start = in_parts(some, lambda part, _: gtrs(part, None))
    alone = np.isfinite(start.x).all(-1).sum(1) == 1  # where there are several, all of them compete
    more, again = plan.run(load.take(left), z[left], threads, np.where(alone[:, None], start.x[:, 0], np.nan))
    for whole, part in zip(answer, more, strict=True):
        whole[left] = part
    pool = _pool(plan, _preferred(answer, problems_at), max(steps, again), began)
    lost = np.flatnonzero(~more.settled)
    if not len(lost):
        return pool
    start = take(start, lost)
    return pool.merge(left[lost], in_parts(some.take(lost), lambda part, which: refinement(part, take(start, which))))


def _preferred(answer: Answer, problems_at: Callable[[Array], Problem]) -> Answer:
    """Return the answer with the likelier by its place of two minima that cost the same, as the verdict has it."""
    tied = np.flatnonzero(answer.settled & (np.abs(answer.rival_cost - answer.cost) <= equal_cost(answer.cost)))
    if not len(tied):
        return answer
    some = problems_at(tied)
    (first, second), (other, another) = likelihood_of(some, answer.x[tied]), likelihood_of(some, answer.rival[tied])
    changed = (other > first) | ((other == first) & (another > second))
    items, some = tied[changed], some.take(np.flatnonzero(changed))
    if not len(items):
        return answer
    x, rival, number, covariance = map(np.array, (answer.x, answer.rival, answer.number, answer.covariance))
    x[items], rival[items] = rival[items], x[items]
    number[items, COST_OF_FIX], number[items, COST_OF_RIVAL] = answer.rival_cost[items], answer.cost[items]
    at = x[items]
    covariance[items] = measure_curvature(some, equations_at(some, at), at, np.zeros(len(at), dtype=int)).covariance
    number[items, KAPPA:] = np.nan  # the verdict looks at its shape
    return answer._replace(x=x, rival=rival, number=number, covariance=covariance)


def _pool(plan: Plan, answer: Answer, steps: int, began: float) -> Pool:
    """Return the pool of fixes that were found directly, with a second slot where some have a rival."""
    count, seconds = len(answer.cost), perf_counter() - began
    rivalled = np.isfinite(answer.rival_cost) & answer.settled
    x, cost = answer.x[:, None], answer.cost[:, None]
    code = np.broadcast_to(np.int8(Status.OK), (count, 1))
    if rivalled.any():
        rival = np.where(rivalled[:, None], answer.rival, np.nan)
        x = np.concatenate([x, rival[:, None]], axis=1)
        cost = np.stack([answer.cost, np.where(rivalled, answer.rival_cost, np.inf)], axis=1)
        # an empty slot is one that nobody has refined
        second = np.where(rivalled, np.int8(Status.OK), np.int8(Status.UNAVAILABLE))
        code = np.concatenate([code, second[:, None]], axis=1)
    return Pool(
        x,
        cost,
        code,
        np.broadcast_to(0, cost.shape),
        np.broadcast_to(plan.weight, (count, len(plan.weight))),
        np.broadcast_to(np.int32(plan.dof), count),
        direct_stages(count, steps, seconds),
        refined=True,
        curvature=Curvature(answer.covariance, kappa=answer.kappa, active=active_of(plan, answer.multiplier)),
        plain=answer.settled & ~rivalled,
        infinity=answer.infinity,
        free=answer.cost if plan.model.admission.level.shape[1] else None,
    )


def active_of(plan: Plan, multiplier: Array) -> Array | None:
    """Return the constraints (N,) that hold fixes, with their multipliers (N, k); None where none does."""
    if not plan.held:
        return None
    out = np.empty(len(multiplier), dtype=object)
    for i, own in enumerate(multiplier.tolist()):
        out[i] = tuple(map(Active, plan.held, own[: len(plan.held)]))
    return out


_STARTED = Stage("gtrs", "1 candidates at most", 0.0)


def direct_stages(count: int, steps: int, seconds: float) -> tuple[Stage, ...]:
    """Return the stages that so many fixes went through at once, and the most steps that one took."""
    return _STARTED, Stage("lsr", f"{count} candidates, {steps} steps at most", seconds)
