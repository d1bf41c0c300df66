"""The keys of one constraint of a problem file as SI values: lengths in any unit, points, directions and corners.

`d` is the dimension of the problem. A *plan* is the plane of the first two coordinates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.frames import Frame
from optloc.base.types import Amount, Array, Motion, Stations
from optloc.base.units import Quantity
from optloc.files.settings import Units, join

# Numbers of coordinates: in the plan, and in space.
_PLAN, _SPACE = 2, 3


@dataclass(frozen=True, slots=True)
class ConstraintValues:
    """The keys of a constraint with the settings that their units and coordinates depend on.

    Parameters
    ----------
    kind : str
        Kind of the constraint.
    given : mapping of str to value
        The given keys.
    stations : Stations
        Stations of the problem; they give the dimension.
    frame : Frame
        Frame of the coordinates.
    motion : Motion
        Motion of the target.
    times : array (k,)
        Seconds of the epochs.
    targets : tuple of str
        Names of the targets of the file.
    target : int
        Number of the target.
    where : str
        Place for messages.
    speed : float
        Propagation speed, m/s, for lengths that are given as times.
    """

    kind: str
    given: Mapping[str, Any]
    stations: Stations
    frame: Frame
    motion: Motion
    times: Array
    targets: tuple[str, ...]
    target: int
    where: str
    speed: float

    @property
    def dimension(self) -> int:
        """Return the dimension d of the problem, 2 or 3."""
        return self.stations.dimension

    def has(self, *keys: str) -> bool:
        """Return whether all these keys are given."""
        return all(self.given.get(key) is not None for key in keys)

    def place(self, key: str) -> str:
        """Return the place of a key, for messages."""
        return join(self.where, f"key {key!r}")

    def units(self, quantity: Quantity) -> Units:
        """Return the units of a quantity."""
        return Units(quantity, self.speed)

    def factor(self, key: str, quantity: Quantity = "length") -> float:
        """Return the SI size of the unit of plain numbers; `key` is the place for messages."""
        return self.units(quantity).conversion(self.given.get("unit"), self.place(key)).factor

    def amount(self, key: str, quantity: Quantity = "length", default: float = np.nan) -> float:
        """Return the SI value of one number under a key; `default` without the key.

        Raise InvalidProblem for a list.
        """
        value = self.given.get(key)
        if value is None:
            return default
        if isinstance(value, list | tuple):
            noun = "bound" if key in ("min", "max") else "number"
            advice = f'give one {noun}, such as "500 m"'
            raise InvalidProblem(f"{self.kind} has one {noun}, not a list", self.place(key), advice)
        units = self.units(quantity)
        return units.plain(value, units.name(self.given.get("unit")), self.place(key))

    def positive(self, key: str, quantity: Quantity = "length") -> float:
        """Return the SI value of a positive number under a key."""
        value = self.amount(key, quantity)
        if not value > 0.0:
            raise InvalidProblem(f"the {key} is not positive", self.place(key), "give a positive number")
        return value

    def bounds(self, quantity: Quantity) -> tuple[float, float]:
        """Return the least and the greatest value under `min` and `max`, SI; infinite without a bound."""
        return self.amount("min", quantity, -np.inf), self.amount("max", quantity, np.inf)

    def rate(self, key: str) -> Amount:
        """Return a number per second under a key, such as "3 deg/s": a text with a unit, or an SI number."""
        value = self.given[key]
        if isinstance(value, list | tuple):
            advice = 'give one bound, such as "3 deg/s" or "2 m/s^2"'
            raise InvalidProblem(f"{self.kind} has one bound, not a list", self.place(key), advice)
        unit = self.given.get("unit")
        return cast("Amount", value if unit is None or isinstance(value, str) else f"{value} {unit}")

    @property
    def naming(self) -> dict[str, Any]:
        """Return the argument `name` of a function of `optloc.constraints`; empty for the default name."""
        return {"name": self.given["name"]} if self.has("name") else {}

    # Coordinates.

    def plan(self) -> None:
        """Raise InvalidProblem if the frame has no plan."""
        if self.frame.kind == "ecef":
            what = f"a constraint {self.kind!r} needs a plan, and the frame is ECEF"
            raise InvalidProblem(what, self.where, 'write kind = "enu" in [frame]')

    def point(self, dimension: int) -> Array:
        """Return the point (dimension,) under x, y, z, or under lat_deg, lon_deg, height; metres of the frame."""
        if not self.has("lat_deg"):
            keys = "xyz"[:dimension]
            missing = next((key for key in keys if not self.has(key)), None)
            if missing is not None:
                raise InvalidProblem(f"{self.kind} has no {missing!r}", self.where, f"add the key {missing!r}")
            if self.has("height"):
                what = "height belongs to lat_deg and lon_deg"
                raise InvalidProblem(
                    what, self.place("height"), f"remove the key{', or give z' if dimension > 2 else ''}"
                )
            if "z" not in keys and self.has("z") and self.amount("z") != 0.0:
                what = "stations in the plane have no z"
                raise InvalidProblem(what, self.place("z"), "remove the key, or give x, y, z of each station")
            return np.array([self.amount(key) for key in keys])
        for key in "xyz":
            if self.has(key):
                what = "the centre is given twice"
                raise InvalidProblem(what, self.place(key), "give x and y, or lat_deg and lon_deg")
        if dimension == _SPACE and not self.has("height"):
            advice = "add the key 'height', metres above the ellipsoid"
            raise InvalidProblem(f"{self.kind} has no 'height'", self.where, advice)
        height = [self.amount("height")] if self.has("height") else []
        place = [self.given["lat_deg"], self.given["lon_deg"], *height]
        return np.asarray(self._geodetic([place], "lat_deg", dimension)[0])

    def points(self, stem: str, sizes: Sequence[int]) -> Array:
        """Return the points (v, 2 or 3) under a key in `unit`, or under the same key with the ending "_deg".

        `sizes` are the valid numbers of coordinates. Points in degrees are latitude, longitude and perhaps a height.
        """
        key = stem if self.has(stem) else f"{stem}_deg"
        place = self.place(key)
        if self.has(stem, f"{stem}_deg"):
            raise InvalidProblem(f"the {stem} are given twice", self.where, f"give {stem} or {stem}_deg")
        given, noun = self.given[key], stem.removesuffix("s")
        wanted = sizes if len({len(point) for point in given}) < 2 else sizes[:1]
        bad = next((i for i, point in enumerate(given) if len(point) not in wanted), None)
        if bad is not None:
            count = {2: "two", 3: "three"}
            advice = f"give {' or '.join(count[size] for size in wanted)} coordinates"
            raise InvalidProblem(f"{noun} {bad + 1} has {len(given[bad])} coordinates", place, advice)
        if key == stem:
            width = len(given[0]) if len(given) else sizes[0]
            return self.factor(key) * np.array(given, dtype=float).reshape(-1, width)
        return self._geodetic(given, key, len(given[0]) if len(given) else _PLAN)

    def _geodetic(self, given: Sequence[Sequence[float]], key: str, dimension: int) -> Array:
        """Return points (v, dimension), m, of latitudes, longitudes in degrees, and perhaps heights.

        Points without a height are at the height of the origin of an ENU frame.
        """
        place, frame = self.place(key), self.frame
        if frame.kind != "enu" and (dimension == _PLAN or not frame.geodetic):
            advice = 'write kind = "enu" in [frame]'
            raise InvalidProblem("latitudes and longitudes need an enu frame", place, advice)
        lat, lon = np.radians([point[:2] for point in given]).reshape(-1, 2).T
        if len(given) and len(given[0]) == _SPACE:
            height = np.array([point[2] for point in given], dtype=float)
        else:
            # Use the height of the origin: a point above the ground has other x and y in the plan.
            height = np.full(len(lat), 0.0 if frame.origin is None else frame.origin[2])
        found = frame.from_geodetic(lat, lon, height, where=place, first_row=1)
        return np.asarray(found[:, :dimension])

    def direction(self, key: str = "normal") -> Array:
        """Return the direction (d,) under a key: a list of numbers without a unit.

        In space, two numbers are a direction of the plan.
        """
        value = self.given[key]
        if not isinstance(value, list) or not _PLAN <= len(value) <= self.dimension:
            count = f"{len(value)} coordinates" if isinstance(value, list) else "one number"
            wanted = "2" if self.dimension == _PLAN else "2 or 3"
            raise InvalidProblem(
                f"{key} has {count}, not {wanted}", self.place(key), "give one number for each coordinate"
            )
        found = np.array(value, dtype=float)
        if not found.any():
            raise InvalidProblem(f"{key} is zero", self.place(key), "give a direction, such as [1.0, 0.0]")
        return np.append(found, np.zeros(self.dimension - len(found)))
