"""Measurements of `optloc.locate`, assigned to stations or, for time differences, to pairs of stations.

Accepted forms: mappings, arrays, series, and data frames with a column for each station or a row for each value. In the
functions, `word` is the name of the argument of `locate`, such as "tdoa". `names` are the names of the stations, and
`reference` is the station to which time differences refer. In shapes, m is the number of values of an epoch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from optloc.base.cache import Cache
from optloc.base.errors import InvalidProblem, no_station
from optloc.base.types import Array
from optloc.files.columns import roles, stem, unit_of
from optloc.files.roles import WORDS
from optloc.models import MODELS


class Argument(NamedTuple):
    """A measurement argument of `locate`: its kind, the unit of plain numbers, and a noun for messages."""

    kind: str
    unit: str
    noun: str


ARGUMENTS = {
    "toa": Argument("toa", "s", "times of arrival"),
    "tdoa": Argument("tdoa", "s", "time differences"),
    "p": Argument("toa", "s", "P picks"),
    "s": Argument("toa", "s", "S picks"),
    "ranges": Argument("range", "m", "ranges"),
    "pseudoranges": Argument("toa", "m", "pseudoranges"),
    "bearings": Argument("azimuth", "deg", "bearings"),
    "elevations": Argument("elevation", "deg", "elevations"),
}
# Arguments whose values may be dates.
_DATED = ("toa", "p", "s")
# Station pairs of the last 256 sets of values.
_ENDS = Cache[list[tuple[int, int]]](256)


class RowLabels(NamedTuple):
    """Labels of the epochs of a data frame.

    values: one label for each epoch. names: names of the labels, such as the name of the index; None for no name.
    """

    values: list[Any]
    names: tuple[Any, ...]


class StationValues(NamedTuple):
    """Values of an argument.

    values: values (..., m), in the unit given. keys: the station, or the pair of stations, of each value. unit: the
    unit in a column name, or None. labels: the labels of the epochs, or None.
    """

    values: Array
    keys: list[Any]
    unit: str | None = None
    labels: RowLabels | None = None


def station_values(word: str, given: Any, names: Sequence[str], reference: str | None) -> StationValues:
    """Return the values of an argument `given`, with the numbers of the stations of each value as keys.

    A key is (station, -1), or a pair of numbers for time differences. `reference` None means the first station. Values
    of the reference station relative to itself are left out. Raise InvalidProblem for other forms of values.
    """
    if reference is not None and reference not in names:
        raise no_station(reference, "reference", names)
    first = names[0] if reference is None else reference
    given = _with_names(given)
    if hasattr(given, "columns") and hasattr(given, "index"):
        found = _of_table(word, given, names, first)
    elif hasattr(given, "index") and hasattr(given, "to_numpy"):
        found = StationValues(_numbers(word, given.to_numpy()), list(given.index))
    elif isinstance(given, Mapping) and given and {*map(type, given.values())} <= {int, float}:
        found = StationValues(_numbers(word, [*given.values()]), list(given))
    elif isinstance(given, Mapping):
        columns = [_numbers(word, value) for value in given.values()]
        if len({np.shape(column) for column in columns}) > 1:
            raise InvalidProblem(
                "some stations have more values than others",
                word,
                "give equal numbers of values, NaN for missing values",
            )
        if any(column.dtype.kind == "M" for column in columns):
            columns = [column if column.dtype.kind == "M" else _no_dates(word, column) for column in columns]
        found = StationValues(np.stack(columns, axis=-1) if columns else np.zeros(0), list(given))
    else:
        values, keys = _numbers(word, given), list(names)
        # An array of time differences may leave out the reference, whose difference is zero.
        if word == "tdoa" and values.ndim and values.shape[-1] == len(names) - 1:
            keys.remove(first)
        if values.ndim == 0 or values.shape[-1] != len(keys):
            what = f"{values.shape[-1] if values.ndim else 1} values for {len(names)} stations"
            raise InvalidProblem(what, word, "give one for each station, NaN for missing values, or name: value")
        found = StationValues(values, keys)
    if not found.keys:
        raise InvalidProblem("there are no values", word, "give name: value")
    ends = _ENDS.call(_all_ends, word, found.keys, names, first)
    kept = [i for i, (a, b) in enumerate(ends) if a != b]  # the difference of the reference to itself is always zero
    if not kept:
        raise InvalidProblem("the only station is the reference", word, "give the other stations")
    return found._replace(values=found.values[..., kept], keys=[ends[i] for i in kept])


def _with_names(given: Any) -> Any:
    """Return a structured array as a mapping, and tables of polars, pyarrow and xarray as pandas objects.

    These types name the stations of their values. As plain arrays, they would be read in the order of the stations.
    """
    fields = getattr(getattr(given, "dtype", None), "names", None)
    if fields:
        return {name: given[name] for name in fields}
    return given.to_pandas() if hasattr(given, "to_pandas") else given


def _all_ends(word: str, keys: Sequence[Any], names: Sequence[str], reference: str) -> list[tuple[int, int]]:
    """Return the station numbers of each key, as `_ends`."""
    return [_ends(word, key, names, reference) for key in keys]


def _ends(word: str, key: Any, names: Sequence[str], reference: str) -> tuple[int, int]:
    """Return the station numbers of a key; the second number is -1 for a single station.

    A key of time differences is a pair, text such as "B-A", or one station, which is relative to `reference`.
    """
    pair = key if isinstance(key, tuple) else (key,)
    if word == "tdoa" and len(pair) == 1 and str(key) not in names:
        cut = [(str(key)[:i], str(key)[i + 1 :]) for i, sign in enumerate(str(key)) if sign == "-"]
        pair = next((each for each in cut if set(each) <= set(names)), pair)
    if word == "tdoa" and len(pair) == 1:
        pair = (pair[0], reference)
    if len(pair) != (2 if word == "tdoa" else 1):
        raise InvalidProblem(f"{key!r} does not name a measurement", word, "use the name of a station")
    unknown = [str(name) for name in pair if str(name) not in names]
    if unknown:
        raise no_station(unknown[0], word, names)
    one, *other = (names.index(str(name)) for name in pair)
    return one, other[0] if other else -1


def _named(word: str, columns: Sequence[Any], names: Sequence[str], reference: str) -> list[Any]:
    """Return the columns of a data frame that are named after stations or pairs of stations, a part of `columns`."""
    found = []
    for column in columns:
        try:
            _ends(word, column, names, reference)
        except InvalidProblem:
            continue
        found.append(column)
    return found


def _wide(word: str, frame: Any, names: Sequence[str], reference: str) -> StationValues:
    """Return the values of a data frame with one column for each station or pair; raise InvalidProblem otherwise."""
    columns = list(frame.columns)
    for column in columns:
        try:
            _ends(word, column, names, reference)
        except InvalidProblem as error:
            advice = f"{error.advice}; drop columns without {ARGUMENTS[word].noun}"
            raise InvalidProblem(error.what, f"{word}, column {column!r}", advice) from None
    # Select columns by number, since two columns may have the same name.
    values = [_numbers(word, frame.iloc[:, i].to_numpy()) for i in range(len(columns))]
    return StationValues(np.stack(values, axis=-1), columns, labels=RowLabels(list(frame.index), (*frame.index.names,)))


def _of_table(word: str, frame: Any, names: Sequence[str], reference: str) -> StationValues:
    """Return the values of a data frame: one column for each station, or one row for each value.

    With one row for each value, the columns have the station, the value, and optionally the epoch; the result has one
    row for each epoch. Raise InvalidProblem for a table without these columns, or with two values of one station.
    """
    columns = list(frame.columns)
    # `wide` has the columns that are named after stations. If all columns are, the table has one column per station.
    wide = _named(word, columns, names, reference)
    if wide and len(wide) == len(columns):
        return _wide(word, frame, names, reference)
    stems = {stem(str(name)): name for name in reversed(list(frame.columns))}
    kind = ARGUMENTS[word].kind
    value_words = [*WORDS["z"].split(), *(stem(each) for each in (word, word.rstrip("s"), kind, *MODELS[kind].aliases))]
    value_words += ["time", "timestamp"] if word in _DATED else []
    chosen = {
        role: next((stems[each] for each in words if each in stems), None)
        for role, words in (("a", WORDS["a"].split()), ("b", WORDS["b"].split()), ("z", value_words))
    }
    # A tidy table has one row for each value: columns for station and value, and no other column named after a station.
    tidy = None not in (chosen["a"], chosen["z"]) and {*wide} <= {*chosen.values()}
    if wide and not tidy:
        return _wide(word, frame, names, reference)
    for role, text in (("a", "station"), ("z", "value")):
        if chosen[role] is None:
            listed = ", ".join(str(name) for name in columns)
            advice = "name the columns after stations, or use the columns station and value"
            if {str(label) for label in frame.index} <= {*names}:
                advice = "the rows are the stations: give the transposed frame, .T"
            raise InvalidProblem(f"no column is a {text}; there are {listed}", word, advice)
    # The words of tables; a column of times has the values of `toa`, and labels the rows of other arguments.
    epoch_words = ("epoch", *roles()["message"].names, *(() if word in _DATED else ("time", "timestamp")))
    epochs = next((stems[each] for each in epoch_words if each in stems), None)
    ends = [str(name) for name in frame[chosen["a"]]]
    if word == "tdoa" and chosen["b"] is not None:
        ends = list(zip(ends, (str(name) for name in frame[chosen["b"]]), strict=True))  # type: ignore[arg-type]
    labels = [None] * len(ends) if epochs is None else frame[epochs].tolist()
    keys, rows = ({one: i for i, one in enumerate(dict.fromkeys(each))} for each in (ends, labels))
    values = _numbers(word, frame[chosen["z"]].to_numpy())
    # Values that the table does not have stay NaN, or NaT (no date) for dates.
    grid = np.full(
        (len(rows), len(keys)),
        np.datetime64("NaT") if values.dtype.kind == "M" else np.nan,
        dtype=values.dtype if values.dtype.kind == "M" else float,
    )
    seen: set[tuple[int, int]] = set()
    # Subtract the minimum from integer times of arrival, so that recent times in nanoseconds keep their digits as
    # floats. Only times of arrival have an origin that does not matter.
    values = values - values.min() if word == "toa" and values.dtype.kind in "iu" else values
    for value, key, label in zip(values, ends, labels, strict=True):
        place = (rows[label], keys[key])
        if place in seen:
            what = f"{key} has two values" + ("" if label is None else f" at {label}")
            raise InvalidProblem(what, word, "remove one of them, or add a column epoch")
        seen.add(place)
        grid[place] = value
    named = unit_of(str(chosen["z"]), ("s", "ms", "us", "ns", "ps", "m", "km", "cm", "mm", "ft", "deg", "rad"))
    named_rows = None if epochs is None else RowLabels(list(rows), (epochs,))
    return StationValues(grid if epochs is not None else grid[0], list(keys), named, named_rows)


def _no_dates(word: str, values: Array) -> Array:
    """Return missing dates instead of missing numbers; raise InvalidProblem if any value is a number.

    The other stations have dates, so a station without dates needs missing dates in its column.
    """
    if not np.isnan(values).all():
        raise InvalidProblem("some times are dates, and others are numbers", word, "give only dates or only numbers")
    return np.full(values.shape, np.datetime64("NaT", "ns"))


def _numbers(word: str, values: Any) -> Array:
    """Return values as an array of numbers or dates; None becomes NaN.

    Raise InvalidProblem for other values, and for dates that are not times of arrival.
    """
    try:
        array = np.asarray(values)
        if array.dtype.kind in "OSU":
            array = np.where(array == None, np.nan, array).astype(float)  # noqa: E711  (elementwise)
    except (TypeError, ValueError):
        array = np.zeros(0, dtype=bool)
    if array.dtype.kind not in "iufM" or (array.dtype.kind == "M" and word not in _DATED):
        raise InvalidProblem("these are not numbers", word, "give numbers, NaN for missing values")
    return array
