"""Pictures of the cost around a fix, and of the starts from which iterations reach the best fit.

A panel shows the plan of the scene in a unit of `size` metres.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Status
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.show.pictures import style
from optloc.show.pictures.bound_map import levels
from optloc.show.pictures.notes import scale_bar, separate_notes
from optloc.show.pictures.position_lines import draw_lines, lines_of_position
from optloc.show.pictures.scene import PLAN, PictureScene, placed_points, scene_of
from optloc.show.pictures.style import BLACK, BLUE, ORANGE, SMALL, WIDE, YELLOW, figure_class, finish, unit_of
from optloc.solvers.landscape import Basins, End, basins, profile_cost

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = "YlGnBu_r"
"""Colour map of the cost: dark for a low cost; lightness increases with the cost."""

# Points along each side of a panel: each point is a separate problem, and isolines through fewer points have corners.
_POINTS = 121
# Levels of the isolines around the fix, standard deviations. Near the fix the covariance describes them; farther away
# their shape shows the nonlinearity.
_SIGMAS = (1, 2, 3, 4, 5, 7, 10)
# 95 % quantile of chi-square with two degrees of freedom, the coordinates of a plan.
_CHI2_95 = 5.991464547107979
# Half the side of the panel around the fix, in standard deviations of the larger coordinate: the 95 % ellipse (2.4) and
# a margin.
_AROUND = 4.2
_NAME = "root of the excess cost (standard deviations)\n(darker: better fit)"
# Maximum number of rows times starts in one batch, limited by memory; and the resulting limits of the starts along a
# side.
_ROWS, _STARTS = 4e6, (31, 161)
_NAMES = {"taylor": "plain Taylor iteration", "lsr": "damped least squares"}
_ENDS = {
    End.REACHED: "the best fit",
    End.ELSEWHERE: "a worse fit elsewhere",
    End.NOWHERE: "no convergence",
}
_COLOURS = {End.REACHED: BLUE, End.ELSEWHERE: YELLOW, End.NOWHERE: "#e4e4e4"}


def plot_landscape(problem: Problem, fix: Fix, title: str = "") -> Figure:
    """Return two plans of the cost: an overview, and the surroundings of the fix.

    The colour is the root of the cost minus the cost of the fix, in standard deviations. At each point, the other
    unknowns have the values of the best fit. In three dimensions, the overview is at the height of the fix. Around the
    fix, the height has the value of the best fit too, so that the 95 % line can be compared with the ellipse.

    Parameters
    ----------
    problem : Problem
        A single problem with one target that has one position in the whole run.
    fix : Fix
        Its fix.
    title : str
        Title of the picture.

    Returns
    -------
    matplotlib.figure.Figure
        The picture; write it with `optloc.show.pictures.save`.

    Raises
    ------
    InvalidProblem
        If there are several fixes or targets, or no fix.
    """
    flat, answer = single(problem, fix)
    scene = scene_of(flat, [answer])
    figure = figure_class()(figsize=(WIDE, 6.2), layout="constrained")
    whole, near = figure.subplots(1, 2)
    _draw_overview(whole, flat, answer, scene)
    _draw_surroundings(near, flat, answer, scene)
    finish(figure, title, (whole, near))
    separate_notes(figure)
    return figure


def single(problem: Problem, fix: Fix) -> tuple[Problem, Fix]:
    """Return a problem and its fix as flat batches of one; raise InvalidProblem unless there is one position."""
    flat, answer = problem.flat(), fix.flat()
    sought = sum(motion.known is None for motion in problem.motions)
    if len(answer) != 1 or sought != 1 or not flat.layout.shares("position"):
        what = f"the picture shows one position, but there are {len(answer)} fixes of {sought} targets"
        raise InvalidProblem(what, "plot", "draw one epoch, or a run of one target")
    if not np.isfinite(answer.x).all():
        raise InvalidProblem(f"the problem has no fix: {answer.reason[0]}", "plot", "see `optloc fix`")
    return flat, answer


def limits(scene: PictureScene, widen: float = 0.25) -> Array:
    """Return the square [[x0, y0], [x1, y1]], m, that holds stations, fix and alternatives with a margin.

    `widen` is the margin on each side as a share of the extent of these points.
    """
    points = np.concatenate([scene.stations, scene.fixes, scene.alternatives])[:, :2]
    low, high = points.min(0), points.max(0)
    half = (0.5 + widen) * float((high - low).max() or 1.0)
    middle = 0.5 * (low + high)
    return np.stack([middle - half, middle + half])


def plane(corners: Array, count: int, above: Array) -> tuple[Array, Array, Array]:
    """Return the grid of a square: x (n,), y (n,) and points (n n, d), m, at the height of the point `above` (d,)."""
    x, y = (np.linspace(low, high, count) for low, high in corners.T)
    east, north = np.meshgrid(x, y)
    points = np.tile(above, (count * count, 1))
    points[:, 0], points[:, 1] = east.ravel(), north.ravel()
    return x, y, points


def _excess(problem: Problem, fix: Fix, points: Array, fixed: int) -> Array:
    """Return the root (n,) of the cost at points minus the cost of the fix, in standard deviations.

    Parameters
    ----------
    problem, fix : Problem, Fix
        Problem and fix with one position.
    points : array (n, d)
        Points along the axes of the picture, m.
    fixed : int
        Number of fixed coordinates: all coordinates, or only the plan while the height has the value of the best fit.
    """
    # The solver works in the frame of the problem, but the fixed coordinates are along the axes of the picture.
    places, axes = placed_points(problem, points)
    cost = profile_cost(problem, fix.x[0], places, axes[:fixed])
    return np.asarray(np.sqrt(np.maximum(cost - fix.cost[0], 0.0)))


def _draw_overview(panel: Axes, problem: Problem, fix: Fix, scene: PictureScene) -> None:
    """Draw the cost over the whole scene with its isolines, stations, fix and alternatives.

    In three dimensions, the cost is at the height of the fix.
    """
    from matplotlib.colors import LogNorm

    corners = limits(scene)
    unit, size = unit_of(corners)
    x, y, grid = plane(corners, _POINTS, scene.fixes[0])
    excess = _excess(problem, fix, grid, problem.dimension).reshape(_POINTS, _POINTS)
    steps = levels(excess)
    # The scale spans at least a factor of two, otherwise it has only one colour.
    norm = LogNorm(steps[0], max(steps[-1], 2.0 * steps[0]), clip=True)
    drawn = panel.pcolormesh(x / size, y / size, excess, norm=norm, cmap=COLOURS, rasterized=True, shading="nearest")
    panel.contour(x / size, y / size, excess, levels=steps, colors="white", linewidths=0.7)
    style.stations(panel, scene, PLAN, size, edgecolors="white", linewidths=0.8)
    style.points(panel, scene, PLAN, size)
    _set_plan_axes(panel, scene, corners / size, unit)
    panel.set_title("overview" if problem.dimension == 2 else "overview, at the height of the fix")
    bar = panel.figure.colorbar(
        drawn, ax=panel, label=_NAME, location="bottom", ticks=steps, format=lambda value, _: f"{value:g}"
    )
    bar.ax.minorticks_off()


def _draw_surroundings(panel: Axes, problem: Problem, fix: Fix, scene: PictureScene) -> None:
    """Draw the cost around the fix with its isolines, the 95 % line of the cost and the 95 % ellipse.

    Without a covariance, the panel contains only a text.
    """
    centre, spread = scene.fixes[0], np.sqrt(np.diagonal(scene.covariances[0])[:2])
    if not np.isfinite(spread).all():
        panel.set_axis_off()
        panel.text(0.5, 0.5, "no covariance", ha="center", va="center", transform=panel.transAxes)
        return
    half = _AROUND * spread.max()
    corners = np.stack([centre[:2] - half, centre[:2] + half])
    unit, size = unit_of(corners - centre[:2])
    x, y, grid = plane(corners, _POINTS, centre)
    # The height has the value of the best fit, so the 95 % line of a linear problem is the ellipse of the plan.
    excess = _excess(problem, fix, grid, 2).reshape(_POINTS, _POINTS)
    x, y, corners = (x - centre[0]) / size, (y - centre[1]) / size, (corners - centre[:2]) / size
    drawn = panel.contourf(x, y, excess, levels=[0, *_SIGMAS], cmap=COLOURS, extend="max")
    panel.contour(x, y, excess, levels=_SIGMAS, colors="white", linewidths=0.7)
    panel.figure.colorbar(drawn, ax=panel, label=_NAME, location="bottom")
    panel.contour(x, y, excess, levels=[np.sqrt(_CHI2_95)], colors=ORANGE, linewidths=2.0)
    panel.plot([], [], color=ORANGE, linewidth=2.0, label="95 % region by the cost")
    moved = scene.moved(lambda place: place - np.pad(centre[:2], (0, len(centre) - 2)))
    style.ellipses(panel, moved, PLAN, size, color=BLACK, linestyle="--", linewidth=1.4)
    panel.scatter(0.0, 0.0, marker="o", s=50, color=BLUE, edgecolors="white", zorder=4)
    _set_plan_axes(panel, scene, corners, unit)
    panel.set_title(f"around {scene.axes[0]} {centre[0]:.1f} m, {scene.axes[1]} {centre[1]:.1f} m")


def _set_plan_axes(panel: Axes, scene: PictureScene, corners: Array, unit: str) -> None:
    """Give a plan axes with names and units, equal scales, no grid, and the limits `corners` (2, 2) in its unit."""
    style.name_axes(panel, scene, PLAN, unit)
    panel.grid(visible=False)
    panel.set_aspect("equal", adjustable="box")
    panel.set_xlim(*corners[:, 0])
    panel.set_ylim(*corners[:, 1])


# Convergence: results of iterations from many starts, compared with the fix, which needs no start.


def plot_convergence(
    problem: Problem, fix: Fix, title: str = "", *, reach: float | None = None, starts: int | None = None
) -> Figure:
    """Return a map of starts, coloured by the result of plain and damped iterations from each start.

    A third panel shows the fix with its lines of position and its surroundings. Starts are in the horizontal plane of
    the fix, so the plain iteration starts with the right height.

    Parameters
    ----------
    problem : Problem
        A single problem with one target that has one position in the whole run.
    fix : Fix
        Its fix, without a guess.
    title : str
        Title of the picture.
    reach : float, optional
        Half the side of the square of starts, m. By default, the square is three times as wide as stations and fix.
    starts : int, optional
        Starts along each side of the square: 161, or fewer for long runs.

    Returns
    -------
    matplotlib.figure.Figure
        The picture; write it with `optloc.show.pictures.save`.

    Raises
    ------
    InvalidProblem
        If there are several fixes or targets, or no fix.
    """
    flat, answer = single(problem, fix)
    scene = scene_of(flat, [answer])
    corners = limits(scene, 1.0)
    if reach is not None:
        corners = corners.mean(0) + np.array([[-reach], [reach]])
    starts = int(np.clip(np.sqrt(_ROWS / flat.count), *_STARTS)) if starts is None else starts
    x, y, points = plane(corners, starts, scene.fixes[0])
    places, _ = placed_points(flat, points)
    figure = figure_class()(figsize=(WIDE, 9.4), layout="constrained")
    *panels, empty = figure.subplots(2, 2, sharex=True, sharey=True).ravel().tolist()
    empty.set_axis_off()
    unit, size = unit_of(corners)
    for panel, method in zip(panels, _NAMES, strict=False):
        found = basins(flat, answer, places.reshape(starts, starts, -1), method)
        _draw_ends(panel, found, x / size, y / size)
        share = f"{100.0 * found.share(End.REACHED):.1f} % of {starts**2} starts"
        panel.set_title(f"{_NAMES[method]}:\n{share} reach the best fit")
    panels[2].set_title(f"optloc needs no start:\n{verdict(answer)}")
    draw_lines(panels[2], lines_of_position(flat, answer, x, y, places), np.zeros(2), size)
    for panel in panels:
        _draw_marks(panel, scene, size, corners / size, unit, last=panel is panels[2])
    _add_legend(empty, panels[2])
    finish(figure, f"{title}: from which starts is the best fit found?" if title else "")
    _draw_inset(panels[2], scene)
    separate_notes(figure)
    return figure


def _draw_inset(panel: Axes, scene: PictureScene) -> None:
    """Draw the surroundings of the fix in a corner, because its ellipse is only a dot in the plan of all starts."""
    centre, covariance = scene.fixes[0], scene.covariances[0]
    half = _AROUND * float(np.sqrt(np.diagonal(covariance)[:2].max()))
    if not (np.isfinite(half) and half > 0.0):
        return
    unit, size = unit_of(np.array([[half, half]]))
    near = panel.inset_axes((0.64, 0.03, 0.33, 0.33))
    moved = scene.moved(lambda place: place - np.pad(centre[:2], (0, len(centre) - 2)))
    style.ellipses(near, moved, PLAN, size)
    near.scatter(0.0, 0.0, s=30, color=BLUE, zorder=4)
    # More room below the fix, for the scale bar.
    near.set(
        xlim=(-half / size, half / size),
        ylim=(-1.3 * half / size, 0.7 * half / size),
        xticks=[],
        yticks=[],
        aspect="equal",
    )
    near.set_title("around the fix", fontsize=SMALL, pad=3)
    scale_bar(near, unit)


def verdict(fix: Fix) -> str:
    """Return the status of a flat fix of one, with the number of positions or the extent of the proof."""
    code, proof = int(fix.code[0]), fix.certificates[0].proof
    if code == Status.AMBIGUOUS:
        return f"ambiguous: {1 + int(np.isfinite(fix.alternatives.gap[0]).sum())} positions listed"
    proven = {"global": ": proven best everywhere", "region": ": proven best in its region"}
    return f"status {Status(code).label}{proven.get(proof, '')}"


def _draw_ends(panel: Axes, found: Basins, x: Array, y: Array) -> None:
    """Colour each start by the result of its iteration; `x` and `y` are the grid lines in the unit of the axes."""
    from matplotlib.colors import ListedColormap

    # The results are the numbers 0, 1 and 2: the limits of the scale put each number in the middle of its colour.
    colours = ListedColormap([_COLOURS[end] for end in End])
    panel.pcolormesh(x, y, found.ends, cmap=colours, vmin=-0.5, vmax=2.5, rasterized=True, shading="nearest")


def _draw_marks(panel: Axes, scene: PictureScene, size: float, corners: Array, unit: str, *, last: bool) -> None:
    """Draw stations and the fix in a panel of starts, and set its axes and limits.

    `corners` (2, 2) are the limits in the unit of the axes. The `last` panel also has the ellipse, the alternatives and
    a grid.
    """
    style.stations(panel, scene, PLAN, size, named=False, s=36, edgecolors="white", linewidths=0.8)
    if last:
        style.ellipses(panel, scene, PLAN, size)
        style.points(panel, scene, PLAN, size)
    else:
        x, y = scene.fixes[0, :2] / size
        panel.scatter(x, y, s=60, color=BLUE, edgecolors="white", linewidths=1.4, zorder=5)
    style.name_axes(panel, scene, PLAN, unit)
    panel.grid(visible=last)
    panel.set_aspect("equal", adjustable="box")
    panel.set_xlim(*corners[:, 0])
    panel.set_ylim(*corners[:, 1])
    panel.label_outer()


def _add_legend(empty: Axes, panel: Axes) -> None:
    """Add a legend in an empty panel: the colours of the results, and the labels of `panel`."""
    from matplotlib.patches import Patch

    patches = [Patch(facecolor=_COLOURS[end], label=f"a start here leads to {_ENDS[end]}") for end in End]
    handles, labels = panel.get_legend_handles_labels()
    # Each label once.
    kept = dict(zip(labels, handles, strict=True))
    shown = [*patches, *kept.values()]
    names = [*(str(patch.get_label()) for patch in patches), *kept]
    empty.legend(shown, names, loc="center", frameon=False)
