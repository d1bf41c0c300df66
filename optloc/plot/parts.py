"""What plans are made of: stations, fixes, alternatives, ellipses, axes with units."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.ellipse import error_ellipse
from optloc.plot.style import BLACK, BLUE, ORANGE, grid
from optloc.scene import Scene
from optloc.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

View = tuple[int, int]
"""Which two of the scene's axes a panel shows."""

PLAN: View = (0, 1)
_NAMED = 20


def xy(points: Array, view: View, size: float) -> tuple[Array, Array]:
    """Return the two coordinates of points (n, d) that a panel shows, in its unit."""
    return points[:, view[0]] / size, points[:, view[1]] / size


def stations(panel: Axes, scene: Scene, view: View, size: float, *, named: bool = True, **style: Any) -> None:
    """Draw the stations, with their names where there are not too many."""
    label = "station, first epoch" if scene.tracks else "station"
    look: dict[str, Any] = {"marker": "^", "s": 60, "color": BLACK, "label": label, "zorder": 3} | style
    panel.scatter(*xy(scene.stations, view, size), **look)
    if named and scene.stations.shape[0] <= _NAMED:
        for name, x, y in zip(scene.names, *xy(scene.stations, view, size), strict=True):
            note(panel, name, x, y)


def note(panel: Axes, text: str, x: float, y: float, colour: str = BLACK) -> None:
    """Write a note beside a point, readable over lines and colours."""
    from matplotlib.patheffects import withStroke

    style: dict[str, Any] = {"fontsize": 8, "color": colour, "zorder": 6, "annotation_clip": True}
    made = panel.annotate(text, (x, y), xytext=(5, 5), textcoords="offset points", **style)
    made.set_path_effects([withStroke(linewidth=2.0, foreground="white")])


def points(panel: Axes, scene: Scene, view: View, size: float) -> None:
    """Draw fixes, and alternatives with their cost gaps."""
    many = len(scene.fixes) > 12
    for clean, colour, mark, label in ((True, BLUE, "o", "fix"), (False, ORANGE, "X", "fix, status not ok")):
        chosen = scene.fixes[scene.clean == clean]
        if len(chosen):
            look: dict[str, Any] = {
                "marker": mark,
                "s": 12 if many else 70,
                "color": colour,
                "label": label,
                "zorder": 4,
            }
            panel.scatter(*xy(chosen, view, size), **look)
    if len(scene.alternatives):
        style: dict[str, Any] = {"marker": "D", "s": 70, "facecolors": "none", "edgecolors": ORANGE, "linewidths": 1.8}
        panel.scatter(*xy(scene.alternatives, view, size), label="alternative, with its cost gap", zorder=4, **style)
    for gap, x, y in zip(scene.gaps, *xy(scene.alternatives, view, size), strict=True):
        note(panel, f"+{gap:.3g}" if gap >= 1e-3 else "+0", x, y, ORANGE)


def ellipses(panel: Axes, scene: Scene, view: View, size: float, **style: Any) -> None:
    """Draw the 95 % ellipses of the fixes."""
    if len(scene.fixes) > 200:
        return
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    look: dict[str, Any] = {"color": BLUE, "linewidth": 1.5, "label": "95 % ellipse", "zorder": 2} | style
    for centre, covariance in zip(scene.fixes, scene.covariances, strict=True):
        semi_axes, directions = error_ellipse(covariance[np.ix_(view, view)])
        if np.isfinite(semi_axes).all() and np.isfinite(centre).all():
            line = centre[list(view)] + circle * semi_axes @ directions.T
            panel.plot(*(line.T / size), **look)
            look["label"] = None


def name_axes(panel: Axes, scene: Scene, view: View, unit: str) -> None:
    """Give both axes of a plan one scale, names and units."""
    panel.margins(0.12)
    panel.set_aspect("equal", adjustable="datalim")
    grid(panel)
    panel.set_xlabel(f"{scene.axes[view[0]]} ({unit})")
    panel.set_ylabel(f"{scene.axes[view[1]]} ({unit})")
