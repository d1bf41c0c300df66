"""Columns of a wide table that are named like those of receivers, but after a station that does not exist."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from typing import NamedTuple

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.units import UNITS
from optloc.files.columns import any_unit, bare, is_sigma, role_of, tokens
from optloc.files.readings import Named, quoted
from optloc.files.table import Table

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
        if column in others or any(map(is_sigma, tokens(bare(column)))):
            continue
        name = next((found for each in patterns if (found := _name_in(column, each, stations))), None)
        if name is not None and _holds_numbers(table, column):
            advice = f"{nearest(name, stations)}; --ignore {quoted(column)} leaves the column out"
            raise InvalidProblem(f"there is no station {name!r}", f"{table.source}, column {column!r}", advice)


def _pattern(one: Named) -> _Pattern:
    words, ends = tokens(bare(one.column)), [tokens(end) for end in one.ends]
    places = [_find(words, end) for end in (ends[0], ends[-1])]
    first, last = min(places), max(place + len(end) for place, end in zip(places, (ends[0], ends[-1]), strict=True))
    return _Pattern(words[:first], words[last:], len(ends), any_unit(one.column))


def _find(words: Sequence[str], part: Sequence[str]) -> int:
    """Return where a part of words begins; 0 where a name without letters and digits has none."""
    return next((i for i in range(len(words)) if words[i : i + len(part)] == part), 0) if part else 0


def _name_in(column: str, pattern: _Pattern, stations: Sequence[str]) -> str | None:
    """Return what stands in the place of a station in the name of a column; None where it is named otherwise."""
    text = bare(column)
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
