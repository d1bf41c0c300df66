"""Directions, ranges and curves of fixes without a trustworthy position: in words, and as geometries on the Earth."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from optloc.base.frames import Frame
from optloc.base.types import Array, Status
from optloc.problem.determined import WITHOUT_PLACE, Determined, Direction, Quantity, bearing_of
from optloc.problem.fix import Fix

# Statuses with a region that numbers about a line or plane of stations describe.
_WITH_REGION = (Status.AMBIGUOUS, Status.CURVED)
# A wedge without an end is cut off at 3 least ranges or 10 sizes of the array, and at 1 000 km.
_LEAST, _SIZES, _MOST = 3.0, 10.0, 1e6


def is_shown(fix: Fix) -> bool:
    """Return whether a single fix has directions, ranges or curves to show in place of a position, or with it."""
    kept = fix.source is not None and fix.source[()] is not None
    return kept and Status(int(fix.code)) in (*WITHOUT_PLACE, *_WITH_REGION)


def has_place(fix: Fix) -> bool:
    """Return whether the position of a single fix is a place."""
    return Status(int(fix.code)) not in WITHOUT_PLACE


def shown_directions(fix: Fix, found: Determined) -> tuple[Direction, ...]:
    """Return the directions that are shown of a single fix: none where it has a place."""
    return () if has_place(fix) else found.directions


def known_rows(fix: Fix) -> list[tuple[str, str]]:
    """Return directions, numbers and curve of a single fix as labels and texts of its sheet."""
    if not is_shown(fix):
        return []
    found = fix.determined
    assert found is not None
    rows = []
    directions = shown_directions(fix, found)
    if directions and found.outside:
        rows.append(("assumed", "the target is farther away from their middle than the stations"))
    for i, one in enumerate(directions, 1):
        number = f" {i}" if len(directions) > 1 else ""
        rows.append((f"95 % direction{number}", _direction_text(found, one)))
        rows.append((f"95 % range{number}", _range_text(one)))
    rows += [(f"95 % {one.name}", _quantity_text(one)) for one in found.quantities]
    if found.quantities and found.axis is not None:
        way = ", ".join(f"{value:.2f}" for value in found.axis)
        shape = "line along" if any(one.name == "angle to line" for one in found.quantities) else "plane across"
        rows.append(("stations", f"on a {shape} ({way}) through {_place(found)}"))
    if found.curve is not None:
        rows.append(("curve", f"{found.curve_name}: fix.determined.curve"))
    return rows


def _place(found: Determined) -> str:
    """Return the middle of the stations in words."""
    return "(" + ", ".join(f"{value:.6g}" for value in found.origin) + ") m, their middle"


def _direction_text(found: Determined, one: Direction) -> str:
    """Return a direction with its cone in words, degrees."""
    if found.north:
        middle, low, high = bearing_of(one.azimuth)
        text = f"bearing {_ends(middle, low, high)}"
    else:
        text = f"azimuth {_ends(*np.degrees(one.azimuth).tolist())}"
    text += f", elevation {_ends(*np.degrees(one.elevation).tolist())}" if one.elevation else ""
    half = " x ".join(f"{value:.2g}" for value in np.degrees(one.half_angles))
    return f"{text}; cone of ± {half} deg from the middle of the stations"


def _ends(middle: float, low: float, high: float) -> str:
    """Return an angle with its interval, with a digit more than the interval is wide."""
    width = high - low
    if width >= 360.0:
        return "not determined"
    digits = int(np.clip(1 - np.floor(np.log10(max(width, 1e-6))), 0, 6))
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f}) deg"


def _range_text(one: Direction) -> str:
    low, high = one.range[1:]
    if not one.mixed:
        return f"{low:.4g} m or more, to infinity"
    return f"{low:.4g} to {high:.4g} m"


def _quantity_text(one: Quantity) -> str:
    """Return a number with its interval."""
    value, low, high, unit = one.value, one.low, one.high, one.unit
    if unit == "rad":
        return _ends(*np.degrees([value, low, high]).tolist())
    far = f"{high:.4g} {unit}" if np.isfinite(high) else "infinity"
    near = f"{low:.4g}" if np.isfinite(low) else "minus infinity"
    return f"{near} to {far}"


# On the Earth.


def known_features(fix: Fix, frame: Frame) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Return geometries of GeoJSON with their properties: of each direction a wedge and a ray, and the curve.

    Parameters
    ----------
    fix : Fix
        A single fix.
    frame : Frame
        Its frame, on Earth.
    """
    from optloc.show.pictures.outlines import earth_line, line_geometry, polygon_geometry

    if not is_shown(fix):
        return []
    found = fix.determined
    assert found is not None
    told: list[tuple[dict[str, Any], dict[str, Any]]] = []
    for one, about in zip(shown_directions(fix, found), found.to_dict()["directions"], strict=False):
        kept = {name: value for name, value in about.items() if name not in ("vector", "outline")}
        reach = reach_of(fix, one)
        wedge = polygon_geometry([[earth_line(frame, _fine(found.wedge(one, reach)))]])
        told.append((wedge, {"role": "direction95", "cut": not one.mixed, **kept}))
        ray = line_geometry([earth_line(frame, _fine(found.ray(one, reach)))])
        told.append((ray, {"role": "ray", "cut": not one.mixed, "gap": one.gap}))
    if found.curve is not None:
        line = line_geometry([earth_line(frame, found.curve)])
        told.append((line, {"role": "curve", "name": found.curve_name}))
    return told


def reach_of(fix: Fix, one: Direction) -> float:
    """Return the distance, metres, at which the wedge of a direction without an end is cut off."""
    size = 0.0 if fix.reach is None else float(np.nan_to_num(fix.reach))
    return float(np.clip(max(_LEAST * one.least_range, _SIZES * size), 1.0, _MOST))


# Pieces of an edge on the Earth, which bends away from a straight line by a kilometre in 100.
_PIECES = 16


def _fine(line: Array) -> Array:
    """Return a line (n, d) with points between its corners."""
    share = np.arange(_PIECES)[:, None] / _PIECES
    parts = [start + share * (end - start) for start, end in pairwise(line)]
    return np.concatenate([*parts, line[-1:]])
