"""What all pictures share: colours, the figure, units of axes, names that keep apart, how it is written."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from optloc.errors import InvalidProblem
from optloc.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Annotation

BLACK, BLUE, ORANGE, GREY = "#000000", "#0072B2", "#D55E00", "#999999"
GREEN, SKY, PURPLE, YELLOW = "#009E73", "#56B4E9", "#CC79A7", "#E69F00"

_PLACES = ((5, 5), (-5, 5), (5, -5), (-5, -5), (0, 8), (0, -8), (9, 0), (-9, 0), (14, 14), (-14, 14), (14, -14))
_MARK, _MANY = 5.0, 200
_ASIDE: dict[int, Literal["left", "center", "right"]] = {-1: "right", 0: "center", 1: "left"}
_ABOVE: dict[int, Literal["bottom", "center", "top"]] = {-1: "top", 0: "center", 1: "bottom"}


def figure_class() -> type[Figure]:
    """Return matplotlib's figure; raise InvalidProblem where it is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise InvalidProblem(
            "pictures need matplotlib", "plot", "install it with: pip install 'optloc[plot]'"
        ) from None
    return Figure


def save(figure: Figure, path: Path) -> None:
    """Write a picture; the ending of the name decides the type."""
    figure.savefig(path, dpi=120)


def unit_of(points: Array) -> tuple[str, float]:
    """Return the unit in which points (n, 2) of metres read best, and its size."""
    reach = np.nanmax(np.abs(points), initial=1e-3)
    return ("km", 1e3) if reach >= 5e3 else ("m", 1.0) if reach >= 1.0 else ("mm", 1e-3)


def grid(panel: Axes) -> None:
    """Draw the grid of a panel."""
    panel.grid(color=GREY, alpha=0.35, linewidth=0.6)
    panel.set_axisbelow(True)


def apart(figure: Figure) -> None:
    """Move the notes at points of a finished figure until none covers another or a mark, or leaves its panel.

    Each takes the first free place around its point; a note that finds none stands above it to the right.
    """
    from matplotlib.text import Annotation

    figure.draw_without_rendering()
    for panel in figure.axes:
        notes = [text for text in panel.texts if isinstance(text, Annotation) and _movable(text)]
        if not notes:
            continue
        spots = panel.transData.transform(np.array([note.xy for note in notes]))
        taken = [_box(x - _MARK, y - _MARK, x + _MARK, y + _MARK) for x, y in _marks(panel)]
        taken += [text.get_window_extent() for text in panel.texts if text not in notes and text.get_visible()]
        for note, (x, y) in zip(notes, spots, strict=True):
            taken.append(_settled(note, panel, [box for box in taken if not box.contains(x, y)]))


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


def _settled(note: Annotation, panel: Axes, taken: list[Any]) -> Any:
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
