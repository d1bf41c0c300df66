"""Reader of problem files: read tables, find epochs, convert to SI units, check, and build the problem.

In shapes, m is the number of rows, k of epochs, s of stations, d of dimensions, and r of rows in one epoch. A chunk has
the rows of one kind in one table. `index` and `target` have the epoch and the target of each row, one array (m,) for
each chunk.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.frames import Frame
from optloc.base.inputs import Budget, access, check_budget
from optloc.base.time_scales import TimeScale
from optloc.base.types import Array, Bias, Rows, Stations
from optloc.base.units import UNITS
from optloc.files.constraint_reader import (
    Demand,
    constraints_of,
    demands_of,
    divided,
    floors_of,
    limits_of,
)
from optloc.files.constraint_table import ConstraintTable
from optloc.files.emission_clock import EmissionClock, emission_clock
from optloc.files.excess_paths import with_station_distance
from optloc.files.measurements import (
    ESTIMATE,
    Context,
    RowChunk,
    check_repeats,
    chunks_of,
    declination_text,
    square,
    with_declination,
)
from optloc.files.phase_rows import check_layers, combined_noise, split_phases, unused_picks
from optloc.files.physics import warnings_of
from optloc.files.propagation import check_speed, medium_in, speed_bias, speed_of, speed_words
from optloc.files.roles import ASSUMED, azimuths_of, with_standard_names
from optloc.files.row_epochs import Epochs, Keys, epochs_of, need_clock
from optloc.files.schema import ProblemFile, StationsTable, name_of, read_document
from optloc.files.settings import Units, join
from optloc.files.stations import over_epochs, survey
from optloc.files.table import Table, table_of
from optloc.files.unknowns import (
    FREE,
    bias_of,
    known_of,
    motions_of,
    needs_clock,
    places_of,
    prior_of,
)
from optloc.files.wave_speed import WaveOptions, with_options, with_profile
from optloc.models import MODELS
from optloc.models.medium import Medium
from optloc.problem.noise import Block, Noise, arrivals, group, group_members
from optloc.problem.problem import Problem
from optloc.problem.signal import Signal
from optloc.problem.validation import checked
from optloc.problem.written import Written
from optloc.station_health.levels import NoiseLevels
from optloc.station_health.structure import with_estimated_noise

LOG = logging.getLogger("optloc.read")


@dataclass(frozen=True, slots=True)
class Loaded:
    """A problem with the names and units of its file.

    Parameters
    ----------
    problem : Problem
        In SI units.
    source : str
        Name of the file.
    title : str
        Title in the file, or its name.
    epochs : tuple of k str
        Labels of the epochs.
    times : array (k,)
        Times of the epochs in the file, s; NaN if missing.
    targets : tuple of str
        Name of each target; with `own_epochs`, name of the target of each epoch.
    own_epochs : bool
        Whether each epoch belongs to one target.
    levels : NoiseLevels, optional
        Noise estimated from the data, if the file requests it.
    bias_units : mapping of str to (str, float)
        Unit of each bias in the file, and its size in SI units with sign; biases in SI units are left out.
    azimuths : str
        Convention of azimuths, and the setting that changes it; empty without azimuths.
    table : mapping
        Interpretation of a measurement table, as a JSON value; empty for a problem file.
    warnings : tuple of str
        Sentences on values that are physically suspicious.
    speed : str
        Wave speed, as text; empty if no value depends on it.
    emission : EmissionClock, optional
        Clock of the arrivals, for emission times; None without arrivals that are times.
    dated : bool
        Whether `times` are seconds since 1970, UTC.
    floors : tuple of float
        Heights, metres, on one of which the target is; empty without such a list.
    """

    problem: Problem
    source: str
    title: str
    epochs: tuple[str, ...]
    times: Array
    targets: tuple[str, ...]
    own_epochs: bool = False
    levels: NoiseLevels | None = None
    bias_units: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    azimuths: str = ""
    table: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    speed: str = ""
    floors: tuple[float, ...] = ()
    emission: EmissionClock | None = None
    dated: bool = False

    def bias_unit(self, name: str, unit: str) -> tuple[str, float]:
        """Return the display unit of an unknown and its size in SI units: from the file, else `unit`."""
        return self.bias_units.get(name, (unit, 1.0))


@dataclass(frozen=True, slots=True)
class Draft:
    """A problem with all data that are needed to write its file again.

    Parameters
    ----------
    loaded : Loaded
        The problem.
    file : ProblemFile
        Settings.
    tables : tuple of Table
        Rows of each ``[[measurements]]``.
    chunks : tuple of RowChunk
        The same rows in SI units, one chunk for each kind of each table.
    numbers : tuple of int array (m,)
        Global row number of each row of each chunk.
    moving : bool
        Whether stations or known targets move.
    """

    loaded: Loaded
    file: ProblemFile
    tables: tuple[Table, ...]
    chunks: tuple[RowChunk, ...]
    numbers: tuple[Array, ...]
    moving: bool

    def plausible(self, surface: str) -> Loaded:
        """Return the problem with warnings on suspicious values; raise InvalidProblem for impossible values."""
        found = warnings_of(self.loaded.problem, self.chunks, self.numbers, surface, self.loaded.source)
        units = {chunk.kind: float(chunk.unit.factor) for chunk in self.chunks}
        speed = self.chunks[0].units.speed if self.chunks else None
        own = any(isinstance(one, str) for each in self.file.measurements for one in (each.sigma, each.arrival_sigma))
        both = any(each.two_way or each.turn_around is not None for each in self.file.measurements)
        size, keys = UNITS["length"].get(self.file.stations.unit), _place_keys(self.file.stations)
        problem = replace(self.loaded.problem, written=Written(units, speed, both, own, size, keys))
        more = unused_picks(self.chunks, problem.stations.names)
        return replace(self.loaded, problem=problem, warnings=found + more)


_PLACE_KEYS = (("x", "y"), ("x", "y", "z"), ("lat_deg", "lon_deg", "height"))


def _place_keys(stations: StationsTable) -> tuple[str, ...]:
    """Return the keys of the coordinates in the rows of stations that have no other keys than these and the name."""
    keys = {tuple(sorted(row)) for row in stations.rows or ()}
    return next((each for each in _PLACE_KEYS if keys == {tuple(sorted(("name", *each)))}), ())


def load(path: str | Path, *, outside: bool | None = None, budget: Budget | None = None) -> Problem:
    """Return the problem of a file.

    Parameters
    ----------
    path : str or Path
        A TOML file with ``format = 1`` or 2.
    outside : bool, optional
        Whether the file may name files outside its folder; by default not.
    budget : Budget, optional
        Limits on the size of the file and its tables.

    Raises
    ------
    InvalidProblem
        One sentence that names the file, the row and the column or key, with advice.
    """
    with access(outside=outside, budget=budget):
        return read(path).problem


def read(
    path: str | Path,
    *,
    values: bool = True,
    more: Mapping[str, ConstraintTable] | None = None,
    wave: WaveOptions | None = None,
) -> Loaded:
    """Return the problem of a file with the names that results need.

    Parameters
    ----------
    path : str or Path
        A TOML file with ``format = 1`` or 2.
    values : bool
        Whether measured values are required; False for simulations and bounds.
    more : mapping of str to ConstraintTable, optional
        Constraints in addition to those of the file, by their place for messages.
    wave : WaveOptions, optional
        Options on the wave, which replace the statements of the file.

    Raises
    ------
    InvalidProblem
        As in `load`.
    """
    loaded = draft(Path(path), values=values, more=more or {}, wave=wave).plausible("file")
    p = loaded.problem
    LOG.info("read %s: %d rows, %d epochs, %d stations", loaded.source, p.count, p.epochs, p.stations.count)
    return loaded


def draft(
    path: Path,
    *,
    values: bool,
    more: Mapping[str, ConstraintTable] | None = None,
    wave: WaveOptions | None = None,
) -> Draft:
    """Return the problem of a file together with its tables; the arguments are as in `read`."""
    file, source = with_options(read_document(path), wave), name_of(path)
    file = with_profile(file, path.parent, source)
    # Read tables before converting anything, so that a missing file is reported before a wrong unit.
    known, limits = places_of(file, path.parent, source), limits_of(file, path.parent, source)
    stations = table_of(file.stations, path.parent, join(source, "[stations]"))
    places = [join(source, f"[[measurements]] {i + 1}") for i in range(len(file.measurements))]
    tables = [table_of(m, path.parent, place) for m, place in zip(file.measurements, places, strict=True)]
    return assemble(file, stations, tables, source, values=values, known=known, limits=limits, more=more)


def assemble(
    file: ProblemFile,
    station_table: Table,
    tables: Sequence[Table],
    source: str,
    *,
    values: bool,
    known: Mapping[str | None, Table] | None = None,
    limits: Mapping[str, Demand] | None = None,
    more: Mapping[str, ConstraintTable] | None = None,
) -> Draft:
    """Return the problem of settings and tables.

    Parameters
    ----------
    file : ProblemFile
        Settings.
    station_table : Table
        Rows of the stations.
    tables : sequence of Table
        Rows of each ``[[measurements]]``.
    source : str
        Name of the settings for messages.
    values : bool
        Whether measured values are required.
    known : mapping of str to Table, optional
        Positions of known targets by name; None is the key of the single target.
    limits : mapping of str to constraints, optional
        The constraints by their place for messages, see `limits_of`; by default the constraints of `file`.
    more : mapping of str to ConstraintTable, optional
        As in `read`.
    """
    stated = file  # the azimuth convention that is stated, and not assumed below
    file, station_table, tables = with_standard_names(file, station_table, tables, source)
    azimuths = azimuths_of(stated, file)
    if ASSUMED in azimuths:
        LOG.warning("%s: azimuths are counted by %s", source, azimuths)
    speed = speed_of(file, source)
    found, frame = survey(file.stations, station_table, file.frame, source)
    chunks = []
    for i, (section, table) in enumerate(zip(file.measurements, tables, strict=True)):
        place = join(source, f"[[measurements]] {i + 1}")
        chunks += chunks_of(Context(section, table, found.names, place, speed, values, _scale(file)))
    # Epochs come from the rows of all tables together: one instant may have rows of several kinds.
    epochs = _epochs(file, chunks, source)
    cuts = np.cumsum([len(chunk.z) for chunk in chunks])[:-1]
    index, target = np.split(epochs.index, cuts), np.split(epochs.target, cuts)
    check_repeats(chunks, index, target, found.names, epochs)
    groups = [one + len(epochs.labels) * other for one, other in zip(index, target, strict=True)]
    # Positions of moving stations are needed only at epochs with rows of them; elsewhere they may be unknown.
    stations = over_epochs(
        found, file.stations, epochs, [_stations_used(c, i) for c, i in zip(chunks, index, strict=True)]
    )
    check_speed(file, chunks, groups, stations, source)
    # Convert excess paths to path sums now, since the station positions are known.
    pairs = [(with_station_distance(chunk, i, stations), i) for chunk, i in zip(chunks, index, strict=True)]
    chunks = [with_declination(chunk, i, stations, frame) for chunk, i in pairs]
    check_layers(chunks, file.medium, source)
    chunks, index, target = split_phases(chunks, index, target, source)
    azimuths += declination_text(chunks) if azimuths else ""
    rows, numbers = _rows(chunks, index, target)
    written = [(number, chunk.units, chunk.written_unit) for number, chunk in zip(numbers, chunks, strict=True)]
    biases = [bias_of(b, rows, stations.names, epochs, stations.dimension, written, source) for b in file.biases]
    units = {bias.name: unit for bias, unit in biases if unit[0]}  # no entry for rows in several units
    all_biases = tuple(bias for bias, _ in biases)
    all_biases += speed_bias(file, written, all_biases, source)
    demands = {**(limits_of(file, None, source) if limits is None else limits), **demands_of(more or {})}
    noise = _noise(file, chunks, numbers, index, target, source)
    problem = _problem(file, epochs, stations, rows, noise, all_biases, frame, source, known or {}, demands)
    # The estimation of noise needs fixes, so do it last.
    problem, levels = with_noise(file, problem, source)
    named = (epochs.labels, epochs.times, epochs.targets, epochs.own)
    words = speed_words(file, source) if any(chunk.depends_on_speed for chunk in chunks) else ""
    floors = floors_of(demands, problem.motions)
    clock = emission_clock(chunks, index, numbers, all_biases, epochs)
    loaded = Loaded(
        problem, source, file.title or source, *named, levels, units, azimuths, speed=words, floors=floors,
        emission=clock, dated=epochs.dated,
    )  # fmt: skip
    moving = found.moving or _has_moving_target(problem)
    return Draft(loaded, file, tuple(tables), tuple(chunks), tuple(numbers), moving)


def _problem(
    file: ProblemFile,
    epochs: Epochs,
    stations: Stations,
    rows: tuple[Rows, ...],
    noise: Noise,
    biases: tuple[Bias, ...],
    frame: Frame,
    source: str,
    known: Mapping[str | None, Table],
    demands: Mapping[str, Demand],
) -> Problem:
    """Return the checked problem with the motions, priors, constraints and medium of the file.

    `known` has the positions of known targets by name, and `demands` the constraints by their place for messages.
    """
    speed = speed_of(file, source)
    motions = motions_of(file, epochs, known_of(file, known, epochs, frame, stations.dimension), source)
    # Times matter for motions and drifts; other files may omit times, or repeat them.
    why = needs_clock(motions, file.biases)
    times = epochs.clock if why is None else need_clock(epochs, why, source)
    priors = tuple(prior_of(p, stations.dimension, source) for p in file.priors)
    limits, motions = constraints_of(demands, stations, frame, motions, epochs.targets, times, speed)
    dated = epochs.dated and times is epochs.times
    made = Problem(stations, rows, noise, times, motions, biases, priors, frame, dated=dated, **divided(limits))
    check_budget("unknowns", made.layout.n_shared, source)
    return _check(made, source, medium_in(file, source, frame, stations))


def _epochs(file: ProblemFile, chunks: Sequence[RowChunk], source: str) -> Epochs:
    """Return the epochs of the rows of all chunks; raise InvalidProblem if only some tables have times or labels."""
    columns: dict[str, Array | None] = {}
    for key in ("label", "time", "written", "target"):
        parts = [getattr(chunk, key) for chunk in chunks]
        present = [part for part in parts if part is not None]
        # If a table has no labels or times, but another table has, raise.
        if 0 < len(present) < len(parts):
            name = {"label": "epoch", "written": "time"}.get(key, key)
            lacking = chunks[next(i for i, part in enumerate(parts) if part is None)].table.source
            raise InvalidProblem(
                f"there is no column {name!r}, which other measurements have", lacking, "add the column"
            )
        columns[key] = np.concatenate(present) if present else None
    place = join(source, "[epochs]", "key 'window'")
    window = None if file.epochs.window is None else Units("time").plain(file.epochs.window, None, place)
    if window is not None and (window <= 0.0 or columns["time"] is None or columns["label"] is not None):
        what = "the window is not positive" if window <= 0.0 else "a window needs a column 'time' and no column 'epoch'"
        raise InvalidProblem(what, place, "remove the key, or correct the columns")
    # A stated motion decides whether targets are free at each epoch; otherwise the number of epochs decides.
    motion = {table.moves for table in (file.target, *file.targets.values())} - {None}
    free = None if not motion else motion <= FREE
    keys = Keys(columns["label"], columns["time"], columns["written"], columns["target"])
    found = epochs_of(keys, sum(len(chunk.z) for chunk in chunks), window, free, source)
    return replace(found, scale=_scale(file), dated=_is_dated(file, chunks, source))


def _scale(file: ProblemFile) -> TimeScale:
    """Return the scale of numbers in the columns of times of a file."""
    return file.epochs.time_scale or "none"


def _is_dated(file: ProblemFile, chunks: Sequence[RowChunk], source: str) -> bool:
    """Return whether the times of a file are seconds since 1970, UTC; raise InvalidProblem for a scale of dates."""
    timed = [chunk for chunk in chunks if chunk.time is not None]
    dates, scale = any(chunk.dated for chunk in timed), _scale(file)
    if scale in ("gps", "tai") and timed and all(chunk.dated for chunk in timed):
        what = f"the measurements have dates, which are UTC, but the time scale is {scale}"
        advice = "convert the dates to UTC and remove the key, or give seconds"
        raise InvalidProblem(what, join(source, "[epochs]", "key 'time_scale'"), advice)
    return bool(timed) and (dates or scale != "none")


def _stations_used(chunk: RowChunk, epoch: Array) -> Array:
    """Return the pairs (epoch, station) (u, 2) whose position the present rows of a chunk need."""
    pairs = [np.stack([epoch, station], axis=-1)[(station >= 0) & (chunk.weight > 0)] for station in (chunk.a, chunk.b)]
    return np.concatenate(pairs)


def _rows(
    chunks: Sequence[RowChunk], index: Sequence[Array], target: Sequence[Array]
) -> tuple[tuple[Rows, ...], list[Array]]:
    """Return the rows of each kind, and the global number of each row of each chunk.

    `index` and `target` are the epoch and the target of each row (m,), for each chunk.
    """
    # A problem has one block of rows for each kind, in the order of appearance; numbers refer to the chunks. Compass
    # bearings have a separate block from other azimuths, since their errors are clockwise.
    order = list(dict.fromkeys(chunk.kind for chunk in chunks))
    distinct = dict.fromkeys((chunk.kind, chunk.units.clockwise) for chunk in chunks)
    kinds = sorted(distinct, key=lambda pair: order.index(pair[0]))
    rows, numbers, start = [], [np.zeros(0, dtype=np.int64)] * len(chunks), 0
    for kind, clockwise in kinds:
        same = [i for i, chunk in enumerate(chunks) if (chunk.kind, chunk.units.clockwise) == (kind, clockwise)]
        columns = {
            name: _concatenate([getattr(chunks[i], name) for i in same])
            for name in ("z", "a", "b", "weight", "correction")
        }
        joined = {
            "epoch": _concatenate([index[i] for i in same]),
            "target": _concatenate([target[i] for i in same]),
        }
        made = Rows(kind, **columns, **joined)
        rows.append(made.clockwise() if clockwise else made)
        for i in same:
            numbers[i] = start + np.arange(len(chunks[i].z))
            start += len(chunks[i].z)
    return tuple(rows), numbers


def _concatenate(parts: Sequence[Array]) -> Array:
    """Return the concatenation of arrays; a single array is returned unchanged."""
    # Do not copy a single part: constant columns of millions of rows use no memory.
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


# Covariance blocks of measurements: independent rows, arrivals, a matrix for each epoch, or a matrix over all kinds.


def _noise(
    file: ProblemFile,
    chunks: Sequence[RowChunk],
    numbers: Sequence[Array],
    index: Sequence[Array],
    target: Sequence[Array],
    source: str,
) -> Noise:
    """Return the noise of all rows: from the chunks, or from the covariance of the whole file.

    `numbers`, `index` and `target` are the global number, the epoch and the target of each row (m,), for each chunk.
    """
    if file.covariance is None:
        return noise_of(chunks, numbers, index, target)
    place = join(source, "key 'covariance'")
    if any(part is not None for c in chunks for part in (c.sigma, c.arrival, c.covariance, c.signal, c.combination)):
        raise InvalidProblem("the noise is given more than once", place, "remove the noise of the single measurements")
    matrix = square(file.covariance, place)
    slope = np.concatenate([chunk.slope for chunk in chunks])
    return Noise((per_epoch(np.concatenate(list(numbers)), np.concatenate(list(index)), slope, matrix, place),))


def noise_of(
    chunks: Sequence[RowChunk], numbers: Sequence[Array], epochs: Sequence[Array], targets: Sequence[Array]
) -> Noise:
    """Return the noise of chunks.

    `numbers`, `epochs` and `targets` are the global row number, epoch and target (m,) of each row, for each chunk.
    """
    blocks = combined_noise(chunks, numbers)
    for chunk, number, epoch, target in zip(chunks, numbers, epochs, targets, strict=True):
        if chunk.sigma is not None:
            blocks.append(Block(number[:, None], chunk.sigma[:, None, None] ** 2))
        elif chunk.arrival is not None:
            # Rows of one epoch and one target share the errors of arrivals; another emission has other errors.
            members = group_members(epoch * (target.max(initial=0) + 1) + target)
            blocks += [Block(number[m], _arrivals(chunk, m)) for m in members]
        elif chunk.signal is not None:
            members = group_members(epoch * (target.max(initial=0) + 1) + target)
            blocks += [Block(number[m], _by_signal(chunk, chunk.signal, m)) for m in members]
        elif chunk.covariance is not None:
            blocks.append(_per_epoch_block(chunk, number, epoch, chunk.covariance))
        elif chunk.combination is None:
            advice = "give sigma, arrival_sigma, covariance or snr, or rows with a column sigma"
            raise InvalidProblem("the measurements have no noise", chunk.table.source, advice)
    return group(blocks)


def _arrivals(chunk: RowChunk, members: Array) -> Array:
    """Return the covariances (g, r, r), SI, of g groups of rows whose noise is the noise of arrivals at stations.

    `members` (g, r) are the rows of each group. Raise InvalidProblem for a row without noise.
    """
    signs = MODELS[chunk.kind].signs
    assert signs is not None
    assert chunk.arrival is not None
    ends = [(index[members], sign) for index, sign in zip((chunk.a, chunk.b), signs, strict=True)]
    covariance = arrivals(ends, chunk.arrival**2)
    row, column = np.nonzero(np.diagonal(covariance, axis1=-2, axis2=-1) <= 0.0)
    if len(row):
        place = join(chunk.table.source, f"row {chunk.row[members[row[0], column[0]]] + 1}")
        raise InvalidProblem("no station of this row has an arrival_sigma", place, "add its stations to arrival_sigma")
    return covariance


def _by_signal(chunk: RowChunk, signal: Signal, members: Array) -> Array:
    """Return the covariances (g, r, r), SI, of groups of rows `members` (g, r) from the signal-to-noise ratio."""
    try:
        return signal.covariance(chunk.kind, chunk.a[members], chunk.b[members])
    except InvalidProblem as error:
        raise InvalidProblem(error.what, join(chunk.table.source, f"key {error.where!r}"), error.advice) from None


def _per_epoch_block(chunk: RowChunk, number: Array, epoch: Array, matrix: Array) -> Block:
    """Return the covariance block of a chunk with a covariance (r, r), in units of the file, for each epoch.

    `number` and `epoch` (m,) are the global number and the epoch of each row.
    """
    return per_epoch(number, epoch, chunk.slope, matrix, join(chunk.table.source, "covariance"), int(chunk.row[0]))


def per_epoch(number: Array, epoch: Array, slope: Array, matrix: Array, where: str, first: int = 0) -> Block:
    """Return the covariance block of a matrix (r, r), in units of the file, that applies to the r rows of each epoch.

    `number` and `epoch` (m,) are the global number and the epoch of each row. `slope` (m,) are the SI units in one unit
    of the file. `where` is the place for messages, and `first` the row number of the first row. Raise InvalidProblem if
    an epoch does not have r rows.
    """
    groups = group_members(epoch)
    # The matrix is the same for each epoch: absent rows keep their place with weight 0.
    wrong = [g for g in groups if g.shape[1] != len(matrix)]
    if wrong:
        row = int(wrong[0][0, 0])
        what = f"the epoch of row {row + first + 1} has {wrong[0].shape[1]} rows, but the covariance has {len(matrix)}"
        raise InvalidProblem(what, where, "give all rows at each epoch, absent rows with weight 0")
    members = groups[0]
    # SI units in one unit of the file, per row: for decibels they depend on the value.
    sizes = slope[members]
    if not np.isfinite(sizes).all():
        raise InvalidProblem("a covariance in dB needs the measured values", where, "state it in unit '1'")
    return Block(number[members], matrix * sizes[:, :, None] * sizes[:, None, :])


def with_noise(file: ProblemFile, problem: Problem, source: str) -> tuple[Problem, NoiseLevels | None]:
    """Return the problem with noise estimated from the data if the file requests it, and the noise levels."""
    if all(section.sigma != ESTIMATE for section in file.measurements):
        return problem, None
    place = join(source, "key 'sigma'")
    if any(section.sigma != ESTIMATE for section in file.measurements):
        what = "some measurements state their noise, and others request an estimate"
        raise InvalidProblem(what, place, f'state it for all, or write sigma = "{ESTIMATE}" for all')
    if not np.isfinite(problem.z[problem.weight > 0.0]).all():
        raise InvalidProblem("the noise cannot be estimated without measured values", place, "state a sigma")
    try:
        return with_estimated_noise(problem)
    except InvalidProblem as error:
        raise InvalidProblem(error.what, place, error.advice) from None


def _check(problem: Problem, source: str, medium: Medium | None = None) -> Problem:
    """Return the problem in its medium after all checks; an error names the file."""
    try:
        return checked(problem if medium is None else problem.in_medium(medium))
    except InvalidProblem as error:
        raise InvalidProblem(error.what, join(source, error.where), error.advice) from None


def _has_moving_target(problem: Problem) -> bool:
    """Return whether a known target moves: it has several positions."""
    return any(motion.known is not None and len(motion.known) > 1 for motion in problem.motions)
