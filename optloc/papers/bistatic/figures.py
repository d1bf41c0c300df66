"""Errors against time, and one run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from optloc.papers.bistatic.trials import Errors
from optloc.papers.report import canvas
from optloc.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Dashes over a full line: two estimators that agree are both seen.
_STYLE = {
    "single fix": ("#999999", "-"),
    "simplified": ("#D55E00", "-"),
    "simplified, no restart": ("#D55E00", "-"),
    "maximum likelihood": ("#0072B2", "--"),
    "restart every 50": ("#009E73", "-"),
    "gain floor 0.05": ("#CC79A7", "-"),
    "Cartesian EKF": ("#E69F00", "-"),
    "line fit": ("#0072B2", "-"),
}
_NAMES = ("range, km", "azimuth, rad", "elevation, rad")
_UNITS = (1e-3, 1.0, 1.0)


def against_time(found: Mapping[str, Errors], bound: tuple[Array, Array], points: Mapping[str, Errors]) -> Figure:
    """Return root mean square errors of range, azimuth and elevation against the number of epochs.

    Parameters
    ----------
    found : mapping of str to Errors
        Curves.
    bound : tuple of array (q,) and array (q, 3)
        Numbers of epochs and the bound.
    points : mapping of str to Errors
        Estimates after one number of epochs each.
    """
    figure = canvas(15.0, 4.6)
    axes = figure.subplots(1, 3)
    for i, ax in enumerate(axes):
        ax.plot(bound[0], _UNITS[i] * bound[1][:, i], color="#000000", lw=1.0, label="Cramér-Rao bound")
        for name, errors in found.items():
            spread = _UNITS[i] * np.sqrt((errors.error[..., i] ** 2).mean(0))
            ax.plot(errors.epochs, spread, _STYLE[name][1], color=_STYLE[name][0], lw=1.6, label=name)
        for name, errors in points.items():
            spread = _UNITS[i] * np.sqrt((errors.error[..., i] ** 2).mean(0))
            ax.plot(errors.epochs, spread, "D", color="#000000", mfc="none", ms=7, label=name)
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter(_two_or_five)
        _named(ax, f"error of {_NAMES[i]} (root mean square)")
    handles, labels = axes[0].get_legend_handles_labels()
    kept = {label: handle for handle, label in zip(handles, labels, strict=True)}
    figure.legend(kept.values(), kept.keys(), loc="outside lower center", ncols=4, frameon=False)
    return figure


def one_run(found: Mapping[str, Errors]) -> Figure:
    """Return the errors of the first run of each estimator against the number of epochs."""
    figure = canvas(15.0, 4.6)
    axes = figure.subplots(1, 3)
    for i, ax in enumerate(axes):
        for name, errors in found.items():
            thin = 0.7 if name == "single fix" else 1.6
            ax.plot(errors.epochs, _UNITS[i] * errors.error[0, :, i], color=_STYLE[name][0], lw=thin, label=name)
        ax.axhline(0.0, color="#000000", lw=0.8)
        _named(ax, f"error of {_NAMES[i]}")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _two_or_five(value: float, place: float) -> str:
    """Return the label of a minor tick of a logarithmic axis: 2 and 5 in every decade."""
    return f"{value:g}" if f"{value:.0e}"[0] in "25" else ""


def _named(ax: Axes, label: str) -> None:
    ax.set_xlabel("epochs, one a second")
    ax.set_ylabel(label)
    ax.grid(visible=True, which="both", alpha=0.25)
