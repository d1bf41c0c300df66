"""Messages of a stream: the parsing of one line with rows, or arrivals at stations, of one event."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from optloc.files import has_controls
from optloc.problem import LARGEST, InvalidProblem, nearest, no_station
from optloc.service.site import Site, SiteRow, UnknownName
from optloc.service.strict_json import read_object

LINE = 1 << 16
"""Largest size of a line, bytes: more than a thousand rows."""

COMMANDS = ("flush", "health")
NAME, ROWS = 256, 4096
"""Largest number of characters of an id or a name, and of rows of an event: far more than any network has."""

KEYS = {
    *("command", "event", "z", "rows", "arrivals", "station", "kind", "a", "b", "sigma", "more", "target", "received"),
    *("time", "time_ns", "time_ps", "client"),
}
ROW_KEYS = {"kind", "a", "b", "z", "sigma"}
"""Permitted keys of a line, and of a row in the list ``rows``."""

# Decimals that give picoseconds, by the key of a time.
_DIGITS = {"time": 12, "time_ns": 3, "time_ps": 0}
_DECIMAL = re.compile(r"([+-]?)(\d{1,25})(?:\.(\d{1,40}))?")
# Tabs and line breaks, which are control characters that other texts may have.
_BREAKS = re.compile(r"[\t\n\r]")
# Picoseconds of 30 000 years: no clock has a later time.
_LATEST = 10**24

Key = int | SiteRow
"""A row of an event: its number in the template, or a row that is not in the template."""


class Message(NamedTuple):
    """The content of a line.

    Parameters
    ----------
    event : str
        Event of the rows, as in `full_name`; empty for a command.
    rows : dict of Key to float
        Values in the units of the site.
    times : dict of int to int
        Arrivals at stations, picoseconds.
    whole : bool
        Whether the event ends with this line.
    sigmas : dict of Key to float, optional
        Standard deviations of rows.
    target : str
        Name of the target, for the answer.
    command : str
        Command instead of rows.
    when : int, optional
        Time of the event, picoseconds; None: use the first arrival.
    """

    event: str
    rows: dict[Key, float]
    times: dict[int, int]
    whole: bool
    sigmas: dict[Key, float] | None = None
    target: str = ""
    command: str = ""
    when: int | None = None


def parse(line: bytes, site: Site) -> Message:
    """Return the content of a line with one JSON object.

    Raises
    ------
    InvalidProblem
        For an invalid line; the message names the key. `UnknownName` has the event of the line.
    """
    found = read_object(line, LINE)
    z = found.get("z")
    if len(found) == 2 and type(z) is list:
        return Message(_event(found), _values(z, site), {}, whole=True)  # the most frequent form of values
    station, time = found.get("station"), found.get("time_ns")
    if len(found) == 3 and type(time) is int and abs(time) < _LATEST // 1000 and type(station) is str:
        number = site.number.get(station, -1)  # the most frequent form of arrivals
        if number >= 0 and site.arrival_rows:
            return Message(_event(found), {}, {number: 1000 * time}, whole=False)
    return _general(found, site)


def _general(found: dict[str, Any], site: Site) -> Message:
    """Return the content of a line with any permitted keys; errors as in `parse`."""
    unknown = found.keys() - KEYS
    if unknown:
        name = min(unknown)
        raise InvalidProblem(f"unknown key {name[:40]!r}", None, nearest(name, sorted(KEYS)))
    if "command" in found:
        command = found["command"]
        if command not in COMMANDS:
            raise InvalidProblem(f"unknown command {str(command)[:40]!r}", "command", f"use {' or '.join(COMMANDS)}")
        return Message("", {}, {}, whole=False, command=command)
    event = full_name(_text(found["client"], "client") if "client" in found else "", _event(found))
    target = _text(found["target"], "target") if "target" in found else ""
    forms: list[str] = [key for key in ("rows", "arrivals", "station", "kind") if key in found]
    forms += ["z"] if "z" in found and "kind" not in found else []
    if len(forms) != 1 and forms != ["rows", "arrivals"]:
        what = f"the line has {' and '.join(forms)}" if forms else "the line has no rows"
        raise InvalidProblem(what, None, "give one of z, rows, arrivals, station, kind")
    more = found.get("more", forms[0] in ("station", "kind"))
    if type(more) is not bool:
        raise InvalidProblem("the value is neither true nor false", "more", "send true if more rows will come")
    try:
        rows, sigmas, times = _named(found, forms, site)
    except UnknownName as error:
        error.event, error.whole = event, not more
        raise
    return Message(event, rows, times, not more, sigmas or None, target, when=_when(found, forms))


def with_reading_time(data: bytes, received: float) -> bytes:
    """Return a valid line with its time of reading, s, as the first key: the form of a recording."""
    if b'"received"' in data:  # a line of a recording that is read again
        found = read_object(data, LINE)
        found.pop("received", None)
        data = json.dumps(found).encode()
    return b'{"received":%.6f,' % received + data[1:]


def of_client(line: bytes, client: str | None) -> bytes:
    """Return a line with the name of its client as its first key; a line that is no object is returned unchanged."""
    data = line.strip()
    if not client or data[:1] != b"{" or data[1:].lstrip()[:1] != b'"':
        return line
    return b'{"client":%s,' % json.dumps(client).encode() + data[1:]


# Clients may use the same ids. A line feed joins client and id, because no name may contain one.


def full_name(client: str, event: str) -> str:
    """Return the name of an event of a client within a stream; the id itself without a client."""
    return f"{client}\n{event}" if client else event


def name_keys(name: str) -> dict[str, str]:
    """Return the keys of an event for answers: its id, and its client if it has one."""
    client, _, event = name.rpartition("\n")
    return {"event": event, "client": client} if client else {"event": event}


def _named(
    found: dict[str, Any], forms: list[str], site: Site
) -> tuple[dict[Key, float], dict[Key, float], dict[int, int]]:
    """Return the values, the standard deviations and the arrivals of a line, by row or station.

    `found` is the line. `forms` are the keys under which the line has data: "rows", "arrivals", "z", "station" or
    "kind". Values and standard deviations are in the units of the site, arrivals in picoseconds.
    """
    rows, sigmas, times = dict[Key, float](), dict[Key, float](), dict[int, int]()
    if "rows" in forms:
        for entry in _list(found["rows"], "rows"):
            _row(_object(entry, ROW_KEYS, "rows"), site, rows, sigmas)
    if "arrivals" in forms:
        for entry in _list(found["arrivals"], "arrivals"):
            _arrival(_object(entry, {"station", *_DIGITS}, "arrivals"), site, times)
    if "z" in forms:
        rows = _values(_list(found["z"], "z"), site)
    elif "station" in forms:
        _arrival(found, site, times)
    elif "kind" in forms:
        _row(found, site, rows, sigmas)
    return rows, sigmas, times


def _event(found: Mapping[str, Any]) -> str:
    """Return the id of the event of a line; a whole number becomes text."""
    if "event" not in found:
        raise InvalidProblem("the line has no event", None, 'give each line an id: "event": "1"')
    name = found["event"]
    return str(name) if type(name) is int and abs(name) < _LATEST else _text(name, "event")


def _text(given: Any, key: str) -> str:
    """Return a name under `key`; raise InvalidProblem for other values, such as text with control characters."""
    if type(given) is not str or not given or len(given) > NAME or _BREAKS.search(given) or has_controls(given):
        raise InvalidProblem(f"{str(given)[:40]!r} is not a name", key, f"give 1 to {NAME} printable characters")
    return given


def _when(found: Mapping[str, Any], forms: list[str]) -> int | None:
    """Return the time of an event in picoseconds; None if the line has no time, or only the time of its arrival."""
    given = [key for key in _DIGITS if key in found]
    if forms == ["station"] or not given:
        return None
    if len(given) > 1:
        raise InvalidProblem(f"the line has {' and '.join(given)}", given[0], "give one of them")
    value = found[given[0]]
    if type(value) is float:  # for a track, a float is precise enough (0.25 us); for an arrival it is not
        value = round(_number(value, given[0]) * 10.0 ** _DIGITS[given[0]])
        if abs(value) >= _LATEST:
            raise _beyond_clocks(found[given[0]], given[0])
        return value
    return picoseconds(value, given[0])


def _list(given: Any, key: str) -> list[Any]:
    """Return a list of 1 to 4096 entries under `key`; raise InvalidProblem for other values."""
    if type(given) is not list or not 0 < len(given) <= ROWS:
        raise InvalidProblem(f"the value is not a list of 1 to {ROWS} entries", key, "give a list")
    return given


def _object(given: Any, keys: set[str], where: str) -> dict[str, Any]:
    """Return an entry as an object that has only the permitted `keys`; raise InvalidProblem with `where` otherwise."""
    if type(given) is not dict:
        raise InvalidProblem(
            "an entry is not an object", where, f"give objects with the keys {', '.join(sorted(keys))}"
        )
    unknown = given.keys() - keys
    if unknown:
        name = min(unknown)
        raise InvalidProblem(f"unknown key {name[:40]!r}", where, nearest(name, sorted(keys)))
    return given


def _number(given: Any, where: str) -> float:
    """Return a finite number of permitted size as a float; raise InvalidProblem with the key `where` otherwise."""
    # in Python, true is an integer, and an integer of 400 digits is not a float
    if type(given) is float or (type(given) is int and abs(given) <= LARGEST):
        value = float(given)
        if abs(value) <= LARGEST:
            return value
    raise InvalidProblem(f"{str(given)[:40]} is not a number up to {LARGEST:g}", where, "give a number")


def _values(given: list[Any], site: Site) -> dict[Key, float]:
    """Return the values of the key "z" by row of the template; null values are left out."""
    if len(given) != len(site.rows):
        what = f"there are {len(given)} values, but the site has {len(site.rows)} rows"
        raise InvalidProblem(what, "z", "give values in the order of the file, null for missing values")
    return {i: _number(value, "z") for i, value in enumerate(given) if value is not None}


def _row(found: Mapping[str, Any], site: Site, rows: dict[Key, float], sigmas: dict[Key, float]) -> None:
    """Add the value of one row to `rows`, and the standard deviation, if given, to `sigmas`.

    `found` is the entry of the row, with the keys kind, a, b, z and sigma. Raise InvalidProblem for an invalid entry,
    or for a second value of a row.
    """
    if "z" not in found:
        raise InvalidProblem("a row has no value", "z", "give a number")
    words = [found.get(key, "") for key in ("kind", "a", "b")]
    if any(type(word) is not str for word in words):
        raise InvalidProblem("kind, a and b are names", "rows", "put them in quotes")
    key = site.find(words[0], words[1], words[2])
    value = _number(found["z"], "z")
    if rows.setdefault(key, value) != value:
        raise InvalidProblem("the line has a row twice", "rows", "send it once")
    if "sigma" in found:
        sigma = _number(found["sigma"], "sigma")
        if sigma <= 0.0:
            raise InvalidProblem(f"the standard deviation {sigma:g} is not positive", "sigma", "give a positive number")
        sigmas[key] = sigma


def _arrival(found: Mapping[str, Any], site: Site, times: dict[int, int]) -> None:
    """Add one arrival to `times`, picoseconds by station number.

    `found` is the entry of the arrival. Raise InvalidProblem for an invalid entry, or for a second time of a station.
    """
    station = found.get("station")
    if not site.arrival_rows:
        what = "the site has neither toa nor tdoa rows, so it cannot use arrivals"
        raise InvalidProblem(what, "station", "send values: kind, a, b, z")
    if type(station) is not str or station not in site.number:
        raise no_station(str(station)[:40], "station", site.number, UnknownName)
    given = [key for key in _DIGITS if key in found]
    if len(given) != 1:
        raise InvalidProblem("an arrival needs one time", "station", "give time_ns, time_ps or time")
    value, number = picoseconds(found[given[0]], given[0]), site.number[station]
    if times.setdefault(number, value) != value:
        raise InvalidProblem(f"station {station!r} has two arrivals", "arrivals", "send one arrival")


def rows_and_arrivals(
    rows: Sequence[Mapping[str, Any]], arrivals: Sequence[Mapping[str, Any]], site: Site
) -> tuple[dict[Key, float], dict[Key, float], dict[int, int]]:
    """Return values, standard deviations and arrivals of the entries of a line; errors as in `parse`."""
    values, sigmas, times = dict[Key, float](), dict[Key, float](), dict[int, int]()
    for entry in rows:
        _row(entry, site, values, sigmas)
    for entry in arrivals:
        _arrival(entry, site, times)
    return values, sigmas, times


def name_under(key: str, given: Any) -> str:
    """Return the name under a key; raise InvalidProblem for an invalid name."""
    return _text(given, key)


def full_name_under(key: str, given: Any) -> str:
    """Return the name of an event under a key, as `full_name` returns it; raise InvalidProblem for an invalid name."""
    parts = given.split("\n") if type(given) is str else [given]
    if len(parts) == 2:
        return full_name(_text(parts[0], key), _text(parts[1], key))
    return _text(given, key)


def picoseconds(given: Any, key: str) -> int:
    """Return a time as picoseconds, from an integer, or from a decimal number in quotes.

    `given` is the time in the unit of `key`: "time" (seconds), "time_ns" or "time_ps". Digits below a picosecond (0.3
    mm) are cut. Raise InvalidProblem for other values, since a float of seconds since 1970 only resolves 70 m.
    """
    digits = _DIGITS[key]
    if type(given) is int and abs(given) < _LATEST:
        value: int = given * 10**digits
    elif type(given) is str and (match := _DECIMAL.fullmatch(given)):
        sign, whole, part = match.groups()
        value = int(whole) * 10**digits + int(((part or "") + "0" * digits)[:digits] or "0")
        value = -value if sign == "-" else value
    else:
        advice = "send a whole number as time_ns or time_ps, or a decimal number in quotes"
        raise InvalidProblem(f"{str(given)[:40]} is not an exact time", key, advice)
    if abs(value) >= _LATEST:
        raise _beyond_clocks(given, key)
    return value


def _beyond_clocks(given: Any, key: str) -> InvalidProblem:
    """Return the error for a time under `key` that no clock has; its unit is probably wrong."""
    return InvalidProblem(f"the time {str(given)[:40]} is out of range", key, "check its unit")
