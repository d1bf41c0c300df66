"""Fixes by plans of the engine. Fixes with a complication take the stages of the method.

A *plan* is everything of a problem that does not depend on its measurements, for compiled code. Complications are, for
instance, several minima, or an iteration that does not converge.

Letters: N problems, m rows of a problem, k epochs, r rows of an epoch, `size` numbers of a parameter vector.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import prod
from time import perf_counter

import numpy as np

from optloc.base.cache import Cache
from optloc.base.records import take
from optloc.base.types import Array, Motion, Status
from optloc.engine.memory import COST_OF_FIX, COST_OF_RIVAL, KAPPA, Answer
from optloc.engine.plan import LIMIT, TOLERANCE, Load, Plan, key_of, plan_of
from optloc.kernels.damping import StopRules
from optloc.kernels.jit import enabled
from optloc.kernels.pack import PackedRuns, fold, folding, pack_runs
from optloc.kernels.sums import equations_at, serves
from optloc.linear.evaluate import block_links
from optloc.linear.normal import depends_on_place, with_station_noise
from optloc.linear.redundancy import degrees_of_freedom
from optloc.linear.vectors import vectors, without_biases
from optloc.model_checks.shape import BENT
from optloc.problem.fix_parts import Active, Stage
from optloc.problem.noise import whiten
from optloc.problem.problem import Problem
from optloc.solvers.coplanar import join_sides
from optloc.solvers.policy import WEAK, equal_cost
from optloc.solvers.pool import PART, Curvature, Pool, in_parts
from optloc.solvers.stages import gtrs, lsr, lsr_with_mirror
from optloc.solvers.verdict.minima import likelihood_of, measure_curvature


@dataclass(frozen=True, slots=True)
class PlannedStages:
    """The stages "gtrs" and "lsr" combined, by a plan of the engine if there is one.

    Parameters
    ----------
    alone : bool
        Whether no stage follows. Then the stages also refine the mirror image of the start. Otherwise the later stages
        search for other minima.
    """

    alone: bool = False

    def __call__(self, problem: Problem, pool: Pool | None) -> Pool:
        """Return the settled pools of a flat batch of problems."""
        count, start = problem.batch_shape[0], pool
        plan = plan_of(problem) if pool is None else None
        refinement: Callable[[Problem, Pool], Pool] = lsr_with_mirror if self.alone else lsr
        if plan is None or not plan.at_hand(count):
            run = run_plan_of(problem) if start is None else None

            def work(some: Problem, part: slice) -> Pool:
                if run is not None:
                    return run.settle(some, lambda few: refinement(few, gtrs(few, None)))
                return refinement(some, gtrs(some, None if start is None else take(start, part)))

            return in_parts(problem, work, PART if run is None else max(1, PART // problem.epochs))
        z = problem.z if len(problem.rows) > 1 else problem.rows[0].z
        z = z if z.ndim == 2 and len(z) == count else np.broadcast_to(z, (count, problem.count))
        return settle_by_plan(plan, plan.load(problem), z, problem.take, refinement)


def settle_by_plan(
    plan: Plan,
    load: Load,
    z: Array,
    problems_at: Callable[[Array], Problem],
    refinement: Callable[[Problem, Pool], Pool] = lsr_with_mirror,
    threads: int | None = None,
) -> Pool:
    """Return the settled pools of measurements: by a plan, or by stages for answers with a complication.

    Parameters
    ----------
    plan : Plan
        Plan of the problems.
    load : Load
        Numbers of the problems that the plan takes as arguments.
    z : array (N, m)
        Measurements, SI units and radians.
    problems_at : callable
        Maps the numbers of problems whose answer has a complication to the problems.
    refinement : callable
        Refines the starts of the problems that the plan cannot settle.
    threads : int, optional
        Most threads; by default the value of `optloc.base.threads.thread_count`.
    """
    began = perf_counter()
    answer, steps = plan.run(load, z, threads)
    unsettled = np.flatnonzero(~answer.settled)
    if not len(unsettled):
        return _with_sides(_pool(plan, _preferred(answer, problems_at), steps, began), problems_at)
    # most of these problems only need another start, which the closed form `gtrs` computes
    rest = problems_at(unsettled)
    start = in_parts(rest, lambda part, _: gtrs(part, None))
    # A problem with several starts gets NaN as start: the plan does not settle it, and all starts compete in the
    # stages.
    single = np.isfinite(start.x).all(-1).sum(1) == 1
    second, again = plan.run(
        load.take(unsettled), z[unsettled], threads, np.where(single[:, None], start.x[:, 0], np.nan)
    )
    # the second answers replace the first answers of these problems
    for whole, part in zip(answer, second, strict=True):
        whole[unsettled] = part
    pool = _with_sides(_pool(plan, _preferred(answer, problems_at), max(steps, again), began), problems_at)
    failed = np.flatnonzero(~second.settled)
    if not len(failed):
        return pool
    start = take(start, failed)
    return pool.merge(
        unsettled[failed], in_parts(rest.take(failed), lambda part, which: refinement(part, take(start, which)))
    )


def _preferred(answer: Answer, problems_at: Callable[[Array], Problem]) -> Answer:
    """Return the answer in which the likelier position comes first if two minima cost the same, as in the verdict.

    `problems_at` maps numbers of problems to the problems.
    """
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
    position = x[items]
    covariance[items] = measure_curvature(
        some, equations_at(some, position), position, np.zeros(len(position), dtype=int)
    ).covariance
    number[items, KAPPA:] = np.nan  # the verdict computes the shape
    return answer._replace(x=x, rival=rival, number=number, covariance=covariance)


def _pool(plan: Plan, answer: Answer, steps: int, began: float) -> Pool:
    """Return the pool of fixes from a plan, with a second slot if some fixes have a rival, another minimum.

    `steps` is the largest number of steps. `began` is a time of `time.perf_counter`.
    """
    count, seconds = len(answer.cost), perf_counter() - began
    rivalled = np.isfinite(answer.rival_cost) & answer.settled
    x, cost = answer.x[:, None], answer.cost[:, None]
    code = np.broadcast_to(np.int8(Status.OK), (count, 1))
    if rivalled.any():
        rival = np.where(rivalled[:, None], answer.rival, np.nan)
        x = np.concatenate([x, rival[:, None]], axis=1)
        cost = np.stack([answer.cost, np.where(rivalled, answer.rival_cost, np.inf)], axis=1)
        # an empty slot has no refinement
        second = np.where(rivalled, np.int8(Status.OK), np.int8(Status.UNAVAILABLE))
        code = np.concatenate([code, second[:, None]], axis=1)
    return Pool(
        x,
        cost,
        code,
        np.broadcast_to(0, cost.shape),
        np.broadcast_to(plan.weight, (count, len(plan.weight))),
        np.broadcast_to(np.int32(plan.dof), count),
        planned_stages(count, steps, seconds),
        refined=True,
        curvature=Curvature(answer.covariance, kappa=answer.kappa, active=active_of(plan, answer.multiplier)),
        plain=answer.settled & ~rivalled,
        infinity=answer.infinity,
        free=answer.cost if plan.model.admission.level.shape[1] else None,
    )


def _with_sides(pool: Pool, problems_at: Callable[[Array], Problem]) -> Pool:
    """Return a settled pool in which both sides of the plane of the stations are one region, if the data allow both.

    Only fixes with a rival or with a curved cost are examined. `problems_at` maps their numbers to the problems.
    """
    assert pool.curvature is not None
    assert pool.curvature.kappa is not None
    assert pool.plain is not None
    with np.errstate(invalid="ignore"):
        items = np.flatnonzero(~pool.plain | ~(pool.curvature.kappa[:, 0] <= BENT))
    if not len(items):
        return pool
    some, part = problems_at(items), take(pool, items)
    joined = join_sides(some, part)
    return pool if joined is part else pool.merge(items, joined, joined.stages[-1])


def active_of(plan: Plan, multiplier: Array) -> Array | None:
    """Return the active constraints (N,) of fixes, tuples of `Active`; None if the plan has no constraint.

    `multiplier` (N, k) has the Lagrange multipliers of the k constraints.
    """
    if not plan.held:
        return None
    out = np.empty(len(multiplier), dtype=object)
    for i, multipliers in enumerate(multiplier.tolist()):
        out[i] = tuple(map(Active, plan.held, multipliers[: len(plan.held)]))
    return out


_STARTED = Stage("gtrs", "1 candidates at most", 0.0)


def planned_stages(count: int, steps: int, seconds: float) -> tuple[Stage, ...]:
    """Return the stages of `count` fixes from a plan, with the largest number of steps and the time in seconds."""
    return _STARTED, Stage("lsr", f"{count} candidates, {steps} steps at most", seconds)


# Runs of targets that are free at each epoch: the plan of an epoch starts them, and one call refines all epochs.


@dataclass(frozen=True, slots=True)
class RunPlan:
    """Everything that fixes of runs of one structure need, except measurements.

    Parameters
    ----------
    rows : int array (k, r)
        Numbers of the rows of each epoch.
    epoch : Plan
        Plan of an epoch without biases.
    load : Load
        Arguments of this plan.
    added, gain : array (r,)
        Known biases plus corrections of the rows of an epoch, and known scales.
    columns : int array (l,)
        For each of the l unknowns of an epoch its entry in the fix of the epoch; -1 without an entry.
    x : array (size,)
        Start of all other unknowns.
    runs : PackedRuns
        The epochs, without measurements.
    correction : array (r,)
        Known amount by which each measurement exceeds the model.
    dof : int
        Degrees of freedom.
    """

    rows: Array
    epoch: Plan
    load: Load
    added: Array
    gain: Array
    columns: Array
    x: Array
    runs: PackedRuns
    correction: Array
    dof: int

    def settle(self, problem: Problem, otherwise: Callable[[Problem], Pool]) -> Pool:
        """Return the settled pools of a flat batch of N runs; `otherwise` settles runs with a complication."""
        from optloc.kernels.runs import fixed_runs

        began, count = perf_counter(), problem.batch_shape[0]
        z = np.broadcast_to(problem.z, (count, problem.count))[:, self.rows].reshape(-1, self.rows.shape[1])
        # the fix of each epoch without its known biases is the start of the run
        answer, _ = self.epoch.run(self.load, (z - self.added) / self.gain)
        start, n = np.tile(self.x, (count, 1)), problem.layout.n_shared
        local = start[:, n:].reshape(len(z), len(self.columns))
        local[:, self.columns >= 0] = answer.x[:, self.columns[self.columns >= 0]]
        start[:, n:] = local.reshape(count, -1)
        packed, item = self.runs.packed, np.arange(count)
        observed = packed.numbers._replace(observed=np.require(z - self.correction, requirements=["C", "W"]))
        runs = self.runs._replace(packed=packed._replace(numbers=observed))
        done, found = fixed_runs(runs, item, start, StopRules(TOLERANCE, LIMIT), problem.dimension)
        curvature = Curvature(found.covariance, found.information, found.regular, found.weakest, local=found.local)
        good = (done.status == Status.OK) & np.isfinite(done.cost) & found.regular & (found.weakest >= WEAK)
        # a run has no complication if the fix of every epoch is valid and the refinement of the run has converged
        plain = answer.settled.reshape(count, -1).all(1) & good
        seconds = perf_counter() - began
        pool = Pool(
            done.x[:, None],
            done.cost[:, None],
            done.status[:, None],
            np.broadcast_to(0, (count, 1)),
            np.broadcast_to(problem.weight, (count, problem.count)),
            np.broadcast_to(np.int32(self.dof), count),
            planned_stages(count, int(done.iterations.max(initial=0)), seconds),
            refined=True,
            curvature=curvature,
            plain=plain,
        )
        failed = np.flatnonzero(~plain)
        return pool.merge(failed, otherwise(problem.take(failed))) if len(failed) else pool


_RUNS = Cache["RunPlan | None"](64)


def run_plan_of(problem: Problem) -> RunPlan | None:
    """Return the plan of runs of one target that is free at each epoch, from a cache; None without a plan.

    The stations must be at rest, and a batch may differ in measurements only.
    """
    motion = problem.motions[0]
    free = len(problem.motions) == 1 and (motion.order, motion.span) == (0, "epoch") and motion.known is None
    place = problem.stations.position
    if not free or problem.epochs == 1 or problem.constraints or place.size != prod(place.shape[-2:]):
        return None
    found = _RUNS.find((*key_of(problem), place.tobytes()), lambda: _plan_run(problem))
    return found if found is not None and found.epoch.at_hand(problem.epochs) and serves(problem, 1) else None


def _plan_run(problem: Problem) -> RunPlan | None:
    """Return a new plan for runs of the structure of a problem, or None if it cannot be planned."""
    found = folding(problem)
    if found is None or not enabled():
        return None
    one = problem.take(np.zeros(1, dtype=int)).with_rows(z=np.zeros((1, problem.count)))
    epoch = fold(one, found).take(np.zeros(1, dtype=int))
    # one epoch as a problem of a target at rest, without biases: `RunPlan.settle` subtracts the known biases
    still = replace(without_biases(epoch), motions=(Motion(),))
    plan = plan_of(still)
    dof = int(degrees_of_freedom(one)[0])
    if plan is None or dof < 0 or epoch.weight.ndim > 1 or depends_on_place(one):
        return None
    runs = pack_runs(one, whiten(with_station_noise(one).noise, one.weight))
    if runs is None or len(runs.packed.numbers.source) > 1:
        return None
    base, links = vectors(epoch, None)[0], block_links(epoch)
    gain, added = (
        np.concatenate([getattr(link, name).total(base, link.block.count) for link in links])
        for name in ("gains", "adds")
    )
    columns = np.full(problem.layout.n_local, -1)
    slots = {slot.name: slot for slot in plan.layout.shared}
    # in the fix of an epoch the local unknowns follow the shared unknowns
    slots |= {slot.name: replace(slot, start=slot.start + plan.layout.n_shared) for slot in plan.layout.local}
    for slot in problem.layout.local:
        if slot.name in slots:
            columns[slot.start : slot.start + slot.size] = slots[slot.name].start + np.arange(slot.size)
    rows = np.concatenate([start + own for start, own in zip(problem.starts, found.rows, strict=True)], axis=1)
    return RunPlan(
        rows,
        plan,
        plan.load(still),
        added + epoch.correction,
        1.0 + gain,
        columns,
        vectors(one, None)[0],
        runs,
        epoch.correction,
        dof,
    )
