"""What all pictures share: colours, the figure, units of axes, names that keep apart, how it is written."""

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
from optloc.base.types import Array, Band, Polygon, Status
from optloc.linear.courses import course_at, elapsed
from optloc.problem.chart import CARTESIAN
from optloc.problem.fix import Fix
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem
from optloc.show.pictures.outlines import outlines_of
from optloc.uncertainty.outline import Outline

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Annotation

# Okabe and Ito: told apart with any colour vision, and in grey by lightness.
BLACK, BLUE, ORANGE, GREY = "#000000", "#0072B2", "#D55E00", "#999999"
GREEN, SKY, PURPLE, YELLOW = "#009E73", "#56B4E9", "#CC79A7", "#E69F00"

View = tuple[int, int]
"""Which two of the scene's axes a panel shows."""

PLAN: View = (0, 1)
HEIGHT: View = (0, 2)
# Places of a note around its point, points of 1/72 inch, the usual one first; and where text ends on either side of it.
_PLACES = ((5, 5), (-5, 5), (5, -5), (-5, -5), (0, 8), (0, -8), (9, 0), (-9, 0), (14, 14), (-14, 14), (14, -14))
_ASIDE: dict[int, Literal["left", "center", "right"]] = {-1: "right", 0: "center", 1: "left"}
_ABOVE: dict[int, Literal["bottom", "center", "top"]] = {-1: "top", 0: "center", 1: "bottom"}
# Half the side of a mark, pixels, that no note may cover; and marks of a panel that are heeded: beyond, all is covered.
_MARK, _MANY = 5.0, 200
# Stations that are named: the names of more would hide each other.
_NAMED = 20
# Fixes of which alternatives are drawn and marks are large, and those that have ellipses: beyond, dots are all one
# sees.
_FEW_FIXES, _ELLIPSES = 12, 200
# Cost gap below which two places explain the data equally well: "+0".
_NO_GAP = 1e-3
# Points of a path or track that a picture needs, and corners of an ellipse: finer than its pixels.
_PATH, _CORNERS = 200, 181
# Greatest coordinate from which a plan is in kilometres, metres.
_FAR = 5e3


def figure_class() -> type[Figure]:
    """Return matplotlib's figure; raise InvalidProblem where it is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise InvalidProblem(
            "pictures need matplotlib", "plot", "install it with: pip install 'optloc[plot]'"
        ) from None
    return Figure


def panels_for(count: int, most: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel for each of some things, at most so many side by side, inches each."""
    columns = min(count, most)
    rows = -(-count // columns)
    size = (0.6 + width * columns, 0.4 + height * rows)
    figure = figure_class()(figsize=size, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for panel in panels[count:]:
        panel.set_axis_off()
    return figure, panels[:count]


# Width of a letter of a legend, inches, and letters that its handle takes.
_LETTER, _HANDLE = 0.07, 6


def finish(figure: Figure, title: str, panels: Sequence[Axes] = (), ncols: int = 5, **style: Any) -> Figure:
    """Give a figure its title, and below it the legend of some of its panels, each label once."""
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
    """Write a picture; the ending of the name decides the type, without one it is PNG.

    Raises
    ------
    InvalidProblem
        Where that type is unknown, or the file cannot be written.
    """
    known = sorted(figure.canvas.get_supported_filetypes())
    ending = path.suffix.lower().removeprefix(".") or "png"
    if ending not in known:
        raise InvalidProblem(f"pictures of type {path.suffix!r} are unknown", str(path), nearest(ending, known))
    # Drawn before it is written: an error of the disk inside a library has many names.
    drawn = BytesIO()
    figure.savefig(drawn, dpi=120, format=ending)
    with written(path) as file:
        file.write_bytes(drawn.getvalue())


# Letters of a title or a name that a picture has room for.
_LETTERS = 120


def literal(text: str) -> str:
    """Return a text as matplotlib shows it letter by letter: dollars begin no formula, and `_` hides nothing."""
    text = visible(" ".join(text.split()))
    text = text if len(text) <= _LETTERS else f"{text[: _LETTERS - 1]}…"
    return (" " if text.startswith("_") else "") + text.replace("$", r"\$")


def unit_of(points: Array) -> tuple[str, float]:
    """Return the unit in which points (n, 2) of metres read best, and its size."""
    reach = np.nanmax(np.abs(points), initial=1e-3)
    return ("km", 1e3) if reach >= _FAR else ("m", 1.0) if reach >= 1.0 else ("mm", 1e-3)


def grid(panel: Axes) -> None:
    """Draw the grid of a panel."""
    panel.grid(color=GREY, alpha=0.35, linewidth=0.6)
    panel.set_axisbelow(True)


# Parts of a panel that a scale bar takes: a length that reads well, and the corner in which fewest marks are.
_BAR, _CORNER = 0.25, 0.3


def scale_bar(panel: Axes, unit: str) -> None:
    """Draw the bar of a length in a corner of a plan whose limits are settled."""
    from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

    (west, east), (south, north) = panel.get_xlim(), panel.get_ylim()
    most = _BAR * (east - west)
    power = 10.0 ** np.floor(np.log10(most))
    length = power * next(n for n in (5.0, 2.0, 1.0) if n * power <= most)
    marks = panel.transData.inverted().transform(_marks(panel))
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


# Notes that keep apart.


def separate_notes(figure: Figure) -> None:
    """Move the notes at points of a finished figure until none covers another or a mark, or leaves its panel.

    Each takes the first free place around its point; a note that finds none stands above it to the right.
    """
    from matplotlib.text import Annotation

    # Sizes of texts are known only once the figure was laid out.
    figure.draw_without_rendering()
    for panel in figure.axes:
        notes = [text for text in panel.texts if isinstance(text, Annotation) and _movable(text)]
        if not notes:
            continue
        spots = panel.transData.transform(np.array([note.xy for note in notes]))
        taken = [_box(x - _MARK, y - _MARK, x + _MARK, y + _MARK) for x, y in _marks(panel)]
        taken += [text.get_window_extent() for text in panel.texts if text not in notes and text.get_visible()]
        for note, (x, y) in zip(notes, spots, strict=True):
            # The box of a mark that the note belongs to may be touched: it is drawn beside it.
            taken.append(_settle(note, panel, [box for box in taken if not box.contains(x, y)]))


def _marks(panel: Axes) -> Array:
    """Return the marks (n, 2) of a panel on the canvas."""
    from matplotlib.collections import PathCollection

    found = [np.ma.filled(c.get_offsets(), np.nan) for c in panel.collections if isinstance(c, PathCollection)]
    points = np.concatenate([np.zeros((0, 2)), *found])
    return np.asarray(panel.transData.transform(points[np.isfinite(points).all(-1)][:_MANY]))


def _movable(note: Annotation) -> bool:
    return note.anncoords == "offset points" and note.get_visible()


def _box(*corners: float) -> Any:
    from matplotlib.transforms import Bbox

    return Bbox.from_extents(*corners)


def _settle(note: Annotation, panel: Axes, taken: list[Any]) -> Any:
    """Move a note to its first free place, and return the box it then has."""
    inside = panel.get_window_extent()
    for place in _PLACES:
        _put(note, place)
        box = note.get_window_extent()
        held = inside.x0 <= box.x0 and box.x1 <= inside.x1 and inside.y0 <= box.y0 and box.y1 <= inside.y1
        if held and not any(box.overlaps(other) for other in taken):
            return box
    _put(note, _PLACES[0])
    return note.get_window_extent()


def _put(note: Annotation, place: tuple[int, int]) -> None:
    note.set_position(place)
    note.set_horizontalalignment(_ASIDE[int(np.sign(place[0]))])
    note.set_verticalalignment(_ABOVE[int(np.sign(place[1]))])


# What a picture of fixes shows: positions along its axes, covariances, alternatives, regions.


@dataclass(frozen=True, slots=True)
class PictureScene:
    """What is drawn, metres along the picture's axes (east, north, up on Earth).

    Parameters
    ----------
    stations : array (s, d)
        Positions.
    names : tuple of s str
        Their names.
    fixes : array (n, d)
        Estimates; NaN where there is none.
    covariances : array (n, d, d)
        Theirs; NaN where there is none.
    clean : bool array (n,)
        Where the status is ok.
    alternatives : array (q, d)
        Other positions.
    gaps : array (q,)
        Their cost gaps.
    axes : tuple of d str
        Names of the axes.
    regions : tuple of array (v, 2)
        Corners of the polygons and boxes of the plan.
    tracks : tuple of array (k, d)
        Where moving stations are in the course of the run.
    paths : tuple of array (k, d)
        The same of moving targets, as they were fixed.
    other_paths : tuple of array (k, d)
        The same as the alternatives have it.
    known : tuple of array (k, d)
        Places of known targets.
    outlines : tuple of n dicts of View to Outline
        The region of each fix that no ellipse covers, in the views of a picture; empty for the others.
    local : bool array (n,), optional
        Where an ellipse does not cover, and what does is not known.
    """

    stations: Array
    names: tuple[str, ...]
    fixes: Array
    covariances: Array
    clean: Array
    alternatives: Array
    gaps: Array
    axes: tuple[str, ...]
    regions: tuple[Array, ...] = ()
    tracks: tuple[Array, ...] = ()
    paths: tuple[Array, ...] = ()
    other_paths: tuple[Array, ...] = ()
    known: tuple[Array, ...] = ()
    outlines: tuple[dict[View, Outline], ...] = ()
    local: Array | None = None

    def moved(self, change: Callable[[Array], Array]) -> PictureScene:
        """Return the scene with all positions changed; regions, outlines about the fixes and covariances stay."""
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
    """Return what is to be drawn of a problem and its fixes, and outlines of what no ellipse covers if asked for."""
    # Of moving stations the first epoch, of a batch the first problem: tracks are drawn as lines.
    stations = problem.stations.position.reshape(-1, problem.stations.count, problem.dimension)[0]
    parts = [part for fix in fixes for part in states_of(fix)]
    d = problem.dimension
    position = np.concatenate([p for p, _, _ in parts] or [np.zeros((0, d))])
    covariance = np.concatenate([c for _, c, _ in parts] or [np.zeros((0, d, d))])
    clean = np.concatenate([ok for _, _, ok in parts] or [np.zeros(0, dtype=bool)])
    others, gaps = _alternatives(fixes, d) if len(position) <= _FEW_FIXES else (np.zeros((0, d)), np.zeros(0))
    axes = ("east", "north", "up") if problem.frame.geodetic else ("x", "y", "z")
    reach = np.concatenate([stations, position[np.isfinite(position).all(-1)]])[:, :2]
    # A box in ECEF is no shape of a plan.
    regions = () if problem.frame.kind == "ecef" else _regions(problem, reach)
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
    return _local(problem, scene) if problem.frame.kind == "ecef" else scene


def _outlines(problem: Problem, fixes: Sequence[Fix], count: int) -> tuple[dict[View, Outline], ...]:
    """Return the regions of fixes in the plan and, in space, in the view of the height."""
    views = (PLAN, HEIGHT) if problem.dimension == 3 else (PLAN,)
    local = local_frame(problem)
    axes = np.eye(problem.dimension) if local is None else local.rotation_to_ecef().T
    found = regions_of(problem, fixes, count, [axes[list(view)] for view in views])
    return tuple(dict(zip(views, each, strict=False)) for each in found)


def regions_of(
    problem: Problem, fixes: Sequence[Fix], count: int, planes: Sequence[Array]
) -> tuple[list[Outline], ...]:
    """Return the regions of fixes of one position each in planes; none where there are others, or too many.

    Parameters
    ----------
    problem : Problem
        Of the fixes.
    fixes : sequence of Fix
        Single fixes or batches.
    count : int
        How many positions they are.
    planes : sequence of array (2, d) or (n, 2, d)
        Axes of each plane, of all fixes or of each.
    """
    if count > _ELLIPSES or count != sum(fix.code.size for fix in fixes):
        return ()
    found: list[list[Outline]] = []
    for fix in fixes:
        part = slice(len(found), len(found) + fix.code.size)
        found += outlines_of(problem, fix, [plane if plane.ndim == 2 else plane[part] for plane in planes])
    return tuple(found)


def is_local(fixes: Sequence[Fix], outlined: Sequence[bool], count: int) -> Array | None:
    """Return where an ellipse does not cover and there is no outline (n,); None unless fixes are one position each."""
    if count != sum(fix.code.size for fix in fixes):
        return None
    kinds = [np.zeros(fix.code.size) if fix.chart is None else np.ravel(fix.chart.kind) for fix in fixes]
    bare = np.array([not each for each in outlined] or [True] * count, dtype=bool)
    return np.asarray((np.concatenate([*kinds, np.zeros(0)]) != CARTESIAN) & bare)


def local_frame(problem: Problem) -> Frame | None:
    """Return east, north and up at the centre of stations in ECEF, in which they are drawn; None in other frames."""
    if problem.frame.kind != "ecef":
        return None
    stations = problem.stations.position.reshape(-1, problem.stations.count, problem.dimension)[0]
    lat, lon, height = problem.frame.to_geodetic(stations.mean(0))
    return Frame("enu", (float(lat), float(lon), float(height)))


def placed_points(problem: Problem, points: Array) -> tuple[Array, Array]:
    """Return points (n, d) along the picture's axes in the problem's frame, and the axes (d, d) in its rows."""
    local = local_frame(problem)
    if local is None:
        return points, np.eye(problem.dimension)
    return local.to_ecef(points), local.rotation_to_ecef().T


def _local(problem: Problem, scene: PictureScene) -> PictureScene:
    """Return a scene in ECEF along east, north and up at the stations' centre."""
    local = local_frame(problem)
    assert local is not None
    turn = local.rotation_to_ecef().T
    moved = scene.moved(lambda place: local.from_ecef(place.reshape(-1, 3)))
    return replace(moved, covariances=turn @ scene.covariances @ turn.T)


def _tracks(problem: Problem) -> tuple[Array, ...]:
    """Return the tracks (k, d) of the stations of a single run that move."""
    position = problem.stations.position
    if position.ndim > 3:
        return ()
    tracks = (thinned(track) for track in np.swapaxes(position, 0, 1))
    return tuple(track for track in tracks if np.ptp(track, axis=0).max() > 0.0)


def thinned(track: Array) -> Array:
    """Return a track (k, d) with no more points than a picture needs, the first and the last among them."""
    return np.asarray(track[np.unique(np.linspace(0, len(track) - 1, _PATH).astype(int))])


def _paths(problem: Problem, fixes: Sequence[Fix]) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Return the paths (k, d) of the moving targets of a run, as fixed and as its alternatives have them."""
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
    motion = problem.motions[target]
    states = [fix.layout.take(x, name) for name in state_names(target, len(problem.motions), motion.order)]
    if motion.span == "epoch":
        return states[0]
    parts = [tuple(state[..., i] for i in range(state.shape[-1])) for state in states]
    rise = 0.0 if motion.rise is None else motion.rise[..., 0]
    return np.stack(course_at(problem, target, parts, elapsed(problem, target), rise), axis=-1)


def _regions(problem: Problem, reach: Array) -> tuple[Array, ...]:
    """Return the corners (v, 2) of polygons and boxes; an open box ends a little beyond the points (n, 2) to reach."""
    rim = 0.1 * np.ptp(reach, axis=0)
    sides: dict[int, tuple[Array, Array]] = {}
    for c in problem.constraints:
        # A box is stored as bounds of single coordinates; other planes have no edges to be drawn.
        if isinstance(c, Band) and c.kind == "plane" and np.ndim(c.lower) == np.ndim(c.upper) == 0:
            along = np.flatnonzero(c.coefficients)
            if len(along) == 1 and along[0] < 2 and c.coefficients[along[0]] == 1.0:
                box = sides.setdefault(c.target, (reach.min(0) - rim, reach.max(0) + rim))
                for corner, bound in zip(box, (c.lower, c.upper), strict=True):
                    corner[along[0]] = bound if np.isfinite(bound) else corner[along[0]]
    boxes = [np.array([[a[0], a[1]], [b[0], a[1]], [b[0], b[1]], [a[0], b[1]]]) for a, b in sides.values()]
    return (*boxes, *(c.vertices for c in problem.constraints if isinstance(c, Polygon)))


def states_of(fix: Fix) -> list[tuple[Array, Array, Array]]:
    """Return positions (n, d), covariances (n, d, d) and whether they are clean (n,) of every target."""
    flat = fix if len(fix.shape) == 1 else fix.flat()
    found = []
    for slots, shared in ((flat.layout.shared, True), (flat.layout.local, False)):
        for slot in slots:
            if slot.name.partition("[")[0] != "position":
                continue
            values = flat.take(slot.name)
            d = values.shape[-1]
            position = values.reshape(-1, d)
            # Positions of single epochs of a run have no covariance unless it was asked for.
            covariance = np.full((len(position), d, d), np.nan)
            if shared:  # an axis that is not determined has no ellipse, and the others keep theirs
                wild = flat.undetermined(slot.name)
                covariance = np.where(wild[:, :, None] | wild[:, None, :], np.nan, flat.covariance(slot.name))
            found.append((position, covariance, np.repeat(flat.code == Status.OK, len(position) // len(flat))))
    return found


def _alternatives(fixes: Sequence[Fix], d: int) -> tuple[Array, Array]:
    points, gaps = [], []
    for fix in fixes:
        flat = fix if len(fix.shape) == 1 else fix.flat()
        shown = np.isfinite(flat.alternatives.gap)
        for slot in flat.layout.shared:
            if slot.name.partition("[")[0] == "position":
                points.append(flat.layout.take(flat.alternatives.x, slot.name)[shown])
                gaps.append(flat.alternatives.gap[shown])
    return np.concatenate(points or [np.zeros((0, d))]), np.concatenate(gaps or [np.zeros(0)])


# What plans are made of: stations, fixes, alternatives, ellipses, axes with units.


def xy(points: Array, view: View, size: float) -> tuple[Array, Array]:
    """Return the two coordinates of points (n, d) that a panel shows, in its unit."""
    return points[:, view[0]] / size, points[:, view[1]] / size


def stations(panel: Axes, scene: PictureScene, view: View, size: float, *, named: bool = True, **style: Any) -> None:
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
    made = panel.annotate(literal(text), (x, y), xytext=(5, 5), textcoords="offset points", **style)
    # A white rim: readable over lines and colours.
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
    """Draw the 95 % ellipses of the fixes, and the outlines of the regions where ellipses do not cover."""
    if len(scene.fixes) > _ELLIPSES:
        return
    look: dict[str, Any] = {"color": BLUE, "linewidth": 1.5, "zorder": 2} | style
    seen: set[str] = set()
    outlines = scene.outlines or ({},) * len(scene.fixes)
    local = np.zeros(len(scene.fixes), dtype=bool) if scene.local is None else scene.local
    for i, (centre, covariance, regions) in enumerate(zip(scene.fixes, scene.covariances, outlines, strict=True)):
        region, place = regions.get(view), centre[list(view)]
        around = [] if region is None else [np.append(place + line, [[np.nan] * 2], axis=0) for line in region.lines]
        label = "local ellipse: it does not cover" if local[i] else "95 % ellipse"
        if region is not None:
            label = "95 % region, cut off" if region.cut else "95 % region"
        dashes = {"linestyle": ":"} if local[i] else {}
        line = np.concatenate(around) if around else place + ellipse_line(covariance[np.ix_(view, view)])
        if around or np.isfinite(line).all():
            panel.plot(*(line.T / size), **(look | dashes | {"label": None if label in seen else label}))
            seen.add(label)


def ellipse_line(covariance: Array) -> Array:
    """Return the 95 % ellipse of a covariance (2, 2) about the origin as a closed line; NaN where there is none."""
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
    semi_axes, directions = error_ellipse(covariance)
    return np.asarray(np.stack([np.cos(angle), np.sin(angle)], axis=-1) * semi_axes @ directions.T)


def name_axes(panel: Axes, scene: PictureScene, view: View, unit: str) -> None:
    """Give both axes of a plan one scale, names and units."""
    panel.margins(0.12)
    # One scale on both axes, or an ellipse would have another shape.
    panel.set_aspect("equal", adjustable="datalim")
    grid(panel)
    panel.set_xlabel(f"{scene.axes[view[0]]} ({unit})")
    panel.set_ylabel(f"{scene.axes[view[1]]} ({unit})")
