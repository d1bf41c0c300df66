"""The Cramer-Rao bound against time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from optloc.bounds import Course
from optloc.layout import Slot
from optloc.plot.style import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, YELLOW, figure_class

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CYCLE = (ORANGE, GREEN, PURPLE, SKY, YELLOW, GREY, BLACK)
_MANY = 10
_WORDS = {"position": ("position", "m"), "velocity": ("velocity", "m/s"), "acceleration": ("acceleration", "m/s²")}


def plot_course(
    course: Course, known: Course | None = None, title: str = "", names: Sequence[str] | None = None
) -> Figure:
    """Return a picture of the bound against time, one panel for each state of a target and each family of biases.

    Parameters
    ----------
    course : Course
        The bound of everything that is unknown.
    known : Course, optional
        The same with biases known, drawn dashed.
    title : str
        Title of the picture.
    names : sequence of str, optional
        Names of the unknowns that are drawn; all by default.

    Returns
    -------
    matplotlib.figure.Figure
        To be written with `optloc.plot.save`.
    """
    slots = [slot for slot in course.layout.shared if names is None or slot.name in names]
    columns = min(len(slots), 3)
    rows = -(-len(slots) // columns)
    figure = figure_class()(figsize=(0.6 + 4.8 * columns, 0.4 + 4.2 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel, slot in zip(panels, slots, strict=False):
        _panel(panel, course, known, slot)
    for panel in panels[len(slots) :]:
        panel.set_axis_off()
    if title:
        figure.suptitle(title)
    return figure


def _panel(panel: Axes, course: Course, known: Course | None, slot: Slot) -> None:
    word, unit = _WORDS.get(slot.name.partition("[")[0], (slot.name, slot.unit))
    sigma, entries = course.sigma(slot.name), slot.entries
    if slot.members and slot.size > _MANY:
        entries, sigma = ("root mean square",), course.total(slot.name)[:, None] / np.sqrt(slot.size)
    for entry, values, colour in zip(entries, sigma.T, _CYCLE * 2, strict=False):
        label = f"{word} {entry}".strip() if slot.members else f"along {entry}"
        panel.plot(course.times, values, color=colour, linewidth=1.8 if slot.members else 1.0, label=label, zorder=3)
    if not slot.members:
        panel.plot(course.times, course.total(slot.name), color=BLUE, linewidth=3.5, label=f"in {_SPACE[slot.size]}")
        if known is not None:
            total = known.total(slot.name)
            panel.plot(known.times, total, color=BLUE, linewidth=1.6, linestyle="--", label="the same, biases known")
    panel.set_yscale("log")
    panel.set_xlabel("time (s)")
    panel.set_ylabel(f"bound of the standard deviation ({unit})")
    panel.set_title(slot.name)
    panel.grid(which="both", color=GREY, alpha=0.3, linewidth=0.6)
    panel.legend(frameon=False, fontsize=8)


_SPACE = {2: "the plane", 3: "space"}
