"""Pictures of fixes: stations, estimates, 95 % ellipses or regions, alternatives and lines of position.

A panel shows two axes of the scene, its view, in a unit of `size` metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.base.types import Array
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.show.pictures import style
from optloc.show.pictures.notes import scale_bar, separate_notes
from optloc.show.pictures.position_lines import draw_lines_of_fix
from optloc.show.pictures.scene import HEIGHT, PLAN, PictureScene, View, scene_of
from optloc.show.pictures.scene_parts import centred, draw_directions, draw_regions, draw_tracks, half_side
from optloc.show.pictures.style import WIDE, figure_class, finish, unit_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# The overview shows the fixes well if their extent is at least this share of the extent of the stations. Otherwise the
# picture has a panel around the fixes.
_CLOSE = 0.3


def plot_fixes(problem: Problem, fixes: Fix | Sequence[Fix], title: str = "") -> Figure:
    """Return a picture of fixes: an overview, the surroundings of the fixes and, in 3-D, a view of the height.

    Both axes of a panel have the same scale. If there is a single fix, the plans also show lines of position at its
    height: the positions that fit one row exactly, such as hyperbolas, circles and rays. If there are many range rates,
    the lines are isodoppler curves.

    Parameters
    ----------
    problem : Problem
        Gives the stations and the frame. If the frame is ECEF, the axes are east, north and up at the centre of the
        stations.
    fixes : Fix or sequence of Fix
        Single fixes or batches.
    title : str
        Title of the picture.

    Returns
    -------
    matplotlib.figure.Figure
        The picture; write it with `optloc.show.pictures.save`.
    """
    every = [fixes] if isinstance(fixes, Fix) else fixes
    scene = scene_of(problem, every, outlined=True)
    spatial = scene.stations.shape[-1] == 3
    count = 1 + spatial + (near := _needs_surroundings(scene))
    # Panels: overview, height in three dimensions, and the surroundings if a fix is only a dot in the overview.
    figure, panels = _panels(count)
    sizes = [draw_overview(panels[0], scene, PLAN)]
    if spatial:
        draw_overview(panels[1], scene, HEIGHT)
    if near:
        sizes.append(draw_surroundings(panels[-1], scene))
    if len(every) == 1 and every[0].code.size == 1 and np.isfinite(scene.fixes).all():
        centres = (np.zeros(2), scene.fixes[0, :2])
        for panel, size, centre in zip((panels[0], panels[-1]), sizes, centres, strict=False):
            if draw_lines_of_fix(panel, problem, every[0], centre, size) and spatial and panel is panels[0]:
                panel.set_title("plan, lines at the height of the fix")
    draw_directions(panels[0], problem, every, sizes[0])
    finish(figure, title, panels[:1])
    # Limits of a plan are final only after the layout of the figure.
    figure.draw_without_rendering()
    # The plans are the first panel and, with the surroundings, the last panel.
    for panel in panels[:: len(panels) - 1] if near else panels[:1]:
        if panel.axison:
            scale_bar(panel, panel.get_xlabel().rpartition("(")[2].rstrip(")"))
    separate_notes(figure)
    return figure


def _panels(count: int) -> tuple[Figure, list[Axes]]:
    """Return a figure with one to three panels: the overview, the height or the surroundings, the surroundings.

    Of three panels, the height is a wide panel below the two plans.
    """
    size = {1: (5.4, 5.2), 2: (WIDE, 5.0), 3: (WIDE, 7.4)}[count]
    figure = figure_class()(figsize=size, layout="constrained")
    if count < 3:
        return figure, figure.subplots(1, count, squeeze=False)[0].tolist()
    names: Any = [["plan", "around"], ["height", "height"]]
    made = figure.subplot_mosaic(names, height_ratios=[2.0, 1.0])
    return figure, [made["plan"], made["height"], made["around"]]


def draw_overview(panel: Axes, scene: PictureScene, view: View) -> float:
    """Draw stations, fixes, alternatives and tracks, and return the size of the unit of the axes, m.

    The size is 1 for metres and 1000 for kilometres.
    """
    lines = (*scene.tracks, *scene.paths, *scene.other_paths, *scene.known)
    everything = np.concatenate([scene.stations, scene.fixes, scene.alternatives, *lines])
    unit, size = unit_of(everything[:, view])
    draw_regions(panel, scene.regions, size, float(np.ptp(everything[:, :2], axis=0).max()), view)
    style.ellipses(panel, scene, view, size)
    draw_tracks(panel, scene, view, size)
    style.stations(panel, scene, view, size)
    style.points(panel, scene, view, size)
    style.name_axes(panel, scene, view, unit)
    panel.set_title("plan" if view == PLAN else "height")
    return size


def _needs_surroundings(scene: PictureScene) -> bool:
    """Return whether the fixes are so close together that the picture needs a panel around them.

    The result is also True if no fix has a position; the panel then contains only a text.
    """
    known = np.asarray(np.isfinite(scene.fixes).all(-1))
    if not known.any():
        return True
    reach = half_side(scene, known, np.median(scene.fixes[known][:, :2], axis=0))
    # Tracks count too: the extent of a single moving station is the extent of its track.
    return reach < _CLOSE * float(np.ptp(np.concatenate([scene.stations, *scene.tracks])[:, :2]))


def draw_surroundings(panel: Axes, scene: PictureScene) -> float:
    """Draw the surroundings of the fixes with their ellipses, and return the size of the unit of the axes, m.

    The origin of the panel is the median of the fixes. If there is no fix, the panel contains only a text.
    """
    known: Array = np.asarray(np.isfinite(scene.fixes).all(-1))
    view = PLAN
    if not known.any():
        panel.set_axis_off()
        panel.text(0.5, 0.5, "no fix", ha="center", va="center", transform=panel.transAxes)
        return 1.0
    # Use medians, so that one outlier among many fixes does not move the panel.
    centre = np.median(scene.fixes[known][:, view], axis=0)
    extent = half_side(scene, known, centre)
    unit, size = unit_of(np.array([centre - extent, centre + extent]) - centre)
    shifted = centred(scene, centre)
    draw_regions(panel, shifted.regions, size)
    style.ellipses(panel, shifted, view, size)
    draw_tracks(panel, shifted, view, size)
    style.points(panel, shifted, view, size)
    style.stations(panel, shifted, view, size, named=False)
    style.name_axes(panel, shifted, view, unit)
    panel.set_aspect("equal", adjustable="box")
    panel.set_xlim(-extent / size, extent / size)
    panel.set_ylim(-extent / size, extent / size)
    panel.set_title(f"around {scene.axes[0]} {centre[0]:.1f} m, {scene.axes[1]} {centre[1]:.1f} m")
    return size
