"""Layers of interactive maps: stations, marks, ellipses, trails and lines as curves, symbols and labels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from optloc.base.types import Array
from optloc.show.maps.canvas import Curve, Drawn, Label, LegendEntry, MapRow, StationSymbol, dot
from optloc.show.maps.map_marks import ELLIPSES, Spots
from optloc.show.maps.projection import Plane, path

# Decimals of the units of the drawing: an ellipse of centimetres on a map of 1000 km is still round.
_DIGITS = 5
# Size of a mark in pixels, and of a mark if there are more than `_FEW`.
_MARK, _SMALL, _FEW = 12, 8, 12
# Diameter of the white centre of a mark, as a share of its size.
_CENTRE = 0.45
# Looks whose marks have a white or black centre, which distinguishes them without colours.
_HOLLOW = {"alone", "care", "rival"}
# Maximum number of names of marks, of lines with a name at the line, and of rows of the list. More names would not fit,
# and more rows would make a page of megabytes.
_NAMES, _NAMED_LINES, ROWS = 300, 10, 2000
# Legend of the looks in the order of the page.
_MEANINGS = {
    "ok": "ok",
    "alone": "ok, but no redundancy",
    "rival": "ambiguous",
    "care": "use with care",
    "bad": "not ok",
    "rival other": "alternative",
}


def curves(lines: Sequence[tuple[str, Array]], plane: Plane, kind: str = "line thin") -> list[Drawn]:
    """Return named lines (n, 2), degrees or metres, as curves that show their names while the pointer is on them."""
    return [Curve(kind, path([plane(line)], close=False, digits=3), hover=name) for name, line in lines]


def line_labels(lines: Sequence[tuple[str, Array]], plane: Plane) -> list[Drawn]:
    """Return a label for each line, at the middle of its part within the map; nothing if there are too many lines."""
    found: list[Drawn] = []
    for name, line in lines if len(lines) <= _NAMED_LINES else ():
        at = plane(line)
        inside = np.flatnonzero((np.abs(at) < 0.95 * plane.half).all(-1))
        if len(inside):
            # A quarter along the visible part, because lines of position cross in the middle.
            x, y = at[inside[len(inside) // 4]]
            found.append(Label("along", x, y, name))
    return found


def nearest_turn(lines: Sequence[tuple[str, Array]], plane: Plane) -> list[tuple[str, Array]]:
    """Return lines after shifting each by a multiple of 360 degrees, so that it is nearest to the middle of the map."""
    if plane.flat:
        return list(lines)
    middle = plane.middle[0]
    return [(name, line - [360.0 * np.round((line[:, 0].mean() - middle) / 360.0), 0.0]) for name, line in lines]


def station_symbols(names: Sequence[str], places: Array) -> tuple[list[Drawn], list[Drawn]]:
    """Return the symbols and the names of stations at `places` (n, 2), units of the drawing.

    Stations without a position on the map have NaN there and are left out.
    """
    known = [(name, x, y) for name, (x, y) in zip(names, places, strict=True) if np.isfinite(x)]
    symbols: list[Drawn] = [StationSymbol(x, y, f"station {name}") for name, x, y in known]
    return symbols, [Label("name", x, y, name) for name, x, y in known]


def ellipses(marks: Spots, plane: Plane) -> list[Drawn]:
    """Return the 95 % ellipses and outlines of marks as curves; nothing if there are more than `ELLIPSES`.

    All valid ellipses and outlines are one curve, and all other ellipses another curve. Ellipses that are not valid
    have another class, so that the style sheet draws them dotted. `plane` is the projection of the map.
    """
    if len(marks.rings) > ELLIPSES:
        return []
    local = np.zeros(len(marks.rings), dtype=bool) if marks.local is None else marks.local
    covers = [ring for ring, bare in zip(marks.rings, local, strict=True) if not bare]
    drawn: list[Drawn] = []
    for kind, rings in (
        ("ring", [*covers, *marks.more]),
        # An ellipse that is not valid must look different from a valid ellipse.
        ("ring local", [ring for ring, bare in zip(marks.rings, local, strict=True) if bare]),
    ):
        lines = [plane(plane.nearest(ring)) for ring in rings if len(ring)]
        hover = "local ellipse: not valid as 95 % region" if kind == "ring local" else ""
        drawn += [Curve(kind, path(lines, close=True, digits=_DIGITS), hover=hover)] if lines else []
    return drawn


def trails(marks: Spots, plane: Plane) -> list[Drawn]:
    """Return a line through the marks of each target in their order; a mark without a position interrupts the line."""
    found: list[Drawn] = []
    at = plane(plane.nearest(marks.place))
    groups = np.array(marks.groups, dtype=object)
    for name in dict.fromkeys(marks.groups):
        points = at[groups == name]
        known = np.isfinite(points).all(-1)
        gaps = np.flatnonzero(~known)
        parts = [points[a + 1 : b] for a, b in pairwise([-1, *gaps.tolist(), len(points)]) if b - a > 2]
        if parts:
            found.append(Curve("trail", path(parts, close=False, digits=3), hover=f"trail of {name}" if name else ""))
    return found


def marks_of(marks: Spots, plane: Plane, *, first: int = 0) -> list[Drawn]:
    """Return marks as dots; the class, the shape and the white centre show the status. No dot without a position.

    `plane` is the projection of the map, and `first` the number of the row of the first mark.
    """
    size = _MARK if len(marks.place) <= _FEW else _SMALL
    found: list[Drawn] = []
    for i, ((x, y), row, text) in enumerate(
        zip(plane(plane.nearest(marks.place)), marks.rows, marks.text, strict=True)
    ):
        if np.isfinite(x):
            found.append(dot(x, y, row.look, size, text, first + i))
            if _HOLLOW & set(row.look.split()):
                found.append(Curve(f"dot centre {row.look}", f"M{x:.9g} {y:.9g}h0", _CENTRE * size))
    return found


def mark_names(marks: Spots, plane: Plane) -> list[Drawn]:
    """Return names and times of marks as labels; nothing if there are more than `_NAMES` marks.

    More than `_FEW` marks have no times, and marks of one day have no date.
    """
    if not 0 < len(marks.place) <= _NAMES:
        return []
    found: list[Drawn] = []
    days = {row.time.partition(" ")[0] for row in marks.rows if row.time.endswith("UTC")}
    for (x, y), row in zip(plane(plane.nearest(marks.place)), marks.rows, strict=True):
        time = row.time if len(marks.rows) <= _FEW or not row.name else ""
        if len(days) == 1:
            time = time.removeprefix(f"{next(iter(days))} ").removesuffix(" UTC")
        text = ", ".join(part for part in (row.name, time) if part)
        if text and np.isfinite(x):
            found.append(Label("mark", x, y, text))
    return found


def placed_rows(marks: Spots, plane: Plane) -> list[MapRow]:
    """Return the rows of marks with their positions, in units of the drawing."""
    at = plane(plane.nearest(marks.place))
    return [replace(row, x=float(x), y=float(y)) for row, (x, y) in zip(marks.rows, at, strict=True)]


def counted(rows: Sequence[MapRow]) -> str:
    """Return the number of rows of each status as text, for instance "12 positions: 10 ok, 2 ambiguous"."""
    numbers = Counter(row.status for row in rows)
    parts = ", ".join(f"{number} {status}" for status, number in numbers.most_common())
    return f"{len(rows)} positions: {parts}." if len(rows) > 1 else ""


def legend_of(rows: Sequence[MapRow], layers: Sequence[str]) -> list[LegendEntry]:
    """Return the legend of the statuses of `rows` and of the names of `layers`."""
    found = []
    for look, meaning in _MEANINGS.items():
        statuses = dict.fromkeys(row.status.partition(",")[0] for row in rows if row.look == look)
        if statuses:
            words = ", ".join(statuses) if look in {"rival", "care", "bad"} else meaning
            found.append(LegendEntry(look, words))
    extra = {
        "stations": LegendEntry("station", "station", "station"),
        "ellipses": LegendEntry("ring", "95 % region", "area"),
        "trails": LegendEntry("trail", "trail", "line"),
        "lines of position": LegendEntry("thin", "line of position", "line"),
        "ground tracks": LegendEntry("line", "ground track", "line"),
        "constraints": LegendEntry("limit", "limit of the target", "line"),
    }
    return [*found, *(entry for name, entry in extra.items() if name in layers)]


def live_legend() -> list[LegendEntry]:
    """Return the legend of a live map, which has every status."""
    words = {"rival": "ambiguous", "care": "unproven, curved", "bad": "any other status"}
    marks = [LegendEntry(look, words.get(look, text)) for look, text in _MEANINGS.items() if look in {"ok", *words}]
    return [*marks, *legend_of((), ("stations", "ellipses", "trails"))]
