"""By how much vectors violate the constraints of a problem. Letters: N vectors x, `size` unknowns in a vector."""

from __future__ import annotations

import numpy as np

from optloc.base.types import AnyOf, Array, Band, Constraint, Polygon
from optloc.linear.constraints.polygons import is_inside, polygon_violation
from optloc.linear.constraints.quantities import decisive_epochs, value_at
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem

# Relative violation of a constraint that is accepted; a micrometre if the bound is zero. This is above the rounding of
# coordinates of the Earth's size (a nanometre), and below the error of any measurement.
TOLERANCE = 1e-6


def violation(problem: Problem, x: Array) -> Array:
    """Return the violation (N,) of the worst constraint at vectors x (N, size); 0 if all constraints are satisfied.

    The violation is divided by one plus the absolute bound, or for a polygon by one plus its greatest coordinate. For a
    union, it is the violation of the least violated member.
    """
    worst = np.zeros(len(x))
    for c in problem.constraints:
        worst = np.maximum(worst, violation_of(problem, c, x))
    return worst


def violation_of(problem: Problem, constraint: Constraint, x: Array) -> Array:
    """Return the violation (N,) of one constraint at vectors x (N, size); negative or zero if it is satisfied."""
    if isinstance(constraint, Polygon):
        return polygon_violation(constraint, plan_positions(problem, constraint.target, x))
    if isinstance(constraint, AnyOf):
        return np.asarray(np.min([member_violation(problem, member, x) for member in constraint.members], axis=0))
    return member_violation(problem, (constraint,), x)


def member_violation(problem: Problem, member: tuple[Band, ...], x: Array) -> Array:
    """Return the violation (N,) of the worst band of a conjunction at vectors x (N, size); negative if satisfied."""
    worst = np.full(len(x), -np.inf)
    with np.errstate(all="ignore"):
        for band in member:
            for epoch in decisive_epochs(problem, band):
                worst = np.maximum(worst, _band_violation(band, value_at(problem, band, x, epoch)))
    return worst


def _band_violation(band: Band, value: Array) -> Array:
    """Return the violation (N,) of the worse bound, divided by one plus the absolute bound; negative if satisfied."""
    worst = np.full(len(value), -np.inf)
    for bound, sign in ((band.lower, 1.0), (band.upper, -1.0)):
        with np.errstate(invalid="ignore"):
            lacking = np.where(np.isfinite(bound), sign * (bound - value), -np.inf)
        # One measure for metres of a height and sines of an elevation: relative to the bound, absolute near zero.
        size = 1.0 + np.where(np.isfinite(bound), np.abs(bound), 0.0)
        worst = np.maximum(worst, lacking / size)
    return worst


def is_admitted(problem: Problem, x: Array) -> Array:
    """Return flags (N,) of vectors x (N, size) that satisfy all constraints, within the accepted violation.

    At the boundary of a polygon there is no such allowance, which would take most of the time.
    """
    out = np.ones(len(x), dtype=bool)
    for c in problem.constraints:
        if isinstance(c, Polygon):
            out &= is_inside(c, plan_positions(problem, c.target, x)) != c.outside
        else:
            out &= violation_of(problem, c, x) <= TOLERANCE
    return out


def violation_names(problem: Problem) -> str:
    """Return the names of all constraints, for messages."""
    return ", ".join(dict.fromkeys(c.name for c in problem.constraints))


def plan_positions(problem: Problem, target: int, x: Array) -> Array:
    """Return the plan positions (N, 2) of a target in vectors x (N, size), metres."""
    slot, _ = problem.layout.find(state_names(target, len(problem.motions), 0)[0])
    return x[:, slot.start : slot.start + 2]
