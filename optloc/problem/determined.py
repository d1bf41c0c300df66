"""Knowledge of a position in every status: directions, numbers with intervals, and a curve."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.base.types import Array, Status
from optloc.problem.chart import basis
from optloc.problem.problem import Problem

LEVEL = 0.95
"""Probability of all intervals and cones."""


WITHOUT_PLACE = (
    Status.UNBOUNDED,
    Status.STALLED,
    Status.MAX_ITERATIONS,
    Status.SINGULAR_GEOMETRY,
    Status.TOO_FEW_ROWS,
    Status.DISCONNECTED,
    Status.UNAVAILABLE,
    Status.NUMERICAL,
)
"""Statuses whose position is no place: a direction is shown instead."""

# Angle between corners of an arc, radians: 2 degrees are seen at no scale that shows the whole.
_CORNER = np.radians(2.0)


@dataclass(frozen=True, slots=True)
class Quantity:
    """One number that the data determine.

    Parameters
    ----------
    name : str
        For instance "distance from line"; lines and planes are those that all stations are on.
    value : float
        Of the highest likelihood.
    low, high : float
        Ends of its 95 % interval; `high` is infinite where the data do not exclude infinity.
    unit : str
        SI unit.
    """

    name: str
    value: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True, slots=True)
class Direction:
    """A direction with its cone and range, seen from the middle of the stations.

    Parameters
    ----------
    vector : array (d,)
        Unit vector of the highest likelihood, in the frame of the problem.
    azimuth : tuple of float
        Angle from the first level axis towards the second and the ends of its 95 % interval, radians; from east
        towards north in frames on Earth. The ends are not wrapped, and a turn apart where nothing is known.
    elevation : tuple of float
        Angle above the level plane and its ends, radians; empty in the plane.
    half_angles : array (d - 1,)
        Semi-axes of the 95 % cone, radians, the larger first: of the ellipse with the second moments of
        `outline`.
    axes : array (d, d - 1)
        Unit vectors along the semi-axes, in columns.
    outline : array (k, d)
        Unit vectors on the edge of the 95 % cone: in space counter-clockwise as seen from outside, in the plane both
        edges.
    range : tuple of float
        Distance from the middle of the stations and the ends of its 95 % interval, metres; infinite where the data do
        not exclude infinity.
    gap : float
        Cost above the first direction's.
    """

    vector: Array
    azimuth: tuple[float, float, float]
    elevation: tuple[float, ...]
    half_angles: Array
    axes: Array
    outline: Array
    range: tuple[float, float, float]
    gap: float = 0.0

    @property
    def least_range(self) -> float:
        """Return the distance from the middle of the stations, metres, that the target exceeds."""
        return self.range[1]

    @property
    def mixed(self) -> bool:
        """Return whether the range has a far end."""
        return bool(np.isfinite(self.range[2]))

    def covers(self, vectors: Array) -> Array:
        """Return whether vectors (..., d) point into the cone, (...)."""
        return is_in_cone(self.vector, self.outline, vectors)


def is_in_cone(axis: Array, outline: Array, vectors: Array) -> Array:
    """Return whether vectors (..., d) are in the cone about an axis (d,) whose edge goes through an outline (k, d)."""
    rim, flat = angles_off_axis(axis, outline), angles_off_axis(axis, np.asarray(vectors, dtype=float))
    if len(axis) == 2:
        return np.asarray((flat[..., 0] >= rim.min()) & (flat[..., 0] <= rim.max()))
    turn = np.arctan2(rim[:, 1], rim[:, 0])
    rim = rim[np.argsort(turn)]
    last = np.searchsorted(np.sort(turn), np.arctan2(flat[..., 1], flat[..., 0])) % len(rim)
    start, end = rim[last - 1], rim[last]
    along, away = end - start, flat - start
    return np.asarray(along[..., 0] * away[..., 1] - along[..., 1] * away[..., 0] >= 0.0)


def angles_off_axis(axis: Array, vectors: Array) -> Array:
    """Return the angles (..., d - 1) by which vectors (..., d) are off an axis (d,), along two axes across it."""
    unit = vectors / np.sqrt((vectors**2).sum(-1, keepdims=True))
    across = unit @ basis(axis)
    size = np.sqrt((across**2).sum(-1, keepdims=True))
    angle = np.arctan2(size, (unit @ axis)[..., None])
    # next to the axis the angle is its own sine
    return np.asarray(across * np.where(size > 0.0, angle / np.where(size > 0.0, size, 1.0), 1.0))


@dataclass(frozen=True, slots=True)
class Determined:
    """Directions, numbers and a curve that the data determine of one position, at 95 %.

    Parameters
    ----------
    origin : array (d,)
        Middle of the stations that rows are present of, metres: directions and ranges are seen from it.
    level : array (d, d)
        Rows: the axes of azimuth 0 and of a quarter turn and, in space, the upward axis; east, north and up on Earth.
    north : bool
        Whether azimuths count from east towards north, so that they are bearings as well.
    directions : tuple of Direction
        The likeliest first; several where the data fit all of them. Empty where no cone holds the directions.
    quantities : tuple of Quantity
        Numbers with intervals, for instance the distance from a line of stations.
    curve : array (k, d), optional
        Line on which one measurement puts the target, metres.
    curve_name : str
        For instance "hyperbola about A and B".
    words : str
        The reason of the fix.
    axis : array (d,), optional
        Direction of the line, or normal of the plane, that all stations are on and quantities are about.
    outside : bool
        Whether the directions assume a target farther from the middle than all stations: without that any is possible.
    """

    origin: Array
    level: Array
    north: bool = False
    directions: tuple[Direction, ...] = ()
    quantities: tuple[Quantity, ...] = ()
    curve: Array | None = None
    curve_name: str = ""
    words: str = ""
    axis: Array | None = None
    outside: bool = False

    def __bool__(self) -> bool:
        """Return whether there are directions, numbers or a curve."""
        return bool(self.directions or self.quantities) or self.curve is not None

    def wedge(self, one: Direction, reach: float, *, whole: bool = False) -> Array:
        """Return the plan of a cone from its least to its greatest range, a closed line (k, d), metres, anticlockwise.

        Parameters
        ----------
        one : Direction
            Of these.
        reach : float
            Where the wedge is cut off if its range has no end, metres.
        whole : bool
            Whether it begins in the middle of the stations, whatever its least range.
        """
        low, high = one.azimuth[1], min(one.azimuth[2], one.azimuth[1] + 2.0 * np.pi)
        near, far = one.range[1], one.range[2] if one.mixed else max(reach, 2.0 * one.range[1])
        # of slant ranges the plan has the shortest and the longest
        steep = np.cos(np.array(one.elevation[1:])) if one.elevation else np.ones(2)
        level = one.elevation and one.elevation[1] <= 0.0 <= one.elevation[2]
        near, far = 0.0 if whole else near * max(float(steep.min()), 0.0), far * (1.0 if level else float(steep.max()))
        turn = np.linspace(low, high, max(2, int(np.ceil((high - low) / _CORNER)) + 1))
        arc = np.stack([np.cos(turn), np.sin(turn)], axis=-1) @ self.level[:2]
        return np.asarray(self.origin + np.concatenate([far * arc, near * arc[::-1], far * arc[:1]]))

    def ray(self, one: Direction, reach: float) -> Array:
        """Return the line (2, d) from the middle of the stations along a direction, metres; see `wedge`."""
        far = one.range[2] if one.mixed else max(reach, 2.0 * one.range[1])
        return np.stack([self.origin, self.origin + far * one.vector])

    def to_dict(self) -> dict[str, Any]:
        """Return all of it as plain numbers, texts and lists: metres and degrees, None for infinity."""
        return {
            "level": LEVEL,
            "origin": self.origin.tolist(),
            "directions": [self._direction(one) for one in self.directions],
            "quantities": [_quantity(one) for one in self.quantities],
            "curve": None if self.curve is None else {"name": self.curve_name, "points": self.curve.tolist()},
            "words": self.words,
            "outside": self.outside,
            "axis": None if self.axis is None else self.axis.tolist(),
        }

    def _direction(self, one: Direction) -> dict[str, Any]:
        """Return one direction as `to_dict` has it."""
        azimuth, *ends = np.degrees(one.azimuth).tolist()
        told = {"vector": one.vector.tolist(), "azimuth_deg": azimuth, "azimuth_interval_deg": ends}
        if self.north:
            low, high = bearing_of(one.azimuth)[1:]
            told |= {"bearing_deg": bearing_of(one.azimuth)[0], "bearing_interval_deg": [low, high]}
        if one.elevation:
            elevation, *ends = np.degrees(one.elevation).tolist()
            told |= {"elevation_deg": elevation, "elevation_interval_deg": ends}
        told |= {"half_angles_deg": np.degrees(one.half_angles).tolist(), "outline": one.outline.tolist()}
        return told | {
            "range": _finite(one.range[0])[0],
            "range_interval": _finite(*one.range[1:]),
            "least_range": one.least_range,
            "gap": one.gap,
        }


def _quantity(one: Quantity) -> dict[str, Any]:
    """Return a number as `Determined.to_dict` has it."""
    value, *interval = _finite(one.value, one.low, one.high)
    return {"name": one.name, "value": value, "interval": interval, "unit": one.unit}


def _finite(*values: float) -> list[float | None]:
    """Return numbers as JSON has them: None for what is infinite."""
    return [value if np.isfinite(value) else None for value in values]


def bearing_of(azimuth: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return an azimuth with its interval, radians, as a bearing clockwise of north, 0 to 360 degrees, with its."""
    middle, low, high = (90.0 - np.degrees(each) for each in azimuth)
    turn = middle - middle % 360.0
    return float(middle - turn), float(high - turn), float(low - turn)


@dataclass(slots=True)
class Source:
    """The problem of one fix, and what its data determine once that was computed.

    Parameters
    ----------
    problem : Problem
        Single, or a flat batch of one.
    found : Determined, optional
        None until it is asked for.
    """

    problem: Problem
    found: Determined | None = None
