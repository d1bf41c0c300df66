"""Starts for a whole run: the minima of its block averages, from a closed form, a relaxation, mirrors and a ring."""

from __future__ import annotations

from collections.abc import Callable
from math import factorial

import numpy as np

from optloc.blocks import averaged
from optloc.plan import elapsed
from optloc.problem import Problem
from optloc.solve.refine import refine
from optloc.solve.scale import spread_of
from optloc.solve.start import completed
from optloc.status import Status
from optloc.types import Array

_BLOCKS = 30
# Rivals that cost more than this on block averages are not refined on all epochs, but for the best of them.
_RIVAL = 1e3
_KEPT = 4
_SAME = 1e-4


def run_starts(problem: Problem, begin: Callable[[Problem], Array | None]) -> Array:
    """Return starting vectors (N, C, size) of a flat batch of runs, the cheapest first.

    Parameters
    ----------
    problem : Problem
        N runs of one target that lasts them.
    begin : callable
        Maps the block averages to starting vectors (N, C, size of theirs), or None where it cannot.
    """
    blocks = averaged(problem, _BLOCKS)
    x = begin(blocks)
    if x is None:
        return np.full((problem.batch_shape[0], 1, problem.layout.size), np.nan)
    found, cost = _minima(blocks, x)
    beside, more = _minima(blocks, mirrored_courses(blocks, found[:, :1]))
    found, cost = _best(blocks, np.concatenate([found, beside], axis=1), np.concatenate([cost, more], axis=1))
    n = problem.layout.n_shared
    return completed(problem, found[..., :n])


def _minima(blocks: Problem, x: Array) -> tuple[Array, Array]:
    """Return the refined starts (N, C, size), the cheapest first, and their costs (N, C), infinite where lost."""
    cost, out = np.full(x.shape[:2], np.inf), x.copy()
    item, slot = np.nonzero(np.isfinite(x).all(-1))
    if len(item):
        done = refine(blocks, x[item, slot], item=item)
        out[item, slot] = done.x
        cost[item, slot] = np.where(np.isin(done.status, (Status.OK, Status.MAX_ITERATIONS)), done.cost, np.inf)
    order = np.argsort(cost, axis=1, kind="stable")
    return np.take_along_axis(out, order[..., None], axis=1), np.take_along_axis(cost, order, axis=1)


def _best(blocks: Problem, x: Array, cost: Array) -> tuple[Array, Array]:
    """Return the different minima (N, C, size) worth refining on all epochs, NaN in empty slots, and their costs."""
    order = np.argsort(cost, axis=1, kind="stable")[:, : 4 * _KEPT]
    x, cost = np.take_along_axis(x, order[..., None], axis=1), np.take_along_axis(cost, order, axis=1)
    for i in range(1, x.shape[1]):
        for j in range(i):
            cost[:, i] = np.where(_alike(blocks, x[:, i], x[:, j]) & np.isfinite(cost[:, j]), np.inf, cost[:, i])
    order = np.argsort(cost, axis=1, kind="stable")[:, :_KEPT]
    x, cost = np.take_along_axis(x, order[..., None], axis=1), np.take_along_axis(cost, order, axis=1)
    with np.errstate(invalid="ignore"):
        cost[:, 2:] = np.where(cost[:, 2:] - cost[:, :1] > _RIVAL, np.inf, cost[:, 2:])
    used = np.isfinite(cost)
    return np.where(used[..., None], x, np.nan)[:, : max(1, int(used.sum(1).max()))], cost


def _alike(blocks: Problem, x: Array, y: Array) -> Array:
    """Return where the positions of two vectors (N, size) are one, as measured by the spread of the stations."""
    apart = blocks.layout.take(x, "position") - blocks.layout.take(y, "position")
    return np.asarray(np.sqrt((apart**2).sum(-1)) < _SAME * spread_of(blocks)[1])


def mirrored_courses(blocks: Problem, x: Array) -> Array:
    """Return courses (N, C, size) mirrored at every epoch in the plane (or line) that fits the stations best.

    The mirrored places are those of a course again where the planes are parallel; else the polynomial next to them.
    """
    order = blocks.motions[0].order
    powers = np.stack([elapsed(blocks, 0) ** j / factorial(j) for j in range(order + 1)], axis=-1)
    slots = [blocks.layout.find(name)[0] for name in ("position", "velocity", "acceleration")[: order + 1]]
    state = np.stack([x[..., slot.start : slot.start + slot.size] for slot in slots], axis=-2)
    place = blocks.stations.position
    place = place if place.ndim == 4 else place[None]
    centre = place.mean(-2)
    apart = place - centre[..., None, :]
    _, vectors = np.linalg.eigh(np.swapaxes(apart, -1, -2) @ apart)
    normal, centre = vectors[..., 0][:, None], centre[:, None]
    course = powers @ state
    course = course - 2.0 * ((course - centre) * normal).sum(-1, keepdims=True) * normal
    state = np.linalg.pinv(powers) @ course
    out = x.copy()
    for j, slot in enumerate(slots):
        out[..., slot.start : slot.start + slot.size] = state[..., j, :]
    return out
