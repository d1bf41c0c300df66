"""Positions of targets along their courses, in the frame of a problem: polynomials in space, or courses over ground.

A *course over ground* follows the curved Earth; its height is a polynomial of time plus a known *rise*. `since` is the
time since the reference time of the state, seconds.
"""

from __future__ import annotations

from math import factorial
from typing import Any

import numpy as np

from optloc.base.types import Array
from optloc.models.course import carry
from optloc.models.primitives import Components, Jet, dot, geodetic_height, geodetic_normal, subtract
from optloc.problem.problem import Problem


def over_ground(problem: Problem) -> bool:
    """Return whether the moving targets of a problem follow the curved Earth; either all of them do, or none."""
    return any(motion.over == "ground" for motion in problem.motions)


def elapsed(problem: Problem, target: int) -> Array:
    """Return the seconds (k,) from the reference time of a target's state to each epoch.

    They are zero if each epoch has its own state.
    """
    motion = problem.motions[target]
    if motion.span == "epoch":
        return np.zeros(problem.epochs)
    # The default is the first epoch, so that later epochs do not change the meaning of a state.
    reference = problem.times[0] if motion.reference is None else motion.reference
    return np.asarray(problem.times - reference)


def to_ecef(problem: Problem, position: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return a position (3 components) in the problem's frame as ECEF components of the same type, metres."""
    # Written with scalar factors, because components may be jets or symbols, which do not support matrices.
    turn, origin = problem.frame.rotation_to_ecef(), problem.frame.origin_ecef()
    if problem.frame.kind == "ecef":
        return position
    return tuple(
        sum((float(turn[i, c]) * position[c] for c in range(1, 3)), float(turn[i, 0]) * position[0]) + float(origin[i])
        for i in range(3)
    )


def from_ecef_axes(problem: Problem, vector: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return a vector of ECEF components in the axes of the problem's frame."""
    turn = problem.frame.rotation_to_ecef()
    if problem.frame.kind == "ecef":
        return vector
    return tuple(
        sum((float(turn[i, c]) * vector[i] for i in range(1, 3)), float(turn[0, c]) * vector[0]) for c in range(3)
    )


def place_and_rate(
    problem: Problem,
    start: Components,
    straight: Components,
    rate: Components | None = None,
    rise: tuple[Any, Any] = (0.0, 0.0),
) -> tuple[Components, Components | None]:
    """Return position and rate on a course over ground, in the problem's frame.

    Parameters
    ----------
    problem : Problem
        Problem in a geodetic frame.
    start : tuple of 3 numbers
        Position at the reference time, metres.
    straight : tuple of 3 numbers
        Position to which the same state leads in space, metres.
    rate : tuple of 3 numbers, optional
        Rate at `straight`, metres per second.
    rise : pair of numbers
        Height above its polynomial, metres, and its rate, metres per second.
    """
    if rate is None:
        return _from_ecef(problem, carry(to_ecef(problem, start), to_ecef(problem, straight), rise[0])), None
    # the derivative by time is one more partial derivative: all numbers, also constants, become jets of it
    begun = tuple(Jet(p, {}) for p in start)
    led = tuple(Jet(p, {0: v}) for p, v in zip(straight, rate, strict=True))
    place = carry(to_ecef(problem, begun), to_ecef(problem, led), Jet(rise[0], {0: rise[1]}))
    found = _from_ecef(problem, place)
    return tuple(jet.value for jet in found), tuple(jet.partials[0] for jet in found)


def course_at(problem: Problem, target: int, states: list[Components], since: Any, rise: Any = 0.0) -> Components:
    """Return the position of a target `since` seconds after its reference time, metres.

    Parameters
    ----------
    problem : Problem
        Problem with the motion of the target.
    target : int
        Number of the target.
    states : list of tuples of d numbers
        Position, velocity and acceleration, as far as the target has them: arrays, jets or symbols.
    since : float or array
        Seconds.
    rise : float or array
        Height above its polynomial, metres; by default zero.
    """
    place = _straight(states, since)
    return (
        place_and_rate(problem, states[0], place, rise=(rise, 0.0))[0]
        if problem.motions[target].over == "ground"
        else place
    )


def height_at(problem: Problem, states: list[Components], since: float) -> Any:
    """Return the height on a course over ground `since` seconds after the reference time, less its rise, metres.

    `optloc.models.course.carry` keeps to this height: the height of the start, plus the upward part of the straight
    way.
    """
    start = to_ecef(problem, states[0])
    ahead = to_ecef(problem, _straight(states, since))
    return geodetic_height(start) + dot(subtract(ahead, start), geodetic_normal(start))


def _straight(states: list[Components], since: Any) -> Components:
    """Return the position to which the states (position, velocity, acceleration) lead on a straight course, metres."""
    place = states[0]
    for j, state in enumerate(states[1:], 1):
        place = tuple(p + since**j / factorial(j) * v for p, v in zip(place, state, strict=True))
    return place


def _from_ecef(problem: Problem, ecef: Components) -> Components:
    """Return ECEF components as a position in the problem's frame, metres."""
    turn, origin = problem.frame.rotation_to_ecef(), problem.frame.origin_ecef()
    if problem.frame.kind == "ecef":
        return ecef
    off = tuple(e - float(o) for e, o in zip(ecef, origin, strict=True))
    return tuple(sum((float(turn[i, c]) * off[i] for i in (1, 2)), float(turn[0, c]) * off[0]) for c in range(3))
