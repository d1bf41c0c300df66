"""Constraints of a problem file, and those that a command line adds to it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from optloc.check_constraints import check_polygon, like
from optloc.constraints import box, height, polygon, speed, visible
from optloc.errors import InvalidProblem
from optloc.files.schema import Amount, ConstraintTable
from optloc.files.words import Units, join, nearest
from optloc.frames import Frame
from optloc.types import Array, Band, Motion, Polygon, Stations
from optloc.units import SPEED_OF_LIGHT, Quantity

Constraint = Band | Polygon

_KEYS = {
    "box": ("min", "max", "unit"),
    "height": ("exactly", "min", "max", "unit"),
    "above-ground": (),
    "polygon": ("corners", "corners_deg", "unit"),
    "visible": ("stations", "elevation"),
    "speed": ("min", "max", "unit"),
}


def constraints_of(
    tables: Mapping[str, ConstraintTable],
    stations: Stations,
    frame: Frame,
    motions: Sequence[Motion],
    names: Sequence[str],
    speed: float = SPEED_OF_LIGHT,
) -> tuple[Constraint, ...]:
    """Return the constraints of tables; those on one quantity of one target become one.

    Parameters
    ----------
    tables : mapping of str to ConstraintTable
        Each behind its place.
    stations : Stations
        Stations in the frame.
    frame : Frame
        What coordinates mean.
    motions : sequence of Motion
        Of each target; a constraint without a target holds for all that are estimated.
    names : sequence of str
        Names of the targets.
    speed : float
        Propagation speed, metres per second.
    """
    found: list[Constraint] = []
    for where, table in tables.items():
        _check_keys(table, where)
        for target in _targets(table, motions, names, where):
            suffix = f" of {names[target]}" if len(motions) > 1 else ""
            made = _made(table, stations, frame, where, speed)
            found += [replace(c, target=target, name=c.name + suffix) for c in made]
    return tuple(_merged(found))


def _check_keys(table: ConstraintTable, where: str) -> None:
    known = _KEYS[table.kind]
    foreign = sorted(table.model_fields_set - {"kind", "target", *known})
    if foreign:
        advice = nearest(foreign[0], known) if known else "leave it out"
        raise InvalidProblem(f"{table.kind} has no key {foreign[0]!r}", where, advice)
    needed = [key for key in known if key not in {"unit", "stations", "elevation"}]
    if needed and not any(getattr(table, key) is not None for key in needed):
        raise InvalidProblem(f"{table.kind} bounds nothing", where, f"give {' or '.join(needed)}")


def _targets(table: ConstraintTable, motions: Sequence[Motion], names: Sequence[str], where: str) -> list[int]:
    if table.target is None:
        free = [i for i, motion in enumerate(motions) if motion.known is None]
        if not free:
            raise InvalidProblem("the motion of every target is known", where, "leave the constraint out")
        return free
    place = join(where, "key 'target'")
    if table.target not in names:
        raise InvalidProblem(
            f"no row has the target {table.target!r}", place, nearest(table.target, sorted(set(names)))
        )
    if len(motions) == 1 and len(set(names)) > 1:
        advice = "leave the key out, or write one file for each target"
        raise InvalidProblem("free targets are fixed apart, and a constraint holds for all of them", place, advice)
    return [list(names).index(table.target) if len(motions) > 1 else 0]


def _made(table: ConstraintTable, stations: Stations, frame: Frame, where: str, c: float) -> Sequence[Constraint]:
    if table.kind == "box":
        low, high = (_corner(table, key, stations.dimension, where, c) for key in ("min", "max"))
        return box(low.tolist(), high.tolist())
    if table.kind == "height":
        if table.exactly is not None and (table.min is not None or table.max is not None):
            raise InvalidProblem("a height is either exact or in a band", where, "give exactly, or min and max")
        return height(*_bounds(table, "length", where, c), exactly=_amount(table, "exactly", "length", where, c))
    if table.kind == "above-ground":
        return height(0.0)
    if table.kind == "speed":
        least, most = _bounds(table, "speed", where, c)
        return speed(most, lower=least)
    return _region(table, frame, where, c) if table.kind == "polygon" else _sight(table, stations, frame, where)


def _bounds(table: ConstraintTable, quantity: Quantity, where: str, c: float) -> tuple[float, float]:
    low, high = (_amount(table, key, quantity, where, c) for key in ("min", "max"))
    return -np.inf if low is None else low, np.inf if high is None else high


def _amount(table: ConstraintTable, key: str, quantity: Quantity, where: str, c: float) -> float | None:
    value: Amount | list[float] | None = getattr(table, key)
    place = join(where, f"key {key!r}")
    if isinstance(value, list):
        raise InvalidProblem(f"{table.kind} has one bound, not a list", place, 'give one, such as "500 m"')
    units = Units(quantity, c)
    return None if value is None else units.plain(value, units.name(table.unit), place)


def _corner(table: ConstraintTable, key: str, dimension: int, where: str, c: float) -> Array:
    """Return the least or greatest coordinates (d,) of a box; infinite where there is no bound."""
    value = getattr(table, key)
    if value is None:
        return np.full(dimension, -np.inf if key == "min" else np.inf)
    place = join(where, f"key {key!r}")
    if not isinstance(value, list) or len(value) != dimension:
        count = f"{len(value)} coordinates" if isinstance(value, list) else "one number"
        raise InvalidProblem(f"the box has {count}, not {dimension}", place, "give one each; inf or -inf is no bound")
    return Units("length", c).conversion(table.unit, place).factor * np.array(value)


def _region(table: ConstraintTable, frame: Frame, where: str, c: float) -> Sequence[Constraint]:
    key = "corners" if table.corners is not None else "corners_deg"
    place = join(where, f"key {key!r}")
    if table.corners is not None and table.corners_deg is not None:
        raise InvalidProblem("the corners are given twice", where, "give corners or corners_deg")
    given = table.corners if table.corners is not None else table.corners_deg
    assert given is not None
    bad = next((i for i, corner in enumerate(given) if len(corner) != 2), None)
    if bad is not None:
        raise InvalidProblem(f"corner {bad + 1} has {len(given[bad])} coordinates", place, "give two")
    corners = np.array(given, dtype=float).reshape(-1, 2)
    if table.corners_deg is None:
        corners = Units("length", c).conversion(table.unit, place).factor * corners
    elif frame.kind != "enu":
        advice = 'write kind = "enu" in [frame]'
        raise InvalidProblem("corners in latitude and longitude need a plan", place, advice)
    else:
        assert frame.origin is not None
        lat, lon = np.radians(corners).T
        level = np.full(len(corners), frame.origin[2])
        corners = frame.from_geodetic(lat, lon, level, where=place, first_row=1)[:, :2]
    check_polygon(corners, place)
    return polygon(corners)


def _sight(table: ConstraintTable, stations: Stations, frame: Frame, where: str) -> Sequence[Constraint]:
    if not frame.geodetic or stations.dimension != 3:
        raise InvalidProblem("a horizon needs a geodetic frame", where, "use frame ecef or enu with 3-D stations")
    if stations.position.shape[-3] > 1:
        raise InvalidProblem("the stations move, and so would their horizon", where, "give one file for each epoch")
    chosen = stations.names if table.stations is None or table.stations == "all" else table.stations
    place = join(where, "key 'stations'")
    if isinstance(chosen, str):
        raise InvalidProblem(f"{chosen!r} is no list of stations", place, 'give "all" or a list of names')
    unknown = [name for name in chosen if name not in stations.names]
    if unknown or not chosen:
        what = f"there is no station {unknown[0]!r}" if unknown else "no station is named"
        raise InvalidProblem(what, place, nearest(unknown[0] if unknown else "", stations.names))
    place = join(where, "key 'elevation'")
    elevation = Units("angle").plain(0.0 if table.elevation is None else table.elevation, "deg", place)
    if abs(elevation) > np.pi / 2:
        raise InvalidProblem("the elevation is outside -90 to 90 deg", place, "give degrees above the horizon")
    index = [stations.names.index(name) for name in chosen]
    seen = visible(frame.to_ecef(stations.position[0, index]), elevation=elevation)
    return [replace(band, name=f"sight of {name}") for band, name in zip(seen, chosen, strict=True)]


def _merged(constraints: Sequence[Constraint]) -> Iterator[Constraint]:
    """Yield the intersection of the bands on each quantity, and every polygon once."""
    for bands in like(constraints):
        lower, upper = np.max([band.lower for band in bands], axis=0), np.min([band.upper for band in bands], axis=0)
        if np.isfinite(lower) or np.isfinite(upper) or lower > upper or np.isnan([lower, upper]).any():
            yield replace(bands[0], lower=lower, upper=upper)
    yield from {(c.target, c.vertices.tobytes()): c for c in constraints if isinstance(c, Polygon)}.values()
