"""Pictures of fixes: stations, estimate, the ellipse or region of 95 % and the other positions that the data allow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.base.linalg import error_ellipse
from optloc.base.types import Array
from optloc.plot import style
from optloc.plot.outlines import rings
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
    finish,
    scene_of,
    unit_of,
    xy,
)
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Reach of the fixes, as a share of the spread of the stations, from which the overview shows them well enough.
_CLOSE = 0.3
# Panel around the fixes: so many semi-axes of the largest ellipse, and of the distance that holds 95 % of the fixes.
# The last is the share of the stations' spread where both are zero, as of a fix that constraints hold.
_SEMI_AXES, _SPREAD, _HELD = 1.6, 1.1, 0.1


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
    scene = scene_of(problem, [fixes] if isinstance(fixes, Fix) else fixes, outlined=True)
    spatial = scene.stations.shape[-1] == 3
    count = 1 + spatial + (near := _nearby(scene))
    figure = figure_class()(figsize=(0.4 + 5.0 * count, 5.2), layout="constrained")
    # Overview, height in space, and the surroundings where the overview shows no more than a dot.
    panels = figure.subplots(1, count, squeeze=False)[0]
    _overview(panels[0], scene, PLAN)
    if spatial:
        _overview(panels[1], scene, (0, 2))
    if near:
        _close(panels[-1], scene)
    finish(figure, title, panels[:1])
    apart(figure)
    return figure


def _overview(panel: Axes, scene: Scene, view: View) -> None:
    lines = (*scene.tracks, *scene.paths, *scene.other_paths, *scene.known)
    everything = np.concatenate([scene.stations, scene.fixes, scene.alternatives, *lines])
    unit, size = unit_of(everything[:, view])
    if view == PLAN:
        _edges(panel, scene, size)
    style.ellipses(panel, scene, view, size)
    _lines(panel, scene, view, size)
    style.stations(panel, scene, view, size)
    style.points(panel, scene, view, size)
    style.name_axes(panel, scene, view, unit)
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
    for lines, look in styles:
        for i, part in enumerate(lines):
            panel.plot(*xy(part, view, size), zorder=2, **(look if i == 0 else look | {"label": None}))


def _nearby(scene: Scene) -> bool:
    """Return whether the fixes are so close together that they deserve a panel of their own."""
    known = np.asarray(np.isfinite(scene.fixes).all(-1))
    if not known.any():
        return True
    reach = _reach(scene, known, np.median(scene.fixes[known][:, :2], axis=0))
    return reach < _CLOSE * float(np.ptp(scene.stations[:, :2]))


def _close(panel: Axes, scene: Scene) -> None:
    """Draw the surroundings of the fixes: what is beyond their ellipses, or their own spread."""
    known: Array = np.asarray(np.isfinite(scene.fixes).all(-1))
    view = PLAN
    if not known.any():
        panel.set_axis_off()
        panel.text(0.5, 0.5, "no fix", ha="center", va="center", transform=panel.transAxes)
        return
    # Medians: one wild fix of many must not move the panel.
    centre = np.median(scene.fixes[known][:, view], axis=0)
    extent = _reach(scene, known, centre)
    unit, size = unit_of(np.array([centre - extent, centre + extent]) - centre)
    shifted = _shift(scene, centre)
    _edges(panel, shifted, size)
    style.ellipses(panel, shifted, view, size)
    _lines(panel, shifted, view, size)
    style.points(panel, shifted, view, size)
    style.stations(panel, shifted, view, size, named=False)
    style.name_axes(panel, shifted, view, unit)
    panel.set_aspect("equal", adjustable="box")
    panel.set_xlim(-extent / size, extent / size)
    panel.set_ylim(-extent / size, extent / size)
    panel.set_title(f"around {scene.axes[0]} {centre[0]:.1f} m, {scene.axes[1]} {centre[1]:.1f} m")


def _shift(scene: Scene, centre: Array) -> Scene:
    shift = np.zeros(scene.stations.shape[-1])
    shift[:2] = centre
    return replace(scene.moved(lambda place: place - shift), regions=tuple(ring - centre for ring in scene.regions))


def _reach(scene: Scene, known: Array, centre: Array) -> float:
    outlined = np.array([bool(pieces) for pieces in scene.outlines] or [False] * len(known))
    semi_axes, _ = error_ellipse(scene.covariances[known & ~outlined][:, :2, :2])
    largest = np.max(semi_axes[np.isfinite(semi_axes)], initial=0.0)
    for fix, pieces in zip(scene.fixes, scene.outlines, strict=False):
        for line in rings([piece[:, :2] for piece in pieces]):
            # The part around the fix, whole; other parts are other positions, which the overview shows.
            if (line.min(0) <= fix[:2]).all() and (fix[:2] <= line.max(0)).all():
                largest = max(float(largest), float(np.abs(line - centre).max()) / _SPREAD)
    away = np.abs(scene.fixes[known][:, :2] - centre).max(-1)
    reach = _SEMI_AXES * float(largest) + _SPREAD * float(np.quantile(away, 0.95))
    return reach if reach > 0.0 else _HELD * float(np.ptp(scene.stations[:, :2]) or 1.0)
