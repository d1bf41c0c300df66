"""Errors of the four filters against time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from optloc.papers.report import canvas
from optloc.papers.satellites.tables import NAMES
from optloc.papers.satellites.trials import Run
from optloc.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Wide lines below narrow ones: filters that agree are all seen.
_STYLE = {
    "ekf": ("#D55E00", "-", 5.0),
    "mvekf": ("#E69F00", "-", 3.2),
    "mgekf": ("#009E73", "-", 1.8),
    "iekf": ("#0072B2", "--", 1.2),
    "quartic + ekf": ("#CC79A7", ":", 1.8),
}


def filters(panels: Mapping[str, tuple[Mapping[str, Run], Array]]) -> Figure:
    """Return root mean square errors and the posterior bound against steps, one panel for each start.

    Parameters
    ----------
    panels : mapping of str to (mapping of str to Run, array (steps,))
        Filters and bound by title.
    """
    figure = canvas(0.6 + 6.0 * len(panels), 4.8)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for ax, (title, (runs, bound)) in zip(axes, panels.items(), strict=True):
        for name, (colour, dash, width) in _STYLE.items():
            if name in runs:
                run = runs[name]
                steps = np.arange(len(bound) - len(run.rms) + 1, len(bound) + 1)
                ax.plot(steps, run.rms, dash, color=colour, lw=width, label=NAMES[name])
        ax.plot(np.arange(1, len(bound) + 1), bound, color="#000000", lw=0.9, label="posterior bound")
        ax.set_title(title)
        _scaled(ax)
    kept = {label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(kept.values(), kept.keys(), loc="outside lower center", ncols=len(kept), frameon=False)
    return figure


def heights(found: Mapping[str, Run]) -> Figure:
    """Return errors, and what the filter claims of them (dotted), against steps, by what is known of the height."""
    figure = canvas(8.0, 5.2)
    ax = figure.subplots()
    # A wide line below a narrow one: two estimates that agree are both seen.
    styles = (
        ("#0072B2", 1.8),
        ("#009E73", 1.8),
        ("#56B4E9", 1.8),
        ("#D55E00", 4.0),
        ("#CC79A7", 1.6),
        ("#000000", 1.8),
    )
    for (colour, width), (name, run) in zip(styles, found.items(), strict=False):
        steps = np.arange(1, run.error.shape[1] + 1)
        ax.plot(steps, run.rms, color=colour, lw=width, label=name)
        ax.plot(steps, run.claimed.mean(0), ":", color=colour, lw=1.4)
    _scaled(ax)
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure


def _two_or_five(value: float, place: float) -> str:
    """Return the label of a minor tick of a logarithmic axis: 2 and 5 in every decade."""
    return f"{value:g}" if f"{value:.0e}"[0] in "25" else ""


def _scaled(ax: Axes) -> None:
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter(_two_or_five)
    ax.set_xlabel("step, one a second")
    ax.set_ylabel("position error, m (root mean square)")
    ax.grid(visible=True, which="both", alpha=0.25)
