"""Figures 1 to 3 of the paper: position error and bound against time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from optloc.papers.registration.trials import History, rms
from optloc.papers.report import canvas

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BLACK, _BLUE, _ORANGE, _GREEN = "#000000", "#0072B2", "#D55E00", "#009E73"
_CURVE = 40


def against_time(
    histories: Sequence[History], titles: Sequence[str], printed: Sequence[float | None], zoom: int | None = None
) -> Figure:
    """Return root mean square position errors and the bound against time, one panel for each history.

    Parameters
    ----------
    histories : sequence of History
        What is drawn.
    titles : sequence of str
        One for each panel.
    printed : sequence of float or None
        Error at 600 s that the paper names, metres.
    zoom : int, optional
        One more panel with the last history from this second on.
    """
    panels = list(zip(histories, titles, printed, strict=True))
    if zoom is not None:
        panels.append((histories[-1], f"the same from {zoom} s on", printed[-1]))
    figure = canvas(0.4 + 5.0 * len(panels), 4.6)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for i, (ax, (history, title, value)) in enumerate(zip(axes, panels, strict=True)):
        _panel(ax, history, value, zoom if zoom is not None and i == len(panels) - 1 else None)
        ax.set_title(title)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    return figure


def _two_or_five(value: float, place: float) -> str:
    """Return the label of a minor tick of a logarithmic axis: 20, 50, 200, 500 and no other."""
    return f"{value:.0f}" if f"{value:.0e}"[0] in "25" else ""


def _panel(ax: Axes, history: History, printed: float | None, since: int | None) -> None:
    step = history.setting.scenario.interval
    keep = [i for i, k in enumerate(history.epochs) if since is None or k * step >= since]
    epochs = [history.epochs[i] for i in keep]
    curve = np.unique(np.linspace(epochs[0], epochs[-1], _CURVE).astype(int))
    ax.plot(
        step * curve, [rms(bound) for bound in history.setting.bounds(curve)], color=_BLACK, label="Cramér-Rao bound"
    )
    times = step * np.array(epochs)
    if history.plain is not None:
        plain = [history.plain[i].rmse for i in keep]
        ax.plot(times, plain, "o", color=_ORANGE, mfc="none", ms=9, label="recursion of the paper")
    ax.plot(times, [history.found[i].rmse for i in keep], "x", color=_BLUE, ms=7, mew=2, label="optloc, no guess")
    if printed is not None:
        ax.plot([600.0], [printed], "D", color=_GREEN, ms=6, label="printed at 600 s")
    if since is None:
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter("{x:.0f}")
        ax.yaxis.set_minor_formatter(_two_or_five)
    ax.set_xlabel("time, s")
    ax.set_ylabel("position error, m (root mean square)")
    ax.grid(visible=True, which="both", alpha=0.25)
