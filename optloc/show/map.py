"""Interactive maps: projection, coastlines, layers of marks, and the marks of fixes, tracks and stations.

A `Plane` projects longitude and latitude to the units of an SVG drawing. `Spots` are marks on Earth, and a `Canvas` is
a map that a template writes as SVG.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Any, ClassVar

import numpy as np

from optloc.base.linalg import error_ellipse
from optloc.base.types import Array, Status
from optloc.models import MODELS
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.show.columns import UNCHECKED
from optloc.show.pictures.fixes import lines_of_position
from optloc.show.pictures.outlines import level_planes
from optloc.show.pictures.style import figure_class, is_local, regions_of, scene_of, states_of, thinned
from optloc.uncertainty.outline import Outline

# Coastlines for maps without a network.
#
# Source: the land polygons of Natural Earth at 1:50 million, version 4.1, public domain
# (https://www.naturalearthdata.com), from the package world-atlas 2.0.2. Coordinates are rounded to a hundredth of a
# degree. The file stores the differences between corners of all rings, and the lengths of the rings.

Window = tuple[float, float, float, float]
"""West, east, south, north in degrees; east may exceed 180."""


@cache
def rings() -> tuple[Array, ...]:
    """Return the shores of all land and of inland seas as closed rings (n, 2): longitude and latitude, degrees.

    A ring that crosses the antimeridian has longitudes beyond 180 degrees. The ring of Antarctica runs along the pole.
    """
    # The file stores differences in hundredths of a degree, as integers, which compress well.
    with (files("optloc.show") / "natural-earth-50m.npz").open("rb") as file, np.load(file) as data:
        delta, length = data["delta"].astype(np.int64), data["length"]
    starts = np.cumsum(length)[:-1]
    return tuple(np.cumsum(part, axis=0) / 100.0 for part in np.split(delta, starts))


def land(window: Window) -> list[Array]:
    """Return the land in a window as polygons (n, 2), degrees; fill them by the even-odd rule."""
    west, east, south, north = window
    found = []
    for ring in rings():
        low, high = ring.min(0), ring.max(0)
        if high[1] < south or low[1] > north:
            continue
        # A ring that crosses the antimeridian can overlap the window after a turn of 360 degrees.
        for turn in (-360.0, 0.0, 360.0):
            if low[0] + turn < east and high[0] + turn > west:
                cut = _clip_ring(ring + np.array([turn, 0.0]), window)
                if len(cut) > 2:
                    found.append(cut)
    return found


def _clip_ring(ring: Array, window: Window) -> Array:
    """Return a ring (n, 2) clipped to a window, degrees.

    The ring is clipped at one side of the window after the other; the result is empty if the ring is outside. Source:
    I. E. Sutherland and G. W. Hodgman, "Reentrant polygon clipping", Communications of the ACM 17 (1974).
    """
    for axis, limit, sign in ((0, window[0], 1.0), (0, window[1], -1.0), (1, window[2], 1.0), (1, window[3], -1.0)):
        if not len(ring):
            return ring
        # Distance inside this side, negative outside; each corner is compared with the corner before it.
        depth = sign * (ring[:, axis] - limit)
        before, depth_before = np.roll(ring, 1, axis=0), np.roll(depth, 1)
        crosses = (depth >= 0.0) != (depth_before >= 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            share = depth_before / (depth_before - depth)
            edge = before + np.where(crosses, share, 0.0)[:, None] * (ring - before)
        # The point on the side comes before the corner; keep points where an edge crosses, and corners inside.
        both = np.stack([edge, ring], axis=1).reshape(-1, 2)
        ring = both[np.stack([crosses, depth >= 0.0], axis=1).ravel()]
    return ring


# Units of the drawing along its longer side. With one decimal, a coast is accurate to a ten-thousandth of the map.
_SIZE = 1000.0
# Extent of the drawn coast, in half sizes of the map along x and y. The script zooms out to 2.5 times the map, a screen
# can be wider than the map, and the user can drag the map.
_AROUND = np.array([6.0, 4.0])
# Minimum ratio of the half sizes for the extent of the coast: the window of a narrow map is as wide as the page.
_NARROWEST = 0.8


class Plane:
    """The projection of longitude and latitude to units of the drawing; true to scale in the middle of the map.

    Parameters
    ----------
    west, east, south, north : float
        Limits of the map, degrees; east can exceed 180.

    Attributes
    ----------
    middle : array (2,)
        Longitude and latitude of the centre of the map, degrees. The drawing has its origin there.
    squeeze : float
        Ratio of a degree of longitude to a degree of latitude on the ground.
    unit : float
        Units of the drawing in a degree of latitude.
    half : array (2,)
        Half the width and half the height of the map, in units of the drawing.
    """

    def __init__(self, west: float, east: float, south: float, north: float) -> None:
        self.middle = np.array([(west + east) / 2.0, (south + north) / 2.0])
        # A degree of longitude is shorter than a degree of latitude by this factor.
        self.squeeze = float(np.cos(np.radians(self.middle[1])))
        self.unit = _SIZE / max((east - west) * self.squeeze, north - south)
        self.half = np.array([(east - west) * self.squeeze, north - south]) * self.unit / 2.0

    def __call__(self, place: Array) -> Array:
        """Return longitude and latitude (..., 2), degrees, in units of the drawing."""
        shift = np.asarray(place, dtype=float) - self.middle
        return np.asarray(shift * [self.squeeze * self.unit, -self.unit])

    @property
    def scale(self) -> list[float]:
        """Return the units of the drawing in a degree of longitude and in a degree of latitude."""
        return [self.squeeze * self.unit, -self.unit]

    def window(self) -> Window:
        """Return the extent of the drawn coast: the map and its surroundings, degrees."""
        half = np.maximum(self.half, self.half.max() * _NARROWEST) * _AROUND / [self.squeeze * self.unit, self.unit]
        (west, south), (east, north) = self.middle - half, self.middle + half
        return max(west, self.middle[0] - 180.0), min(east, self.middle[0] + 180.0), max(south, -90.0), min(north, 90.0)


@dataclass(frozen=True, slots=True)
class Curve:
    """A path of SVG. A dot is a path of length zero: the stroke has round ends, so its width is the size of the dot.

    Parameters
    ----------
    kind : str
        Class of the style sheet.
    d : str
        Path data, in units of the drawing.
    colour : str
        Colour of the stroke if the style sheet sets no colour.
    width : float
        Width of the stroke, pixels at any zoom.
    tell : str
        Text that the page shows while the pointer is on the curve.
    """

    kind: str
    d: str
    colour: str = ""
    width: float = 0.0
    tell: str = ""
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
    """

    kind: str
    x: float
    y: float
    text: str
    shape: ClassVar = "label"


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


Drawn = Curve | Label | Image


@dataclass(frozen=True, slots=True)
class Canvas:
    """A map, ready for a template.

    Parameters
    ----------
    name : str
        Id of the element.
    title : str
        Description of the map.
    layers : mapping of str to sequence of Curve, Label and Image
        Layers from bottom to top; a checkbox hides each layer.
    text : str
        Text below the map while the pointer is on no mark.
    box, shore : str
        View box of the SVG, and path data of all land.
    data : dict
        Values for the script: `middle` and `scale` of the plane; `x`, `y` and `values` of a bound; `focus`, the centre
        and width of a part that a button shows; `nearest`, the largest zoom.
    """

    name: str
    title: str
    layers: Mapping[str, Sequence[Drawn]]
    text: str
    box: str
    shore: str
    data: dict[str, Any]


def map_canvas(
    plane: Plane, name: str, title: str, layers: Mapping[str, Sequence[Drawn]], data: dict[str, Any], text: str
) -> Canvas:
    """Return the map of a plane. For the arguments see `Canvas`; `data` needs no `middle` and no `scale`."""
    shore = path([plane(ring) for ring in land(plane.window())], close=True)
    width, height = 2.0 * plane.half
    box = f"{-plane.half[0]:.1f} {-plane.half[1]:.1f} {width:.1f} {height:.1f}"
    return Canvas(
        name, title, layers, text, box, shore, {"middle": plane.middle.tolist(), "scale": plane.scale, **data}
    )


def path(lines: Sequence[Array], *, close: bool, digits: int = 1) -> str:
    """Return lines (n, 2), in units of the drawing, as the data of an SVG path.

    With `close`, each line is closed to a ring. `digits` is the number of decimals.
    """
    end = "Z" if close else ""
    return "".join("M" + "L".join(f"{x:.9g} {y:.9g}" for x, y in np.round(line, digits)) + end for line in lines)


def dot(x: float, y: float, colour: str, size: float, title: str = "") -> Curve:
    """Return a dot of `size` pixels at any zoom; the page shows `title` while the pointer is on the dot."""
    return Curve("dot", f"M{x:.9g} {y:.9g}h0", colour, size, title)


# Fixes and tracks as marks on Earth: longitude, latitude, ellipse and a line of text.

# Corners of an ellipse: one for every five degrees; the last corner repeats the first.
_RING = 73
# Height, m, at which space begins by convention. Satellites have no position on a map.
_SKY = 100e3
# Points along an axis of the grid on which lines of position are traced: 112 steps across the map. The grid extends
# beyond each side by `_RIM` times the width, for windows that are wider or taller than the map. One batch evaluates
# 80 000 points.
_GRID, _RIM = 281, 0.75
# Largest latitude of the grid, degrees: at a pole, the longitude is undefined.
_POLE = 89.9


@dataclass(frozen=True, slots=True)
class Spots:
    """Marks on Earth.

    Parameters
    ----------
    place : array (n, 2)
        Longitude and latitude, degrees; NaN for a missing position.
    rings : tuple of n arrays (r, 2)
        95 % ellipse of each mark, degrees. If no ellipse is valid, the outline of the 95 % region; if there is no
        covariance, an empty array.
    clean : bool array (n,)
        Whether the status is `ok`.
    text : tuple of n str
        Text that the page shows for each mark.
    more : tuple of array (r, 2)
        Outlines of the other parts of regions that have several parts, degrees.
    local : bool array (n,), optional
        Whether the ring is an ellipse that is not valid, while the valid region is unknown.
    """

    place: Array
    rings: tuple[Array, ...]
    clean: Array
    text: tuple[str, ...]
    more: tuple[Array, ...] = ()
    local: Array | None = None


def spots(
    problem: Problem,
    position: Array,
    covariance: Array,
    clean: Array,
    text: Sequence[str],
    outlines: Sequence[Sequence[Outline]] = (),
) -> Spots:
    """Return positions in the frame of a problem as marks on Earth.

    Parameters
    ----------
    problem : Problem
        Gives the frame.
    position, covariance : array (n, d), (n, d, d)
        Positions, m, and covariances, m^2.
    clean : bool array (n,)
        Whether the status is `ok`.
    text : sequence of n str
        Text that the page shows for each mark.
    outlines : sequence of n sequences of Outline, optional
        Outlines along east and north of the 95 % regions of fixes without a valid ellipse; empty for other fixes.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, _RING)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rings: list[Array] = []
    more: list[Array] = []
    for centre, spread, regions in zip(position, covariance, outlines or [()] * len(position), strict=True):
        if not (np.isfinite(centre).all() and np.isfinite(spread).all()):
            rings.append(np.zeros((0, 2)))
            continue
        # Use the marginal covariance of east and north.
        axes = problem.frame.enu_axes(centre)[:2]
        if regions:
            lines = [degrees(problem, centre + line @ axes) for region in regions for line in region.lines]
            # The outline with most points is the ring of the mark; all other outlines go to `more`.
            lines.sort(key=len, reverse=True)
            rings.append(lines[0])
            more += lines[1:]
            continue
        semi_axes, directions = error_ellipse(axes @ spread @ axes.T)
        rings.append(degrees(problem, centre + circle * semi_axes @ directions.T @ axes))
    return Spots(degrees(problem, position), tuple(rings), clean, tuple(text), tuple(more))


def degrees(problem: Problem, position: Array) -> Array:
    """Return longitude and latitude (n, 2), degrees, of positions (n, d), m; NaN for NaN positions."""
    out = np.full((len(position), 2), np.nan)
    known = np.isfinite(position).all(-1)
    if known.any():
        lat, lon, _ = problem.frame.to_geodetic(position[known])
        out[known] = np.degrees(np.stack([lon, lat], axis=-1))
    return out


def fixed_spots(problem: Problem, fixes: Sequence[Fix], labels: Sequence[str]) -> Spots:
    """Return the marks of fixes; `labels` are their names if there is one label for each position.

    A run has several positions but one status. Its marks then have the text "status not ok" or no status.
    """
    parts = [part for fix in fixes for part in states_of(fix)]
    position, covariance, clean = (np.concatenate(each) for each in zip(*parts, strict=True))
    status = [
        f"{Status(int(code)).label} ({UNCHECKED})" if alone else Status(int(code)).label
        for fix in fixes
        for code, alone in zip(np.ravel(fix.code), np.ravel(fix.unchecked), strict=True)
    ]
    names = list(labels) if len(labels) == len(position) > 1 else [""] * len(position)
    status_texts = status if len(status) == len(position) else ["" if ok else "status not ok" for ok in clean]
    sigma = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
    sentences = [sentence(*each) for each in zip(names, status_texts, degrees(problem, position), sigma, strict=True)]
    outlines = regions_of(problem, fixes, len(position), [level_planes(problem, position)])
    for i, regions in enumerate(outlines):
        sentences[i] += ", 95 % region larger than drawn" if any(region.cut for region in regions) else ""
    found = spots(problem, position, covariance, clean, sentences, outlines)
    # Mark ellipses that are not valid, if no outline of the valid region replaces them.
    return replace(found, local=is_local(fixes, [bool(each) for each in outlines], len(position)))


def sentence(name: str, status: str, place: Array, sigma: float) -> str:
    """Return the text of a fix: name, status, latitude and longitude, sigma.

    `place` (2,) is longitude and latitude in degrees, and `sigma` is in metres. Missing parts are omitted.
    """
    parts = [name, status, f"{place[1]:.5f}°, {place[0]:.5f}°" if np.isfinite(place).all() else "no position"]
    return ", ".join(part for part in [*parts, f"sigma {sigma:.3g} m" if np.isfinite(sigma) else ""] if part)


def other_spots(problem: Problem, fixes: Sequence[Fix]) -> Spots:
    """Return the marks of the alternatives of fixes, without ellipses: positions of other minima of the cost.

    Positions that change from epoch to epoch have no marks.
    """
    places, text = [np.zeros((0, problem.dimension))], []
    for fix in fixes:
        flat = fix if len(fix.shape) == 1 else fix.flat()
        shown = np.isfinite(flat.alternatives.gap)
        for slot in flat.layout.shared:
            if slot.name.partition("[")[0] == "position":
                places.append(flat.layout.take(flat.alternatives.x, slot.name)[shown])
                text += [f"alternative, cost gap {gap:.3g}" for gap in flat.alternatives.gap[shown]]
    position = np.concatenate(places)
    count, d = position.shape
    return spots(problem, position, np.full((count, d, d), np.nan), np.zeros(count, dtype=bool), text)


def station_spots(problem: Problem) -> Spots:
    """Return the marks of the stations in the first epoch; a station in space has the place NaN and is not drawn."""
    position = problem.stations.position.reshape(-1, problem.stations.count, problem.dimension)[0]
    place = degrees(problem, position)
    place[problem.frame.to_geodetic(position)[2] > _SKY] = np.nan
    nothing = tuple(np.zeros((0, 2)) for _ in position)
    return Spots(place, nothing, np.ones(len(position), dtype=bool), problem.stations.names)


def ground_tracks(problem: Problem) -> list[tuple[str, Array]]:
    """Return the names and ground tracks (n, 2), degrees, of satellites with range rate measurements.

    Longitudes continue beyond 180 degrees, so that a track has no jump at the antimeridian.
    """
    indices = [index for rows in problem.rows if MODELS[rows.kind].velocity for index in (rows.a, rows.b)]
    found = []
    # -1 is the first of the sorted numbers: it means no station.
    for station in np.unique(np.concatenate([*indices, [-1]]))[1:].tolist():
        track = problem.stations.position.reshape(-1, *problem.stations.position.shape[-3:])[0, :, station]
        lat, lon, height = problem.frame.to_geodetic(thinned(track))
        if height.min() > _SKY:
            line = np.degrees(np.stack([np.unwrap(lon), lat], axis=-1))
            found.append((f"ground track of {problem.stations.names[station]}", line))
    return found


def lines_on_map(problem: Problem, fix: Fix, limits: tuple[float, float, float, float]) -> list[tuple[str, Array]]:
    """Return the lines of position of a single fix at its height: label, and line (n, 2) in degrees.

    A line of position holds the positions that fit one row exactly. `limits` are west, east, south and north of the
    map, degrees; the lines continue beyond them. The list is empty for several fixes, without a fix, and if the
    position changes from epoch to epoch.
    """
    figure_class()  # Raise one clear error if matplotlib, which installs contourpy, is missing.
    flat = fix.flat()
    if len(flat) != 1 or not np.isfinite(flat.x).all() or not flat.layout.shares("position"):
        return []
    lon, lat = _grid_beyond(*limits[:2]), np.clip(_grid_beyond(*limits[2:]), -_POLE, _POLE)
    height = float(problem.frame.to_geodetic(flat.take("position")[0])[2])
    # Longitudes and latitudes of all grid points, radians.
    east, north = (np.radians(v.ravel()) for v in np.meshgrid(lon, lat))
    # The grid continues beyond the antimeridian: wrap its longitudes to ±180 degrees.
    place = problem.frame.from_geodetic(north, (east + np.pi) % (2.0 * np.pi) - np.pi, np.full(east.size, height))
    found = lines_of_position(problem, fix, lon, lat, place[:, : problem.dimension])
    return [(one.name if one.kind == "isodoppler" else f"{one.kind} {one.name}", one.line) for one in found]


# Points along a limit without ends, and half its length in extents of the plan.
_ALONG, _BEYOND = 61, 3.0


def constraint_lines(problem: Problem, fixes: Sequence[Fix]) -> list[tuple[str, Array]]:
    """Return the shapes of constraints in the plan of an ENU frame: label, and line (n, 2) of longitude and latitude.

    The lines are at the height of the fixes. Other frames have no plan, so the list is empty.
    """
    if problem.frame.kind != "enu" or not (problem.constraints or problem.fences):
        return []
    scene = scene_of(problem, fixes)
    known = scene.fixes[np.isfinite(scene.fixes).all(-1)]
    places = np.concatenate([scene.stations, known])
    level = float(np.median(known[:, 2])) if len(known) and places.shape[-1] > 2 else 0.0
    extent = float(np.ptp(places[:, :2], axis=0).max()) or 1.0
    found = []
    for region in (each for each in scene.regions if each.view == (0, 1)):
        for line in region.lines:
            ends = np.asarray(line)
            if len(ends) == 2:  # a limit without ends: only its part around the plan, since the plan is flat
                along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
                steps = _BEYOND * extent * np.linspace(-1.0, 1.0, _ALONG)
                ends = ends.mean(0) + steps[:, None] * along
            lat, lon, _ = problem.frame.to_geodetic(np.column_stack([ends, np.full(len(ends), level)]))
            found.append((region.label, np.degrees(np.stack([np.unwrap(lon), lat], axis=-1))))
    return found


def _grid_beyond(low: float, high: float) -> Array:
    """Return grid points from beyond the lower limit to beyond the upper limit, because a window can exceed the map.

    `low` and `high` are the limits of the map along one axis, degrees.
    """
    rim = _RIM * (high - low)
    return np.linspace(low - rim, high + rim, _GRID)
