"""Parts of pictures of a scene: shapes of constraints, tracks, directions, and the surroundings of the fixes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.base.linalg import error_ellipse
from optloc.base.types import Array
from optloc.problem.determined import WITHOUT_PLACE
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.show.pictures.constraint_shapes import DrawnRegion
from optloc.show.pictures.scene import PLAN, PictureScene, View, local_frame
from optloc.show.pictures.style import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, xy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Half the side of the panel around the fixes: `_SEMI_AXES` largest semi-axes plus `_SPREAD` times the distance that
# holds 95 % of the fixes. If both are zero, as for a fix that constraints determine, `_HELD` times the extent of the
# stations.
_SEMI_AXES, _SPREAD, _HELD = 1.6, 1.1, 0.1
# Length of an unlimited wedge, in widths of the plan that it crosses.
_BEYOND = 3.0
# A pale tint of `YELLOW`.
_SAND = "#F6E0B5"
# Styles of the shapes of constraints by their look. Hatched areas and the side of ticks are excluded.
_LINES_OF: dict[str, dict[str, Any]] = {
    "inside": {"colors": GREY, "linewidths": 1.2, "linestyles": "--", "zorder": 1},
    "limit": {"colors": GREY, "linewidths": 1.2, "zorder": 1},
    "ground": {"colors": GREY, "linewidths": 0.6, "alpha": 0.7, "zorder": 0.5},
}
_AREAS_OF: dict[str, dict[str, Any]] = {
    "outside": {"facecolor": "none", "edgecolor": GREY, "hatch": "////", "linewidth": 1.2, "zorder": 0.8},
    # One opaque colour for area and edge: overlaps of segments stay invisible, and a narrow road stays visible.
    "road": {"facecolor": _SAND, "edgecolor": _SAND, "linewidth": 1.5, "zorder": 0.6},
}
# Distance between the ticks of a limit, points of 1/72 inch; and the largest extent of an outline that widens the plan,
# in extents of the plan.
_TICKS, _WIDENS = 7.0, 2.0


def draw_regions(
    panel: Axes, regions: Sequence[DrawnRegion], size: float, extent: float = 0.0, view: View = PLAN
) -> None:
    """Draw the shapes of constraints of a view in a panel with the unit `size`, m.

    Outlines widen the plan if they are not much larger than its `extent`, m.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline
    from matplotlib.patheffects import withTickedStroke

    seen: set[str] = set()
    for region in (each for each in regions if each.lines and each.view == view):
        lines, label = [line / size for line in region.lines], None if region.label in seen else region.label
        seen.add(region.label)
        if region.look in _AREAS_OF:
            rings = Outline.make_compound_path(*(Outline(line, closed=True) for line in lines))
            # An artist without autoscaling, so that a large shape does not shrink the rest of the plan.
            panel.add_artist(PathPatch(rings, label=label, **_AREAS_OF[region.look]))
        else:
            drawn = LineCollection(lines, label=label, **_LINES_OF[region.look])
            if region.look == "limit":
                drawn.set_path_effects([withTickedStroke(spacing=_TICKS)])
            panel.add_collection(drawn, autolim=False)
        if region.look in ("inside", "outside"):
            points = np.concatenate(region.lines)
            if np.ptp(points, axis=0).max() <= _WIDENS * extent:
                panel.update_datalim(points / size)


def draw_tracks(panel: Axes, scene: PictureScene, view: View, size: float) -> None:
    """Draw tracks of stations, paths of targets and known targets as lines."""
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


def draw_directions(panel: Axes, problem: Problem, fixes: Sequence[Fix], size: float) -> None:
    """Draw the directions of a single fix without a valid position as wedges and rays up to the limits of the plan.

    If the data determine a curve, the curve is drawn. Other fixes have no directions to draw.
    """
    if len(fixes) != 1 or fixes[0].code.size != 1 or int(fixes[0].code.ravel()[0]) not in WITHOUT_PLACE:
        return
    from matplotlib.collections import Collection, LineCollection, PolyCollection

    found = fixes[0].flat()[0].determined
    if found is None:
        return
    # Long enough to cross the plan; `autolim=False` keeps the limits of the plan.
    reach = size * _BEYOND * float(np.ptp((panel.get_xlim(), panel.get_ylim()), axis=1).max())
    wedges = [_horizontal(problem, found.wedge(one, reach, whole=True)) / size for one in found.directions]
    rays = [_horizontal(problem, found.ray(one, reach)) / size for one in found.directions]
    curves = [] if found.curve is None else [_horizontal(problem, found.curve) / size]
    drawn: list[Collection] = []
    if wedges:
        drawn.append(PolyCollection(wedges, color=SKY, alpha=0.35, label="95 % direction", zorder=0))
        drawn.append(LineCollection(rays, colors=BLUE, linestyles="--", label="most likely direction", zorder=1))
    if curves:
        drawn.append(LineCollection(curves, colors=PURPLE, label=found.curve_name, zorder=1))
    for each in drawn:
        panel.add_collection(each, autolim=False)


def _horizontal(problem: Problem, line: Array) -> Array:
    """Return the horizontal coordinates (n, 2), m, of a line (n, d) in the frame of the problem."""
    local = local_frame(problem)
    return np.asarray((line if local is None else local.from_ecef(line))[:, :2])


def centred(scene: PictureScene, centre: Array) -> PictureScene:
    """Return the scene with the origin of the plan at the point `centre` (2,), m."""
    shift = np.zeros(scene.stations.shape[-1])
    shift[:2] = centre
    return replace(
        scene.moved(lambda place: place - shift), regions=tuple(each.moved(-centre) for each in scene.regions)
    )


def half_side(scene: PictureScene, known: Array, centre: Array) -> float:
    """Return half the side of the panel around the fixes, m.

    `known` (n,) marks the fixes with a position, and `centre` (2,) is the centre of the panel, m. The panel holds most
    fixes and the largest ellipse or region.
    """
    outlined = np.array([bool(regions) for regions in scene.outlines] or [False] * len(known))
    semi_axes, _ = error_ellipse(scene.covariances[known & ~outlined][:, :2, :2])
    largest = np.max(semi_axes[np.isfinite(semi_axes)], initial=0.0)
    for fix, regions in zip(scene.fixes, scene.outlines, strict=False):
        for line in regions[PLAN].lines if regions else []:
            # Only the part around the fix counts; other parts are other positions, which the overview shows.
            if (line.min(0) <= 0.0).all() and (line.max(0) >= 0.0).all():
                largest = max(float(largest), float(np.abs(fix[:2] + line - centre).max()) / _SPREAD)
    distance = np.abs(scene.fixes[known][:, :2] - centre).max(-1)
    reach = _SEMI_AXES * float(largest) + _SPREAD * float(np.quantile(distance, 0.95))
    return reach if reach > 0.0 else _HELD * float(np.ptp(scene.stations[:, :2]) or 1.0)
