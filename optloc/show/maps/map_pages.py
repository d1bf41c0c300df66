"""Pages with an interactive map of fixes, of tracks, or of the latest fixes of a live site."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optloc.base.types import Array
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.show.describe_fix import answer_of
from optloc.show.fix_answer import FixAnswer
from optloc.show.maps.background import SOURCES
from optloc.show.maps.canvas import Drawn, map_canvas
from optloc.show.maps.map_layers import (
    ROWS,
    counted,
    curves,
    ellipses,
    legend_of,
    line_labels,
    live_legend,
    mark_names,
    marks_of,
    nearest_turn,
    placed_rows,
    station_symbols,
    trails,
)
from optloc.show.maps.map_lines import constraint_lines, ground_tracks, lines_on_map
from optloc.show.maps.map_marks import LOOKS, NO_SPOTS, Spots, fixed_spots, map_row, other_spots, station_spots
from optloc.show.maps.projection import Plane, map_limits
from optloc.show.page import LISTED, PagePart, write_page
from optloc.show.row_answer import state_table

HELP = "Drag to move. Wheel, pinch, + or − to zoom. Select a mark, on the map or in the list, for details."
"""Text below a map while nothing is selected."""
_KEYS = (
    "Keys on the map: arrows move it, + and − zoom, 0 shows all, Enter selects the mark nearest to the centre. In the "
    "list: arrows, then Enter."
)


def fix_page(
    problem: Problem,
    fixes: Fix | Sequence[Fix],
    title: str,
    labels: Sequence[str] = (),
    *,
    times: Sequence[float] = (),
    targets: Sequence[str] = (),
    dated: bool = False,
    answer: FixAnswer | None = None,
) -> str:
    """Return an HTML page with the answer as text and an interactive map; the page needs no server and no network.

    A frame on Earth has coastlines, borders and cities. Any other frame has a grid of x and y.

    Parameters
    ----------
    problem : Problem
        Gives the stations and the frame.
    fixes : Fix or sequence of Fix
        Single fixes or batches.
    title : str
        Title of the page.
    labels : sequence of str
        Names of the fixes, for instance their epochs.
    times : sequence of float
        Times of the fixes, s.
    targets : sequence of str
        Targets of the fixes, each of which has its trail; by default one target.
    dated : bool
        Whether the times are since 1970, UTC.
    answer : FixAnswer, optional
        Text above the map. By default, the answers of the fixes.

    Raises
    ------
    InvalidProblem
        If nothing has a position, or matplotlib is missing.
    """
    several = [fixes] if isinstance(fixes, Fix) else list(fixes)
    found, others = fixed_spots(problem, several, labels, times, targets, dated=dated), other_spots(problem, several)
    # Lines of position need a single fix.
    single = several[0] if len(several) == 1 and several[0].code.size == 1 else None
    shown = [_answer(fix, labels) for fix in several] if answer is None else [replace(answer, title="")]
    return _marks_page(problem, found, others, title, "fix", single, constraint_lines(problem, several), shown)


def _answer(fix: Fix, labels: Sequence[str]) -> FixAnswer:
    """Return the answer of fixes, with the labels of the page if there is one for each fix."""
    if fix.labels is None and fix.shape and len(labels) == fix.code.size:
        fix = replace(fix, labels=np.array(labels, dtype=object).reshape(fix.shape))
    return answer_of(fix, most=LISTED)


def track_page(problem: Problem, tracks: Spots, title: str, answer: FixAnswer | None = None) -> str:
    """Return an HTML page with an interactive map of the scans of tracks; `tracks` are their marks.

    `problem` gives the stations, and `title` is the title of the page. `answer` is the text above the map.
    """
    answers = () if answer is None else (replace(answer, title=""),)
    return _marks_page(problem, tracks, NO_SPOTS, title, "track", None, answers=answers)


def live_page(problem: Problem, title: str) -> str:
    """Return an HTML page with a map of stations and of the latest fixes, which it requests from its server.

    Parameters
    ----------
    problem : Problem
        Gives the stations and the frame.
    title : str
        Title of the page.

    Raises
    ------
    InvalidProblem
        If no station has a position on the map.
    """
    flat = not problem.frame.geodetic
    stations = station_spots(problem)
    limits = map_limits([stations.place], flat=flat)
    plane = Plane(*limits, flat=flat)
    symbols, names = station_symbols(stations.text, plane(plane.nearest(stations.place)))
    layers: dict[str, Sequence[Drawn]] = {
        "trails": (),
        "ellipses": (),
        "stations": symbols,
        "fixes": (),
        "names": names,
    }
    canvas = map_canvas(
        plane,
        "map-1",
        title,
        layers,
        {"looks": LOOKS, "live": "map.json"},
        HELP,
        counted="No fix yet.",
        stations=_station_texts(problem),
        legend=live_legend(),
        summary=f"Map of {len(names)} stations and of the latest fix of each target.",
        listed=True,
    )
    return write_page(title, [PagePart("map", "Map", maps=[canvas], note=_note(flat=flat))], live=True)


def _note(*, flat: bool) -> str:
    """Return the small print below a map: keys, and the sources of the background."""
    return _KEYS if flat else f"{_KEYS} {SOURCES}"


def _station_texts(problem: Problem) -> list[tuple[str, str]]:
    """Return the name and the coordinates of each station as texts."""
    d = problem.dimension
    position = problem.stations.position.reshape(-1, problem.stations.count, d)[0]
    unknown = np.full((len(position), d, d), np.nan)
    columns = state_table(problem.frame, position, unknown, status=[""] * len(position))
    rows = [map_row(problem.frame, columns, i) for i in range(len(position))]
    return [
        (name, ", ".join(filter(None, (row.place, row.size))))
        for name, row in zip(problem.stations.names, rows, strict=True)
    ]


def _marks_page(
    problem: Problem,
    marks: Spots,
    others: Spots,
    title: str,
    role: str,
    single: Fix | None,
    shapes: Sequence[tuple[str, Array]] = (),
    answers: Sequence[FixAnswer] = (),
) -> str:
    """Return the HTML of a page with the map of fixes or tracks.

    `marks` are the marks of fixes or scans, and `others` the marks of alternatives. `role` names a mark, "fix" or
    "track". `single` is the fix if there is only one fix, for lines of position. `shapes` are names and lines (n, 2),
    degrees or metres, of constraints. `answers` are shown above the map.
    """
    flat = not problem.frame.geodetic
    stations, tracks = station_spots(problem), ground_tracks(problem)
    limits = map_limits([stations.place, marks.place, others.place, *(line for _, line in tracks)], flat=flat)
    plane = Plane(*limits, flat=flat)
    layers = _layers(problem, marks, others, role, plane)
    lines = [] if single is None else lines_on_map(problem, single, limits)
    more = {
        "lines of position": [*curves(lines, plane), *line_labels(lines, plane)],
        "ground tracks": curves(nearest_turn(tracks, plane), plane, "line"),
        "constraints": curves(nearest_turn(shapes, plane), plane, "line limit"),
    }
    layers = {**{name: drawn for name, drawn in more.items() if drawn}, **layers}
    rows = [*placed_rows(marks, plane), *placed_rows(others, plane)]
    count = len(marks.rows)
    left = f" The list has the first {ROWS} of {len(rows)} rows; the result file has all of them."
    canvas = map_canvas(
        plane,
        "map-1",
        title,
        layers,
        _data(marks, plane),
        HELP,
        off=frozenset({"trails"} if role == "fix" and single is None else ()),
        rows=rows[:ROWS],
        counted=counted(marks.rows) + (left if len(rows) > ROWS else ""),
        stations=_station_texts(problem),
        legend=legend_of(rows, list(layers)),
        summary=f"Map of {len(stations.place)} stations and {count} {'positions' if count > 1 else 'position'}.",
        listed=True,
    )
    dotted = marks.local is not None and bool(marks.local.any())
    text = "Dotted: a local ellipse, not valid as 95 % region." if dotted else ""
    return write_page(title, [PagePart("map", "Map", text, maps=[canvas], note=_note(flat=flat))], answers=answers)


def _layers(problem: Problem, marks: Spots, others: Spots, role: str, plane: Plane) -> dict[str, Sequence[Drawn]]:
    """Return the layers of marks and stations from bottom to top; layers without content are left out.

    For the arguments see `_marks_page`; `plane` is the projection of the map.
    """
    stations = station_spots(problem)
    symbols, names = station_symbols(stations.text, plane(plane.nearest(stations.place)))
    layers: dict[str, Sequence[Drawn]] = {
        "trails": trails(marks, plane),
        "ellipses": ellipses(marks, plane),
        "stations": symbols,
        "alternatives": marks_of(others, plane, first=len(marks.rows)),
        role: marks_of(marks, plane),
        "names": [*names, *(mark_names(marks, plane) if len(marks.rows) > 1 else ())],
    }
    return {name: drawn for name, drawn in layers.items() if drawn or name == role}


def _data(marks: Spots, plane: Plane) -> dict[str, object]:
    """Return the values for the script of a map: part to zoom to, largest zoom and origin of the grid."""
    data: dict[str, object] = {}
    at = plane(plane.nearest(marks.place))
    if len(at) == 1 and np.isfinite(at).all():
        data["origin"] = at[0].tolist()
    # A button zooms to the fix: its view is three ellipses wide. A map that is less than twice as wide has no button.
    if focus := _focus(marks, plane):
        # Allow zooming until a tenth of this view fills the map, and at least as far as on other maps.
        data |= {"focus": focus, "nearest": max(200.0, 10.0 * 2.0 * float(plane.half[0]) / focus[2])}
    return data


def _focus(marks: Spots, plane: Plane) -> list[float] | None:
    """Return the centre x, y and the width of a view of a single fix, in units of the drawing.

    The width is three times the size of its ellipse. The result is None if the width is at least half the width of the
    map, or if there are several marks or no ellipse. `plane` is the projection of the map.
    """
    rings = [ring for ring in marks.rings if len(ring)]
    if len(marks.place) != 1 or not rings:
        return None
    ring = plane(plane.nearest(rings[0]))
    (x, y), width = ring.mean(0), 3.0 * float(np.ptp(ring, axis=0).max())
    return [float(x), float(y), width] if width < plane.half[0] else None
