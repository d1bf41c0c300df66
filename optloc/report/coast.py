"""Coastlines for maps without a network.

The land polygons of Natural Earth at 1:50 million (https://www.naturalearthdata.com, version 4.1, public domain), by
way of the package world-atlas 2.0.2, to a hundredth of a degree: differences of the corners of all rings, and the
lengths of the rings.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files

import numpy as np

from optloc.types import Array

Window = tuple[float, float, float, float]
"""West, east, south, north in degrees; east may exceed 180."""


@cache
def rings() -> tuple[Array, ...]:
    """Return the shores of all land, and of seas in it, as closed rings (n, 2) of longitude and latitude in degrees.

    Each is in one piece, so that some go beyond 180 degrees; that of Antarctica goes along the pole.
    """
    with (files("optloc.report") / "natural-earth-50m.npz").open("rb") as file, np.load(file) as data:
        delta, length = data["delta"].astype(np.int64), data["length"]
    starts = np.cumsum(length)[:-1]
    return tuple(np.cumsum(part, axis=0) / 100.0 for part in np.split(delta, starts))


def land(window: Window) -> list[Array]:
    """Return the land in a window as polygons (n, 2); to be filled by the even-odd rule."""
    west, east, south, north = window
    found = []
    for ring in rings():
        low, high = ring.min(0), ring.max(0)
        if high[1] < south or low[1] > north:
            continue
        for turn in (-360.0, 0.0, 360.0):
            if low[0] + turn < east and high[0] + turn > west:
                cut = _clipped(ring + np.array([turn, 0.0]), window)
                if len(cut) > 2:
                    found.append(cut)
    return found


def _clipped(ring: Array, window: Window) -> Array:
    """Return a ring cut at four straight lines.

    I. E. Sutherland and G. W. Hodgman, "Reentrant polygon clipping", Communications of the ACM 17 (1974).
    """
    for axis, limit, sign in ((0, window[0], 1.0), (0, window[1], -1.0), (1, window[2], 1.0), (1, window[3], -1.0)):
        if not len(ring):
            return ring
        depth = sign * (ring[:, axis] - limit)
        before, depth_before = np.roll(ring, 1, axis=0), np.roll(depth, 1)
        crosses = (depth >= 0.0) != (depth_before >= 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            share = depth_before / (depth_before - depth)
            edge = before + np.where(crosses, share, 0.0)[:, None] * (ring - before)
        both = np.stack([edge, ring], axis=1).reshape(-1, 2)
        ring = both[np.stack([crosses, depth >= 0.0], axis=1).ravel()]
    return ring
