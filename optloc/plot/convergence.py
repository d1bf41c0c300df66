"""Where iterations from many starts end, beside the fix that needs no start."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optloc.fix import Fix
from optloc.plot import parts
from optloc.plot.landscape import limits, plane, single
from optloc.plot.parts import PLAN
from optloc.plot.style import BLUE, YELLOW, apart, figure_class, unit_of
from optloc.problem import Problem
from optloc.scene import Scene, placed_points, scene_of
from optloc.solve.basins import Basins, End, basins
from optloc.status import Status
from optloc.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ROWS = 4e6
_NAMES = {"taylor": "plain Taylor iteration", "lsr": "damped least squares"}
_ENDS = {
    End.REACHED: "the best fit",
    End.ELSEWHERE: "a worse fit elsewhere",
    End.NOWHERE: "nowhere: it does not converge",
}
_COLOURS = {End.REACHED: BLUE, End.ELSEWHERE: YELLOW, End.NOWHERE: "#e4e4e4"}


def plot_convergence(
    problem: Problem, fix: Fix, title: str = "", *, reach: float | None = None, starts: int | None = None
) -> Figure:
    """Return a map of starts, coloured by where plain and damped iterations from there end, beside the fix.

    Starts lie in the horizontal plane of the fix: the plain iteration is told the height.

    Parameters
    ----------
    problem : Problem
        A single problem with one target that stands for the run.
    fix : Fix
        Its fix, without a guess.
    title : str
        Title of the picture.
    reach : float, optional
        Half the side of the square of starts, metres; by default it holds stations and fix three times.
    starts : int, optional
        Starts along each side of the square: 161, or fewer for long runs.

    Returns
    -------
    matplotlib.figure.Figure
        To be written with `optloc.plot.save`.

    Raises
    ------
    InvalidProblem
        Where there are several fixes or targets, or no answer.
    """
    flat, answer = single(problem, fix)
    scene = scene_of(flat, [answer])
    corners = limits(scene, 1.0)
    if reach is not None:
        corners = corners.mean(0) + np.array([[-reach], [reach]])
    starts = int(np.clip(np.sqrt(_ROWS / flat.count), 31, 161)) if starts is None else starts
    x, y, points = plane(corners, starts, scene.fixes[0])
    places, _ = placed_points(flat, points)
    figure = figure_class()(figsize=(13.0, 5.2), layout="constrained")
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    unit, size = unit_of(corners)
    for panel, method in zip(panels, _NAMES, strict=False):
        found = basins(flat, answer, places.reshape(starts, starts, -1), method)
        _ends(panel, found, x / size, y / size)
        share = f"{100.0 * found.share(End.REACHED):.1f} % of {starts**2} starts"
        panel.set_title(f"{_NAMES[method]}\n{share} reach the best fit")
    panels[2].set_title(f"optloc, without a start\n{verdict(answer)}")
    for panel in panels:
        _marks(panel, scene, size, corners / size, unit, last=panel is panels[2])
    _legend(figure, panels[2])
    if title:
        figure.suptitle(title)
    apart(figure)
    return figure


def verdict(fix: Fix) -> str:
    """Return the status of a flat fix of one, and what is listed or proven."""
    code, proof = int(fix.code[0]), fix.certificate[0].proof
    if code == Status.AMBIGUOUS:
        return f"ambiguous: {1 + int(np.isfinite(fix.alternatives.gap[0]).sum())} places listed"
    proven = {"global": ": proven best everywhere", "region": ": proven best in its region"}
    return f"status {Status(code).label}{proven.get(proof, '')}"


def _ends(panel: Axes, found: Basins, x: Array, y: Array) -> None:
    from matplotlib.colors import ListedColormap

    colours = ListedColormap([_COLOURS[end] for end in End])
    panel.pcolormesh(x, y, found.ends, cmap=colours, vmin=-0.5, vmax=2.5, rasterized=True, shading="nearest")


def _marks(panel: Axes, scene: Scene, size: float, corners: Array, unit: str, *, last: bool) -> None:
    parts.stations(panel, scene, PLAN, size, named=False, s=36, edgecolors="white", linewidths=0.8)
    if last:
        parts.ellipses(panel, scene, PLAN, size)
        parts.points(panel, scene, PLAN, size)
    else:
        x, y = scene.fixes[0, :2] / size
        panel.scatter(x, y, s=60, color=BLUE, edgecolors="white", linewidths=1.4, zorder=5)
    parts.name_axes(panel, scene, PLAN, unit)
    panel.grid(visible=last)
    panel.set_aspect("equal", adjustable="box")
    panel.set_xlim(*corners[:, 0])
    panel.set_ylim(*corners[:, 1])
    panel.label_outer()


def _legend(figure: Figure, panel: Axes) -> None:
    from matplotlib.patches import Patch

    patches = [Patch(facecolor=_COLOURS[end], label=f"a start here leads to {_ENDS[end]}") for end in End]
    handles, labels = panel.get_legend_handles_labels()
    kept = dict(zip(labels, handles, strict=True))
    shown = [*patches, *kept.values()]
    names = [*(str(patch.get_label()) for patch in patches), *kept]
    figure.legend(shown, names, loc="outside lower center", ncols=3, frameon=False)
