"""Functions with which users state constraints on heights, sights, motions and pairs of targets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from optloc.base.errors import InvalidProblem
from optloc.base.types import Amount, Array, Band, Motion
from optloc.base.units import in_si
from optloc.linear.constraints.arguments import check_order, float_array, least_of, metres, rate_of

# Standard gravity, m/s^2: exact by definition (CGPM 1901).
_GRAVITY = 9.80665


def box(
    lower: Sequence[Amount] | Array, upper: Sequence[Amount] | Array, *, target: int = 0, name: str = ""
) -> tuple[Band, ...]:
    """Return the constraint that a target is in a box; an infinite bound means no bound.

    Parameters
    ----------
    lower, upper : sequence of d float or str
        Least and greatest coordinates in the problem's frame: metres, or text such as "2 km".
    target : int
        Number of the target.
    name : str
        Name in reports, before the name of the axis.
    """
    d = len(lower)
    if d != len(upper) or d > len("xyz"):
        what = f"the box has {d} lower and {len(upper)} upper limits"
        raise InvalidProblem(what, name or "box", "give two or three of each, infinite for none")
    return tuple(
        Band("plane", metres(low, "box"), metres(high, "box"), np.eye(d)[i], f"{name} {'xyz'[i]}".strip(), target)
        for i, (low, high) in enumerate(zip(lower, upper, strict=True))
    )


def height(
    lower: Amount | Array = -np.inf,
    upper: Amount | Array = np.inf,
    *,
    exactly: Amount | Array | None = None,
    target: int = 0,
    along: bool = True,
    name: str = "height",
) -> tuple[Band, ...]:
    """Return the constraint on a target's height above the WGS 84 ellipsoid: a band, or one exact value.

    A straight course departs from a height above the curved Earth. So a moving target needs
    ``Motion(order, over="ground")``, see also `reported`.

    Parameters
    ----------
    lower, upper : float or str
        Band, metres or text such as "1640 ft"; `lower` = 0 is "above ground".
    exactly : float, str or array (...), optional
        Known height, instead of a band.
    target : int
        Number of the target.
    along : bool
        Whether the constraint applies at every epoch, or only at the reference time.
    name : str
        Name in reports.
    """
    low, high = (lower, upper) if exactly is None else (exactly, exactly)
    low, high = metres(low, "height"), metres(high, "height")
    return (Band("height", low, high, np.zeros(0), name, target, along),)


def reported(
    heights: ArrayLike,
    times: ArrayLike,
    *,
    within: Amount = 0.0,
    order: int = 1,
    reference: float | None = None,
    target: int = 0,
    name: str = "height",
) -> tuple[Motion, tuple[Band, ...]]:
    """Return motion and constraint of a target whose height is known at every epoch.

    An example is an aircraft that reports its height. The course over ground is a polynomial of the given order. Its
    height at each epoch is the reported height plus a polynomial of time, which the constraint bounds: it is zero if
    `within` is zero.

    Parameters
    ----------
    heights : array (..., k)
        Heights above the WGS 84 ellipsoid at each epoch, metres.
    times : array (k,)
        Times of the epochs, seconds, ascending.
    within : float or str
        Half the width of the band about the reported height: metres, or text such as "50 ft"; 0: the height is exact.
    order : 1 or 2
        Order of the motion over ground: 1 for a constant velocity, 2 for a constant acceleration.
    reference : float, optional
        Time to which the state belongs, seconds; the first epoch by default.
    target : int
        Number of the target.
    name : str
        Name in reports.

    Returns
    -------
    Motion
        Motion over ground. Its field `rise` (..., k, 2) contains the heights relative to the height at the reference
        time, metres, and their rates, m/s.
    tuple of Band
        The height at the reference time, and therefore at every epoch.

    Raises
    ------
    InvalidProblem
        If the number of heights differs from the number of times, or times are not ascending.
    """
    heights, times = np.asarray(heights, dtype=float), np.asarray(times, dtype=float)
    if times.ndim != 1 or heights.shape[-1:] != times.shape or not (np.diff(times) > 0.0).all():
        what = f"heights of shape {heights.shape} for times of shape {times.shape}"
        raise InvalidProblem(what, "reported heights", "give one height for each epoch, and ascending times")
    # height at the reference time: linear between epochs `before` and `before` + 1, outside the times constant
    last = len(times) - 1
    place = float(np.interp(times[0] if reference is None else reference, times, np.arange(last + 1.0)))
    before = min(int(place), last)
    share = place - before
    at_reference = heights[..., before] * (1.0 - share) + heights[..., min(before + 1, last)] * share
    rate = np.gradient(heights, times, axis=-1) if last else np.zeros_like(heights)
    half = float(metres(within, "within"))
    rise = np.stack([heights - at_reference[..., None], rate], axis=-1)
    motion = Motion(order, reference=reference, over="ground", rise=rise)
    return motion, height(at_reference - half, at_reference + half, target=target, name=name)


def visible(
    points: ArrayLike, *, elevation: Amount = 0.0, target: int = 0, name: str = "sight of point"
) -> tuple[Band, ...]:
    """Return the constraint that points, for instance satellites, are above the target's horizon.

    Parameters
    ----------
    points : array (v, 3)
        ECEF, metres.
    elevation : float or str
        Least elevation: radians, or text such as "5 deg".
    target : int
        Number of the target.
    name : str
        Name in reports, before the number of the point.
    """
    # The bounded quantity is the sine, see `optloc.models.surfaces`, which increases with the elevation.
    least = float_array(np.sin(in_si(elevation, "angle", "elevation")))
    return tuple(
        Band("visible", least, float_array(np.inf), point, f"{name} {i}", target)
        for i, point in enumerate(np.asarray(points, dtype=float))
    )


def speed(
    upper: Amount, *, lower: Amount = 0.0, target: int = 0, along: bool = False, name: str = "speed"
) -> tuple[Band, ...]:
    """Return the constraint on a target's speed: metres per second, or text such as "90 km/h".

    Parameters
    ----------
    upper, lower : float or str
        Greatest and least speed. A lower limit of zero has no effect.
    target : int
        Number of the target.
    along : bool
        Whether the limits apply at all times of the run, or only at the reference time. They differ for a course with
        an acceleration. The greatest speed is then at an end of the run; the least one has a closed form.
    name : str
        Name in reports.
    """
    most, least = float(in_si(upper, "speed", name)), float(in_si(lower, "speed", name))
    check_order(least, most, name, "m/s")
    low = least_of(least)
    if not along:
        return (Band("speed", low, float_array(most), np.zeros(0), name, target),)
    greatest = Band("speed", float_array(-np.inf), float_array(most), np.zeros(0), name, target, along=True)
    if least <= 0.0:
        return (greatest,)
    return (greatest, Band("least speed", low, float_array(np.inf), np.zeros(0), f"least {name}", target))


def acceleration(upper: Amount, *, target: int = 0, name: str = "acceleration") -> tuple[Band, ...]:
    """Return the constraint on the acceleration of a target with a course of order 2.

    Parameters
    ----------
    upper : float or str
        Greatest absolute acceleration: metres per second squared, or text such as "2 m/s^2" or "0.3 g".
    target : int
        Number of the target.
    name : str
        Name in reports.
    """
    most = rate_of(upper, name, {"m/s^2": 1.0, "g": _GRAVITY})
    if not most > 0.0:
        raise InvalidProblem(f"the greatest acceleration is {most:g} m/s^2", name, "give a positive number")
    return (Band("acceleration", float_array(-np.inf), float_array(most), np.zeros(0), name, target),)


def turn_rate(
    upper: Amount, *, lower: Amount | None = None, target: int = 0, name: str = "turn rate"
) -> tuple[Band, ...]:
    """Return the constraint on the turn rate in the plan of a target with a course of order 2, at all times of its run.

    Parameters
    ----------
    upper : float or str
        Greatest turn rate, anticlockwise: radians per second, or text such as "3 deg/s".
    lower : float or str, optional
        Least turn rate, negative for turns clockwise; ``-upper`` by default.
    target : int
        Number of the target.
    name : str
        Name in reports.
    """
    units = {"rad/s": 1.0, "deg/s": np.pi / 180.0}
    most = rate_of(upper, name, units)
    least = -most if lower is None else rate_of(lower, name, units)
    check_order(least, most, name, "rad/s")
    if least > 0.0 or most < 0.0:
        # the bounds are on the turn rate of greatest absolute value, which says nothing about the least one
        what = f"turn rates from {least:g} to {most:g} rad/s leave out a straight course"
        raise InvalidProblem(what, name, "give a lower limit of at most zero and an upper limit of at least zero")
    return (Band("turn_rate", float_array(least), float_array(most), np.zeros(0), name, target),)


def separation(
    first: int,
    second: int,
    lower: Amount = 0.0,
    upper: Amount = np.inf,
    *,
    along: bool = True,
    name: str = "separation",
) -> tuple[Band, ...]:
    """Return the constraint on the distance between two targets.

    Parameters
    ----------
    first, second : int
        Numbers of the targets.
    lower, upper : float or str
        Least and greatest distance, metres or text such as "5 nmi"; equal for a known distance.
    along : bool
        Whether the limits apply at all times of the run, or only at the reference time. They differ if a target moves;
        then both need constant velocities.
    name : str
        Name in reports.
    """
    if first == second:
        raise InvalidProblem(f"target {first} has no distance from itself", name, "name two different targets")
    least, most = float(metres(lower, name)), float(metres(upper, name))
    check_order(least, most, name, "m")
    if most <= 0.0:
        raise InvalidProblem("the greatest distance is not positive", name, "give a positive number of metres")
    low, high = least_of(least), float_array(most)
    none, free = np.zeros(0), float_array(np.inf)
    if not along or least == most:
        return (Band("separation", low, high, none, name, first, along=along, other=second),)
    found = [Band("separation", -free, high, none, name, first, along=True, other=second)] if most < np.inf else []
    if least > 0.0:
        found.append(Band("least separation", low, free, none, f"least {name}" if found else name, first, other=second))
    return tuple(found)
