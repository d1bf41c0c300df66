"""Conversion of measurement tables to problem files: receiver readings, pseudoranges, stations, satellite orbits.

A `TableProblem` has the sections of the problem file. `optloc convert` writes it, and other commands read it directly.
In the functions, `hints` has the facts that the table does not contain, as stated by options. `roles` has the table and
the roles of its columns. `stations` has the stations with their positions.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.outputs import claim
from optloc.base.types import Array
from optloc.base.units import UNITS
from optloc.files.cell_text import Decimals
from optloc.files.columns import PLACE, is_sigma, role_named, role_of, stem
from optloc.files.crust import crust_of
from optloc.files.csv_formats import read_table
from optloc.files.declination import declination_of
from optloc.files.headings import stations_turned
from optloc.files.lone_columns import text_columns
from optloc.files.measurements import ESTIMATE
from optloc.files.picks import phase_sigmas, waves_of
from optloc.files.pseudoranges import is_gnss
from optloc.files.reading_report import check_receivers, reading_lines, unused_columns, uses_of
from optloc.files.roles import ColumnPlaces, Roles, in_space, places_of
from optloc.files.satellite_tables import AT_RECEPTION, gnss, pseudoranges, write_satellites
from optloc.files.shapes import epoch_lines, epochs_of, read_inline, read_long, read_wide
from optloc.files.table import Table
from optloc.files.table_import import (
    CONVENTIONS,
    ColumnHints,
    Form,
    Named,
    Readings,
    as_angles,
    holds_names,
    named_columns,
    sigmas_by_kind,
    sort_named,
    sorts_of,
    without_ignored_columns,
)
from optloc.files.table_problem import Converted, Section, TableProblem, no_sigma
from optloc.files.table_wave import with_wave
from optloc.files.words import equal_rows
from optloc.files.writer import write_csv
from optloc.models import MODELS, kind_named
from optloc.problem.problem import Problem

INPUTS = ("arrivals", "picks", "sp", "excess", "pseudoranges", "stations")

# File endings of orbits. With --times, each file is read as orbits.
_ORBITS = (".tle", ".2le", ".3le", ".sp3", ".omm")
# Arrivals that locate a target in the plane; a note reports epochs with fewer.
_FEW = 3


def convert(
    source: Path,
    out: Path,
    hints: ColumnHints | None = None,
    *,
    tell: Callable[[TableProblem], object] = lambda _: None,
    **options: Any,
) -> Converted:
    """Write a table as a problem file.

    Parameters
    ----------
    source : Path
        Receiver readings or pseudoranges as CSV, Parquet or JSON; pseudoranges as RINEX (with a navigation file) or as
        an Android log; stations as a table or as GeoJSON; or satellite orbits as two-line elements, OMM (JSON, CSV) or
        SP3.
    out : Path
        Problem file to write, .toml; its tables are CSV files in the same folder. For stations alone, the CSV file.
    hints : ColumnHints, optional
        Facts that the table does not contain.
    tell : callable, optional
        Receives the problem of the table before it is written.
    **options
        Single fields of `ColumnHints`.

    Returns
    -------
    Converted
        The files, and the problem that the reader makes of them.

    Raises
    ------
    InvalidProblem
        The message names the file, the row and the column.
    """
    hints = replace(hints or ColumnHints(), **options)
    _check_hints(hints)
    claim(out, inputs=[source, *(path for path in (hints.stations, hints.times) if isinstance(path, Path))])
    if hints.times is not None or source.suffix.lower() in _ORBITS:
        assert not isinstance(hints.stations, Table)
        return write_satellites(source, out, hints.columns, hints.times, hints.stations)
    if hints.what == "stations" or source.suffix.lower() == ".geojson":
        return _write_stations(source, out, hints.columns, hints.frame)
    if out.suffix.lower() != ".toml":
        raise InvalidProblem("the name of a problem file must end in .toml", str(out), "change the name after --out")
    table_problem = interpret_table(source, hints)
    tell(table_problem)
    claim(*table_problem.tables(out), inputs=[source, *(path for path in (hints.stations,) if isinstance(path, Path))])
    # Read before writing, so that an invalid problem is not written.
    loaded = table_problem.read()
    return Converted(table_problem.write(out), loaded, table_problem.notes, table_problem.as_read)


def load_table(source: str | Path, **options: Any) -> Problem:
    """Return the problem of a file of readings, as ``optloc fix`` reads it.

    The format is recognised by the content: a table, HYPO71 or NonLinLoc picks, QuakeML, opensoundscape events, RINEX
    and the others that `convert` reads.

    Parameters
    ----------
    source : str or Path
        File of readings.
    **options
        Fields of `ColumnHints`, such as ``stations="net.csv"``, ``sigma="0.1 s"``, ``vp="6 km/s"`` and
        ``vs="3.5 km/s"``.

    Raises
    ------
    InvalidProblem
        The message names the file, the row and the column.
    """
    paths = {name: Path(options[name]) for name in ("stations", "navigation", "times") if options.get(name) is not None}
    known = [*ColumnHints.__dataclass_fields__]
    unknown = next((name for name in options if name not in known), None)
    if unknown is not None:
        raise InvalidProblem(f"there is no option {unknown!r}", unknown, nearest(unknown, known))
    hints = ColumnHints(**(options | paths))
    _check_hints(hints)
    return interpret_table(Path(source), hints).read().problem


def _check_hints(hints: ColumnHints) -> None:
    """Raise InvalidProblem for unknown roles, frames and conventions."""
    for role in hints.columns:
        role_named(role)
    choices = {"frame": ("cartesian", "ecef"), "azimuth": CONVENTIONS, "positive": ("a-farther", "b-farther")}
    for name, known in choices.items():
        given = getattr(hints, name)
        if given not in (None, *known):
            raise InvalidProblem(f"there is no {name} {given!r}", f"--{name}", nearest(str(given), known))
    if hints.what is not None and hints.what not in INPUTS:
        _sort(hints.what)


def _sort(word: str) -> str:
    """Return the sort of readings for a word of --as: "arrivals", "picks", "sp", "excess", or a measurement kind.

    Raise InvalidProblem for an unknown word, or a kind without stations.
    """
    if word in ("arrivals", "picks", "sp", "excess"):
        return word
    try:
        kind = kind_named(word, "--as")
    except InvalidProblem:
        raise InvalidProblem(f"there is no input {word!r}", "--as", nearest(word, [*INPUTS, *MODELS])) from None
    if not MODELS[kind].stations:
        raise InvalidProblem(f"{kind} has no stations", "--as", "write it in the problem file")
    return "arrivals" if kind == "toa" else kind


def interpret_table(source: Path, hints: ColumnHints, table: Table | None = None) -> TableProblem:
    """Return the problem of a table of readings or pseudoranges; `hints` has the facts that the table does not contain.

    The table is read from the file `source`, unless it is given as `table`.

    Raises
    ------
    InvalidProblem
        For errors, and for ambiguous content; then the message names the option that decides.
    """
    _check_hints(hints)
    if table is None and is_gnss(source):
        table_problem = gnss(source, hints)
    else:
        table_problem = _of_table(source, hints, read_table(source) if table is None else table)
    azimuths = any(section.kind == "azimuth" for section in table_problem.sections)
    if hints.declination is not None and not azimuths:
        raise InvalidProblem("the table has no bearings", "--declination", "remove this option")
    if hints.turned and AT_RECEPTION != table_problem.lines:
        raise InvalidProblem("the table has no satellites", "--turned", "remove this option")
    stated = table_problem.height if hints.height is None else _stated_height(hints.height)
    return with_wave(replace(table_problem, height=stated), hints.wave)


def _of_table(source: Path, hints: ColumnHints, table: Table) -> TableProblem:
    """Return the problem of a measurement table.

    The table has pseudoranges with satellites, or columns that are named after stations, or one reading in each row.
    Raise InvalidProblem if its content or the positions of its stations are unknown.
    """
    table = without_ignored_columns(table, hints.ignore)
    stated_columns = {role: name for role, name in hints.columns.items() if hints.stations is None or role not in PLACE}
    roles = Roles.of(table, stated_columns)
    # Arrivals with the name and position of a satellite in each row are pseudoranges.
    satellites = all(roles.find(role) for role in ("toa", "satellite", "x"))
    if (hints.what == "pseudoranges" and roles.find("satellite")) or (hints.what is None and satellites):
        return pseudoranges(source, roles, hints)
    hints = hints if hints.what is None else replace(hints, what=_sort(hints.what))
    named: list[Named] = []
    if hints.stations is not None:
        stations = places_of(hints.stations, {k: name for k, name in hints.columns.items() if k in PLACE}, hints.frame)
        named = _of_receivers(roles, stations)
        chosen = [one for one in named if _may_be(one, hints)]
        if len(chosen) > 1 and not _is_long(roles, hints, stations):
            roles = Roles.of(table, stated_columns, [one.column for one in chosen]).without_stations()
            return _plan(roles, hints, stations, source, read_wide(roles, hints, chosen, stations), named)
        roles = _with_station(roles, stations)
    roles = as_angles(roles, hints)
    sorts, receivers = sorts_of(roles, hints), None
    if not sorts:
        raise _unknown(roles, hints)
    if hints.stations is None:
        if roles.find("lat") is None and roles.find("x") is None:
            advice = "give a table or GeoJSON file with --stations"
            raise InvalidProblem("the station positions are unknown", "--stations", advice)
        stations, receivers = read_inline(roles, hints)
    forms = [sort_named(name) for name in sorts]
    roles = _with_transmitters(roles, forms, stations)
    return _plan(
        roles,
        hints,
        stations,
        source,
        [read_long(roles, form, hints, stations, receivers, forms) for form in forms],
        named,
    )


def _of_receivers(roles: Roles, stations: ColumnPlaces) -> list[Named]:
    """Return the columns that are named after stations, without columns that have another role.

    Other roles are stated roles, and columns of station names.

    Raises
    ------
    InvalidProblem
        For a column whose name is both a station and a role, if its cells do not decide.
    """
    taken = {part for role in roles.stated for part in roles.by_role[role].split("+")}
    found = [one for one in named_columns(list(roles.table.columns), stations.names) if one.column not in taken]
    kept = []
    for one in found:
        role = role_of(one.column)
        if role in ("station", "reference", "name", "id") and holds_names(roles.table, one.column, stations.names):
            continue
        kept.append(one)
    return kept


def _is_long(roles: Roles, hints: ColumnHints, stations: ColumnPlaces) -> bool:
    """Return whether a table has one reading in each row: a column of stations and a column of readings."""
    if "station" in roles.stated:
        return True
    station = roles.find("station")
    if station is None or not holds_names(roles.table, station, stations.names):
        return False
    # If receivers have columns of readings, a time column is the time of these readings, not a reading.
    return bool({*sorts_of(roles, hints)} - {"times"})


def _with_station(roles: Roles, stations: ColumnPlaces) -> Roles:
    """Return roles in which the only column of station names is the station, if no word identifies a column.

    The second station of a row, if its column has a known name, is no choice for the first.
    """
    if roles.find("station") is not None:
        return roles
    taken = {part for role in roles.stated for part in roles.by_role[role].split("+")}
    taken |= {roles.by_role[role] for role in ("reference", "transmitter") if role in roles.by_role}
    found = [name for name in text_columns(roles.table, taken) if holds_names(roles.table, name, stations.names)]
    if len(found) != 1 or role_of(found[0]) is not None:
        return roles
    note = f"the column {found[0]!r} has the station of each row; --column station=NAME states another"
    table = replace(roles.table, notes=(*roles.table.notes, note))
    return replace(roles, table=table, by_role={**roles.by_role, "station": found[0]})


def _with_transmitters(roles: Roles, forms: Sequence[Form], stations: ColumnPlaces) -> Roles:
    """Return roles in which the column of transmitters is the second station of sums of ranges.

    A column such as "transmitter" names targets in other tables. Here it names stations, if all its cells are stations.
    """
    if not all(form.kind == "range_sum" for form in forms) or roles.find("reference") is not None:
        return roles
    found = next((role for role in ("transmitter", "target") if roles.find(role) is not None), None)
    if found is None or not holds_names(roles.table, roles.column(found), stations.names):
        return roles
    kept = {role: column for role, column in roles.by_role.items() if role != found}
    return replace(roles, by_role={**kept, "reference": roles.column(found)})


def _unknown(roles: Roles, hints: ColumnHints) -> InvalidProblem:
    """Return the error for a table whose columns do not identify its content."""
    columns = list(roles.table.columns)
    what = f"the columns {', '.join(columns)} do not identify the content"
    advice = f"state it with --as {', --as '.join(INPUTS)} or a kind, and state columns with --column ROLE=NAME"
    if hints.stations is None:
        advice += "; columns that are named after receivers need --stations"
    return InvalidProblem(what, roles.table.source, advice)


def _may_be(one: Named, hints: ColumnHints) -> bool:
    """Return whether a column that is named after stations can have the sort of readings that `--as` states."""
    return hints.what is None or one.form in (None, hints.what)


# From readings to the tables of a problem file.


def _plan(
    roles: Roles,
    hints: ColumnHints,
    stations: ColumnPlaces,
    source: Path,
    found: Sequence[Readings],
    named: Sequence[Named],
) -> TableProblem:
    """Return the problem of readings.

    `found` are the sorts of readings in the table. `named` are the columns that are named after stations.
    """
    # Kinds that do not exist in the plane need stations in space.
    stations = in_space(stations) if any(2 not in MODELS[one.form.kind].dimensions for one in found) else stations
    stations, heading_note = stations_turned(stations, found)
    epochs = epochs_of(roles, hints, found)
    _check_unit(hints, found)
    sigmas = _sigmas(hints, found)
    uses = uses_of(roles, hints, found, epochs, sigmas)
    check_receivers(roles.table, uses, named, stations.names)
    rest = unused_columns(roles, uses, named)
    parts = zip(found, sigmas, strict=True)
    sections = tuple(_with_declination(_section(one, epochs, sigma), one, hints) for one, sigma in parts)
    notes = [*roles.table.notes, *(one.notes[0] for one in found if one.heading is not None)]
    notes += [note for note in (heading_note, stations.note) if note]
    notes += dict.fromkeys(note for one in found for note in one.notes if note not in notes)
    lines, after, frame, sections, speeds = _with_waves(sections, found, hints, stations)
    after += epoch_lines(hints, epochs, roles.table.source)
    replaced = [name for name in rest if is_sigma(stem(name))] if hints.sigma is not None else []
    notes += [f"--sigma replaces the column {name}; remove one of them" for name in replaced]
    height, note = _height(found, stations)
    notes += [*_few(sections, hints), *([note] if note else [])]
    read = [
        *reading_lines(roles, hints, stations, found, epochs, uses),
        *([("waves", speeds)] if speeds else []),
        *([("not used", ", ".join(rest))] if rest else []),
    ]
    found_text = tuple(read), tuple(notes)
    return TableProblem(source, sections, stations, *found_text, lines, after, height, uses, frame, epochs)


def _check_unit(hints: ColumnHints, found: Sequence[Readings]) -> None:
    """Raise InvalidProblem for a stated unit that no sort of readings can have, such as degrees for times."""
    known = [list(UNITS[one.form.quantity]) for one in found]  # type: ignore[index]  # models hold known quantities only
    if hints.unit is not None and not any(hints.unit in units for units in known):
        what = f"{hints.unit!r} is not a unit of {found[0].form.text}"
        raise InvalidProblem(what, "--unit", nearest(hints.unit, known[0]))


def _stated_height(given: str) -> str:
    """Return the line of a problem file for a height of the options, or for a list of heights."""
    parts = [part.strip() for part in given.split(",")]
    return f"exactly = {json.dumps(given)}" if len(parts) < 2 else f"one_of = {json.dumps(parts)}"


def _height(found: Sequence[Readings], stations: ColumnPlaces) -> tuple[str, str]:
    """Return a height constraint for a target on Earth, as a line of a problem file, and a note; empty texts for none.

    Azimuths alone do not determine the height, so the mean height of the stations is assumed. S minus P times are of
    earthquakes, which are below the highest station, and so are picks of P and S waves.
    """
    if stations.frame != "geodetic":
        return "", ""
    heights, unit = stations.columns["height"], stations.unit
    if all(one.form.kind == "azimuth" for one in found):
        mean = round(float(heights.mean()), 3)
        remark = (
            f"bearings do not determine the height: {mean:g} {unit} is assumed, the mean of the stations, or --height"
        )
        return f'exactly = "{mean!r} {unit}"', remark
    if any(one.form.value in ("sp", "picks") for one in found):
        top = float(heights.max())
        remark = f"the earthquake is assumed below the highest station, {top:g} {unit}; --height states other limits"
        return f'max = "{top!r} {unit}"', remark
    return "", ""


def _sigmas(hints: ColumnHints, found: Sequence[Readings]) -> list[str | None]:
    """Return the standard deviation of each sort of readings as text; None if the table has a column of them.

    The option `--sigma` has one value for all sorts, or a value for each kind, such as "tdoa=20 ns,azimuth=1 deg".
    """
    if hints.sigma is None or phase_sigmas(hints) is not None:
        for one in found:
            if one.sigma is None:
                raise no_sigma("20 ns", one.form.kind if len(found) > 1 else "rows")
        return [None] * len(found)
    if "=" not in hints.sigma:
        if len({one.form.quantity for one in found}) > 1:
            advice = "write --sigma '" + ",".join(f"{one.form.kind}=1 {one.unit}" for one in found) + "'"
            raise InvalidProblem("the readings have several kinds, and each needs a sigma", "--sigma", advice)
        return [hints.sigma if one.sigma is None else None for one in found]
    given = sigmas_by_kind(hints.sigma)
    other = next((kind for kind in given if kind not in {one.form.kind for one in found}), None)
    if other is not None:
        raise InvalidProblem(f"the table has no readings of {other}", "--sigma", f"remove {other}")
    lacking = next((one.form.kind for one in found if one.form.kind not in given and one.sigma is None), None)
    if lacking is not None:
        raise InvalidProblem(f"{lacking} has no sigma", "--sigma", f"add {lacking}=AMOUNT after a comma")
    return [given.get(one.form.kind) if one.sigma is None else None for one in found]


def _with_waves(
    sections: tuple[Section, ...],
    found: Sequence[Readings],
    hints: ColumnHints,
    stations: ColumnPlaces,
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...], tuple[Section, ...], str]:
    """Return lines of the file for P and S waves, the sections with their phases, and their speeds for the report.

    The lines are before the tables, after them, and in the frame. Raise InvalidProblem for speeds of P and S waves
    that no reading uses.
    """
    if any(one.form.value == "sp" for one in found):
        crust = crust_of(hints, with_s=True)
        if crust.speed is None or crust.vp_vs is None:
            raise InvalidProblem("S minus P alone needs two speeds", "--vp", "leave --as sp out to use layers")
        speed = crust.speed / (crust.vp_vs - 1.0)
        words = f"S minus P times {speed:.6g} m/s, vp vs / (vp - vs), is a range (straight rays, constant speeds)"
        return (f"propagation_speed = {speed!r}",), (), (), sections, words
    if found[0].form.value != "picks":
        if hints.vp is not None or hints.vs is not None:
            advice = "remove this option, use --wave-speed for other waves, or name the columns with --column p=, s="
            raise InvalidProblem("the table has no picks of P and S", "--vp" if hints.vp else "--vs", advice)
        return (), (), (), sections, ""
    waves = waves_of(found[0])
    crust = crust_of(hints, with_s=waves is not None)
    if waves is not None:
        section = sections[0]
        lines = (*section.lines, f"vp_vs = {crust.ratio}")
        sections = (replace(section, columns={**section.columns, "phase": waves}, lines=lines),)
    heights = stations.columns.get("height", stations.columns.get("z"))
    highest = 0.0 if heights is None else float(np.max(heights)) * UNITS["length"][stations.unit]
    return crust.lines, crust.medium(highest), crust.frame(stations), sections, crust.note


def _section(found: Readings, epochs: Mapping[str, Array], sigma: str | None) -> Section:
    """Return the section of a problem file for one sort of readings, as the columns and settings of its table.

    `epochs` are columns of the source table that determine epochs. `sigma` is the standard deviation as text; None if
    it is a column. Times of arrival are stored relative to the first arrival of each message.
    """
    columns: dict[str, Any] = {name: column[found.row] for name, column in epochs.items()}
    values, text, after = found.values, found.form.text, list[str]()
    if found.form.kind == "toa":
        timed = "time" in columns
        values, text = _from_first(found, columns), "arrivals, relative to the first of each message"
        if not timed and "time" in columns:
            after = [f'after = "{"date" if found.dated else "time"}"']
    columns |= {"a": found.a} | ({} if found.b is None else {"b": found.b}) | {"z": values}
    if found.sigma is not None and sigma is None:
        columns["sigma"] = found.sigma
    lines = [f'azimuth = "{found.azimuth}"'] if found.azimuth is not None else []
    lines += after
    lines += ["excess = true"] if found.form.value == "excess" else []
    lines += [f'positive = "{found.positive}"'] if found.positive != "a-farther" else []
    if found.b is not None and sigma not in (None, ESTIMATE) and MODELS[found.form.kind].signs == (1, -1):
        # As in `optloc.locate`, differences share the errors of their stations, each with half of the variance.
        lines += [
            f'arrival_sigma = "{_sigma_of_one_station(str(sigma), found.unit)}"    # of one station, sigma / sqrt(2)'
        ]
        sigma = None
    return Section(found.form.kind, columns, found.unit, sigma, text, tuple(lines))


def _with_declination(section: Section, found: Readings, hints: ColumnHints) -> Section:
    """Return a section of bearings with the stated declination."""
    if hints.declination is None or found.form.kind != "azimuth":
        return section
    declination_of(hints.declination, found.azimuth, None, "--declination")
    return replace(section, lines=(*section.lines, f"declination = {json.dumps(hints.declination.strip())}"))


def _sigma_of_one_station(sigma: str, unit: str) -> str:
    """Return the standard deviation of one station as text with a unit, from `sigma` of a difference: sigma / sqrt(2).

    `unit` applies if `sigma` has no unit. A text that is not a number is returned unchanged.
    """
    number, stated_unit = re.fullmatch(r"\s*([-+.\deE]*)\s*(.*?)\s*", sigma, re.DOTALL).groups()  # type: ignore[union-attr]
    try:
        return f"{float(number) / np.sqrt(2.0):.9g} {stated_unit or unit}"
    except ValueError:  # the reader of the file reports the error
        return sigma


def _from_first(found: Readings, columns: dict[str, Any]) -> Decimals:
    """Return arrivals relative to the first arrival of their message, in the unit of the table.

    Recent times in nanoseconds have 19 digits, a float has 16, so differences are taken before rounding. If `columns`
    has no time, the time of each first arrival, s, is added, unless arrivals are already relative.
    """
    keys = [columns[name] for name in ("epoch", "time", "target") if name in columns]
    _, message = equal_rows(keys, len(found.values))
    order = np.lexsort((found.values.units, message))
    first = order[np.unique(message[order], return_index=True)[1]]
    # If all messages begin with the same number, arrivals are already relative and have no date.
    dated = found.unit in UNITS["time"] and len(np.unique(found.values.units[first])) == len(first)
    if dated and "time" not in columns:
        factor = Decimal(repr(UNITS["time"][found.unit]))
        begins = np.array([float(value * factor) for value in found.values.take(first).tolist()])
        columns["time"] = begins[message]
    return found.values.since(first, message)


def _few(sections: Sequence[Section], hints: ColumnHints) -> list[str]:
    """Return a note on messages with fewer than three receivers, or on times with one reading; empty without either."""
    names = [name for name in ("epoch", "target") if name in sections[0].columns] or ["time"]
    columns_of_sections = [section.columns for section in sections if set(names) <= set(section.columns)]
    if not columns_of_sections:
        return []
    columns = [np.concatenate([part[name] for part in columns_of_sections]) for name in names]
    counts = np.bincount(equal_rows(columns, len(columns[0]))[1])
    few = int((counts < _FEW).sum())
    if sections[0].kind == "toa" and few:
        return [f"{few} of {len(counts)} messages were received by fewer than three stations; add stations to fix them"]
    if len(counts) > 1 and counts.max() == 1 and hints.window is None:
        advice = "use --still if the target does not move, or --window '0.1 s' to join readings within 0.1 s"
        return [f"each of the {len(counts)} times has one reading: {advice}"]
    return []


# Stations alone, and satellites.


def _write_stations(source: Path, out: Path, stated_columns: Mapping[str, str], frame: str | None) -> Converted:
    """Write a table of stations as CSV, and return its file.

    `stated_columns` has the stated roles of columns. `frame` is the stated frame, or None.
    """
    if out.suffix.lower() != ".csv":
        what = "stations alone are not a problem; they are written as a CSV table"
        raise InvalidProblem(what, str(out), "use the ending .csv after --out, or convert the measurements")
    found = places_of(source, stated_columns, frame)
    write_csv(out, found.columns)
    return Converted((out,), None, (found.note,) if found.note else ())
