"""The site of a stream: the template of events from a problem file, and prepared problems for sets of rows.

A site is an ordinary problem file. Its rows are the template of an event: kinds, stations and noise matter, values do
not. An event is solved like a file with only its rows, by the same reader.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from optloc.engine import Cache
from optloc.files import (
    FREE,
    Draft,
    ProblemFile,
    StatedConstraint,
    Table,
    WaveOptions,
    assemble,
    height_table,
    join,
    limits_of,
    name_of,
    places_of,
    read_document,
    speed_of,
    table_of,
    with_options,
    with_profile,
)
from optloc.model_checks import least_values
from optloc.models import MODELS
from optloc.problem import Array, Conversion, Frame, InvalidProblem, nearest, no_station
from optloc.solvers import Prepared, PreparedFloors, prepare_on_floors

FAST = "gtrs+lsr"
"""The method of the first phase: no proof, about ten microseconds for each fix."""

# Number of stored prepared problems, about 100 kB each: a network of ten has more sets of receivers, but few are
# frequent.
_KEPT = 64
# Columns of a row in a table of the site, in addition to its stations.
_ROW_SETTINGS = ("sigma", "weight", "correction")


class UnknownName(InvalidProblem):
    """A line has a station or a kind that the site does not have.

    Attributes
    ----------
    event : str
        The event of the line; "" if unknown.
    whole : bool
        Whether the event consists of this line alone.
    """

    event: str = ""
    whole: bool = True


class SiteOptions(NamedTuple):
    """Options of a command that replace statements of the file: on the wave, and the known height of the targets."""

    wave: WaveOptions = WaveOptions()
    height: str | None = None

    def apply(self, file: ProblemFile) -> ProblemFile:
        """Return the file with these options."""
        file = with_options(file, self.wave)
        if self.height is None:
            return file
        return file.model_copy(update={"constraints": [*file.constraints, height_table(self.height)]})


class SiteRow(NamedTuple):
    """A row of an event.

    section: number of the table ``[[measurements]]`` with its settings. at: row number in that table, -1 for a row that
    is not listed. kind: measurement kind. a, b: stations, empty for none. sigma: standard deviation that the event
    states, in the unit of the file.
    """

    section: int
    at: int
    kind: str
    a: str = ""
    b: str = ""
    sigma: float | None = None

    @property
    def name(self) -> str:
        """Return a name for messages: kind and stations."""
        return " ".join(part for part in (self.kind, "-".join(filter(None, (self.a, self.b)))) if part)


@dataclass(frozen=True, slots=True, eq=False)
class Ready:
    """A prepared problem for one set of rows.

    Parameters
    ----------
    fast, full : Prepared or PreparedFloors
        Solvers of the first phase, and of the method of the stream.
    count : int
        Number of rows m of the problem; rows without a value have the weight 0.
    row, first, second : int array (l,)
        Rows of the problem that come from arrivals, and the two arrivals of each, as columns of the arrivals of an
        event. `second` is -1 for a time of arrival.
    stated : tuple of (int array, int array, Conversion, array)
        For each kind of rows with values: their columns, rows of the problem, unit, and the amount to add, SI.
    scale : float
        Metres that the signal travels in a picosecond.
    least : array (m,)
        Least possible values of the rows, SI; minus infinity for no limit.
    """

    fast: Prepared | PreparedFloors
    full: Prepared | PreparedFloors
    count: int
    row: Array
    first: Array
    second: Array
    stated: tuple[tuple[Array, Array, Conversion, Array], ...]
    scale: float
    least: Array

    def si(self, arrivals: Array, values: Array) -> Array:
        """Return the measurements (n, m) of the problem for n events, SI.

        `arrivals` (n, h) are the times at h stations, picoseconds since the first arrival of each event. `values` (n,
        v) are the other rows, in their units.
        """
        z = np.zeros((len(values), self.count))
        # A difference is the first arrival minus the second. Nothing is subtracted from a time of arrival.
        less = np.where(self.second >= 0, arrivals[:, self.second], 0.0) if len(self.row) else 0.0
        z[:, self.row] = self.scale * (arrivals[:, self.first] - less)
        for column, row, unit, more in self.stated:
            z[:, row] = unit.to_si(values[:, column]) + more
        return z


# The key includes the site, so a reloaded site has separate problems.
_READY = Cache["Ready | None"](_KEPT)


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """Content of the problem file of a stream.

    Parameters
    ----------
    source : str
        Name of the file.
    title : str
        Title of the file.
    method : str
        Method of the fixes; see `optloc.solve`.
    file : ProblemFile
        Settings.
    station_table : Table
        Stations as read.
    tables : tuple of Table
        Rows of each ``[[measurements]]``.
    places : mapping of str to Table
        Positions of known targets.
    limits : mapping of str to StatedConstraint
        Constraints with the contents of their files, by their place for messages.
    rows : tuple of SiteRow
        Template of an event, in the order of the file.
    stations : tuple of str
        Names of the stations.
    position : array (s, d)
        Positions of the stations, metres in the frame.
    frame : Frame
        Frame of the positions.
    speed : float
        Propagation speed, metres per second.
    arrival_rows, other_rows : tuple of int
        Rows of the template that come from arrivals, which are the rows of the first table of `toa` or `tdoa`; and all
        other rows.
    arrival_stations : tuple of int
        Stations with arrivals in the template.
    index : dict of (kind, a, b) to int
        Number of each row of the template.
    number : dict of str to int
        Number of each station.
    options : SiteOptions
        Options that replaced statements of the file.
    """

    source: str
    title: str
    method: str
    file: ProblemFile
    station_table: Table
    tables: tuple[Table, ...]
    places: dict[str | None, Table]
    limits: dict[str, StatedConstraint]
    rows: tuple[SiteRow, ...]
    stations: tuple[str, ...]
    position: Array
    frame: Frame
    speed: float
    arrival_rows: tuple[int, ...]
    other_rows: tuple[int, ...]
    arrival_stations: tuple[int, ...]
    index: dict[tuple[str, str, str], int]
    number: dict[str, int]
    options: SiteOptions

    @property
    def whole(self) -> Ready:
        """Return the prepared problem of an event with values of all rows."""
        ready = self.ready((), self.rows)
        assert ready is not None  # a site has rows
        return ready

    def find(self, kind: str, a: str, b: str) -> int | SiteRow:
        """Return the row of an event by kind and stations.

        The result is its number in the template, or a row that is not in the template.

        Raises
        ------
        UnknownName
            For a kind or a station that the site does not have.
        InvalidProblem
            For a missing or superfluous station.
        """
        known = self.index.get((kind, a, b))
        if known is not None:
            return known
        alike = [row for row in self.rows if row.kind == kind]
        if not alike:
            kinds = list(dict.fromkeys(row.kind for row in self.rows))
            raise UnknownName(f"the site has no rows of the kind {kind[:40]!r}", "kind", nearest(kind, kinds))
        count = MODELS[kind].stations
        for key, name, needed in (("a", a, count > 0), ("b", b, count > 1)):
            if bool(name) != needed:
                what = "the station is missing" if needed else "there is a superfluous station"
                raise InvalidProblem(what, key, f"{kind} rows name {count} of them")
            if needed and name not in self.number:
                raise no_station(name[:40], key, self.stations, UnknownName)
        if a == b and count > 1:
            raise InvalidProblem(f"{kind} names station {a!r} twice", "b", "name two stations")
        return SiteRow(alike[0].section, -1, kind, a, b)

    def row(self, key: int | SiteRow) -> SiteRow:
        """Return a row by its key in an event."""
        return self.rows[key] if isinstance(key, int) else key

    def name_of(self, key: int | SiteRow) -> str:
        """Return the name of a row for messages."""
        return self.row(key).name

    def ready(self, receivers: tuple[int, ...], rows: tuple[SiteRow, ...]) -> Ready | None:
        """Return the prepared problem for arrivals and rows; None if they give no row.

        `receivers` are the numbers of the stations with an arrival, ascending. `rows` are the rows with values. Raise
        InvalidProblem if the file lacks data for a row, such as its noise.
        """
        return _READY.find((self, receivers, rows), lambda: self._prepare(receivers, rows))

    def between(self, receivers: tuple[int, ...]) -> tuple[SiteRow, ...]:
        """Return the rows of a problem that arrivals at the stations `receivers` (numbers, ascending) give.

        These are the rows of the template whose stations have arrivals. If they do not connect all stations, a
        difference to the first station connects each further group. Times of arrival need no connection: each station
        without a row gets one.
        """
        if not receivers:
            return ()
        names = [self.stations[i] for i in receivers]
        kept = [self.rows[i] for i in self.arrival_rows if {self.rows[i].a, self.rows[i].b} - {""} <= set(names)]
        section, kind = self.rows[self.arrival_rows[0]].section, self.rows[self.arrival_rows[0]].kind
        if kind == "toa":
            listed = {row.a for row in kept}
            return (*kept, *(SiteRow(section, -1, kind, name) for name in names if name not in listed))
        group = {name: name for name in names}  # the connected group of each station, named after one of its stations
        for row in kept:
            group = {name: group[row.b] if g == group[row.a] else g for name, g in group.items()}
        for name in names[1:]:
            if group[name] != group[names[0]]:
                kept.append(SiteRow(section, -1, kind, name, names[0]))
                group = {other: group[names[0]] if g == group[name] else g for other, g in group.items()}
        return tuple(kept)

    def _prepare(self, receivers: tuple[int, ...], rows: tuple[SiteRow, ...]) -> Ready | None:
        """Return the prepared problem for arrivals and rows, as `ready`, but without the cache."""
        timed = self.between(receivers)
        if not (timed or rows):
            return None
        draft, order = self._draft((*timed, *rows))
        problem = draft.loaded.problem
        bare = problem.with_rows(z=np.zeros(problem.count))
        # `links` has the rows that come from arrivals, each with the places of its arrivals among `receivers`. `stated`
        # has the other rows, by chunk.
        place, stated, links = {station: i for i, station in enumerate(receivers)}, [], []
        for chunk, number in zip(draft.chunks, draft.numbers, strict=True):
            section = next(i for i, table in enumerate(draft.tables) if table is chunk.table)
            # index of each row in (*timed, *rows); -1 for a row without a value
            column = np.array([order[section][row] for row in chunk.row.tolist()])
            made = np.flatnonzero((column >= 0) & (column < len(timed))).tolist()
            links += [(number[i], place[int(chunk.a[i])], place.get(int(chunk.b[i]), -1)) for i in made]
            # rows that are only present for a covariance may keep any value: their weight is zero
            given = column >= len(timed)
            added = np.where(chunk.weight > 0.0, chunk.baseline, 0.0)[given]
            stated.append((column[given] - len(timed), number[given], chunk.unit, added))
        row, first, second = np.array(links, dtype=np.int64).reshape(-1, 3).T
        floors = draft.loaded.floors
        fast = prepare_on_floors(bare, floors, FAST)
        full = fast if self.method == FAST else prepare_on_floors(bare, floors, self.method)
        return Ready(
            fast, full, problem.count, row, first, second, tuple(stated), self.speed * 1e-12, least_values(bare)
        )

    def _draft(self, rows: tuple[SiteRow, ...]) -> tuple[Draft, list[list[int]]]:
        """Return the problem of rows, and for each row of its tables the index in `rows`, -1 for a row without a value.

        With a covariance matrix, all rows of the site are present, and rows without a value have the weight 0.
        """
        sections, tables, order = [], [], []
        for i, (section, table) in enumerate(zip(self.file.measurements, self.tables, strict=True)):
            of_all = section.covariance is not None or self.file.covariance is not None
            listed = {row.at: k for k, row in enumerate(rows) if row.section == i and row.at >= 0}
            others = [k for k, row in enumerate(rows) if row.section == i and row.at < 0]
            if of_all and others:
                what = f"the covariance of the site does not include {rows[others[0]].name}"
                raise InvalidProblem(what, self.source, "send only rows of the site")
            # one matrix for all rows of an epoch: absent rows keep their place, with weight 0
            all_rows = [row for row in self.rows if row.section == i] if of_all else []
            chosen = all_rows or [*(rows[k] for k in sorted(listed.values())), *(rows[k] for k in others)]
            if not chosen:
                continue
            place = [listed.get(row.at, -1) for row in all_rows] or [*sorted(listed.values()), *others]
            sections.append(section)
            tables.append(_table(table, section.kind is None, chosen, [k >= 0 for k in place]))
            order.append(place)
        file = self.file.model_copy(update={"measurements": sections})
        draft = assemble(
            file, self.station_table, tables, self.source, values=False, known=self.places, limits=self.limits
        )
        return draft, order


def _table(table: Table, kinds: bool, rows: Sequence[SiteRow], present: Sequence[bool]) -> Table:
    """Return the rows of an event as a table with the columns of a table of the site.

    `table` is that table. `kinds` is whether its rows state their kind. `present` (for each of `rows`) is whether the
    event has a value; other rows get the weight 0.
    """
    columns: dict[str, Array] = {}
    if kinds:
        columns["kind"] = np.array([row.kind for row in rows], dtype=object)
    for key in ("a", "b"):
        if any(getattr(row, key) for row in rows):
            columns[key] = np.array([getattr(row, key) or None for row in rows], dtype=object)
    for key in _ROW_SETTINGS:
        given = table.numbers(key) if table.has(key) else None
        stated = key == "sigma" and any(row.sigma is not None for row in rows)
        if given is None and not stated and (key != "weight" or all(present)):
            continue
        columns[key] = np.array([_row_setting(given, key, row, table.source) for row in rows])
    if not all(present):
        columns["weight"] = np.where(present, columns["weight"], 0.0)
    return Table(table.source, columns, len(rows))


def _row_setting(given: Array | None, key: str, row: SiteRow, source: str) -> float:
    """Return the standard deviation, weight or correction of a row, by `key`, in the unit of the file.

    `given` has the values of the table of the site, if any. The standard deviation that an event states has priority.
    Rows that the site does not list have the weight 1 and the correction 0.
    """
    if key == "sigma" and row.sigma is not None:
        return row.sigma
    if given is not None and row.at >= 0:
        return float(given[row.at])
    if key == "sigma":
        raise InvalidProblem(f"the noise of {row.name} is unknown", source, "send its sigma")
    return 1.0 if key == "weight" else 0.0


def read_site(path: Path, method: str = "auto", options: SiteOptions | None = None) -> Site:
    """Return the site of a problem file.

    Parameters
    ----------
    path : Path
        The file; its rows are the template of an event and need no values.
    method : str
        Method of the fixes.
    options : SiteOptions, optional
        Options that replace statements of the file.

    Raises
    ------
    InvalidProblem
        For an invalid file, and for properties that single events cannot have: moving stations or targets, estimated
        noise, decibels.
    """
    source, options = name_of(path), options or SiteOptions()
    file = with_profile(options.apply(read_document(path)), path.parent, source)
    station_table = table_of(file.stations, path.parent, join(source, "[stations]"))
    places, limits = places_of(file, path.parent, source), limits_of(file, path.parent, source)
    tables = [
        table_of(section, path.parent, join(source, f"[[measurements]] {i + 1}"))
        for i, section in enumerate(file.measurements)
    ]
    draft = assemble(file, station_table, tables, source, values=False, known=places, limits=limits)
    _check(draft, source)
    rows = _template(draft, source)
    problem = draft.loaded.problem
    timed = next((row for row in rows if row.kind in ("toa", "tdoa")), None)
    # Rows of the same section and kind as the first row of `toa` or `tdoa`.
    arrival_rows = tuple(i for i, row in enumerate(rows) if timed and row[:3:2] == timed[:3:2])
    number = {name: i for i, name in enumerate(problem.stations.names)}
    arrival_stations = {number[end] for i in arrival_rows for end in (rows[i].a, rows[i].b) if end}
    site = Site(
        source=source,
        title=draft.loaded.title,
        method=method,
        file=draft.file,
        station_table=station_table,
        tables=draft.tables,
        places=places,
        limits=limits,
        rows=rows,
        stations=problem.stations.names,
        position=problem.stations.position[0],
        frame=problem.frame,
        speed=speed_of(file, source),
        arrival_rows=arrival_rows,
        other_rows=tuple(i for i in range(len(rows)) if i not in arrival_rows),
        arrival_stations=tuple(sorted(arrival_stations)),
        index={row[2:5]: i for i, row in enumerate(rows)},
        number=number,
        options=options,
    )
    # report errors of the reader now; an event that cannot be fixed, as with a bias without a prior, gets a status
    # later
    site.ready((), rows)
    return site


def _check(draft: Draft, source: str) -> None:
    """Raise InvalidProblem for properties that single events cannot have."""
    if draft.moving or len(draft.loaded.problem.stations.position) > 1:
        raise InvalidProblem(
            "the stations move", join(source, "[stations]"), "use fixed stations; a stream cannot have moving stations"
        )
    motion = {table.moves for table in (draft.file.target, *draft.file.targets.values())} - {None, "static"}
    if motion - FREE:
        what = f"the motion {min(map(str, motion - FREE))} needs several epochs"
        raise InvalidProblem(what, join(source, "[target]"), "remove it; each event is fixed separately")
    if any(section.vp_vs is not None for section in draft.file.measurements):
        what = "a stream cannot use P and S arrivals with one origin time"
        raise InvalidProblem(what, join(source, "key 'vp_vs'"), "remove it, and send P arrivals")
    for chunk in draft.chunks:
        if chunk.unit.logarithmic:
            where = join(chunk.table.source, "key 'unit'")
            raise InvalidProblem("a stream cannot use ratios in decibels", where, "send ratios, in the unit '1'")


def _template(draft: Draft, source: str) -> tuple[SiteRow, ...]:
    """Return the distinct rows in the order of the file: each combination of kind and stations once.

    A file with one epoch must not have two equal rows.
    """
    found: dict[tuple[int, str, str, str], SiteRow] = {}
    for i, (section, table) in enumerate(zip(draft.file.measurements, draft.tables, strict=True)):
        kinds = [section.kind] * table.count if section.kind is not None else table.labels("kind").tolist()
        ends = [
            table.labels(key).tolist() if table.has(key) else [getattr(section, key) or ""] * table.count
            for key in ("a", "b")
        ]
        for at, (kind, a, b) in enumerate(zip(kinds, *ends, strict=True)):
            count = MODELS[kind].stations
            key = (i, kind, a if count > 0 else "", b if count > 1 else "")
            if key in found and draft.loaded.problem.epochs == 1:
                what = f"the row {found[key].name} occurs twice"
                place = join(source, f"[[measurements]] {i + 1}")
                raise InvalidProblem(what, place, "remove one: kind and stations must identify a row")
            found.setdefault(key, SiteRow(i, at, *key[1:]))
    return tuple(found.values())
