"""Cells of foreign tables with all their digits: numbers, dates with their zones, and what stands for nothing."""

from __future__ import annotations

import re
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

# What cells hold that hold nothing, in the words of spreadsheets, databases and programs.
NOTHING = frozenset({"", "nan", "na", "n/a", "#n/a", "null", "none", "nil", "-", "--", "?"})
# Decimals of an instant: no clock tells more than 20, and a float written in full has some fifty.
_DIGITS = 60
_DATE = re.compile(r"\d{4}-\d\d?-\d\d?|\d{4}\d\d\d\dT")
_ZONE = re.compile(r"(Z|[+-]\d\d:?(\d\d)?)$", re.IGNORECASE)
_FRACTION = re.compile(r"^(.*:\d\d)[.,](\d+)(.*)$")


def numbers(table: Table, name: str) -> list[Decimal | None]:
    """Return a column with all its digits, None where a cell holds nothing; raise InvalidProblem for other words."""
    column = table.raw(name)
    if column.dtype.kind not in "iufO":
        raise InvalidProblem(f"it holds {column.dtype}, not numbers", table.where(name), "give numbers")
    return [_number(table, name, row, cell) for row, cell in enumerate(column.tolist())]


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


def instants(table: Table, name: str, zone: str | None) -> list[Decimal | None]:
    """Return a column of dates as seconds since 1970, UTC, None where a cell holds nothing.

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
        nanoseconds = column.astype("datetime64[ns]").astype(np.int64).tolist()
        return [None if np.isnat(at) else Decimal(n).scaleb(-9) for at, n in zip(column, nanoseconds, strict=True)]
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
        seconds = read.dt.tz_localize(None).to_numpy().astype("datetime64[s]").astype(np.int64).tolist()
    except (ValueError, OverflowError, TypeError, AttributeError) as error:
        what = str(error).partition(",")[0].partition(". You")[0][:120]
        raise InvalidProblem(f"a date cannot be read ({what})", table.where(name), "use ISO 8601") from None
    out: list[Decimal | None] = [None] * len(cells)
    for row, part, second in zip(held, parts, seconds, strict=True):
        out[row] = Decimal(second) + (Decimal(f"0.{part[2][:_DIGITS]}") if part else 0)
    return out


def _zone(name: str) -> ZoneInfo:
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        advice = "name it as UTC or Europe/Rome"
        raise InvalidProblem(f"there is no time zone {name[:40]!r}", "--zone", advice) from None


def moments(roles: Roles, name: str, zone: str | None, told_unit: str | None = None) -> Array | None:
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
        held, factor = instants(table, name, zone), 1.0
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
    empty = next((row for row, value in enumerate(held) if value is None), None)
    if empty is not None:
        raise InvalidProblem("the cell is empty", table.where(name, empty), "give the time, or leave the row out")
    return np.array([float(value) * factor for value in held if value is not None])
