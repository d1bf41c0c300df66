"""Pages and elements with the map of a bound: coastlines, bound, isolines, stations and trials."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from io import BytesIO
from typing import Any

import numpy as np

from optloc.base.types import Array
from optloc.bounds.over_area import BoundMap
from optloc.show.maps.background import SOURCES
from optloc.show.maps.canvas import Canvas, Curve, Drawn, Image, Label, LegendEntry, dot, map_canvas
from optloc.show.maps.map_layers import station_symbols
from optloc.show.maps.projection import Plane, path
from optloc.show.page import PagePart, write_page
from optloc.show.pictures.bound_map import COLOURS, isolines, levels


def map_page(found: BoundMap, title: str) -> str:
    """Return an HTML page with the interactive map of a bound; the page needs no network.

    `found` is the bound over a grid, and `title` the title of the page.

    Raises
    ------
    InvalidProblem
        If matplotlib is missing.
    """
    text = "Root of the trace of the Cramer-Rao bound of the position, in metres."
    note = SOURCES if found.geodetic else ""
    part = PagePart("map", "Bound of the position error", text, maps=[map_element(found, "map-1", title)], note=note)
    return write_page(title, [part])


# Maximum number of dots of trials: enough to show the distribution, few enough to see the bound below and to move the
# page smoothly.
_DOTS = 400
_RIGHT, _WRONG = 4, 7  # Pixels: wrong trials must be visible among many right trials.


def map_element(found: BoundMap, name: str, title: str, trials: tuple[Array, Array] | None = None) -> Canvas:
    """Return the map of a bound.

    Parameters
    ----------
    found : BoundMap
        The bound over a grid of longitude and latitude.
    name : str
        Id of the element.
    title : str
        Description of the map.
    trials : (places, off), optional
        Longitude and latitude (n, 2), degrees, of true positions, and whether each trial (n,) had a wrong result.
    """
    plane = Plane(found.x[0], found.x[-1], found.y[0], found.y[-1], flat=not found.geodetic)
    symbols, names = station_symbols(found.names, plane(found.stations))
    layers: dict[str, Sequence[Drawn]] = {
        **({} if trials is None else {"trials": _trials(plane, *trials)}),
        "stations": symbols,
        "names": names,
    }
    legend = [_colour_bar(found), LegendEntry("line", "isoline of the bound", "line")]
    legend.append(LegendEntry("station", "station", "station"))
    if trials is not None:
        legend += [LegendEntry("ok", "trial"), LegendEntry("bad", "trial with a wrong result that is ok")]
    summary = f"Map of the bound of the position error, with {len(found.names)} stations. {_map_text(found)}"
    bound = {"bound": [_image(found, plane), *_lines(found, plane)]}
    text = _map_text(found)
    return map_canvas(plane, name, title, layers, _data(found), text, under=bound, legend=legend, summary=summary)


def _map_text(found: BoundMap) -> str:
    """Return the text below the map of a bound: the range of its colours and the height."""
    steps = levels(found.sigma)
    low, high = _metres(steps[0]), _metres(steps[-1])
    # A map in the plane has no height.
    where = f" at z = {found.height:g} m" if np.isfinite(found.vertical).any() else ""
    where = f" at {found.height:.0f} m above the ellipsoid" if found.geodetic else where
    return f"Bound from {low} (light) to {high} (dark){where}. Point at the map to read the bound."


# Number of colours from which the colour bar of the legend is interpolated.
_STEPS = 8


def _colour_bar(found: BoundMap) -> LegendEntry:
    """Return the colour bar of a bound for the legend, with the sense of its colours."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    steps = levels(found.sigma)
    colours = ", ".join(to_hex(colour) for colour in colormaps[COLOURS](np.linspace(0.0, 1.0, _STEPS)))
    text = f"bound, {_metres(steps[0])} to {_metres(steps[-1])} (darker: larger error)"
    return LegendEntry(f"linear-gradient(to right, {colours})", text, "bar")


def _metres(level: float) -> str:
    """Return a length in m as text, in km from 1000 m on."""
    return f"{level:g} m" if level < 1e3 else f"{level / 1e3:g} km"


def _image(found: BoundMap, plane: Plane) -> Image:
    """Return the bound as a picture for the map: one pixel for each grid point, transparent where there is no bound.

    `found` is the bound over a grid, and `plane` is the projection of the map.
    """
    from matplotlib import colormaps
    from matplotlib.colors import LogNorm
    from matplotlib.image import imsave

    steps = levels(found.sigma)
    # A colour scale needs two different ends, also if the bound is constant.
    norm = LogNorm(steps[0], max(steps[-1], 2.0 * steps[0]), clip=True)
    rgba = colormaps[COLOURS](norm(np.ma.masked_invalid(found.sigma)))
    # Cells without a bound are transparent.
    rgba[~np.isfinite(found.sigma)] = 0.0
    file = BytesIO()
    # The first row of a picture is at the top, the first row of the bound in the south.
    imsave(file, np.ascontiguousarray(rgba[::-1]), format="png")
    # Grid points are centres of pixels, so the picture extends half a step beyond the grid.
    dx, dy = ((v[1] - v[0]) / 2.0 for v in (found.x, found.y))
    x, y = plane(np.array([found.x[0] - dx, found.y[-1] + dy]))
    right, low = plane(np.array([found.x[-1] + dx, found.y[0] - dy]))
    return Image(x, y, right - x, low - y, f"data:image/png;base64,{b64encode(file.getvalue()).decode()}")


def _lines(found: BoundMap, plane: Plane) -> list[Drawn]:
    """Return the isolines of the bound as curves, with one label for each level.

    `found` is the bound over a grid, and `plane` is the projection of the map.
    """
    parts: list[Drawn] = []
    for level, lines in isolines(found):
        drawn = [plane(line) for line in lines]
        if not drawn:
            continue
        # Write one label for each level, in the middle of its longest line.
        longest = max(drawn, key=len)
        x, y = longest[len(longest) // 2]
        parts += [Curve("line", path(drawn, close=False)), Label("level", x, y, _metres(level))]
    return parts


def _trials(plane: Plane, places: Array, off: Array) -> list[Drawn]:
    """Return at most `_DOTS` trials as dots at longitude and latitude `places` (n, 2), degrees.

    Trials with a wrong result, marked by `off` (n,), have another colour and shape and are larger. `plane` is the
    projection of the map.
    """
    kept = np.unique(np.linspace(0, len(places) - 1, min(_DOTS, len(places))).astype(int))
    order = kept[np.argsort(off[kept], kind="stable")]  # Draw wrong trials last, on top.
    return [
        dot(x, y, "bad" if bad else "ok", _WRONG if bad else _RIGHT)
        for (x, y), bad in zip(plane(places[order]), off[order], strict=True)
    ]


def _data(found: BoundMap) -> dict[str, Any]:
    """Return the values from which the script of the page reads the bound at the pointer.

    `x` and `y` are first and last grid line, degrees, and their number. `values` are the bounds in m, row by row from
    the south; None where there is no bound. `found` is the bound over the grid.
    """
    return {
        "x": [float(found.x[0]), float(found.x[-1]), len(found.x)],
        "y": [float(found.y[0]), float(found.y[-1]), len(found.y)],
        "values": [float(f"{v:.3g}") if np.isfinite(v) else None for v in found.sigma.ravel()],
    }
