"""Notes next to points of a plan, moved so that none covers another, and the scale bar of a plan."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from optloc.base.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.text import Annotation

# Positions of a note around its point, in points of 1/72 inch, the usual one first; and the alignment of its text.
_PLACES = ((5, 5), (-5, 5), (5, -5), (-5, -5), (0, 8), (0, -8), (9, 0), (-9, 0), (14, 14), (-14, 14), (14, -14))
_ASIDE: dict[int, Literal["left", "center", "right"]] = {-1: "right", 0: "center", 1: "left"}
_ABOVE: dict[int, Literal["bottom", "center", "top"]] = {-1: "top", 0: "center", 1: "bottom"}
# Half the side of a mark in pixels, which notes avoid; and maximum number of marks of a panel that notes avoid, because
# more marks cover the whole panel.
_MARK, _MANY = 5.0, 200
# Largest length of a scale bar, and size of the corner in which marks are counted, as shares of a panel.
_BAR, _NEAR = 0.25, 0.38
# Width and height of the corner that a scale bar with its text covers, as shares of a panel.
_BAR_CORNER = (0.34, 0.16)


def free_corner(
    panel: Axes, taken: str = "", size: tuple[float, float] = (_NEAR, _NEAR), first: str = "upper"
) -> tuple[str, bool]:
    """Return the corner with the fewest marks of a panel with final limits, and whether it is without marks.

    Parameters
    ----------
    panel : Axes
        The panel.
    taken : str
        A corner that is not free, such as "upper left".
    size : tuple of float
        Width and height of the corner, as shares of the panel.
    first : str
        The edge that is preferred if corners have equal numbers of marks: "upper" or "lower".
    """
    (west, east), (south, north) = panel.get_xlim(), panel.get_ylim()
    marks = panel.transData.inverted().transform(mark_positions(panel))
    share = (marks - [west, south]) / [east - west, north - south]
    edges = {"upper": 1.0, "lower": 0.0} if first == "upper" else {"lower": 0.0, "upper": 1.0}
    counts = {
        f"{row} {column}": int(((np.abs(share - [x, y]) < size).all(-1)).sum())
        for row, y in edges.items()
        for column, x in (("right", 1.0), ("left", 0.0))
        if f"{row} {column}" != taken
    }
    corner = min(counts, key=lambda name: counts[name])
    return corner, not counts[corner]


def scale_bar(panel: Axes, unit: str, taken: str = "") -> None:
    """Draw a scale bar in the corner with the fewest marks, in a plan with final limits.

    `taken` is a corner that is not free. The lower corners are preferred.
    """
    from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

    (west, east), (south, north) = panel.get_xlim(), panel.get_ylim()
    most = _BAR * (east - west)
    power = 10.0 ** np.floor(np.log10(most))
    length = power * next(n for n in (5.0, 2.0, 1.0) if n * power <= most)
    corner, _ = free_corner(panel, taken, _BAR_CORNER, "lower")
    style: dict[str, Any] = {"pad": 0.3, "borderpad": 0.4, "sep": 3, "size_vertical": 0.004 * (north - south)}
    bar = AnchoredSizeBar(panel.transData, length, f"{length:g} {unit}", corner, frameon=True, **style)
    bar.patch.set(edgecolor="none", alpha=0.8)
    panel.add_artist(bar)


def separate_notes(figure: Figure | SubFigure, panels: Sequence[Axes] | None = None) -> None:
    """Move the notes of a finished figure, or of some panels, so that none covers another note or a mark.

    A note stays in its panel. It takes the first free position around its point. If no position is free, it covers
    as few others as possible.
    """
    from matplotlib.offsetbox import AnchoredOffsetbox
    from matplotlib.text import Annotation

    # Sizes of texts are known only after the layout of the whole figure, also for a part of a figure.
    whole: Any = figure
    whole.figure.draw_without_rendering()
    for panel in figure.axes if panels is None else panels:
        notes = [text for text in panel.texts if isinstance(text, Annotation) and _movable(text)]
        if not notes:
            continue
        spots = panel.transData.transform(np.array([note.xy for note in notes]))
        taken = [_box(x - _MARK, y - _MARK, x + _MARK, y + _MARK) for x, y in mark_positions(panel)]
        taken += [text.get_window_extent() for text in panel.texts if text not in notes and text.get_visible()]
        # An inset with its title hides notes below it, and a scale bar too.
        taken += [box for each in panel.child_axes if (box := each.get_tightbbox()) is not None]
        taken += [artist.get_window_extent() for artist in panel.artists if isinstance(artist, AnchoredOffsetbox)]
        for note, (x, y) in zip(notes, spots, strict=True):
            # A note may touch the box of its mark, because it is drawn next to the mark.
            taken.append(_move_to_free_place(note, panel, [box for box in taken if not box.contains(x, y)]))


def mark_positions(panel: Axes) -> Array:
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
    note takes the position in the panel that overlaps the fewest boxes; without such a position, the first.
    """
    inside, best, fewest = panel.get_window_extent(), _PLACES[0], len(taken) + 1
    for place in _PLACES:
        _place_note(note, place)
        box = note.get_window_extent()
        if inside.x0 <= box.x0 and box.x1 <= inside.x1 and inside.y0 <= box.y0 and box.y1 <= inside.y1:
            overlaps = sum(bool(box.overlaps(other)) for other in taken)
            if overlaps < fewest:
                best, fewest = place, overlaps
            if not overlaps:
                break
    _place_note(note, best)
    return note.get_window_extent()


def _place_note(note: Annotation, place: tuple[int, int]) -> None:
    """Move a note to an offset from its point, in points of 1/72 inch, and align its text away from the point."""
    note.set_position(place)
    note.set_horizontalalignment(_ASIDE[int(np.sign(place[0]))])
    note.set_verticalalignment(_ABOVE[int(np.sign(place[1]))])
