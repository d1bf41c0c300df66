"""Report on how a table was read: the role of each column, and errors for unused columns that may be measurements.

A sort of readings is a measurement kind in one form, such as arrivals or S minus P times. `hints` has the options.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from typing import NamedTuple

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.types import Array
from optloc.base.units import UNITS
from optloc.files.columns import any_unit, is_sigma, role_of, tokens, without_unit
from optloc.files.roles import ColumnPlaces, Roles, check_column_hints, place_roles
from optloc.files.table import Table
from optloc.files.table_import import (
    CARTESIAN,
    COMPASS,
    COUNTER,
    ColumnHints,
    Named,
    Readings,
    name_of_stations,
    quoted,
    sort_named,
    unused_measurement,
)
from optloc.files.words import numbered

# Largest number of column names in one line of the report.
_MAX_NAMES = 4
# Description of azimuths for each convention.
_ORIENTED = {
    COMPASS: "compass bearings",
    CARTESIAN: "angles from the x axis",
    COUNTER: "angles from north, anticlockwise",
}


def uses_of(
    roles: Roles,
    hints: ColumnHints,
    found: Sequence[Readings],
    epochs: Mapping[str, Array],
    sigmas: Sequence[str | None],
) -> dict[str, str]:
    """Return the role of each column that is used.

    `found` has the readings of each sort. `epochs` has the columns epoch, time and target of the rows. `sigmas` is the
    stated standard deviation of each sort; None if a column of the table has it.
    """
    out = {name: one.form.kind for one in found for name in one.columns}
    # A table with one reading in each row has one column for each sort; picks may have a column for each wave.
    picks = any(one.form.value in ("sp", "picks") for one in found)
    long = picks or len(out) == len(found)
    # A column whose readings were all left out is used as well, such as the zeros of a reference station.
    out |= {name: one.form.kind for one in found for name in one.headers}
    # The roles of S minus P: columns of P and S, a column of their difference, or columns of phase and time.
    by_phase = picks and roles.find("sp") is None and not (roles.find("p") and roles.find("s"))
    wanted = ["phase"] if by_phase else ["sp"] if roles.find("sp") is not None else ["p", "s"]
    wanted = wanted if picks else []
    if long:
        wanted += ["station"]
        wanted += ["reference"] if hints.reference is None and any(one.b is not None for one in found) else []
    wanted += ["target"] if "target" in epochs else []
    timed = "time" in epochs or (not hints.still and roles.find("message") is None)
    wanted += ["message"] if "epoch" in epochs and hints.window is None else []
    wanted += ["time"] if timed or by_phase else []
    if hints.stations is None:
        wanted += ["name", *place_roles(roles)]
    for role in wanted:
        column = roles.find(role)
        for part in () if column is None else column.split("+"):
            out.setdefault(part, role)
    out |= {one.heading: "heading" for one in found if one.heading is not None}
    for one, sigma in zip(found, sigmas, strict=True):
        for column in one.errors if sigma is None else ():
            out.setdefault(column, f"sigma_{one.form.kind}")
    return out


def unused_columns(
    roles: Roles, uses: Mapping[str, str], named: Sequence[Named] = (), *, lengths: bool = False
) -> list[str]:
    """Return the unused columns; raise InvalidProblem for possible measurements and for stated roles without use.

    `uses` has the role of each used column. `named` are the columns that are named after stations. With `lengths`, only
    lengths and their rates can be measurements of this table, since satellites measure no angles. The message names the
    option that leaves a column out.
    """
    check_column_hints(roles, {role for role, name in roles.by_role.items() if set(name.split("+")) <= set(uses)})
    columns = [*roles.table.columns, *roles.table.others]
    rest = [name for name in columns if name not in uses]
    forms = {one.column: one.form for one in named if one.form is not None and not one.sigma}
    for name in rest:
        what = sort_named(forms[name]).text if name in forms else unused_measurement(name, lengths)
        if what is not None:
            advice = f"--ignore {quoted(name)} leaves it out, --column ROLE={quoted(name)} states its role"
            where = f"{roles.table.source}, column {name!r}"
            raise InvalidProblem(f"the column may have a measurement ({what}) but is not used", where, advice)
    return rest


def reading_lines(
    roles: Roles,
    hints: ColumnHints,
    stations: ColumnPlaces,
    found: Sequence[Readings],
    epochs: Mapping[str, Array],
    uses: Mapping[str, str],
) -> list[tuple[str, str]]:
    """Return the interpretation of a table as lines for the user, each a keyword and a text.

    `stations` has the stations and `found` the readings of each sort. `epochs` has the columns epoch, time and target
    of the rows. `uses` has the role of each used column.
    """
    out: list[tuple[str, str]] = []
    for one in found:
        cells = one.columns
        shown = ", ".join(cells[:_MAX_NAMES]) + (
            f" and {len(cells) - _MAX_NAMES} more columns" if len(cells) > _MAX_NAMES else ""
        )
        unit = f" in {one.unit}" if one.unit != "1" else ""
        text = _ORIENTED.get(str(one.azimuth))
        text = text if one.heading is None else f"bearings from the bow, plus {one.heading}"
        ranges = one.form.kind == "toa" and one.unit not in UNITS["time"]
        text = text or ("pseudoranges, with a clock of each epoch" if ranges else one.form.text)
        out.append((one.form.kind, f"{len(one.values)} readings{unit} from {shown}: {text}"))
        if one.b is not None and one.form.kind != "range_sum":
            sign = "above 1" if one.form.quantity == "ratio" and one.unit == "1" else "positive"
            out.append(("sign", f"{sign} if the {farther_station(one)} is farther"))
    errors = {name: role.removeprefix("sigma_") for name, role in uses.items() if role.startswith("sigma_")}
    out += [("sigma", f"of {kind}, from column {name}") for name, kind in errors.items()]
    if "epoch" in epochs:
        names = [roles.find(role) for role in (("message", "time") if hints.window is None else ("time",))]
        label = next(
            (f"column {name}" for name in names if name is not None and set(name.split("+")) <= set(uses)), "row"
        )
        out.append(("epochs", f"{len(set(numbered(epochs['epoch'])[0]) - {''})} by {label}"))
    elif "time" in epochs:
        each = f"{hints.window} each" if hints.window else f"{len(np.unique(epochs['time']))}"
        out.append(("epochs", f"{each} by column {roles.find('time')}"))
    if "target" in epochs:
        out.append(("targets", f"{len(numbered(epochs['target'])[0])} by column {roles.find('target')}"))
    where = "the table itself" if hints.stations is None else name_of_stations(hints)
    axes = (
        "latitude and longitude" if stations.frame == "geodetic" else f"x and y, {stations.frame}, in {stations.unit}"
    )
    out.append(("stations", f"{len(set(stations.names))} of {where}, by {axes}"))
    return out


def farther_station(found: Readings) -> str:
    """Return the station, "first" or "second", that is farther if a difference is positive."""
    # The level at the nearer station is higher, so a positive difference of levels means that the second is farther.
    turned = (found.positive == "b-farther") != (found.form.quantity == "level")
    return "second" if turned else "first"


# Roles that columns often have in a table with a column for each receiver: time, label and true position of a row.
_AUXILIARY_ROLES = frozenset(("message", "id", "time", "target", "x", "y", "z", "lat", "lon", "height", "depth"))
# Names with words of at most two letters and equal patterns are one series, such as A1 and B7. Longer words of equal
# length, such as Lake and note, have nothing in common.
_SERIES = 2
# Similarity above which one name is a misspelling of another, such as wset of west. A similarity of one half is
# chance: squawk and Quarry.
_CLOSE = 0.75


class _Pattern(NamedTuple):
    """Name pattern of receiver columns.

    before, behind: words before and behind the stations. stations: number of stations. unit: unit at the end, or None.
    """

    before: tuple[str, ...]
    behind: tuple[str, ...]
    stations: int
    unit: str | None


def check_receivers(table: Table, uses: Mapping[str, str], named: Sequence[Named], stations: Sequence[str]) -> None:
    """Raise InvalidProblem for a column with numbers that is named like the receiver columns but has no known station.

    A column is named like them if the same words surround the name, with a unit of the same quantity. If the receiver
    columns are named by stations alone, a name counts if it is nearly a station name or continues their series. The
    message names the nearest stations and the option that leaves the column out.
    """
    used = [one for one in named if one.column in uses and not one.sigma]
    if len(used) < 2:  # one column has no pattern
        return
    patterns = dict.fromkeys(_pattern(one) for one in used)
    others = {one.column for one in named} | {*uses}
    for column in table.columns:
        if column in others or any(map(is_sigma, tokens(without_unit(column)))):
            continue
        name = next((found for each in patterns if (found := _name_in(column, each, stations))), None)
        if name is not None and _holds_numbers(table, column):
            advice = f"{nearest(name, stations)}; --ignore {quoted(column)} leaves the column out"
            raise InvalidProblem(f"there is no station {name!r}", f"{table.source}, column {column!r}", advice)


def _pattern(one: Named) -> _Pattern:
    """Return the name pattern of the column `one`, which is named after stations."""
    words, ends = tokens(without_unit(one.column)), [tokens(end) for end in one.ends]
    places = [_find(words, end) for end in (ends[0], ends[-1])]
    first, last = min(places), max(place + len(end) for place, end in zip(places, (ends[0], ends[-1]), strict=True))
    return _Pattern(words[:first], words[last:], len(ends), any_unit(one.column))


def _find(words: Sequence[str], part: Sequence[str]) -> int:
    """Return the index of the start of `part` in `words`; 0 for an empty part."""
    return next((i for i in range(len(words)) if words[i : i + len(part)] == part), 0) if part else 0


def _name_in(column: str, pattern: _Pattern, stations: Sequence[str]) -> str | None:
    """Return the part of a column name at the place of a station; None if the name does not match the pattern.

    `pattern` is the pattern of the receiver columns, and `stations` are the names of the known stations. None also
    means another column of a known station, or a name that is only by chance at this place.
    """
    text = without_unit(column)
    words, n_around = tokens(text), len(pattern.before) + len(pattern.behind)
    inner = range(len(pattern.before), len(words) - len(pattern.behind))
    if len(words) <= n_around or words[: inner.start] != pattern.before or words[inner.stop :] != pattern.behind:
        return None
    unknown_words = _without_stations(words, inner, stations)
    name = _spelled(text, unknown_words)
    same = _same_quantity(any_unit(column), pattern.unit)
    if not unknown_words or (pattern.stations == 1 and len(unknown_words) < len(inner) and not (same and pattern.unit)):
        return None  # another column of a known receiver, such as its signal level
    if _is_like(name, stations):
        return name
    if not n_around and (pattern.unit is None or role_of(column) in _AUXILIARY_ROLES):
        return None
    # A single name may lack the unit.
    unit_omitted = n_around > 0 and any_unit(column) is None and role_of(name) not in _AUXILIARY_ROLES
    return name if same or unit_omitted else None


def _without_stations(words: Sequence[str], inner: range, stations: Sequence[str]) -> list[int]:
    """Return the indices of the words in the range `inner` that belong to no known station."""
    known = sorted((tokens(name) for name in stations if tokens(name)), key=len, reverse=True)
    unknown_words, at = [], inner.start
    while at < inner.stop:
        size = next((len(name) for name in known if tuple(words[at : at + len(name)]) == name), 0)
        unknown_words += [] if size else [at]
        at += max(size, 1)
    return unknown_words


def _spelled(text: str, places: Sequence[int]) -> str:
    """Return the part of a text from the first to the last of the words with the indices `places`; empty for none."""
    spans = [match.span() for match in re.finditer(r"[^\W\d_]+|\d+", text.lower())]
    return text[spans[places[0]][0] : spans[places[-1]][1]] if places else ""


def _same_quantity(one: str | None, other: str | None) -> bool:
    """Return whether two units have the same quantity, such as "m" and "km".

    A name without a unit (None) matches only another name without a unit.
    """
    if one is None or other is None:
        return one is other
    return any(one in units and other in units for units in UNITS.values())


def _is_like(name: str, stations: Sequence[str]) -> bool:
    """Return whether a name is close to a station name, or continues the series of station names."""
    close = get_close_matches(name.lower(), [station.lower() for station in stations], n=1, cutoff=_CLOSE)
    return bool(close) or _shape(name) in {_shape(station) for station in stations} - {None}


def _shape(name: str) -> str | None:
    """Return a name with "a" for each letter and "0" for each number; None for a name with long words."""
    words: Iterable[str] = tokens(name)
    if any(word.isalpha() and len(word) > _SERIES for word in words):
        return None
    return re.sub(r"\d+", "0", re.sub(r"[^\W\d_]", "a", name.strip().lower()))


def _holds_numbers(table: Table, column: str) -> bool:
    """Return whether a cell of a column has a number."""
    for cell in table.raw(column).tolist():
        try:
            if cell is not None and not isinstance(cell, bool) and float(cell) == float(cell):
                return True
        except (TypeError, ValueError):
            continue
    return False
