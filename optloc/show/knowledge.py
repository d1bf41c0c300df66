"""Directions, ranges and curves of fixes without a reliable position, as text and as GeoJSON.

If the data determine no position, they may still determine a direction, a range or a curve. `known_rows` returns these
as text, and `known_features` returns them as geometries on Earth.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from optloc.base.frames import Frame
from optloc.base.types import Array, Status
from optloc.problem.determined import WITHOUT_PLACE, Determined, Direction, Quantity, bearing_of
from optloc.problem.fix import Fix

# Statuses that have a valid position and also intervals relative to a line or plane of stations.
_WITH_REGION = (Status.AMBIGUOUS, Status.CURVED)
# If the range of a direction has no upper limit, its wedge is cut off: at 3 times the smallest range or at 10 times
# the size of the array, whichever is farther, but at most at 1 000 km.
_LEAST, _SIZES, _MOST = 3.0, 10.0, 1e6


def is_shown(fix: Fix) -> bool:
    """Return whether a single fix has directions, ranges or curves to show, with or without a position."""
    kept = fix.source is not None and fix.source[()] is not None
    return kept and Status(int(fix.code)) in (*WITHOUT_PLACE, *_WITH_REGION)


def has_place(fix: Fix) -> bool:
    """Return whether a single fix has a status with a valid position."""
    return Status(int(fix.code)) not in WITHOUT_PLACE


def shown_directions(fix: Fix, found: Determined) -> tuple[Direction, ...]:
    """Return the directions of a single fix to show; empty if the fix has a valid position.

    `found` are the quantities that the data determine, from `fix.determined`.
    """
    return () if has_place(fix) else found.directions


def known_rows(fix: Fix) -> list[tuple[str, str]]:
    """Return directions, intervals and the curve of a single fix as pairs of label and text."""
    if not is_shown(fix):
        return []
    found = fix.determined
    assert found is not None
    rows = []
    directions = shown_directions(fix, found)
    if directions and found.outside:
        rows.append(("assumed", "the target is farther from the middle of the stations than any station"))
    for i, one in enumerate(directions, 1):
        number = f" {i}" if len(directions) > 1 else ""
        rows.append((f"95 % direction{number}", _direction_text(found, one)))
        rows.append((f"95 % range{number}", _range_text(one)))
    rows += [(f"95 % {one.name}", _quantity_text(one)) for one in found.quantities]
    if found.quantities and found.axis is not None:
        way = ", ".join(f"{value:.2f}" for value in found.axis)
        shape = "line along" if any(one.name == "angle to line" for one in found.quantities) else "plane normal to"
        rows.append(("stations", f"on a {shape} ({way}) through {_centre_text(found)}"))
    if found.curve is not None:
        rows.append(("curve", f"{found.curve_name}: fix.determined.curve"))
    return rows


def _centre_text(found: Determined) -> str:
    """Return the text of the centre of the stations, m."""
    return "(" + ", ".join(f"{value:.6g}" for value in found.origin) + ") m, the middle of the stations"


def _direction_text(found: Determined, direction: Direction) -> str:
    """Return the text of a direction with its cone, degrees.

    `found` are the quantities of the fix; they state whether azimuths convert to bearings from north.
    """
    if found.north:
        middle, low, high = bearing_of(direction.azimuth)
        text = f"bearing {_angle_text(middle, low, high)}"
    else:
        text = f"azimuth {_angle_text(*np.degrees(direction.azimuth).tolist())}"
    text += f", elevation {_angle_text(*np.degrees(direction.elevation).tolist())}" if direction.elevation else ""
    half = " x ".join(f"{value:.2g}" for value in np.degrees(direction.half_angles))
    return f"{text}; cone of ± {half} deg from the middle of the stations"


def _angle_text(middle: float, low: float, high: float) -> str:
    """Return the text of an angle with its interval, degrees.

    The width of the interval sets the number of digits: one digit more than the width needs. `middle` is the angle, and
    `low` and `high` are the ends of the interval. If the interval is a full turn, the angle is not determined.
    """
    width = high - low
    if width >= 360.0:
        return "not determined"
    digits = int(np.clip(1 - np.floor(np.log10(max(width, 1e-6))), 0, 6))
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f}) deg"


def _range_text(direction: Direction) -> str:
    """Return the text of the 95 % interval of the range of a direction, m; it may have no upper end."""
    low, high = direction.range[1:]
    if not direction.mixed:
        return f"{low:.4g} m or more, to infinity"
    return f"{low:.4g} to {high:.4g} m"


def _quantity_text(quantity: Quantity) -> str:
    """Return the text of the interval of a quantity; angles are printed in degrees, and an end may be infinite."""
    value, low, high, unit = quantity.value, quantity.low, quantity.high, quantity.unit
    if unit == "rad":
        return _angle_text(*np.degrees([value, low, high]).tolist())
    far = f"{high:.4g} {unit}" if np.isfinite(high) else "infinity"
    near = f"{low:.4g}" if np.isfinite(low) else "minus infinity"
    return f"{near} to {far}"


# GeoJSON on Earth.


def known_features(fix: Fix, frame: Frame) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Return GeoJSON geometries with their properties: a wedge and a ray for each direction, and the curve.

    Parameters
    ----------
    fix : Fix
        A single fix.
    frame : Frame
        Frame of the fix, on Earth.
    """
    from optloc.show.pictures.outlines import earth_line, line_geometry, polygon_geometry

    if not is_shown(fix):
        return []
    found = fix.determined
    assert found is not None
    features: list[tuple[dict[str, Any], dict[str, Any]]] = []
    for one, about in zip(shown_directions(fix, found), found.to_dict()["directions"], strict=False):
        # The geometry shows the direction and the edge of the cone.
        kept = {name: value for name, value in about.items() if name not in ("vector", "outline")}
        reach = reach_of(fix, one)
        wedge = polygon_geometry([[earth_line(frame, _with_points_between(found.wedge(one, reach)))]])
        features.append((wedge, {"role": "direction95", "cut": not one.mixed, **kept}))
        ray = line_geometry([earth_line(frame, _with_points_between(found.ray(one, reach)))])
        features.append((ray, {"role": "ray", "cut": not one.mixed, "gap": one.gap}))
    if found.curve is not None:
        line = line_geometry([earth_line(frame, found.curve)])
        features.append((line, {"role": "curve", "name": found.curve_name}))
    return features


def reach_of(fix: Fix, direction: Direction) -> float:
    """Return the distance, m, at which the wedge of a direction without an upper limit of its range ends.

    `fix.reach` is the greatest distance of a station from the mean of the stations, m; it counts as zero if it is
    unknown. The result is at least 1 m.
    """
    size = 0.0 if fix.reach is None else float(np.nan_to_num(fix.reach))
    return float(np.clip(max(_LEAST * direction.least_range, _SIZES * size), 1.0, _MOST))


# Pieces of each edge. The surface of the Earth drops about 1 km below a straight line of 100 km, so a long edge needs
# points in between.
_PIECES = 16


def _with_points_between(line: Array) -> Array:
    """Return a line (n, d) with extra points between its corners, `_PIECES` pieces for each edge."""
    share = np.arange(_PIECES)[:, None] / _PIECES
    parts = [start + share * (end - start) for start, end in pairwise(line)]
    return np.concatenate([*parts, line[-1:]])
