"""Readings of a measurement table: sort and unit of the readings, missing readings and repeats.

A reading is one measured value of a table. A sort of readings is a measurement kind in one form, such as arrivals. In
the functions, `hints` has the options of the command line. In shapes, m is the number of readings.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.types import Array
from optloc.base.units import UNITS
from optloc.files.cell_text import NOTHING, Decimals
from optloc.files.columns import any_unit, is_sigma, role_of, sigma_kind, stem, tokens, unit_of, without_unit
from optloc.files.roles import Roles
from optloc.files.table import Table
from optloc.files.wave_speed import WaveOptions
from optloc.models import MODELS, kind_named


class NoReading(InvalidProblem):
    """A table whose readings are all missing."""


@dataclass(frozen=True, slots=True)
class Form:
    """A sort of readings in tables.

    Parameters
    ----------
    kind : str
        Measurement kind of the reading in a problem.
    value : str
        Role of its column.
    text : str
        Description of the readings.
    """

    kind: str
    value: str
    text: str

    @property
    def stations(self) -> int:
        """Return the number of stations of a reading."""
        return MODELS[self.kind].stations

    @property
    def quantity(self) -> str:
        """Return the quantity of its values."""
        return MODELS[self.kind].quantity


_SPECIAL_FORMS = {
    "arrivals": Form("toa", "toa", "arrival times"),
    "times": Form("toa", "time", "arrival times"),
    "excess": Form("range_sum", "excess", "paths by way of the target, in excess of the direct path"),
    "picks": Form("toa", "picks", "arrivals of P and S waves"),
    "sp": Form("range", "sp", "times from P to S of an earthquake, as ranges"),
}


def sort_named(name: str) -> Form:
    """Return a sort of reading by name: a special form, such as "times" (arrivals in the time column), or a kind."""
    return _SPECIAL_FORMS[name] if name in _SPECIAL_FORMS else Form(name, name, MODELS[name].summary)


# Kinds that a column name can suggest, in the order of the sections of a problem file.
_KINDS_BY_NAME = ("tdoa", "range", "range_sum", "azimuth", "elevation", "range_rate", "fdoa", "groa", "rss_difference")
# Numbers that programs write for a missing reading.
_MISSING_VALUES = tuple(map(Decimal, (0, -1, *(sign * (10**n - 1) for n in (2, 3, 4, 5, 6, 9) for sign in (1, -1)))))
# Names that without a unit can mean an angle or a height.
_ANGLE_OR_HEIGHT = ("elevation", "elev")
# Names with at most this number of letters, such as d, r and el, have many other uses.
_LETTERS = 2
# A full turn in radians: larger angles are in degrees.
_TURN = 6.2832
COMPASS, CARTESIAN = "north-clockwise", "east-counterclockwise"
COUNTER, BOW = "north-counterclockwise", "bow-clockwise"
CONVENTIONS = (COMPASS, CARTESIAN, COUNTER, BOW)
"""Conventions of azimuths in tables: as in a problem file, or relative to the bow of a vehicle."""


@dataclass(frozen=True, slots=True)
class ColumnHints:
    """Facts about a table that the table does not contain; each is an option of the command line.

    Parameters
    ----------
    stations : Path or Table, optional
        Station positions: a file (CSV, Parquet, JSON or GeoJSON) or its table. With orbits: the file of the fixed
        stations.
    sigma : str, optional
        Standard deviation of each reading with its unit, such as "20 ns"; "estimate" finds it from many epochs; for
        several kinds "range=10 cm,azimuth=2 deg".
    what : str, optional
        Content of the table: "arrivals", "picks" (P and S), "sp" (S minus P alone), "excess" (bistatic path minus the
        direct path), "pseudoranges", "stations" or a measurement kind; by default from the column names.
    columns : mapping of str to str
        Column of each role whose name is not clear; "set+msg" joins two columns.
    ignore : tuple of str
        Columns to leave out, such as unwanted measurements.
    time_unit : str, optional
        Unit of the time column, if its name does not end in the unit.
    time_scale : str, optional
        Scale of numbers in the time column, as in a problem file: "unix", "utc", "gps", "tai" or "none".
    unit : str, optional
        Unit of the values, if the column name does not end in the unit.
    frame : "cartesian" or "ecef", optional
        Frame of stations with x, y, z; by default cartesian.
    times : Path, optional
        Table of measurements; satellite positions are computed at its times.
    missing : str, optional
        Numbers that mean no reading, such as "0,-1,9999"; "none": each number is a reading.
    average : bool
        Whether repeated readings of one measurement are averaged; by default they are rejected.
    azimuth : str, optional
        Convention of azimuths, as in a problem file, or "bow-clockwise", which is the default with a heading column.
    declination : str, optional
        Magnetic declination of bearings, east positive: "4 deg", or a date such as "2026-06-01".
    positive : str, optional
        Sign of differences, as in a problem file.
    reference : str, optional
        Reference station of differences in columns of single stations.
    vp, vs : str, optional
        Speeds of the P and S waves, such as "6 km/s". For layers, `vp` is the path of a table with the columns depth,
        vp and vs, and `vs` may be a ratio such as "vp/1.73".
    window : str, optional
        Time within which readings belong to one epoch, such as "0.1 s".
    still : bool
        Whether the target does not move, so that all readings form one epoch.
    zone : str, optional
        Time zone of dates without a zone, such as "UTC" or "Europe/Rome".
    navigation : Path, optional
        RINEX navigation file for RINEX observations or an Android log.
    system : str, optional
        Letter of the satellite system: "G", "E" or "J"; by default GPS.
    mask : str, optional
        Lowest elevation of satellites, such as "15 deg"; by default 10 degrees.
    turned : bool
        Whether satellite positions are in the Earth axes at reception; by default at transmission.
    wave : WaveOptions
        Wave speed, wind, and two-way times.
    height : str, optional
        Known height of the target for `convert`, such as "1.2 m"; several heights are separated by commas.
    """

    stations: Path | Table | None = None
    sigma: str | None = None
    what: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    ignore: tuple[str, ...] = ()
    time_unit: str | None = None
    time_scale: str | None = None
    unit: str | None = None
    frame: str | None = None
    times: Path | None = None
    missing: str | None = None
    average: bool = False
    azimuth: str | None = None
    declination: str | None = None
    positive: str | None = None
    reference: str | None = None
    vp: str | None = None
    vs: str | None = None
    window: str | None = None
    still: bool = False
    zone: str | None = None
    navigation: Path | None = None
    system: str | None = None
    mask: str | None = None
    turned: bool = False
    wave: WaveOptions = field(default_factory=WaveOptions)
    height: str | None = None


def name_of_stations(hints: ColumnHints) -> str:
    """Return the name of the file or table of the stations, for messages; empty without one."""
    given = hints.stations
    return given.source if isinstance(given, Table) else "" if given is None else given.name


@dataclass(frozen=True, slots=True)
class Readings:
    """Readings of one sort.

    Parameters
    ----------
    form : Form
        Sort of the readings.
    unit : str
        Unit of the values.
    values : Decimals
        m numbers with all their digits.
    row : int array (m,)
        Row numbers in the table.
    headers : tuple of str
        Names of columns.
    column : int array (m,)
        Index of the column of each reading in `headers`.
    a, b : object array (m,)
        Names of the stations; b for pairs only.
    positive : str
        Sign of differences.
    azimuth : str, optional
        Convention of azimuths.
    heading : str, optional
        Column of headings that the values include.
    sigma : array (m,), optional
        Standard deviations in the same unit.
    errors : tuple of str
        Columns of these standard deviations.
    notes : tuple of str
        Assumptions, and readings that were left out.
    phase : object array (m,), optional
        Wave of each pick, "P" or "S".
    dated : bool
        Whether the values are dates, in seconds since 1970.
    """

    form: Form
    unit: str
    values: Decimals
    row: Array
    headers: tuple[str, ...]
    column: Array
    a: Array
    b: Array | None = None
    positive: str = "a-farther"
    azimuth: str | None = None
    heading: str | None = None
    sigma: Array | None = None
    errors: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    phase: Array | None = None
    dated: bool = False

    def take(self, pick: Array) -> Readings:
        """Return the readings with the indices `pick`."""
        return replace(
            self,
            values=self.values.take(pick),
            row=self.row[pick],
            column=self.column[pick],
            a=self.a[pick],
            b=None if self.b is None else self.b[pick],
            sigma=None if self.sigma is None else self.sigma[pick],
            phase=None if self.phase is None else self.phase[pick],
        )

    def where(self, table: Table, item: int) -> str:
        """Return the place of the cell of a reading, for messages."""
        return table.where(self.headers[int(self.column[item])], int(self.row[item]))

    @property
    def columns(self) -> list[str]:
        """Return the columns with readings, in the order of the readings."""
        number, first = np.unique(self.column, return_index=True)
        return [self.headers[i] for i in number[np.argsort(first)].tolist()]


# Columns that are named after stations.


@dataclass(frozen=True, slots=True)
class Named:
    """A column that is named after one or two stations.

    Parameters
    ----------
    column : str
        Column name.
    form : str, optional
        Sort of reading; None if the name does not include one.
    ends : tuple of str
        The stations.
    minus : bool
        Whether the name has a minus between the two stations.
    sigma : bool
        Whether the column has standard deviations.
    """

    column: str
    form: str | None
    ends: tuple[str, ...]
    minus: bool
    sigma: bool = False


def named_columns(columns: Sequence[str], stations: Sequence[str]) -> list[Named]:
    """Return the columns of a wide table that are named after stations.

    Their names have one or two names of stations, and otherwise only words with a known meaning.
    """
    # Names with more words come first, so that a name is not taken for a shorter name inside it.
    known = sorted({tokens(name): name for name in stations if tokens(name)}.items(), key=lambda item: -len(item[0]))
    exact = {name.strip(): name for name in stations}
    found = []
    for column in columns:
        text = without_unit(column)
        ends, rest = ([exact[text]], []) if text in exact else _stations_in(tokens(text), known)
        words = [word for word in rest if word not in _ENDS and not is_sigma(word)]
        form = _form_of("".join(words), any_unit(column))
        if ends and len(ends) <= 2 and form is not None:
            has_minus = re.search(r"[-\u2212\u2013]|minus", text) is not None
            deviation = any(map(is_sigma, rest))
            found.append(Named(column, form or None, tuple(ends), len(ends) == 2 and has_minus, deviation))
    return found


# Words in column names that go with a station name.
_ENDS = frozenset("receiver rx sensor anchor node site station beacon minus at to from".split())


def _stations_in(words: tuple[str, ...], known: Sequence[tuple[tuple[str, ...], str]]) -> tuple[list[str], list[str]]:
    """Return the stations among the words of a column name, in their order, and the remaining words.

    `known` has the words and the name of each station, long names first.
    """
    ends, rest, at = [], [], 0
    while at < len(words):
        hit = next(((key, name) for key, name in known if words[at : at + len(key)] == key), None)
        if hit is None:
            rest.append(words[at])
            at += 1
        else:
            ends.append(hit[1])
            at += len(hit[0])
    return ends, rest


def _form_of(word: str, unit: str | None) -> str | None:
    """Return the sort of reading for a word with a unit: "" for no word, None for an unknown word."""
    if not word:
        return ""
    role = role_of(word if unit is None else f"{word}_{unit}")
    if role == "height" and unit is None and word in _ANGLE_OR_HEIGHT:
        return "elevation"  # a station has one height, but a different elevation angle in each row
    if role in ("toa", "time"):
        return "arrivals"
    return role if role == "sp" or role in _KINDS_BY_NAME else None


def stated_sigma(hints: ColumnHints, kind: str) -> str | None:
    """Return the standard deviation that --sigma states for a kind, or None."""
    if hints.sigma is None or "=" not in hints.sigma:
        return hints.sigma
    return sigmas_by_kind(hints.sigma).get(kind)


def sigmas_by_kind(text: str) -> dict[str, str]:
    """Return the amounts of a text such as "range=6 m,azimuth=2 deg" by kind."""
    parts = [part.partition("=") for part in text.split(",")]
    return {kind_named(word.strip(), "--sigma"): amount.strip() for word, _, amount in parts}


def holds_names(table: Table, column: str, stations: Sequence[str]) -> bool:
    """Return whether all cells of a column are station names, so that it has no readings."""
    cells = {str(cell).strip() for cell in table.raw(column).tolist() if cell is not None and str(cell).strip()}
    return bool(cells) and cells <= {name.strip() for name in stations}


def without_ignored_columns(table: Table, ignored: Sequence[str]) -> Table:
    """Return a table without the columns that the user ignores; raise InvalidProblem for an unknown column."""
    known = [*table.columns, *table.others]
    lacking = next((name for name in ignored if name not in known), None)
    if lacking is not None:
        raise InvalidProblem(f"{table.source} has no column {lacking!r}", "--ignore", nearest(lacking, known))
    columns = {name: column for name, column in table.columns.items() if name not in ignored}
    others = {name: kind for name, kind in table.others.items() if name not in ignored}
    return replace(table, columns=columns, others=others)


def sorts_of(roles: Roles, hints: ColumnHints) -> list[str]:
    """Return the names of the sorts of readings in a table with one reading in each row, such as "range" or "arrivals".

    "times" means arrivals in the time column, "picks" means P and S waves, and "sp" means times between them. The
    option `--as` takes precedence over the names of the columns. The list is empty if the columns do not identify a
    sort.

    Raises
    ------
    InvalidProblem
        If times may be arrivals, but another column may have readings as well.
    """
    if hints.what is not None:
        return ["times" if hints.what == "arrivals" and roles.find("toa") is None else hints.what]
    if roles.find("sp"):
        return ["sp"]
    if roles.find("station") and (all(map(roles.find, ("time", "phase"))) or all(map(roles.find, ("p", "s")))):
        return ["picks"]
    fitting = [name for name in _KINDS_BY_NAME if roles.find(name)]
    fitting += ["excess"] if roles.find("excess") and "range_sum" not in fitting else []
    fitting += ["arrivals"] if roles.find("toa") else []
    if fitting or not (roles.find("station") and roles.find("time")):
        return fitting
    _check_times_alone(roles)
    return ["times"]


def _check_times_alone(roles: Roles) -> None:
    """Raise InvalidProblem if another column may have the readings, so that the times may not be arrivals."""
    taken = {part for name in roles.by_role.values() for part in name.split("+")}
    for column in [*roles.table.columns, *roles.table.others]:
        other = column not in taken and role_of(column) is None
        if other and (any_unit(column) is not None or _kind_within(column, None) is not None):
            what = f"the readings may be in {column!r}, or may be the times in {roles.find('time')!r}"
            advice = f"use --column range={quoted(column)} or another kind, or --as arrivals for the times"
            raise InvalidProblem(what, roles.table.source, advice)


def _kind_within(column: str, unit: str | None) -> str | None:
    """Return the kind that words in a column name and a unit suggest, such as "range" for "dist_raw_m"; else None."""
    words = [word for word in tokens(without_unit(column)) if not word.isdigit()]
    parts = ["_".join(words[i:j]) for i in range(len(words)) for j in range(len(words), i, -1)]
    named = [part if unit is None else f"{part}_{unit}" for part in parts if len(part) >= _LETTERS]
    return next((role for name in named if (role := role_of(name)) is not None and role in MODELS), None)


def as_angles(roles: Roles, hints: ColumnHints) -> Roles:
    """Return roles in which a column `elevation` without a unit is an angle or a height, as stated by the options.

    Raise InvalidProblem if no option decides: an elevation may be an angle above the horizon or the height of a
    station.
    """
    column = roles.by_role.get("height")
    if column is None or "height" in roles.stated or stem(column) not in _ANGLE_OR_HEIGHT or any_unit(column):
        return roles
    rest = {role: name for role, name in roles.by_role.items() if role != "height"}
    if hints.what == "elevation" or hints.unit in UNITS["angle"]:
        return replace(roles, by_role={"elevation": column, **rest})
    name = quoted(column)
    advice = f"use --column elevation={name} with --unit deg, --column height={name}, or --ignore {name}"
    raise InvalidProblem(f"the column {column!r} may be an angle or a height", roles.table.source, advice)


def quoted(name: str) -> str:
    """Return a column name with quotes for a shell, if needed."""
    return name if re.fullmatch(r"[\w.%+-]+", name) else repr(name)


def unused_measurement(column: str, lengths: bool = False) -> str | None:
    """Return the possible measurement in an unused column, None if its name suggests no measurement.

    With `lengths`, only lengths and their rates can be measurements of the table.
    """
    kind = sigma_kind(column)
    unit = any_unit(column)
    role = role_of(column) or (None if unit is None else _kind_within(column, unit))
    if kind is not None or role is None or (lengths and role in MODELS and MODELS[role].quantity == "angle"):
        return None
    # Names of one or two letters without a unit do not indicate a measurement.
    short = unit is None and len(stem(column)) <= _LETTERS
    if role in MODELS and not short:
        return MODELS[role].summary
    return MODELS["height"].summary if role in ("height", "depth") and not short else None


# Units, missing readings, repeats.


def unit_for(column: str, form: Form, hints: ColumnHints, values: Decimals, where: str) -> tuple[str, str]:
    """Return the unit of a column and a note (empty without one); raise InvalidProblem if the unit is unknown.

    The unit comes from the option `--unit`, from the column name, or for angles from the size of `values`.
    """
    known = UNITS[form.quantity]  # type: ignore[index]  # models hold known quantities only
    unit_in_name = unit_of(column, known)
    if hints.unit is not None and hints.unit in known:
        note = f"--unit {hints.unit} replaces {unit_in_name} of the column name; remove it if the name is right"
        return hints.unit, note if unit_in_name not in (None, hints.unit) else ""
    if hints.unit is not None and (unit_in_name is None or not any(hints.unit in table for table in UNITS.values())):
        raise InvalidProblem(f"{hints.unit!r} is not a unit of {form.text}", "--unit", nearest(hints.unit, list(known)))
    if unit_in_name is not None:
        return unit_in_name, ""
    if form.quantity == "angle" and bool((np.abs(values.floats()) > _TURN).any()):
        return (
            "deg",
            f"{column!r} is in degrees, because some values exceed a full turn in radians; --unit states another",
        )
    examples = {"length": "ns, or --unit m", "angle": "deg, or --unit rad", "speed": "m/s"}.get(form.quantity, "1")
    raise InvalidProblem(f"the unit of the column {column!r} is unknown", where, f"state it with --unit {examples}")


def in_unit(value: Decimal, unit: str, wanted: str, form: Form) -> Decimal:
    """Return a value in another unit of its quantity, with all its digits.

    Raise InvalidProblem for a time and a length, since the conversion needs a propagation speed.
    """
    known = UNITS[form.quantity]  # type: ignore[index]  # models hold known quantities only
    times = {unit, wanted} <= set(UNITS["time"])
    if unit == wanted:
        return value
    if form.quantity == "length" and not times and {unit, wanted} & set(UNITS["time"]):
        advice = "use one unit in all columns, or convert them separately"
        raise InvalidProblem(f"some columns are in {unit}, others in {wanted}", "units", advice)
    return value * Decimal(repr(known[unit])) / Decimal(repr(known[wanted]))


def marks_of(hints: ColumnHints) -> frozenset[Decimal] | None:
    """Return the numbers that mean no reading, as the option `--missing` states; None without this option."""
    if hints.missing is None:
        return None
    if hints.missing.strip().lower() == "none":
        return frozenset()
    try:
        words = [word.strip() for word in hints.missing.split(",")]
        return frozenset(Decimal(word) for word in words if word.lower() not in NOTHING)
    except InvalidOperation:
        advice = "write numbers such as --missing 0,-1,9999, or --missing none"
        raise InvalidProblem(f"{hints.missing!r} is not a list of numbers", "--missing", advice) from None


def without_gaps(found: Readings, epoch: Array, hints: ColumnHints, table: Table, empty: int) -> Readings:
    """Return the readings without the numbers that mean no reading.

    `epoch` (m,) is the epoch number of each reading. `empty` is the number of empty cells, for a note. Raise
    InvalidProblem for a number that may be a reading or mean no reading, unless `--missing` decides.
    """
    marks = marks_of(hints)
    if marks is None:
        marks = frozenset()
        doubtful = _suspicious_number(found, epoch)
        if doubtful is not None:
            occurrences = np.flatnonzero(found.values.units == found.values.number(doubtful))
            times = f"{len(occurrences)} times, first here" if len(occurrences) > 1 else "once"
            advice = f"use --missing {doubtful}, or --missing none if it is a reading"
            what = f"{doubtful} occurs {times}, and may be a reading or mean no reading"
            raise InvalidProblem(what, found.where(table, int(occurrences[0])), advice)
    is_missing = np.zeros(len(found.values), dtype=bool)
    for number in (found.values.number(mark) for mark in marks):
        is_missing |= False if number is None else found.values.units == number
    if is_missing.all():
        raise NoReading("no cell has a reading", table.source, "check --missing and the columns")
    count = int(is_missing.sum())
    notes = (
        [f"{_cells(count)} with {hints.missing}: no reading; use --missing none if they are readings"] if count else []
    )
    notes += [f"{_cells(empty)} without a number: no reading; fill in a number that is missing"] if empty else []
    return replace(found.take(np.flatnonzero(~is_missing)) if count else found, notes=(*found.notes, *notes))


def _cells(count: int) -> str:
    """Return a number of cells as text."""
    return "1 cell" if count == 1 else f"{count} cells"


def _suspicious_number(found: Readings, epoch: Array) -> Decimal | None:
    """Return a number that may mean a missing reading, or None.

    The candidates are numbers that programs write for a missing reading, such as 0, -1 or 9999. A candidate is
    suspicious if it is the smallest or the largest number of the table, or more frequent than each other number.
    `epoch` (m,) is the epoch number of each reading.
    """
    values, counts = np.unique(found.values.units, return_counts=True)
    for mark in _MISSING_VALUES:
        number = found.values.number(mark)
        here = np.flatnonzero(values == number)
        if number is None or not len(here) or len(values) == 1:
            continue
        if mark == 0 and found.form.kind == "toa" and _is_relative_to_first(found, epoch):
            continue
        beyond = int(here[0]) in (0, len(values) - 1)  # `values` are sorted
        count, others = counts[here[0]], np.delete(counts, here[0])
        if beyond or (count > 1 and count > others.max()):
            return mark
    return None


def _is_relative_to_first(found: Readings, epoch: Array) -> bool:
    """Return whether each epoch has one zero and no negative number: then arrivals are relative to the first."""
    units = found.values.units
    zeros = np.bincount(epoch[units == 0], minlength=int(epoch.max()) + 1)
    return bool((units >= 0).all() and (zeros[np.unique(epoch)] == 1).all())
