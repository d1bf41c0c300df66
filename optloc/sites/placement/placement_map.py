"""Maps of the accuracy bound before and after a choice of stations, and the gap during the search.

Letters: P places, s stations, q recorded moments of the search.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from optloc.bounds import BoundMap
from optloc.problem import Array
from optloc.show import BLACK, COLOURS, GREY, figure_class, levels, literal, separate_notes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Largest number of taken stations with a label, and side of a map from which its axes are in kilometres,
# metres.
_NAMED, _FAR = 16, 5e3


def plot_placement(
    maps: Sequence[BoundMap],
    taken: Sequence[Array],
    places: Array,
    weights: Array,
    course: Array,
    titles: Sequence[str],
) -> Figure:
    """Return a figure: two maps of the bound on one scale above value and bound over time.

    Parameters
    ----------
    maps : sequence of 2 BoundMap
        Bounds of the position error before and after the choice; their stations are all candidates.
    taken : sequence of 2 bool array (s,)
        Taken stations of each map.
    places : array (P, 2)
        Places of interest, in the coordinates of the maps.
    weights : array (P,)
        Weights of the places.
    course : array (q, 3)
        Seconds, bound and value (both as standard deviations, metres).
    titles : sequence of 2 str
        Titles of the maps.
    """
    from matplotlib.colors import LogNorm

    steps = levels(np.concatenate([found.sigma.ravel() for found in maps]))
    norm = LogNorm(steps[0], max(steps[-1], steps[0] * 2.0))
    figure = figure_class()(figsize=(9.6, 7.4), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=[3.0, 1.0])
    upper = [figure.add_subplot(grid[0, i]) for i in range(2)]
    for axes, found, chosen, title in zip(upper, maps, taken, titles, strict=True):
        scale = 1.0 if found.geodetic or max(np.ptp(found.x), np.ptp(found.y)) < _FAR else 1e-3
        drawn = axes.pcolormesh(
            found.x * scale, found.y * scale, found.sigma, norm=norm, cmap=COLOURS, shading="nearest", rasterized=True
        )
        lines = axes.contour(
            found.x * scale, found.y * scale, found.sigma, levels=steps, colors=BLACK, linewidths=0.6, alpha=0.7
        )
        axes.clabel(lines, fmt=lambda value: f"{value:g}", fontsize=7)
        _mark(axes, found, chosen, places * scale, weights, scale)
        axes.set_aspect(1.0 / np.cos(np.radians(found.y.mean())) if found.geodetic else 1.0)
        axes.set_title(literal(title), fontsize=10, wrap=True)
        unit = "deg" if found.geodetic else "m" if scale == 1.0 else "km"
        axes.set_xlabel(f"{'longitude' if found.geodetic else 'x'} ({unit})")
    upper[0].set_ylabel(f"{'latitude' if maps[0].geodetic else 'y'} ({unit})")
    label = "bound of the position error (m)"
    bar = figure.colorbar(drawn, ax=upper, label=label, ticks=steps, format=lambda value, _: f"{value:g}")
    bar.ax.minorticks_off()
    _course(figure.add_subplot(grid[1, :]), course)
    handles, labels = upper[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=8, frameon=False)
    for axes in figure.axes[:2]:
        axes.tick_params(labelsize=8)
    separate_notes(figure)
    return figure


def _mark(axes: Axes, found: BoundMap, chosen: Array, places: Array, weights: Array, scale: float) -> None:
    """Draw places, candidates and taken stations into a map (`found`).

    `chosen` (s,) marks the taken stations. `places` (P, 2) are in the units of the axes: metres, km or
    degrees. `scale` converts the positions of the stations to these units. The markers of places grow with
    their `weights` (P,).
    """
    stations = found.stations * scale
    size = 30.0 + 50.0 * weights / weights.max()
    axes.scatter(
        places[:, 0],
        places[:, 1],
        marker="x",
        s=size,
        color="#D55E00",
        linewidths=1.3,
        zorder=4,
        label="places of interest",
    )
    axes.scatter(
        stations[~chosen, 0],
        stations[~chosen, 1],
        s=14,
        facecolors="white",
        edgecolors=GREY,
        linewidths=0.7,
        zorder=5,
        label="candidates",
    )
    axes.scatter(
        stations[chosen, 0],
        stations[chosen, 1],
        marker="^",
        s=60,
        color=BLACK,
        edgecolors="white",
        linewidths=0.8,
        zorder=6,
        label="taken",
    )
    if chosen.sum() <= _NAMED:
        for place, name in zip(stations[chosen], np.array(found.names)[chosen], strict=True):
            note = axes.annotate(literal(str(name)), place, (5, 5), textcoords="offset points", fontsize=8, zorder=7)
            note.set_bbox({"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1})
    axes.set_xlim(found.x[0] * scale, found.x[-1] * scale)
    axes.set_ylim(found.y[0] * scale, found.y[-1] * scale)


def _course(axes: Axes, course: Array) -> None:
    """Draw bound and value (metres) over time; `course` (q, 3) contains seconds, bound and value."""
    seconds, bound, value = course.T
    seconds = seconds - seconds[0]
    axes.step(seconds, value, where="post", color=BLACK, linewidth=1.4, label="best set")
    axes.step(seconds, bound, where="post", color="#0072B2", linewidth=1.4, label="bound: no set is better")
    axes.fill_between(seconds, bound, value, step="post", color="#0072B2", alpha=0.12, linewidth=0)
    axes.set_xlabel("time since the first bound (s)")
    axes.set_ylabel("criterion (m)")
    axes.legend(fontsize=8, loc="lower right")
    axes.grid(visible=True, color=GREY, alpha=0.3, linewidth=0.5)
