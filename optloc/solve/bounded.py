"""Answers under inequalities: the minimum lies inside, or on one of the faces; all of them are tried."""

from __future__ import annotations

import numpy as np

from optloc.constraints import TOLERANCE, Face, exact, faces, violation
from optloc.problem import Problem
from optloc.solve.refine import refine
from optloc.solve.sight import hidden
from optloc.solve.verdict import Candidates
from optloc.status import Status
from optloc.types import Array

_STARTS = 3


def bounded(problem: Problem, pool: Candidates) -> Candidates:
    """Return the feasible candidates of a flat batch, with those on faces added where the cheapest breaks a constraint.

    A target that the Earth hides from a satellite which hears it is not feasible either.

    Every set of inequalities that can hold with equality together is a face. The cost is minimised on each from the
    cheapest candidates, and what is feasible competes: the cheapest meets the conditions of Karush, Kuhn and Tucker.

    Parameters
    ----------
    problem : Problem
        N problems with constraints.
    pool : Candidates
        Refined under the equalities alone.

    Returns
    -------
    Candidates
        Infeasible ones have infinite cost and status `infeasible`.
    """
    broken = _broken(problem, pool)
    if not broken.any():
        return pool
    sides = faces(problem)
    first = np.argmin(np.where(np.isfinite(pool.cost), pool.cost, np.inf), axis=1)
    needy = np.flatnonzero(broken[np.arange(len(first)), first])
    kept = _without(pool, broken)
    if not len(needy) or sides == [exact(problem)]:
        return kept
    starts = _cheapest(pool, needy)
    on_faces = [_on_face(problem, sides, number, needy, starts) for number in range(1, len(sides))]
    size, width = len(pool.x), starts.shape[1] * len(on_faces)
    x = np.full((size, width, pool.x.shape[-1]), np.nan)
    cost, code = np.full((size, width), np.inf), np.full((size, width), int(Status.INFEASIBLE), dtype=np.int8)
    face = np.zeros((size, width), dtype=int)
    for array, place in ((x, 0), (cost, 1), (code, 2), (face, 3)):
        array[needy] = np.concatenate([found[place] for found in on_faces], axis=1)
    return Candidates(
        np.concatenate([kept.x, x], axis=1),
        np.concatenate([kept.cost, cost], axis=1),
        np.concatenate([kept.code, code], axis=1),
        np.concatenate([kept.face, face], axis=1),
    )


def without_broken(problem: Problem, pool: Candidates) -> Candidates:
    """Return candidates of which those that break a constraint, or are hidden, have infinite cost."""
    return _without(pool, _broken(problem, pool))


def _broken(problem: Problem, pool: Candidates) -> Array:
    """Return which candidates break a constraint, or stand where the Earth hides them from a satellite."""
    broken = np.zeros(pool.cost.shape, dtype=bool)
    item, slot = np.nonzero(np.isfinite(pool.x).all(-1))
    if len(item) and (problem.constraints or problem.frame.geodetic):
        part, x = problem.take(item), pool.x[item, slot]
        broken[item, slot] = (violation(part, x) > TOLERANCE) | hidden(part, x)
    return broken


def _without(pool: Candidates, broken: Array) -> Candidates:
    cost = np.where(broken, np.inf, pool.cost)
    return Candidates(pool.x, cost, np.where(broken, np.int8(Status.INFEASIBLE), pool.code), pool.face)


def _cheapest(pool: Candidates, items: Array) -> Array:
    """Return the cheapest candidates (items, q, size) of some problems; NaN where there are fewer."""
    order = np.argsort(pool.cost[items], axis=1, kind="stable")[:, :_STARTS]
    x = np.take_along_axis(pool.x[items], order[..., None], axis=1)
    good = np.isfinite(np.take_along_axis(pool.cost[items], order, axis=1))
    return np.where(good[..., None], x, np.nan)


def _on_face(problem: Problem, sides: list[Face], number: int, items: Array, starts: Array) -> tuple[Array, ...]:
    """Return x, cost, code and face (items, q) of the minima on one face."""
    shape = starts.shape[:2]
    cost, code = np.full(shape, np.inf), np.full(shape, int(Status.INFEASIBLE), dtype=np.int8)
    x = np.array(starts)
    row, slot = np.nonzero(np.isfinite(starts).all(-1))
    done = refine(problem, starts[row, slot], item=items[row], face=sides[number], limit=100)
    part = problem.take(items[row])
    inside = (violation(part, done.x) <= TOLERANCE) & ~hidden(part, done.x) & np.isfinite(done.cost)
    x[row, slot] = done.x
    cost[row, slot] = np.where(inside, done.cost, np.inf)
    code[row, slot] = np.where(inside, done.status, np.int8(Status.INFEASIBLE))
    return x, cost, code, np.full(shape, number)
