"""Pictures of fixes: stations, estimates, 95 % ellipses or regions, alternatives and lines of position.

A panel shows two axes of the scene, its view, in a unit of `size` metres. A line of position holds the positions that
fit one row exactly; it is found as a zero line of the residual of the row on a grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from optloc.base.frames import Frame
from optloc.base.linalg import error_ellipse
from optloc.base.types import Array, Rows
from optloc.linear.evaluate import differentiate
from optloc.models import MODELS, RAY, Point
from optloc.models.layers import Layers
from optloc.problem.determined import WITHOUT_PLACE
from optloc.problem.fix import Fix
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem
from optloc.show.pictures import style
from optloc.show.pictures.constraint_shapes import DrawnRegion
from optloc.show.pictures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    HEIGHT,
    ORANGE,
    PLAN,
    PURPLE,
    SKY,
    YELLOW,
    PictureScene,
    View,
    figure_class,
    finish,
    local_frame,
    placed_points,
    scene_of,
    separate_notes,
    unit_of,
    xy,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# The overview shows the fixes well if their extent is at least this share of the extent of the stations. Otherwise the
# picture has a panel around the fixes.
_CLOSE = 0.3
# Half the side of the panel around the fixes: `_SEMI_AXES` largest semi-axes plus `_SPREAD` times the distance that
# holds 95 % of the fixes. If both are zero, as for a fix that constraints determine, `_HELD` times the extent of the
# stations.
_SEMI_AXES, _SPREAD, _HELD = 1.6, 1.1, 0.1
# Maximum number of range rates with curves, evenly spread over a run; points along a side of the grid on which curves
# are traced; and the side of the grid in widths of the panel, because a panel can be wider or taller than its limits.
_CURVES, _GRID, _WIDE = 9, 161, 2.0
# Maximum number of rows with lines of position: more lines are unreadable.
_LINES = 24
# Legend of the lines of each kind.
_SHAPES = {
    "tdoa": "hyperbola of a time difference",
    "toa": "hyperbola of two arrivals",
    "range": "circle of a range",
    "range_sum": "ellipse of a bistatic range",
    "azimuth": "ray of a bearing",
    "isodoppler": "equal Doppler through the fix",
}
# Length of an unlimited wedge, in widths of the plan that it crosses.
_BEYOND = 3.0
# Horizontal distance from the origin, m, at which the surface of the Earth is almost vertical; and iterations to find
# the surface.
_STEEP, _STEPS = 5.5e6, 12


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
    figure = figure_class()(figsize=(0.4 + 5.0 * count, 5.2), layout="constrained")
    # Panels: overview, height in three dimensions, and the surroundings if a fix is only a dot in the overview.
    panels = figure.subplots(1, count, squeeze=False)[0]
    sizes = [_draw_overview(panels[0], scene, PLAN)]
    if spatial:
        _draw_overview(panels[1], scene, HEIGHT)
    if near:
        sizes.append(_draw_surroundings(panels[-1], scene))
    if len(every) == 1 and every[0].code.size == 1 and np.isfinite(scene.fixes).all():
        centres = (np.zeros(2), scene.fixes[0, :2])
        for panel, size, centre in zip((panels[0], panels[-1]), sizes, centres, strict=False):
            if _draw_position_lines(panel, problem, every[0], centre, size) and spatial and panel is panels[0]:
                panel.set_title("plan, lines at the height of the fix")
    _draw_directions(panels[0], problem, every, sizes[0])
    finish(figure, title, panels[:1])
    # Limits of a plan are final only after the layout of the figure.
    figure.draw_without_rendering()
    # The plans are the first panel and, with the surroundings, the last panel.
    for panel in panels[:: len(panels) - 1] if near else panels[:1]:
        if panel.axison:
            style.scale_bar(panel, panel.get_xlabel().rpartition("(")[2].rstrip(")"))
    separate_notes(figure)
    return figure


def _draw_overview(panel: Axes, scene: PictureScene, view: View) -> float:
    """Draw stations, fixes, alternatives and tracks, and return the size of the unit of the axes, m.

    The size is 1 for metres and 1000 for kilometres.
    """
    lines = (*scene.tracks, *scene.paths, *scene.other_paths, *scene.known)
    everything = np.concatenate([scene.stations, scene.fixes, scene.alternatives, *lines])
    unit, size = unit_of(everything[:, view])
    draw_regions(panel, scene.regions, size, float(np.ptp(everything[:, :2], axis=0).max()), view)
    style.ellipses(panel, scene, view, size)
    _draw_tracks(panel, scene, view, size)
    style.stations(panel, scene, view, size)
    style.points(panel, scene, view, size)
    style.name_axes(panel, scene, view, unit)
    panel.set_title("plan" if view == PLAN else "height")
    return size


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


def _draw_tracks(panel: Axes, scene: PictureScene, view: View, size: float) -> None:
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


def _draw_directions(panel: Axes, problem: Problem, fixes: Sequence[Fix], size: float) -> None:
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


def _needs_surroundings(scene: PictureScene) -> bool:
    """Return whether the fixes are so close together that the picture needs a panel around them.

    The result is also True if no fix has a position; the panel then contains only a text.
    """
    known = np.asarray(np.isfinite(scene.fixes).all(-1))
    if not known.any():
        return True
    reach = _half_side(scene, known, np.median(scene.fixes[known][:, :2], axis=0))
    # Tracks count too: the extent of a single moving station is the extent of its track.
    return reach < _CLOSE * float(np.ptp(np.concatenate([scene.stations, *scene.tracks])[:, :2]))


def _draw_surroundings(panel: Axes, scene: PictureScene) -> float:
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
    extent = _half_side(scene, known, centre)
    unit, size = unit_of(np.array([centre - extent, centre + extent]) - centre)
    shifted = _centred(scene, centre)
    draw_regions(panel, shifted.regions, size)
    style.ellipses(panel, shifted, view, size)
    _draw_tracks(panel, shifted, view, size)
    style.points(panel, shifted, view, size)
    style.stations(panel, shifted, view, size, named=False)
    style.name_axes(panel, shifted, view, unit)
    panel.set_aspect("equal", adjustable="box")
    panel.set_xlim(-extent / size, extent / size)
    panel.set_ylim(-extent / size, extent / size)
    panel.set_title(f"around {scene.axes[0]} {centre[0]:.1f} m, {scene.axes[1]} {centre[1]:.1f} m")
    return size


def _centred(scene: PictureScene, centre: Array) -> PictureScene:
    """Return the scene with the origin of the plan at the point `centre` (2,), m."""
    shift = np.zeros(scene.stations.shape[-1])
    shift[:2] = centre
    return replace(
        scene.moved(lambda place: place - shift), regions=tuple(each.moved(-centre) for each in scene.regions)
    )


def _half_side(scene: PictureScene, known: Array, centre: Array) -> float:
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


# Lines of position: positions that fit one row exactly.


class PositionLine(NamedTuple):
    """The positions that fit one row exactly.

    - kind: kind of the row, or "isodoppler".
    - name: names of the stations.
    - line (p, 2): the positions in x and y, in the units of the grid.
    """

    kind: str
    name: str
    line: Array


def _draw_position_lines(panel: Axes, problem: Problem, fix: Fix, centre: Array, size: float) -> bool:
    """Draw the lines of position in a plan whose origin is `centre`, m, and return whether there are lines."""
    if _only_target(problem.flat(), fix.flat()) is None:
        return False
    (west, east), (south, north) = panel.get_xlim(), panel.get_ylim()
    middle, half = np.array([west + east, south + north]) / 2.0, _WIDE * max(east - west, north - south) / 2.0
    corners = size * np.stack([middle - half, middle + half]) + centre
    # Use a coarser grid for layers: a bent ray takes a thousand times longer to compute than a straight ray.
    side = _GRID if not isinstance(problem.medium, Layers) else _GRID // 3
    x, y = (np.linspace(low, high, side) for low, high in corners.T)
    places = _at_height(problem, fix, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    found = lines_of_position(problem, fix, x, y, places)
    draw_lines(panel, found, centre, size)
    return bool(found)


def draw_lines(panel: Axes, found: Sequence[PositionLine], centre: Array, size: float) -> None:
    """Draw lines of position in a plan with the origin `centre`, m, and the unit `size`, m."""
    from matplotlib.collections import LineCollection

    for kind, colour in zip(dict.fromkeys(one.kind for one in found), cycle((PURPLE, SKY, GREEN, YELLOW))):
        lines = [(one.line - centre) / size for one in found if one.kind == kind]
        label = _SHAPES.get(kind, f"positions that fit one {kind.removeprefix(RAY)}")
        # Curves do not change the limits of a plan (autolim=False), because they can be much longer than the scene.
        look: dict[str, Any] = {"colors": colour, "linewidths": 1.0, "alpha": 0.8, "zorder": 1}
        panel.add_collection(LineCollection(lines, label=label, **look), autolim=False)


def lines_of_position(problem: Problem, fix: Fix, x: Array, y: Array, places: Array) -> list[PositionLine]:
    """Return the positions that fit each row exactly, as lines; other unknowns have their values at the fix.

    Time differences give hyperbolas; arrivals give hyperbolas with the first arrival; ranges give circles, bearings
    rays. If there are many rows, only some range rates have lines: the isodoppler curves through the fix.

    Parameters
    ----------
    problem : Problem
        A problem with one unknown target.
    fix : Fix
        Its fix.
    x, y : array (n,), (m,)
        Grid of a plan or a map.
    places : array (m n, d)
        Points of the grid in the frame of the problem, m; NaN for points without a position.
    """
    flat, answer = problem.flat(), fix.flat()
    target = _only_target(flat, answer)
    if target is None:
        return []
    count = sum(int((rows.target == target).sum()) for rows in flat.rows)
    if count > _LINES or (flat.motions[target].order > 0 and flat.epochs > 1):
        return [PositionLine("isodoppler", name, line) for name, line in isodopplers(problem, fix, x, y, places)]
    slot, _ = flat.layout.find(state_names(target, len(flat.motions), 0)[0])
    vectors = np.tile(answer.x[0], (len(places), 1))
    vectors[:, slot.start : slot.start + slot.size] = places[:, : slot.size]
    with np.errstate(all="ignore"):
        residual = differentiate(flat, vectors)[0]
    found: list[PositionLine] = []
    for rows, start in zip(flat.rows, flat.starts, strict=True):
        found += _lines_of(flat, rows, target, residual[:, start : start + rows.count], x, y)
    return found


def _only_target(flat: Problem, answer: Fix) -> int | None:
    """Return the index of the only unknown target; None if there are several or the target has no single fix."""
    sought = [i for i, motion in enumerate(flat.motions) if motion.known is None]
    single = flat.batch_shape == (1,) and bool(np.isfinite(answer.x).all())
    if len(sought) != 1 or not single or flat.motions[sought[0]].span == "epoch":
        return None
    return sought[0]


def _lines_of(problem: Problem, rows: Rows, target: int, residual: Array, x: Array, y: Array) -> list[PositionLine]:
    """Return the zero lines of residuals on a grid, for the rows of one kind and one target.

    `residual` (points, m) are the residuals of the m rows at the points of the grid, x fastest. `x` and `y` are the
    grid lines.
    """
    from contourpy import contour_generator

    model, names = MODELS[rows.kind], problem.stations.names
    present = (rows.weight.reshape(-1, rows.count)[0] > 0.0) & (rows.target == target)
    found = []
    for i in np.flatnonzero(present).tolist():
        values, ends = residual[:, i], [names[k] for k in (rows.a[i], rows.b[i]) if k >= 0]
        if model.emission:
            # The emission time is unknown, so subtract the residual of the first arrival: the difference is a measured
            # quantity.
            same = np.flatnonzero(present & (rows.epoch == rows.epoch[i]))
            first = same[np.argmin(rows.z.reshape(-1, rows.count)[0, same])]
            if first == i:
                continue
            values, ends = values - residual[:, first], [*ends, names[rows.a[first]]]
        if model.period is not None:
            # Behind a station, a bearing jumps by a full turn: mask this sign change, which is no line of position.
            values = np.where(np.abs(values) < 0.25 * model.period, values, np.nan)
        made = contour_generator(x, y, np.ma.masked_invalid(values.reshape(len(y), len(x)))).lines(0.0)
        found += [PositionLine(rows.kind, " – ".join(ends), np.asarray(line)) for line in made]
    return found


def isodopplers(problem: Problem, fix: Fix, x: Array, y: Array, places: Array) -> list[tuple[str, Array]]:
    """Return curves on which a range rate, or a difference of range rates, has the same value as at the fix.

    Parameters
    ----------
    problem : Problem
        A problem with one unknown target.
    fix : Fix
        Its fix.
    x, y : array (n,), (m,)
        Grid of a plan or a map.
    places : array (m n, d)
        Points of the grid in the frame of the problem, m; NaN for points without a position.

    Returns
    -------
    list of (str, array (p, 2))
        Names of at most nine rows, and their lines in x and y. The list is empty if the target moves during a run, or
        there is no fix.
    """
    from contourpy import contour_generator

    flat, answer = problem.flat(), fix.flat()
    rates = [rows for rows in flat.rows if MODELS[rows.kind].velocity]
    target = _only_target(flat, answer)
    if target is None or not rates or (flat.motions[target].order > 0 and flat.epochs > 1):
        return []
    # The last point is the fix; its value is the level of the curve.
    places = np.concatenate([places, answer.position.reshape(1, -1)])
    velocity = answer.velocity.reshape(-1) if flat.motions[target].order else np.zeros(flat.dimension)
    found = []
    # The zero lines of the value minus the value at the fix are the curves.
    for rows, row in _chosen_rows(rates, target):
        value = _rate(flat, rows, row, places, velocity)
        excess = np.ma.masked_invalid((value[:-1] - value[-1]).reshape(len(y), len(x)))
        ends = " – ".join(flat.stations.names[k] for k in (rows.a[row], rows.b[row]) if k >= 0)
        made = contour_generator(x, y, excess).lines(0.0)
        found += [(f"{rows.kind} {ends}, as at the fix", np.asarray(line)) for line in made]
    return found


def _chosen_rows(rates: Sequence[Rows], target: int) -> list[tuple[Rows, int]]:
    """Return the rows of a target with positive weight as pairs of rows and number.

    If there are more than `_CURVES` rows, only evenly chosen rows are returned.
    """
    present = [(rows.weight.reshape(-1, rows.count)[0] > 0.0) & (rows.target == target) for rows in rates]
    every = [(rows, i) for rows, mask in zip(rates, present, strict=True) for i in np.flatnonzero(mask).tolist()]
    return [every[i] for i in np.unique(np.linspace(0, len(every) - 1, min(_CURVES, len(every))).astype(int)).tolist()]


def _rate(problem: Problem, rows: Rows, row: int, places: Array, velocity: Array) -> Array:
    """Return the modelled value (n,) of a row, m/s, for a target at positions (n, d), m, with `velocity` (d,), m/s.

    `row` is the number of the row in `rows`. `places` are the positions.
    """

    def at(array: Array | None, index: int) -> tuple[float, ...]:
        # Position or velocity of a station at the epoch of the row; stations at rest have one epoch.
        if array is None:
            return (0.0,) * problem.dimension
        epoch = rows.epoch[row] if array.shape[-3] > 1 else 0
        return tuple(array.reshape(-1, *array.shape[-3:])[0, epoch, index].tolist())

    stations = problem.stations
    a, b = (Point(at(stations.position, i[row]), at(stations.velocity, i[row])) for i in (rows.a, rows.b))
    target = Point(tuple(places.T), tuple(velocity))
    with np.errstate(all="ignore"):
        # Use straight rays also for media with bent rays: the curve still passes through the fix.
        return np.asarray(MODELS[MODELS[rows.kind].straight or rows.kind].h(target, a, b))


def _at_height(problem: Problem, fix: Fix, plan: Array) -> Array:
    """Return points (n, d), m, in the frame of the problem, above a plan (n, 2) and at the height of the fix.

    Points beyond the horizon are NaN.
    """
    fixed = fix.position.reshape(1, -1)
    if problem.dimension == 2:
        return plan
    frame = local_frame(problem) or problem.frame
    if not frame.geodetic:
        return np.column_stack([plan, np.full(len(plan), fixed[0, 2])])
    height = float(problem.frame.to_geodetic(fixed)[2][0])
    return placed_points(problem, np.column_stack([plan, _third_coordinate(frame, plan, height)]))[0]


def _third_coordinate(frame: Frame, plan: Array, height: float) -> Array:
    """Return the third coordinate (n,), m, of points above a plan that have a given height above the ellipsoid.

    `frame` has the axes east, north and up, and `plan` (n, 2) are the first two coordinates, m. A point beyond the
    horizon gets NaN. The method is Newton iteration from the surface of a sphere.
    """
    across = np.linalg.norm(plan, axis=1)
    near = across < _STEEP
    centre = np.linalg.norm(frame.origin_ecef())
    up = np.full(len(plan), np.nan)
    up[near] = np.sqrt(centre**2 - across[near] ** 2) - centre
    for _ in range(_STEPS):
        at = np.column_stack([plan[near], up[near]])
        # Increase of the height for each metre along the third axis of the picture, for a spherical Earth.
        gain = (up[near] + centre) / np.hypot(across[near], up[near] + centre)
        up[near] -= (frame.to_geodetic(at)[2] - height) / gain
    return up
