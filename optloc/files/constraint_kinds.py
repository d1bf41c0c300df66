"""The kinds of constraints of problem files: their keys, and the function that makes each constraint.

A new kind is one entry of `CONSTRAINT_KINDS`. The check of the keys, the JSON schema, the option `--constraint`,
`optloc list constraints` and the tables of the manual use this table. Each quantity that other packages register in the
group ``optloc.constraints`` is a kind, too: it has the keys of `QUANTITY`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from optloc.base.errors import InvalidProblem, nearest, no_station
from optloc.base.types import Amount, Array, Constraint, Fence, Motion
from optloc.base.units import UNITS, Quantity
from optloc.files.constraint_values import ConstraintValues
from optloc.files.settings import Units
from optloc.linear import constraints
from optloc.models.surfaces import SURFACES
from optloc.problem.constraint_checks import check_polygon

Made = Sequence[Constraint | Fence] | tuple[Motion, Sequence[Constraint]]
"""Constraints and fences; a height along a course also determines the motion that can keep it."""


@dataclass(frozen=True, slots=True)
class ConstraintKind:
    """A kind of constraint of problem files.

    Parameters
    ----------
    make : callable
        Returns the constraints of the values of a table.
    needs : tuple of str
        What must be given, each as the possible sets of keys: "x y / lat_deg lon_deg".
    summary : str
        What the constraint states, for lists.
    optional : tuple of str
        Further keys.
    example : str
        Value of the option `--constraint`.
    """

    make: Callable[[ConstraintValues], Made]
    needs: tuple[str, ...]
    summary: str
    optional: tuple[str, ...] = ()
    example: str = ""

    @property
    def keys(self) -> tuple[str, ...]:
        """Return all keys of the kind, without the keys that every kind has."""
        needed = [key for choice in self.needs for keys in _sets(choice) for key in keys]
        return tuple(dict.fromkeys([*needed, *self.optional]))


def _sets(choice: str) -> list[list[str]]:
    """Return the possible sets of keys of an entry of `ConstraintKind.needs`."""
    return [keys.split() for keys in choice.split("/")]


COMMON = ("kind", "target", "name")
"""Keys of every kind."""


def kind_of(name: str) -> ConstraintKind | None:
    """Return a kind of constraint by its name, or None for an unknown name.

    The name is a key of `CONSTRAINT_KINDS`, or a quantity of `optloc.models.surfaces.SURFACES`.
    """
    if name in CONSTRAINT_KINDS:
        return CONSTRAINT_KINDS[name]
    # A quantity with several coefficients, or with none.
    if name in SURFACES:
        return replace(QUANTITY, summary=SURFACES[name].summary)
    return None


# Quantities of optloc behind kinds with other names: a file can bound them, but lists name the kinds.
_BEHIND = {"plane", "distance", "segment", "turn_rate", "least speed", "least separation"}


def kind_names() -> list[str]:
    """Return the names of all kinds of constraints: the kinds of optloc, then the quantities of other packages."""
    return [*CONSTRAINT_KINDS, *sorted(set(SURFACES) - set(CONSTRAINT_KINDS) - _BEHIND)]


def check_keys(name: str, given: set[str], where: str) -> None:
    """Raise InvalidProblem for a key that a kind does not use, or for a missing key.

    `given` are the keys of the table, without the keys that every kind has, and `where` is its place for messages.
    """
    kind = kind_of(name)
    assert kind is not None  # the schema has checked the name
    foreign = sorted(given - set(kind.keys))
    if foreign:
        advice = nearest(foreign[0], kind.keys) if kind.keys else "remove it"
        raise InvalidProblem(f"{name} has no key {foreign[0]!r}", where, advice)
    for choice in kind.needs:
        sets = _sets(choice)
        if any(given.issuperset(keys) for keys in sets):
            continue
        closest = max(sets, key=lambda keys: len(given.intersection(keys)))
        missing = [key for key in closest if key not in given]
        if len(sets) == 1 or len(missing) < len(closest):
            raise InvalidProblem(f"{name} has no {missing[0]!r}", where, f"add the key {missing[0]!r}")
        advice = f"give {' or '.join(', '.join(keys) for keys in sets)}"
        raise InvalidProblem(f"{name} has no {_NOUNS.get(choice, 'shape')}", where, advice)


# Constructors. Each gets the values of a table, and calls a function of `optloc.constraints`.


def _half_plane(v: ConstraintValues) -> Made:
    """Return the half-plane ``normal . position <= offset``."""
    v.plan()
    return constraints.half_plane(v.direction(), v.amount("offset"), **v.naming)


def _band(v: ConstraintValues) -> Made:
    """Return the band ``min <= normal . position <= max``."""
    v.plan()
    return constraints.band(v.direction(), *v.bounds("length"), **v.naming)


def _fence(v: ConstraintValues) -> Made:
    """Return a half-plane with an uncertain boundary: a term of the cost."""
    v.plan()
    return constraints.fence(v.direction(), v.amount("offset"), v.positive("sigma"), **v.naming)


def _disc(v: ConstraintValues) -> Made:
    """Return a disc in the plan."""
    v.plan()
    return constraints.disc(v.point(2), v.positive("radius"), **v.naming)


def _annulus(v: ConstraintValues) -> Made:
    """Return a ring in the plan."""
    v.plan()
    inner, outer = v.positive("inner"), v.positive("outer")
    if inner > outer:
        raise InvalidProblem("the inner radius is above the outer radius", v.place("inner"), "exchange them")
    return constraints.annulus(v.point(2), inner, outer, **v.naming)


def _keep_out_disc(v: ConstraintValues) -> Made:
    """Return the plan outside a disc."""
    v.plan()
    return constraints.keep_out_disc(v.point(2), v.positive("radius"), **v.naming)


def _ball(v: ConstraintValues) -> Made:
    """Return a ball."""
    return constraints.ball(v.point(v.dimension), v.positive("radius"), **v.naming)


def _keep_out_ball(v: ConstraintValues) -> Made:
    """Return the space outside a ball."""
    return constraints.keep_out_ball(v.point(v.dimension), v.positive("radius"), **v.naming)


def _corners(v: ConstraintValues) -> Array:
    """Return the corners (n, 2) of a polygon, m."""
    corners = v.points("corners", (2,))
    check_polygon(corners, v.place("corners" if v.has("corners") else "corners_deg"))
    return corners


def _polygon(v: ConstraintValues) -> Made:
    """Return a polygon of the plan."""
    return constraints.polygon(_corners(v), **v.naming)


def _keep_out_polygon(v: ConstraintValues) -> Made:
    """Return the plan outside a polygon."""
    return constraints.keep_out_polygon(_corners(v), **v.naming)


def _above_ground(v: ConstraintValues) -> Made:
    """Return the constraint that the height is not negative, and the motion that can keep it."""
    return _level(v, 0.0, np.inf)


def _polyhedron(v: ConstraintValues) -> Made:
    """Return the intersection of half-planes or half-spaces."""
    v.plan()
    normals, offsets = v.given["normals"], v.given["offsets"]
    bad = next((i for i, normal in enumerate(normals) if len(normal) != v.dimension), None)
    if bad is not None:
        what = f"normal {bad + 1} has {len(normals[bad])} coordinates, not {v.dimension}"
        raise InvalidProblem(what, v.place("normals"), "give one number for each coordinate")
    if len(offsets) != len(normals):
        what = f"there are {len(offsets)} offsets for {len(normals)} normals"
        raise InvalidProblem(what, v.place("offsets"), "give one offset for each normal")
    limits = v.factor("offsets") * np.array(offsets, dtype=float)
    return constraints.polyhedron(np.array(normals, dtype=float), limits, **v.naming)


def _polyline(v: ConstraintValues) -> Made:
    """Return the neighbourhood of a line: a road or a track."""
    v.plan()
    sizes = (2,) if v.dimension == 2 else (2, 3)
    points = v.points("points", sizes)
    if len(points) < 2:
        what = f"the polyline has {len(points)} points"
        raise InvalidProblem(what, v.place("points"), "give two points or more")
    return constraints.polyline(points, v.positive("tolerance"), **v.naming)


def _terrain(v: ConstraintValues) -> Made:
    """Return the constraint on the height above a grid of heights."""
    v.plan()
    if v.dimension != 3:
        raise InvalidProblem("a terrain needs three dimensions", v.where, "give z of the stations")
    x, y = (v.factor(key) * np.array(_list(v, key), dtype=float) for key in "xy")
    given = _list(v, "height")
    if len({len(row) if isinstance(row, list) else -1 for row in given}) != 1 or not isinstance(given[0], list):
        raise InvalidProblem("the heights are not a grid", v.place("height"), "give one list of heights for each x")
    heights = v.factor("height") * np.array(given, dtype=float)
    if heights.shape != (len(x), len(y)):
        what = f"{heights.shape[0]} by {heights.shape[1]} heights for {len(x)} x and {len(y)} y"
        raise InvalidProblem(what, v.place("height"), "give one list of heights for each x, with one height for each y")
    for key, axis in (("x", x), ("y", y)):
        if not (np.diff(axis) > 0.0).all():
            raise InvalidProblem(f"the values of {key} are not ascending", v.place(key), "sort the grid")
    if v.has("exactly"):
        if v.has("min") or v.has("max"):
            raise InvalidProblem("a height is either exact or in a band", v.where, "give exactly, or min and max")
        return constraints.terrain(x, y, heights, exactly=v.amount("exactly"), **v.naming)
    lower, upper = v.bounds("length")
    return constraints.terrain(x, y, heights, lower=lower, upper=upper, **v.naming)


def _list(v: ConstraintValues, key: str) -> list[Any]:
    """Return the list under a key; raise InvalidProblem for one number."""
    value = v.given[key]
    if isinstance(value, np.ndarray):
        return cast("list[Any]", value.tolist())
    if not isinstance(value, list) or not value:
        raise InvalidProblem(f"{key} is not a list", v.place(key), "give the lines of the grid, such as [0.0, 100.0]")
    return value


def _box(v: ConstraintValues) -> Made:
    """Return a box."""
    low, high = (_bound(v, key) for key in ("min", "max"))
    return constraints.box(low.tolist(), high.tolist(), **v.naming)


def _bound(v: ConstraintValues, key: str) -> Array:
    """Return the least or greatest coordinates (d,) of a box; infinite without a bound."""
    if not v.has(key):
        return np.full(v.dimension, -np.inf if key == "min" else np.inf)
    value = v.given[key]
    if not isinstance(value, list) or len(value) != v.dimension:
        count = f"{len(value)} coordinates" if isinstance(value, list) else "one number"
        advice = "give one number for each coordinate; inf or -inf means no bound"
        raise InvalidProblem(f"the box has {count}, not {v.dimension}", v.place(key), advice)
    return v.factor(key) * np.array(value)


def _height(v: ConstraintValues) -> Made:
    """Return a height, or a band of heights, above the ellipsoid, and the motion that can keep it.

    A list of heights gives the band from the lowest to the highest; commands that fix then compare the heights.
    """
    if v.has("one_of"):
        others = [key for key in ("exactly", "within", "min", "max") if v.has(key)]
        if others:
            raise InvalidProblem(f"a list of heights has no {others[0]!r}", v.where, "give one_of alone")
        found = heights_of(v.given["one_of"], v.given.get("unit"), v.place("one_of"))
        return _level(v, min(found), max(found))
    if not v.has("exactly"):
        if v.has("within"):
            raise InvalidProblem("'within' needs 'exactly'", v.where, "give exactly, or min and max alone")
        return _level(v, *v.bounds("length"))
    if v.has("min") or v.has("max"):
        raise InvalidProblem("a height is either exact or in a band", v.where, "give exactly, or min and max")
    within = v.amount("within", default=0.0)
    if within < 0.0:
        raise InvalidProblem("the band has a negative width", v.place("within"), "give the half width")
    if isinstance(v.given["exactly"], list):
        return _reported(v, within)
    level = v.amount("exactly")
    return _level(v, level - within, level + within)


def heights_of(given: Sequence[Amount], unit: str | None, where: str) -> tuple[float, ...]:
    """Return the heights of a list, metres, ascending and each once; `unit` is the unit of plain numbers.

    Raise InvalidProblem for a list of one height; `where` is its place for messages.
    """
    units = Units("length")
    found = sorted({units.plain(each, units.name(unit), where) for each in given})
    if len(found) < 2:
        raise InvalidProblem("a list of heights needs two different heights", where, 'or write exactly = "3.5 m"')
    return tuple(found)


def _level(v: ConstraintValues, low: float, high: float) -> Made:
    """Return the motion that can keep a height between two values, m, and the constraint.

    On Earth, a moving target with a height along its course follows the Earth. Elsewhere the height is the third
    coordinate.
    """
    if not v.frame.geodetic:
        return _level_plane(v, low, high)
    # bounds of a height that may curve hold at one time: inside them at both ends, the course may still leave them
    along = v.given["along"] if v.has("along") else v.motion.order < 2 or low == high
    over = replace(v.motion, over="ground") if along and moves(v.motion) else v.motion
    return over, constraints.height(low, high, along=along, **v.naming)


def _level_plane(v: ConstraintValues, low: float, high: float) -> Made:
    """Return the constraint on the third coordinate in a frame that is not on Earth."""
    if v.dimension != 3:
        advice = "give x, y, z of each station, or remove the height"
        raise InvalidProblem("stations in the plane have no height", v.where, advice)
    along = v.given["along"] if v.has("along") else v.motion.order < 2 or low == high
    planes = constraints.box([-np.inf, -np.inf, low], [np.inf, np.inf, high], **v.naming)
    return [replace(plane, name="height", along=along) for plane in planes[2:]]


def moves(motion: Motion) -> bool:
    """Return whether a target has an unknown course over several epochs, with a velocity."""
    return motion.order > 0 and motion.span == "run" and motion.known is None


def _reported(v: ConstraintValues, within: float) -> Made:
    """Return motion and constraint for heights that are stated for each epoch.

    `within` is the half width of the band around each height, m.
    """
    motion, given, place = v.motion, v.given["exactly"], v.place("exactly")
    if motion.span == "run" and not motion.order:
        raise InvalidProblem("a static target has one height", place, 'give one height, such as "500 m"')
    if v.given.get("along") is False:
        raise InvalidProblem("heights of all epochs hold along the course", v.where, "remove along = false")
    if len(given) != len(v.times):
        what = f"{len(given)} heights for {len(v.times)} epochs"
        raise InvalidProblem(what, place, "give one height for each epoch, in the order of time")
    levels = v.factor("exactly") * np.array(given, dtype=float)
    if motion.span == "epoch":
        # A free target has one constraint: the height minus its known rise above the first height. The rate is zero.
        rise = np.stack([levels - levels[0], np.zeros_like(levels)], axis=-1)
        return replace(motion, rise=rise), constraints.height(levels[0] - within, levels[0] + within, **v.naming)
    settings: dict[str, Any] = {"order": motion.order, "reference": motion.reference, **v.naming}
    return constraints.reported(levels, v.times, within=within, **settings)


def _visible(v: ConstraintValues) -> Made:
    """Return one constraint for each named station: the station is above the horizon of the target."""
    stations = v.stations
    if not v.frame.geodetic or v.dimension != 3:
        raise InvalidProblem("a horizon needs a geodetic frame", v.where, "use frame ecef or enu with 3-D stations")
    if stations.position.shape[-3] > 1:
        what = "the stations move, so their horizon is not constant"
        raise InvalidProblem(what, v.where, "give one file for each epoch")
    chosen = v.given.get("stations", "all")
    chosen, place = stations.names if chosen == "all" else chosen, v.place("stations")
    if isinstance(chosen, str):
        raise InvalidProblem(f"{chosen!r} is not a list of stations", place, 'give "all" or a list of names')
    if not chosen:
        raise InvalidProblem("no station is named", place, nearest("", stations.names))
    unknown = next((name for name in chosen if name not in stations.names), None)
    if unknown is not None:
        raise no_station(unknown, place, stations.names)
    index = [stations.names.index(name) for name in chosen]
    elevation = v.units("angle").plain(v.given.get("elevation", 0.0), "deg", v.place("elevation"))
    if abs(elevation) > np.pi / 2:
        advice = "give degrees above the horizon"
        raise InvalidProblem("the elevation is outside -90 to 90 deg", v.place("elevation"), advice)
    seen = constraints.visible(v.frame.to_ecef(stations.position[0, index]), elevation=elevation)
    stem = v.naming.get("name", "sight of")
    return [replace(band, name=f"{stem} {name}") for band, name in zip(seen, chosen, strict=True)]


def _speed(v: ConstraintValues) -> Made:
    """Return bounds of the speed."""
    least, most = v.bounds("speed")
    return constraints.speed(most, lower=least, along=bool(v.given.get("along")), **v.naming)


def _turn_rate(v: ConstraintValues) -> Made:
    """Return bounds of the turn rate of a course with an acceleration; by default equal to both sides."""
    least = v.rate("min") if v.has("min") else None
    return constraints.turn_rate(v.rate("max"), lower=least, **v.naming)


def _acceleration(v: ConstraintValues) -> Made:
    """Return the greatest acceleration of a course."""
    return constraints.acceleration(v.rate("max"), **v.naming)


def _separation(v: ConstraintValues) -> Made:
    """Return bounds of the distance between two targets."""
    names, place = v.given["between"], v.place("between")
    if len(names) != 2 or names[0] == names[1]:
        raise InvalidProblem("a separation is between two targets", place, 'give two names, such as ["A", "B"]')
    unknown = next((name for name in names if name not in v.targets), None)
    if unknown is not None:
        raise InvalidProblem(f"no row has the target {unknown!r}", place, nearest(unknown, sorted(set(v.targets))))
    first, second = (v.targets.index(name) for name in names)
    lower, upper = v.bounds("length")
    return constraints.separation(first, second, lower, upper, along=v.given.get("along", True), **v.naming)


def _quantity(v: ConstraintValues) -> Made:
    """Return bounds of a registered quantity."""
    surface = SURFACES[v.kind]
    if surface.table or surface.other:
        what = f"{v.kind} needs {'a table' if surface.table else 'a second target'}"
        raise InvalidProblem(what, v.where, "state it in Python with optloc.constraints.quantity")
    given, counts = v.given.get("coefficients", []), surface.counts(v.dimension)
    if len(given) not in counts:
        wanted = " or ".join(map(str, counts))
        what = f"{v.kind} has {len(given)} coefficients, not {wanted}"
        raise InvalidProblem(what, v.place("coefficients"), "give SI numbers, in the order of the quantity")
    # Bounds in units need a quantity whose SI unit optloc knows; bounds of other quantities are plain numbers.
    quantity: Quantity = next((name for name, units in UNITS.items() if next(iter(units)) == surface.unit), "plain")
    lower, upper = v.bounds(quantity)
    return constraints.quantity(v.kind, lower, upper, np.array(given, dtype=float), **v.naming)


# Choices of several kinds: a centre, bounds, and the corners of a polygon; and how messages name them.
_CENTRE, _BOUNDS, _LEVELS = "x y / lat_deg lon_deg", "min / max", "exactly / min / max"
_HEIGHTS = "exactly / one_of / min / max"
_CORNERS = "corners / corners_deg / file"
_NOUNS = {_CENTRE: "centre", _BOUNDS: "bound", _LEVELS: "bound", _HEIGHTS: "bound", _CORNERS: "corners"}

CONSTRAINT_KINDS: dict[str, ConstraintKind] = {
    "half-plane": ConstraintKind(
        _half_plane,
        ("normal", "offset"),
        "on one side of a line or plane: normal · position is at most the offset",
        ("unit",),
        "half-plane normal=1,0 offset=2 km",
    ),
    "fence": ConstraintKind(
        _fence,
        ("normal", "offset", "sigma"),
        "on one side of a line or plane at an uncertain place; beyond it, the target is improbable",
        ("unit",),
        "fence normal=1,0 offset=2 km sigma=50 m",
    ),
    "band": ConstraintKind(
        _band,
        ("normal", _BOUNDS),
        "between two parallel lines or planes: normal · position is between min and max",
        ("unit",),
        "band normal=1,1 min=0 max=2 km",
    ),
    "disc": ConstraintKind(
        _disc, (_CENTRE, "radius"), "in a disc of the plan", ("unit",), "disc x=3 km y=2 km radius=500 m"
    ),
    "annulus": ConstraintKind(
        _annulus,
        (_CENTRE, "inner", "outer"),
        "in a ring of the plan",
        ("unit",),
        "annulus x=0 y=0 inner=1 km outer=2 km",
    ),
    "keep-out-disc": ConstraintKind(
        _keep_out_disc,
        (_CENTRE, "radius"),
        "outside a disc of the plan",
        ("unit",),
        "keep-out-disc lat=47.1 lon=8.2 radius=1 nmi",
    ),
    "ball": ConstraintKind(
        _ball, (_CENTRE, "radius"), "in a ball", ("z", "height", "unit"), "ball x=0 y=0 z=100 radius=2 km"
    ),
    "keep-out-ball": ConstraintKind(
        _keep_out_ball,
        (_CENTRE, "radius"),
        "outside a ball",
        ("z", "height", "unit"),
        "keep-out-ball x=0 y=0 z=100 radius=50 m",
    ),
    "polygon": ConstraintKind(
        _polygon, (_CORNERS,), "in a polygon of the plan, convex or not", ("unit",), "polygon file=area.geojson"
    ),
    "keep-out-polygon": ConstraintKind(
        _keep_out_polygon,
        (_CORNERS,),
        "outside a polygon of the plan",
        ("unit",),
        "keep-out-polygon corners=[[0,0],[900,0],[0,900]]",
    ),
    "polyhedron": ConstraintKind(
        _polyhedron,
        ("normals", "offsets"),
        "in a convex region: each normal · position is at most its offset",
        ("unit",),
        "polyhedron normals=[[1,0],[0,1]] offsets=900,800",
    ),
    "polyline": ConstraintKind(
        _polyline,
        ("points / points_deg / file", "tolerance"),
        "near a line, such as a road or a track",
        ("unit",),
        "polyline file=road.geojson tolerance=10 m",
    ),
    "terrain": ConstraintKind(
        _terrain,
        ("file / x y height", _LEVELS),
        "at a height above the ground of a grid",
        ("unit",),
        "terrain file=ground.asc exactly=2 m",
    ),
    "height": ConstraintKind(
        _height,
        (_HEIGHTS,),
        "at a height above the WGS 84 ellipsoid",
        ("within", "unit", "along"),
        "height exactly=1640 ft",
    ),
    "above-ground": ConstraintKind(_above_ground, (), "above the WGS 84 ellipsoid", ("along",), "above-ground"),
    "box": ConstraintKind(
        _box, (_BOUNDS,), "in a box: each coordinate is in a range", ("unit",), "box min=0,0 max=5000,4000"
    ),
    "visible": ConstraintKind(
        _visible, (), "where stations are above the horizon", ("stations", "elevation"), "visible elevation=5 deg"
    ),
    "speed": ConstraintKind(_speed, (_BOUNDS,), "at a speed in a range", ("unit", "along"), "speed max=90 km/h"),
    "turn-rate": ConstraintKind(
        _turn_rate,
        ("max",),
        "on a course with an acceleration and a bounded turn rate",
        ("min", "unit"),
        "turn-rate max=3 deg/s",
    ),
    "acceleration": ConstraintKind(
        _acceleration, ("max",), "on a course with a bounded acceleration", ("unit",), "acceleration max=2 m/s^2"
    ),
    "separation": ConstraintKind(
        _separation,
        ("between", _BOUNDS),
        "at a distance from another target",
        ("unit", "along"),
        "separation between=A,B min=50 m",
    ),
}
"""Kinds of constraints by name. The summary continues the words "the target is"."""

QUANTITY = ConstraintKind(_quantity, (_BOUNDS,), "a registered quantity", ("coefficients", "unit"))
"""Keys of a quantity that a package registers in the group `optloc.constraints`."""
