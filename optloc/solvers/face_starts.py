"""Starts spread along faces, for data that contradict a constraint: the cost then has several minima along a face.

Candidates of the problem without constraints are far from such a face, and descents from them miss minima. So points
around the candidates and around the stations are projected onto the face. Those that cost less than their neighbours
are starts.

Letters: n problems, q candidates or starts of each, k points of each, M points of several problems, f faces with c
levels. A parameter vector has `size` numbers, the first s of which all epochs share.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import replace

import numpy as np

from optloc.base.linalg import centre_and_spread, spread_directions
from optloc.base.types import Array
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import TOLERANCE, Face, Level, band_at, binds_position, bound_of, violation
from optloc.linear.normal import marginal
from optloc.linear.vectors import complete
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem
from optloc.solvers.retraction import is_on, projected

# Points around the best candidate: random directions, and multiples of a distance. At this distance the cost without
# constraints has risen to the cost on the face. If the cost is quadratic, the minimum is within a multiple of one. The
# cost of ranges is not quadratic, so that two is tried too.
_DIRECTIONS, _MULTIPLES = 54, (0.5, 1.0, 2.0)
# Points around the middle of the stations: directions by dimension, and multiples of the spread of the stations.
# Targets are seldom farther than that, and minima that are farther belong to candidates, which are projected too.
_AROUND, _RADII = {2: 12, 3: 26}, (0.25, 0.6, 1.2, 2.5)
# Least rise of chi-square to which these distances belong: three standard deviations.
_LEAST_RISE = 9.0
# Greatest distance of such a point, as a multiple of the spread of the stations, if the data leave a direction open.
_FARTHEST = 10.0
# Least eigenvalue of the information, scaled to a unit diagonal, that is not rounding error: half the digits.
_WEAKEST = 1e-8
# Candidates that are projected. Local minima kept on one face: of all points, and of the admitted ones. Starts kept on
# all faces of one problem: a fix with several hundred faces takes a second.
_PROJECTED, _KEPT, _ADMITTED, _IN_ALL = 8, 4, 3, 96
# Neighbours with which a point is compared, for each dimension of a face, and at most.
_NEIGHBOURS, _MOST_NEIGHBOURS = 3, 8
# Most numbers of a working array: some tens of megabytes.
_NUMBERS = 2**22


def structure(problem: Problem, face: Face) -> tuple[Hashable, ...]:
    """Return a key of everything but the numbers of the levels of a face."""
    bands = [(band_at(problem, level), level.epoch) for level in face]
    return tuple((b.kind, b.target, b.other, b.table, b.coefficients.shape[-1], epoch) for b, epoch in bands)


def limited_to(problem: Problem, sides: list[Face], own: Array, counts: list[int]) -> tuple[Problem, Face]:
    """Return problems whose only constraints are the levels of faces with the same `structure`, and their one face.

    Parameters
    ----------
    problem : Problem
        Flat batch of problems.
    sides : list of Face
        Faces with the same structure.
    own : int array (M,)
        Number of the problem of each point: first the points on the first face, and so on.
    counts : list of int
        Number of points on each face.
    """
    bands, size, splits = [], problem.batch_shape[0], np.split(own, np.cumsum(counts)[:-1])
    for k in range(len(sides[0])):
        same = [(band_at(problem, side[k]), bound_of(problem, side[k])) for side in sides]
        value = np.concatenate([np.broadcast_to(b, (size,))[one] for (_, b), one in zip(same, splits, strict=True)])
        c = np.concatenate(
            [
                np.broadcast_to(band.coefficients, (size, band.coefficients.shape[-1]))[one]
                for (band, _), one in zip(same, splits, strict=True)
            ]
        )
        bands.append(replace(same[0][0], lower=value, upper=value, coefficients=c))
    face = tuple(Level(k, "equal", level.epoch) for k, level in enumerate(sides[0]))
    return replace(problem.take(own), constraints=tuple(bands)), face


def spread_along(problem: Problem, sides: list[Face], candidates: Array, rise: Array) -> list[Array]:
    """Return starts (n, q, size) spread along each face but the first, NaN in empty slots; `rise` (n,) sets distances.

    Parameters
    ----------
    problem : Problem
        Flat batch of n problems.
    sides : list of Face
        All faces. The first has no inequality, and gets no starts.
    candidates : array (n, q, size)
        Candidates without the inequalities, the cheapest first.
    rise : array (n,)
        How far chi-square on the faces is above the cheapest candidate, as far as known; infinite if not.
    """
    n, size = len(candidates), candidates.shape[-1]
    width = min(_PROJECTED, candidates.shape[1]) + _KEPT + _ADMITTED
    starts, cost = np.full((len(sides), n, width, size), np.nan), np.full((len(sides), n, width), np.inf)
    groups: dict[tuple[Hashable, ...], list[int]] = {}
    for number in range(1, len(sides)):
        groups.setdefault(structure(problem, sides[number]), []).append(number)
    cloud = _cloud_in_metric(problem, candidates, rise)
    for numbers in groups.values():
        wider = cloud if not _is_of_places(problem, sides[numbers[0]]) else _with_places(problem, sides, numbers, cloud)
        points, roots, known = wider
        per_point = max(size, points.shape[1], roots.shape[-1] ** 2)
        most = max(1, _NUMBERS // (n * points.shape[1] * per_point))
        for first in range(0, len(numbers), most):
            chosen = numbers[first : first + most]
            starts[chosen], cost[chosen] = _lowest_on(problem, [sides[i] for i in chosen], points, roots, known, width)
    order = np.argsort(np.moveaxis(cost, 0, 1).reshape(n, -1), axis=1, kind="stable")
    rank = np.argsort(order, axis=1).reshape(n, len(sides), width)
    kept = (np.moveaxis(rank, 1, 0) < _IN_ALL) & np.isfinite(cost)
    return list(np.where(kept[..., None], starts, np.nan)[1:])


Cloud = tuple[Array, Array, int]
"""Points (n, k, size), roots (n, 2, s, s) of the two metrics in which they are projected, and a number of points.

That many points, from the first, take the first metric; the others take the second."""


def _cloud_in_metric(problem: Problem, candidates: Array, rise: Array) -> Cloud:
    """Return the candidates and points around the first, at distances that `rise` (n,) gives in the data's metric."""
    first, s = candidates[:, 0], problem.layout.n_shared
    information, _, _ = marginal(equations_at(problem, np.where(np.isfinite(first), first, 0.0)))
    unit = np.sqrt(np.maximum(np.diagonal(information, axis1=-2, axis2=-1), 0.0))
    unit = np.where(unit > 0.0, unit, 1.0)
    scaled = information / (unit[:, :, None] * unit[:, None])
    values, axes = np.linalg.eigh(np.where(np.isfinite(scaled), scaled, 0.0))
    root = axes / np.sqrt(np.maximum(values, _WEAKEST))[:, None] / unit[:, :, None]
    reach = np.sqrt(np.clip(rise, _LEAST_RISE, None))
    reach = np.where(np.isfinite(reach), reach, np.sqrt(_LEAST_RISE))
    _, spread = centre_and_spread(problem.stations.places)
    farthest = np.abs(root[:, _places(problem)]).max(1, initial=0.0) * reach[:, None]
    with np.errstate(divide="ignore"):
        root *= np.minimum(1.0, _FARTHEST * np.reshape(spread, (-1, 1)) / farthest)[:, None]
    # the same directions in every run: a fix must not change from call to call
    ways = np.random.default_rng(0).normal(size=(_DIRECTIONS, s))
    ways /= np.sqrt((ways**2).sum(1, keepdims=True))
    ways *= np.resize(_MULTIPLES, (_DIRECTIONS, 1))
    around = np.repeat(first[:, None], _DIRECTIONS, axis=1)
    around[..., :s] += reach[:, None, None] * (ways @ np.swapaxes(root, -1, -2))
    points = np.concatenate([candidates[:, :_PROJECTED], around], axis=1)
    return points, np.stack([root, np.zeros_like(root)], axis=1), points.shape[1]


def _places(problem: Problem, targets: tuple[int, ...] = ()) -> Array:
    """Return the columns of the positions of targets whose state lasts the run; of all targets by default."""
    found = []
    for target in targets or range(len(problem.motions)):
        if problem.motions[target].known is None:
            slot, shared = problem.layout.find(state_names(target, len(problem.motions), 0)[0])
            found += list(range(slot.start, slot.start + slot.size)) if shared else []
    return np.array(found, dtype=int)


def _is_of_places(problem: Problem, face: Face) -> bool:
    """Return whether all levels of a face bound positions at the reference time."""
    return all(level.epoch is None and binds_position(problem, level) for level in face)


def _with_places(problem: Problem, sides: list[Face], numbers: list[int], cloud: Cloud) -> Cloud:
    """Return a cloud with points around the middle of the stations for each target that the faces bound.

    Its other unknowns are those that fit best there, in the linear model.
    """
    points, roots, known = cloud
    bands = [band_at(problem, level) for level in sides[numbers[0]]]
    targets = dict.fromkeys(t for b in bands for t in (b.target, b.other) if t is not None)
    d, n = problem.dimension, len(points)
    centre, spread = (np.broadcast_to(part, (n, *part.shape[1:])) if part.ndim else part for part in _middle(problem))
    offset = np.concatenate([radius * spread_directions(_AROUND[d], d) for radius in _RADII])
    placed = [points]
    for target in targets:
        columns = _places(problem, (target,))
        if len(columns):
            one = np.repeat(points[:, :1], len(offset), axis=1)
            one[..., columns] = centre[:, None] + spread[:, None, None] * offset
            placed.append(_fitted(problem, one, columns))
    metric = np.zeros(roots.shape[-1])
    metric[_places(problem, tuple(targets))] = 1.0
    roots = roots.copy()
    roots[:, 1] = np.diag(metric)
    return np.concatenate(placed, axis=1), roots, known


def _middle(problem: Problem) -> tuple[Array, Array]:
    """Return the middle (1 or n, d) of the stations and their spread (1 or n,)."""
    centre, spread = centre_and_spread(problem.stations.places)
    return np.reshape(centre, (-1, problem.dimension)), np.reshape(spread, -1)


def _fitted(problem: Problem, x: Array, fixed: Array) -> Array:
    """Return vectors (n, k, size) after one Gauss-Newton step of all shared unknowns but those in columns `fixed`."""
    n, k = x.shape[:2]
    free = np.setdiff1d(np.arange(problem.layout.n_shared), fixed)
    if not len(free):
        return x
    flat = np.where(np.isfinite(x), x, 0.0).reshape(n * k, -1)
    with np.errstate(all="ignore"):
        information, vector, _ = marginal(equations_at(problem.take(np.repeat(np.arange(n), k)), flat))
    usable: Array = np.asarray(np.isfinite(information).all((-1, -2)) & np.isfinite(vector).all(-1))
    block = np.where(usable[:, None, None], information[:, free[:, None], free], np.eye(len(free)))
    step = (np.linalg.pinv(block, hermitian=True) @ np.where(usable[:, None], vector[:, free], 0.0)[..., None])[..., 0]
    out = x.copy()
    out[..., free] += step.reshape(n, k, -1)
    return out


def _lowest_on(
    problem: Problem, sides: list[Face], points: Array, roots: Array, known: int, width: int
) -> tuple[Array, Array]:
    """Return starts (f, n, q, size) on f faces and their costs (f, n, q): the points of a cloud that cost least there.

    `sides` are faces with the same structure, and `width` is the number q of slots. The other arguments are a `Cloud`.
    """
    f, (n, k, size), s = len(sides), points.shape, problem.layout.n_shared
    own = np.tile(np.repeat(np.arange(n), k), f)
    limited, face = limited_to(problem, sides, own, [n * k] * f)
    second = np.tile(np.arange(k) >= known, n * f).astype(int)
    x = np.tile(points.reshape(-1, size), (f, 1))
    good = np.isfinite(x).all(-1)
    x = np.where(good[:, None], x, 0.0)
    x[:, :s] = projected(limited, face, x, roots[own, second])
    with np.errstate(all="ignore"):
        x = complete(limited, x[:, None, :s])[:, 0]
        good &= is_on(limited, face, x) & np.isfinite(x).all(-1)
        x = np.where(good[:, None], x, 0.0)
        cost = equations_at(limited, x).cost
        admitted = violation(problem.take(own), x) <= TOLERANCE
    cost = np.where(good & np.isfinite(cost), cost, np.inf).reshape(f * n, k)
    x, admitted = x.reshape(f * n, k, size), admitted.reshape(f * n, k)
    near = _neighbours(x[..., :s], np.isfinite(cost), min(_NEIGHBOURS * max(1, s - len(face)), _MOST_NEIGHBOURS))
    chosen = np.zeros((f * n, k), dtype=bool)
    chosen[:, : width - _KEPT - _ADMITTED] = True
    for values, kept in ((cost, _KEPT), (np.where(admitted, cost, np.inf), _ADMITTED)):
        lowest = np.take_along_axis(values[:, None], near, axis=2).min(-1) if near.shape[-1] else values
        low = np.where(values <= lowest, values, np.inf)
        rank = np.argsort(np.argsort(low, axis=1, kind="stable"), axis=1)
        chosen |= (rank < kept) & np.isfinite(low)
    cost = np.where(chosen, cost, np.inf)
    best = np.argsort(cost, axis=1, kind="stable")[:, :width]
    least = np.take_along_axis(cost, best, axis=1)
    return np.take_along_axis(x, best[..., None], axis=1).reshape(f, n, -1, size), least.reshape(f, n, -1)


def _neighbours(points: Array, present: Array, count: int) -> Array:
    """Return the indices (N, k, k or N, k, count) of the nearest points of each of points (N, k, s), each scaled.

    Points that are not `present` (N, k) are no neighbours, except where there are too few others.
    """
    with np.errstate(all="ignore"):
        held = np.where(present[..., None], points, np.nan)
        low, high = (np.nan_to_num(reach(held, axis=1, keepdims=True)) for reach in (np.fmin.reduce, np.fmax.reduce))
        scaled = points / np.where(high > low, high - low, 1.0)
        square = (scaled**2).sum(-1)
        apart = square[:, :, None] + square[:, None] - 2.0 * scaled @ np.swapaxes(scaled, -1, -2)
    apart = np.where(present[:, None] & present[..., None], apart, np.inf)
    return np.argsort(apart, axis=-1, kind="stable")[..., 1 : 1 + count]
