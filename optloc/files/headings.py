"""Bearings from the bow of a vehicle: its heading is added, which a column of the table holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.units import UNITS
from optloc.files.cell_text import Decimals, numbers
from optloc.files.columns import stem, unit_of
from optloc.files.roles import ColumnPlaces, Roles
from optloc.files.table_import import BOW, COMPASS, ColumnHints, Readings, in_unit, marks_of

# A turn in each unit, and the radians of one: an angle without unit that is larger is in degrees.
_TURNS = {"deg": Decimal(360)}
_RADIANS = Decimal("6.2832")


def heading_of(found: Readings, roles: Roles, told: ColumnHints) -> str | None:
    """Return the column of headings that is added to bearings; None where they are counted from elsewhere.

    Parameters
    ----------
    found : Readings
        Azimuths.
    roles : Roles
        Columns of the table.
    told : ColumnHints
        The convention, where it is stated: any but that of the bow leaves the headings out.

    Raises
    ------
    InvalidProblem
        For bearings from the bow without a column of headings.
    """
    if told.azimuth not in (None, BOW):
        return None
    column = roles.column("heading") if told.azimuth == BOW else roles.find("heading")
    # A heading that was measured is a bearing, and the heading of one vehicle is not the one of several receivers.
    if column is None or column in found.columns or (told.azimuth is None and len(found.columns) > 1):
        return None
    return column


def from_bow(found: Readings, roles: Roles, column: str, told: ColumnHints) -> Readings:
    """Return bearings clockwise from north: those from the bow with the heading of their row added.

    Parameters
    ----------
    found : Readings
        Bearings, clockwise from the bow.
    roles : Roles
        Columns of the table.
    column : str
        The headings, clockwise from north.
    told : ColumnHints
        Whether the convention is stated, and what the unit is without one in the name of the column.

    Raises
    ------
    InvalidProblem
        Where a bearing has no heading, the unit is not known, or magnetic headings have no declination.
    """
    table = roles.table
    if "mag" in stem(column) and told.declination is None:
        advice = "give it with --declination, such as '4 deg' or the date 2026-06-01"
        raise InvalidProblem(f"the headings {column!r} are magnetic, of unknown declination", table.source, advice)
    held, nothing = numbers(table, column), marks_of(told) or frozenset()
    given = dict(zip(held.row.tolist(), held.values.tolist(), strict=True))
    lacking = next((row for row in found.row.tolist() if given.get(row) is None or given[row] in nothing), None)
    if lacking is not None:
        advice = "leave the row out, or say --azimuth north-clockwise if bearings are true ones"
        raise InvalidProblem("the bearing has no heading", table.where(column, lacking), advice)
    used = [given[row] for row in found.row.tolist()]
    unit = _unit(column, used, told, table.where(column))
    turn = in_unit(Decimal(360), "deg", unit, found.form)
    wrong = next((i for i, heading in enumerate(used) if abs(heading) > turn * Decimal("1.0001")), None)
    if wrong is not None:
        spot = table.where(column, int(found.row[wrong]))
        raise InvalidProblem(f"the heading {used[wrong]:f} {unit} is more than a turn", spot, "leave the row out")
    sums = [
        value + in_unit(heading, unit, found.unit, found.form)
        for value, heading in zip(found.values.tolist(), used, strict=True)
    ]
    if found.unit in _TURNS:
        turn = _TURNS[found.unit]
        sums = [(value % turn + turn) % turn for value in sums]
    note = f"bearings are taken clockwise from the bow of the vehicle, and its heading was added, column {column!r}"
    note += "" if told.azimuth == BOW else f"; --azimuth {COMPASS} takes them as true bearings"
    return replace(found, values=Decimals.of(sums), azimuth=COMPASS, heading=column, notes=(note, *found.notes))


def stations_turned(place: ColumnPlaces, found: Sequence[Readings]) -> tuple[ColumnPlaces, str]:
    """Return stations with the headings of their table where bearings are read from them, and a remark.

    Parameters
    ----------
    place : ColumnPlaces
        Stations, with a column of headings where their table has one.
    found : sequence of Readings
        All readings.

    Raises
    ------
    InvalidProblem
        For a station without a heading that measures a bearing, and for headings of stations and of a vehicle.
    """
    if "heading_deg" not in place.columns:
        return place, ""
    headings = place.columns["heading_deg"]
    bearings = [one for one in found if one.form.kind == "azimuth"]
    if not bearings:
        kept = {name: column for name, column in place.columns.items() if name != "heading_deg"}
        return replace(place, columns=kept), ""
    if any(one.heading is not None for one in bearings):
        what = "the headings of stations and the headings of a vehicle are both given"
        raise InvalidProblem(what, "--stations", "leave one of the columns out")
    used = {str(name) for one in bearings for name in one.a.tolist()}
    lacking = next((n for n, v in zip(place.names, headings, strict=True) if n in used and np.isnan(v)), None)
    if lacking is not None:
        raise InvalidProblem(f"station {lacking!r} has no heading", "--stations", "give one to each, 0 for north")
    note = "bearings are taken from the headings of the stations, which their table gives"
    return replace(place, columns={**place.columns, "heading_deg": np.nan_to_num(headings)}), note


def _unit(column: str, held: list[Decimal], told: ColumnHints, where: str) -> str:
    """Return the unit of headings: the one in the name of their column, or the one that their size or --unit tells."""
    known = UNITS["angle"]
    own = unit_of(column, known) or (told.unit if told.unit in known else None)
    if own is None and any(abs(value) > _RADIANS for value in held):
        return "deg"
    if own is None:
        advice = f"call it {column}_deg or {column}_rad, or say --unit"
        raise InvalidProblem(f"the unit of the column {column!r} is not known", where, advice)
    return own
