"""Shapes of constraints in a plan: outlines, keep-out areas, limits, roads and contours of a terrain.

Coordinates are metres in the plan of the frame. In space, a shape is cut at the height of the fixes. Letters: n points
of a line, d coordinates.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from optloc.base.types import AnyOf, Array, Band, Constraint, Fence, Polygon
from optloc.models.primitives import Point
from optloc.models.surfaces import SURFACES
from optloc.problem.problem import Problem

# Corners of a circle, and points along each axis of the grid on which a quantity is traced: finer than the pixels of a
# picture.
_CORNERS, _GRID = 181, 161
# Half the length of a line without ends, and half the side of the square in which a quantity is traced, in extents of
# the plan: a panel can be several times wider than the extent of its marks.
_LONG, _WIDE = 20.0, 2.0
# Greatest number of contours of a terrain.
_CONTOURS = 10


@dataclass(frozen=True, slots=True)
class DrawnRegion:
    """The shape of a constraint in a plan.

    Parameters
    ----------
    look : "inside", "outside", "limit", "road" or "ground"
        A closed outline that contains the target; a closed outline of an excluded area; lines with the excluded side
        on their left; closed outlines around the segments of a road; or contours of a terrain.
    lines : tuple of array (n, 2)
        The lines, metres.
    label : str
        Text of the legend.
    view : pair of int
        Indices of the two axes of the lines: the plan, or (0, 2) for a section of a terrain.
    """

    look: Literal["inside", "outside", "limit", "road", "ground"]
    lines: tuple[Array, ...]
    label: str
    view: tuple[int, int] = (0, 1)

    def moved(self, shift: Array) -> DrawnRegion:
        """Return the shape moved by `shift` (2,), m."""
        return replace(self, lines=tuple(line + shift for line in self.lines)) if self.view == (0, 1) else self


def drawn_regions(problem: Problem, reach: Array, place: Array) -> tuple[DrawnRegion, ...]:
    """Return the shapes of the constraints of a problem.

    Lines without ends go beyond the points `reach` (n, 2), m, of the plan. `place` is the point of the cuts: the centre
    of the fixes (d,), m.
    """
    scale = float(np.ptp(reach, axis=0).max()) or 1.0
    centre = (reach.min(0) + reach.max(0)) / 2.0
    boxes, rest = _boxes(problem)
    plan = _Plan(centre, scale, place)
    shapes = (shape for constraint in rest for shape in plan.shapes(constraint))
    return (*boxes, *shapes, *(shape for fence in problem.fences for shape in plan.fence(fence)))


def _boxes(problem: Problem) -> tuple[list[DrawnRegion], list[Constraint]]:
    """Return a box for each target with finite bounds of both coordinates of the plan, and the other constraints."""
    # A box is stored as bounds of single coordinates.
    sides: dict[int, dict[int, Band]] = {}
    for c in problem.constraints:
        if isinstance(c, Band) and c.kind == "plane" and not np.ndim(c.lower):
            along = np.flatnonzero(c.coefficients)
            if len(along) == 1 and c.coefficients[along[0]] == 1.0:
                sides.setdefault(c.target, {})[int(along[0])] = c
    boxes, drawn = [], set()
    for bands in sides.values():
        bounds = [(float(bands[i].lower), float(bands[i].upper)) for i in (0, 1) if i in bands]
        if len(bounds) == 2 and np.isfinite(bounds).all():
            (west, east), (south, north) = bounds
            ring = np.array([[west, south], [east, south], [east, north], [west, north]])
            boxes.append(DrawnRegion("inside", (_closed(ring),), "region"))
            drawn |= {id(bands[0]), id(bands[1])}
    return boxes, [c for c in problem.constraints if id(c) not in drawn]


def _closed(ring: Array) -> Array:
    """Return corners (n, 2) with the first corner repeated at the end."""
    return np.concatenate([ring, ring[:1]])


@dataclass(frozen=True, slots=True)
class _Plan:
    """A plan around the point `centre` (2,) with the extent `scale`, m, and sections through the point `place` (d,)."""

    centre: Array
    scale: float
    place: Array

    @property
    def level(self) -> float:
        """Return the height of the cut, m; NaN in the plane."""
        return float(self.place[2]) if len(self.place) > 2 else np.nan

    def shapes(self, c: Constraint) -> Iterator[DrawnRegion]:
        """Yield the shapes of a constraint; none for a constraint without a shape in the plan."""
        if isinstance(c, Polygon):
            line = (_closed(c.vertices),)
            yield DrawnRegion("outside", line, "keep-out area") if c.outside else DrawnRegion("inside", line, "region")
        elif isinstance(c, AnyOf):
            bands = [band for member in c.members for band in member]
            if all(band.kind == "segment" for band in bands):
                yield self._road(bands)
            else:
                for band in bands:
                    yield from self.shapes(band)
        elif np.ndim(c.lower) == np.ndim(c.upper) == 0 and c.other is None:
            yield from self._of_band(c)

    def fence(self, fence: Fence) -> Iterator[DrawnRegion]:
        """Yield the stated line of a fence, and its parallels at a distance of one standard deviation."""
        if np.ndim(fence.offset):
            return
        place, sigma = float(fence.offset), float(fence.sigma)
        line = self._line(fence.normal, place, -1.0)
        beside = [each for more in (-sigma, sigma) for each in self._line(fence.normal, place + more, -1.0)]
        if line:
            yield DrawnRegion("limit", tuple(line), "fence, ticks on the improbable side")
            yield DrawnRegion("inside", tuple(beside), "fence, one standard deviation")

    def _of_band(self, band: Band) -> Iterator[DrawnRegion]:
        """Yield the shapes of a band with one pair of bounds."""
        bounds = [(float(band.lower), 1.0), (float(band.upper), -1.0)]
        # An equality has no excluded side: one line.
        finite = [bound for bound in bounds[: 1 if bounds[0][0] == bounds[1][0] else 2] if np.isfinite(bound[0])]
        if band.kind == "segment":
            yield self._road([band])
        elif band.kind == "terrain":
            yield from self._ground(band)
        elif band.kind == "distance":
            yield from self._circles(band)
        elif band.kind == "plane":
            lines = [line for bound, sign in finite for line in self._line(band.coefficients, bound, sign)]
            yield from self._limit(band, lines)
        elif self._is_plain(band):
            lines = [line for bound, sign in finite for line in self._traced(band, bound, sign)]
            yield from self._limit(band, lines)

    def _limit(self, band: Band, lines: list[Array]) -> Iterator[DrawnRegion]:
        """Yield lines as a limit, or as a curve without sides for an equality."""
        if lines and band.lower == band.upper:
            yield DrawnRegion("inside", tuple(lines), "region")
        elif lines:
            yield DrawnRegion("limit", tuple(lines), "limit, ticks on the excluded side")

    def _line(self, normal: Array, bound: float, sign: float) -> list[Array]:
        """Return the line (2, 2) ``normal . x = bound`` with the excluded side on its left; empty for a level plane.

        `sign` is 1 for a lower and -1 for an upper bound.
        """
        across = np.asarray(normal[:2], dtype=float)
        size = float(across @ across)
        if len(normal) == 3:
            bound -= float(normal[2]) * (self.level if np.isfinite(self.level) else 0.0)
        if size == 0.0:
            return []
        foot = self.centre + across * (bound - float(across @ self.centre)) / size
        along = sign * np.array([across[1], -across[0]]) / np.sqrt(size)
        # The line runs against `along`, so sign * (-across) points to its left: below a lower, above an upper bound.
        ends = np.array([[1.0], [-1.0]]) * _LONG * self.scale * along
        return [foot + ends]

    def _circles(self, band: Band) -> Iterator[DrawnRegion]:
        """Yield the circles of bounds of a distance from a point, in the plan or at the height of the cut."""
        centre, radii = band.coefficients, []
        for bound in (float(band.lower), float(band.upper)):
            below = 0.0
            if len(centre) == 3 and np.isfinite(self.level):
                below = self.level - float(centre[2])
            cut = bound**2 - below**2
            radii.append(np.sqrt(cut) if np.isfinite(bound) and cut > 0.0 else np.nan)
        # Outside the cut of a ball, its outline from above is clearer than no outline.
        if len(centre) == 3 and np.isnan(radii[1]) and np.isfinite(band.upper):
            radii[1] = float(band.upper)
        angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        inner, outer = (centre[:2] + radius * ring for radius in radii)
        if np.isfinite(radii[1]):
            yield DrawnRegion("inside", (outer,), "region")
        if np.isfinite(radii[0]) and radii[0] != radii[1]:
            yield DrawnRegion("outside", (inner,), "keep-out area")

    def _road(self, bands: list[Band]) -> DrawnRegion:
        """Return the outlines of the surroundings of segments, all counter-clockwise."""
        half = np.linspace(0.0, np.pi, _CORNERS // 4)
        rings = []
        for band in bands:
            width, d = float(band.upper), len(band.coefficients) // 2
            a, b = band.coefficients[:2], band.coefficients[d : d + 2]
            turn = np.arctan2(*(b - a)[::-1]) - np.pi / 2.0
            ends = [
                end + width * np.stack([np.cos(half + turn + more), np.sin(half + turn + more)], axis=-1)
                for end, more in ((b, 0.0), (a, np.pi))
            ]
            rings.append(_closed(np.concatenate(ends)))
        return DrawnRegion("road", tuple(rings), "road with its tolerance")

    def _ground(self, band: Band) -> Iterator[DrawnRegion]:
        """Yield contours of a grid of heights at round levels, and its section through the fixes."""
        from contourpy import contour_generator
        from matplotlib.ticker import MaxNLocator

        ground = band.table
        # A grid that is finer than the grid of the file, so that contours follow the spline between its points.
        x, y = (np.linspace(axis[0], axis[-1], max(_GRID, len(axis))) for axis in (ground.x, ground.y))
        heights = ground.at(*np.meshgrid(x, y))[0]
        levels = MaxNLocator(_CONTOURS).tick_values(heights.min(), heights.max())
        found = contour_generator(x, y, heights)
        lines = [np.asarray(line) for level in levels for line in found.lines(level)]
        yield DrawnRegion("ground", tuple(lines), f"terrain, contours every {levels[1] - levels[0]:g} m")
        section = np.stack([x, ground.at(x, np.full_like(x, self.place[1]))[0]], axis=-1)
        yield DrawnRegion("ground", (section,), "terrain", (0, 2))

    def _is_plain(self, band: Band) -> bool:
        """Return whether a quantity depends on the position alone, in the axes of the frame."""
        surface = SURFACES[band.kind]
        return surface.places and not (surface.ecef or surface.table or surface.other)

    def _traced(self, band: Band, bound: float, sign: float) -> list[Array]:
        """Return the lines on which a quantity equals a bound, with the excluded side on their left.

        `sign` is 1 for a lower and -1 for an upper bound.
        """
        from contourpy import contour_generator

        steps = _WIDE * self.scale * np.linspace(-1.0, 1.0, _GRID)
        x, y = np.meshgrid(self.centre[0] + steps, self.centre[1] + steps)
        place = (x, y) if np.isnan(self.level) else (x, y, np.full_like(x, self.level))
        with np.errstate(all="ignore"):
            values = SURFACES[band.kind].g(Point(place), tuple(band.coefficients))
        if np.shape(values) != x.shape:
            return []
        # Contours have greater values on their left.
        lines = contour_generator(x, y, np.ma.masked_invalid(values)).lines(bound)
        return [np.asarray(line)[::-1] if sign > 0.0 else np.asarray(line) for line in lines]
