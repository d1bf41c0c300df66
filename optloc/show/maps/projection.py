"""Projection of map positions to the units of an SVG drawing, and limits of a map around its points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array

Window = tuple[float, float, float, float]
"""West, east, south, north in degrees, where east may exceed 180; or lowest x, highest x, lowest y, highest y in m."""

# Units of the drawing along its longer side. With one decimal, a coast is accurate to a ten-thousandth of the map.
_SIZE = 1000.0
# Extent of the drawn coast, in half sizes of the map along x and y. The script zooms out to 2.5 times the map, a screen
# can be wider than the map, and the user can drag the map.
_AROUND = np.array([6.0, 4.0])
# Minimum ratio of the half sizes for the extent of the coast: the window of a narrow map is as wide as the page.
_NARROWEST = 0.8
# Extent of the marks if all marks have the same position: degrees on Earth, else metres. The map is about 1 m wide.
_LEAST, _LEAST_FLAT = 1e-5, 1.0
RIM = 0.22
"""Share of the map on each side that stays free of marks, as room for the names of stations."""
# Minimum ratio of the shorter side of a map to the longer side.
_SLIMMEST = 0.6


class Plane:
    """The projection of map positions to units of the drawing; true to scale in the middle of the map.

    Parameters
    ----------
    west, east, south, north : float
        Limits of the map, degrees, where east can exceed 180; metres of x and y if `flat`.
    flat : bool
        Whether the positions are x and y of a frame that is not on Earth.

    Attributes
    ----------
    middle : array (2,)
        Centre of the map, degrees or metres. The drawing has its origin there.
    squeeze : float
        Ratio of a degree of longitude to a degree of latitude on the ground; 1 if `flat`.
    unit : float
        Units of the drawing in a degree of latitude, or in a metre.
    half : array (2,)
        Half the width and half the height of the map, in units of the drawing.
    flat : bool
        As the parameter.
    """

    def __init__(self, west: float, east: float, south: float, north: float, *, flat: bool = False) -> None:
        self.flat = flat
        self.middle = np.array([(west + east) / 2.0, (south + north) / 2.0])
        # A degree of longitude is shorter than a degree of latitude by this factor.
        self.squeeze = 1.0 if flat else float(np.cos(np.radians(self.middle[1])))
        self.unit = _SIZE / max((east - west) * self.squeeze, north - south)
        self.half = np.array([(east - west) * self.squeeze, north - south]) * self.unit / 2.0

    def __call__(self, place: Array) -> Array:
        """Return map positions (..., 2), degrees or metres, in units of the drawing."""
        shift = np.asarray(place, dtype=float) - self.middle
        return np.asarray(shift * [self.squeeze * self.unit, -self.unit])

    @property
    def scale(self) -> list[float]:
        """Return the units of the drawing in a degree of longitude and of latitude, or in a metre of x and of y."""
        return [self.squeeze * self.unit, -self.unit]

    def nearest(self, place: Array) -> Array:
        """Return positions (n, 2) with longitudes within 180 degrees of the middle of the map."""
        return np.asarray(place, dtype=float) if self.flat else shift_near(place, float(self.middle[0]))

    def window(self) -> Window:
        """Return the extent of the drawn coast: the map and its surroundings, degrees."""
        half = np.maximum(self.half, self.half.max() * _NARROWEST) * _AROUND / [self.squeeze * self.unit, self.unit]
        (west, south), (east, north) = self.middle - half, self.middle + half
        return max(west, self.middle[0] - 180.0), min(east, self.middle[0] + 180.0), max(south, -90.0), min(north, 90.0)


def map_limits(places: Sequence[Array], *, flat: bool = False) -> Window:
    """Return the limits of a map around all points (n, 2) of `places`, with a margin.

    Points are longitude and latitude, degrees, or x and y, m, if `flat`. If points are on both sides of the
    antimeridian, the shorter way around the Earth is used. Without any finite point, the function raises
    InvalidProblem.
    """
    points = np.concatenate(places)
    points = points[np.isfinite(points).all(-1)]
    if not len(points):
        raise InvalidProblem("nothing has a position on the map", "map", "see `optloc fix` for the reasons")
    # Move all longitudes to within 180 degrees of the first point.
    points = points if flat else shift_near(points, points[0, 0])
    low, high = points.min(0), points.max(0)
    # A degree of longitude is shorter than a degree of latitude by this factor.
    squeeze = np.array([1.0 if flat else np.cos(np.radians((low + high)[1] / 2.0)), 1.0])
    # Half the width and height with margins, in degrees of latitude; the least extent is for a single point.
    extent = (high - low) * squeeze
    half = (0.5 + RIM) * np.maximum(extent, _SLIMMEST * float(extent.max() or (_LEAST_FLAT if flat else _LEAST)))
    (west, south), (east, north) = (low + high) / 2.0 - half / squeeze, (low + high) / 2.0 + half / squeeze
    if flat:
        return float(west), float(east), float(south), float(north)
    return float(west), float(east), float(max(south, -90.0)), float(min(north, 90.0))


def shift_near(place: Array, middle: float) -> Array:
    """Return longitude and latitude (n, 2), degrees, with longitudes within 180 degrees of the middle of the map."""
    out = np.array(place, dtype=float)
    out[:, 0] = (out[:, 0] - middle + 180.0) % 360.0 - 180.0 + middle
    return out


def path(lines: Sequence[Array], *, close: bool, digits: int = 1) -> str:
    """Return lines (n, 2), in units of the drawing, as the data of an SVG path.

    With `close`, each line is closed to a ring. `digits` is the number of decimals.
    """
    end = "Z" if close else ""
    return "".join("M" + "L".join(f"{x:.9g} {y:.9g}" for x, y in np.round(line, digits)) + end for line in lines)


def short_path(lines: Sequence[Array], *, close: bool) -> str:
    """Return lines (n, 2), in units of the drawing, as path data in tenths of a unit relative to the corner before.

    Relative coordinates need fewer characters. Corners that coincide after rounding are left out.
    """
    found = []
    for line in lines:
        tenths = np.round(10.0 * line).astype(np.int64)
        steps = np.diff(tenths, axis=0)
        steps = steps[(steps != 0).any(-1)]
        if len(steps):
            first = f"M{tenths[0, 0] / 10:.9g} {tenths[0, 1] / 10:.9g}l"
            found.append(first + _joined(steps.ravel()) + ("Z" if close else ""))
    return "".join(found)


def _joined(tenths: Array) -> str:
    """Return numbers in tenths as text for path data, without a zero before a point and without needless spaces."""
    texts = [
        f"{value / 10:g}".replace("0.", ".", 1) if abs(value) < 10 else f"{value / 10:g}" for value in tenths.tolist()
    ]
    return "".join(text if text.startswith("-") or i == 0 else f" {text}" for i, text in enumerate(texts))
