"""An interactive map in a page: coastlines, bound, stations and trials, without a network."""

from __future__ import annotations

import json
from base64 import b64encode
from html import escape
from io import BytesIO

import numpy as np

from optloc.maps import BoundMap
from optloc.plot.bound_map import COLOURS, isolines, levels
from optloc.plot.style import BLACK, BLUE, ORANGE
from optloc.report.coast import Window, land
from optloc.types import Array

_SIZE = 1000.0
_AROUND = np.array([6.0, 4.0])
_DOTS = 400


class _Plane:
    """Longitude and latitude to the units of the drawing, true to scale in the middle of the map."""

    def __init__(self, found: BoundMap) -> None:
        x, y = found.x, found.y
        self.middle = np.array([(x[0] + x[-1]) / 2.0, (y[0] + y[-1]) / 2.0])
        self.squeeze = float(np.cos(np.radians(self.middle[1])))
        self.unit = _SIZE / max((x[-1] - x[0]) * self.squeeze, y[-1] - y[0])
        self.half = np.array([(x[-1] - x[0]) * self.squeeze, y[-1] - y[0]]) * self.unit / 2.0

    def __call__(self, place: Array) -> Array:
        shift = np.asarray(place, dtype=float) - self.middle
        return np.asarray(shift * [self.squeeze * self.unit, -self.unit])

    def window(self) -> Window:
        """Return what is drawn of the coast: the map and its surroundings."""
        half = np.maximum(self.half, self.half.max() * 0.8) * _AROUND / [self.squeeze * self.unit, self.unit]
        (west, south), (east, north) = self.middle - half, self.middle + half
        return max(west, self.middle[0] - 180.0), min(east, self.middle[0] + 180.0), max(south, -90.0), min(north, 90.0)


def map_element(found: BoundMap, name: str, title: str, trials: tuple[Array, Array] | None = None) -> str:
    """Return a map as an element of a page that holds `page_scripts`.

    Parameters
    ----------
    found : BoundMap
        The bound over a grid of longitude and latitude.
    name : str
        Identity of the element.
    title : str
        What it shows.
    trials : (places, off), optional
        Longitude and latitude (n, 2) of true places, and which of them (n,) were not answered right.
    """
    plane = _Plane(found)
    layers = [
        f'<path class="land" d="{_path([plane(ring) for ring in land(plane.window())], close=True)}"/>',
        f'<g data-layer="bound">{_image(found, plane)}{_lines(found, plane)}</g>',
        "" if trials is None else f'<g data-layer="trials">{_trials(plane, *trials)}</g>',
        f'<g data-layer="stations">{_stations(found, plane)}</g>',
    ]
    width, height = 2.0 * plane.half
    box = f"{-plane.half[0]:.1f} {-plane.half[1]:.1f} {width:.1f} {height:.1f}"
    names = ["bound", *([] if trials is None else ["trials"]), "stations"]
    boxes = "".join(f'<label><input type="checkbox" value="{n}" checked> {n}</label>' for n in names)
    buttons = "".join(
        f'<button type="button" data-do="{do}" aria-label="{label}">{sign}</button>'
        for do, sign, label in (("in", "+", "nearer"), ("out", "−", "farther"), ("all", "⌂", "whole map"))
    )
    return (
        f'<div class="map" id="{name}"><svg viewBox="{box}" role="img" aria-label="{escape(title, quote=True)}">'
        f'{"".join(layers)}</svg><div class="tools">{buttons}</div><div class="layers">{boxes}</div>'
        f"<output>{_help(found)}</output>"
        f'<script type="application/json">{json.dumps(_data(found, plane))}</script></div>'
    )


def _help(found: BoundMap) -> str:
    steps = levels(found.sigma)
    low, high = _metres(steps[0]), _metres(steps[-1])
    return f"Bound from {low} (light) to {high} (dark), {found.height:.0f} m above the ellipsoid. Point at a place."


def _metres(level: float) -> str:
    return f"{level:g} m" if level < 1e3 else f"{level / 1e3:g} km"


def _path(lines: list[Array], *, close: bool) -> str:
    parts = []
    for line in lines:
        rounded = np.round(line, 1)
        parts.append("M" + "L".join(f"{x:g} {y:g}" for x, y in rounded) + ("Z" if close else ""))
    return "".join(parts)


def _image(found: BoundMap, plane: _Plane) -> str:
    from matplotlib import colormaps
    from matplotlib.colors import LogNorm
    from matplotlib.image import imsave

    steps = levels(found.sigma)
    norm = LogNorm(steps[0], max(steps[-1], 2.0 * steps[0]), clip=True)
    rgba = colormaps[COLOURS](norm(np.ma.masked_invalid(found.sigma)))
    rgba[~np.isfinite(found.sigma)] = 0.0
    file = BytesIO()
    imsave(file, np.ascontiguousarray(rgba[::-1]), format="png")
    dx, dy = ((v[1] - v[0]) / 2.0 for v in (found.x, found.y))
    x, y = plane(np.array([found.x[0] - dx, found.y[-1] + dy]))
    right, low = plane(np.array([found.x[-1] + dx, found.y[0] - dy]))
    source = b64encode(file.getvalue()).decode()
    size = f'x="{x:.2f}" y="{y:.2f}" width="{right - x:.2f}" height="{low - y:.2f}"'
    return f'<image {size} preserveAspectRatio="none" opacity="0.75" href="data:image/png;base64,{source}"/>'


def _lines(found: BoundMap, plane: _Plane) -> str:
    parts = []
    for level, lines in isolines(found):
        drawn = [plane(line) for line in lines]
        if not drawn:
            continue
        parts.append(f'<path class="line" d="{_path(drawn, close=False)}"/>')
        longest = max(drawn, key=len)
        x, y = longest[len(longest) // 2]
        parts.append(f'<text class="level" x="{x:.1f}" y="{y:.1f}">{_metres(level)}</text>')
    return "".join(parts)


def _dot(x: float, y: float, colour: str, size: float, title: str = "") -> str:
    """Return a dot whose size does not depend on the zoom."""
    inner = f"<title>{escape(title)}</title>" if title else ""
    return f'<path class="dot" d="M{x:.1f} {y:.1f}h0" stroke="{colour}" stroke-width="{size}">{inner}</path>'


def _stations(found: BoundMap, plane: _Plane) -> str:
    parts = []
    for name, (x, y) in zip(found.names, plane(found.stations), strict=True):
        parts += [_dot(x, y, BLACK, 11), _dot(x, y, "#ffffff", 7, name)]
        parts.append(f'<text class="name" x="{x:.1f}" y="{y:.1f}">{escape(name)}</text>')
    return "".join(parts)


def _trials(plane: _Plane, places: Array, off: Array) -> str:
    kept = np.unique(np.linspace(0, len(places) - 1, min(_DOTS, len(places))).astype(int))
    order = kept[np.argsort(off[kept], kind="stable")]
    return "".join(
        _dot(x, y, ORANGE if bad else BLUE, 5 if bad else 3)
        for (x, y), bad in zip(plane(places[order]), off[order], strict=True)
    )


def _data(found: BoundMap, plane: _Plane) -> dict[str, object]:
    """Return what the script of the page needs to tell the bound at a place."""
    values = [float(f"{v:.3g}") if np.isfinite(v) else None for v in found.sigma.ravel()]
    return {
        "middle": plane.middle.tolist(),
        "scale": [plane.squeeze * plane.unit, -plane.unit],
        "x": [float(found.x[0]), float(found.x[-1]), len(found.x)],
        "y": [float(found.y[0]), float(found.y[-1]), len(found.y)],
        "values": values,
    }
