"""The drawing of an interactive map: a plane of longitude and latitude, paths, dots, layers that come and go."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from optloc.report.coast import Window, land
from optloc.types import Array

_SIZE = 1000.0
_TOOLS = (("in", "+", "nearer"), ("out", "−", "farther"), ("all", "⌂", "whole map"), ("focus", "◎", "to the fix"))
_AROUND = np.array([6.0, 4.0])


class Plane:
    """Longitude and latitude to the units of the drawing, true to scale in the middle of the map.

    Parameters
    ----------
    west, east, south, north : float
        Limits of the map, degrees; east may exceed 180.
    """

    def __init__(self, west: float, east: float, south: float, north: float) -> None:
        self.middle = np.array([(west + east) / 2.0, (south + north) / 2.0])
        self.squeeze = float(np.cos(np.radians(self.middle[1])))
        self.unit = _SIZE / max((east - west) * self.squeeze, north - south)
        self.half = np.array([(east - west) * self.squeeze, north - south]) * self.unit / 2.0

    def __call__(self, place: Array) -> Array:
        """Return longitude and latitude (..., 2) in the units of the drawing."""
        shift = np.asarray(place, dtype=float) - self.middle
        return np.asarray(shift * [self.squeeze * self.unit, -self.unit])

    @property
    def scale(self) -> list[float]:
        """Return units of the drawing in a degree of longitude and of latitude."""
        return [self.squeeze * self.unit, -self.unit]

    def window(self) -> Window:
        """Return what is drawn of the coast: the map and its surroundings."""
        half = np.maximum(self.half, self.half.max() * 0.8) * _AROUND / [self.squeeze * self.unit, self.unit]
        (west, south), (east, north) = self.middle - half, self.middle + half
        return max(west, self.middle[0] - 180.0), min(east, self.middle[0] + 180.0), max(south, -90.0), min(north, 90.0)


def path(lines: Sequence[Array], *, close: bool, digits: int = 1) -> str:
    """Return lines (n, 2) of the drawing as the data of an SVG path."""
    end = "Z" if close else ""
    return "".join("M" + "L".join(f"{x:.9g} {y:.9g}" for x, y in np.round(line, digits)) + end for line in lines)


def dot(x: float, y: float, colour: str, size: float, title: str = "") -> str:
    """Return a dot whose size does not depend on the zoom; the page shows its title when it is pointed at."""
    told = f' data-tell="{escape(title, quote=True)}"' if title else ""
    return f'<path class="dot" d="M{x:.9g} {y:.9g}h0" stroke="{colour}" stroke-width="{size}"{told}/>'


def map_canvas(plane: Plane, name: str, title: str, layers: Mapping[str, str], data: dict[str, Any], text: str) -> str:
    """Return a map as an element of a page that holds the script of maps.

    Parameters
    ----------
    plane : Plane
        Its limits.
    name : str
        Identity of the element.
    title : str
        What it shows.
    layers : mapping of str to str
        SVG of each layer, from the lowest on; a box switches it off.
    data : dict
        What the script needs beside the plane: `x`, `y` and `values` of the bound; `focus`, middle and width of a part
        that deserves a button, and `nearest`, how far one can zoom.
    text : str
        Stands below the map while nothing is pointed at.
    """
    shore = path([plane(ring) for ring in land(plane.window())], close=True)
    groups = "".join(f'<g data-layer="{layer}">{inner}</g>' for layer, inner in layers.items())
    width, height = 2.0 * plane.half
    box = f"{-plane.half[0]:.1f} {-plane.half[1]:.1f} {width:.1f} {height:.1f}"
    boxes = "".join(f'<label><input type="checkbox" value="{n}" checked> {n}</label>' for n in layers)
    buttons = "".join(
        f'<button type="button" data-do="{do}" aria-label="{label}">{sign}</button>'
        for do, sign, label in _TOOLS[: 4 if "focus" in data else 3]
    )
    numbers = json.dumps({"middle": plane.middle.tolist(), "scale": plane.scale, **data}).replace("</", "<\\/")
    return (
        f'<div class="map" id="{name}"><svg viewBox="{box}" role="img" aria-label="{escape(title, quote=True)}">'
        f'<path class="land" d="{shore}"/>{groups}</svg>'
        f'<div class="tools">{buttons}</div><div class="layers">{boxes}</div><output>{escape(text)}</output>'
        f'<script type="application/json">{numbers}</script></div>'
    )
