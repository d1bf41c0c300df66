"""Estimates of a run against time, with their intervals: biases, and whatever else its epochs share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.errors import InvalidProblem
from optloc.layout import Slot
from optloc.plot.style import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, YELLOW, figure_class, grid
from optloc.solve.growing import Growing
from optloc.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CYCLE = (BLUE, ORANGE, GREEN, PURPLE, SKY, YELLOW)
_DASHES = ("-", "--", "-.", ":")
_MOST = 6
_95 = 1.959963984540054


def plot_biases(
    found: Growing, title: str = "", *, names: Sequence[str] | None = None, truth: Mapping[str, Array] | None = None
) -> Figure:
    """Return a picture of estimates against the length of a run, with 95 % intervals, one panel for each family.

    Parameters
    ----------
    found : Growing
        Estimates after the first epochs, of `optloc.solve.growing.growing`.
    title : str
        Title of the picture.
    names : sequence of str, optional
        What is drawn; all families of biases by default.
    truth : mapping of str to array, optional
        True values by name, drawn dotted.

    Returns
    -------
    matplotlib.figure.Figure
        To be written with `optloc.plot.save`.

    Raises
    ------
    InvalidProblem
        Where there is nothing to draw.
    """
    slots = [slot for slot in found.layout.shared if (bool(slot.members) if names is None else slot.name in names)]
    if not slots:
        advice = f"choose from {', '.join(slot.name for slot in found.layout.shared)}"
        raise InvalidProblem("the run has no biases to draw", "names", advice)
    columns = min(len(slots), 2)
    rows = -(-len(slots) // columns)
    figure = figure_class()(figsize=(0.8 + 5.4 * columns, 0.4 + 4.0 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel, slot in zip(panels, slots, strict=False):
        _panel(panel, found, slot, None if truth is None else truth.get(slot.name))
    for panel in panels[len(slots) :]:
        panel.set_axis_off()
    if title:
        figure.suptitle(title)
    return figure


def _panel(panel: Axes, found: Growing, slot: Slot, truth: Array | None) -> None:
    values, sigma = found.take(slot.name)
    for i, entry in enumerate(slot.entries[:_MOST]):
        colour, band = _CYCLE[i % len(_CYCLE)], _95 * sigma[:, i]
        style: dict[str, Any] = {"color": colour, "linewidth": 1.5, "linestyle": _DASHES[i % len(_DASHES)]}
        panel.plot(found.times, values[:, i], label=str(entry), zorder=3, **style)
        panel.fill_between(
            found.times, values[:, i] - band, values[:, i] + band, color=colour, alpha=0.18, linewidth=0.0
        )
        if truth is not None:
            panel.axhline(np.ravel(truth)[i], color=BLACK, linewidth=1.0, linestyle=":", zorder=2)
    _window(panel, values[:, :_MOST], sigma[:, :_MOST])
    hidden = len(slot.entries) - _MOST
    panel.set_title(slot.name + (f" (first {_MOST} of {len(slot.entries)})" if hidden > 0 else ""))
    panel.set_xlabel("time (s)")
    panel.set_ylabel(f"estimate and 95 % ({slot.unit})" if slot.unit else "estimate and 95 %")
    panel.legend(frameon=False, fontsize=8, ncols=2)
    grid(panel)


def _window(panel: Axes, values: Array, sigma: Array) -> None:
    """Limit the vertical axis to the last estimates and what their intervals were half way."""
    known = np.flatnonzero(np.isfinite(values).all(-1))
    if not len(known):
        return
    last, rim = values[known[-1]], 8.0 * np.nanmax(sigma[known[len(known) // 2]])
    panel.set_ylim(float(last.min() - rim), float(last.max() + rim))
