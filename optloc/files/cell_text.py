"""Cells of measurement tables as decimals with all digits, dates with time zones, and empty cells.

Recent times in nanoseconds have 19 digits, and a float has 16. So differences of times are computed from decimals. In
shapes, m is the number of cells that are not empty.
"""

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
from optloc.files.table import Table, number_advice

# Integers up to 2^53 and powers of ten up to 10^22 are exact as floats. Their quotient is then the nearest float.
_EXACT, _EXACT_PLACES = 2**53, 22
# Sums and differences of integers below this bound fit 64 bits.
_LARGEST = 2**62


@dataclass(frozen=True, slots=True)
class Decimals:
    """Numbers (m,) with all their digits.

    Parameters
    ----------
    units : int array (m,), or object array (m,) of int
        The numbers times 10 to the power of `places`; Python integers if 64 bits are too few.
    places : int
        Decimals of all numbers in `units`.
    written : int array (m,)
        Decimals of each number in the file; negative if digits before the point are unknown, as in 1.7E12.
    """

    units: Array
    places: int
    written: Array

    @classmethod
    def of(cls, values: Sequence[Decimal]) -> Decimals:
        """Return finite numbers (m,) as decimals."""
        written = np.array([-int(value.as_tuple().exponent) for value in values], dtype=np.int64)
        places = max(int(written.max(initial=0)), 0)
        units = np.empty(len(values), dtype=object)
        units[:] = [int(f"{value:.{places}f}".replace(".", "")) for value in values]
        return cls(_smallest(units), places, written)

    @classmethod
    def scaled(cls, units: Array, written: Array) -> Decimals:
        """Return integers (m,) divided by ten to the power of `written` (m,) as decimals."""
        places = max(int(written.max(initial=0)), 0)
        return cls(_times_ten(units, places - written), places, written)

    @classmethod
    def join(cls, parts: Sequence[Decimals]) -> Decimals:
        """Return the concatenation of columns, with the largest number of decimals of all columns."""
        places = max(part.places for part in parts)
        units = [part.at_places(places) for part in parts]
        return cls(np.concatenate(units), places, np.concatenate([part.written for part in parts]))

    def __len__(self) -> int:
        return len(self.units)

    def __getitem__(self, item: int) -> Decimal:
        """Return one number with its decimals in the file."""
        written = int(self.written[item])
        return Decimal(f"{int(self.units[item]) // 10 ** (self.places - written)}E{-written}")

    def take(self, pick: Any) -> Decimals:
        """Return the numbers that an index or a mask, `pick`, selects."""
        return Decimals(self.units[pick], self.places, self.written[pick])

    def tolist(self) -> list[Decimal]:
        """Return the numbers as a list."""
        return [self[i] for i in range(len(self))]

    def at_places(self, places: int) -> Array:
        """Return the numbers (m,) times ten to the power of `places`, which must not be less than their decimals."""
        return _times_ten(self.units, np.full(len(self), places - self.places))

    def number(self, value: Decimal) -> int | None:
        """Return `value` times ten to the power of the decimals of the column; None if it has more decimals.

        The result can be compared with `units`.
        """
        units = value.scaleb(self.places)
        return int(units) if units == units.to_integral_value() else None

    def since(self, first: Array, index: Array) -> Decimals:
        """Return differences between the numbers (m,) and reference numbers of the same column.

        `first` (n,) are the indices of the references; `index` (m,) selects the reference of each number. A difference
        has the larger number of decimals of both.
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
        """Return the numbers as text without an exponent."""
        return [f"{value:f}" for value in self.tolist()]


def _smallest(units: Array) -> Array:
    """Return integers (m,) as an array of 64 bits if they fit, else as Python integers."""
    most = max(map(abs, units.tolist()), default=0)
    return units.astype(np.int64) if most < _LARGEST else units


def _times_ten(units: Array, power: Array) -> Array:
    """Return integers (m,) times ten to the power of `power` (m,), which is not negative.

    The result has Python integers if 64 bits are too few.
    """
    most = int(power.max(initial=0))
    if not most:
        return units
    if units.dtype == object or int(np.abs(units).max(initial=0)) * 10**most >= _LARGEST:
        out = np.empty(len(units), dtype=object)
        out[:] = [int(unit) * 10 ** int(more) for unit, more in zip(units.tolist(), power.tolist(), strict=True)]
        return out
    return units * 10 ** power.astype(np.int64)


# Spellings of empty cells in spreadsheets, databases and programs.
NOTHING = frozenset({"", "nan", "na", "n/a", "#n/a", "null", "none", "nil", "-", "--", "?"})
# Largest number of decimals of an instant: clocks have at most 20, and a float written in full has about fifty.
_DIGITS = 60
# Share of the largest permitted number above which a cell is checked exactly, since floats round.
_EXACT_CHECK_SHARE = 0.5
_DATE = re.compile(r"\d{4}-\d\d?-\d\d?|\d{4}\d\d\d\dT")
_ZONE = re.compile(r"(Z|[+-]\d\d:?(\d\d)?)$", re.IGNORECASE)
_FRACTION = re.compile(r"^(.*:\d\d)[.,](\d+)(.*)$")


@dataclass(frozen=True, slots=True)
class NumberColumn:
    """The numbers (m,) of a column and the row (m,) of each; empty cells are left out."""

    values: Decimals
    row: Array


def numbers(table: Table, name: str) -> NumberColumn:
    """Return a column with all its digits; raise InvalidProblem for text other than an empty cell."""
    column = table.raw(name)
    if column.dtype.kind not in "iufO":
        raise InvalidProblem(f"the column has the type {column.dtype}, not numbers", table.where(name), "give numbers")
    return _plain_numbers(column) or _of_cells(
        [_number(table, name, row, cell) for row, cell in enumerate(column.tolist())]
    )


def _of_cells(cells: list[Decimal | None]) -> NumberColumn:
    """Return the numbers of cells as a column; cells that are None are left out."""
    row = np.array([row for row, value in enumerate(cells) if value is not None], dtype=np.int64)
    return NumberColumn(Decimals.of([value for value in cells if value is not None]), row)


# Pattern of most numbers: digits, perhaps with a point.
_PLAIN = r"^-?([0-9]+(\.[0-9]*)?|\.[0-9]+)$"


def _plain_numbers(column: Array) -> NumberColumn | None:
    """Return a column of whole numbers, or of text with plain numbers of at most 64 bits; None for other columns.

    This function is fast; other columns are read cell by cell.
    """
    import pyarrow as pa
    from pyarrow import compute as pc

    # Arrow and Python write floats in different forms, so floats are read cell by cell.
    if column.dtype not in (np.object_, np.int64):
        return None
    try:
        given = pa.array(column, pa.string()) if column.dtype == object else pc.cast(pa.array(column), pa.string())
        text = pc.utf8_trim_whitespace(given)
    except (pa.ArrowException, UnicodeEncodeError):
        return None
    nothing = pc.or_kleene(pc.is_null(text), pc.is_in(pc.utf8_lower(text), pa.array(sorted(NOTHING))))
    row = np.flatnonzero(~nothing.to_numpy(zero_copy_only=False))
    text = text.filter(pc.invert(nothing))
    if not pc.all(pc.match_substring_regex(text, _PLAIN)).as_py():
        return None
    # `written` has the number of decimals of each cell, and `units` the digits without the point as an integer.
    point = pc.find_substring(text, ".").to_numpy()
    written = np.where(point < 0, 0, pc.binary_length(text).to_numpy() - point - 1).astype(np.int64)
    try:
        units = pc.cast(pc.replace_substring(text, ".", "", max_replacements=1), pa.int64()).to_numpy()
    except pa.ArrowInvalid:  # more digits than 64 bits hold
        return None
    # Read values that may be too large cell by cell, so that the error names the cell.
    if (np.abs(units / 10.0**written) > _EXACT_CHECK_SHARE * LARGEST).any():
        return None
    return NumberColumn(Decimals.scaled(units, written), row)


def _number(table: Table, name: str, row: int, cell: Any) -> Decimal | None:
    """Return a cell as a decimal; None for an empty cell. Raise InvalidProblem for other text.

    `name` and `row` are the column and the row of the cell, for messages.
    """
    text = "" if cell is None else str(cell).strip()
    if text.lower() in NOTHING:
        return None
    try:
        # Python reads 1_000 as a thousand; in a table it is a typing error.
        number = Decimal("nan") if "_" in text or isinstance(cell, bool) else Decimal(text)
    except InvalidOperation:
        number = Decimal("nan")
    # Limit the exponent: 1e-999999999 has a billion digits when written in full.
    if number.is_finite() and abs(number) <= LARGEST and -int(number.as_tuple().exponent) <= _DIGITS:
        return number
    what = f"{text[:40]!r} is not a finite number"
    raise InvalidProblem(what, table.where(name, row), number_advice(text, "correct it, or empty the cell"))


def is_dated(table: Table, name: str) -> bool:
    """Return whether a column has dates, by its first cell that is not empty."""
    column = table.raw(name)
    if column.dtype.kind == "M":
        return True
    first = next((cell for cell in column.tolist() if cell is not None and str(cell).strip()), None)
    return isinstance(first, str) and _DATE.match(first.strip()) is not None


def date_seconds(table: Table, name: str, zone: str | None) -> NumberColumn:
    """Return a column of ISO 8601 dates as seconds since 1970, UTC, with all decimals.

    `zone` is the time zone of dates without a zone.
    """
    import pandas as pd

    column = table.raw(name)
    if column.dtype.kind == "M":
        row = np.flatnonzero(~np.isnat(column))
        nanoseconds = column[row].astype("datetime64[ns]").astype(np.int64)
        return NumberColumn(Decimals.scaled(nanoseconds, np.full(len(row), 9)), row)
    cells = ["" if cell is None else str(cell).strip() for cell in column.tolist()]
    # `filled_rows` have a date, and `bare_rows` a date without a time zone.
    filled_rows = [row for row, cell in enumerate(cells) if cell.lower() not in NOTHING]
    bare_rows = [
        row for row in filled_rows if not _ZONE.search(cells[row].partition("T")[2] or cells[row].partition(" ")[2])
    ]
    if bare_rows and len(bare_rows) < len(filled_rows):
        what = "the date has no time zone, but others have one"
        raise InvalidProblem(what, table.where(name, bare_rows[0]), "write the zone in each date, such as Z for UTC")
    if bare_rows and zone is None:
        advice = "use --zone UTC, or the zone of the clocks such as --zone Europe/Rome"
        raise InvalidProblem("the dates have no time zone", table.where(name), advice)
    parts = [_FRACTION.match(cells[row]) for row in filled_rows]
    # pandas keeps nine decimals only: it reads the whole seconds, and the fraction is added.
    whole = [part[1] + part[3] if part else cells[row] for part, row in zip(parts, filled_rows, strict=True)]
    try:
        read = pd.to_datetime(pd.Series(whole, dtype=object), format="ISO8601", utc=not bare_rows)
        read = read.dt.tz_localize(_zone(str(zone))).dt.tz_convert("UTC") if bare_rows else read
        seconds = read.dt.tz_localize(None).to_numpy().astype("datetime64[s]").astype(np.int64)
    except (ValueError, OverflowError, TypeError, AttributeError) as error:
        what = str(error).partition(",")[0].partition(". You")[0][:120]
        raise InvalidProblem(f"a date cannot be read ({what})", table.where(name), "use ISO 8601") from None
    fractions = [part[2][:_DIGITS] if part else "" for part in parts]
    values = [Decimal(second) + Decimal(f"0.{more}") for second, more in zip(seconds.tolist(), fractions, strict=True)]
    return NumberColumn(Decimals.of(values), np.array(filled_rows, dtype=np.int64))


def _zone(name: str) -> ZoneInfo:
    """Return a time zone by name; raise InvalidProblem for an unknown name."""
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        advice = "write a zone such as UTC or Europe/Rome"
        raise InvalidProblem(f"there is no time zone {name[:40]!r}", "--zone", advice) from None


def date_texts(seconds: Array) -> Array:
    """Return seconds since 1970, UTC (m,), as ISO 8601 text in UTC, an object array (m,).

    All texts have the same number of decimals: the fewest that show the times, at most six.
    """
    microseconds = np.round(seconds * 1e6).astype(np.int64)
    unit = next((unit for unit, size in (("s", 10**6), ("ms", 10**3)) if not (microseconds % size).any()), "us")
    # the unit of the dates is the unit of their texts
    texts = np.datetime_as_string(microseconds.astype("datetime64[us]").astype(f"datetime64[{unit}]"))
    return np.char.add(texts, "Z").astype(object)


def column_times(
    roles: Roles, name: str, zone: str | None, told_unit: str | None = None, scale: str | None = None
) -> Array | None:
    """Return a column of times in seconds (m,); None if its numbers have no unit and so are labels.

    `zone` is the time zone of dates without a zone. `told_unit` is the unit if the column name does not end in one.
    With a time scale, the unit is seconds if nothing states it.
    """
    table = roles.table
    if is_dated(table, name):
        values, factor = date_seconds(table, name, zone), 1.0
    else:
        unit = unit_of(name, UNITS["time"])
        if told_unit is not None and told_unit not in UNITS["time"]:
            raise InvalidProblem(
                f"{told_unit!r} is not a unit of time", "--time-unit", nearest(told_unit, [*UNITS["time"]])
            )
        if told_unit is not None and unit not in (None, told_unit):
            what = f"the column {name!r} ends in {unit}, not in {told_unit}"
            raise InvalidProblem(what, "--time-unit", "remove it, or state another column with --column time=NAME")
        unit = told_unit if unit is None else unit
        unit = "s" if unit is None and scale is not None else unit
        if unit is None:
            return None
        values, factor = numbers(table, name), UNITS["time"][unit]
    if len(values.row) < table.count:
        empty = int(np.setdiff1d(np.arange(table.count), values.row)[0])
        raise InvalidProblem("the cell is empty", table.where(name, empty), "give the time, or remove the row")
    return values.values.floats() * factor
