"""The stage "nlp": the maximum-likelihood problem as a nonlinear program for IPOPT, one problem at a time.

It checks the refinement by an independent solver. Module `optloc.solvers.scaled_program` builds the programs.
"""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np

from formulations.backend import SolverError
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Status
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import Face, face_of, faces, is_conjunctive, on_face, restore, tangent_at
from optloc.linear.normal import decrement, step, with_station_noise
from optloc.linear.vectors import complete
from optloc.problem.fix_parts import Stage
from optloc.problem.noise import whiten
from optloc.problem.problem import Problem
from optloc.solvers.inequalities import bound_pool, by_least_squares, without_broken
from optloc.solvers.pool import Pool, begin, offer
from optloc.solvers.scaled_program import ScaledProblem
from optloc.solvers.stages import lsr
from optloc.solvers.starts.block_averages import average_blocks
from optloc.solvers.starts.position import is_registration_run
from optloc.solvers.starts.registration import BLOCKS, group_alike
from optloc.solvers.verdict.judge import judge, surviving_candidates
from optloc.solvers.verdict.minima import settle

# Squared length of the next Gauss-Newton step, in sigma, at a minimum: IPOPT reports some of these ends as unfinished.
_STATIONARY = 1e-10


def nlp(problem: Problem, pool: Pool | None) -> Pool:
    """Return the minima that IPOPT reaches from all candidates of the pool before.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems.
    pool : Pool
        Starts.

    Returns
    -------
    Pool
        Settled. For a long run IPOPT solves block averages, and least squares refines the answers on all epochs.
    """
    if pool is None:
        raise InvalidProblem("nlp needs a start", "method", "give start= or a method such as 'gtrs+nlp'")
    began = perf_counter()
    # a program with thousands of rows is slow to build and to solve; the least squares after it use all epochs
    # with fewer than two epochs per block, nothing would be averaged
    if is_registration_run(problem) and problem.epochs >= 2 * BLOCKS:
        return lsr(problem, offer(problem, _of_blocks(problem, pool.x), pool, "nlp", began))
    # IPOPT gets one covariance, so station errors of an epoch become noise
    problem = with_station_noise(problem)
    x, shape = pool.x.copy(), pool.x.shape[:2]
    cost, code = np.full(shape, np.inf), np.full(shape, int(Status.NUMERICAL), dtype=np.int8)
    item, slot = pool.occupied
    # one by one: a program belongs to a structure and takes the numbers of each problem
    for i in np.unique(item):
        one = problem.take(np.array([i]))
        solver = ScaledProblem(one)
        for j in slot[item == i]:
            x[i, j], cost[i, j], code[i, j] = _from_start(solver, pool.x[i, j])
    face = np.zeros(shape, dtype=int)
    if len(item):
        part, points = problem.take(item), x[item, slot]
        face[item, slot] = face_of(part, points) if problem.constraints else 0
        code[item, slot] = _stationary(part, points, code[item, slot], face[item, slot])
    cost[code == Status.NUMERICAL] = np.inf  # for instance a start on a station
    weights = np.broadcast_to(problem.weight, (len(pool), problem.count))
    found = Pool(x, cost, code, face, weights, pool.dof, pool.stages, missing=pool.missing)
    # a program cannot contain a union; so each of its faces is an equality of one more program
    united = any(not is_conjunctive(constraint) for constraint in problem.constraints)
    found = bound_pool(problem, found, _on_face) if united else without_broken(problem, found)
    settled = settle(problem, found, Stage("nlp", f"{len(item)} programs", perf_counter() - began))
    return replace(settled, refined=False)  # not refined, so that a following "lsr" runs


# Most starts of programs on one face of the constraints: the starts of least cost after projection onto it.
_STARTS = 6


def _on_face(problem: Problem, start: Array, item: Array, face: Face) -> tuple[Array, Array, Array]:
    """Return x (M, size), cost (M,) and status (M,) of the minima on a face that IPOPT reaches from starts (M, size).

    `item` (M,) is the problem of each start. Faces at epochs along a course are left to least squares.
    """
    if any(level.epoch is not None for level in face):
        return by_least_squares(problem, start, item, face)
    part = problem.take(item)
    with np.errstate(all="ignore"):
        x = restore(part, face, start)
        cost = equations_at(part, np.where(np.isfinite(x), x, start)).cost
    ends, least, code = start.copy(), np.full(len(start), np.inf), np.full(len(start), int(Status.NUMERICAL))
    for i in np.unique(item):
        solver = ScaledProblem(on_face(problem.take(np.array([i])), face))
        own = np.flatnonzero(item == i)
        for k in own[np.argsort(cost[own], kind="stable")][:_STARTS]:
            ends[k], least[k], code[k] = _from_start(solver, x[k] if np.isfinite(x[k]).all() else start[k])
    number = faces(problem).index(face)
    code = _stationary(part, ends, code, np.full(len(ends), number))
    return ends, np.where(code == Status.NUMERICAL, np.inf, least), code


def _of_blocks(problem: Problem, x: Array) -> Array:
    """Return the answers (N, q, size) for the block averages of runs, started from candidates x (N, q, size).

    A run of many epochs is averaged to `BLOCKS` epochs, since a program with thousands of rows is slow. NaN in empty
    slots.
    """
    n, out = problem.layout.n_shared, np.full(x.shape, np.nan)
    for items in group_alike(problem):
        blocks = average_blocks(problem.take(items), BLOCKS)
        pool = nlp(blocks, begin(blocks, complete(blocks, x[items, :, :n])))
        found = surviving_candidates(pool, judge(blocks, pool))
        width = min(found.shape[1], x.shape[1])
        out[items, :width] = complete(problem.take(items), found[:, :width, :n])
    return out


def _stationary(problem: Problem, x: Array, code: Array, face: Array) -> Array:
    """Return status codes (M,) of points x (M, size): `ok` if the next Gauss-Newton step is shorter than 1e-5 sigma.

    `code` (M,) has the codes from the reports of IPOPT, which stay otherwise. `face` (M,) is the index of the face of
    each point.
    """
    sides, out = faces(problem) if problem.constraints else [()], np.array(code)
    for number in np.unique(face):
        items = np.flatnonzero(face == number)
        part, here = problem.take(items), x[items]
        with np.errstate(all="ignore"):
            along = tangent_at(part, sides[number], here) if sides[number] else None
            equations = equations_at(part, here, whiten(part.noise, part.weight))
            move, solvable = step(equations, np.zeros(len(here)), along)
            small = solvable & (np.abs(decrement(equations, move, problem.layout.n_shared)) < _STATIONARY)
        out[items[small]] = Status.OK
    return out


def _from_start(scaled: ScaledProblem, start: Array) -> tuple[Array, float, int]:
    """Return vector (size,), cost and status of the minimum that IPOPT reaches from a start (size,)."""
    begin = (start - scaled.centre) / scaled.unit
    try:
        found = scaled.program.solve(begin, scaled.z, scaled.weight, scaled.data, prior=scaled.prior)
    except SolverError:  # only this candidate failed; `recording` has the message
        return start, np.inf, int(Status.NUMERICAL)
    code = Status.OK if found.success else Status.MAX_ITERATIONS if "Iteration" in found.status else Status.NUMERICAL
    return found.x * scaled.unit + scaled.centre, found.cost, int(code)
