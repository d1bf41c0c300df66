"""Roles of columns in measurement tables: names, and units that fit each role."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.units import UNITS
from optloc.models import MODELS, Model, kind_named

# Spellings of units in column headers.
_SPELLED = {
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("feet", "foot"), "ft"),
    **dict.fromkeys(("sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("msec", "millis", "milliseconds"), "ms"),
    **dict.fromkeys(("µs", "μs", "usec", "micros", "microseconds"), "us"),
    **dict.fromkeys(("nsec", "nanos", "nanoseconds"), "ns"),
    **dict.fromkeys(("°", "degree", "degrees"), "deg"),
    **dict.fromkeys(("radian", "radians"), "rad"),
}
# Longest first, so that the unit of toa_ns is ns, not s.
_UNITS = sorted({*UNITS["length"], *UNITS["angle"], *UNITS["speed"], *UNITS["level"], *_SPELLED}, key=len, reverse=True)
_SUFFIX = re.compile(rf"\s*[_ \[(/]\s*({'|'.join(map(re.escape, _UNITS))})[\])]?$", re.IGNORECASE)
# ROS adds this prefix to the fields of a message (rostopic echo -p).
_PREFIX = re.compile(r"^field\.", re.IGNORECASE)

_CLOCK = tuple(UNITS["time"])
_ANGLE = tuple(UNITS["angle"])
# A coordinate is never a time, although a measured length may be given as a time.
_LENGTH = tuple(unit for unit in UNITS["length"] if unit not in UNITS["time"])
# Names of the two stations of a pair, such as anchor1 and anchor2.
_FIRST, _SECOND = (
    " ".join(f"{word}{end}" for word in "station receiver anchor sensor node rx site".split() for end in ends)
    for ends in ("a1", "b2")
)


@dataclass(frozen=True, slots=True)
class Role:
    """A role that a column of a table can have.

    Parameters
    ----------
    text : str
        Content of the column.
    names : tuple of str
        Names of columns with this role, in the form of `stem`, the most likely first.
    units : tuple of str
        Units in which the column name may end.
    with_unit : tuple of str
        Names that need one of these units at the end.
    """

    text: str
    names: tuple[str, ...]
    units: tuple[str, ...] = ()
    with_unit: tuple[str, ...] = ()

    def allows(self, unit: str | None) -> bool:
        """Return whether a column with this unit in its name, or without a unit, can have the role."""
        return unit is None or unit in self.units


def _role(text: str, names: str, units: Iterable[str] = (), with_unit: str = "") -> Role:
    """Return a role from its content `text`, and texts with names that are separated by spaces.

    `units` are the permitted units. `with_unit` are names that need one of the units at the end.
    """
    return Role(text, tuple(names.split()), tuple(units), tuple(with_unit.split()))


_MESSAGES = "message msg messageid msgid pulse frame epoch event eventid burst shot seq"
_STATIONS = (
    "station receiver rx sensor anchor beacon site observer node microphone mic hydrophone recorder transponder "
    f"geophone stationid receiverid sensorid a {_FIRST}"
)
_FIXED = {
    "message": _role("label of a message, pulse or epoch", _MESSAGES),
    "station": _role("station of the row", _STATIONS),
    "name": _role("name of a station, if no column is named after stations", "name callsign user"),
    "id": _role("name of a station; label of a message if another column names the station", "id"),
    "reference": _role("second station of the row", f"b reference ref refstation {_SECOND}"),
    "time": _role(
        "time of the row; the arrival if the table has no other reading",
        "rxtime time timestamp utc datetime date t tgps gpstime tow", _CLOCK, "epoch",
    ),
    "target": _role("target of the row", "target tag mobile transmitter emitter icao hex mac device track"),
    "phase": _role("phase of a pick, P or S", "phase phasehint phasetype"),
    "p": _role("arrival of the P wave", "p tp ptime ppick parrival", _CLOCK),
    "s": _role("arrival of the S wave", "s ts stime spick sarrival", _CLOCK),
    "sp": _role("time from P to S", "sp sminusp spdifference stmp tstp", _CLOCK),
    "heading": _role(
        "heading of the vehicle, added to its bearings",
        "heading hdg trueheading headingtrue magneticheading headingmagnetic magheading headingmag", _ANGLE,
    ),
    "satellite": _role("satellite of the row", "satellite sat prn sv svid satid"),
    "x": _role("coordinate of a station", "x satx xecef ecefx xsat", _LENGTH),
    "y": _role("coordinate of a station", "y saty yecef ecefy ysat", _LENGTH),
    "z": _role("coordinate of a station", "z satz zecef ecefz zsat", _LENGTH),
    "lat": _role("latitude of a station", "lat latitude", _ANGLE),
    "lon": _role("longitude of a station", "lon long lng longitude", _ANGLE),
    "height": _role("height of a station", "height h alt altitude ellipsoidalheight elevation elev", _LENGTH),
    "depth": _role("depth of a station", "depth", _LENGTH),
}  # fmt: skip
# Further names of measured columns: too short for a problem file, or unambiguous in a table only.
_SHORT = {
    "toa": "pr prange rho c1c prm",
    "range": "ranges dist r d",
    "tdoa": "tdoas timedifference rdiff",
    "azimuth": "az bearings brg lob lineofbearing",
    "elevation": "el",
}
# Without a unit these names are heights in a table of stations; with a unit of angle they are elevations.
_ANGLES_BY_UNIT = {"elevation": "elevation elev altitude alt"}
_SIGMA = "sigma std stddev stdev sd uncertainty"
# Other words for roles in --column.
_OTHER = {"pseudorange": "toa", "arrivals": "toa"}
PLACE = ("name", "x", "y", "z", "lat", "lon", "height", "depth")
"""Roles of columns with station positions."""


def roles() -> Mapping[str, Role]:
    """Return all roles by name, including one for each measurement kind with stations."""
    return _roles(tuple(MODELS.items()))


@lru_cache(maxsize=4)
def _roles(models: tuple[tuple[str, Model], ...]) -> Mapping[str, Role]:
    """Return all roles by name, for the measurement kinds in `models`.

    The argument is the key of the cache, so that new kinds are included.
    """
    kinds = {kind: _of_kind(kind, model) for kind, model in models if model.stations}
    every = dict.fromkeys(unit for units in UNITS.values() for unit in units)
    return _FIXED | {"sigma": _role("standard deviation of the row", _SIGMA, every)} | kinds


def _of_kind(kind: str, model: Model) -> Role:
    """Return the role of a measured column of a kind, with the units of its quantity."""
    units = tuple(UNITS[model.quantity])  # type: ignore[index]  # models hold known quantities only
    by_unit = _ANGLES_BY_UNIT.get(kind, "").split()
    names = dict.fromkeys([*map(stem, (kind, *model.aliases)), *_SHORT.get(kind, "").split()])
    return Role(model.summary, tuple(name for name in names if name not in by_unit), units, tuple(by_unit))


def role_of(column: str) -> str | None:
    """Return the role that a column name suggests; None without a match."""
    return _by_name(tuple(MODELS.items())).get((stem(column), any_unit(column)))


@lru_cache(maxsize=4)
def _by_name(models: tuple[tuple[str, Model], ...]) -> Mapping[tuple[str, str | None], str]:
    """Return the role of each pair of a name and a permitted unit; the unit None is a name without a unit."""
    found: dict[tuple[str, str | None], str] = {}
    for role, entry in _roles(models).items():
        for name in entry.names:
            for unit in (None, *entry.units):
                found.setdefault((name, unit), role)
        for name in entry.with_unit:
            for unit in entry.units:
                found.setdefault((name, unit), role)
    return found


def rank(role: str, column: str) -> int:
    """Return the index of a column name in the list of names of its role, where the most likely name is first.

    If several columns can have the role, the smallest index is the best choice.
    """
    entry = roles()[role]
    return (*entry.names, *entry.with_unit).index(stem(column))


def role_named(word: str) -> str:
    """Return the role of a word in --column, such as a role, a kind or "sigma_" with a kind.

    Raise InvalidProblem for an unknown word.
    """
    word = word.strip()
    if word in roles() or word in ("epoch", *_OTHER):
        return _OTHER.get(word, word)
    if word.startswith("sigma_"):
        return f"sigma_{kind_named(word.removeprefix('sigma_'), '--column')}"
    try:
        return kind_named(word, "--column")
    except InvalidProblem:
        known = [*roles(), "epoch", *_OTHER]
        raise InvalidProblem(f"there is no role {word!r}", "--column", nearest(word, known)) from None


def check_unit(role: str, column: str) -> None:
    """Raise InvalidProblem if a column name ends in a unit that does not fit the stated role."""
    entry = roles().get(role)
    unit = any_unit(column)
    if entry is not None and entry.units and not entry.allows(unit):
        permitted = ", ".join(entry.units[:4])
        what = f"the column {column!r} is in {unit}, which is not a unit of the role {role}"
        raise InvalidProblem(what, "--column", f"state a column in {permitted}, or give this column another role")


def sigma_kind(column: str) -> str | None:
    """Return the kind of a column of standard deviations, such as "range" for "range_std_m"; None for other columns."""
    words = tokens(without_unit(column))
    rest = [word for word in words if word not in _SIGMA.split()]
    if len(rest) == len(words) or not rest:
        return None
    role = _by_name(tuple(MODELS.items())).get(("".join(rest), None))
    role = role or next((kind for kind, by_unit in _ANGLES_BY_UNIT.items() if "".join(rest) in by_unit.split()), None)
    role = "elevation" if role == "height" and any_unit(column) in _ANGLE else role
    return role if role is not None and role in MODELS else None


def is_sigma(word: str) -> bool:
    """Return whether a word means a standard deviation."""
    return word in _SIGMA.split()


def stem(column: str) -> str:
    """Return a column name in lower case without unit and punctuation: "TOA_ns" gives "toa"."""
    return re.sub(r"[^a-z0-9]", "", without_unit(_PREFIX.sub("", column.strip())).lower())


def tokens(text: str) -> tuple[str, ...]:
    """Return the words and numbers of a name in lower case."""
    return tuple(re.findall(r"[^\W\d_]+|\d+", text.lower()))


def without_unit(column: str) -> str:
    """Return a column name without its unit."""
    return _SUFFIX.sub("", column.strip())


def any_unit(column: str) -> str | None:
    """Return the unit at the end of a column name, of any quantity; None without a unit."""
    return unit_of(column, _UNITS)


def unit_of(column: str, known: Iterable[str]) -> str | None:
    """Return the unit at the end of a column name; None if it is not in `known`."""
    found = _SUFFIX.search(column.strip())
    if found is None:
        return None
    spelled = found.group(1).lower()
    return {unit.lower(): unit for unit in known}.get(_SPELLED.get(spelled, spelled).lower())
