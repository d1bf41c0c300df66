"""Fixes in layers of constant speed: a refinement in each layer, and minima on the interfaces between layers.

Travel times have a kink, or a jump, at an interface. So each layer is a separate problem. Steps end at its borders, and
along a border the depth is fixed. A point on an interface is a minimum if the cost grows into both layers, or if the
other side costs more. The first case is the condition of Karush, Kuhn and Tucker on each side.

Letters: L layers, M starts or points, N problems, q starts of a problem, `size` numbers of a parameter vector, z the
third coordinate (upward), metres. A *side* is the end of a layer that a point has reached: 1 upper, -1 lower, 0 none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base import linalg
from optloc.base.types import Array, Band, Status
from optloc.kernels.least_squares import Limits, Refined, refine
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import Face, Level, band_at, exact, levels
from optloc.linear.mirror import one_position
from optloc.linear.normal import Normal, marginal
from optloc.models.layers import Layers
from optloc.models.surfaces import SURFACES
from optloc.problem.problem import Problem
from optloc.solvers.policy import equal_cost

# Metres from an interface at which a layer ends: above the rounding of coordinates, and far below what times resolve.
_EDGE = 1e-6
# Metres from the end of a layer within which a refinement has reached the end.
_REACHED = 1e-3
# Candidates of a pool that are tried in every layer, from the first. Closed forms give few places, and in each layer
# the cost has few minima.
_TRIED = 3
# Times that a refinement begins again from a border from which the cost falls inwards.
_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class Strata:
    """The layers of constant speed in which the depth of a target is free.

    Parameters
    ----------
    column : int
        Column of the third coordinate of the target.
    low, high : array (L,)
        Ends of the layers in this coordinate, metres, the uppermost layer first; the last has no lower end.
    """

    column: int
    low: Array
    high: Array

    def layer(self, z: Array) -> Array:
        """Return the number of the layer (...) that contains third coordinates z (...), metres."""
        return np.asarray(np.clip(np.searchsorted(-self.low, -z), 0, len(self.low) - 1))

    def inside(self, z: Array, layer: Array) -> Array:
        """Return third coordinates z (...), metres, moved into given layers (...).

        Their distance from the ends of the layer is at least a quarter of its height.
        """
        low, high = self.low[layer], self.high[layer]
        # the last layer is taken to be as high as all others together
        deep = np.maximum(self.high[0] - self.high[-1], 1.0)
        height = np.where(np.isfinite(low), high - low, 2.0 * deep)
        return np.asarray(np.clip(z, np.where(np.isfinite(low), low + 0.25 * height, -np.inf), high - 0.25 * height))


def strata_of(problem: Problem, face: Face = ()) -> Strata | None:
    """Return the layers for a problem of one position; None without interfaces, or if `face` fixes the depth."""
    medium = problem.medium
    if not isinstance(medium, Layers) or medium.between != "constant" or len(medium.depth) == 1:
        return None
    if not one_position(problem) or any(_holds_depth(problem, level) for level in face):
        return None
    slot, _ = problem.layout.find("position")
    tops = medium.surface - np.array(medium.depth)
    high = tops - np.where(np.arange(len(tops)) > 0, _EDGE, 0.0)
    return Strata(slot.start + 2, np.append(tops[1:] + _EDGE, -np.inf), high)


def _holds_depth(problem: Problem, level: Level) -> bool:
    """Return whether the constraint of a level restricts the third coordinate: a height, or a plane with a z term."""
    band = band_at(problem, level)
    if band.kind == "plane":
        return bool(np.any(band.coefficients[..., 2:] != 0.0))
    # distances in the plan have two or four coefficients
    return SURFACES[band.kind].places and not (
        band.kind in ("distance", "segment") and band.coefficients.shape[-1] in (2, 4)
    )


def in_every_layer(strata: Strata, x: Array) -> Array:
    """Return starts x (N, q, size), followed by the first starts of each problem moved into each layer of `strata`."""
    first, count = x[:, :_TRIED], len(strata.low)
    more = np.repeat(first[:, :, None], count, axis=2)
    more[..., strata.column] = strata.inside(more[..., strata.column], np.arange(count))
    return np.concatenate([x, more.reshape(len(x), -1, x.shape[-1])], axis=1)


def refine_in_layers(
    problem: Problem, strata: Strata, start: Array, item: Array, face: Face, limit: int, *, cross: bool = False
) -> Refined:
    """Return the minima in the layers of starts (M, size), or on the borders of these layers.

    If the cost falls on the other side of a border, a point on the border is not a minimum. Its cost is then infinite,
    and its status `unavailable`.

    Parameters
    ----------
    problem : Problem
        N problems.
    strata : Strata
        Their layers.
    start : array (M, size)
        Starts.
    item : int array (M,)
        Problem of each start.
    face : Face
        Constraints that are satisfied with equality.
    limit : int
        Most steps of each refinement.
    cross : bool
        Whether a point from which the cost falls is moved to the other side, as unfinished, for a further refinement.
    """
    column, layer = strata.column, strata.layer(start[:, strata.column])
    limits = Limits(column, strata.low[layer], strata.high[layer])
    x, steps = start.copy(), np.zeros(len(start), dtype=np.int32)
    cost, status = np.full(len(x), np.inf), np.full(len(x), int(Status.MAX_ITERATIONS), dtype=np.int8)
    active = np.arange(len(x))
    for _ in range(_ROUNDS):
        done = refine(problem, x[active], item=item[active], limit=limit, face=face, limits=limits.take(active))
        x[active], cost[active], status[active] = done.x, done.cost, done.status
        steps[active] += done.iterations
        ended = active[limits.take(active).reached(x[active], _REACHED) != 0]
        if not len(ended):
            break
        end, inwards = _along_border(problem, limits.take(ended), x[ended], item[ended], face, limit)
        x[ended], cost[ended], status[ended] = end
        active = ended[inwards]
        if not len(active):
            break
    else:  # all rounds were used, and some points have not settled
        status[active] = Status.STALLED
    _leave_falling(problem, strata, (x, cost, status), item, cross)
    return Refined(x, cost, status, steps, lambda: equations_at(problem.take(item), x))


def _along_border(
    problem: Problem, limits: Limits, x: Array, item: Array, face: Face, limit: int
) -> tuple[tuple[Array, Array, Array], Array]:
    """Return the minima along the borders next to x (M, size), and flags (M,): the cost falls inwards.

    The minima are vectors (M, size), costs (M,) and statuses (M,). `limits` are the ends of the layers of the points,
    `item` (M,) is the problem of each point, and `limit` is the largest number of steps. `face` are other constraints
    that are satisfied with equality.
    """
    side = limits.reached(x, _REACHED)
    z = np.where(side < 0, limits.low, limits.high)
    part = problem.take(item)
    fixed, border = _with_depth(part, z, face)
    done = refine(fixed, x, limit=limit, face=border)
    pull = _pull(fixed, border, done.x)
    return (done.x, done.cost, done.status), np.asarray((done.status == Status.OK) & (pull * side < 0.0))


def _with_depth(problem: Problem, z: Array, face: Face) -> tuple[Problem, Face]:
    """Return M problems with known third coordinates z (M,), metres, and the face extended by this constraint.

    A refinement on this face moves along a border between layers.
    """
    known = Band("plane", z, z, np.eye(3)[2], "interface")
    return replace(problem, constraints=(*problem.constraints, known)), (
        *face,
        Level(len(problem.constraints), "equal"),
    )


def _pull(problem: Problem, face: Face, x: Array) -> Array:
    """Return the upward force of the cost (M,): minus half its slope in z, per metre, at minima x (M, size).

    The last level of the face must be the constraint on z. The sign says to which side the cost falls.
    """
    gradients = levels(problem, face, x)[1]
    force = marginal(equations_at(problem, x))[1]
    return np.asarray((np.linalg.pinv(np.swapaxes(gradients, -1, -2)) @ force[..., None])[:, -1, 0])


def _leave_falling(
    problem: Problem, strata: Strata, found: tuple[Array, Array, Array], item: Array, cross: bool
) -> None:
    """Drop or move points on an interface from which the cost falls on the other side; choose a side for the others.

    The chosen side has the larger variance of the depth. The slope of the cost away from a kink only narrows the law of
    the depth. So this covariance is not too small on either side.

    Parameters
    ----------
    problem : Problem
        N problems.
    strata : Strata
        Their layers.
    found : tuple of arrays
        Vectors (M, size), costs (M,) and statuses (M,), which are changed.
    item : int array (M,)
        Problem of each vector.
    cross : bool
        Whether points are moved.
    """
    x, cost, status = found
    layer = strata.layer(x[:, strata.column])
    side = Limits(strata.column, strata.low[layer], strata.high[layer]).reached(x, _REACHED)
    neighbour = layer - side
    # the uppermost and the last layer end where no other begins
    rows = np.flatnonzero((side != 0) & (status == Status.OK) & (neighbour >= 0) & (neighbour < len(strata.low)))
    if not len(rows):
        return
    other, part, side = x[rows].copy(), problem.take(item[rows]), side[rows]
    other[:, strata.column] = np.where(side > 0, strata.low[neighbour[rows]], strata.high[neighbour[rows]])
    over, on = equations_at(part, other), equations_at(part, x[rows])
    # the upward force times the side is positive if the cost falls further from the border on the other side
    force, tolerance = marginal(over)[1][:, strata.column], equal_cost(cost[rows])
    falls = (over.cost < cost[rows] - tolerance) | ((over.cost < cost[rows] + tolerance) & (force * side > 0.0))
    cost[rows[falls]] = over.cost[falls] if cross else np.inf
    status[rows[falls]] = Status.MAX_ITERATIONS if cross else Status.UNAVAILABLE
    spreads = []
    for equations in (on, over):
        covariance, ok = linalg.inverse(marginal(equations)[0])
        variance = covariance[:, strata.column, strata.column]
        spreads.append(np.where(ok & np.isfinite(variance), variance, 0.0))
    moved = ~falls & (np.abs(over.cost - cost[rows]) <= tolerance) & (spreads[1] > spreads[0])
    moved |= falls & cross
    x[rows[moved]] = other[moved]


# The law of the depth next to an interface along which rays graze: the slope of the times is zero there, and J'J has no
# information about the depth.

# Metres of the first distance that is tried, and doublings: 100 km are beyond any layer.
_FIRST, _DOUBLINGS = 1.0, 17


def equations_in_layers(problem: Problem, x: Array) -> Normal:
    """Return the normal equations at vectors x (N, size) for their covariances.

    Where rays graze an interface, the standard deviation of the depth is the distance at which the cost is larger by 1.
    """
    at, face = equations_at(problem, x), exact(problem)
    strata = strata_of(problem, face)
    if strata is None:
        return at
    layer = strata.layer(x[:, strata.column])
    limits = Limits(strata.column, strata.low[layer], strata.high[layer])
    covariance, ok = linalg.inverse(marginal(at)[0])
    deep = 2.0 * (strata.high[0] - strata.high[-1])
    with np.errstate(invalid="ignore"):
        known = ok & (covariance[:, strata.column, strata.column] < deep * deep)
    rows = np.flatnonzero(~known & (limits.reached(x, _REACHED) != 0))
    if not len(rows):
        return at
    apart = _rise_of_one(problem.take(rows), limits.take(rows), x[rows], at.cost[rows], face)
    shared = np.array(at.shared)
    shared[rows, strata.column, strata.column] += 1.0 / apart**2
    return replace(at, shared=shared)


def _rise_of_one(problem: Problem, limits: Limits, x: Array, cost: Array, face: Face) -> Array:
    """Return the distance (M,), metres, from a border to the depth at which the least cost is larger by one.

    `cost` (M,) is the cost at x (M, size), `limits` are the ends of the layers, and `face` are the equalities. The
    search ends at the other border of the layer.
    """
    z, side = x[:, limits.column], limits.reached(x, _REACHED)
    longest = np.where(side > 0, z - limits.low, limits.high - z)
    apart, found, before = np.minimum(_FIRST, longest), np.zeros(len(x), dtype=bool), np.zeros(len(x))
    for _ in range(_DOUBLINGS):
        fixed, border = _with_depth(problem, z - side * apart, face)
        done = refine(fixed, x, face=border)
        x, rise = done.x, np.maximum(done.cost - cost, 0.0)
        reached = ~found & (rise >= 1.0)
        # Between two distances the rise is a power of the distance, the second or more. At the first distance `before`
        # is 0, so the power is infinite and the distance does not change.
        with np.errstate(divide="ignore"):
            power = np.maximum(np.log2(np.maximum(rise, 1.0) / before), 2.0)
        apart = np.where(reached, apart * np.maximum(rise, 1.0) ** (-1.0 / power), apart)
        before = rise
        found |= reached | (apart >= longest)
        if found.all():
            break
        apart = np.where(found, apart, np.minimum(2.0 * apart, longest))
    return apart
