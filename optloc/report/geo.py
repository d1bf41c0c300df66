"""An interactive map in a page: coastlines, bound, stations and trials, without a network."""

from __future__ import annotations

from base64 import b64encode
from html import escape
from io import BytesIO
from typing import Any

import numpy as np

from optloc.maps import BoundMap
from optloc.plot.bound_map import COLOURS, isolines, levels
from optloc.plot.style import BLACK, BLUE, ORANGE
from optloc.report.canvas import Plane, dot, map_canvas, path
from optloc.types import Array

_DOTS = 400


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
    plane = Plane(found.x[0], found.x[-1], found.y[0], found.y[-1])
    layers = {
        "bound": _image(found, plane) + _lines(found, plane),
        **({} if trials is None else {"trials": _trials(plane, *trials)}),
        "stations": _stations(found, plane),
    }
    return map_canvas(plane, name, title, layers, _data(found), _help(found))


def _help(found: BoundMap) -> str:
    steps = levels(found.sigma)
    low, high = _metres(steps[0]), _metres(steps[-1])
    return f"Bound from {low} (light) to {high} (dark), {found.height:.0f} m above the ellipsoid. Point at a place."


def _metres(level: float) -> str:
    return f"{level:g} m" if level < 1e3 else f"{level / 1e3:g} km"


def _image(found: BoundMap, plane: Plane) -> str:
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


def _lines(found: BoundMap, plane: Plane) -> str:
    parts = []
    for level, lines in isolines(found):
        drawn = [plane(line) for line in lines]
        if not drawn:
            continue
        parts.append(f'<path class="line" d="{path(drawn, close=False)}"/>')
        longest = max(drawn, key=len)
        x, y = longest[len(longest) // 2]
        parts.append(f'<text class="level" x="{x:.1f}" y="{y:.1f}">{_metres(level)}</text>')
    return "".join(parts)


def _stations(found: BoundMap, plane: Plane) -> str:
    parts = []
    for name, (x, y) in zip(found.names, plane(found.stations), strict=True):
        parts += [dot(x, y, BLACK, 11), dot(x, y, "#ffffff", 7, name)]
        parts.append(f'<text class="name" x="{x:.1f}" y="{y:.1f}">{escape(name)}</text>')
    return "".join(parts)


def _trials(plane: Plane, places: Array, off: Array) -> str:
    kept = np.unique(np.linspace(0, len(places) - 1, min(_DOTS, len(places))).astype(int))
    order = kept[np.argsort(off[kept], kind="stable")]
    return "".join(
        dot(x, y, ORANGE if bad else BLUE, 5 if bad else 3)
        for (x, y), bad in zip(plane(places[order]), off[order], strict=True)
    )


def _data(found: BoundMap) -> dict[str, Any]:
    """Return what the script of the page needs to tell the bound at a place."""
    return {
        "x": [float(found.x[0]), float(found.x[-1]), len(found.x)],
        "y": [float(found.y[0]), float(found.y[-1]), len(found.y)],
        "values": [float(f"{v:.3g}") if np.isfinite(v) else None for v in found.sigma.ravel()],
    }
