"""Cells of foreign tables with all their digits: numbers, dates with their zones, and what stands for nothing."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from typing import Any
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.types import Array
from optloc.base.units import LARGEST, UNITS
from optloc.files.columns import unit_of
from optloc.files.roles import Roles
from optloc.files.table import Table

# Integers up to this are exact as floats, and so are powers of ten up to this exponent: a quotient of both is then the
# float that is nearest to the number.
_EXACT, _EXACT_PLACES = 2**53, 22
# Integers below this have sums and differences of 64 bits.
_LARGEST = 2**62


@dataclass(frozen=True, slots=True)
class Decimals:
    """NumberColumn (m,) with all their digits.

    Parameters
    ----------
    units : int array (m,), or object array (m,) of int
        The numbers times 10 to the power of `places`; Python's integers where 64 bits do not hold them.
    places : int
        Decimals that all numbers have here.
    written : int array (m,)
        Decimals that each was written with, negative where digits before the point are unknown, as of 1.7E12.
    """

    units: Array
    places: int
    written: Array

    @classmethod
    def of(cls, values: Sequence[Decimal]) -> Decimals:
        """Return finite numbers as decimals."""
        written = np.array([-int(value.as_tuple().exponent) for value in values], dtype=np.int64)
        places = max(int(written.max(initial=0)), 0)
        units = np.empty(len(values), dtype=object)
        units[:] = [int(f"{value:.{places}f}".replace(".", "")) for value in values]
        return cls(_smallest(units), places, written)

    @classmethod
    def scaled(cls, units: Array, written: Array) -> Decimals:
        """Return integers (m,) with a number of decimals each."""
        places = max(int(written.max(initial=0)), 0)
        return cls(_times_ten(units, places - written), places, written)

    @classmethod
    def join(cls, parts: Sequence[Decimals]) -> Decimals:
        """Return columns one behind the other."""
        places = max(part.places for part in parts)
        units = [part.at_places(places) for part in parts]
        return cls(np.concatenate(units), places, np.concatenate([part.written for part in parts]))

    def __len__(self) -> int:
        return len(self.units)

    def __getitem__(self, item: int) -> Decimal:
        """Return one number as it was written."""
        written = int(self.written[item])
        return Decimal(f"{int(self.units[item]) // 10 ** (self.places - written)}E{-written}")

    def take(self, pick: Any) -> Decimals:
        """Return some of the numbers."""
        return Decimals(self.units[pick], self.places, self.written[pick])

    def tolist(self) -> list[Decimal]:
        """Return the numbers one by one."""
        return [self[i] for i in range(len(self))]

    def at_places(self, places: int) -> Array:
        """Return the numbers as integers with a given number of decimals, not fewer than they have."""
        return _times_ten(self.units, np.full(len(self), places - self.places))

    def number(self, value: Decimal) -> int | None:
        """Return a number in the units of the column; None where it has more decimals than the column."""
        units = value.scaleb(self.places)
        return int(units) if units == units.to_integral_value() else None

    def since(self, first: Array, index: Array) -> Decimals:
        """Return the differences to other numbers of the column, with the larger number of decimals.

        Parameters
        ----------
        first : int array (n,)
            NumberColumn that are subtracted.
        index : int array (m,)
            Which of them is subtracted from each number.
        """
        at = first[index]
        return Decimals(self.units - self.units[at], self.places, np.maximum(self.written, self.written[at]))

    def floats(self) -> Array:
        """Return the nearest floats (m,)."""
        small = np.abs(self.units) < _EXACT
        if self.places <= _EXACT_PLACES and small.all():
            return np.asarray(self.units.astype(np.float64) / 10.0**self.places)
        return np.array([float(value) for value in self.tolist()])

    def texts(self) -> list[str]:
        """Return the numbers as they are written without an exponent."""
        return [f"{value:f}" for value in self.tolist()]


def _smallest(units: Array) -> Array:
    """Return integers in 64 bits where they fit."""
    most = max(map(abs, units.tolist()), default=0)
    return units.astype(np.int64) if most < _LARGEST else units


def _times_ten(units: Array, power: Array) -> Array:
    """Return integers times powers of ten that are not negative."""
    most = int(power.max(initial=0))
    if not most:
        return units
    if units.dtype == object or int(np.abs(units).max(initial=0)) * 10**most >= _LARGEST:
        out = np.empty(len(units), dtype=object)
        out[:] = [int(unit) * 10 ** int(more) for unit, more in zip(units.tolist(), power.tolist(), strict=True)]
        return out
    return units * 10 ** power.astype(np.int64)


# What cells hold that hold nothing, in the words of spreadsheets, databases and programs.
NOTHING = frozenset({"", "nan", "na", "n/a", "#n/a", "null", "none", "nil", "-", "--", "?"})
# Decimals of an instant: no clock tells more than 20, and a float written in full has some fifty.
_DIGITS = 60
# Share of the largest number that a float next to it may fall short of by rounding.
_NEARLY = 0.5
_DATE = re.compile(r"\d{4}-\d\d?-\d\d?|\d{4}\d\d\d\dT")
_ZONE = re.compile(r"(Z|[+-]\d\d:?(\d\d)?)$", re.IGNORECASE)
_FRACTION = re.compile(r"^(.*:\d\d)[.,](\d+)(.*)$")


@dataclass(frozen=True, slots=True)
class NumberColumn:
    """The numbers (m,) of a column, and the row of each: cells that hold nothing are left out."""

    values: Decimals
    row: Array


def numbers(table: Table, name: str) -> NumberColumn:
    """Return a column with all its digits; raise InvalidProblem for other words than those of empty cells."""
    column = table.raw(name)
    if column.dtype.kind not in "iufO":
        raise InvalidProblem(f"it holds {column.dtype}, not numbers", table.where(name), "give numbers")
    return _plain_numbers(column) or _of_cells(
        [_number(table, name, row, cell) for row, cell in enumerate(column.tolist())]
    )


def _of_cells(cells: list[Decimal | None]) -> NumberColumn:
    row = np.array([row for row, value in enumerate(cells) if value is not None], dtype=np.int64)
    return NumberColumn(Decimals.of([value for value in cells if value is not None]), row)


# NumberColumn as nearly all tables have them: digits, perhaps with a point.
_PLAIN = r"^-?([0-9]+(\.[0-9]*)?|\.[0-9]+)$"


def _plain_numbers(column: Array) -> NumberColumn | None:
    """Return a column of text with plain numbers of at most 64 bits; None for other columns."""
    import pyarrow as pa
    from pyarrow import compute as pc

    if column.dtype != object:
        return None
    try:
        text = pc.utf8_trim_whitespace(pa.array(column, pa.string()))
    except (pa.ArrowException, UnicodeEncodeError):
        return None
    nothing = pc.or_kleene(pc.is_null(text), pc.is_in(pc.utf8_lower(text), pa.array(sorted(NOTHING))))
    row = np.flatnonzero(~nothing.to_numpy(zero_copy_only=False))
    text = text.filter(pc.invert(nothing))
    if not pc.all(pc.match_substring_regex(text, _PLAIN)).as_py():
        return None
    point = pc.find_substring(text, ".").to_numpy()
    written = np.where(point < 0, 0, pc.binary_length(text).to_numpy() - point - 1).astype(np.int64)
    try:
        units = pc.cast(pc.replace_substring(text, ".", "", max_replacements=1), pa.int64()).to_numpy()
    except pa.ArrowInvalid:  # more digits than 64 bits hold
        return None
    # Values that may be too large are read cell by cell: the error names the cell.
    if (np.abs(units / 10.0**written) > _NEARLY * LARGEST).any():
        return None
    return NumberColumn(Decimals.scaled(units, written), row)


def _number(table: Table, name: str, row: int, cell: Any) -> Decimal | None:
    text = "" if cell is None else str(cell).strip()
    if text.lower() in NOTHING:
        return None
    try:
        # Python reads 1_000 as a thousand, which in a table is a slip.
        number = Decimal("nan") if "_" in text or isinstance(cell, bool) else Decimal(text)
    except InvalidOperation:
        number = Decimal("nan")
    # Written out, 1e-999999999 has a billion digits.
    if number.is_finite() and abs(number) <= LARGEST and -int(number.as_tuple().exponent) <= _DIGITS:
        return number
    what = f"{text[:40]!r} is not a finite number"
    raise InvalidProblem(what, table.where(name, row), "correct it, or empty the cell")


def is_dated(table: Table, name: str) -> bool:
    """Return whether a column holds dates: the first cell that holds something does."""
    column = table.raw(name)
    if column.dtype.kind == "M":
        return True
    first = next((cell for cell in column.tolist() if cell is not None and str(cell).strip()), None)
    return isinstance(first, str) and _DATE.match(first.strip()) is not None


def date_seconds(table: Table, name: str, zone: str | None) -> NumberColumn:
    """Return a column of dates as seconds since 1970, UTC.

    Parameters
    ----------
    table : Table
        The table.
    name : str
        The column: ISO 8601, with as many decimals as it likes.
    zone : str, optional
        Time zone of dates that name none.
    """
    import pandas as pd

    column = table.raw(name)
    if column.dtype.kind == "M":
        row = np.flatnonzero(~np.isnat(column))
        nanoseconds = column[row].astype("datetime64[ns]").astype(np.int64)
        return NumberColumn(Decimals.scaled(nanoseconds, np.full(len(row), 9)), row)
    cells = ["" if cell is None else str(cell).strip() for cell in column.tolist()]
    held = [row for row, cell in enumerate(cells) if cell.lower() not in NOTHING]
    bare_rows = [row for row in held if not _ZONE.search(cells[row].partition("T")[2] or cells[row].partition(" ")[2])]
    if bare_rows and len(bare_rows) < len(held):
        what = "the date names no time zone, but others do"
        raise InvalidProblem(what, table.where(name, bare_rows[0]), "write the zone everywhere, such as Z for UTC")
    if bare_rows and zone is None:
        advice = "say --zone UTC, or the zone of the clocks such as --zone Europe/Rome"
        raise InvalidProblem("the dates name no time zone", table.where(name), advice)
    parts = [_FRACTION.match(cells[row]) for row in held]
    # Whole seconds are read by pandas; it keeps nine decimals, and the rest is added.
    whole = [part[1] + part[3] if part else cells[row] for part, row in zip(parts, held, strict=True)]
    try:
        read = pd.to_datetime(pd.Series(whole, dtype=object), format="ISO8601", utc=not bare_rows)
        read = read.dt.tz_localize(_zone(str(zone))).dt.tz_convert("UTC") if bare_rows else read
        seconds = read.dt.tz_localize(None).to_numpy().astype("datetime64[s]").astype(np.int64)
    except (ValueError, OverflowError, TypeError, AttributeError) as error:
        what = str(error).partition(",")[0].partition(". You")[0][:120]
        raise InvalidProblem(f"a date cannot be read ({what})", table.where(name), "use ISO 8601") from None
    fractions = [part[2][:_DIGITS] if part else "" for part in parts]
    values = [Decimal(second) + Decimal(f"0.{more}") for second, more in zip(seconds.tolist(), fractions, strict=True)]
    return NumberColumn(Decimals.of(values), np.array(held, dtype=np.int64))


def _zone(name: str) -> ZoneInfo:
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        advice = "name it as UTC or Europe/Rome"
        raise InvalidProblem(f"there is no time zone {name[:40]!r}", "--zone", advice) from None


def column_times(roles: Roles, name: str, zone: str | None, told_unit: str | None = None) -> Array | None:
    """Return a column of times as seconds (m,), None where its numbers have no unit: then they are mere labels.

    Parameters
    ----------
    roles : Roles
        The table.
    name : str
        The column.
    zone : str, optional
        Time zone of dates that name none.
    told_unit : str, optional
        Unit of its numbers, where its name does not end in one.
    """
    table = roles.table
    if is_dated(table, name):
        held, factor = date_seconds(table, name, zone), 1.0
    else:
        unit = unit_of(name, UNITS["time"])
        if told_unit is not None and told_unit not in UNITS["time"]:
            raise InvalidProblem(
                f"{told_unit!r} is no unit of time", "--time-unit", nearest(told_unit, [*UNITS["time"]])
            )
        if told_unit is not None and unit not in (None, told_unit):
            what = f"the column {name!r} ends in {unit}, not in {told_unit}"
            raise InvalidProblem(what, "--time-unit", "leave it out, or name another column with --column time=NAME")
        unit = told_unit if unit is None else unit
        if unit is None:
            return None
        held, factor = numbers(table, name), UNITS["time"][unit]
    if len(held.row) < table.count:
        empty = int(np.setdiff1d(np.arange(table.count), held.row)[0])
        raise InvalidProblem("the cell is empty", table.where(name, empty), "give the time, or leave the row out")
    return held.values.floats() * factor
