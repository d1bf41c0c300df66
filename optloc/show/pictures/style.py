"""Common parts of all pictures: colours, units of axes, labels without overlap, the scene of a fix, and image files.

An ellipse is *valid* if it covers the true position with the stated probability. A plan is drawn in a unit of `size`
metres: coordinates in metres are divided by `size`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.frames import Frame
from optloc.base.linalg import error_ellipse
from optloc.base.outputs import visible, written
from optloc.base.types import Array, Status
from optloc.linear.courses import course_at, elapsed
from optloc.problem.chart import CARTESIAN
from optloc.problem.fix import Fix
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem
from optloc.show.pictures.constraint_shapes import DrawnRegion, drawn_regions
from optloc.show.pictures.outlines import outlines_of
from optloc.uncertainty.outline import Outline

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Annotation

# Palette of Okabe and Ito: distinct with any colour vision, and by lightness in grey print.
BLACK, BLUE, ORANGE, GREY = "#000000", "#0072B2", "#D55E00", "#999999"
GREEN, SKY, PURPLE, YELLOW = "#009E73", "#56B4E9", "#CC79A7", "#E69F00"

View = tuple[int, int]
"""Indices of the two axes of the scene that a panel shows."""

PLAN: View = (0, 1)
HEIGHT: View = (0, 2)
# Positions of a note around its point, in points of 1/72 inch, the usual one first; and the alignment of its text.
_PLACES = ((5, 5), (-5, 5), (5, -5), (-5, -5), (0, 8), (0, -8), (9, 0), (-9, 0), (14, 14), (-14, 14), (14, -14))
_ASIDE: dict[int, Literal["left", "center", "right"]] = {-1: "right", 0: "center", 1: "left"}
_ABOVE: dict[int, Literal["bottom", "center", "top"]] = {-1: "top", 0: "center", 1: "bottom"}
# Half the side of a mark in pixels, which notes avoid; and maximum number of marks of a panel that notes avoid, because
# more marks cover the whole panel.
_MARK, _MANY = 5.0, 200
# Maximum number of stations with names: more names would overlap.
_NAMED = 20
# Maximum number of fixes with alternatives and large marks, and of fixes with ellipses: with more fixes, only dots are
# readable.
_FEW_FIXES, _ELLIPSES = 12, 200
# A cost gap below this is printed as "+0": both positions fit the data equally well.
_NO_GAP = 1e-3
# Points of a path or track, and corners of an ellipse: finer than the pixels of a picture.
_PATH, _CORNERS = 200, 181
# A plan is in kilometres if its largest coordinate is at least this, m.
_FAR = 5e3


def figure_class() -> type[Figure]:
    """Return the figure class of matplotlib; raise InvalidProblem if matplotlib is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise InvalidProblem(
            "pictures need matplotlib", "plot", "install it with: pip install 'optloc[plot]'"
        ) from None
    return Figure


def panels_for(count: int, most: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with `count` panels, at most `most` side by side; `width` and `height` of a panel in inches."""
    columns = min(count, most)
    rows = -(-count // columns)
    size = (0.6 + width * columns, 0.4 + height * rows)
    figure = figure_class()(figsize=size, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for panel in panels[count:]:
        panel.set_axis_off()
    return figure, panels[:count]


# Width of a letter of a legend, inches, and the width of its handle in letters.
_LETTER, _HANDLE = 0.07, 6


def finish(figure: Figure, title: str, panels: Sequence[Axes] = (), ncols: int = 5, **style: Any) -> Figure:
    """Return the figure after adding its title and a legend below the panels, with each label of `panels` once.

    The legend has at most `ncols` columns, or fewer if they do not fit. `style` holds further options of the legend.
    """
    shown: dict[str, Any] = {}
    for panel in panels:
        handles, labels = panel.get_legend_handles_labels()
        for label, handle in zip(labels, handles, strict=True):
            shown.setdefault(label, handle)
    if shown:
        fit = int(figure.get_figwidth() / (_LETTER * (max(map(len, shown)) + _HANDLE)))
        ncols = max(1, min(ncols, fit))
        figure.legend(shown.values(), shown, loc="outside lower center", ncols=ncols, frameon=False, **style)
    if title:
        figure.suptitle(literal(title), wrap=True)
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a picture; the ending of the file name selects the type, and without an ending the type is PNG.

    Raises
    ------
    InvalidProblem
        If the type is unknown, or the file cannot be written.
    """
    known = sorted(figure.canvas.get_supported_filetypes())
    ending = path.suffix.lower().removeprefix(".") or "png"
    if ending not in known:
        raise InvalidProblem(f"pictures of type {path.suffix!r} are unknown", str(path), nearest(ending, known))
    # Draw into memory first: then only the write below can raise an error of the disk, and that error is handled.
    drawn = BytesIO()
    figure.savefig(drawn, dpi=120, format=ending)
    with written(path) as file:
        file.write_bytes(drawn.getvalue())


# Maximum number of letters of a title or a name in a picture.
_LETTERS = 120


def literal(text: str) -> str:
    """Return a text that matplotlib prints literally: `$` starts no formula, and a leading `_` hides no label."""
    text = visible(" ".join(text.split()))
    text = text if len(text) <= _LETTERS else f"{text[: _LETTERS - 1]}…"
    return (" " if text.startswith("_") else "") + text.replace("$", r"\$")


def unit_of(points: Array) -> tuple[str, float]:
    """Return the unit for axes around points (n, 2), m, and the size of the unit, m."""
    reach = np.nanmax(np.abs(points), initial=1e-3)
    return ("km", 1e3) if reach >= _FAR else ("m", 1.0) if reach >= 1.0 else ("mm", 1e-3)


def grid(panel: Axes) -> None:
    """Draw the grid of a panel."""
    panel.grid(color=GREY, alpha=0.35, linewidth=0.6)
    panel.set_axisbelow(True)


# Largest length of a scale bar, and size of the corner in which marks are counted, as shares of a panel.
_BAR, _CORNER = 0.25, 0.3


def scale_bar(panel: Axes, unit: str) -> None:
    """Draw a scale bar in the lower corner with fewer marks, in a plan with final limits."""
    from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

    (west, east), (south, north) = panel.get_xlim(), panel.get_ylim()
    most = _BAR * (east - west)
    power = 10.0 ** np.floor(np.log10(most))
    length = power * next(n for n in (5.0, 2.0, 1.0) if n * power <= most)
    marks = panel.transData.inverted().transform(_mark_positions(panel))
    share = (marks - [west, south]) / [east - west, north - south]
    counts = {
        name: int(((np.abs(share[:, 0] - x) < 1.3 * _CORNER) & (share[:, 1] < _CORNER)).sum())
        for name, x in (("lower right", 1.0), ("lower left", 0.0))
    }
    corner = min(counts, key=lambda name: counts[name])
    style: dict[str, Any] = {"pad": 0.3, "borderpad": 0.4, "sep": 3, "size_vertical": 0.004 * (north - south)}
    bar = AnchoredSizeBar(panel.transData, length, f"{length:g} {unit}", corner, frameon=True, **style)
    bar.patch.set(edgecolor="none", alpha=0.8)
    panel.add_artist(bar)


# Notes without overlap.


def separate_notes(figure: Figure) -> None:
    """Move the notes of a finished figure until no note covers another note or a mark, or leaves its panel.

    Each note takes the first free position around its point. If no position is free, the note is above the point to the
    right.
    """
    from matplotlib.text import Annotation

    # Sizes of texts are known only after the layout of the figure.
    figure.draw_without_rendering()
    for panel in figure.axes:
        notes = [text for text in panel.texts if isinstance(text, Annotation) and _movable(text)]
        if not notes:
            continue
        spots = panel.transData.transform(np.array([note.xy for note in notes]))
        taken = [_box(x - _MARK, y - _MARK, x + _MARK, y + _MARK) for x, y in _mark_positions(panel)]
        taken += [text.get_window_extent() for text in panel.texts if text not in notes and text.get_visible()]
        for note, (x, y) in zip(notes, spots, strict=True):
            # A note may touch the box of its mark, because it is drawn next to the mark.
            taken.append(_move_to_free_place(note, panel, [box for box in taken if not box.contains(x, y)]))


def _mark_positions(panel: Axes) -> Array:
    """Return the positions (n, 2) of the marks of a panel on the canvas, pixels."""
    from matplotlib.collections import PathCollection

    found = [np.ma.filled(c.get_offsets(), np.nan) for c in panel.collections if isinstance(c, PathCollection)]
    points = np.concatenate([np.zeros((0, 2)), *found])
    return np.asarray(panel.transData.transform(points[np.isfinite(points).all(-1)][:_MANY]))


def _movable(note: Annotation) -> bool:
    """Return whether a note is visible and placed relative to its point."""
    return note.anncoords == "offset points" and note.get_visible()


def _box(*corners: float) -> Any:
    """Return a box of matplotlib from x0, y0, x1, y1, pixels."""
    from matplotlib.transforms import Bbox

    return Bbox.from_extents(*corners)


def _move_to_free_place(note: Annotation, panel: Axes, taken: list[Any]) -> Any:
    """Move a note to its first free position, and return its box there.

    A position is free if it is inside the panel and does not overlap the boxes `taken`. If no position is free, the
    note takes the first position.
    """
    inside = panel.get_window_extent()
    for place in _PLACES:
        _place_note(note, place)
        box = note.get_window_extent()
        fits = inside.x0 <= box.x0 and box.x1 <= inside.x1 and inside.y0 <= box.y0 and box.y1 <= inside.y1
        if fits and not any(box.overlaps(other) for other in taken):
            return box
    _place_note(note, _PLACES[0])
    return note.get_window_extent()


def _place_note(note: Annotation, place: tuple[int, int]) -> None:
    """Move a note to an offset from its point, in points of 1/72 inch, and align its text away from the point."""
    note.set_position(place)
    note.set_horizontalalignment(_ASIDE[int(np.sign(place[0]))])
    note.set_verticalalignment(_ABOVE[int(np.sign(place[1]))])


# The scene of fixes: positions along the axes of the picture, covariances, alternatives and regions.


@dataclass(frozen=True, slots=True)
class PictureScene:
    """The content of a picture of fixes, m, along the axes of the picture (east, north, up on Earth).

    Parameters
    ----------
    stations : array (s, d)
        Positions of the stations.
    names : tuple of s str
        Names of the stations.
    fixes : array (n, d)
        Estimated positions; NaN if unknown.
    covariances : array (n, d, d)
        Covariances of the estimates, m^2; NaN if unknown.
    clean : bool array (n,)
        Whether the status is `ok`.
    alternatives : array (q, d)
        Positions of the alternatives.
    gaps : array (q,)
        Cost gaps of the alternatives.
    axes : tuple of d str
        Names of the axes.
    regions : tuple of DrawnRegion
        Shapes of constraints in the plan.
    tracks : tuple of array (k, d)
        Tracks of the moving stations during the run.
    paths : tuple of array (k, d)
        Estimated paths of the moving targets.
    other_paths : tuple of array (k, d)
        Paths of the moving targets in the alternatives.
    known : tuple of array (k, d)
        Positions of known targets.
    outlines : tuple of n dicts of View to Outline
        95 % region of each fix without a valid ellipse, by view; empty for other fixes.
    local : bool array (n,), optional
        Whether the ellipse of a fix is not valid while its region is unknown.
    """

    stations: Array
    names: tuple[str, ...]
    fixes: Array
    covariances: Array
    clean: Array
    alternatives: Array
    gaps: Array
    axes: tuple[str, ...]
    regions: tuple[DrawnRegion, ...] = ()
    tracks: tuple[Array, ...] = ()
    paths: tuple[Array, ...] = ()
    other_paths: tuple[Array, ...] = ()
    known: tuple[Array, ...] = ()
    outlines: tuple[dict[View, Outline], ...] = ()
    local: Array | None = None

    def moved(self, change: Callable[[Array], Array]) -> PictureScene:
        """Return the scene with all positions changed; regions, covariances and outlines do not change."""
        return replace(
            self,
            stations=change(self.stations),
            fixes=change(self.fixes),
            alternatives=change(self.alternatives),
            tracks=tuple(change(part) for part in self.tracks),
            paths=tuple(change(part) for part in self.paths),
            other_paths=tuple(change(part) for part in self.other_paths),
            known=tuple(change(part) for part in self.known),
        )


def scene_of(problem: Problem, fixes: Sequence[Fix], *, outlined: bool = False) -> PictureScene:
    """Return the scene of a problem and its fixes.

    With `outlined`, the scene has the outlines of the 95 % regions of fixes without a valid ellipse.
    """
    # Use the first epoch of moving stations and the first problem of a batch; tracks are drawn as lines.
    stations = problem.stations.position.reshape(-1, problem.stations.count, problem.dimension)[0]
    parts = [part for fix in fixes for part in states_of(fix)]
    d = problem.dimension
    position = np.concatenate([p for p, _, _ in parts] or [np.zeros((0, d))])
    covariance = np.concatenate([c for _, c, _ in parts] or [np.zeros((0, d, d))])
    clean = np.concatenate([ok for _, _, ok in parts] or [np.zeros(0, dtype=bool)])
    others, gaps = _alternatives(fixes, d) if len(position) <= _FEW_FIXES else (np.zeros((0, d)), np.zeros(0))
    axes = ("east", "north", "up") if problem.frame.geodetic else ("x", "y", "z")
    reach = np.concatenate([stations, position[np.isfinite(position).all(-1)]])[:, :2]
    # Shapes in space are cut at the fixes. In ECEF, a box of x and y has no shape in the plan.
    known = position[np.isfinite(position).all(-1)]
    centre = np.median(known if len(known) else stations, axis=0)
    regions = () if problem.frame.kind == "ecef" else drawn_regions(problem, reach, centre)
    paths, other = _paths(problem, fixes)
    known = tuple(m.known.reshape(-1, *m.known.shape[-2:])[:, 0] for m in problem.motions if m.known is not None)
    outlines = _outlines(problem, fixes, len(position)) if outlined else ()
    scene = PictureScene(
        *(stations, problem.stations.names, position, covariance, clean, others, gaps, axes[:d], regions),
        tracks=_tracks(problem),
        paths=paths,
        other_paths=other,
        known=tuple(thinned(place) for place in known),
        outlines=outlines,
        local=is_local(fixes, [bool(each) for each in outlines], len(position)),
    )
    return _along_local_axes(problem, scene) if problem.frame.kind == "ecef" else scene


def _outlines(problem: Problem, fixes: Sequence[Fix], count: int) -> tuple[dict[View, Outline], ...]:
    """Return the 95 % regions of fixes without a valid ellipse, by view: the plan and, in three dimensions, the height.

    Each fix has one dict, which is empty if its ellipse is valid. Without any dict, the regions are unknown
    (see `regions_of`); `count` is as there.
    """
    views = (PLAN, HEIGHT) if problem.dimension == 3 else (PLAN,)
    local = local_frame(problem)
    axes = np.eye(problem.dimension) if local is None else local.rotation_to_ecef().T
    found = regions_of(problem, fixes, count, [axes[list(view)] for view in views])
    return tuple(dict(zip(views, each, strict=False)) for each in found)


def regions_of(
    problem: Problem, fixes: Sequence[Fix], count: int, planes: Sequence[Array]
) -> tuple[list[Outline], ...]:
    """Return the 95 % regions of fixes in planes.

    The result is empty if there are too many fixes, or a fix has several positions.

    Parameters
    ----------
    problem : Problem
        Problem of the fixes.
    fixes : sequence of Fix
        Single fixes or batches.
    count : int
        Number of positions in the picture.
    planes : sequence of array (2, d) or (n, 2, d)
        Axes of each plane, the same for all fixes or one plane for each fix.
    """
    if count > _ELLIPSES or count != sum(fix.code.size for fix in fixes):
        return ()
    found: list[list[Outline]] = []
    for fix in fixes:
        part = slice(len(found), len(found) + fix.code.size)
        found += outlines_of(problem, fix, [plane if plane.ndim == 2 else plane[part] for plane in planes])
    return tuple(found)


def is_local(fixes: Sequence[Fix], outlined: Sequence[bool], count: int) -> Array | None:
    """Return, for each fix (n,), whether its ellipse is not valid and it has no outline.

    If a fix has several positions, the result is None.
    """
    if count != sum(fix.code.size for fix in fixes):
        return None
    kinds = [np.zeros(fix.code.size) if fix.chart is None else np.ravel(fix.chart.kind) for fix in fixes]
    bare = np.array([not each for each in outlined] or [True] * count, dtype=bool)
    return np.asarray((np.concatenate([*kinds, np.zeros(0)]) != CARTESIAN) & bare)


def local_frame(problem: Problem) -> Frame | None:
    """Return the frame of pictures in ECEF: east, north and up at the centre of the stations; None for other frames."""
    if problem.frame.kind != "ecef":
        return None
    stations = problem.stations.position.reshape(-1, problem.stations.count, problem.dimension)[0]
    lat, lon, height = problem.frame.to_geodetic(stations.mean(0))
    return Frame("enu", (float(lat), float(lon), float(height)))


def placed_points(problem: Problem, points: Array) -> tuple[Array, Array]:
    """Return points in the frame of the problem (n, d), m, and the axes of the picture (d, d) as rows in that frame.

    The argument `points` (n, d) is along the axes of the picture.
    """
    local = local_frame(problem)
    if local is None:
        return points, np.eye(problem.dimension)
    return local.to_ecef(points), local.rotation_to_ecef().T


def _along_local_axes(problem: Problem, scene: PictureScene) -> PictureScene:
    """Return a scene in ECEF along east, north and up at the centre of the stations."""
    local = local_frame(problem)
    assert local is not None
    turn = local.rotation_to_ecef().T
    moved = scene.moved(lambda place: local.from_ecef(place.reshape(-1, 3)))
    return replace(moved, covariances=turn @ scene.covariances @ turn.T)


def _tracks(problem: Problem) -> tuple[Array, ...]:
    """Return the tracks (k, d), m, of the moving stations of a single run."""
    position = problem.stations.position
    if position.ndim > 3:
        return ()
    tracks = (thinned(track) for track in np.swapaxes(position, 0, 1))
    return tuple(track for track in tracks if np.ptp(track, axis=0).max() > 0.0)


def thinned(track: Array) -> Array:
    """Return a track (k, d) with at most `_PATH` points, including the first and the last point."""
    return np.asarray(track[np.unique(np.linspace(0, len(track) - 1, _PATH).astype(int))])


def _paths(problem: Problem, fixes: Sequence[Fix]) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Return the paths (k, d), m, of the moving targets of a run: first of its only fix, then of the alternatives."""
    if len(fixes) != 1 or fixes[0].shape or problem.epochs == 1:
        return (), ()
    others = fixes[0].alternatives
    vectors = [fixes[0].x, *others.x[np.isfinite(others.gap)]]
    paths: list[list[Array]] = [[], []]
    for number, x in enumerate(vectors):
        if not np.isfinite(x).all():
            continue
        for i, motion in enumerate(problem.motions):
            if motion.known is None and (motion.order or motion.span == "epoch"):
                paths[number > 0].append(thinned(_path(problem, fixes[0], i, x)))
    return tuple(paths[0]), tuple(paths[1])


def _path(problem: Problem, fix: Fix, target: int, x: Array) -> Array:
    """Return the path (k, d), m, of a moving target at the epochs of a run, from the parameter vector `x` (size,)."""
    motion = problem.motions[target]
    states = [fix.layout.take(x, name) for name in state_names(target, len(problem.motions), motion.order)]
    if motion.span == "epoch":
        return states[0]
    parts = [tuple(state[..., i] for i in range(state.shape[-1])) for state in states]
    rise = 0.0 if motion.rise is None else motion.rise[..., 0]
    return np.stack(course_at(problem, target, parts, elapsed(problem, target), rise), axis=-1)


def states_of(fix: Fix) -> list[tuple[Array, Array, Array]]:
    """Return positions (n, d), m, covariances (n, d, d), m^2, and whether the status is `ok` (n,), for each target."""
    flat = fix if len(fix.shape) == 1 else fix.flat()
    found = []
    for slots, shared in ((flat.layout.shared, True), (flat.layout.local, False)):
        for slot in slots:
            if slot.name.partition("[")[0] != "position":
                continue
            values = flat.take(slot.name)
            d = values.shape[-1]
            position = values.reshape(-1, d)
            # Positions of single epochs in a run have a covariance only if the solver was asked to compute it.
            covariance = np.full((len(position), d, d), np.nan)
            if shared:  # NaN removes the undetermined axes only.
                undetermined = flat.undetermined(slot.name)
                hidden = undetermined[:, :, None] | undetermined[:, None, :]
                covariance = np.where(hidden, np.nan, flat.covariance(slot.name))
            found.append((position, covariance, np.repeat(flat.code == Status.OK, len(position) // len(flat))))
    return found


def _alternatives(fixes: Sequence[Fix], d: int) -> tuple[Array, Array]:
    """Return the positions (q, d), m, and the cost gaps (q,) of the alternatives of all fixes."""
    points, gaps = [], []
    for fix in fixes:
        flat = fix if len(fix.shape) == 1 else fix.flat()
        shown = np.isfinite(flat.alternatives.gap)
        for slot in flat.layout.shared:
            if slot.name.partition("[")[0] == "position":
                points.append(flat.layout.take(flat.alternatives.x, slot.name)[shown])
                gaps.append(flat.alternatives.gap[shown])
    return np.concatenate(points or [np.zeros((0, d))]), np.concatenate(gaps or [np.zeros(0)])


# Parts of plans: stations, fixes, alternatives, ellipses, axes with units.


def xy(points: Array, view: View, size: float) -> tuple[Array, Array]:
    """Return the two coordinates of points (n, d), m, that a panel shows, in the unit of the panel (`size` metres)."""
    return points[:, view[0]] / size, points[:, view[1]] / size


def stations(panel: Axes, scene: PictureScene, view: View, size: float, *, named: bool = True, **style: Any) -> None:
    """Draw the stations; if they are few, write their names."""
    label = "station, first epoch" if scene.tracks else "station"
    look: dict[str, Any] = {"marker": "^", "s": 60, "color": BLACK, "label": label, "zorder": 3} | style
    panel.scatter(*xy(scene.stations, view, size), **look)
    if named and scene.stations.shape[0] <= _NAMED:
        for name, x, y in zip(scene.names, *xy(scene.stations, view, size), strict=True):
            note(panel, name, x, y)


def note(panel: Axes, text: str, x: float, y: float, colour: str = BLACK) -> None:
    """Write a note next to the point x, y, in the unit of the axes, readable over lines and colours."""
    from matplotlib.patheffects import withStroke

    style: dict[str, Any] = {"fontsize": 8, "color": colour, "zorder": 6, "annotation_clip": True}
    made = panel.annotate(literal(text), (x, y), xytext=(5, 5), textcoords="offset points", **style)
    # A white outline keeps the text readable over lines and colours.
    made.set_path_effects([withStroke(linewidth=2.0, foreground="white")])


def points(panel: Axes, scene: PictureScene, view: View, size: float) -> None:
    """Draw fixes, and alternatives with their cost gaps."""
    many = len(scene.fixes) > _FEW_FIXES
    for clean, colour, mark, label in ((True, BLUE, "o", "fix"), (False, ORANGE, "X", "fix, status not ok")):
        chosen = scene.fixes[scene.clean == clean]
        if len(chosen):
            look: dict[str, Any] = {"marker": mark, "s": 12 if many else 70, "color": colour, "zorder": 4}
            panel.scatter(*xy(chosen, view, size), label=label, **look)
    if len(scene.alternatives):
        style: dict[str, Any] = {"marker": "D", "s": 70, "facecolors": "none", "edgecolors": ORANGE, "linewidths": 1.8}
        panel.scatter(*xy(scene.alternatives, view, size), label="alternative, with its cost gap", zorder=4, **style)
    for gap, x, y in zip(scene.gaps, *xy(scene.alternatives, view, size), strict=True):
        note(panel, f"+{gap:.3g}" if gap >= _NO_GAP else "+0", x, y, ORANGE)


def ellipses(panel: Axes, scene: PictureScene, view: View, size: float, **style: Any) -> None:
    """Draw the 95 % ellipses of the fixes, or the outlines of the 95 % regions if ellipses are not valid."""
    if len(scene.fixes) > _ELLIPSES:
        return
    look: dict[str, Any] = {"color": BLUE, "linewidth": 1.5, "zorder": 2} | style
    seen: set[str] = set()
    outlines = scene.outlines or ({},) * len(scene.fixes)
    local = np.zeros(len(scene.fixes), dtype=bool) if scene.local is None else scene.local
    for i, (centre, covariance, regions) in enumerate(zip(scene.fixes, scene.covariances, outlines, strict=True)):
        region, place = regions.get(view), centre[list(view)]
        around = [] if region is None else [np.append(place + line, [[np.nan] * 2], axis=0) for line in region.lines]
        label = "local ellipse: not valid as 95 % region" if local[i] else "95 % ellipse"
        if region is not None:
            label = "95 % region, cut off" if region.cut else "95 % region"
        dashes = {"linestyle": ":"} if local[i] else {}
        line = np.concatenate(around) if around else place + ellipse_line(covariance[np.ix_(view, view)])
        if around or np.isfinite(line).all():
            panel.plot(*(line.T / size), **(look | dashes | {"label": None if label in seen else label}))
            seen.add(label)


def ellipse_line(covariance: Array) -> Array:
    """Return the 95 % ellipse of a covariance (2, 2), m^2, about the origin as a closed line (p, 2), m; NaN for NaN."""
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
    semi_axes, directions = error_ellipse(covariance)
    return np.asarray(np.stack([np.cos(angle), np.sin(angle)], axis=-1) * semi_axes @ directions.T)


def name_axes(panel: Axes, scene: PictureScene, view: View, unit: str) -> None:
    """Give both axes of a plan the same scale, and write their names and their unit; `view` selects the axes."""
    panel.margins(0.12)
    # With different scales, an ellipse would have a wrong shape.
    panel.set_aspect("equal", adjustable="datalim")
    grid(panel)
    panel.set_xlabel(f"{scene.axes[view[0]]} ({unit})")
    panel.set_ylabel(f"{scene.axes[view[1]]} ({unit})")
