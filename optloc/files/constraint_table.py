"""The table `[[constraints]]` of problem files, and the same table as one line of text."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import AliasChoices, ConfigDict, Field, ValidationError, field_validator
from pydantic_core import PydanticCustomError

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.types import Amount
from optloc.files.constraint_kinds import COMMON, CONSTRAINT_KINDS, kind_names, kind_of
from optloc.files.settings import Bound, FileTable

# Maximum number of points of a line, and of lines of a grid, in the table itself: longer ones belong in a file.
_MOST = 1000
# Maximum number of heights in a list: each is a fix, and the tallest buildings have fewer floors.
_FLOORS = 200
Points = list[list[float]]


def _conditions(schema: dict[str, Any]) -> None:
    """Add the keys of each kind to the JSON schema of the table."""
    schema["allOf"] = [
        {
            "if": {"properties": {"kind": {"const": name}}},
            "then": {"propertyNames": {"enum": [*COMMON, *kind.keys]}},
        }
        for name, kind in CONSTRAINT_KINDS.items()
    ]


class ConstraintTable(FileTable):
    """A constraint on the position, height or velocity of targets."""

    model_config = ConfigDict(json_schema_extra=_conditions)

    kind: str = Field(json_schema_extra=lambda schema: schema.update(enum=[*kind_names()]))
    """Kind of the constraint; each kind has different keys."""
    target: str | None = None
    """Name of the target; by default all targets."""
    name: str | None = Field(default=None, min_length=1)
    """Name in results; by default the kind."""
    unit: str | None = None
    """Unit of plain numbers; by default metres, metres per second, or the SI unit of the quantity."""
    exactly: Amount | list[Bound] | None = None
    """Known height above the WGS 84 ellipsoid, or above a terrain; or a reported height for each epoch."""
    one_of: list[Amount] | None = Field(default=None, min_length=2, max_length=_FLOORS)
    """Known heights on one of which the target is, such as the floors of a building."""
    within: Amount | None = None
    """Half width of a band around `exactly`."""
    along: bool | None = None
    """Whether the limit of a moving target holds at all times, or only at the reference time. By default, heights and
    separations hold at all times; a target with a height along its course follows the Earth."""
    min: Amount | list[Bound] | None = None
    """Least value; least coordinates of a box in the frame, -inf for no bound."""
    max: Amount | list[Bound] | None = None
    """Greatest value; greatest coordinates of a box, inf for no bound."""
    x: Amount | list[float] | None = None
    """First coordinate of a centre; for a terrain, the lines of the grid in ascending order."""
    y: Amount | list[float] | None = None
    """Second coordinate of a centre; for a terrain, the lines of the grid in ascending order."""
    z: Amount | None = None
    """Third coordinate of a centre."""
    lat_deg: float | None = Field(default=None, validation_alias=AliasChoices("lat_deg", "lat"))
    """Latitude of a centre, degrees; or `lat`."""
    lon_deg: float | None = Field(default=None, validation_alias=AliasChoices("lon_deg", "lon"))
    """Longitude of a centre, degrees; or `lon`."""
    height: Amount | list[list[float]] | None = None
    """Height of a centre above the ellipsoid; for a terrain, one list of heights for each x, with one for each y."""
    radius: Amount | None = None
    """Radius of a disc or a ball."""
    inner: Amount | None = None
    """Inner radius of an annulus."""
    outer: Amount | None = None
    """Outer radius of an annulus."""
    normal: list[float] | None = None
    """Direction across a half-plane, a band or a fence, of any length."""
    offset: Amount | None = None
    """Greatest value of normal . position, such as "2 km" for a normal of length one."""
    sigma: Amount | None = None
    """Standard deviation of the place of a fence."""
    normals: Points | None = Field(default=None, max_length=_MOST)
    """Outward normals of a polyhedron."""
    offsets: list[float] | None = Field(default=None, max_length=_MOST)
    """Greatest value of each normal . position of a polyhedron, in `unit`."""
    corners: Points | None = None
    """Corners [x, y] of a polygon in the plan, in order around it."""
    corners_deg: Points | None = None
    """Corners [latitude, longitude] of a polygon in degrees, at the height of the origin of an ENU frame."""
    points: Points | None = Field(default=None, max_length=_MOST)
    """Points [x, y] or [x, y, z] of a polyline, in order."""
    points_deg: Points | None = Field(default=None, max_length=_MOST)
    """Points [latitude, longitude] or [latitude, longitude, height] of a polyline."""
    tolerance: Amount | None = None
    """Greatest distance from a polyline."""
    file: str | None = None
    """File with a polygon or a line (GeoJSON, CSV) or a grid of heights (CSV with x, y, height; ESRI ASCII `.asc`),
    relative to the problem file."""
    stations: str | list[str] | None = None
    """Stations, for instance satellites, above the horizon of the target: "all" (default), or names."""
    elevation: Amount | None = None
    """Least elevation of these stations, degrees; by default 0."""
    between: list[str] | None = None
    """Names of two targets with a bounded distance."""
    coefficients: list[float] | None = None
    """Coefficients of a quantity that another package adds, SI units."""

    @field_validator("kind")
    @classmethod
    def _known(cls, kind: str) -> str:
        """Return a known kind."""
        if kind_of(kind) is None:
            raise PydanticCustomError("literal_error", "unknown kind", {"expected": ", ".join(map(repr, kind_names()))})
        return kind

    @property
    def given(self) -> set[str]:
        """Return the given keys, without the keys that every kind has."""
        return {key for key in self.model_fields_set if getattr(self, key) is not None} - set(COMMON)


def height_table(height: str) -> ConstraintTable:
    """Return the constraint of a height such as "1640 ft", or of a list of floors such as "0 m, 3.5 m, 7 m"."""
    parts = [part.strip() for part in height.split(",")]
    if len(parts) < 2:
        return ConstraintTable(kind="height", exactly=height)
    return ConstraintTable(kind="height", one_of=list(parts))


# A constraint as text: "disc x=3 km y=2 km radius=500 m".

_KEY = re.compile(r"(?:^|\s)([A-Za-z_]+)\s*=")


def constraint_of_text(text: str, where: str) -> ConstraintTable:
    """Return the table of a text such as ``disc x=3 km y=2 km radius=500 m``.

    The text is a kind, then keys with values: numbers, texts, and lists such as ``0,0`` or ``[[0,0],[9,0]]``.

    Parameters
    ----------
    text : str
        Kind, keys and values.
    where : str
        Place for messages.

    Raises
    ------
    InvalidProblem
        For an unknown kind or key, or a value that does not fit.
    """
    first, _, rest = text.strip().partition(" ")
    keys = list(_KEY.finditer(rest))
    if kind_of(first) is None:
        raise InvalidProblem(f"there is no constraint {first!r}", where, nearest(first, kind_names()))
    if rest[: keys[0].start() if keys else None].strip():
        advice = f"write it as {(kind_of(first) or CONSTRAINT_KINDS['disc']).example or 'name min=0 max=1'!r}"
        raise InvalidProblem(f"{rest.split()[0]!r} is no key with a value", where, advice)
    ends = [*(key.start() for key in keys[1:]), len(rest)][: len(keys)]
    values: dict[str, Any] = {"kind": first}
    for key, end in zip(keys, ends, strict=True):
        if key[1] in values:
            raise InvalidProblem(f"the key {key[1]!r} is given twice", where, "remove one of them")
        values[key[1]] = _value(rest[key.end() : end].strip())
    return constraint_table(values, where)


def constraint_table(values: Mapping[str, Any], where: str) -> ConstraintTable:
    """Return a table of keys and values.

    Parameters
    ----------
    values : mapping of str to value
        The keys.
    where : str
        Place for messages.

    Raises
    ------
    InvalidProblem
        For an unknown kind or key, or a value that does not fit.
    """
    try:
        return ConstraintTable.model_validate(_plain(dict(values)))
    except ValidationError as error:
        first = error.errors()[0]
        key, given = str(first["loc"][0]), str(first["input"])[:_SHOWN]
        kind = kind_of(str(values.get("kind")))
        if key == "kind" or kind is None:
            word = str(values.get("kind", ""))
            raise InvalidProblem(f"there is no constraint {word!r}", where, nearest(word, kind_names())) from None
        if first["type"] == "extra_forbidden":
            advice = nearest(key, kind.keys) if kind.keys else "remove it"
            raise InvalidProblem(f"{values['kind']} has no key {key!r}", where, advice) from None
        advice = "write numbers with their units, and lists of numbers"
        raise InvalidProblem(f"{key} = {given!r} does not fit", where, advice) from None


def _plain(value: Any) -> Any:
    """Return a value with lists instead of arrays and tuples, as problem files have them."""
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return [_plain(each) for each in value] if isinstance(value, list | tuple) else value


# Largest number of characters of a value in a message.
_SHOWN = 40


def _value(text: str) -> Any:
    """Return the value of a key: a number, a truth value, text, or a list of these."""
    try:
        found = tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        found = [_value(part.strip()) for part in text.split(",")] if "," in text else text
    # Only numbers, truth values, text and lists are values of keys; a date is text here.
    return found if isinstance(found, int | float | str | list) else text
