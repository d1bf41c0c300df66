"""Plans of a fix and of a problem in one axes, as the methods `plot` return them."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Status
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.show.pictures import style
from optloc.show.pictures.fixes import draw_overview
from optloc.show.pictures.notes import free_corner, scale_bar, separate_notes
from optloc.show.pictures.position_lines import draw_lines_of_fix, draw_lines_of_problem
from optloc.show.pictures.scene import PLAN, PictureScene, scene_of
from optloc.show.pictures.scene_parts import centred, draw_directions, draw_regions, draw_tracks, half_side
from optloc.show.pictures.style import GREY, SMALL, axes_or_new, fix_limits, literal, unit_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Half the side of the surroundings of a fix, as a share of the width of the plan, below which the plan has an inset:
# the ellipse is then hardly larger than the mark of the fix.
_TINY = 0.04
# Margin of the plan of a problem on each side, as a share of the extent of its stations.
_MARGIN = 0.4
# Side of an inset, and its distance from the edge, as shares of the plan.
_INSET, _GAP = 0.32, 0.03


def fix_axes(fix: Fix, problem: Problem | None = None, *, ax: Axes | None = None, title: str = "") -> Axes:
    """Return a plan of fixes: stations, 95 % ellipses or regions, alternatives and lines of position.

    If the ellipse is too small to see, an inset shows it. In three dimensions, the lines are at the height of the fix.

    Parameters
    ----------
    fix : Fix
        A single fix or a batch.
    problem : Problem, optional
        Its problem; by default the problem that the fix refers to.
    ax : matplotlib.axes.Axes, optional
        Where the plan is drawn; by default in a new figure.
    title : str
        Title; by default the status.

    Raises
    ------
    InvalidProblem
        If matplotlib is missing, or the fix does not refer to its problem and `problem` is missing.
    """
    problem = _problem_of(fix) if problem is None else problem
    panel = axes_or_new(ax)
    scene = scene_of(problem, [fix], outlined=True)
    size = draw_overview(panel, scene, PLAN)
    single = fix.code.size == 1 and bool(np.isfinite(scene.fixes).all())
    if single:
        draw_lines_of_fix(panel, problem, fix, np.zeros(2), size)
    draw_directions(panel, problem, [fix], size)
    _finish(panel, title or _verdicts(fix))
    taken = _draw_inset(panel, scene, size, problem, fix) if len(scene.fixes) else ""
    scale_bar(panel, panel.get_xlabel().rpartition("(")[2].rstrip(")"), taken)
    separate_notes(panel.figure, [panel])
    return panel


def problem_axes(problem: Problem, *, ax: Axes | None = None, title: str = "") -> Axes:
    """Return a plan of a problem: stations, constraints, tracks of moving stations and known targets.

    In the plane, a problem whose only unknowns are one position and times of emission has lines of position.

    Parameters
    ----------
    problem : Problem
        A single problem, or a batch whose first problem is drawn.
    ax : matplotlib.axes.Axes, optional
        Where the plan is drawn; by default in a new figure.
    title : str
        Title; by default the numbers of stations and rows.

    Raises
    ------
    InvalidProblem
        If matplotlib is missing.
    """
    panel = axes_or_new(ax)
    scene = scene_of(problem, [])
    size = draw_overview(panel, scene, PLAN)
    # The target may be outside of the stations.
    panel.margins(_MARGIN)
    draw_lines_of_problem(panel, problem, size)
    kinds = Counter[str]()
    for rows in problem.rows:
        kinds[rows.kind] += rows.count
    counted = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    _finish(panel, title or f"{problem.stations.count} stations, {counted} rows")
    scale_bar(panel, panel.get_xlabel().rpartition("(")[2].rstrip(")"))
    separate_notes(panel.figure, [panel])
    return panel


def _problem_of(fix: Fix) -> Problem:
    """Return the problem that a fix refers to, of a batch the first; raise InvalidProblem without a problem."""
    sources = [] if fix.source is None else fix.source.ravel().tolist()
    known = [source.problem for source in sources if source is not None]
    if not known:
        raise InvalidProblem("the fix does not refer to its problem", "plot", "give it: fix.plot(problem)")
    found: Problem = known[0].flat()
    return found


def _verdicts(fix: Fix) -> str:
    """Return the status of a fix, or the number of fixes of each status."""
    counts = Counter(int(code) for code in fix.code.ravel())
    if fix.code.size == 1:
        return f"status {Status(next(iter(counts))).label}"
    return ", ".join(f"{count} {Status(code).label}" for code, count in sorted(counts.items()))


def _finish(panel: Axes, title: str) -> None:
    """Give a plan its title, and a legend below it with each label once; then the limits are final."""
    panel.set_title(literal(title), wrap=True)
    handles, labels = panel.get_legend_handles_labels()
    shown = dict(zip(labels, handles, strict=True))
    if shown:
        place: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.12), "ncols": 2}
        panel.legend(shown.values(), shown, frameon=False, fontsize=SMALL, **place)
    fix_limits(panel)


def _draw_inset(panel: Axes, scene: PictureScene, size: float, problem: Problem, fix: Fix) -> str:
    """Draw the surroundings of the fixes in the emptiest corner if an ellipse is too small to see.

    The result is the name of the corner, such as "upper left"; empty without an inset. `size` is the unit of the plan.
    """
    known: Array = np.asarray(np.isfinite(scene.fixes).all(-1))
    if not known.any() or not np.isfinite(scene.covariances[known]).all():
        return ""
    centre = np.median(scene.fixes[known][:, :2], axis=0)
    half = half_side(scene, known, centre)
    if half / size > _TINY * float(np.ptp(panel.get_xlim())):
        return ""
    corner, empty = free_corner(panel)
    # If every corner has a station, the inset is on the right of the plan.
    corner = corner if empty else "beside"
    places = {"left": _GAP, "right": 1.0 - _GAP - _INSET, "beside": 1.0 + _GAP}
    x = places[corner.rpartition(" ")[2]]
    # The title of the inset needs room below the upper edge.
    y = _GAP if "lower" in corner else 1.0 - 2.0 * _GAP - _INSET
    near = panel.inset_axes((x, y, _INSET, _INSET), zorder=7)
    unit, near_size = unit_of(np.array([[half, half]]))
    shifted = centred(scene, centre)
    draw_regions(near, shifted.regions, near_size)
    style.ellipses(near, shifted, PLAN, near_size)
    draw_tracks(near, shifted, PLAN, near_size)
    style.points(near, shifted, PLAN, near_size)
    reach = half / near_size
    near.set(xlim=(-reach, reach), ylim=(-reach, reach), xticks=[], yticks=[], aspect="equal")
    if fix.code.size == 1:
        draw_lines_of_fix(near, problem, fix, centre, near_size, named=False)
    near.set_title("around the fix" if fix.code.size == 1 else "around the fixes", fontsize=SMALL, pad=3)
    near.set_facecolor("white")
    scale_bar(near, unit)
    (left, low), side = (centre - half) / size, 2.0 * half / size
    panel.indicate_inset((left, low, side, side), near, edgecolor=GREY, alpha=0.9)
    return corner
