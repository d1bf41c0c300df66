"""Models of motion by name: `cv`, `ca`, `static`, `singer` and `csm`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from optloc.base.errors import InvalidProblem, nearest
from optloc.tracking.dynamics import Dynamics, current_statistical, polynomial, singer


@dataclass(frozen=True, slots=True)
class MotionModel:
    """A named model of motion.

    Parameters
    ----------
    noise : float
        Default standard deviation of the driving noise, SI units.
    summary : str
        One line for listings.
    make : callable
        Function of the standard deviation of the noise and the duration of accelerations in seconds; returns
        `Dynamics`.
    """

    noise: float
    summary: str
    make: Callable[[float, float], Dynamics]


# Values for ordinary traffic, which brakes and turns by 1 m/s^2. The noise of csm is the largest acceleration, about 1
# g.
MOTIONS = {
    "cv": MotionModel(1.0, "constant velocity, driven by an acceleration", lambda noise, _: polynomial(1, noise)),
    "ca": MotionModel(1.0, "constant acceleration, driven by a jerk", lambda noise, _: polynomial(2, noise)),
    "static": MotionModel(0.0, "a static target, driven by a velocity", lambda noise, _: polynomial(0, noise)),
    "singer": MotionModel(1.0, "Singer: a correlated acceleration", lambda noise, memory: singer(memory, noise)),
    "csm": MotionModel(
        10.0,
        "current statistical: Singer about the present acceleration; the noise is the largest acceleration",
        lambda noise, memory: current_statistical(memory, noise),
    ),
}
"""Models of motion by name."""


def motion_named(name: str, noise: float | None = None, memory: float = 10.0, where: str = "model") -> Dynamics:
    """Return a model of motion by name.

    Parameters
    ----------
    name : str
        See `MOTIONS`.
    noise : float, optional
        Standard deviation of the driving noise, SI units; default from `MOTIONS`.
    memory : float
        Duration of an acceleration in seconds (``singer`` and ``csm``).
    where : str
        Name of the argument for error messages.

    Raises
    ------
    InvalidProblem
        If the name is unknown.
    """
    if name not in MOTIONS:
        raise InvalidProblem(f"unknown model {name!r}", where, nearest(name, list(MOTIONS)))
    motion = MOTIONS[name]
    return motion.make(motion.noise if noise is None else noise, memory)
