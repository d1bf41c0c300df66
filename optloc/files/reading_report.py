"""How a table was read: the role of each column, and a refusal of columns that may be measurements but are not used."""

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
    quoted,
    sort_named,
    unused_measurement,
)
from optloc.files.words import numbered

# Names of columns that one line repeats of a list.
_NAMED = 4
# What azimuths of each convention are.
_ORIENTED = {
    COMPASS: "bearings of a compass",
    CARTESIAN: "angles from the x axis",
    COUNTER: "angles from north, anticlockwise",
}


def uses_of(
    roles: Roles,
    told: ColumnHints,
    found: Sequence[Readings],
    epochs: Mapping[str, Array],
    sigmas: Sequence[str | None],
) -> dict[str, str]:
    """Return the role of each column that is used.

    Parameters
    ----------
    roles : Roles
        The table.
    told : ColumnHints
        What the user says of it.
    found : sequence of Readings
        The readings, one set for each sort.
    epochs : mapping of str to array (n,)
        Columns epoch, time and target of the rows.
    sigmas : sequence of str or None
        Standard deviation of each sort, None where a column of the table has it.
    """
    out = {name: one.form.kind for one in found for name in one.columns}
    long = len(out) == len(found)
    picks = any(one.form.value == "sp" for one in found)
    # Columns of P and S, one of their difference, or one of phases with one of times: see `shapes`.
    by_phase = picks and roles.find("sp") is None and not (roles.find("p") and roles.find("s"))
    wanted = ["phase"] if by_phase else ["sp"] if roles.find("sp") is not None else ["p", "s"]
    wanted = wanted if picks else []
    if long:
        wanted += ["station"]
        wanted += ["reference"] if told.reference is None and any(one.b is not None for one in found) else []
    wanted += ["target"] if "target" in epochs else []
    timed = "time" in epochs or (not told.still and roles.find("message") is None)
    wanted += ["message"] if "epoch" in epochs and told.window is None else []
    wanted += ["time"] if timed or by_phase else []
    if told.stations is None:
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
    """Return the columns that are not used; refuse those that could be measurements, and roles that are not used.

    Parameters
    ----------
    roles : Roles
        The table.
    uses : mapping of str to str
        Role of each column that is used.
    named : sequence of Named
        Columns that are called after stations.
    lengths : bool
        Whether measurements of this table are lengths and their rates: a satellite measures no angles.

    Raises
    ------
    InvalidProblem
        Naming the column, and the option that leaves it out.
    """
    check_column_hints(roles, {role for role, name in roles.by_role.items() if set(name.split("+")) <= set(uses)})
    columns = [*roles.table.columns, *roles.table.others]
    rest = [name for name in columns if name not in uses]
    forms = {one.column: one.form for one in named if one.form is not None and not one.sigma}
    for name in rest:
        what = sort_named(forms[name]).text if name in forms else unused_measurement(name, lengths)
        if what is not None:
            advice = f"--ignore {quoted(name)} leaves it out, --column ROLE={quoted(name)} names its role"
            where = f"{roles.table.source}, column {name!r}"
            raise InvalidProblem(f"it may hold a measurement ({what}) and is not used", where, advice)
    return rest


def reading_lines(
    roles: Roles,
    told: ColumnHints,
    place: ColumnPlaces,
    found: Sequence[Readings],
    epochs: Mapping[str, Array],
    uses: Mapping[str, str],
) -> list[tuple[str, str]]:
    """Return how a table was read, for a person to check: a word, and what it means for this table."""
    out: list[tuple[str, str]] = []
    for one in found:
        cells = one.columns
        shown = ", ".join(cells[:_NAMED]) + (f" and {len(cells) - _NAMED} more columns" if len(cells) > _NAMED else "")
        unit = f" in {one.unit}" if one.unit != "1" else ""
        text = _ORIENTED.get(str(one.azimuth))
        text = text if one.heading is None else f"bearings from the bow, plus {one.heading}"
        ranges = one.form.kind == "toa" and one.unit not in UNITS["time"]
        text = text or ("pseudoranges, with a clock of each epoch" if ranges else one.form.text)
        out.append((one.form.kind, f"{len(one.values)} readings{unit} from {shown}: {text}"))
        if one.b is not None and one.form.kind != "range_sum":
            sign = "above 1" if one.form.quantity == "ratio" and one.unit == "1" else "positive"
            out.append(("sign", f"{sign} where the {farther_station(one)} is farther"))
    errors = {name: role.removeprefix("sigma_") for name, role in uses.items() if role.startswith("sigma_")}
    out += [("sigma", f"of {kind}, from column {name}") for name, kind in errors.items()]
    if "epoch" in epochs:
        names = [roles.find(role) for role in (("message", "time") if told.window is None else ("time",))]
        label = next(
            (f"column {name}" for name in names if name is not None and set(name.split("+")) <= set(uses)), "row"
        )
        out.append(("epochs", f"{len(set(numbered(epochs['epoch'])[0]) - {''})} by {label}"))
    elif "time" in epochs:
        each = f"{told.window} each" if told.window else f"{len(np.unique(epochs['time']))}"
        out.append(("epochs", f"{each} by column {roles.find('time')}"))
    if "target" in epochs:
        out.append(("targets", f"{len(numbered(epochs['target'])[0])} by column {roles.find('target')}"))
    where = told.stations.name if told.stations is not None else "the table itself"
    axes = "latitude and longitude" if place.frame == "geodetic" else f"x and y, {place.frame}, in {place.unit}"
    out.append(("stations", f"{len(set(place.names))} of {where}, by {axes}"))
    return out


def farther_station(found: Readings) -> str:
    """Return which station is farther where a difference is positive, "first" or "second"."""
    # The level at the nearer station is higher, so a positive difference of levels has the farther station second.
    turned = (found.positive == "b-farther") != (found.form.quantity == "level")
    return "second" if turned else "first"


# Roles that a column beside those of receivers has as a rule: when a row was taken, of what, and where that truly was.
_BESIDE = frozenset(("message", "id", "time", "target", "x", "y", "z", "lat", "lon", "height", "depth"))
# Letters up to which names with the same numbers of letters and digits are of one series, such as A1 and B7: longer
# words of equal length, such as Lake and note, have nothing in common.
_SERIES = 2
# Share of equal letters from which a name is a misspelt one: that of wset and west. Half of them are chance: squawk
# and Quarry.
_CLOSE = 0.75


class _Pattern(NamedTuple):
    """How columns of receivers are named: words before and behind the stations, how many stations, and the unit."""

    before: tuple[str, ...]
    behind: tuple[str, ...]
    stations: int
    unit: str | None


def check_receivers(table: Table, uses: Mapping[str, str], named: Sequence[Named], stations: Sequence[str]) -> None:
    """Refuse a column that is named like the columns of receivers and holds numbers, but names no station.

    A column is named like them where the same words stand around a name, with a unit of the same quantity; or, where
    their names are nothing but those of stations, if its name is nearly one of these or continues their series.

    Parameters
    ----------
    table : Table
        A table with a column for each receiver or pair; others pass.
    uses : mapping of str to str
        Role of each column that is used.
    named : sequence of Named
        Columns that are called after stations.
    stations : sequence of str
        Names of the stations.

    Raises
    ------
    InvalidProblem
        Naming the column, the nearest stations, and the option that leaves the column out.
    """
    used = [one for one in named if one.column in uses and not one.sigma]
    if len(used) < 2:
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
    words, ends = tokens(without_unit(one.column)), [tokens(end) for end in one.ends]
    places = [_find(words, end) for end in (ends[0], ends[-1])]
    first, last = min(places), max(place + len(end) for place, end in zip(places, (ends[0], ends[-1]), strict=True))
    return _Pattern(words[:first], words[last:], len(ends), any_unit(one.column))


def _find(words: Sequence[str], part: Sequence[str]) -> int:
    """Return where a part of words begins; 0 where a name without letters and digits has none."""
    return next((i for i in range(len(words)) if words[i : i + len(part)] == part), 0) if part else 0


def _name_in(column: str, pattern: _Pattern, stations: Sequence[str]) -> str | None:
    """Return what stands in the place of a station in the name of a column; None where it is named otherwise."""
    text = without_unit(column)
    words, around = tokens(text), len(pattern.before) + len(pattern.behind)
    inner = range(len(pattern.before), len(words) - len(pattern.behind))
    if len(words) <= around or words[: inner.start] != pattern.before or words[inner.stop :] != pattern.behind:
        return None
    left = _without_stations(words, inner, stations)
    name = _spelled(text, left)
    same = _same_quantity(any_unit(column), pattern.unit)
    if not left or (pattern.stations == 1 and len(left) < len(inner) and not (same and pattern.unit)):
        return None  # a further column of a known receiver, such as its signal level
    if _is_like(name, stations):
        return name
    if not around and (pattern.unit is None or role_of(column) in _BESIDE):
        return None
    # The unit may be missing in one name among many.
    forgotten = around > 0 and any_unit(column) is None and role_of(name) not in _BESIDE
    return name if same or forgotten else None


def _without_stations(words: Sequence[str], inner: range, stations: Sequence[str]) -> list[int]:
    """Return the places of words that belong to no known station."""
    known = sorted((tokens(name) for name in stations if tokens(name)), key=len, reverse=True)
    left, at = [], inner.start
    while at < inner.stop:
        size = next((len(name) for name in known if tuple(words[at : at + len(name)]) == name), 0)
        left += [] if size else [at]
        at += max(size, 1)
    return left


def _spelled(text: str, places: Sequence[int]) -> str:
    """Return the words of a text at some places as they are written, with what is between them."""
    spans = [match.span() for match in re.finditer(r"[^\W\d_]+|\d+", text.lower())]
    return text[spans[places[0]][0] : spans[places[-1]][1]] if places else ""


def _same_quantity(one: str | None, other: str | None) -> bool:
    """Return whether two units measure the same; no unit measures the same as no unit."""
    if one is None or other is None:
        return one is other
    return any(one in units and other in units for units in UNITS.values())


def _is_like(name: str, stations: Sequence[str]) -> bool:
    """Return whether a name is nearly that of a station, or of their series."""
    close = get_close_matches(name.lower(), [station.lower() for station in stations], n=1, cutoff=_CLOSE)
    return bool(close) or _shape(name) in {_shape(station) for station in stations} - {None}


def _shape(name: str) -> str | None:
    """Return a name with one sign for all letters and one for all numbers; None for one with long words."""
    words: Iterable[str] = tokens(name)
    if any(word.isalpha() and len(word) > _SERIES for word in words):
        return None
    return re.sub(r"\d+", "0", re.sub(r"[^\W\d_]", "a", name.strip().lower()))


def _holds_numbers(table: Table, column: str) -> bool:
    """Return whether a cell of a column holds a number."""
    for cell in table.raw(column).tolist():
        try:
            if cell is not None and not isinstance(cell, bool) and float(cell) == float(cell):
                return True
        except (TypeError, ValueError):
            continue
    return False
