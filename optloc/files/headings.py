"""Bearings relative to the bow of a vehicle, to which the heading in a column of the table is added."""

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

# A full turn in degrees, and in radians: an angle without unit that exceeds a turn in radians is in degrees.
_FULL_TURN = {"deg": Decimal(360)}
_RADIANS = Decimal("6.2832")


def heading_of(found: Readings, roles: Roles, hints: ColumnHints) -> str | None:
    """Return the column of headings to add to bearings; None if bearings are not relative to the bow.

    `hints` may state the convention of the azimuths `found`: any other convention than the bow ignores headings. Raise
    InvalidProblem for bearings from the bow without a column of headings.
    """
    if hints.azimuth not in (None, BOW):
        return None
    column = roles.column("heading") if hints.azimuth == BOW else roles.find("heading")
    # A measured heading is a bearing. The heading of one vehicle does not apply to columns of several receivers.
    if column is None or column in found.columns or (hints.azimuth is None and len(found.columns) > 1):
        return None
    return column


def from_bow(found: Readings, roles: Roles, column: str, hints: ColumnHints) -> Readings:
    """Return bearings clockwise from north: bearings from the bow plus the heading of their row.

    `column` has the headings, clockwise from north. `hints` may state the convention, and the unit if the column name
    has none. Raise InvalidProblem if a bearing has no heading, the unit is unknown, or magnetic headings have no
    declination.
    """
    table = roles.table
    if "mag" in stem(column) and hints.declination is None:
        advice = "give it with --declination, such as '4 deg' or the date 2026-06-01"
        raise InvalidProblem(
            f"the headings {column!r} are magnetic, and the declination is unknown", table.source, advice
        )
    # `nothing` has the numbers that mean no heading, as `--missing` states.
    column_values, nothing = numbers(table, column), marks_of(hints) or frozenset()
    given = dict(zip(column_values.row.tolist(), column_values.values.tolist(), strict=True))
    lacking = next((row for row in found.row.tolist() if given.get(row) is None or given[row] in nothing), None)
    if lacking is not None:
        advice = "remove the row, or use --azimuth north-clockwise if the bearings are true bearings"
        raise InvalidProblem("the bearing has no heading", table.where(column, lacking), advice)
    used = [given[row] for row in found.row.tolist()]  # the heading of each bearing
    unit = _unit(column, used, hints, table.where(column))
    full_turn = in_unit(Decimal(360), "deg", unit, found.form)
    wrong = next((i for i, heading in enumerate(used) if abs(heading) > full_turn * Decimal("1.0001")), None)
    if wrong is not None:
        spot = table.where(column, int(found.row[wrong]))
        raise InvalidProblem(f"the heading {used[wrong]:f} {unit} is more than a full turn", spot, "remove the row")
    sums = [
        value + in_unit(heading, unit, found.unit, found.form)
        for value, heading in zip(found.values.tolist(), used, strict=True)
    ]
    # A decimal remainder has the sign of the number: add a turn, so that bearings are from zero to a full turn.
    if found.unit in _FULL_TURN:
        full_turn = _FULL_TURN[found.unit]
        sums = [(value % full_turn + full_turn) % full_turn for value in sums]
    note = f"bearings are read as clockwise from the bow of the vehicle; the heading in column {column!r} is added"
    note += "" if hints.azimuth == BOW else f"; --azimuth {COMPASS} reads them as true bearings"
    return replace(found, values=Decimals.of(sums), azimuth=COMPASS, heading=column, notes=(note, *found.notes))


def stations_turned(stations: ColumnPlaces, found: Sequence[Readings]) -> tuple[ColumnPlaces, str]:
    """Return the stations, with headings if bearings are relative to the headings of stations, and a note.

    `stations` may have a column of headings. Raise InvalidProblem for a station that measures a bearing but has no
    heading, and for headings of stations and of a vehicle at once.
    """
    if "heading_deg" not in stations.columns:
        return stations, ""
    headings = stations.columns["heading_deg"]
    bearings = [one for one in found if one.form.kind == "azimuth"]
    if not bearings:
        kept = {name: column for name, column in stations.columns.items() if name != "heading_deg"}
        return replace(stations, columns=kept), ""
    if any(one.heading is not None for one in bearings):
        what = "the headings of stations and the headings of a vehicle are both given"
        raise InvalidProblem(what, "--stations", "remove one of the columns")
    used = {str(name) for one in bearings for name in one.a.tolist()}
    lacking = next((n for n, v in zip(stations.names, headings, strict=True) if n in used and np.isnan(v)), None)
    if lacking is not None:
        raise InvalidProblem(
            f"station {lacking!r} has no heading", "--stations", "give a heading for each station, 0 for north"
        )
    # A station without bearings may lack a heading. Zero is then stored, without an effect.
    note = "bearings are relative to the headings of the stations in their table; remove them if they are true"
    return replace(stations, columns={**stations.columns, "heading_deg": np.nan_to_num(headings)}), note


def _unit(column: str, headings: list[Decimal], hints: ColumnHints, where: str) -> str:
    """Return the unit of headings: from the column name, from --unit, or from their size.

    `headings` are the values of the column, without empty cells. If any exceeds a full turn in radians, the unit is the
    degree.
    """
    known = UNITS["angle"]
    stated = unit_of(column, known) or (hints.unit if hints.unit in known else None)
    if stated is None and any(abs(value) > _RADIANS for value in headings):
        return "deg"
    if stated is None:
        advice = f"rename it to {column}_deg or {column}_rad, or use --unit"
        raise InvalidProblem(f"the unit of the column {column!r} is unknown", where, advice)
    return stated
