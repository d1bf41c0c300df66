"""Pictures of fixes: stations, estimate, 95 % ellipse and the other positions that the data allow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.base.linalg import error_ellipse
from optloc.base.types import Array
from optloc.plot import style as parts
from optloc.plot.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PLAN,
    Scene,
    View,
    apart,
    figure_class,
    scene_of,
    unit_of,
    xy,
)
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_fixes(problem: Problem, fixes: Fix | Sequence[Fix], title: str = "") -> Figure:
    """Return a picture of fixes.

    A plan of everything and a plan of the surroundings of the fix; in three dimensions a view of the height between
    them. One scale on both axes of each.

    Parameters
    ----------
    problem : Problem
        Gives the stations and the frame; ECEF is drawn along east, north and up at the stations' centre.
    fixes : Fix or sequence of Fix
        Single fixes or batches.
    title : str
        Title of the picture.

    Returns
    -------
    matplotlib.figure.Figure
        To be written with `optloc.plot.save`.
    """
    scene = scene_of(problem, [fixes] if isinstance(fixes, Fix) else fixes)
    spatial = scene.stations.shape[-1] == 3
    count = 1 + spatial + (near := _nearby(scene))
    figure = figure_class()(figsize=(0.4 + 5.0 * count, 5.2), layout="constrained")
    panels = figure.subplots(1, count, squeeze=False)[0]
    _overview(panels[0], scene, PLAN)
    if spatial:
        _overview(panels[1], scene, (0, 2))
    if near:
        _close(panels[-1], scene)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)
    if title:
        figure.suptitle(title)
    apart(figure)
    return figure


def _overview(panel: Axes, scene: Scene, view: View) -> None:
    lines = (*scene.tracks, *scene.paths, *scene.other_paths, *scene.known)
    everything = np.concatenate([scene.stations, scene.fixes, scene.alternatives, *lines])
    unit, size = unit_of(everything[:, view])
    if view == PLAN:
        _edges(panel, scene, size)
    parts.ellipses(panel, scene, view, size)
    _lines(panel, scene, view, size)
    parts.stations(panel, scene, view, size)
    parts.points(panel, scene, view, size)
    parts.name_axes(panel, scene, view, unit)
    panel.set_title("plan" if view == PLAN else "height")


def _edges(panel: Axes, scene: Scene, size: float) -> None:
    """Draw the outlines of the regions that must hold the target."""
    label: str | None = "region"
    for corners in scene.regions:
        ring = np.concatenate([corners, corners[:1]]) / size
        panel.plot(*ring.T, color=GREY, linewidth=1.2, linestyle="--", label=label, zorder=1)
        label = None


def _lines(panel: Axes, scene: Scene, view: View, size: float) -> None:
    """Draw what moves as lines, and known targets."""
    spots: dict[str, Any] = {"marker": "s", "markersize": 4, "markevery": [0]}
    styles: tuple[tuple[tuple[Array, ...], dict[str, Any]], ...] = (
        (scene.tracks, {"label": "track of a station", "color": BLACK, "linewidth": 1.0}),
        (scene.paths, {"label": "path of the target", "color": BLUE, "linewidth": 1.6}),
        (scene.other_paths, {"label": "path of an alternative", "color": ORANGE, "linewidth": 1.2, "linestyle": "--"}),
        (scene.known, {"label": "known target", "color": GREEN, "linewidth": 1.2, **spots}),
    )
    for lines, style in styles:
        for i, part in enumerate(lines):
            panel.plot(*xy(part, view, size), zorder=2, **(style if i == 0 else style | {"label": None}))


def _nearby(scene: Scene) -> bool:
    """Return whether the fixes are so close together that they deserve a panel of their own."""
    known = np.asarray(np.isfinite(scene.fixes).all(-1))
    if not known.any():
        return True
    return _reach(scene, known, np.median(scene.fixes[known][:, :2], axis=0)) < 0.3 * float(
        np.ptp(scene.stations[:, :2])
    )


def _close(panel: Axes, scene: Scene) -> None:
    """Draw the surroundings of the fixes: three times their ellipse, or their own spread."""
    known: Array = np.asarray(np.isfinite(scene.fixes).all(-1))
    view = PLAN
    if not known.any():
        panel.set_axis_off()
        panel.text(0.5, 0.5, "no fix", ha="center", va="center", transform=panel.transAxes)
        return
    centre = np.median(scene.fixes[known][:, view], axis=0)
    extent = _reach(scene, known, centre)
    unit, size = unit_of(np.array([centre - extent, centre + extent]) - centre)
    shifted = _moved(scene, centre)
    _edges(panel, shifted, size)
    parts.ellipses(panel, shifted, view, size)
    _lines(panel, shifted, view, size)
    parts.points(panel, shifted, view, size)
    parts.stations(panel, shifted, view, size, named=False)
    parts.name_axes(panel, shifted, view, unit)
    panel.set_aspect("equal", adjustable="box")
    panel.set_xlim(-extent / size, extent / size)
    panel.set_ylim(-extent / size, extent / size)
    panel.set_title(f"around {scene.axes[0]} {centre[0]:.1f} m, {scene.axes[1]} {centre[1]:.1f} m")


def _moved(scene: Scene, centre: Array) -> Scene:
    shift = np.zeros(scene.stations.shape[-1])
    shift[:2] = centre
    return replace(scene.moved(lambda place: place - shift), regions=tuple(ring - centre for ring in scene.regions))


def _reach(scene: Scene, known: Array, centre: Array) -> float:
    semi_axes, _ = error_ellipse(scene.covariances[known][:, :2, :2])
    largest = np.max(semi_axes[np.isfinite(semi_axes)], initial=0.0)
    away = np.abs(scene.fixes[known][:, :2] - centre).max(-1)
    reach = 1.6 * float(largest) + 1.1 * float(np.quantile(away, 0.95))
    return reach if reach > 0.0 else 0.1 * float(np.ptp(scene.stations[:, :2]) or 1.0)
