"""Maps of the accuracy bound before and after a choice of stations, and the loss of each station.

Letters: P places, s stations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from optloc.bounds import BoundMap
from optloc.problem import Array
from optloc.show import (
    BLACK,
    BLUE,
    BOUND,
    COLOURS,
    GREY,
    ORANGE,
    SMALL,
    WIDE,
    figure_class,
    levels,
    literal,
    separate_notes,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Largest number of taken stations with a label, and side of a map from which its axes are in kilometres,
# metres.
_NAMED, _FAR = 16, 5e3
# Largest number of drawn losses: more bars are thinner than their names.
_LOSSES = 12


class StationLoss(NamedTuple):
    """The effect of the loss of one station on the criterion, as standard deviations.

    - name: the station.
    - value: the criterion without the station, metres; not finite if the other stations give no fix.
    - replacement: the site that replaces it best; empty if no site can.
    - replaced: the criterion with the replacement, metres.
    """

    name: str
    value: float
    replacement: str
    replaced: float


def plot_placement(
    maps: Sequence[BoundMap],
    taken: Sequence[Array],
    places: Array,
    weights: Array,
    losses: Sequence[StationLoss],
    value: float,
    titles: Sequence[str],
) -> Figure:
    """Return a figure: two maps of the bound on one scale above the loss of each station.

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
    losses : sequence of StationLoss
        Losses of the taken stations, largest first.
    value : float
        The criterion of the taken stations as a standard deviation, metres.
    titles : sequence of 2 str
        Titles of the maps.
    """
    from matplotlib.colors import LogNorm

    steps = levels(np.concatenate([found.sigma.ravel() for found in maps]))
    norm = LogNorm(steps[0], max(steps[-1], steps[0] * 2.0))
    figure = figure_class()(figsize=(WIDE, 8.2), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=[2.4, 1.0])
    upper = [figure.add_subplot(grid[0, i]) for i in range(2)]
    for axes, found, chosen, title in zip(upper, maps, taken, titles, strict=True):
        drawn = draw_map(axes, found, chosen, places, weights, (steps, norm))
        axes.set_title(literal(title), fontsize=10, wrap=True)
    upper[1].set_ylabel("")
    bar = figure.colorbar(drawn, ax=upper, label=BOUND, ticks=steps, format=lambda value, _: f"{value:g}")
    bar.ax.minorticks_off()
    draw_losses(figure.add_subplot(grid[1, :]), losses, value)
    handles, labels = upper[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=SMALL, frameon=False)
    separate_notes(figure)
    return figure


def draw_map(
    axes: Axes,
    found: BoundMap,
    chosen: Array,
    places: Array,
    weights: Array,
    colours: tuple[list[float], Any],
    notes: Mapping[str, str] | None = None,
) -> Any:
    """Draw a map of the bound with places, candidates and taken stations, and return its coloured mesh.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
        Where the map is drawn.
    found : BoundMap
        The bound; its stations are all candidates.
    chosen : bool array (s,)
        Taken stations.
    places : array (P, 2)
        Places of interest, in the coordinates of the map.
    weights : array (P,)
        Weights of the places.
    colours : tuple of (list of float, matplotlib.colors.Normalize)
        Levels of the isolines, metres, and the colour scale.
    notes : mapping of str to str, optional
        Text below the name of a taken station.
    """
    steps, norm = colours
    scale = 1.0 if found.geodetic or max(np.ptp(found.x), np.ptp(found.y)) < _FAR else 1e-3
    x, y = found.x * scale, found.y * scale
    drawn = axes.pcolormesh(x, y, found.sigma, norm=norm, cmap=COLOURS, shading="nearest", rasterized=True)
    lines = axes.contour(x, y, found.sigma, levels=steps, colors=BLACK, linewidths=0.6, alpha=0.7)
    axes.clabel(lines, fmt=lambda value: f"{value:g}", fontsize=SMALL)
    _mark(axes, found, chosen, places * scale, weights, scale, notes or {})
    axes.set_aspect(1.0 / np.cos(np.radians(found.y.mean())) if found.geodetic else 1.0)
    unit = "deg" if found.geodetic else "m" if scale == 1.0 else "km"
    axes.set_xlabel(f"{'longitude' if found.geodetic else 'x'} ({unit})")
    axes.set_ylabel(f"{'latitude' if found.geodetic else 'y'} ({unit})")
    return drawn


def _mark(
    axes: Axes,
    found: BoundMap,
    chosen: Array,
    places: Array,
    weights: Array,
    scale: float,
    notes: Mapping[str, str],
) -> None:
    """Draw places, candidates and taken stations into a map (`found`).

    `chosen` (s,) marks the taken stations. `places` (P, 2) are in the units of the axes: metres, km or
    degrees. `scale` converts the positions of the stations to these units. The markers of places grow with
    their `weights` (P,). `notes` are texts below the names.
    """
    stations = found.stations * scale
    look: dict[str, Any] = {"marker": "x", "s": 30.0 + 50.0 * weights / weights.max(), "color": ORANGE}
    axes.scatter(*places.T, linewidths=1.3, zorder=4, label="places of interest", **look)
    # A dark outline: candidates must be visible on light and on dark parts of the map.
    look = {"s": 26, "facecolors": "white", "edgecolors": BLACK, "linewidths": 0.9}
    axes.scatter(*stations[~chosen].T, zorder=5, label="candidate, not taken", **look)
    look = {"marker": "^", "s": 60, "color": BLACK, "edgecolors": "white", "linewidths": 0.8}
    axes.scatter(*stations[chosen].T, zorder=6, label="taken", **look)
    if chosen.sum() <= _NAMED:
        for place, name in zip(stations[chosen], np.array(found.names)[chosen], strict=True):
            text = "\n".join([literal(str(name)), *([notes[str(name)]] if str(name) in notes else [])])
            note = axes.annotate(text, place, (5, 5), textcoords="offset points", fontsize=SMALL, zorder=7)
            note.set_bbox({"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1})
    axes.set_xlim(found.x[0] * scale, found.x[-1] * scale)
    axes.set_ylim(found.y[0] * scale, found.y[-1] * scale)


def draw_losses(axes: Axes, losses: Sequence[StationLoss], value: float) -> None:
    """Draw the criterion without each of the stations as bars, and with the best replacement as marks.

    `value` is the criterion of all taken stations, metres. A station without which no fix is possible has a text.
    """
    shown = losses[:_LOSSES]
    place = np.arange(len(shown))
    values = np.array([loss.value for loss in shown])
    replaced = np.array([loss.replaced if loss.replacement else np.nan for loss in shown])
    axes.barh(
        place, np.where(np.isfinite(values), values, np.nan), height=0.6, color=GREY, label="without this station"
    )
    mark: dict[str, Any] = {"marker": "D", "s": 28, "color": BLUE, "zorder": 4}
    axes.scatter(replaced, place, label="with the best other candidate instead", **mark)
    axes.axvline(value, color=BLACK, linewidth=1.2, linestyle="--", label="all taken stations")
    for i in np.flatnonzero(~np.isfinite(values)).tolist():
        axes.annotate("no fix", (value, i), (5, 0), textcoords="offset points", va="center", fontsize=SMALL)
    axes.set_yticks(place, [literal(loss.name) for loss in shown])
    axes.set_ylim(len(shown) - 0.4, -0.6)
    axes.set_xlabel("criterion (m)")
    axes.set_title("loss of one station", fontsize=10)
    axes.legend(fontsize=SMALL, loc="upper center", bbox_to_anchor=(0.5, -0.26), ncols=3, frameon=False)
    axes.grid(axis="x", color=GREY, alpha=0.3, linewidth=0.5)
    axes.set_axisbelow(True)
