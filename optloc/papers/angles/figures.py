"""Figures 1 to 7 of the paper as errors and bounds against time, and one of the starts that lose the track."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from optloc.papers.angles import printed
from optloc.papers.angles.filters import Curve
from optloc.papers.angles.scenario import REPAIRED
from optloc.papers.report import canvas
from optloc.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BLACK, _GREY, _BLUE, _ORANGE, _GREEN, _PURPLE = (
    "#000000",
    "#7F7F7F",
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
)
_PARTS = ("position error, m", "velocity error, m/s", "acceleration error, m/s²")
_EDGES = (1e-3, 1e8)
Style = tuple[str, str, str]
"""Label, colour and line style of a curve."""


def three_parts(curves: Mapping[Style, Curve], values: Sequence[float]) -> Figure:
    """Return errors of position, velocity and acceleration against time, one panel for each.

    Parameters
    ----------
    curves : mapping of (label, colour, line) to Curve
        What is drawn.
    values : sequence of three float
        Printed errors over the whole track.
    """
    figure = canvas(13.0, 4.4)
    axes = figure.subplots(1, 3)
    for part, (ax, name) in enumerate(zip(axes, _PARTS, strict=True)):
        for (label, colour, line), curve in curves.items():
            ax.plot(curve.seconds, curve.error[:, part], line, color=colour, label=label)
        ax.axhline(values[part], color=_PURPLE, linestyle=":", label="printed, over the track")
        _dressed(ax, name)
    _legend(figure, axes[0])
    return figure


def straight(curves: Sequence[Curve]) -> Figure:
    """Return figures 1 to 3: simulation 1."""
    by = {c.label: c for c in curves}
    return three_parts(
        {
            ("filter, a_max 2", _BLUE, "-"): by["filter, a_max 2"],
            ("filter, a_max 30", _GREEN, "-"): by["filter, a_max 30"],
            ("printed f33, a_max 2", _ORANGE, "-"): by["printed f33, a_max 2"],
            ("posterior bound, a_max 2", _BLACK, "--"): by["posterior bound, a_max 2"],
            ("bound of one track", _GREY, "--"): by["bound of one track"],
        },
        printed.STRAIGHT,
    )


def winding(curves: Sequence[Curve]) -> Figure:
    """Return figures 4 to 6: simulation 2."""
    looks = ((_ORANGE, "-"), (_BLUE, "-"), (_BLACK, "--"))
    return three_parts({(c.label, *look): c for c, look in zip(curves, looks, strict=True)}, printed.WINDING)


def circles(found: Mapping[float, Sequence[Curve]], snapshot: Curve) -> Figure:
    """Return figure 7: position errors of the repaired simulation 3, one panel for each limit."""
    figure = canvas(13.0, 4.6)
    axes = figure.subplots(1, len(found), sharey=True, squeeze=False)[0]
    for ax, (limit, curves) in zip(axes, found.items(), strict=True):
        ax.axvspan(*REPAIRED.phases[:2], color="#EEEEEE")
        ax.plot(snapshot.seconds, snapshot.error[:, 0], ":", color=_GREY, label="bound of every second by itself")
        by = {c.label: c for c in curves}
        # The two filters hardly differ: the converged one is a broad line behind the other.
        looks = (
            ("converged", _ORANGE, "-", 4.0),
            ("single step", _BLUE, "-", 1.2),
            ("posterior bound", _BLACK, "--", 1.5),
        )
        for label, colour, line, width in looks:
            ax.plot(by[label].seconds, by[label].error[:, 0], line, color=colour, label=label, lw=width)
        _dressed(ax, "position error, m (root mean square)", logarithmic=False)
        ax.set_title(f"a_max = {limit:g} m/s²; shaded: circle with 74 m/s²")
        ax.set_ylim(0.0, 1800.0)
    axes[1].set_ylabel("")
    _legend(figure, axes[0])
    return figure


def starts(ends: Mapping[str, Array]) -> Figure:
    """Return the share of tracks that end nearer to the truth than a distance.

    Parameters
    ----------
    ends : mapping of str to array (trials,)
        Distances at the end, by label.
    """
    figure = canvas(7.0, 4.4)
    ax = figure.subplots()
    looks = ((_ORANGE, "-", 1.5), (_BLUE, "-", 4.0), (_GREEN, "--", 1.5))
    for (label, values), (colour, line, width) in zip(ends.items(), looks, strict=True):
        ordered = np.sort(np.append(np.where(np.isfinite(values), values, np.inf), _EDGES))
        share = np.searchsorted(np.sort(values), ordered, side="right") / len(values)
        ax.step(ordered, share, line, where="post", color=colour, label=label, lw=width)
    ax.axvline(10.0, color=_GREY, linestyle=":", label="counts as lost")
    ax.set_xscale("log")
    ax.set_xlim(*_EDGES)
    ax.set_xlabel("distance from the truth at 50 s, m")
    ax.set_ylabel("share of tracks")
    ax.grid(visible=True, alpha=0.25)
    ax.legend(loc="lower right", frameon=False)
    return figure


def _dressed(ax: Axes, name: str, *, logarithmic: bool = True) -> None:
    if logarithmic:
        ax.set_yscale("log")
    ax.set_xlabel("time, s")
    ax.set_ylabel(name)
    ax.grid(visible=True, alpha=0.25)


def _legend(figure: Figure, ax: Axes) -> None:
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
