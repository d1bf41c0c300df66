"""Maps of the Cramér-Rao bound and of the share of `ok` fixes: pictures, isolines and GeoJSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Status
from optloc.bounds.over_area import BoundMap, Grid
from optloc.show.pictures.notes import separate_notes
from optloc.show.pictures.outlines import feature, line_geometry, point_geometry
from optloc.show.pictures.style import BLACK, GREY, SMALL, figure_class, literal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    from optloc.solvers.shares import StatusMap

BOUND = "bound of the position error (m)\n(darker: larger error)"
"""Label of the colour scale of a bound."""

COLOURS = "GnBu"
"""Colour map from light to dark in one hue: readable in grey and with any colour vision, below black lines."""

# Levels in each decade, and extra levels between them if a map has few levels.
_STEPS = (1.0, 2.0, 5.0)
_BETWEEN = {1.0: (1.2, 1.5), 2.0: (3.0,), 5.0: (7.0,)}
# Maximum number of levels: isolines of more levels would merge.
_LEVELS = 9
# Maximum number of stations with names on the map.
_NAMED = 12
# Decimals of a degree of isolines: 0.1 m.
_DIGITS = 6
# Isolines of the share of `ok` fixes, percent: few, half, most and nearly all fixes.
_SHARES = (10.0, 50.0, 90.0, 99.0)
# A map is in kilometres if its longer side is at least this, m.
_FAR = 5e3


def plot_bound_map(found: BoundMap, title: str = "", *, dilution: bool = False) -> Figure:
    """Return a map of the bound, with isolines and stations.

    Parameters
    ----------
    found : BoundMap
        The bound over a grid.
    title : str
        Title of the picture.
    dilution : bool
        Draw the dilution of precision instead of the bound.

    Returns
    -------
    matplotlib.figure.Figure
        The picture; write it with `optloc.show.pictures.save`.

    Raises
    ------
    InvalidProblem
        If the geometry is singular everywhere, or the rows have no common dilution of precision.
    """
    from matplotlib.colors import LogNorm

    values, name = _drawn(found, dilution=dilution)
    steps = levels(values)
    # The scale spans at least a factor of two, otherwise it has only one colour.
    norm = LogNorm(steps[0], max(steps[-1], steps[0] * 2.0))
    return _draw(found, values, steps, norm, name, title)


def plot_status_map(found: StatusMap, title: str = "") -> Figure:
    """Return a map of the share of `ok` fixes, with isolines and stations.

    Parameters
    ----------
    found : StatusMap
        The shares over a grid.
    title : str
        Title of the picture.

    Returns
    -------
    matplotlib.figure.Figure
        The picture; write it with `optloc.show.pictures.save`.
    """
    from matplotlib.colors import Normalize

    values = 100.0 * found.shares.of(Status.OK)
    name = "fixes with status ok (%)\n(darker: more fixes)"
    return _draw(found.grid, values, list(_SHARES), Normalize(0.0, 100.0), name, title)


def _draw(grid: Grid, values: Array, steps: list[float], norm: Normalize, name: str, title: str) -> Figure:
    """Return a map of values (ny, nx) with isolines at the values `steps`.

    `norm` converts values to colours, and `name` is the label of the colour scale. `grid` holds the grid points, m or
    degrees, and the stations.
    """
    scale = 1.0 if grid.geodetic or max(np.ptp(grid.x), np.ptp(grid.y)) < _FAR else 1e-3
    x, y = grid.x * scale, grid.y * scale
    # A degree of longitude is shorter than a degree of latitude: use the ratio at the middle of the map for both axes.
    squeeze = np.cos(np.radians(grid.y.mean())) if grid.geodetic else 1.0
    tall = float(np.clip(np.ptp(y) / (np.ptp(x) * squeeze), 0.4, 1.6))
    figure = figure_class()(figsize=(6.4, 0.9 + 5.2 * tall), layout="compressed")
    axes = figure.subplots()
    drawn = axes.pcolormesh(x, y, values, norm=norm, cmap=COLOURS, shading="nearest", rasterized=True)
    crossed = [step for step in steps if np.nanmin(values) < step < np.nanmax(values)]
    if crossed:
        lines = axes.contour(x, y, values, levels=crossed, colors=BLACK, linewidths=0.8)
        axes.clabel(lines, fmt=lambda value: f"{value:g}", fontsize=SMALL)
    _mark_stations(axes, grid.stations * scale, grid.names, x, y)
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(y[0], y[-1])
    axes.set_aspect(1.0 / squeeze)
    unit = "deg" if grid.geodetic else "m" if scale == 1.0 else "km"
    axes.set_xlabel(f"{'longitude' if grid.geodetic else 'x'} ({unit})")
    axes.set_ylabel(f"{'latitude' if grid.geodetic else 'y'} ({unit})")
    bar = figure.colorbar(drawn, ax=axes, label=name, ticks=steps, format=lambda value, _: f"{value:g}", pad=0.02)
    bar.ax.minorticks_off()
    if title:
        axes.set_title(literal(title), fontsize=11, wrap=True)
    separate_notes(figure)
    return figure


def _mark_stations(axes: Axes, stations: Array, names: Sequence[str], x: Array, y: Array) -> None:
    """Draw the stations; if they are few, write the names of the stations on the map.

    `stations` (s, 2) and the grid lines `x` and `y` are in the unit of the axes.
    """
    style: dict[str, Any] = {"marker": "^", "s": 50, "color": "white", "edgecolors": BLACK, "linewidths": 1.2}
    axes.scatter(stations[:, 0], stations[:, 1], zorder=4, **style)
    inside = (np.abs(stations - [x.mean(), y.mean()]) <= [np.ptp(x) / 2, np.ptp(y) / 2]).all(-1)
    for place, text in zip(stations[inside], np.array(names)[inside], strict=True):
        if len(names) <= _NAMED:
            note = axes.annotate(
                literal(str(text)), place, (4, 5), textcoords="offset points", fontsize=SMALL, zorder=5
            )
            note.set_bbox({"facecolor": "white", "edgecolor": GREY, "alpha": 0.75, "pad": 1, "linewidth": 0.4})


def _drawn(found: BoundMap, *, dilution: bool) -> tuple[Array, str]:
    """Return the values (ny, nx) of a map and the label of its colour scale.

    The values are the bound in m, or the dilution of precision, which has no unit. If there is nothing to draw, the
    function raises InvalidProblem.
    """
    values = found.dilution if dilution else found.sigma
    if dilution and not np.isfinite(found.row):
        advice = "draw the bound in metres"
        raise InvalidProblem("the rows are not all lengths, so they have no dilution of precision", "map", advice)
    if not np.isfinite(values).any():
        advice = "add rows, or choose another height or place"
        raise InvalidProblem("the geometry is singular everywhere on the map", "map", advice)
    return values, "dilution of precision\n(darker: larger error)" if dilution else BOUND


def levels(values: Array) -> list[float]:
    """Return the levels of isolines, 1, 2, 5 times powers of ten, around the middle 98 % of the values.

    If there are few levels, round numbers between them are added. If there are more than `_LEVELS`, only powers of ten
    or every second level remain.
    """
    good = values[np.isfinite(values) & (values > 0.0)]
    # Near stations the bound approaches zero, and far away it approaches infinity: the outer 1 % at either end has no
    # isoline.
    low, high = (float(np.quantile(good, share)) for share in (0.01, 0.99))
    decades = range(int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(high))) + 1)
    steps = [step * 10.0**power for power in decades for step in _STEPS]
    # The last level below the values and the first level above them, at least two levels.
    first = max(i for i, step in enumerate(steps) if step <= low)
    last = min((i for i, step in enumerate(steps) if step >= high), default=len(steps) - 1)
    chosen = steps[first : max(last, first + 1) + 1]
    if len(chosen) <= _LEVELS // 2:
        return [round(step, 12) for step in _finer(chosen)]
    if len(chosen) > _LEVELS:
        whole = [step for step in chosen if np.isclose(np.log10(step) % 1.0, [0.0, 1.0]).any()]
        chosen = whole if len(whole) > 2 else chosen[::2]
    return [round(step, 12) for step in chosen]


def _finer(steps: list[float]) -> list[float]:
    """Return steps with one or two round numbers between neighbours."""
    full = []
    for step in steps[:-1]:
        # Enlarge the step a little: rounding can make the logarithm of 1000 less than 3.
        power = 10.0 ** np.floor(np.log10(step * 1.0001))
        full += [step, *(more * power for more in _BETWEEN[float(round(step / power))])]
    return [*full, steps[-1]]


def isolines(found: BoundMap) -> list[tuple[float, list[Array]]]:
    """Return the isolines of the bound: each level, m, with its lines (n, 2) of x and y."""
    figure_class()  # Raise one clear error if matplotlib, which installs contourpy, is missing.
    from contourpy import contour_generator

    values, _ = _drawn(found, dilution=False)
    made = contour_generator(found.x, found.y, np.ma.masked_invalid(values))
    return [(level, [np.asarray(line) for line in made.lines(level)]) for level in levels(values)]


def map_geojson(found: BoundMap) -> dict[str, Any]:
    """Return the stations and isolines of a map as a GeoJSON feature collection (RFC 7946).

    Raises
    ------
    InvalidProblem
        If the frame is not on Earth, or matplotlib is missing.
    """
    _demand_earth(found)
    features = _station_features(found)
    for level, lines in isolines(found):
        if lines:
            about = {"role": "bound", "sigma_m": level, "height": found.height}
            features.append(feature(line_geometry(lines, _DIGITS), about))
    return {"type": "FeatureCollection", "features": features}


def _demand_earth(grid: Grid) -> None:
    """Raise InvalidProblem if the grid of a map is not on Earth."""
    if not grid.geodetic:
        advice = 'give a [frame] of kind "geodetic", "ecef" or "enu"'
        raise InvalidProblem("GeoJSON needs positions on Earth, but the frame is cartesian", "map", advice)


def _station_features(grid: Grid) -> list[dict[str, Any]]:
    """Return the stations of a map as GeoJSON points."""
    return [
        feature(point_geometry(place, _DIGITS), {"role": "station", "name": name})
        for name, place in zip(grid.names, grid.stations, strict=True)
    ]


def status_geojson(found: StatusMap) -> dict[str, Any]:
    """Return stations and grid points, with the shares of all statuses, as a GeoJSON feature collection (RFC 7946).

    Raises
    ------
    InvalidProblem
        If the frame is not on Earth.
    """
    grid, shares = found.grid, found.shares
    _demand_earth(grid)
    features = _station_features(grid)
    for j, lat in enumerate(grid.y):
        for i, lon in enumerate(grid.x):
            pairs = zip(shares.statuses, shares.share[j, i], strict=True)
            by_status = {status.label: float(share) for status, share in pairs}
            about = {"role": "status", "height": grid.height, "trials": shares.trials, "share": by_status}
            features.append(feature(point_geometry(np.array([lon, lat]), _DIGITS), about))
    return {"type": "FeatureCollection", "features": features}
