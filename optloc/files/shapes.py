"""Long and wide tables of readings: one reading in each row, or a column for each receiver.

In the functions, `roles` has the table and the roles of its columns. `hints` has the options, and `stations` the
stations. A form is a sort of readings, such as arrivals or ranges. In shapes, m is the number of readings, and n the
number of rows of the table.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from decimal import Decimal
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.time_scales import TIME_SCALES
from optloc.base.types import Array
from optloc.base.units import SPEED_OF_LIGHT, UNITS
from optloc.files.cell_text import Decimals, NumberColumn, column_times, date_seconds, date_texts, is_dated, numbers
from optloc.files.columns import any_unit, sigma_kind, stem, unit_of
from optloc.files.headings import from_bow, heading_of
from optloc.files.lone_columns import without_difference
from optloc.files.picks import differences, read_picks
from optloc.files.repeated_readings import without_repeats
from optloc.files.roles import ColumnPlaces, Roles, placed
from optloc.files.settings import Units
from optloc.files.table import Table
from optloc.files.table_import import (
    CARTESIAN,
    COMPASS,
    ColumnHints,
    Form,
    Named,
    NoReading,
    Readings,
    in_unit,
    name_of_stations,
    sort_named,
    stated_sigma,
    unit_for,
    without_gaps,
)
from optloc.files.words import equal_rows, numbered
from optloc.models import BEARING

# Largest number of column names in a message.
_SHOWN = 4


# Wide tables: a column for each receiver, or for each pair.


def read_wide(roles: Roles, hints: ColumnHints, columns: Sequence[Named], stations: ColumnPlaces) -> list[Readings]:
    """Return the readings of a wide table, one set for each sort; raise InvalidProblem if the sort is unknown.

    `columns` are the columns that are named after stations.
    """
    sorts: dict[str, list[Named]] = {}
    for one in columns:
        if one.sigma:
            continue
        name = one.form or hints.what or ("tdoa" if one.minus else None)
        if name is None:
            shown = ", ".join(repr(each.column) for each in columns[:_SHOWN])
            advice = "state it with --as arrivals, --as range, --as tdoa or another kind"
            raise InvalidProblem(f"columns such as {shown} do not identify their content", roles.table.source, advice)
        sorts.setdefault(name, []).append(one)
    errors = [one for one in columns if one.sigma]
    forms = {name: sort_named(name) for name in sorts}
    return [_wide_sort(roles, forms[name], hints, chosen, errors, stations, forms) for name, chosen in sorts.items()]


def _wide_sort(
    roles: Roles,
    form: Form,
    hints: ColumnHints,
    columns: Sequence[Named],
    errors: Sequence[Named],
    stations: ColumnPlaces,
    forms: Mapping[str, Form],
) -> Readings:
    """Return the readings of one sort of a wide table.

    `columns` are the columns of this sort. `errors` are the columns of standard deviations, and `forms` all sorts of
    the table by name.
    """
    table = roles.table
    values: list[Decimals] = []
    rows, ends, notes = [], [], []
    deviations: list[Array] = []
    errors_used: list[str] = []
    first, empty = "", 0  # unit of the first column, to which the other columns are converted; number of empty cells
    for one in columns:
        dated = form.quantity == "length" and is_dated(table, one.column)
        cells = date_seconds(table, one.column, hints.zone) if dated else numbers(table, one.column)
        unit, note = ("s", "") if dated else unit_for(one.column, form, hints, cells.values, table.source)
        first = first or unit
        notes += [note] if note else []
        empty += table.count - len(cells.row)
        values.append(_in_unit(cells.values, unit, first, form))
        rows.append(cells.row)
        ends.append(_ends(one, form, hints, table.source))
        sigma_name = next((each.column for each in errors if _is_error_of(each, one, form)), None)
        sigma_name = None if stated_sigma(hints, form.kind) is not None else sigma_name
        sigma_name = sigma_name or sigma_column(roles, form, hints, list(forms.values()))
        if sigma_name is not None:
            deviations.append(sigma_of(table, sigma_name, form, first, cells.row))
            errors_used.append(sigma_name)
    if not any(map(len, values)):
        raise NoReading("no cell has a reading", table.source, "check the columns of the receivers")
    pairs = form.stations > 1
    # The name A-B, or one station and a stated reference, determine the sign: positive if the first is farther.
    minus = all(one.minus or len(one.ends) == 1 for one in columns)
    number = np.repeat(np.arange(len(columns)), list(map(len, values)))
    names, row = tuple(one.column for one in columns), np.concatenate(rows)
    a, b = (np.array(end, dtype=object)[number] for end in zip(*ends, strict=True))
    all_dated = form.quantity == "length" and all(is_dated(table, one.column) for one in columns)
    found = Readings(
        form, first, Decimals.join(values), row, names, number, a, b if pairs else None, notes=tuple(notes),
        dated=all_dated,
    )  # fmt: skip
    # Standard deviations of a part of the columns are not used.
    if len(deviations) == len(columns):
        found = replace(found, sigma=np.concatenate(deviations), errors=tuple(dict.fromkeys(errors_used)))
    return _checked(found, roles, hints, stations, empty, "a-farther" if minus else None)


def _in_unit(values: Decimals, unit: str, wanted: str, form: Form) -> Decimals:
    """Return numbers in the unit `wanted` instead of `unit`, with all their digits; `form` determines the quantity."""
    if unit == wanted:
        return values
    return Decimals.of([in_unit(value, unit, wanted, form) for value in values.tolist()])


def _is_error_of(error: Named, one: Named, form: Form) -> bool:
    """Return whether the column `error` has the standard deviations of the column `one` of the same receivers."""
    kinds = (None, one.form, form.kind)
    return error.ends == one.ends and error.form in kinds and _allows(form, error.column)


def _allows(form: Form, column: str) -> bool:
    """Return whether a column name ends in a unit of a sort, or in no unit."""
    unit = any_unit(column)
    return unit is None or unit in UNITS[form.quantity]  # type: ignore[index]  # models hold known quantities only


def sigma_column(roles: Roles, form: Form, hints: ColumnHints, forms: Sequence[Form]) -> str | None:
    """Return the column of standard deviations of a sort of readings; None with --sigma, or without a column.

    `forms` are all sorts of the table. Raise InvalidProblem if the column may belong to several sorts.
    """
    if stated_sigma(hints, form.kind) is not None:
        return None
    named = roles.by_role.get(f"sigma_{form.kind}")
    named = named or next((name for name in roles.table.columns if sigma_kind(name) == form.kind), None)
    if named is not None and _allows(form, named):
        return named
    column = roles.find("sigma")
    if column is None or not _allows(form, column):
        return None
    others = [one for one in forms if _allows(one, column)]
    if (any_unit(column) is None and len({one.quantity for one in others}) > 1) or len(others) > 1:
        kinds = " or ".join(one.kind for one in others)
        advice = f"use --column sigma_{others[0].kind}={column}, or state all of them with --sigma"
        raise InvalidProblem(f"the column {column!r} may be the error of {kinds}", roles.table.source, advice)
    return column


def sigma_of(table: Table, column: str, form: Form, unit: str, pick: Array) -> Array:
    """Return the standard deviations (m,) of the readings in the rows `pick` (m,), in the unit of the readings.

    `column` has the standard deviations, and `unit` is the unit of the readings. Raise InvalidProblem for a reading
    without a standard deviation, or for a time in one column and a length in the other.
    """
    known = UNITS[form.quantity]  # type: ignore[index]  # models hold known quantities only
    column_unit = unit_of(column, known) or unit
    if (
        {column_unit, unit} & set(UNITS["time"])
        and not {column_unit, unit} <= set(UNITS["time"])
        and form.quantity == "length"
    ):
        advice = "give both in one unit, or use --sigma"
        raise InvalidProblem(
            f"the column is in {column_unit}, but the readings are in {unit}", table.where(column), advice
        )
    sigmas = numbers(table, column)
    # Number of the cell of each table row among the cells that are not empty; -1 for an empty cell.
    place = np.full(table.count, -1)
    place[sigmas.row] = np.arange(len(sigmas.row))
    lacking = pick[place[pick] < 0]
    if len(lacking):
        advice = "give a number, or remove the row"
        raise InvalidProblem("the reading has no standard deviation", table.where(column, int(lacking[0])), advice)
    return np.asarray(sigmas.values.floats()[place[pick]] * known[column_unit] / known[unit])


def _ends(one: Named, form: Form, hints: ColumnHints, source: str) -> tuple[str, str | None]:
    """Return the stations of the column `one` of a wide table; the second is None for one station.

    Raise InvalidProblem if the name has one station more or less than the sort needs, and no option states a reference.
    """
    if form.stations == 1 and len(one.ends) == 1:
        return one.ends[0], None
    if form.stations == 2 and len(one.ends) == 2:
        return one.ends
    if form.stations == 2 and hints.reference is not None:
        return one.ends[0], hints.reference
    if form.stations == 2:
        advice = "state the other with --reference STATION"
        raise InvalidProblem(f"{form.kind} needs two stations, {one.column!r} names one", source, advice)
    raise InvalidProblem(
        f"{form.kind} has one station, {one.column!r} names two", source, "state the content with --as"
    )


# Long tables: one reading in each row.


def read_inline(roles: Roles, hints: ColumnHints) -> tuple[ColumnPlaces, Array]:
    """Return the stations of a table with station positions in each row, and the station name of each row (m,)."""
    count = roles.table.count
    role = next((role for role in ("station", "name") if roles.find(role)), None)
    names = np.array([str(i + 1) for i in range(count)], dtype=object) if role is None else roles.labels(role)
    every = placed(roles, hints.frame, names)
    spots: dict[tuple[Any, ...], str] = {}
    seen: dict[str, int] = {}
    station_of_row, first = [], []
    # A key is the name and the coordinates of a row.
    for row, key in enumerate(zip(*(column.tolist() for column in every.columns.values()), strict=True)):
        if key not in spots:
            # A station with another position in another row becomes a new station: positions matter, not names.
            seen[key[0]] = seen.get(key[0], 0) + 1
            spots[key] = key[0] if seen[key[0]] == 1 else f"{key[0]} ({seen[key[0]]})"
            first.append(row)
        station_of_row.append(spots[key])
    columns = {key: column[first] for key, column in every.columns.items()}
    columns["name"] = np.array([station_of_row[row] for row in first], dtype=object)
    return replace(every, columns=columns), np.array(station_of_row, dtype=object)


def read_long(
    roles: Roles, form: Form, hints: ColumnHints, stations: ColumnPlaces, receivers: Array | None, forms: Sequence[Form]
) -> Readings:
    """Return the readings of one sort of a table with one reading in each row.

    `receivers` has the station of each row (n,) if no column has them. `forms` are all sorts of the table.
    """
    table = roles.table
    if form.value == "picks" or (form.value == "sp" and roles.find("sp") is None):
        return _read_phases(roles, form, hints, stations)
    column = roles.column(form.value)
    dated = form.quantity == "length" and is_dated(table, column)
    cells = date_seconds(table, column, hints.zone) if dated else numbers(table, column)
    unit, note = ("s", "") if dated else unit_for(column, form, hints, cells.values, table.source)
    pick = cells.row
    if not len(pick):
        raise NoReading("no cell has a reading", table.where(column), "check the column")
    a = roles.labels("station") if receivers is None else receivers
    found = _of_column(form, unit, cells, column, a)
    hints, why = _with_reference(found, roles, hints, stations)
    positive, b = ("a-farther", None) if form.stations == 1 else _second_station(roles, hints)
    notes = tuple(text for text in (note, why) if text)
    found = replace(found, b=None if b is None else b[pick], notes=notes, dated=dated)
    if (sigma_name := sigma_column(roles, form, hints, forms)) is not None:
        found = replace(found, sigma=sigma_of(table, sigma_name, form, unit, pick), errors=(sigma_name,))
    return _checked(found, roles, hints, stations, table.count - len(pick), positive)


def _read_phases(roles: Roles, form: Form, hints: ColumnHints, stations: ColumnPlaces) -> Readings:
    """Return the picks of P and S waves, or their differences for the form "sp"."""
    if form.value == "sp":
        return _checked(differences(roles, hints), roles, hints, stations, 0, "a-farther")
    found = read_picks(roles, hints)
    named = None if found.sigma is not None else sigma_column(roles, form, hints, [form])
    if named is not None:
        found = replace(found, sigma=sigma_of(roles.table, named, form, "s", found.row), errors=(named,))
    return _checked(found, roles, hints, stations, 0, "a-farther")


def _of_column(form: Form, unit: str, cells: NumberColumn, column: str, a: Array) -> Readings:
    """Return the readings of one column.

    `cells` are its numbers, in `unit`. `a` has the station of each row of the table.
    """
    return Readings(form, unit, cells.values, cells.row, (column,), np.zeros(len(cells.row), dtype=int), a[cells.row])


def _with_reference(
    found: Readings, roles: Roles, hints: ColumnHints, stations: ColumnPlaces
) -> tuple[ColumnHints, str]:
    """Return options with the only station without a difference as reference, and a note; unchanged if they state one.

    The stations need a separate table: the rows of differences alone may lack the reference.
    """
    lacking = hints.reference is None and roles.find("reference") is None and hints.stations is not None
    if found.form.stations == 1 or found.form.kind == "range_sum" or not lacking:
        return hints, ""
    name = without_difference(stations.names, found.a, found.values.units != 0)
    # A zero is the difference of the reference to itself for differences of times or lengths alone.
    if name is None or (found.form.kind != "tdoa" and name in found.a.tolist()):
        return hints, ""
    note = f"the reference is {name}, the only station without a difference; --reference states another"
    return replace(hints, reference=name), note


def _second_station(roles: Roles, hints: ColumnHints) -> tuple[str | None, Array]:
    """Return the sign of differences, and the second station of each row (n,).

    The sign is "a-farther" for a reference station, None if it is unknown.
    """
    column = roles.find("reference")
    if hints.reference is not None:
        return "a-farther", np.full(roles.table.count, hints.reference, dtype=object)
    if column is None:
        advice = "state it with --reference STATION, or state its column with --column reference=NAME"
        raise InvalidProblem("no column looks like the second station", roles.table.source, advice)
    is_reference = stem(column) in ("reference", "ref", "refstation", "b")
    return ("a-farther" if is_reference else None), roles.labels("reference")


# Checks for both forms: known stations, no missing readings, no repeats, sign and convention.


def _checked(
    found: Readings, roles: Roles, hints: ColumnHints, stations: ColumnPlaces, empty: int, positive: str | None
) -> Readings:
    """Return checked readings.

    Missing readings are removed, repeats are averaged or rejected, and sign and convention are set. `empty` is the
    number of empty cells. `positive` is the sign of differences that the table states; None if it is unknown. Raise
    InvalidProblem for an unknown station, a pair of equal stations, or an unknown sign.
    """
    table, known = roles.table, set(stations.names)
    for end in (found.a, found.b):
        for name in [] if end is None else numbered(end)[0]:
            if name not in known:
                where = table.source if hints.stations is None else name_of_stations(hints)
                column = roles.find("station") if len(found.columns) == 1 else None
                item = int(np.flatnonzero(end == name)[0])
                spot = found.where(table, item) if column is None else table.where(column, int(found.row[item]))
                raise InvalidProblem(f"there is no station {name!r} in {where}", spot, nearest(name, stations.names))
    if found.b is not None:
        found = _without_reference(found, table)
    found = _with_digits(found, table)
    columns = [column for key, column in epochs_of(roles, hints, [found]).items()]
    _, epoch = equal_rows(columns, table.count)
    found = without_gaps(found, epoch[found.row], hints, table, empty)
    if found.form.kind == "azimuth" and (heading := heading_of(found, roles, hints)) is not None:
        found = from_bow(found, roles, heading, hints)
    if not hints.still:
        label = (lambda row: str(columns[0][row])) if columns else (lambda _: "")
        found = without_repeats(found, epoch[found.row], hints, table, label)
    signed = found.form.stations > 1 and found.form.kind != "range_sum"
    if signed and hints.positive is None and positive is None:
        advice = "use --positive a-farther if the first is farther, else --positive b-farther"
        what = "the sign of differences is unknown: positive values may mean that the first or the second is farther"
        raise InvalidProblem(what, table.source, advice)
    found = replace(found, positive=hints.positive or positive or "a-farther")
    return _with_convention(found, hints, stations, table.source) if found.form.kind == "azimuth" else found


def _without_reference(found: Readings, table: Table) -> Readings:
    """Return differences without the rows of the reference station to itself, whose values are zero.

    Raise InvalidProblem for such a row with another value, or if no other row exists.
    """
    same = np.asarray(found.a) == np.asarray(found.b)
    wrong = np.flatnonzero(same & ((found.values.units != 0) | (found.form.kind != "tdoa")))
    if len(wrong) or same.all():
        item = int(wrong[0]) if len(wrong) else 0
        spot = table.at(int(found.row[item]))
        raise InvalidProblem(f"{found.form.kind} names station {found.a[item]!r} twice", spot, "name two stations")
    if not same.any():
        return found
    names = ", ".join(dict.fromkeys(np.asarray(found.a)[same].tolist()))
    note = f"zero readings of the reference station {names} to itself are left out: {int(same.sum())}; see --reference"
    return replace(found.take(np.flatnonzero(~same)), notes=(*found.notes, note))


# Significant digits of a recent time in seconds or nanoseconds; rounding, m, that has no effect on a fix.
_INSTANT, _ROUNDED = 9, 1.0


def _with_digits(found: Readings, table: Table) -> Readings:
    """Return arrivals with all their digits; raise InvalidProblem if a spreadsheet rounded them."""
    if found.form.kind != "toa":
        return found
    # A negative number of decimals means lost digits before the point, as in 1.7E12.
    for i in np.flatnonzero(found.values.written < 0).tolist():
        value = found.values[i]
        if len(value.as_tuple().digits) <= _INSTANT <= value.adjusted():
            advice = "write it with all digits; in a spreadsheet, format the column as text"
            raise InvalidProblem(f"the arrival {value:E} has lost its digits", found.where(table, i), advice)
    floats = any(table.raw(name).dtype.kind == "f" for name in found.columns)
    factor = UNITS["length"][found.unit] * (SPEED_OF_LIGHT if found.unit in UNITS["time"] else 1.0)
    step = float(np.spacing(np.abs(found.values.floats()).max())) * factor
    if not floats or step < _ROUNDED:
        return found
    note = f"arrivals are floating-point numbers, rounded to {step:.3g} m here; write text or integers for more digits"
    return replace(found, notes=(*found.notes, note))


def _with_convention(found: Readings, hints: ColumnHints, stations: ColumnPlaces, source: str) -> Readings:
    """Return azimuths with their convention: from the options, the column name or, on Earth, the compass."""
    named = any(word in stem(found.columns[0]) for word in (BEARING, "brg", "compass", "heading"))
    if found.heading is not None:  # `from_bow` has set the convention
        return found
    if hints.azimuth is not None or named:
        return replace(found, azimuth=hints.azimuth or COMPASS)
    if stations.frame == "cartesian":
        advice = f"use --azimuth {COMPASS} for a compass, or --azimuth {CARTESIAN} from the x axis"
        raise InvalidProblem("azimuths may count from north or from the x axis", source, advice)
    note = f"azimuths are read as compass bearings; --azimuth {CARTESIAN} changes this"
    return replace(found, azimuth=COMPASS, notes=(*found.notes, note))


def events_of_rows(roles: Roles, hints: ColumnHints) -> dict[str, Array]:
    """Return the columns epoch, time and target (n,) of the rows of a table without any reading, as `epochs_of`."""
    out = {"target": roles.labels("target")} if roles.find("target") is not None else {}
    if roles.find("message") is not None:
        out["epoch"] = roles.labels("message")
    name = roles.find("time")
    time = None if name is None else column_times(roles, name, hints.zone, hints.time_unit, hints.time_scale)
    if time is not None:
        out["time"] = time
    elif name is not None and "epoch" not in out:
        out["epoch"] = roles.labels("time")
    return out if out.keys() & {"epoch", "time"} else out | {"epoch": _row_numbers(roles.table)}


def _row_numbers(table: Table) -> Array:
    """Return the numbers of the rows of a table as text (n,), from 1."""
    return np.array([str(row + 1) for row in range(table.count)], dtype=object)


def epochs_of(roles: Roles, hints: ColumnHints, found: Sequence[Readings]) -> dict[str, Array]:
    """Return the available columns epoch, time and target (n,) of the rows of a table, by these names.

    Times are in seconds, or ISO 8601 text if the table has dates. Columns of readings are left out, as are times that
    are the readings. With `--still`, the result has at most the target: all rows are one epoch.
    """
    table, taken = roles.table, {name for one in found for name in one.columns}
    out: dict[str, Array] = {}
    # A table with one reading in each row has one column for each sort; picks may have a column for each wave.
    picks = found[0].form.value in ("sp", "picks")
    long = picks or len(taken) == len(found)
    if picks:
        taken |= {column for role in ("p", "s", "phase", "time") if (column := roles.find(role))}
    if long and (station := roles.find("station")):
        taken.add(station)
    target = roles.find("target")
    if target is not None and target not in taken:
        out["target"] = roles.labels("target")
        taken.add(target)
    if hints.still:
        return out
    message, when = (None if (name := roles.find(role)) in taken else name for role in ("message", "time"))
    if hints.window is not None and found[0].form.kind == "toa" and when is None and long:
        return out | {"epoch": _clusters(found[0], hints.window, table.count)}
    if hints.window is not None and when is None:
        raise _no_times()
    if message is not None and hints.window is None:
        out["epoch"] = roles.labels("message")
    time = None if when is None else column_times(roles, when, hints.zone, hints.time_unit, hints.time_scale)
    if time is not None:
        # Dates stay dates, so that labels of epochs and written files show them.
        out["time"] = date_texts(time) if is_dated(table, str(when)) else time
    elif when is not None and hints.window is not None:
        advice = "state it with --time-unit, such as --time-unit ns"
        raise InvalidProblem(f"the unit of the times in column {when!r} is unknown", table.source, advice)
    elif when is not None and message is None:
        out["epoch"] = roles.labels("time")
    # Without labels and times, each row of a wide table is an epoch.
    if not long and not out.keys() & {"epoch", "time"}:
        out["epoch"] = _row_numbers(table)
    return out


def epoch_lines(hints: ColumnHints, epochs: Mapping[str, Array], source: str) -> tuple[str, ...]:
    """Return the lines of a problem file on its times: the window of an epoch and the time scale.

    `epochs` are the columns that determine epochs, and `source` is the place for messages.
    """
    # With a column "epoch", the window was already used to make its labels.
    lines = [f"window = {json.dumps(hints.window)}"] if hints.window is not None and "epoch" not in epochs else []
    if hints.time_scale is not None:
        if hints.time_scale not in TIME_SCALES:
            what = f"{hints.time_scale!r} is not a time scale"
            raise InvalidProblem(what, "--time-scale", nearest(hints.time_scale, list(TIME_SCALES)))
        if "time" not in epochs:
            raise InvalidProblem(f"{source} has no column of times", "--time-scale", "state it with --column time=NAME")
        if epochs["time"].dtype.kind == "O":
            what = f"the times of {source} are dates, which have the scale utc"
            raise InvalidProblem(what, "--time-scale", "remove it, or convert the dates to UTC")
        lines.append(f"time_scale = {json.dumps(hints.time_scale)}")
    return ("", "[epochs]", *lines) if lines else ()


def _no_times() -> InvalidProblem:
    """Return the error for the option --window without a column of times."""
    advice = "state the time column with --column time=NAME, and its unit with --time-unit"
    return InvalidProblem("a window needs a column of times", "--window", advice)


def _clusters(found: Readings, window: str, count: int) -> Array:
    """Return the message of each row (n,) as text, from 1; empty for a row without an arrival.

    Arrivals that are less than a window apart belong to one message. `window` is text such as "0.1 s", and `count` the
    number of rows n.
    """
    # Arrivals in metres are times multiplied by the speed of light.
    seconds = Decimal(repr(UNITS["length"][found.unit]))
    seconds = seconds if found.unit in UNITS["time"] else seconds / Decimal(repr(SPEED_OF_LIGHT))
    factor = Decimal(repr(Units("time").plain(window, None, "--window"))) / seconds
    values, order = found.values, np.argsort(found.values.units, kind="stable")
    starts_message = np.diff(values.units[order]) > int(factor.scaleb(values.places))
    out = np.full(count, "", dtype=object)
    out[found.row[order]] = np.concatenate([[1], 1 + np.cumsum(starts_message)]).astype(str)
    return out
