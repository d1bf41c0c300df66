"""HTML pages: one self-contained file from the templates of this package, with interactive maps.

Python prepares the values, and templates write the HTML. Templates escape all texts except the style sheets and scripts
that `asset` reads, and the SVG of figures.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.bounds.over_area import BoundMap
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.show.describe_fix import answer_of
from optloc.show.drawing import Drawing, Look
from optloc.show.fix_answer import FixAnswer
from optloc.show.map import (
    Canvas,
    Curve,
    Drawn,
    Image,
    Label,
    Plane,
    Spots,
    constraint_lines,
    dot,
    fixed_spots,
    ground_tracks,
    lines_on_map,
    map_canvas,
    other_spots,
    path,
    station_spots,
)
from optloc.show.pictures.bound_map import COLOURS, isolines, levels
from optloc.show.pictures.style import BLACK, BLUE, ORANGE
from optloc.show.render import environment
from optloc.show.sheet import Sheet


@dataclass(frozen=True, slots=True)
class PagePart:
    """A section of a page. The page shows the parts of a section in the order of this list and omits empty parts.

    Parameters
    ----------
    name, title : str
        Id and heading of the section.
    text : str
        A paragraph.
    tables : sequence of Sheet
        Tables.
    drawings : sequence of Drawing
        Figures, side by side if the width allows.
    wide : bool
        Whether each figure has the whole width.
    maps : sequence of Canvas or Drawing
        Interactive maps, or figures of maps.
    headings : bool
        Whether interactive maps have their titles as headings.
    folded : sequence of Sheet
        Tables that are folded until the reader opens them.
    source : str
        Text of a study file, folded until the reader opens it.
    note : str
        A paragraph in small print.
    """

    name: str
    title: str
    text: str = ""
    tables: Sequence[Sheet] = ()
    drawings: Sequence[Drawing] = ()
    wide: bool = False
    maps: Sequence[Canvas | Drawing] = ()
    headings: bool = False
    folded: Sequence[Sheet] = ()
    source: str = ""
    note: str = ""

    @property
    def moving(self) -> bool:
        """Return whether the section has an interactive map and so needs the script of maps."""
        return any(isinstance(one, Canvas) for one in self.maps)


def write_page(
    title: str,
    parts: Sequence[PagePart],
    *,
    opening: Sequence[str] = (),
    facts: str = "",
    methods: Iterable[Look] = (),
    live: bool = False,
    answers: Sequence[FixAnswer] = (),
) -> str:
    """Return a page as HTML.

    Parameters
    ----------
    title : str
        Title of the page.
    parts : sequence of PagePart
        Sections of the page; if there are several, the page begins with links to them.
    opening : sequence of str
        Paragraphs above the sections.
    facts : str
        A paragraph in small print above the sections.
    methods : iterable of Look
        Methods for a legend that stays visible.
    live : bool
        Whether the map requests new fixes from its server once a second.
    answers : sequence of FixAnswer
        Answers as text above the sections; they need no script.
    """
    page = environment().get_template("page.html")
    values = {"title": title, "parts": parts, "opening": opening, "facts": facts, "answers": answers}
    return page.render(values, methods=list(methods), live=live)


# A row has about 200 bytes, so that the table adds at most a fifth of a megabyte.
LISTED = 1000
"""Number of fixes that the table of a page shows completely; of more, it shows the first and the last."""

# Pages with an interactive map: of fixes or tracks, with ellipses and lines of position, or of a bound.

# Maximum number of ellipses on a map: more are unreadable, and each ellipse adds 70 corners to the file.
_ELLIPSES = 200
# Decimals of the units of the drawing: an ellipse of centimetres on a map of 1000 km is still round.
_DIGITS = 5
# Extent of the marks, degrees, if all marks have the same position; the map is then about 1 m wide.
_LEAST = 1e-5
# Share of the map on each side that stays free of marks, as room for the names of stations.
_RIM = 0.22
# Minimum ratio of the shorter side of a map to the longer side.
_SLIMMEST = 0.6
# Size of a dot in pixels: a station, its white centre, a mark, and a mark if there are more than `_FEW`.
_STATION, _MIDDLE, _MARK, _SMALL = 11, 7, 11, 5
_FEW = 12


def fix_page(
    problem: Problem,
    fixes: Fix | Sequence[Fix],
    title: str,
    labels: Sequence[str] = (),
    answer: FixAnswer | None = None,
) -> str:
    """Return an HTML page with the answer as text and an interactive map; the page needs no server and no network.

    Parameters
    ----------
    problem : Problem
        Gives the stations; its frame is on Earth.
    fixes : Fix or sequence of Fix
        Single fixes or batches.
    title : str
        Title of the page.
    labels : sequence of str
        Names of the fixes, for instance their epochs.
    answer : FixAnswer, optional
        Text above the map. By default, the answers of the fixes.

    Raises
    ------
    InvalidProblem
        If the frame is not on Earth, nothing has a position, or matplotlib is missing.
    """
    _on_earth(problem.frame.geodetic)
    several = [fixes] if isinstance(fixes, Fix) else list(fixes)
    found, others = fixed_spots(problem, several, labels), other_spots(problem, several)
    # Lines of position need a single fix.
    single = several[0] if len(several) == 1 and several[0].code.size == 1 else None
    shown = [_answer(fix, labels) for fix in several] if answer is None else [replace(answer, title="")]
    return _marks_page(problem, found, others, title, "fix", single, constraint_lines(problem, several), shown)


def _answer(fix: Fix, labels: Sequence[str]) -> FixAnswer:
    """Return the answer of fixes, with the labels of the page if there is one for each fix."""
    if fix.labels is None and fix.shape and len(labels) == fix.code.size:
        fix = replace(fix, labels=np.array(labels, dtype=object).reshape(fix.shape))
    return answer_of(fix, most=LISTED)


def track_page(problem: Problem, tracks: Spots, title: str) -> str:
    """Return an HTML page with an interactive map of the scans of tracks; `tracks` are their marks.

    `problem` gives the stations, and `title` is the title of the page. If the frame is not on Earth, the function
    raises InvalidProblem.
    """
    _on_earth(problem.frame.geodetic)
    return _marks_page(problem, tracks, Spots(np.zeros((0, 2)), (), np.zeros(0, dtype=bool), ()), title, "track", None)


def live_page(problem: Problem, title: str) -> str:
    """Return an HTML page with a map of stations and of the latest fixes, which it requests from its server.

    Parameters
    ----------
    problem : Problem
        Gives the stations; its frame is on Earth.
    title : str
        Title of the page.

    Raises
    ------
    InvalidProblem
        If the frame is not on Earth, or matplotlib is missing.
    """
    _on_earth(problem.frame.geodetic)
    stations = station_spots(problem)
    limits = _map_limits([stations.place])
    plane, middle = Plane(*limits), (limits[0] + limits[1]) / 2.0
    layers: dict[str, Sequence[Drawn]] = {"stations": _stations(stations, plane, middle), "fixes": ()}
    text = "White: stations. Blue: the latest fixes; orange if the status is not ok. Point at a mark for details."
    canvas = map_canvas(plane, "map-1", title, layers, {}, text)
    note = "Drag to move, wheel or pinch to zoom. Shores: Natural Earth."
    return write_page(title, [PagePart("map", "Map", maps=[canvas], note=note)], live=True)


def map_page(found: BoundMap, title: str) -> str:
    """Return an HTML page with the interactive map of a bound; the page needs no network.

    `found` is the bound over a grid, and `title` the title of the page.

    Raises
    ------
    InvalidProblem
        If the frame is not on Earth, or matplotlib is missing.
    """
    _on_earth(found.geodetic)
    text = "Root of the trace of the Cramer-Rao bound of the position, in metres. Shores: Natural Earth."
    part = PagePart("map", "Bound of the position error", text, maps=[map_element(found, "map-1", title)])
    return write_page(title, [part])


def _on_earth(geodetic: bool) -> None:
    """Raise InvalidProblem if the frame of the positions is not on Earth."""
    if not geodetic:
        advice = 'write a picture (.png, .svg, .pdf), or give a [frame] of kind "geodetic", "ecef" or "enu"'
        raise InvalidProblem("an interactive map needs positions on Earth", "map", advice)


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
    degrees, of constraints. `answers` are shown above the map.
    """
    stations, tracks = station_spots(problem), ground_tracks(problem)
    limits = _map_limits([stations.place, marks.place, others.place, *(line for _, line in tracks)])
    plane, middle = Plane(*limits), (limits[0] + limits[1]) / 2.0
    lines = [] if single is None else lines_on_map(problem, single, limits)
    few = len(marks.place) <= _FEW
    layers: dict[str, Sequence[Drawn]] = {
        **({"lines of position": _curves(lines, plane)} if lines else {}),
        **({"ground tracks": _curves(_nearest_turn(tracks, middle), plane, "line")} if tracks else {}),
        **({"constraints": _curves(_nearest_turn(shapes, middle), plane, "line limit")} if shapes else {}),
        "stations": _stations(stations, plane, middle),
        **({"alternatives": _dots(others, plane, middle, _MARK)} if len(others.place) else {}),
        role: [*_ellipses(marks, plane, middle), *_dots(marks, plane, middle, _MARK if few else _SMALL)],
    }
    # A button zooms to the fix: its view is three ellipses wide. A map that is less than twice as wide has no button.
    data: dict[str, object] = {}
    if focus := _focus(marks, plane, middle):
        # Allow zooming until a tenth of this view fills the map, and at least as far as on other maps.
        data = {"focus": focus, "nearest": max(200.0, 10.0 * 2.0 * float(plane.half[0]) / focus[2])}
    text = f"White: stations. Blue: {role}, with 95 % region; orange if not ok. Point at a mark for details."
    if marks.local is not None and marks.local.any():
        text = text.replace("95 % region;", "95 % region (dotted: a local ellipse, not valid);")
    text += " Brown: limits of the target." if shapes else ""
    canvas = map_canvas(plane, "map-1", title, layers, data, text)
    note = "Drag to move, wheel or pinch to zoom. Shores: Natural Earth."
    return write_page(title, [PagePart("map", "Map", maps=[canvas], note=note)], answers=answers)


def _map_limits(places: Sequence[Array]) -> tuple[float, float, float, float]:
    """Return west, east, south, north, degrees, around all points (n, 2) of `places` with a margin.

    Points are longitude and latitude, degrees. If points are on both sides of the antimeridian, the shorter way around
    the Earth is used. Without any finite point, the function raises InvalidProblem.
    """
    points = np.concatenate(places)
    points = points[np.isfinite(points).all(-1)]
    if not len(points):
        raise InvalidProblem("nothing has a position on the map", "map", "see `optloc fix` for the reasons")
    # Move all longitudes to within 180 degrees of the first point.
    points = _shift_near(points, points[0, 0])
    low, high = points.min(0), points.max(0)
    # A degree of longitude is shorter than a degree of latitude by this factor.
    squeeze = np.array([np.cos(np.radians((low + high)[1] / 2.0)), 1.0])
    # Half the width and height with margins, in degrees of latitude; `_LEAST` replaces the extent of a single point.
    half = (0.5 + _RIM) * np.maximum(
        (high - low) * squeeze, _SLIMMEST * float(((high - low) * squeeze).max() or _LEAST)
    )
    (west, south), (east, north) = (low + high) / 2.0 - half / squeeze, (low + high) / 2.0 + half / squeeze
    return float(west), float(east), float(max(south, -90.0)), float(min(north, 90.0))


def _shift_near(place: Array, middle: float) -> Array:
    """Return longitude and latitude (n, 2), degrees, with longitudes within 180 degrees of the middle of the map."""
    out = np.array(place, dtype=float)
    out[:, 0] = (out[:, 0] - middle + 180.0) % 360.0 - 180.0 + middle
    return out


def _focus(marks: Spots, plane: Plane, middle: float) -> list[float] | None:
    """Return the centre x, y and the width of a view of a single fix, in units of the drawing.

    The width is three times the size of its ellipse. `middle` is the longitude of the middle of the map, degrees. The
    result is None if the width is at least half the width of the map, or if there are several marks or no ellipse.
    `plane` is the projection of the map.
    """
    rings = [ring for ring in marks.rings if len(ring)]
    if len(marks.place) != 1 or not rings:
        return None
    ring = plane(_shift_near(rings[0], middle))
    (x, y), width = ring.mean(0), 3.0 * float(np.ptp(ring, axis=0).max())
    return [float(x), float(y), width] if width < plane.half[0] else None


def _nearest_turn(lines: Sequence[tuple[str, Array]], middle: float) -> list[tuple[str, Array]]:
    """Return lines after shifting each by a multiple of 360 degrees, so that it is nearest to the middle of the map."""
    return [(name, line - [360.0 * np.round((line[:, 0].mean() - middle) / 360.0), 0.0]) for name, line in lines]


def _curves(lines: Sequence[tuple[str, Array]], plane: Plane, kind: str = "line thin") -> list[Drawn]:
    """Return named lines (n, 2), degrees, as curves that show their names while the pointer is on them."""
    return [Curve(kind, path([plane(line)], close=False, digits=3), tell=name) for name, line in lines]


def _stations(stations: Spots, plane: Plane, middle: float) -> list[Drawn]:
    """Return the dots and names of the stations that have a position on the map.

    `middle` is the longitude of the middle of the map, degrees.
    """
    places = plane(_shift_near(stations.place, middle))
    marks = [_station(name, x, y, f"station {name}") for name, (x, y) in zip(stations.text, places, strict=True)]
    return [one for mark, seen in zip(marks, np.isfinite(places[:, 0]), strict=True) if seen for one in mark]


def _station(name: str, x: float, y: float, tell: str) -> tuple[Drawn, ...]:
    """Return a station at x, y of the drawing: a black dot with a white centre, and its name.

    The page shows the text `tell` while the pointer is on the centre.
    """
    return dot(x, y, BLACK, _STATION), dot(x, y, "#ffffff", _MIDDLE, tell), Label("name", x, y, name)


def _ellipses(marks: Spots, plane: Plane, middle: float) -> list[Drawn]:
    """Return the 95 % ellipses and outlines of marks as curves; nothing if there are more than `_ELLIPSES`.

    All valid ellipses and outlines are one curve, and all other ellipses another curve. `middle` is the longitude of
    the middle of the map, degrees. Ellipses that are not valid have another class, so that the style sheet draws them
    dotted. `plane` is the projection of the map.
    """
    if len(marks.rings) > _ELLIPSES:
        return []
    local = np.zeros(len(marks.rings), dtype=bool) if marks.local is None else marks.local
    covers = [ring for ring, bare in zip(marks.rings, local, strict=True) if not bare]
    drawn: list[Drawn] = []
    for kind, rings in (
        ("ring", [*covers, *marks.more]),
        # An ellipse that is not valid must look different from a valid ellipse.
        ("ring local", [ring for ring, bare in zip(marks.rings, local, strict=True) if bare]),
    ):
        lines = [plane(_shift_near(ring, middle)) for ring in rings if len(ring)]
        tell = "local ellipse: not valid as 95 % region" if kind == "ring local" else ""
        drawn += [Curve(kind, path(lines, close=True, digits=_DIGITS), BLUE, tell=tell)] if lines else []
    return drawn


def _dots(marks: Spots, plane: Plane, middle: float, size: float) -> list[Drawn]:
    """Return marks as dots of `size` pixels: blue if the status is `ok`, else orange; none for a missing position.

    `middle` is the longitude of the middle of the map, degrees. `plane` is the projection of the map.
    """
    return [
        dot(x, y, BLUE if ok else ORANGE, size, text)
        for (x, y), ok, text in zip(plane(_shift_near(marks.place, middle)), marks.clean, marks.text, strict=True)
        if np.isfinite(x)
    ]


# The map of a bound: coastlines, bound, stations and trials.

# Maximum number of dots of trials: enough to show the distribution, few enough to see the bound below and to move the
# page smoothly.
_DOTS = 400
_RIGHT, _WRONG = 3, 5  # Pixels: wrong trials must be visible among many right trials.


def map_element(found: BoundMap, name: str, title: str, trials: tuple[Array, Array] | None = None) -> Canvas:
    """Return the map of a bound.

    Parameters
    ----------
    found : BoundMap
        The bound over a grid of longitude and latitude.
    name : str
        Id of the element.
    title : str
        Description of the map.
    trials : (places, off), optional
        Longitude and latitude (n, 2), degrees, of true positions, and whether each trial (n,) had a wrong result.
    """
    plane = Plane(found.x[0], found.x[-1], found.y[0], found.y[-1])
    layers: dict[str, Sequence[Drawn]] = {
        "bound": [_image(found, plane), *_lines(found, plane)],
        **({} if trials is None else {"trials": _trials(plane, *trials)}),
        "stations": _map_stations(found, plane),
    }
    return map_canvas(plane, name, title, layers, _data(found), _map_text(found))


def _map_text(found: BoundMap) -> str:
    """Return the text below the map of a bound: the range of its colours and the height."""
    steps = levels(found.sigma)
    low, high = _metres(steps[0]), _metres(steps[-1])
    where = f"{found.height:.0f} m above the ellipsoid"
    return f"Bound from {low} (light) to {high} (dark), {where}. Point at the map to read the bound."


def _metres(level: float) -> str:
    """Return a length in m as text, in km from 1000 m on."""
    return f"{level:g} m" if level < 1e3 else f"{level / 1e3:g} km"


def _image(found: BoundMap, plane: Plane) -> Image:
    """Return the bound as a picture for the map: one pixel for each grid point, transparent where there is no bound.

    `found` is the bound over a grid, and `plane` is the projection of the map.
    """
    from matplotlib import colormaps
    from matplotlib.colors import LogNorm
    from matplotlib.image import imsave

    steps = levels(found.sigma)
    # A colour scale needs two different ends, also if the bound is constant.
    norm = LogNorm(steps[0], max(steps[-1], 2.0 * steps[0]), clip=True)
    rgba = colormaps[COLOURS](norm(np.ma.masked_invalid(found.sigma)))
    # Cells without a bound are transparent.
    rgba[~np.isfinite(found.sigma)] = 0.0
    file = BytesIO()
    # The first row of a picture is at the top, the first row of the bound in the south.
    imsave(file, np.ascontiguousarray(rgba[::-1]), format="png")
    # Grid points are centres of pixels, so the picture extends half a step beyond the grid.
    dx, dy = ((v[1] - v[0]) / 2.0 for v in (found.x, found.y))
    x, y = plane(np.array([found.x[0] - dx, found.y[-1] + dy]))
    right, low = plane(np.array([found.x[-1] + dx, found.y[0] - dy]))
    return Image(x, y, right - x, low - y, f"data:image/png;base64,{b64encode(file.getvalue()).decode()}")


def _lines(found: BoundMap, plane: Plane) -> list[Drawn]:
    """Return the isolines of the bound as curves, with one label for each level.

    `found` is the bound over a grid, and `plane` is the projection of the map.
    """
    parts: list[Drawn] = []
    for level, lines in isolines(found):
        drawn = [plane(line) for line in lines]
        if not drawn:
            continue
        # Write one label for each level, in the middle of its longest line.
        longest = max(drawn, key=len)
        x, y = longest[len(longest) // 2]
        parts += [Curve("line", path(drawn, close=False)), Label("level", x, y, _metres(level))]
    return parts


def _map_stations(found: BoundMap, plane: Plane) -> list[Drawn]:
    """Return the dots and names of the stations of a bound."""
    places = zip(found.names, plane(found.stations), strict=True)
    return [one for name, (x, y) in places for one in _station(name, x, y, name)]


def _trials(plane: Plane, places: Array, off: Array) -> list[Drawn]:
    """Return at most `_DOTS` trials as dots at longitude and latitude `places` (n, 2), degrees.

    Trials with a wrong result, marked by `off` (n,), are orange and larger. `plane` is the projection of the map.
    """
    kept = np.unique(np.linspace(0, len(places) - 1, min(_DOTS, len(places))).astype(int))
    order = kept[np.argsort(off[kept], kind="stable")]  # Draw wrong trials last, on top.
    return [
        dot(x, y, ORANGE if bad else BLUE, _WRONG if bad else _RIGHT)
        for (x, y), bad in zip(plane(places[order]), off[order], strict=True)
    ]


def _data(found: BoundMap) -> dict[str, Any]:
    """Return the values from which the script of the page reads the bound at the pointer.

    `x` and `y` are first and last grid line, degrees, and their number. `values` are the bounds in m, row by row from
    the south; None where there is no bound. `found` is the bound over the grid.
    """
    return {
        "x": [float(found.x[0]), float(found.x[-1]), len(found.x)],
        "y": [float(found.y[0]), float(found.y[-1]), len(found.y)],
        "values": [float(f"{v:.3g}") if np.isfinite(v) else None for v in found.sigma.ravel()],
    }
