"""A network in plan and elevation: stations with ellipses, pulses, prior positions and alternatives.

Letters: M stations, N pulses, d coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from optloc.problem import Array
from optloc.show import BLACK, BLUE, GREY, ORANGE, SMALL, WIDE, figure_class, literal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Root of the 95 % quantile of chi-square with two degrees of freedom.
_RADIUS = 2.447746830680816
# Points of an ellipse, and width of the histogram bars: narrow enough to show the shape of a normal
# distribution.
_POINTS, _BAR = 60, 0.25
# Larger residuals (in standard deviations) go into the last bars: a gross residual must not compress the others
# into one bar.
_FAR = 5.0


def plot_network(
    names: Sequence[str],
    stations: Array,
    covariance: Array,
    pulses: Array,
    known: Array,
    others: Sequence[Array],
    residuals: Array,
    dof: int,
    title: str,
) -> Figure:
    """Return a figure with plan, elevation (in space) and histogram of the residuals of a network.

    Parameters
    ----------
    names : sequence of M str
        Names of the stations.
    stations : array (M, d)
        Station positions, metres.
    covariance : array (M d, M d)
        Covariance of the station coordinates, square metres.
    pulses : array (N, d)
        Pulse positions, metres; NaN for unknown positions.
    known : array (M, d)
        Prior station positions, metres; NaN for unknown positions.
    others : sequence of arrays (M, d)
        Stations of other networks that fit the data, in the same frame, metres.
    residuals : array (...)
        Residuals in standard deviations; NaN for missing measurements.
    dof : int
        Degrees of freedom; the expected spread of the residuals depends on them, since the fit makes residuals
        smaller.
    title : str
        Title of the figure.
    """
    d = stations.shape[1]
    figure = figure_class()(figsize=(WIDE, 4.8 if d == 2 else 6.4), layout="constrained")
    figure.suptitle(literal(title))
    grid = figure.add_gridspec(d - 1, 2, width_ratios=[2.0, 1.0], height_ratios=[2.0, 1.0][: d - 1])
    views = [(0, 1)] if d == 2 else [(0, 1), (0, 2)]
    for row, view in enumerate(views):
        axes = figure.add_subplot(grid[row, 0])
        draw_network(axes, view, names, stations, covariance, pulses, known, others)
        if row == 0:
            axes.legend(fontsize=SMALL, loc="best")
    _histogram(figure.add_subplot(grid[:, 1]), residuals[np.isfinite(residuals)], dof)
    return figure


def _histogram(axes: Axes, residuals: Array, dof: int) -> None:
    """Draw the whitened residuals (n,) and their expected normal distribution.

    The variance of this distribution is dof / n, because the fit makes residuals smaller.
    """
    edges = np.arange(-_FAR, _FAR + _BAR, _BAR)
    weights = np.full(residuals.size, 1.0 / (max(residuals.size, 1) * _BAR))
    axes.hist(np.clip(residuals, -_FAR, _FAR), bins=edges.tolist(), weights=weights, color=GREY)
    if residuals.size and dof > 0:
        spread = np.sqrt(min(dof / residuals.size, 1.0))
        x = np.linspace(-_FAR, _FAR, 200)
        law = np.exp(-0.5 * (x / spread) ** 2) / (np.sqrt(2.0 * np.pi) * spread)
        axes.plot(x, law, color=BLACK, label=f"expected, {dof} degrees of freedom")
        axes.legend(fontsize=SMALL, loc="upper right")
        axes.margins(y=0.2)
    beyond = int((np.abs(residuals) > _FAR).sum())
    title = "residuals" + (f"; {beyond} beyond {_FAR:g} in the last bars" if beyond else "")
    axes.set(xlabel="residual (standard deviations)", ylabel="density", title=title)


def draw_network(
    axes: Axes,
    view: tuple[int, int],
    names: Sequence[str],
    stations: Array,
    covariance: Array,
    pulses: Array,
    known: Array,
    others: Sequence[Array],
) -> None:
    """Draw the network in the plane of two coordinates, `view` (for instance 0 and 1 for x and y).

    `plot_network` explains the other arguments.
    """
    i, k = view
    d = stations.shape[1]
    axes.plot(pulses[:, i], pulses[:, k], ".", color=GREY, markersize=4, label="pulses" if len(pulses) else None)
    for place, other in ((s, o) for one in others for s, o in zip(stations, one, strict=True)):
        axes.plot([place[i], other[i]], [place[k], other[k]], "-", color=GREY, linewidth=0.6)
    for n, one in enumerate(others):
        label = "other networks that fit" if n == 0 else None
        axes.plot(one[:, i], one[:, k], "o", markerfacecolor="none", color=GREY, label=label)
    axes.plot(known[:, i], known[:, k], "x", color=ORANGE, label="known" if np.isfinite(known).any() else None)
    axes.plot(stations[:, i], stations[:, k], "^", color=BLUE, label="stations, 95 %")
    turn = np.linspace(0.0, 2.0 * np.pi, _POINTS)
    circle = _RADIUS * np.array([np.cos(turn), np.sin(turn)])
    for n, name in enumerate(names):
        block = covariance[np.ix_([n * d + i, n * d + k], [n * d + i, n * d + k])]
        if np.isfinite(block).all():
            width, turned = np.linalg.eigh(block)
            shape = turned @ (np.sqrt(np.maximum(width, 0.0))[:, None] * circle)
            axes.plot(stations[n, i] + shape[0], stations[n, k] + shape[1], color=BLUE, linewidth=0.8)
        axes.annotate(
            literal(name), (stations[n, i], stations[n, k]), xytext=(5, 5), textcoords="offset points", fontsize=SMALL
        )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{'xyz'[i]} (m)", ylabel=f"{'xyz'[k]} (m)")
