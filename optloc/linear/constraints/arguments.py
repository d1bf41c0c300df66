"""Arguments of the functions that state constraints: units, shapes and limits."""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.base.units import in_si


def point_of(centre: Any, counts: tuple[int, ...], name: str) -> Array:
    """Return the coordinates of a point, metres; raise for a wrong number of coordinates."""
    point = metres(centre, name)
    if point.ndim != 1 or len(point) not in counts:
        listed = " or ".join(str(count) for count in counts)
        raise InvalidProblem(f"the centre has shape {point.shape}", name, f"give {listed} coordinates")
    if not np.isfinite(point).all():
        raise InvalidProblem("a coordinate of the centre is not finite", name, "give numbers in metres")
    return point


# Least radius, metres: a hundred times the violation of a constraint that is accepted. A smaller region is a point, and
# along its boundary no descent makes progress.
_LEAST_RADIUS = 1e-4


def radius_of(radius: Any, name: str) -> float:
    """Return a radius in metres; raise if it is not positive, or so small that the region is a point."""
    size = float(metres(radius, name))
    if not 0.0 < size < np.inf:
        raise InvalidProblem(f"the radius is {size:g} m", name, "give a positive number of metres")
    if size < _LEAST_RADIUS:
        advice = f"give at least {_LEAST_RADIUS:g} m, or for a known point a box with equal limits"
        raise InvalidProblem(f"the radius is {size:g} m, so that the region is a point", name, advice)
    return size


def direction_of(normal: Any, name: str) -> tuple[Array, float]:
    """Return a normal scaled to unit length (d,), and its length before."""
    vector = numbers_of(normal, name)
    if vector.ndim != 1 or len(vector) not in (2, 3):
        raise InvalidProblem(f"the normal has shape {vector.shape}", name, "give one number for each coordinate")
    length = float(np.sqrt((vector**2).sum()))
    if not 0.0 < length < np.inf:
        raise InvalidProblem("the normal has no direction", name, "give finite numbers that are not all zero")
    return vector / length, length


def check_order(lower: float, upper: float, name: str, unit: str) -> None:
    """Raise if no value is between two limits."""
    if np.isnan(lower) or np.isnan(upper):
        raise InvalidProblem("a limit is not a number", name, "give a number, or leave the limit out")
    if lower > upper:
        what = f"it must be at least {lower:.10g} {unit} and at most {upper:.10g} {unit}"
        raise InvalidProblem(what, name, "correct the limits, they contradict each other")


def least_of(value: float) -> Array:
    """Return a least distance or speed; zero or less is no limit, and at zero the gradient does not exist."""
    return float_array(value if value > 0.0 else -np.inf)


def numbers_of(values: Any, name: str) -> Array:
    """Return an array of floats; raise InvalidProblem for anything else."""
    try:
        return np.asarray(in_si(values, "length", name, place=True), dtype=float)
    except (TypeError, ValueError) as error:
        if isinstance(error, InvalidProblem):
            raise
        raise InvalidProblem("not all entries are numbers", name, "give numbers of one shape") from None


def rate_of(value: Any, name: str, units: dict[str, float]) -> float:
    """Return a rate in SI units, from a number or a text with one of `units`, such as "3 deg/s"."""
    if not isinstance(value, str):
        return float(value)
    for unit, factor in units.items():
        number = value.strip().removesuffix(unit)
        if number != value.strip():
            try:
                return float(number) * factor
            except ValueError:
                break
    raise InvalidProblem(f"{value!r} is no number with a unit", name, f"use one of {', '.join(units)}")


def float_array(value: Any) -> Array:
    """Return a value as an array of floats."""
    return np.asarray(value, dtype=float)


def metres(value: Any, where: str) -> Array:
    """Return a length in metres, from a number or a text with a unit."""
    return float_array(in_si(value, "length", where, place=True))
