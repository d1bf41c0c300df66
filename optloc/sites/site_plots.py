"""Pictures of placements and calibrations in one axes, as their methods `plot` return them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.problem import InvalidProblem
from optloc.show import BOUND, SMALL, axes_or_new, levels, literal, separate_notes
from optloc.sites.calibration.network_map import draw_network
from optloc.sites.placement.chosen import losses_of, maps_of
from optloc.sites.placement.placement_map import draw_map

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from optloc.sites.calibration.calibrated import Calibration
    from optloc.sites.placement.chosen import Placement
    from optloc.sites.placement.sites import SiteSelection

# Largest number of drawn alternatives of a network: more links would merge.
_OTHERS = 3


def placement_axes(
    found: Placement, selection: SiteSelection | None = None, *, ax: Axes | None = None, title: str = ""
) -> Axes:
    """Return a map of the bound with the taken stations: their names, and the criterion if one of them is lost.

    Parameters
    ----------
    found : Placement
        Result of `optloc.place`.
    selection : SiteSelection, optional
        The selection that was passed to `optloc.place`; by default `found.selection`.
    ax : matplotlib.axes.Axes, optional
        Where the map is drawn; by default in a new figure.
    title : str
        Title; by default the criterion.

    Raises
    ------
    InvalidProblem
        If matplotlib or the selection is missing, or the selection takes single rows.
    """
    from matplotlib.colors import LogNorm

    selection = found.selection if selection is None else selection
    if selection is None:
        raise InvalidProblem("the placement has no selection", "plot", "give it: placement.plot(selection=selection)")
    panel = axes_or_new(ax, 6.4, 5.8)
    made = maps_of(selection, found)
    steps = levels(made.maps[1].sigma)
    norm = LogNorm(steps[0], max(steps[-1], steps[0] * 2.0))
    lost = {
        one.name: f"lost: {one.value:.3g} m" if np.isfinite(one.value) else "(lost: no fix)" for one in losses_of(found)
    }
    drawn = draw_map(panel, made.maps[1], made.taken[1], made.places, made.weights, (steps, norm), lost)
    bar = panel.figure.colorbar(drawn, ax=panel, label=BOUND, ticks=steps, format=lambda value, _: f"{value:g}")
    bar.ax.minorticks_off()
    panel.set_title(literal(title or f"{len(found.chosen)} new stations: {found.sigma:.3g} m"), wrap=True)
    place: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.12), "ncols": 3}
    panel.legend(frameon=False, fontsize=SMALL, **place)
    separate_notes(panel.figure, [panel])
    return panel


def calibration_axes(
    found: Calibration, *, view: tuple[int, int] = (0, 1), ax: Axes | None = None, title: str = ""
) -> Axes:
    """Return a plan of a network: stations with their 95 % ellipses, pulses, prior places and alternatives.

    Parameters
    ----------
    found : Calibration
        Result of `optloc.calibrate`.
    view : tuple of 2 int
        Coordinates along the axes: (0, 1) for the plan, (0, 2) for x and z.
    ax : matplotlib.axes.Axes, optional
        Where the plan is drawn; by default in a new figure.
    title : str
        Title; by default the status.

    Raises
    ------
    InvalidProblem
        If matplotlib is missing, or the network has no such coordinates.
    """
    net, d = found.network, found.stations.shape[1]
    if len(set(view)) != 2 or not set(view) <= set(range(d)):
        raise InvalidProblem(f"a network in {d} dimensions has no view {view}", "view", "give two of 0, 1, 2 below it")
    panel = axes_or_new(ax)
    known = np.where(np.isfinite(net.place_sigma), net.place, np.nan)
    size = net.stations * d
    others = [other.stations for other in found.alternatives[:_OTHERS]]
    covariance = found.covariance[:size, :size]
    draw_network(panel, view, net.names, found.stations, covariance, found.pulses, known, others)
    panel.set_title(literal(title or f"status {found.status.label}"), wrap=True)
    place: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.12), "ncols": 2}
    panel.legend(frameon=False, fontsize=SMALL, **place)
    separate_notes(panel.figure, [panel])
    return panel


PLOTS: dict[str, Callable[..., Any]] = {"Placement": placement_axes, "Calibration": calibration_axes}
"""Functions that draw a value in one axes; see `optloc.problem.plot_of`."""
