"""Starts for a whole run: the minima of its block averages, from a closed form, a relaxation, mirrors and a ring."""

from __future__ import annotations

from collections.abc import Callable
from math import factorial

import numpy as np

from optloc.blocks import averaged
from optloc.equations import equations_at
from optloc.normal import covariance
from optloc.plan import elapsed
from optloc.problem import Problem
from optloc.solve.freedom import degrees_of_freedom
from optloc.solve.reasons import DOUBT
from optloc.solve.refine import refine
from optloc.solve.scale import distance_of, spread_of
from optloc.solve.start import completed, vectors
from optloc.status import Status
from optloc.types import Array

BLOCKS = 30
# Rivals that cost more than this on block averages are not refined on all epochs, but for the best of them.
_RIVAL = 1e3
_KEPT = 4
_SAME = 1e-4
# Where the verdict is not clean: minima beyond the stations' plane and along the valley of a weak fix.
_WEAK = 1e-2
_AZIMUTHS = 6
_RADII = (1.5, 5.0)
# Without a closed form also among the stations.
_ANYWHERE = (0.3, 0.8, 1.5, 5.0)
_STEPS = (-8.0, -4.0, -2.0, -1.0, 1.0, 2.0, 4.0, 8.0)
# Fixes with an error beyond this share of their distance may have another minimum that block averages do not show.
_BLURRED = 2e-3
_BESIDE = (-6.0, -2.0, 2.0, 6.0)


def run_starts(problem: Problem, begin: Callable[[Problem], Array | None]) -> Array:
    """Return starting vectors (N, C, size) of a flat batch of runs, the cheapest first.

    Parameters
    ----------
    problem : Problem
        N runs of one target that lasts them.
    begin : callable
        Maps the block averages to starting vectors (N, C, size of theirs), or None where it cannot: the starts are
        then places around the stations.
    """
    groups = alike(problem)
    if len(groups) == 1:
        return _starts(problem, begin)
    parts = [(items, _starts(problem.take(items), begin)) for items in groups]
    out = np.full((problem.batch_shape[0], max(part.shape[1] for _, part in parts), problem.layout.size), np.nan)
    for items, part in parts:
        out[items, : part.shape[1]] = part
    return out


def alike(problem: Problem) -> list[Array]:
    """Return the problems of a flat batch in groups that have the same rows: these have block averages in common."""
    present = np.broadcast_to(problem.weight > 0.0, (problem.batch_shape[0], problem.count))
    if problem.weight.ndim == 1 or (present == present[:1]).all():
        return [np.arange(len(present))]
    _, group = np.unique(present, axis=0, return_inverse=True)
    return [np.flatnonzero(group.reshape(-1) == i) for i in range(int(group.max()) + 1)]


def _starts(problem: Problem, begin: Callable[[Problem], Array | None]) -> Array:
    blocks = averaged(problem, BLOCKS)
    x = begin(blocks)
    x = _around(blocks, _ANYWHERE) if x is None else x
    pool = _minima(blocks, x)
    pool = _pooled(pool, _minima(blocks, mirrored_courses(blocks, pool[0][:, :1])))
    doubtful = np.flatnonzero(~_settled(blocks, pool))
    if len(doubtful):
        part = blocks.take(doubtful)
        wider = _minima(part, np.concatenate([_around(part, _RADII), _valley(part, pool[0][doubtful, 0])], axis=1))
        pool = _pooled(pool, _spread(wider, doubtful, len(x)))
    return completed(problem, _best(blocks, *pool)[..., : problem.layout.n_shared])


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


def _pooled(one: tuple[Array, Array], two: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return two sets of minima as one, the cheapest first."""
    x, cost = (np.concatenate(parts, axis=1) for parts in zip(one, two, strict=True))
    order = np.argsort(cost, axis=1, kind="stable")
    return np.take_along_axis(x, order[..., None], axis=1), np.take_along_axis(cost, order, axis=1)


def _spread(found: tuple[Array, Array], items: Array, count: int) -> tuple[Array, Array]:
    x = np.full((count, *found[0].shape[1:]), np.nan)
    cost = np.full((count, found[1].shape[1]), np.inf)
    x[items], cost[items] = found
    return x, cost


def _settled(blocks: Problem, pool: tuple[Array, Array]) -> Array:
    """Return where the best minimum (N,) fits the data and has a small error: where else to look is no question."""
    from scipy.special import gammaincc

    x, cost = pool[0][:, 0], pool[1][:, 0]
    found, dof = np.isfinite(cost), np.maximum(degrees_of_freedom(blocks), 1)
    fits = found & (gammaincc(dof / 2.0, np.where(found, cost, np.inf) / 2.0) > DOUBT)
    deviation = np.sqrt(np.trace(_covariance(blocks, x), axis1=-2, axis2=-1))
    with np.errstate(invalid="ignore"):
        return np.asarray(fits & (deviation < _WEAK * distance_of(blocks, blocks.layout.take(x, "position"))))


def _covariance(blocks: Problem, x: Array) -> Array:
    """Return the covariance of the position (N, d, d) in units of the spread of the stations."""
    usable = np.asarray(np.isfinite(x).all(-1))
    slot, _ = blocks.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    with np.errstate(all="ignore"):
        full, ok = covariance(equations_at(blocks, np.where(usable[:, None], x, 0.0)))
    return np.asarray(
        np.where((usable & ok)[:, None, None], full[:, part, part], np.nan) / _length(blocks)[:, None, None] ** 2
    )


def _length(blocks: Problem) -> Array:
    return np.asarray(spread_of(blocks)[1])


def _around(blocks: Problem, radii: tuple[float, ...]) -> Array:
    """Return vectors (N, C, size) of targets at rest on circles around the stations, and above and below."""
    d, centre = blocks.dimension, spread_of(blocks)[0]
    angle = 2.0 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
    level = np.stack([np.cos(angle), np.sin(angle), *([0.0 * angle] * (d - 2))], axis=-1)
    poles = np.eye(d)[2:]
    direction = np.concatenate([level, poles, -poles])
    away = (np.array(radii)[:, None, None] * direction).reshape(-1, d)
    x = np.repeat(vectors(blocks, None)[:, None], len(away), axis=1)
    slot, _ = blocks.layout.find("position")
    x[..., slot.start : slot.start + slot.size] = centre[:, None] + _length(blocks)[:, None, None] * away
    return x


def _valley(blocks: Problem, x: Array) -> Array:
    """Return vectors (N, C, size) along the longest axis of the error ellipsoid of the best minimum."""
    return _along(blocks, x, _covariance(blocks, x) * _length(blocks)[:, None, None] ** 2, _STEPS)


def beside(problem: Problem, x: Array, covariance: Array) -> Array:
    """Return vectors (N, C, size) along the longest axis of badly determined fixes of runs; NaN for the others.

    Block averages blur minima that lie within a few standard deviations of each other.

    Parameters
    ----------
    problem : Problem
        N runs.
    x : array (N, size)
        Their fixes.
    covariance : array (N, d, d)
        Of the positions, square metres.
    """
    far = distance_of(problem, problem.layout.take(x, "position")) * _length(problem)
    with np.errstate(invalid="ignore"):
        weak = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1)) > _BLURRED * far
    return np.where(weak[:, None, None], _along(problem, x, covariance, _BESIDE), np.nan)


def _along(problem: Problem, x: Array, covariance: Array, steps: tuple[float, ...]) -> Array:
    """Return vectors (N, C, size) moved by steps in standard deviations along the longest axis of their covariances."""
    usable = np.asarray(np.isfinite(covariance).all((-1, -2)) & np.isfinite(x).all(-1))
    values, axes = np.linalg.eigh(np.where(usable[:, None, None], covariance, 0.0))
    longest = np.sqrt(np.maximum(values[:, -1:], 0.0)) * axes[..., -1]
    out = np.repeat(np.where(usable[:, None], x, np.nan)[:, None], len(steps), axis=1)
    slot, _ = problem.layout.find("position")
    out[..., slot.start : slot.start + slot.size] += np.array(steps)[:, None] * longest[:, None]
    return out


def _best(blocks: Problem, x: Array, cost: Array) -> Array:
    """Return the different minima (N, C, size) worth refining on all epochs; NaN in empty slots."""
    order = np.argsort(cost, axis=1, kind="stable")
    x, cost = np.take_along_axis(x, order[..., None], axis=1), np.take_along_axis(cost, order, axis=1)
    for i in np.flatnonzero(np.isfinite(cost).any(0))[1:]:
        for j in range(i):
            cost[:, i] = np.where(_at_one_place(blocks, x[:, i], x[:, j]) & np.isfinite(cost[:, j]), np.inf, cost[:, i])
    order = np.argsort(cost, axis=1, kind="stable")[:, :_KEPT]
    x, cost = np.take_along_axis(x, order[..., None], axis=1), np.take_along_axis(cost, order, axis=1)
    with np.errstate(invalid="ignore"):
        cost[:, 2:] = np.where(cost[:, 2:] - cost[:, :1] > _RIVAL, np.inf, cost[:, 2:])
    used = np.isfinite(cost)
    return np.where(used[..., None], x, np.nan)[:, : max(1, int(used.sum(1).max()))]


def _at_one_place(blocks: Problem, x: Array, y: Array) -> Array:
    """Return where the positions of two vectors (N, size) are one, as measured by the spread of the stations."""
    apart = blocks.layout.take(x, "position") - blocks.layout.take(y, "position")
    return np.asarray(np.sqrt((apart**2).sum(-1)) < _SAME * _length(blocks))


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
