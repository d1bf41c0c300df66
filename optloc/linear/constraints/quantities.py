"""The bounded quantities of constraints at vectors: their values, their derivatives, and the epochs that decide.

Letters: N vectors x, d coordinates. A *band* is a constraint ``lower <= g(x) <= upper``; its *quantity* is g.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import AnyOf, Array, Band, Constraint
from optloc.linear.courses import course_at, elapsed, height_at, to_ecef
from optloc.models.primitives import Components, Jet, Point
from optloc.models.surfaces import SURFACES
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem


def is_exact(constraint: Constraint) -> bool:
    """Return whether a constraint is an equality."""
    return isinstance(constraint, Band) and bool(np.all(constraint.lower == constraint.upper))


def needs_velocity(constraint: Constraint) -> bool:
    """Return whether a constraint bounds the velocity of its target."""
    return any(not SURFACES[band.kind].places for band in bands_of(constraint))


def bands_of(constraint: Constraint) -> tuple[Band, ...]:
    """Return the bands that a constraint contains: itself, the bands of all members, or none for a polygon."""
    if isinstance(constraint, Band):
        return (constraint,)
    return tuple(band for member in constraint.members for band in member) if isinstance(constraint, AnyOf) else ()


def for_target(constraint: Constraint, target: int) -> Constraint:
    """Return the same constraint on the target with another number."""
    if isinstance(constraint, AnyOf):
        members = tuple(tuple(replace(band, target=target) for band in member) for member in constraint.members)
        return replace(constraint, members=members, target=target)
    return replace(constraint, target=target)


def is_of_one_target(constraint: Constraint) -> bool:
    """Return whether a constraint is about one target, and not about the distance between two."""
    return all(band.other is None for band in bands_of(constraint))


def decisive_epochs(problem: Problem, constraint: Constraint) -> list[int | None]:
    """Return the epochs at which a constraint along a course decides about all epochs; None is the reference time.

    The bounded quantity is a polynomial of time of the motion's order n. An equality at n + 1 epochs makes it constant.
    If n = 1, bounds at the first and the last epoch are enough. The same is true for an upper bound of a quantity that
    is convex in time, as a speed.
    """
    if not isinstance(constraint, Band) or not holds_along(problem, constraint):
        return [None]
    count = 2 if SURFACES[constraint.kind].ends else problem.motions[constraint.target].order + 1
    chosen = np.unique(np.linspace(0, problem.epochs - 1, count).round().astype(int))
    return [int(k) for k in np.argsort(problem.times, kind="stable")[chosen]]


def holds_along(problem: Problem, band: Band) -> bool:
    """Return whether a band bounds a whole course.

    This needs three conditions: the band applies along the course, a target moves, and its state lasts for the run. A
    speed also needs an acceleration, since it is constant otherwise.
    """
    least = 0 if SURFACES[band.kind].places else 1
    targets = [band.target] if band.other is None else [band.target, band.other]
    motions = [problem.motions[target] for target in targets]
    return band.along and any(motion.span == "run" and motion.order > least for motion in motions)


def quantity_at(problem: Problem, band: Band, x: Array, epoch: int | None = None) -> tuple[Jet, dict[int, int]]:
    """Return the bounded quantity (N,) at an epoch with its derivatives, and the column of x for each derivative.

    The second result maps the seed of each derivative to the column. The epoch None is the reference time. `x` (N,
    size) are the vectors.
    """
    columns = dict[int, int]()
    states = _jets(problem, band.target, x, columns)
    others = None if band.other is None else _jets(problem, band.other, x, columns)
    c = band.coefficients
    numbers = tuple(c[..., i] for i in range(c.shape[-1]))
    return bounded(problem, band, states, numbers, epoch, others), columns


def value_at(problem: Problem, band: Band, x: Array, epoch: int | None = None) -> Array:
    """Return the bounded quantity (N,) at an epoch at vectors x (N, size); None is the reference time."""
    numbers = tuple(band.coefficients[..., i] for i in range(band.coefficients.shape[-1]))
    states = [
        None if target is None else [tuple(jet.value for jet in state) for state in _jets(problem, target, x, {})]
        for target in (band.target, band.other)
    ]
    assert states[0] is not None
    # without derivatives, which take most of the time
    value = bounded(problem, band, states[0], numbers, epoch, states[1])
    return np.asarray(np.broadcast_to(value, (len(x),)))


def _jets(problem: Problem, target: int, x: Array, columns: dict[int, int]) -> list[Components]:
    """Return position, velocity and acceleration of a target as jets, as far as it has them.

    The columns of x (N, size) that belong to their seeds are added to `columns`.
    """
    states = []
    for name in state_names(target, len(problem.motions), problem.motions[target].order):
        slot, shared = problem.layout.find(name)
        if not shared:
            raise InvalidProblem(
                "a constraint needs a target whose state lasts the run", "constraints", "solve epoch by epoch"
            )
        first, d = len(columns), problem.dimension
        columns |= {first + i: slot.start + i for i in range(d)}
        states.append(tuple(Jet(x[:, slot.start + i], {first + i: np.ones(1)}) for i in range(d)))
    return states


def bounded(
    problem: Problem,
    band: Band,
    states: Sequence[Any],
    coefficients: tuple[Any, ...],
    epoch: int | None,
    others: Sequence[Any] | None = None,
) -> Any:
    """Return the quantity that a band bounds, less the known rise of a height.

    Parameters
    ----------
    problem : Problem
        Problem with the motion of the target.
    band : Band
        The constraint.
    states : sequence of tuples of d numbers
        Position, velocity and acceleration, as far as the target has them: jets or symbols.
    coefficients : tuple of c numbers
        Coefficients of the band.
    epoch : int, optional
        Epoch along the course; None: the reference time.
    others : sequence of tuples of d numbers, optional
        The states of the second target, for a band with one.
    """
    surface = SURFACES[band.kind]
    since = 0.0 if epoch is None else float(elapsed(problem, band.target)[epoch])
    if epoch is not None and band.kind == "height":
        return height_at(problem, list(states), since)
    point = _point(problem, band.target, states, epoch, surface.ecef)
    if band.kind == "plane":
        # An edge of a polygon is a plane with two coefficients: it bounds the plan position of a target in space.
        point = Point(point.position[: len(coefficients)])
    if others is not None and band.other is not None:
        second = _point(problem, band.other, others, epoch, False)
        point = Point(point.position, point.velocity, ecef=point.ecef, span=point.span, other=second)
    return surface.g(point, coefficients if band.table is None else (*coefficients, band.table))


def _point(problem: Problem, target: int, states: Sequence[Any], epoch: int | None, ecef: bool) -> Point:
    """Return a target at an epoch, with the parts of its state that it has; None is the reference time."""
    times = elapsed(problem, target)
    since = 0.0 if epoch is None else float(times[epoch])
    position = states[0] if epoch is None else course_at(problem, target, list(states), since)
    velocity = states[1] if len(states) > 1 else None
    acceleration = states[2] if len(states) > 2 else None
    if velocity is not None and acceleration is not None and since:
        velocity = tuple(v + since * a for v, a in zip(velocity, acceleration, strict=True))
    span = (float(times.min(initial=0.0)) - since, float(times.max(initial=0.0)) - since)
    place = to_ecef(problem, position) if ecef else None
    return Point(position, velocity, ecef=place, acceleration=acceleration, span=span)
