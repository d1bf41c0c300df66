"""Facts about a position that the data determine even without a fix: directions, numbers with intervals, a curve."""

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
"""Statuses in which the position of the fix is not usable. Output then shows a direction instead."""

# Angle between the corners of a drawn arc, radians. At 2 degrees an arc looks smooth at every usual scale.
_CORNER = np.radians(2.0)


@dataclass(frozen=True, slots=True)
class Quantity:
    """One number that the data determine, with its 95 % interval.

    Parameters
    ----------
    name : str
        For instance "distance from line". A line or a plane in a name contains all stations.
    value : float
        Value of the highest likelihood.
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
    """A direction, as seen from the mean of the stations, with its 95 % cone and its range.

    Parameters
    ----------
    vector : array (d,)
        Unit vector of the highest likelihood, in the frame of the problem.
    azimuth : tuple of three float
        Angle from the first horizontal axis towards the second, and the lower and upper end of its 95 % interval,
        radians. In frames on Earth it counts from east towards north. The ends are not wrapped; they are a full turn
        apart if every azimuth is possible.
    elevation : tuple of three float
        Angle above the horizontal plane and the ends of its interval, radians; empty in two dimensions.
    half_angles : array (d - 1,)
        Semi-axes of the 95 % cone, radians, the larger first. They belong to the ellipse that has the second moments of
        `outline`.
    axes : array (d, d - 1)
        Unit vectors along the semi-axes, in columns.
    outline : array (k, d)
        Unit vectors on the edge of the 95 % cone. In space they are counter-clockwise as seen from outside; in the
        plane they are the two edges.
    range : tuple of three float
        Distance from the mean of the stations and the ends of its 95 % interval, metres. The far end is infinite if the
        data do not exclude infinity.
    gap : float
        Cost (chi-square) of this direction minus the cost of the first direction.
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
        """Return the lower end of the range interval, metres from the mean of the stations."""
        return self.range[1]

    @property
    def mixed(self) -> bool:
        """Return whether the upper end of the range interval is finite, so that the data determine a range too."""
        return bool(np.isfinite(self.range[2]))

    def covers(self, vectors: Array) -> Array:
        """Return a bool array (...): whether vectors (..., d) of any length are inside the 95 % cone."""
        return is_in_cone(self.vector, self.outline, vectors)


def is_in_cone(axis: Array, outline: Array, vectors: Array) -> Array:
    """Return whether vectors (..., d) are in the cone around `axis` (d,) with edge vectors `outline` (k, d).

    In the plane, the cone is between the extreme edges. In space, a vector is inside if it is on the inner side of the
    edge between its two neighbouring outline vectors.
    """
    rim, angles = angles_off_axis(axis, outline), angles_off_axis(axis, np.asarray(vectors, dtype=float))
    if len(axis) == 2:
        return np.asarray((angles[..., 0] >= rim.min()) & (angles[..., 0] <= rim.max()))
    polar = np.arctan2(rim[:, 1], rim[:, 0])
    # Sort the edge vectors by their angle about the axis. The neighbours of a vector are then number `last` and the
    # number before it; the edge is closed, so number 0 follows the last.
    rim = rim[np.argsort(polar)]
    last = np.searchsorted(np.sort(polar), np.arctan2(angles[..., 1], angles[..., 0])) % len(rim)
    start, end = rim[last - 1], rim[last]
    edge, offset = end - start, angles - start
    return np.asarray(edge[..., 0] * offset[..., 1] - edge[..., 1] * offset[..., 0] >= 0.0)


def angles_off_axis(axis: Array, vectors: Array) -> Array:
    """Return the angles (..., d - 1), radians, between vectors (..., d) and an axis (d,), as components.

    The components refer to the vectors `basis(axis)`, which are orthogonal to the axis. The length of the components is
    the angle between vector and axis.
    """
    unit = vectors / np.sqrt((vectors**2).sum(-1, keepdims=True))
    across = unit @ basis(axis)
    size = np.sqrt((across**2).sum(-1, keepdims=True))
    angle = np.arctan2(size, (unit @ axis)[..., None])
    # At the axis the angle equals its sine, so the quotient is 1.
    return np.asarray(across * np.where(size > 0.0, angle / np.where(size > 0.0, size, 1.0), 1.0))


@dataclass(frozen=True, slots=True)
class Determined:
    """Directions, numbers and a curve that the data determine about one position, with probability 95 %.

    Parameters
    ----------
    origin : array (d,)
        Mean of the stations that have present rows, metres: the origin of directions and ranges.
    level : array (d, d)
        Rows: the axis of azimuth 0, the axis of azimuth 90 degrees and, in space, the upward axis. On Earth: east,
        north, up.
    north : bool
        Whether azimuths count from east towards north, so that they convert to bearings.
    directions : tuple of Direction
        The most likely first; several if the data fit several. Empty if no cone contains the directions.
    quantities : tuple of Quantity
        Numbers with intervals, for instance the distance from a line of stations.
    curve : array (k, d), optional
        Points of the line on which one measurement places the target, metres.
    curve_name : str
        For instance "hyperbola about A and B".
    words : str
        The `reason` of the fix.
    axis : array (d,), optional
        Direction of the line, or normal of the plane, that contains all stations and to which the quantities refer.
    outside : bool
        Whether the directions assume that the target is farther from the mean than all stations. Without this
        assumption every direction is possible.
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
        """Return whether the data determine a direction, a number or a curve."""
        return bool(self.directions or self.quantities) or self.curve is not None

    def wedge(self, one: Direction, reach: float, *, whole: bool = False) -> Array:
        """Return the horizontal outline of a cone between its least and greatest range: a closed line (k, d), metres.

        The line is anticlockwise.

        Parameters
        ----------
        one : Direction
            One of `directions`.
        reach : float
            Length of the wedge if the range has no upper end, metres.
        whole : bool
            Whether the wedge begins at the mean of the stations instead of at the least range.
        """
        # At most a full turn, so that the outline does not cover itself.
        low, high = one.azimuth[1], min(one.azimuth[2], one.azimuth[1] + 2.0 * np.pi)
        near, far = one.range[1], one.range[2] if one.mixed else max(reach, 2.0 * one.range[1])
        # Horizontal distance is slant range times cos(elevation): take its least and its greatest value.
        cosines = np.cos(np.array(one.elevation[1:])) if one.elevation else np.ones(2)
        level = one.elevation and one.elevation[1] <= 0.0 <= one.elevation[2]
        near, far = (
            0.0 if whole else near * max(float(cosines.min()), 0.0),
            far * (1.0 if level else float(cosines.max())),
        )
        azimuths = np.linspace(low, high, max(2, int(np.ceil((high - low) / _CORNER)) + 1))
        arc = np.stack([np.cos(azimuths), np.sin(azimuths)], axis=-1) @ self.level[:2]
        return np.asarray(self.origin + np.concatenate([far * arc, near * arc[::-1], far * arc[:1]]))

    def ray(self, one: Direction, reach: float) -> Array:
        """Return the line (2, d), metres, from the mean of the stations along a direction.

        If the range has no upper end, the line has the length `reach`, or twice the least range if that is longer.
        """
        far = one.range[2] if one.mixed else max(reach, 2.0 * one.range[1])
        return np.stack([self.origin, self.origin + far * one.vector])

    def to_dict(self) -> dict[str, Any]:
        """Return all content as plain numbers, texts and lists, in metres and degrees, with None for infinity."""
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
        """Return one direction as a dictionary for `to_dict`.

        Angles are in degrees, ranges in metres.
        """
        azimuth, *ends = np.degrees(one.azimuth).tolist()
        entries = {"vector": one.vector.tolist(), "azimuth_deg": azimuth, "azimuth_interval_deg": ends}
        if self.north:
            low, high = bearing_of(one.azimuth)[1:]
            entries |= {"bearing_deg": bearing_of(one.azimuth)[0], "bearing_interval_deg": [low, high]}
        if one.elevation:
            elevation, *ends = np.degrees(one.elevation).tolist()
            entries |= {"elevation_deg": elevation, "elevation_interval_deg": ends}
        entries |= {"half_angles_deg": np.degrees(one.half_angles).tolist(), "outline": one.outline.tolist()}
        return entries | {
            "range": _finite(one.range[0])[0],
            "range_interval": _finite(*one.range[1:]),
            "least_range": one.least_range,
            "gap": one.gap,
        }


def _quantity(one: Quantity) -> dict[str, Any]:
    """Return one quantity as a dictionary for `Determined.to_dict`."""
    value, *interval = _finite(one.value, one.low, one.high)
    return {"name": one.name, "value": value, "interval": interval, "unit": one.unit}


def _finite(*values: float) -> list[float | None]:
    """Return the values as a list for JSON, with None instead of infinity and NaN."""
    return [value if np.isfinite(value) else None for value in values]


def bearing_of(azimuth: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the bearing and its interval, degrees clockwise from north, of an azimuth with its interval, radians.

    `azimuth` is the value, its lower end and its upper end. The bearing is from 0 to 360 degrees. The ends of the
    interval are not wrapped, so that the interval contains the bearing; the lower end is first.
    """
    # A bearing decreases when the azimuth increases, so the ends change places.
    middle, low, high = (90.0 - np.degrees(each) for each in azimuth)
    turn = middle - middle % 360.0
    return float(middle - turn), float(high - turn), float(low - turn)


@dataclass(slots=True)
class Source:
    """The problem of one fix, and a cache of its `Determined`.

    Parameters
    ----------
    problem : Problem
        A single problem, or a flat batch of one.
    found : Determined, optional
        None until it is computed at the first use.
    """

    problem: Problem
    found: Determined | None = None
