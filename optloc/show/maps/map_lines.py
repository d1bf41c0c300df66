"""Lines of interactive maps: ground tracks of satellites, lines of position and shapes of constraints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from optloc.base.types import Array
from optloc.models import MODELS
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.show.maps.map_marks import SKY
from optloc.show.maps.projection import Window
from optloc.show.pictures.position_lines import lines_of_position
from optloc.show.pictures.scene import scene_of, thinned
from optloc.show.pictures.style import figure_class

# Points along an axis of the grid on which lines of position are traced: 112 steps across the map. The grid extends
# beyond each side by `_REACH` times the width, for windows that are wider or taller than the map. One batch evaluates
# 80 000 points.
_GRID, _REACH = 281, 0.75
# Largest latitude of the grid, degrees: at a pole, the longitude is undefined.
_POLE = 89.9


def ground_tracks(problem: Problem) -> list[tuple[str, Array]]:
    """Return the names and ground tracks (n, 2), degrees, of satellites with range rate measurements.

    Longitudes continue beyond 180 degrees, so that a track has no jump at the antimeridian.
    """
    if not problem.frame.geodetic:
        return []
    indices = [index for rows in problem.rows if MODELS[rows.kind].velocity for index in (rows.a, rows.b)]
    found = []
    # -1 is the first of the sorted numbers: it means no station.
    for station in np.unique(np.concatenate([*indices, [-1]]))[1:].tolist():
        track = problem.stations.position.reshape(-1, *problem.stations.position.shape[-3:])[0, :, station]
        lat, lon, height = problem.frame.to_geodetic(thinned(track))
        if height.min() > SKY:
            line = np.degrees(np.stack([np.unwrap(lon), lat], axis=-1))
            found.append((f"ground track of {problem.stations.names[station]}", line))
    return found


def lines_on_map(problem: Problem, fix: Fix, limits: Window) -> list[tuple[str, Array]]:
    """Return the lines of position of a single fix at its height: label, and line (n, 2) in degrees or metres.

    A line of position holds the positions that fit one row exactly. `limits` are the limits of the map; the lines
    continue beyond them. The list is empty for several fixes, without a fix, and if the position changes from epoch to
    epoch.
    """
    figure_class()  # Raise one clear error if matplotlib, which installs contourpy, is missing.
    flat = fix.flat()
    if len(flat) != 1 or not np.isfinite(flat.x).all() or not flat.layout.shares("position"):
        return []
    x, y = _grid_beyond(*limits[:2]), _grid_beyond(*limits[2:])
    y = np.clip(y, -_POLE, _POLE) if problem.frame.geodetic else y
    east, north = (v.ravel() for v in np.meshgrid(x, y))
    found = lines_of_position(problem, fix, x, y, _points_at(problem, flat.take("position")[0], east, north))
    return [(one.name if one.kind == "isodoppler" else f"{one.kind} {one.name}", one.line) for one in found]


def _points_at(problem: Problem, fix: Array, east: Array, north: Array) -> Array:
    """Return the points of a grid (n,), degrees or metres, at the height of a fix (d,), in the frame (n, d), m."""
    if not problem.frame.geodetic:
        return np.column_stack([east, north, *(np.full(east.size, value) for value in fix[2:])])
    height = float(problem.frame.to_geodetic(fix)[2])
    # The grid continues beyond the antimeridian: wrap its longitudes to ±180 degrees.
    lon = (np.radians(east) + np.pi) % (2.0 * np.pi) - np.pi
    place = problem.frame.from_geodetic(np.radians(north), lon, np.full(east.size, height))
    return np.asarray(place[:, : problem.dimension])


# Points along a limit without ends, and half its length in extents of the plan.
_ALONG, _BEYOND = 61, 3.0


def constraint_lines(problem: Problem, fixes: Sequence[Fix]) -> list[tuple[str, Array]]:
    """Return the shapes of constraints in the plan of a frame: label, and line (n, 2) in degrees or metres.

    The lines are at the height of the fixes. An ECEF frame has no plan, so the list is empty.
    """
    if (problem.frame.geodetic and problem.frame.kind != "enu") or not (problem.constraints or problem.fences):
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
            if not problem.frame.geodetic:
                found.append((region.label, ends))
                continue
            lat, lon, _ = problem.frame.to_geodetic(np.column_stack([ends, np.full(len(ends), level)]))
            found.append((region.label, np.degrees(np.stack([np.unwrap(lon), lat], axis=-1))))
    return found


def _grid_beyond(low: float, high: float) -> Array:
    """Return grid points from beyond the lower limit to beyond the upper limit, because a window can exceed the map.

    `low` and `high` are the limits of the map along one axis, degrees.
    """
    rim = _REACH * (high - low)
    return np.linspace(low - rim, high + rim, _GRID)
