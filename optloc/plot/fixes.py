"""Pictures of fixes: stations, estimate, 95 % ellipse and the other positions that the data allow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.ellipse import error_ellipse
from optloc.fix import Fix
from optloc.plot.style import BLACK, BLUE, GREEN, GREY, ORANGE, figure_class
from optloc.problem import Problem
from optloc.scene import Scene, scene_of
from optloc.types import Array

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
    _overview(panels[0], scene, (0, 1))
    if spatial:
        _overview(panels[1], scene, (0, 2))
    if near:
        _close(panels[-1], scene)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)
    if title:
        figure.suptitle(title)
    return figure


def _overview(panel: Axes, scene: Scene, view: tuple[int, int]) -> None:
    lines = (*scene.tracks, *scene.paths, *scene.other_paths, *scene.known)
    everything = np.concatenate([scene.stations, scene.fixes, scene.alternatives, *lines])
    unit, size = _unit(everything[:, view])
    if view == (0, 1):
        _edges(panel, scene, size)
    _ellipses(panel, scene, view, size)
    _lines(panel, scene, view, size)
    label = "station, first epoch" if scene.tracks else "station"
    panel.scatter(*_xy(scene.stations, view, size), marker="^", s=60, color=BLACK, label=label, zorder=3)
    if scene.stations.shape[0] <= 20:
        for name, x, y in zip(scene.names, *_xy(scene.stations, view, size), strict=True):
            panel.annotate(name, (x, y), xytext=(5, 5), textcoords="offset points", fontsize=8, zorder=6)
    _points(panel, scene, view, size)
    _frame(panel, scene, view, unit)
    panel.set_title("plan" if view == (0, 1) else "height")


def _edges(panel: Axes, scene: Scene, size: float) -> None:
    """Draw the outlines of the regions that must hold the target."""
    label: str | None = "region"
    for corners in scene.regions:
        ring = np.concatenate([corners, corners[:1]]) / size
        panel.plot(*ring.T, color=GREY, linewidth=1.2, linestyle="--", label=label, zorder=1)
        label = None


def _lines(panel: Axes, scene: Scene, view: tuple[int, int], size: float) -> None:
    """Draw what moves as lines, and known targets."""
    spots: dict[str, Any] = {"marker": "s", "markersize": 4, "markevery": [0]}
    styles: tuple[tuple[tuple[Array, ...], dict[str, Any]], ...] = (
        (scene.tracks, {"label": "track of a station", "color": BLACK, "linewidth": 1.0}),
        (scene.paths, {"label": "path of the target", "color": BLUE, "linewidth": 1.6}),
        (scene.other_paths, {"label": "path of an alternative", "color": ORANGE, "linewidth": 1.2, "linestyle": "--"}),
        (scene.known, {"label": "known target", "color": GREEN, "linewidth": 1.2, **spots}),
    )
    for parts, style in styles:
        for i, part in enumerate(parts):
            panel.plot(*_xy(part, view, size), zorder=2, **(style if i == 0 else style | {"label": None}))


def _points(panel: Axes, scene: Scene, view: tuple[int, int], size: float) -> None:
    many = len(scene.fixes) > 12
    for clean, colour, mark, label in ((True, BLUE, "o", "fix"), (False, ORANGE, "X", "fix, status not ok")):
        chosen = scene.fixes[scene.clean == clean]
        if len(chosen):
            panel.scatter(
                *_xy(chosen, view, size), marker=mark, s=12 if many else 70, color=colour, label=label, zorder=4
            )
    if len(scene.alternatives):
        style: dict[str, Any] = {"marker": "D", "s": 70, "facecolors": "none", "edgecolors": ORANGE, "linewidths": 1.8}
        panel.scatter(*_xy(scene.alternatives, view, size), label="alternative, with its cost gap", zorder=4, **style)
    for gap, x, y in zip(scene.gaps, *_xy(scene.alternatives, view, size), strict=True):
        panel.annotate(
            f"+{gap:.3g}" if gap >= 1e-3 else "+0",
            (x, y),
            xytext=(7, -12),
            textcoords="offset points",
            fontsize=8,
            color=ORANGE,
        )


def _ellipses(panel: Axes, scene: Scene, view: tuple[int, int], size: float) -> None:
    if len(scene.fixes) > 200:
        return
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    label: str | None = "95 % ellipse"
    for centre, covariance in zip(scene.fixes, scene.covariances, strict=True):
        semi_axes, directions = error_ellipse(covariance[np.ix_(view, view)])
        if np.isfinite(semi_axes).all() and np.isfinite(centre).all():
            line = centre[list(view)] + circle * semi_axes @ directions.T
            panel.plot(*(line.T / size), color=BLUE, linewidth=1.5, label=label, zorder=2)
            label = None


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
    view = (0, 1)
    if not known.any():
        panel.set_axis_off()
        panel.text(0.5, 0.5, "no fix", ha="center", va="center", transform=panel.transAxes)
        return
    centre = np.median(scene.fixes[known][:, view], axis=0)
    extent = _reach(scene, known, centre)
    unit, size = _unit(np.array([centre - extent, centre + extent]) - centre)
    shifted = _moved(scene, centre)
    _edges(panel, shifted, size)
    _ellipses(panel, shifted, view, size)
    _lines(panel, shifted, view, size)
    _points(panel, shifted, view, size)
    panel.scatter(*_xy(shifted.stations, view, size), marker="^", s=60, color=BLACK, zorder=3)
    _frame(panel, shifted, view, unit)
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


def _frame(panel: Axes, scene: Scene, view: tuple[int, int], unit: str) -> None:
    panel.margins(0.12)
    panel.set_aspect("equal", adjustable="datalim")
    panel.grid(color=GREY, alpha=0.35, linewidth=0.6)
    panel.set_xlabel(f"{scene.axes[view[0]]} ({unit})")
    panel.set_ylabel(f"{scene.axes[view[1]]} ({unit})")


def _xy(points: Array, view: tuple[int, int], size: float) -> tuple[Array, Array]:
    return points[:, view[0]] / size, points[:, view[1]] / size


def _unit(points: Array) -> tuple[str, float]:
    """Return the unit in which points (n, 2) of metres read best, and its size."""
    reach = np.nanmax(np.abs(points), initial=1e-3)
    return ("km", 1e3) if reach >= 5e3 else ("m", 1.0) if reach >= 1.0 else ("mm", 1e-3)
