"""Common tables as a problem file with CSV tables beside it: readings of receivers, pseudoranges, stations, orbits."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.frames import ECEF
from optloc.base.inputs import at_most
from optloc.base.outputs import claim, together, write_text
from optloc.base.types import Array
from optloc.base.units import UNITS
from optloc.files.cells import moments
from optloc.files.columns import PLACE, role_named, role_of, unit_of
from optloc.files.declination import angle_of, date_of
from optloc.files.foreign import read_table
from optloc.files.headings import stations_turned
from optloc.files.measurements import ESTIMATE
from optloc.files.orbits import read_orbits
from optloc.files.pseudoranges import at_reception, is_gnss, received
from optloc.files.reader import Loaded, read
from optloc.files.reading_report import about, left_over, uses_of
from optloc.files.readings import (
    CARTESIAN,
    CONVENTIONS,
    Named,
    Readings,
    Told,
    as_angles,
    holds_names,
    named_columns,
    sigmas_by_kind,
    sort_named,
    sorts_of,
    without,
)
from optloc.files.receiver_names import check_receivers
from optloc.files.roles import Places, Roles, check_told, in_space, places_of, scaled
from optloc.files.schema import ConstraintTable, Units
from optloc.files.shapes import epochs_of, inline, long, sigma_column, sigma_of, wide
from optloc.files.table import distinct
from optloc.files.writer import write_csv
from optloc.models import MODELS, kind_named

INPUTS = ("arrivals", "sp", "pseudoranges", "stations")

# Nothing is nearer to the centre of the Earth than its poles but what has another unit, metres.
_SURFACE = 6.4e6
# What files of orbits are called; where times are given, any file is one.
_ORBITS = (".tle", ".2le", ".3le", ".sp3", ".omm")
# Arrivals that place a target in the plane; of fewer the user is told.
_FEW = 3
# Letters of the name of a file that is not kept.
_LETTERS = 40


@dataclass(frozen=True, slots=True)
class Section:
    """One table of measurements: its kind, columns (m,), unit, noise, what it is, and further lines of the file."""

    kind: str
    columns: Mapping[str, Any]
    unit: str
    sigma: str | None
    text: str
    lines: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Plan:
    """What a table is understood to be, before anything is written.

    Parameters
    ----------
    source : Path
        The table.
    sections : tuple of Section
        The measurements.
    places : Places
        The stations.
    about : tuple of (str, str)
        What was understood: a word, and what it is.
    notes : tuple of str
        What was assumed or left out.
    lines : tuple of str
        Further lines of the problem file, before its tables.
    after : tuple of str
        The same, behind them.
    height : str
        What the constraint on the height says, where there is one.
    uses : mapping of str to str
        Role of each column that is used.
    """

    source: Path
    sections: tuple[Section, ...]
    places: Places
    about: tuple[tuple[str, str], ...]
    notes: tuple[str, ...] = ()
    lines: tuple[str, ...] = ()
    after: tuple[str, ...] = ()
    height: str = ""
    uses: Mapping[str, str] = field(default_factory=dict)

    @property
    def as_read(self) -> dict[str, Any]:
        """Return how the table was read, as a JSON value."""
        pairs = [list(pair) for pair in self.about]
        return {"understood": pairs, "notes": list(self.notes), "columns": dict(self.uses)}

    def read(self, more: Mapping[str, ConstraintTable] | None = None) -> Loaded:
        """Return the problem, with more constraints; nothing is left on the disk."""
        with TemporaryDirectory() as folder:
            # As the table is called, as far as every system writes such a name.
            place = Path(folder) / f"{re.sub(r'[^A-Za-z0-9_-]', '_', self.source.stem)[:_LETTERS]}.toml"
            # A height that is told takes the place of one that was assumed.
            (replace(self, height="") if "--height" in (more or {}) else self).write(place)
            return replace(read(place, more=more), source=self.source.name, table=self.as_read)

    def write(self, out: Path) -> tuple[Path, ...]:
        """Write a problem file with its tables beside it, and return their paths."""
        tables = self.tables(out)
        with together():
            for path, columns in zip(tables, (self.places.columns, *(s.columns for s in self.sections)), strict=True):
                write_csv(path, columns)
            write_text(out, self._text([path.name for path in tables]))
        return (out, *tables)

    def tables(self, out: Path) -> tuple[Path, ...]:
        """Return the names of the tables beside a problem file: stations, then the rows of each kind."""
        many = len(self.sections) > 1
        names = ("stations", *(section.kind if many else "rows" for section in self.sections))
        return tuple(out.with_name(f"{out.stem}-{name}.csv") for name in names)

    def _text(self, names: Sequence[str]) -> str:
        # JSON spells strings as TOML does, but for signs beyond 16 bits, which stay as they are.
        quoted = partial(json.dumps, ensure_ascii=False)
        lines = [f"# Made from {quoted(self.source.name)} by optloc convert.", "format = 2"]
        lines += [f"title = {quoted(self.source.stem)}", *self.lines, "", "[frame]", f'kind = "{self.places.frame}"']
        lines += ["", "[stations]", f"file = {quoted(names[0])}", f'unit = "{self.places.unit}"']
        for section, name in zip(self.sections, names[1:], strict=True):
            lines += ["", "[[measurements]]", f'kind = "{section.kind}"                         # {section.text}']
            lines += [f"file = {quoted(name)}", f'unit = "{section.unit}"', *section.lines]
            lines += [f"sigma = {quoted(section.sigma)}"] if section.sigma is not None else []
        lines += [*self.after, *(["", "[[constraints]]", 'kind = "height"', self.height] if self.height else [])]
        return "\n".join(lines) + "\n"


@dataclass(frozen=True, slots=True)
class Converted:
    """What was written, the problem that it is (None of stations alone), what was assumed, and how it was read."""

    written: tuple[Path, ...]
    loaded: Loaded | None
    notes: tuple[str, ...] = ()
    as_read: Mapping[str, Any] = field(default_factory=dict)


def convert(
    source: Path,
    out: Path,
    told: Told | None = None,
    *,
    tell: Callable[[Plan], object] = lambda _: None,
    **options: Any,
) -> Converted:
    """Write a table as a problem file.

    Parameters
    ----------
    source : Path
        Readings of receivers or pseudoranges as CSV, Parquet or JSON, pseudoranges as RINEX or as a log of Android, the
        navigation file beside it; or stations, as such a table or as GeoJSON; or
        orbits of satellites, as two-line elements, OMM (JSON, CSV) or SP3.
    out : Path
        Problem file to write, .toml; its tables go to CSV files beside it. Of stations alone: the CSV file.
    told : Told, optional
        What the table does not say itself.
    tell : callable, optional
        Is given the plan of a table of readings before it is written.
    **options
        The same, one by one: the fields of `Told`.

    Returns
    -------
    Converted
        The files, and the problem as it is read back from them.

    Raises
    ------
    InvalidProblem
        Naming the file, the row and the column.
    """
    told = replace(told or Told(), **options)
    _check_told(told)
    claim(out, inputs=[source, *(path for path in (told.stations, told.times) if path)])
    if told.times is not None or source.suffix.lower() in _ORBITS:
        return _write_satellites(source, out, told.columns, told.times, told.stations)
    if told.what == "stations" or source.suffix.lower() == ".geojson":
        return _write_stations(source, out, told.columns, told.frame)
    if out.suffix.lower() != ".toml":
        raise InvalidProblem("the problem file must end in .toml", str(out), "let the name behind --out end in it")
    plan = understood(source, told)
    tell(plan)
    claim(*plan.tables(out), inputs=[source, *(path for path in (told.stations,) if path)])
    # Read before it is there: what cannot be read is not written.
    loaded = plan.read()
    return Converted(plan.write(out), loaded, plan.notes, plan.as_read)


def _check_told(told: Told) -> None:
    """Refuse roles, frames and conventions that there are none of."""
    for role in told.columns:
        role_named(role)
    choices = {"frame": ("cartesian", "ecef"), "azimuth": CONVENTIONS, "positive": ("a-farther", "b-farther")}
    for name, known in choices.items():
        given = getattr(told, name)
        if given not in (None, *known):
            raise InvalidProblem(f"there is no {name} {given!r}", f"--{name}", nearest(str(given), known))
    if told.what is not None and told.what not in INPUTS:
        _sort(told.what)


def _sort(word: str) -> str:
    """Return the sort of reading that --as names."""
    if word in ("arrivals", "sp"):
        return word
    try:
        kind = kind_named(word, "--as")
    except InvalidProblem:
        raise InvalidProblem(f"there is no input {word!r}", "--as", nearest(word, [*INPUTS, *MODELS])) from None
    if not MODELS[kind].stations:
        raise InvalidProblem(f"{kind} has no stations", "--as", "write it in the problem file")
    return "arrivals" if kind == "toa" else kind


def understood(source: Path, told: Told) -> Plan:
    """Return what a table of readings or pseudoranges is, with what it does not say itself.

    Raises
    ------
    InvalidProblem
        For what is wrong, and for what may mean two things: naming the option that says which.
    """
    _check_told(told)
    plan = _gnss(source, told) if is_gnss(source) else _of_table(source, told)
    azimuths = any(section.kind == "azimuth" for section in plan.sections)
    if told.declination is not None and not azimuths:
        raise InvalidProblem("the table has no bearings", "--declination", "leave it out")
    if told.turned and _AT_RECEPTION != plan.lines:
        raise InvalidProblem("the table has no satellites", "--turned", "leave it out")
    return plan


def _of_table(source: Path, told: Told) -> Plan:
    """Return what a table is."""
    table = without(read_table(source), told.ignore)
    own = {role: name for role, name in told.columns.items() if told.stations is None or role not in PLACE}
    roles = Roles.of(table, own)
    satellites = all(roles.find(role) for role in ("toa", "satellite", "x"))
    if (told.what == "pseudoranges" and roles.find("satellite")) or (told.what is None and satellites):
        return _pseudoranges(source, roles, told)
    told = told if told.what is None else replace(told, what=_sort(told.what))
    named: list[Named] = []
    if told.stations is not None:
        place = places_of(told.stations, {k: name for k, name in told.columns.items() if k in PLACE}, told.frame)
        named = _of_receivers(roles, place)
        chosen = [one for one in named if _may_be(one, told)]
        if len(chosen) > 1 and not _is_long(roles, told, place):
            roles = Roles.of(table, own, [one.column for one in chosen]).without_stations()
            return _plan(roles, told, place, source, wide(roles, told, chosen, place), named)
    roles = as_angles(roles, told)
    sorts, heard = sorts_of(roles, told), None
    if not sorts:
        raise _unknown(roles, told)
    if told.stations is None:
        if roles.find("lat") is None and roles.find("x") is None:
            advice = "name a table or GeoJSON file with --stations"
            raise InvalidProblem("nothing is known of where the stations are", "--stations", advice)
        place, heard = inline(roles, told)
    forms = [sort_named(name) for name in sorts]
    return _plan(roles, told, place, source, [long(roles, form, told, place, heard, forms) for form in forms], named)


def _of_receivers(roles: Roles, place: Places) -> list[Named]:
    """Return the columns that are called after stations, without those that have another role.

    Raises
    ------
    InvalidProblem
        For a column that is called like a station and like a role, where its cells do not tell.
    """
    told = {part for role in roles.told for part in roles.by_role[role].split("+")}
    found = [one for one in named_columns(list(roles.table.columns), place.names) if one.column not in told]
    kept = []
    for one in found:
        role = role_of(one.column)
        if role in ("station", "reference", "name", "id") and holds_names(roles.table, one.column, place.names):
            continue
        kept.append(one)
    return kept


def _is_long(roles: Roles, told: Told, place: Places) -> bool:
    """Return whether a table has one reading a row: a column of stations, and one of readings."""
    if "station" in roles.told:
        return True
    station = roles.find("station")
    if station is None or not holds_names(roles.table, station, place.names):
        return False
    # Times beside columns of receivers are the times of their readings.
    return bool({*sorts_of(roles, told)} - {"times"})


def _unknown(roles: Roles, told: Told) -> InvalidProblem:
    """Return what is said of a table whose columns do not tell what it is."""
    columns = list(roles.table.columns)
    what = f"the columns {', '.join(columns)} do not tell what this is"
    advice = f"say it with --as {', --as '.join(INPUTS)} or a kind, and name columns with --column ROLE=NAME"
    if told.stations is None:
        advice += "; columns named by receivers need --stations"
    return InvalidProblem(what, roles.table.source, advice)


def _may_be(one: Named, told: Told) -> bool:
    """Return whether a column that names stations holds what is asked for."""
    return told.what is None or one.form in (None, told.what)


# From readings to the tables of a problem file.


def _plan(
    roles: Roles, told: Told, place: Places, source: Path, found: Sequence[Readings], named: Sequence[Named]
) -> Plan:
    """Return what readings become; `named` are the columns that are called after stations."""
    place = in_space(place) if any(2 not in MODELS[one.form.kind].dimensions for one in found) else place
    place, turn = stations_turned(place, found)
    epochs = epochs_of(roles, told, found)
    sigmas = _sigmas(told, found)
    uses = uses_of(roles, told, found, epochs, sigmas)
    check_receivers(roles.table, uses, named, place.names)
    rest = left_over(roles, uses, named)
    parts = zip(found, sigmas, strict=True)
    sections = tuple(_with_declination(_section(one, epochs, sigma), one, told) for one, sigma in parts)
    notes = [*roles.table.notes, *(one.notes[0] for one in found if one.heading is not None)]
    notes += [note for note in (turn, place.note) if note]
    notes += dict.fromkeys(note for one in found for note in one.notes if note not in notes)
    lines: tuple[str, ...] = ()
    if any(one.form.value == "sp" for one in found):
        speed = _sp_speed(told)
        lines = (f"propagation_speed = {speed!r}",)
        notes.append(f"S minus P times {speed:.6g} m/s, vp vs / (vp - vs), is a range: straight rays, one speed")
    after: tuple[str, ...] = ()
    if told.window is not None and "epoch" not in epochs:
        after = ("", "[epochs]", f"window = {json.dumps(told.window)}")
    height, note = _height(found, place)
    notes += [*_few(sections, told), *([note] if note else [])]
    read = [*about(roles, told, place, found, epochs, uses), *([("not used", ", ".join(rest))] if rest else [])]
    return Plan(source, sections, place, tuple(read), tuple(notes), lines, after, height, uses)


def _height(found: Sequence[Readings], place: Places) -> tuple[str, str]:
    """Return what is known of the height of a target on Earth without a reading, as a line of a file, and a remark."""
    if place.frame != "geodetic":
        return "", ""
    heights, unit = place.columns["height"], place.unit
    if all(one.form.kind == "azimuth" for one in found):
        mean = round(float(heights.mean()), 3)
        remark = (
            f"bearings tell no height: it is taken to be {mean:g} {unit}, the stations' mean, or what --height says"
        )
        return f'exactly = "{mean!r} {unit}"', remark
    if any(one.form.value == "sp" for one in found):
        top = float(heights.max())
        return f'max = "{top!r} {unit}"', f"the earthquake is taken to be below the highest station, {top:g} {unit}"
    return "", ""


def _sigmas(told: Told, found: Sequence[Readings]) -> list[str | None]:
    """Return the standard deviation of each sort as it is written, None where the table has its own."""
    if told.sigma is None:
        for one in found:
            if one.sigma is None:
                raise _no_sigma("20 ns", one.form.kind if len(found) > 1 else "rows")
        return [None] * len(found)
    if "=" not in told.sigma:
        if len({one.form.quantity for one in found}) > 1:
            advice = "write --sigma '" + ",".join(f"{one.form.kind}=1 {one.unit}" for one in found) + "'"
            raise InvalidProblem("the readings are of several kinds, and each needs its own", "--sigma", advice)
        return [told.sigma] * len(found)
    given = sigmas_by_kind(told.sigma)
    other = next((kind for kind in given if kind not in {one.form.kind for one in found}), None)
    if other is not None:
        raise InvalidProblem(f"the table has no readings of {other}", "--sigma", f"leave {other} out")
    lacking = next((one.form.kind for one in found if one.form.kind not in given and one.sigma is None), None)
    if lacking is not None:
        raise InvalidProblem(f"nothing is said of {lacking}", "--sigma", f"add {lacking}=AMOUNT behind a comma")
    return [given.get(one.form.kind) for one in found]


def _no_sigma(example: str, rows: str = "rows") -> InvalidProblem:
    advice = f"say it with --sigma '{example}' (or metres); --sigma estimate finds it from many epochs"
    what = "the rows are" if rows == "rows" else f"the readings of {rows} are"
    return InvalidProblem(f"nothing is known of how accurate {what}", "--sigma", advice)


def _sp_speed(told: Told) -> float:
    """Return the speed that turns S minus P into a range, metres per second."""
    if told.vp is None or told.vs is None:
        advice = "say both, such as --vp '6 km/s' --vs '3.5 km/s'"
        raise InvalidProblem("the speeds of the P and S waves are not known", "--vp", advice)
    vp, vs = (Units("speed").plain(given, None, where) for given, where in ((told.vp, "--vp"), (told.vs, "--vs")))
    if not 0.0 < vs < vp:
        raise InvalidProblem(f"P waves of {vp:g} m/s are not faster than S waves of {vs:g} m/s", "--vs", "correct it")
    return vp * vs / (vp - vs)


def _section(found: Readings, epochs: Mapping[str, Array], sigma: str | None) -> Section:
    columns: dict[str, Any] = {name: column[found.row] for name, column in epochs.items()}
    values, text = found.values, found.form.text
    if found.form.kind == "toa":
        values, text = _from_first(found, columns), "arrivals, counted from the first of each message"
    columns |= {"a": found.a} | ({} if found.b is None else {"b": found.b}) | {"z": [f"{value:f}" for value in values]}
    if found.sigma is not None and sigma is None:
        columns["sigma"] = found.sigma
    lines = [f'azimuth = "{found.azimuth}"'] if found.azimuth is not None else []
    lines += [f'positive = "{found.positive}"'] if found.positive != "a-farther" else []
    if found.b is not None and sigma not in (None, ESTIMATE) and MODELS[found.form.kind].signs == (1, -1):
        # as `optloc.locate` takes it: differences share the errors of their stations, each half of the variance
        lines += [f'arrival_sigma = "{_share(str(sigma), found.unit)}"    # of one station, sigma / sqrt(2)']
        sigma = None
    return Section(found.form.kind, columns, found.unit, sigma, text, tuple(lines))


def _with_declination(section: Section, found: Readings, told: Told) -> Section:
    """Return a section of bearings with the declination that is told."""
    if told.declination is None or found.form.kind != "azimuth":
        return section
    if found.azimuth == CARTESIAN:
        raise InvalidProblem("angles from the x axis have no declination", "--declination", "leave it out")
    if date_of(told.declination, "--declination") is None:
        angle_of(told.declination, None, "--declination")
    return replace(section, lines=(*section.lines, f"declination = {json.dumps(told.declination.strip())}"))


def _share(sigma: str, unit: str) -> str:
    """Return the part of one station in the standard deviation of a difference, an amount as text."""
    number, own = re.fullmatch(r"\s*([-+.\deE]*)\s*(.*?)\s*", sigma, re.DOTALL).groups()  # type: ignore[union-attr]
    try:
        return f"{float(number) / np.sqrt(2.0):.9g} {own or unit}"
    except ValueError:  # what reads the file says what is wrong with it
        return sigma


def _from_first(found: Readings, columns: dict[str, Any]) -> list[Decimal]:
    """Return arrivals counted from the first of their message, whose time becomes a column where there is none.

    Seconds of today in nanoseconds have 19 digits, a float 16: differences are taken before anything is rounded.
    """
    keys = [columns[name].tolist() for name in ("epoch", "time", "target") if name in columns]
    labels: list[Any] = list(zip(*keys, strict=True)) if keys else [()] * len(found.values)
    first: dict[Any, Decimal] = {}
    for label, value in zip(labels, found.values, strict=True):
        first[label] = min(value, first.get(label, value))
    # Arrivals that are counted from their first already say nothing of when that was.
    dated = found.unit in UNITS["time"] and len(set(first.values())) == len(first)
    if dated and "time" not in columns:
        factor = Decimal(repr(UNITS["time"][found.unit]))
        columns["time"] = np.array([float(first[label] * factor) for label in labels])
    return [value - first[label] for label, value in zip(labels, found.values, strict=True)]


def _few(sections: Sequence[Section], told: Told) -> list[str]:
    """Return what is to be said of epochs with few readings."""
    counts: Counter[Any] = Counter()
    for section in sections:
        keys = [section.columns[name] for name in ("epoch", "target") if name in section.columns]
        keys = keys or [section.columns[name] for name in ("time",) if name in section.columns]
        counts.update(zip(*(column.tolist() for column in keys), strict=True))
    few = sum(count < _FEW for count in counts.values())
    if sections[0].kind == "toa" and few:
        return [f"{few} of {len(counts)} messages were heard by fewer than three stations"]
    if len(counts) > 1 and max(counts.values()) == 1 and told.window is None:
        advice = "--still puts them together if the target stays, --window '0.1 s' those of 0.1 s"
        return [f"each of the {len(counts)} instants has one reading: {advice}"]
    return []


# A table of pseudoranges: which satellite was received when, from where, and how far it seemed.


# What a problem file says of satellites, and what is said of those that were turned.
_AT_RECEPTION = ("# Satellites are where they were when they sent, along the axes of the Earth at reception.",)
_TURNED = "satellites are turned with the Earth during the flight of the signal; --turned takes them as they are"


def _pseudoranges(source: Path, roles: Roles, told: Told) -> Plan:
    """Return pseudoranges as arrivals with a clock of each epoch, and the satellites as stations that move, in ECEF."""
    form = sort_named("arrivals")
    own = sigma_column(roles, form, told, [form])
    if told.sigma is None and own is None:
        raise _no_sigma("2 m")
    by = "message" if roles.find("message") is not None else "time"
    epoch, satellite, z = roles.labels(by), roles.labels("satellite"), roles.numbers("toa")
    unit = told.unit or unit_of(roles.column("toa"), UNITS["length"]) or "m"
    Units("length").conversion(unit, "--unit")
    length = unit_of(roles.column("x"), UNITS["length"]) or "m"
    place = np.stack([scaled(roles, axis, "length", length) for axis in "xyz"], axis=-1)
    _check_far(roles, place * UNITS["length"][length])
    _check_once(roles, epoch, satellite)
    notes = roles.table.notes
    if not told.turned:
        metres, ranges = place * UNITS["length"][length], Units("length").conversion(unit, "--unit").to_si(z)
        place = at_reception(source, epoch, metres, ranges) / UNITS["length"][length]
        notes += (_TURNED,)
    columns = {"epoch": epoch, "a": satellite, "z": z}
    when = roles.find("time")
    if when is not None:
        seconds = moments(roles, when, told.zone, told.time_unit)
        columns["time"] = roles.numbers("time") if seconds is None else seconds
    uses = {roles.column(role): role for role in ("satellite", "toa", *"xyz")}
    uses |= dict.fromkeys(roles.column(by).split("+"), by) | ({} if when is None else {when: "time"})
    if own is not None:
        columns["sigma"] = sigma_of(roles.table, own, form, unit, range(len(z)))
        uses[own] = "sigma_toa"
    rest = left_over(roles, uses, (), lengths=True)
    satellites = {"name": satellite, "epoch": epoch} | dict(zip("xyz", place.T, strict=True))
    section = Section("toa", columns, unit, told.sigma, "the range and the receiver's clock")
    when_ = "reception" if told.turned else "transmission"
    read = [
        ("pseudoranges", f"{len(z)} readings in {unit} from {roles.column('toa')}, with a clock of each epoch"),
        ("epochs", f"{len(set(epoch.tolist()))} by column {roles.column(by)}"),
        ("satellites", f"{len(set(satellite.tolist()))} at x, y, z in {length}, along ECEF at {when_}"),
    ]
    read += [("sigma", f"of pseudoranges, from column {own}")] if "sigma" in columns else []
    read += [("not used", ", ".join(rest))] if rest else []
    places = Places(satellites, "ecef", length)
    return Plan(source, (section,), places, tuple(read), notes, _AT_RECEPTION, uses=uses)


def _gnss(source: Path, told: Told) -> Plan:
    """Return what a receiver of navigation satellites has seen as arrivals, like a table of pseudoranges."""
    if told.columns or told.ignore:
        flag = "--column" if told.columns else "--ignore"
        raise InvalidProblem(f"{source.name} has no columns with names", flag, "leave it out")
    found = received(source, told.navigation, told.sigma, system=told.system, mask=told.mask)
    columns = {"epoch": found.epoch, "time": found.time, "a": found.satellite, "z": np.round(found.z, 4)}
    columns["sigma"] = np.round(found.sigma, 3)
    places = {"name": found.satellite, "epoch": found.epoch} | dict(zip("xyz", np.round(found.place, 4).T, strict=True))
    section = Section("toa", columns, "m", None, "the range and the receiver's clock")
    return Plan(source, (section,), Places(places, "ecef", "m"), found.about, found.notes, _AT_RECEPTION)


def _check_once(roles: Roles, epoch: Array, satellite: Array) -> None:
    """Refuse a satellite that an epoch has twice."""
    seen: dict[tuple[str, str], int] = {}
    for row, key in enumerate(zip(epoch.tolist(), satellite.tolist(), strict=True)):
        if key in seen:
            what = f"satellite {key[1]!r} occurs again at epoch {key[0]!r}, first in row {seen[key] + 1}"
            raise InvalidProblem(what, roles.table.at(row), "leave one of them out")
        seen[key] = row


# Stations alone, and satellites.


def _write_stations(source: Path, out: Path, told: Mapping[str, str], frame: str | None) -> Converted:
    if out.suffix.lower() != ".csv":
        what = "stations alone are no problem: they become a CSV table"
        raise InvalidProblem(what, str(out), "let the name behind --out end in .csv, or convert the measurements")
    found = places_of(source, told, frame)
    write_csv(out, found.columns)
    return Converted((out,), None, (found.note,) if found.note else ())


def _write_satellites(
    source: Path, out: Path, told: Mapping[str, str], times: Path | None, stations: Path | None
) -> Converted:
    """Write where satellites are at the times of measurements, and with which velocity, as a table of stations."""
    if times is None:
        advice = "name the table of the measurements with --times: its times, and its satellites if it has them"
        raise InvalidProblem("nothing is known of when the satellites are wanted", "--times", advice)
    if out.suffix.lower() != ".csv":
        what = "satellites are stations that move: they become a CSV table"
        raise InvalidProblem(what, str(out), "let the name behind --out end in .csv")
    own = {role: name for role, name in told.items() if stations is None or role not in PLACE}
    orbits, roles = read_orbits(source), Roles.of(read_table(times), own)
    check_told(roles, ("time", "satellite"))
    written, seconds = roles.table.raw(roles.column("time")), roles.table.times(roles.column("time"), 1.0)
    whose = roles.labels("satellite") if roles.find("satellite") is not None else None
    wanted = distinct(whose)[0] if whose is not None else list(orbits.courses)
    at_most("cells", 7 * len(wanted) * len(seconds), roles.table.source)
    parts: list[tuple[Array, ...]] = []
    for name in wanted:
        rows = np.arange(len(seconds)) if whose is None else np.flatnonzero(whose == name)
        rows = rows[np.unique(seconds[rows], return_index=True)[1]]
        parts.append((np.full(len(rows), name, dtype=object), rows, *orbits.at(name, seconds[rows])))
    rows = np.unique(seconds, return_index=True)[1]
    for name, place in _resting(stations, told).items():
        still = np.zeros((len(rows), 3))
        parts.append((np.full(len(rows), name, dtype=object), rows, place + still, still))
    names, rows, position, velocity = (np.concatenate(part) for part in zip(*parts, strict=True))
    columns = {"name": names, "time": written[rows]} | dict(zip("xyz", position.T, strict=True))
    write_csv(out, columns | dict(zip(("vx", "vy", "vz"), velocity.T, strict=True)))
    return Converted((out,), None, ('positions are along ECEF: write kind = "ecef" in [frame]',))


def _resting(path: Path | None, told: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Return where stations on the ground are in ECEF, by name."""
    if path is None:
        return {}
    own = {role: name for role, name in told.items() if role in PLACE}
    place = places_of(path, own, "ecef")
    held, scale = place.columns, UNITS["length"][place.unit]
    if place.frame == "geodetic":
        lat, lon = np.radians(held["lat_deg"]), np.radians(held["lon_deg"])
        found = ECEF.from_geodetic(lat, lon, scale * held["height"], where=path.name, first_row=1)
    elif "z" in held:
        found = scale * np.stack([held[axis] for axis in "xyz"], axis=-1)
    else:
        raise InvalidProblem("stations beside satellites have x, y and z", path.name, "or latitude and longitude")
    return dict(zip(place.names, found, strict=True))


def _check_far(roles: Roles, place: np.ndarray) -> None:
    """Raise InvalidProblem where a satellite is within the Earth: its unit or its columns are other ones."""
    near = np.flatnonzero(np.linalg.norm(place, axis=-1) < _SURFACE)
    if len(near):
        where = roles.table.where(roles.column("x"), int(near[0]))
        away = np.linalg.norm(place[near[0]]) / 1e3
        what = f"the satellite is {away:.4g} km from the centre of the Earth"
        raise InvalidProblem(what, where, "name the columns with --column x=NAME and so on; a unit is seen from x_km")
