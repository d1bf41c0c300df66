"""From refined candidates to the distinct minima of each problem: the best minimum, its curvature, and its rivals.

Letters: N problems, q candidates of a problem, r rivals, n shared unknowns, `size` numbers of a parameter vector.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np

from optloc.base import linalg
from optloc.base.types import Array, Status
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import Face, face_names, faces, levels, tangent_at
from optloc.linear.fences import unfenced
from optloc.linear.mirror import one_position
from optloc.linear.normal import Normal, local_covariance, marginal
from optloc.linear.vectors import vectors
from optloc.linear.walks import walk_names
from optloc.model_checks.scaled_rows import runs_backwards
from optloc.problem.fix_parts import Active, Stage
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem
from optloc.solvers.horizon import lowest_sight
from optloc.solvers.policy import AMBIGUOUS_GAP, FAR, FLAT, LISTED_GAP, SAME_PLACE, WEAK, equal_cost
from optloc.solvers.pool import Curvature, Pool
from optloc.solvers.starts.position import distance_of, spread_of
from optloc.solvers.verdict.findings import centre_of

# Information up to this value counts as zero: the square of a Jacobian entry is never so small. Its root can be
# inverted.
_DEAD = 1e-300
# Terms below this share of the largest term of an open direction are not named in the sentence.
_TELLING = 0.05
# Spreads of stations that count as zero, since rounding may cause them. _POINT is relative to the coordinates. _FLAT is
# the spread across a line or plane relative to the spread along it: noise hides the effect of a micrometre per metre.
_POINT, _FLAT = 1e-9, 1e-6
# Positions at which the information of the rows is tested: corners of a box around the stations, at 1.3 times the
# spread to avoid planes of symmetry. Rows must determine a position at more than this share of the corners: a corner
# may be singular by chance.
_AWAY, _MOST = 1.3, 0.5


def measure_curvature(problem: Problem, equations: Normal, x: Array, face: Array) -> Curvature:
    """Return the curvature of the cost at vectors x (N, size) on faces `face` (N,) of the constraints.

    `optloc.linear.constraints.faces` lists the faces; face 0 has no inequalities. `equations` are the normal equations
    at x.
    """
    information, vector, ok = marginal(equations)
    covariance, regular = linalg.inverse(information)
    weakest = smallest_pivot(information)
    active: Array = np.frompyfunc(lambda _: (), 1, 1)(np.arange(len(x)))
    sides = faces(problem) if problem.constraints else [()]
    free = shift = None
    for number in np.unique(face):
        if not sides[number]:
            continue
        items = np.flatnonzero(face == number)
        part = problem.take(items)
        if len(sides[number]) > len(sides[0]):  # an inequality is active
            if free is None or shift is None:
                free, shift = np.full(covariance.shape, np.nan), np.full(vector.shape, np.nan)
            free[items], shift[items] = _without_bounds(part, sides[0], x[items], information[items], vector[items])
        along = tangent_at(part, sides[number], x[items])
        covariance[items], regular[items] = linalg.inverse_within(information[items], along)
        # constraints determine the directions across the face, so only pivots along the face count
        inner = np.swapaxes(along, -1, -2) @ information[items] @ along
        weakest[items] = smallest_pivot(inner) if inner.shape[-1] else 1.0
        active[items] = _multipliers(part, sides[number], x[items], vector[items])
    regular = ok & regular
    if problem.fences:  # a fence limits the target on one side only, so the rows must determine it
        regular &= np.isfinite(unfenced(problem, x, covariance).covariance).all((-1, -2))
    local = _local_covariance(problem, equations, covariance)
    return Curvature(covariance, information, regular, weakest, active, local, free=free, shift=shift)


def _without_bounds(
    problem: Problem, equalities: Face, x: Array, information: Array, vector: Array
) -> tuple[Array, Array]:
    """Return covariance (N, n, n), and mean minus x (N, n), of the quadratic model with equalities but without bounds.

    `information` (N, n, n) and `vector` (N, n), half the downhill gradient of the cost, are the model at x. If the data
    and the equalities leave a direction undetermined, the result is NaN.
    """
    if equalities:
        covariance, regular = linalg.inverse_within(information, tangent_at(problem, equalities, x))
    else:
        covariance, regular = linalg.inverse(information)
    regular &= smallest_pivot(information) >= WEAK if not equalities else True
    covariance = np.where(regular[:, None, None], covariance, np.nan)
    return covariance, (covariance @ vector[..., None])[..., 0]


def _local_covariance(problem: Problem, equations: Normal, shared: Array) -> Array | None:
    """Return the covariance (N, k, p, p) of the states of targets and walks at each epoch, or None without such states.

    `shared` (N, n, n) is the covariance of the shared unknowns.
    """
    names = {name for i, m in enumerate(problem.motions) for name in state_names(i, len(problem.motions), m.order)}
    names |= set(walk_names(problem))
    # these states come first in the layout
    size = sum(slot.size for slot in problem.layout.local if slot.name in names)
    with np.errstate(all="ignore"):
        return local_covariance(equations, shared, size) if size else None


def _multipliers(problem: Problem, face: Face, x: Array, vector: Array) -> Array:
    """Return the active constraints of each problem (N,), tuples of `Active` with Lagrange multipliers.

    The multipliers meet: gradient of the cost + sum of multiplier * gradient of the constraint = 0. `face` are the
    constraints that are satisfied with equality. `vector` (N, n) is half the downhill gradient of the cost.
    """
    _, gradients = levels(problem, face, x)
    names = face_names(problem, face)
    out = np.empty(len(x), dtype=object)
    for i in range(len(x)):
        out[i] = ()
        if np.isfinite(gradients[i]).all() and np.isfinite(vector[i]).all():
            # The vector of the normal equations is half the gradient of the cost, hence the factor 2. Least squares,
            # since constraints need not balance the gradient exactly.
            values = np.linalg.lstsq(gradients[i].T, 2.0 * vector[i], rcond=None)[0]
            out[i] = tuple(Active(name, float(value)) for name, value in zip(names, values, strict=True))
    return out


def smallest_pivot(information: Array) -> Array:
    """Return the smallest squared pivot (N,) of the information (N, n, n), scaled to a unit diagonal; 0 if singular."""
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        # a unit diagonal makes metres, seconds and radians comparable
        scale = 1.0 / np.sqrt(diagonal)
        lower, ok = linalg.factor(information * scale[..., :, None] * scale[..., None, :])
        pivots = np.diagonal(lower, axis1=-2, axis2=-1).min(-1, initial=1.0) ** 2
    return np.where(ok & np.isfinite(pivots), pivots, 0.0)


def weak_direction(problem: Problem, information: Array) -> str:
    """Return a sentence that names the combination of unknowns that the data do not determine.

    `information` (n, n) belongs to one problem.
    """
    diagonal = np.diagonal(information)
    if not np.isfinite(information).all():
        return "the information is not finite"
    labels = problem.layout.labels()
    dead = np.flatnonzero(diagonal <= _DEAD)
    if len(dead):
        return "no measurement depends on " + ", ".join(labels[i] for i in dead)
    scale = 1.0 / np.sqrt(diagonal)
    _, vectors = np.linalg.eigh(information * scale[:, None] * scale[None])
    direction = vectors[:, 0] * scale
    direction = direction / np.abs(direction).max()
    terms = [f"{value:+.2g} {labels[i]}" for i, value in enumerate(direction) if abs(value) > _TELLING]
    return "the data do not determine the direction " + " ".join(terms)


def _corners(problem: Problem) -> Array:
    """Return vectors (N, q, size) with the position at the q corners of a box around the stations."""
    centre, spread = spread_of(problem)
    corners = _AWAY * np.array(list(product((-1.0, 1.0), repeat=problem.dimension)))
    places = centre[:, None] + spread[:, None, None] * corners
    return vectors(problem, np.broadcast_to(places, (problem.batch_shape[0], *corners.shape)))


def is_measured(problem: Problem) -> Array:
    """Return flags (N,) of problems whose rows and equalities determine the position around the stations.

    A problem passes if they do so at most corners of a box; False for problems of several positions.
    """
    size = problem.batch_shape[0]
    if not one_position(problem):
        return np.zeros(size, dtype=bool)
    x = _corners(problem)
    item, points = np.repeat(np.arange(size), x.shape[1]), x.reshape(-1, x.shape[-1])
    part = problem.take(item)
    with np.errstate(all="ignore"):
        found = measure_curvature(part, equations_at(part, points), points, np.zeros(len(points), dtype=int))
    assert found.regular is not None
    assert found.weakest is not None
    good = found.regular & (found.weakest >= WEAK)
    return np.asarray(good.reshape(x.shape[:2]).mean(1) > _MOST)


def unmeasured_direction(problem: Problem) -> str:
    """Return a sentence that names the unknowns that no row measures at any position; "" without such unknowns."""
    if not one_position(problem):
        return ""
    x = _corners(problem)[0]
    with np.errstate(all="ignore"):
        information, _, _ = marginal(equations_at(problem.take(np.zeros(len(x), dtype=int)), x))
    dead = np.asarray((np.diagonal(information, axis1=-2, axis2=-1) <= _DEAD).all(0))
    names = np.array(problem.layout.labels())[: len(dead)][dead]
    return "no measurement depends on " + ", ".join(names) if dead.any() else ""


def station_direction(problem: Problem) -> str:
    """Return a sentence on the geometry because of which the stations of one problem cannot determine a position."""
    position = problem.stations.position.reshape(-1, problem.dimension)
    used = sorted({int(s) for rows in problem.rows for s in (*rows.a, *rows.b) if s >= 0})
    places = position[used]
    values, vectors = np.linalg.eigh(np.cov(places.T, bias=True)) if len(used) > 1 else (np.zeros(1), np.eye(1))
    spread = np.sqrt(np.maximum(values, 0.0))
    if spread[-1] <= _POINT * (1.0 + np.abs(places).max()):
        return "all stations are at the same point"
    flat = int((spread < _FLAT * spread[-1]).sum())
    axis = ", ".join(f"{v:.2f}" for v in vectors[:, -1])
    if flat >= problem.dimension - 1 and problem.dimension > 1:
        return f"all stations are on one line along ({axis}); a rotation about this line changes no measurement"
    axis = ", ".join(f"{v:.2f}" for v in vectors[:, 0])
    return f"the measurements leave more than one direction undetermined; the stations spread least along ({axis})"


Equations = Callable[[Problem, Array], Normal]


def settle(problem: Problem, pool: Pool, stage: Stage, equations: Equations = equations_at) -> Pool:
    """Return the pool of the distinct minima of every problem: the best one first, with its curvature.

    Three groups of candidates are dropped. Runs to infinity are dropped if a finite minimum costs about as little;
    their cost is kept. The others are within a tenth of a standard deviation of a candidate, or cost too much to
    matter.

    Parameters
    ----------
    problem : Problem
        N problems.
    pool : Pool
        Their refined candidates.
    stage : Stage
        The refinement stage.
    equations : callable
        Maps (problem, x) to the `Normal` equations at vectors (N, size) of the minimised cost.
    """
    # a wave that travels backwards is not physical
    good = np.isfinite(pool.cost) & ~runs_backwards(problem, pool.x)
    pool = replace(pool, cost=np.where(good, pool.cost, np.inf))
    pool, infinity = _without_runs_to_infinity(problem, pool)
    pool = _sort(pool)
    rows, best = np.arange(len(pool)), _choose(problem, pool)
    x, cost, face = pool.x[rows, best], pool.cost[rows, best], pool.face[rows, best]
    found = np.isfinite(cost)
    with np.errstate(all="ignore"):
        # problems without a candidate are evaluated at zero, to fill the batch; their curvature is not shown
        at = equations(problem, np.where(found[:, None], x, 0.0))
        curvature = measure_curvature(problem, at, x, np.where(found, face, 0))
    slots = _rivals(problem, pool, x, cost, curvature)
    return replace(
        pool,
        x=np.concatenate([np.where(found[:, None], x, np.nan)[:, None], _take_slots(pool.x, slots, np.nan)], axis=1),
        cost=np.concatenate([np.where(found, cost, np.inf)[:, None], _take_slots(pool.cost, slots, np.inf)], axis=1),
        code=np.concatenate(
            [pool.code[rows, best, None], _take_slots(pool.code, slots, Status.UNAVAILABLE)], axis=1, dtype=np.int8
        ),
        face=np.concatenate([face[:, None], _take_slots(pool.face, slots, 0)], axis=1),
        stages=(*pool.stages, stage),
        refined=True,
        curvature=curvature,
        infinity=infinity if np.isfinite(infinity).any() else None,
    )


def _without_runs_to_infinity(problem: Problem, pool: Pool) -> tuple[Pool, Array]:
    """Return the pool without runs to infinity that a finite minimum rivals, and the least cost (N,) of all such runs.

    The cost is NaN without a run to infinity. A rival costs at most `AMBIGUOUS_GAP` more than the run.
    """
    none = np.full(len(pool), np.nan)
    if not problem.layout.shares("position"):
        return pool, none
    distance = distance_of(problem, problem.layout.take(pool.x, "position"))
    with np.errstate(invalid="ignore"):
        # an unfinished point beyond FAR is on its way to infinity; beyond FLAT wave fronts are flat, so finished points
        # count too
        remote = (distance > FLAT) | ((distance > FAR) & (pool.code != Status.OK))
    if not remote.any():
        return pool, none
    near = np.where(~remote & (pool.code == Status.OK), pool.cost, np.inf).min(1)
    far = np.where(remote, pool.cost, np.inf).min(1)
    with np.errstate(invalid="ignore"):
        # the finite minimum is the answer; the verdict uses the cost at infinity
        rivals = np.isfinite(near) & (near - far <= AMBIGUOUS_GAP)
    return replace(pool, cost=np.where(remote & rivals[:, None], np.inf, pool.cost)), np.where(
        np.isfinite(far), far, np.nan
    )


def _sort(pool: Pool) -> Pool:
    """Return the pool with the candidates of every problem in ascending order of cost."""
    if pool.cost.shape[1] == 1:
        return pool
    order = np.argsort(pool.cost, axis=1, kind="stable")
    cost, code, face = (np.take_along_axis(a, order, axis=1) for a in (pool.cost, pool.code, pool.face))
    return replace(pool, x=np.take_along_axis(pool.x, order[..., None], axis=1), cost=cost, code=code, face=face)


def _choose(problem: Problem, pool: Pool) -> Array:
    """Return the slot (N,) of the answer: the cheapest candidate, or the likeliest of finished ones with equal costs.

    The candidates must be in ascending order of cost. Rounding, which differs between processors, must not choose
    between equal costs.
    """
    finished, least = pool.code == Status.OK, pool.cost[:, :1]
    with np.errstate(invalid="ignore"):
        near = finished & (pool.cost <= least + equal_cost(np.abs(least)))
    best = np.where(near.any(1), near.argmax(1), 0)
    tied, slot = np.nonzero(near & (near.sum(1) > 1)[:, None])
    if len(tied) and problem.layout.shares("position"):
        first, second = np.full((2, *pool.cost.shape), -np.inf)
        first[tied, slot], second[tied, slot] = likelihood_of(problem.take(tied), pool.x[tied, slot])
        second[first < first.max(1)[:, None]] = -np.inf
        best[tied] = second[tied].argmax(1)
    return best


def likelihood_of(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Return two numbers (N,) that rank vectors (N, size) of equal cost by their positions: larger is likelier.

    The first number on Earth is the lowest elevation from a station, elsewhere the nearness to the stations. The second
    number is the last coordinate: it chooses the upper one of two mirror images. The first number is rounded, so that
    rounding errors do not rank equal positions.
    """
    place = problem.layout.take(x, "position")
    if problem.frame.geodetic:
        first = lowest_sight(problem, x)  # sines of elevations
    else:
        # only stations with rows count, so that an unused station changes nothing
        with np.errstate(divide="ignore", over="ignore"):
            first = -0.5 * np.log(((place - centre_of(problem)) ** 2).sum(-1))
    return np.round(first, 6), place[:, -1]


def _rivals(problem: Problem, pool: Pool, x: Array, cost: Array, curvature: Curvature) -> Array:
    """Return the slots (N, r) of the other finished minima within the listed gap, cheapest first; -1 for empty slots.

    `x` (N, size) and `cost` (N,) are the best minima. Each minimum is listed once. For a run all minima are listed at
    any cost: they are few, and users need to know by how much the data exclude them.
    """
    n, limit = problem.layout.n_shared, np.inf if problem.epochs > 1 else LISTED_GAP
    with np.errstate(invalid="ignore"):
        gap = np.where(pool.code == Status.OK, pool.cost - cost[:, None], np.inf)
    gap = np.where(np.isfinite(gap) & (gap < limit), gap, np.inf)
    kept: list[tuple[Array, Array]] = [(x[:, :n], np.ones(len(x), dtype=bool))]
    slots = np.full(gap.shape, np.inf)
    for slot in np.flatnonzero(np.isfinite(gap).any(0)):
        new = np.isfinite(gap[:, slot])
        for other, present in kept:
            new &= ~_is_same_place(pool.x[:, slot, :n], other, curvature) | ~present
        if new.any():
            kept.append((pool.x[:, slot, :n], new))
            slots[:, slot] = np.where(new, gap[:, slot], np.inf)
    order = np.argsort(slots, axis=1, kind="stable")[:, : int(np.isfinite(slots).sum(1).max(initial=0))]
    return np.where(np.isfinite(np.take_along_axis(slots, order, axis=1)), order, -1)


def _take_slots(values: Array, slots: Array, empty: float) -> Array:
    """Return values (N, q, ...) at slots (N, r); `empty` where the slot is -1."""
    extra = (1,) * (values.ndim - 2)
    index = slots.reshape(*slots.shape, *extra)
    return np.where(index < 0, empty, np.take_along_axis(values, np.maximum(index, 0), axis=1))


def _is_same_place(x: Array, y: Array, curvature: Curvature) -> Array:
    """Return flags (N,) of points x and y (N, n) that are equal, or closer than 0.1 standard deviations."""
    difference = x - y
    with np.errstate(all="ignore"):  # a point that constraints determine has no spread
        squared = (difference[:, None, :] @ curvature.information @ difference[..., None])[:, 0, 0]
        spread = np.trace(curvature.covariance, axis1=-2, axis2=-1)  # constraints leave directions without information
        squared = np.maximum(squared, (difference**2).sum(-1) / spread)
        equal = (np.abs(difference) <= 1e-9 * (1.0 + np.abs(x))).all(-1)  # rounding of one point
    return np.asarray(equal | (squared < SAME_PLACE))
