"""Parts of an interactive map: curves, labels, pictures and rows of the list, and the map that a template writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from optloc.base.types import Array
from optloc.show.maps.background import borders, cities_of, land
from optloc.show.maps.projection import Plane, short_path


@dataclass(frozen=True, slots=True)
class Curve:
    """A path of SVG. A dot is a path of length zero: the stroke has round ends, so its width is the size of the dot.

    Parameters
    ----------
    kind : str
        Classes of the style sheet, which gives the colour.
    d : str
        Path data, in units of the drawing.
    width : float
        Width of the stroke, pixels at any zoom; 0 for the width of the style sheet.
    hover : str
        Text that the page shows while the pointer is on the curve.
    row : int
        Number of the row of the list that belongs to a mark; -1 if there is no row.
    """

    kind: str
    d: str
    width: float = 0.0
    hover: str = ""
    row: int = -1
    shape: ClassVar = "curve"  # The template selects the SVG element by the shape.


@dataclass(frozen=True, slots=True)
class Label:
    """A text at a position of the drawing.

    Parameters
    ----------
    kind : str
        Class of the style sheet.
    x, y : float
        Position, in units of the drawing.
    text : str
        The text.
    shown : bool
        Whether the text fits on the whole map. The script decides again at each zoom.
    """

    kind: str
    x: float
    y: float
    text: str
    shown: bool = True
    shape: ClassVar = "label"


@dataclass(frozen=True, slots=True)
class StationSymbol:
    """A triangle that marks a station; it has the same size at any zoom.

    Parameters
    ----------
    x, y : float
        Centre, in units of the drawing.
    hover : str
        Text that the page shows while the pointer is on the symbol.
    """

    x: float
    y: float
    hover: str
    shape: ClassVar = "symbol"


@dataclass(frozen=True, slots=True)
class Image:
    """A picture in a drawing.

    Parameters
    ----------
    x, y : float
        Upper left corner, in units of the drawing.
    width, height : float
        Size, in units of the drawing.
    source : str
        Data URL with the content.
    """

    x: float
    y: float
    width: float
    height: float
    source: str
    shape: ClassVar = "image"


Drawn = Curve | Label | StationSymbol | Image


@dataclass(frozen=True, slots=True)
class MapRow:
    """A row of the list of a map: one fix, one scan of a track, or one alternative.

    Parameters
    ----------
    name : str
        Name, for instance of the epoch or the target.
    time : str
        Time as text; empty if it is unknown.
    status : str
        Status.
    look : str
        Class of the style sheet for this status; see `map_marks.look_of`.
    place : str
        Coordinates as text; empty without a position.
    copied : str
        Coordinates as the button copies them: decimal degrees or metres, separated by commas.
    size : str
        Height and standard deviations as text.
    note : str
        Reason of the status.
    x, y : float
        Position, in units of the drawing; NaN without a position.
    """

    name: str
    time: str
    status: str
    look: str
    place: str = ""
    copied: str = ""
    size: str = ""
    note: str = ""
    x: float = float("nan")
    y: float = float("nan")


@dataclass(frozen=True, slots=True)
class LegendEntry:
    """An entry of the legend of a map.

    Parameters
    ----------
    look : str
        Class of the style sheet; for a bar its colours as a gradient of CSS.
    text : str
        Meaning of the mark.
    shape : str
        "dot", "station", "line", "area" or "bar".
    """

    look: str
    text: str
    shape: str = "dot"


@dataclass(frozen=True, slots=True)
class Canvas:
    """A map, ready for a template.

    Parameters
    ----------
    name : str
        Id of the element.
    title : str
        Description of the map.
    layers : mapping of str to sequence of Drawn
        Layers from bottom to top; a checkbox hides each layer.
    text : str
        Text below the map while the pointer is on no mark.
    box, shore, border : str
        View box of the SVG, and path data of all land and of all borders.
    data : dict
        Values for the script: `middle`, `scale` and `flat` of the plane; `x`, `y` and `values` of a bound; `focus`,
        the centre and width of a part that a button shows; `nearest`, the largest zoom; `origin`, the point from which
        the grid counts distances.
    off : frozenset of str
        Layers that are hidden at first.
    rows : sequence of MapRow
        Rows of the list of positions.
    counted : str
        Text above the list, for instance the number of fixes of each status.
    stations : sequence of (str, str)
        Names and coordinates of the stations.
    legend : sequence of LegendEntry
        Legend.
    summary : str
        Description of the content, for readers who do not see the map.
    listed : bool
        Whether the map has a list; the list of a live map is empty at first.
    """

    name: str
    title: str
    layers: Mapping[str, Sequence[Drawn]]
    text: str
    box: str
    shore: str
    data: dict[str, Any]
    border: str = ""
    off: frozenset[str] = frozenset()
    rows: Sequence[MapRow] = ()
    counted: str = ""
    stations: Sequence[tuple[str, str]] = ()
    legend: Sequence[LegendEntry] = ()
    summary: str = ""
    listed: bool = False


def map_canvas(
    plane: Plane,
    name: str,
    title: str,
    layers: Mapping[str, Sequence[Drawn]],
    data: dict[str, Any],
    text: str,
    *,
    under: Mapping[str, Sequence[Drawn]] | None = None,
    **more: Any,
) -> Canvas:
    """Return the map of a plane with its background and with the labels that fit.

    For the arguments see `Canvas`; `data` needs no `middle`, `scale` and `flat`, and `more` are other fields. `under`
    are layers below the grid and the names of cities.
    """
    width, height = 2.0 * plane.half
    box = f"{-plane.half[0]:.1f} {-plane.half[1]:.1f} {width:.1f} {height:.1f}"
    shore = border = ""
    below: dict[str, Sequence[Drawn]] = {**(under or {}), "grid": ()}
    if not plane.flat:
        window = plane.window()
        shore = short_path([plane(ring) for ring in land(window)], close=True)
        border = short_path([plane(line) for line in borders(window)], close=False)
        below["cities"] = _city_labels(plane)
    known = {"middle": plane.middle.tolist(), "scale": plane.scale, "flat": plane.flat, **data}
    fitted = fitting({**below, **layers}, plane)
    return Canvas(name, title, fitted, text, box, shore, known, border, **more)


def dot(x: float, y: float, look: str, size: float, hover: str = "", row: int = -1) -> Curve:
    """Return a dot of `size` pixels at any zoom; the page shows `hover` while the pointer is on the dot."""
    return Curve(f"dot {look}", f"M{x:.9g} {y:.9g}h0", size, hover, row)


def _city_labels(plane: Plane) -> list[Label]:
    """Return the names of cities as labels, the largest city first; the bullet of a label marks the city."""
    found = cities_of(plane)
    return [Label("city", x, y, f"• {name}") for name, (x, y) in zip(found.names, plane(found.place), strict=True)]


# Layout of labels without a script: width of a letter and height of a line in pixels, width of the map on a page in
# pixels, and order of the kinds of labels, the most important first.
_LETTER, _LINE, _PAGE = 6.6, 14.0, 760.0
_ORDER = ("name", "mark", "level", "along", "city")


def fitting(layers: Mapping[str, Sequence[Drawn]], plane: Plane) -> dict[str, Sequence[Drawn]]:
    """Return the layers with `shown` false for each label that overlaps a more important label on the whole map.

    `plane` is the projection of the map. The order of importance is stations, marks, levels, lines, cities.
    """
    pixel = 2.0 * float(plane.half.max()) / _PAGE
    texts = [one for drawn in layers.values() for one in drawn if isinstance(one, Label)]
    texts.sort(key=lambda one: _ORDER.index(one.kind) if one.kind in _ORDER else len(_ORDER))
    boxes = np.zeros((0, 4))
    hidden: set[int] = set()
    for one in texts:
        width, height = pixel * _LETTER * len(one.text), pixel * _LINE
        box = np.array([one.x, one.y - height, one.x + width, one.y + 0.3 * height])
        overlaps = (boxes[:, :2] < box[2:]).all(1) & (box[:2] < boxes[:, 2:]).all(1)
        if overlaps.any() or not _inside(box, plane.half):
            hidden.add(id(one))
        else:
            boxes = np.vstack([boxes, box])
    return {
        name: [replace(one, shown=False) if isinstance(one, Label) and id(one) in hidden else one for one in drawn]
        for name, drawn in layers.items()
    }


def _inside(box: Array, half: Array) -> bool:
    """Return whether a box (4,), left, top, right, bottom, is within the map; `half` is half the size of the map."""
    return bool((box[:2] > -half).all() and (box[2:] < half).all())
