"""From a problem file to a problem: tables are read, epochs found, everything converted to SI and checked."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from optloc.base.errors import InvalidProblem
from optloc.base.frames import Frame
from optloc.base.inputs import Budget, access, check_budget
from optloc.base.types import Array, Bias, Rows, Stations
from optloc.files.measurements import (
    ESTIMATE,
    RowChunk,
    check_repeats,
    chunks_of,
    declination_text,
    square,
    with_baseline,
    with_declination,
)
from optloc.files.propagation import medium_in, speed_bias, speed_of
from optloc.files.roles import ASSUMED, azimuths_of, with_standard_names
from optloc.files.schema import (
    ConstraintTable,
    ProblemFile,
    Units,
    join,
    name_of,
    read_document,
    validate,
)
from optloc.files.stations import over_epochs, station_table, survey
from optloc.files.table import Epochs, Keys, Table, epochs_of, need_clock, of_frame, table_of
from optloc.files.unknowns import (
    FREE,
    bias_of,
    constraints_of,
    known_of,
    motions_of,
    needs_clock,
    places_of,
    prior_of,
)
from optloc.models import MODELS
from optloc.models.medium import Medium
from optloc.problem.noise import Block, Noise, arrivals, group, group_members
from optloc.problem.problem import Problem
from optloc.problem.signal import Signal
from optloc.problem.validation import checked
from optloc.station_health.levels import NoiseLevels
from optloc.station_health.structure import with_estimated_noise

if TYPE_CHECKING:
    import pandas as pd

LOG = logging.getLogger("optloc.read")


@dataclass(frozen=True, slots=True)
class Loaded:
    """A problem and what its file calls things.

    Parameters
    ----------
    problem : Problem
        In SI units.
    source : str
        Name of the file.
    title : str
        What the file says it is, or its name.
    epochs : tuple of k str
        Labels of the epochs.
    times : array (k,)
        Seconds as the file gives them; NaN where it gives none.
    targets : tuple of str
        Name of each target; of the target of each epoch where `own_epochs`.
    own_epochs : bool
        Whether every epoch belongs to one target.
    levels : NoiseLevels, optional
        What the data say of the noise, where it is left to them.
    bias_units : mapping of str to (str, float)
        Unit of the file that people read each bias in, and its SI size with sign; those read in SI are left out.
    azimuths : str
        From where azimuths are counted, and how the file would say otherwise; empty where there are none.
    table : mapping
        How a foreign table was read, as a JSON value; empty of a problem file.
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

    def bias_unit(self, name: str, unit: str) -> tuple[str, float]:
        """Return the unit that people read an unknown in and its SI size: the file's, or what its slot says."""
        return self.bias_units.get(name, (unit, 1.0))


@dataclass(frozen=True, slots=True)
class Draft:
    """A problem with everything that is needed to write its file again.

    Parameters
    ----------
    loaded : Loaded
        The problem.
    file : ProblemFile
        Settings.
    tables : tuple of Table
        Rows of each ``[[measurements]]``.
    chunks : tuple of RowChunk
        The same in SI units, one for each kind of each table.
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


def load(path: str | Path, *, outside: bool | None = None, budget: Budget | None = None) -> Problem:
    """Return the problem of a file.

    Parameters
    ----------
    path : str or Path
        A TOML file with ``format = 1`` or 2.
    outside : bool, optional
        Whether it may name files that are not beneath its own folder; it may not by default.
    budget : Budget, optional
        How much it and its tables may hold.

    Raises
    ------
    InvalidProblem
        One sentence that names the file, the row and the column or key, and says what to do.
    """
    with access(outside=outside, budget=budget):
        return read(path).problem


def read(path: str | Path, *, values: bool = True, more: Mapping[str, ConstraintTable] | None = None) -> Loaded:
    """Return the problem of a file with the names that results need.

    Parameters
    ----------
    path : str or Path
        A TOML file with ``format = 1`` or 2.
    values : bool
        Whether measured values are needed; False for simulations and bounds.
    more : mapping of str to ConstraintTable, optional
        Constraints in addition to those of the file, each behind the place to name.

    Raises
    ------
    InvalidProblem
        As `load`.
    """
    loaded = draft(Path(path), values=values, more=more or {}).loaded
    p = loaded.problem
    LOG.info("read %s: %d rows, %d epochs, %d stations", loaded.source, p.count, p.epochs, p.stations.count)
    return loaded


def draft(path: Path, *, values: bool, more: Mapping[str, ConstraintTable] | None = None) -> Draft:
    """Return the problem of a file together with its tables; arguments as `read`."""
    file, source = read_document(path), name_of(path)
    # Tables are read before anything is converted: a missing file is told before a wrong unit.
    known = places_of(file, path.parent, source)
    stations = table_of(file.stations, path.parent, join(source, "[stations]"))
    places = [join(source, f"[[measurements]] {i + 1}") for i in range(len(file.measurements))]
    tables = [table_of(m, path.parent, place) for m, place in zip(file.measurements, places, strict=True)]
    return assemble(file, stations, tables, source, values=values, known=known, more=more)


def assemble(
    file: ProblemFile,
    station_table: Table,
    tables: Sequence[Table],
    source: str,
    *,
    values: bool,
    known: Mapping[str | None, Table] | None = None,
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
        Name to call the settings.
    values : bool
        Whether measured values are needed.
    known : mapping of str to Table, optional
        Places of known targets by name; None names the target.
    more : mapping of str to ConstraintTable, optional
        As `read`.
    """
    stated = file
    file, station_table, tables = with_standard_names(file, station_table, tables, source)
    azimuths = azimuths_of(stated, file)
    if ASSUMED in azimuths:
        LOG.warning("%s: azimuths are counted by %s", source, azimuths)
    speed = speed_of(file, source)
    found, frame = survey(file.stations, station_table, file.frame, source)
    chunks = []
    for i, (section, table) in enumerate(zip(file.measurements, tables, strict=True)):
        place = join(source, f"[[measurements]] {i + 1}")
        chunks += chunks_of(section, table, found.names, place, speed, values=values)
    # Epochs come from the rows of all tables together: one instant may have rows of several kinds.
    epochs = _epochs(file, chunks, source)
    cuts = np.cumsum([len(chunk.z) for chunk in chunks])[:-1]
    index, target = np.split(epochs.index, cuts), np.split(epochs.target, cuts)
    check_repeats(chunks, index, target, found.names, epochs)
    # Stations that move are needed only where somebody measured; elsewhere they may be unknown.
    stations = over_epochs(
        found, file.stations, epochs, [_stations_used(c, i) for c, i in zip(chunks, index, strict=True)]
    )
    # Excess paths become path sums only now, when it is known where their stations were.
    chunks = [_add_baseline(chunk, i, stations) for chunk, i in zip(chunks, index, strict=True)]
    chunks = [with_declination(chunk, i, stations, frame) for chunk, i in zip(chunks, index, strict=True)]
    if azimuths:
        azimuths += declination_text(chunks)
    rows, numbers = _rows(chunks, index, target)
    noise = _noise(file, chunks, numbers, index, target, source)
    written = [(number, chunk.units, chunk.written_unit) for number, chunk in zip(numbers, chunks, strict=True)]
    biases = [bias_of(b, rows, stations.names, epochs, stations.dimension, written, source) for b in file.biases]
    units = {bias.name: unit for bias, unit in biases if unit[0]}
    own = tuple(bias for bias, _ in biases)
    own += speed_bias(file, written, own, source)
    problem = _problem(file, epochs, stations, rows, noise, own, frame, source, known or {}, more or {})
    # Noise that is left to the data needs fixes, so the whole problem: it comes last.
    problem, levels = with_noise(file, problem, source)
    title = file.title or source
    named = (epochs.labels, epochs.times, epochs.targets, epochs.own)
    loaded = Loaded(problem, source, title, *named, levels, units, azimuths)
    return Draft(loaded, file, tuple(tables), tuple(chunks), tuple(numbers), found.moving or _follows(problem))


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
    more: Mapping[str, ConstraintTable],
) -> Problem:
    speed = speed_of(file, source)
    motions = motions_of(file, epochs, known_of(file, known, epochs, frame, stations.dimension), source)
    # Times matter to what moves or drifts; other files may leave them out, or date epochs alike.
    why = needs_clock(motions, file.biases)
    times = epochs.clock if why is None else need_clock(epochs, why, source)
    priors = tuple(prior_of(p, stations.dimension, source) for p in file.priors)
    demands = {join(source, f"[[constraints]] {i + 1}"): table for i, table in enumerate(file.constraints)}
    demands |= more
    constraints, motions = constraints_of(demands, stations, frame, motions, epochs.targets, times, speed)
    made = Problem(stations, rows, noise, times, motions, biases, priors, frame, constraints)
    check_budget("unknowns", made.layout.n_shared, source)
    return _check(made, source, medium_in(file, source))


def _epochs(file: ProblemFile, chunks: Sequence[RowChunk], source: str) -> Epochs:
    columns: dict[str, Array | None] = {}
    for key in ("label", "time", "written", "target"):
        parts = [getattr(chunk, key) for chunk in chunks]
        present = [part for part in parts if part is not None]
        # A table of labelled epochs may leave their times to another one, but not the other way round.
        if 0 < len(present) < len(parts):
            name = {"label": "epoch", "written": "time"}.get(key, key)
            lacking = chunks[next(i for i, part in enumerate(parts) if part is None)].table.source
            raise InvalidProblem(f"there is no column {name!r}, which other measurements have", lacking, "add it")
        columns[key] = np.concatenate(present) if present else None
    place = join(source, "[epochs]", "key 'window'")
    window = None if file.epochs.window is None else Units("time").plain(file.epochs.window, None, place)
    if window is not None and (window <= 0.0 or columns["time"] is None or columns["label"] is not None):
        what = "the window is not positive" if window <= 0.0 else "a window needs a column 'time' and no column 'epoch'"
        raise InvalidProblem(what, place, "leave the key out, or correct the columns")
    # A stated motion decides whether targets are free at each epoch; none leaves it to the number of epochs.
    motion = {table.moves for table in (file.target, *file.targets.values())} - {None}
    free = None if not motion else motion <= FREE
    keys = Keys(columns["label"], columns["time"], columns["written"], columns["target"])
    return epochs_of(keys, sum(len(chunk.z) for chunk in chunks), window, free, source)


def _stations_used(chunk: RowChunk, epoch: Array) -> Array:
    pairs = [np.stack([epoch, station], axis=-1)[(station >= 0) & (chunk.weight > 0)] for station in (chunk.a, chunk.b)]
    return np.concatenate(pairs)


def _add_baseline(chunk: RowChunk, epoch: Array, stations: Stations) -> RowChunk:
    if not chunk.excess:
        return chunk
    place = stations.position[epoch if len(stations.position) > 1 else np.zeros_like(epoch)]
    rows = np.arange(len(epoch))
    return with_baseline(chunk, np.linalg.norm(place[rows, chunk.a] - place[rows, chunk.b], axis=-1))


def _rows(
    chunks: Sequence[RowChunk], index: Sequence[Array], target: Sequence[Array]
) -> tuple[tuple[Rows, ...], list[Array]]:
    """Return the rows of each kind, and the global number of each row of each chunk."""
    # A problem has one block of rows for each kind, in the order of appearance; numbers lead back to the chunks.
    # Compass bearings beside other azimuths have a block of their own, as their errors are clockwise.
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
    # One part is not copied: constant columns of millions of rows take no memory.
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


# Covariance blocks of measurements: independent rows, arrivals, a matrix for each epoch, or one over all kinds.


def _noise(
    file: ProblemFile,
    chunks: Sequence[RowChunk],
    numbers: Sequence[Array],
    index: Sequence[Array],
    target: Sequence[Array],
    source: str,
) -> Noise:
    if file.covariance is None:
        return noise_of(chunks, numbers, index, target)
    place = join(source, "key 'covariance'")
    if any(part is not None for c in chunks for part in (c.sigma, c.arrival, c.covariance, c.signal)):
        raise InvalidProblem("the noise is given more than once", place, "leave out that of the single measurements")
    matrix = square(file.covariance, place)
    slope = np.concatenate([chunk.slope for chunk in chunks])
    return Noise((per_epoch(np.concatenate(list(numbers)), np.concatenate(list(index)), slope, matrix, place),))


def noise_of(
    chunks: Sequence[RowChunk], numbers: Sequence[Array], epochs: Sequence[Array], targets: Sequence[Array]
) -> Noise:
    """Return the noise of chunks.

    Parameters
    ----------
    chunks : sequence of RowChunk
        Rows with their own noise.
    numbers, epochs, targets : sequence of int array (m,)
        Global row number, epoch and target of each row of each chunk.
    """
    blocks: list[Block] = []
    for chunk, number, epoch, target in zip(chunks, numbers, epochs, targets, strict=True):
        if chunk.sigma is not None:
            blocks.append(Block(number[:, None], chunk.sigma[:, None, None] ** 2))
        elif chunk.arrival is not None:
            # Arrivals are common to the rows of one epoch and one target: another pulse has other errors.
            members = group_members(epoch * (target.max(initial=0) + 1) + target)
            blocks += [Block(number[m], _arrivals(chunk, m)) for m in members]
        elif chunk.signal is not None:
            members = group_members(epoch * (target.max(initial=0) + 1) + target)
            blocks += [Block(number[m], _by_signal(chunk, chunk.signal, m)) for m in members]
        elif chunk.covariance is not None:
            blocks.append(_per_epoch_block(chunk, number, epoch, chunk.covariance))
        else:
            advice = "give sigma, arrival_sigma, covariance or snr, or rows with a column sigma"
            raise InvalidProblem("the measurements have no noise", chunk.table.source, advice)
    return group(blocks)


def _arrivals(chunk: RowChunk, members: Array) -> Array:
    """Return the covariance (g, r, r) of groups of rows (g, r) that combine what stations measure independently."""
    signs = MODELS[chunk.kind].signs
    assert signs is not None
    assert chunk.arrival is not None
    ends = [(index[members], sign) for index, sign in zip((chunk.a, chunk.b), signs, strict=True)]
    covariance = arrivals(ends, chunk.arrival**2)
    row, column = np.nonzero(np.diagonal(covariance, axis1=-2, axis2=-1) <= 0.0)
    if len(row):
        place = join(chunk.table.source, f"row {chunk.row[members[row[0], column[0]]] + 1}")
        raise InvalidProblem("no station of this row has an arrival_sigma", place, "name its stations there")
    return covariance


def _by_signal(chunk: RowChunk, signal: Signal, members: Array) -> Array:
    try:
        return signal.covariance(chunk.kind, chunk.a[members], chunk.b[members])
    except InvalidProblem as error:
        raise InvalidProblem(error.what, join(chunk.table.source, f"key {error.where!r}"), error.advice) from None


def _per_epoch_block(chunk: RowChunk, number: Array, epoch: Array, matrix: Array) -> Block:
    return per_epoch(number, epoch, chunk.slope, matrix, join(chunk.table.source, "covariance"), int(chunk.row[0]))


def per_epoch(number: Array, epoch: Array, slope: Array, matrix: Array, where: str, first: int = 0) -> Block:
    """Return the block of a matrix (r, r) that holds for the r rows of every epoch, in the order of the file.

    Parameters
    ----------
    number, epoch : int array (m,)
        Global row number and epoch of each row.
    slope : array (m,)
        SI units in one unit of the file.
    matrix : array (r, r)
        In the file's units.
    where : str
        Place to name.
    first : int
        Row that the first stands in.
    """
    groups = group_members(epoch)
    # One matrix for every epoch: absent rows keep their place with weight 0.
    wrong = [g for g in groups if g.shape[1] != len(matrix)]
    if wrong:
        row = int(wrong[0][0, 0])
        what = f"the epoch of row {row + first + 1} has {wrong[0].shape[1]} rows, but the covariance {len(matrix)}"
        raise InvalidProblem(what, where, "give every epoch all rows, absent ones with weight 0")
    members = groups[0]
    # SI units in one unit of the file, per row: of decibels it depends on the value.
    sizes = slope[members]
    if not np.isfinite(sizes).all():
        raise InvalidProblem("a covariance in dB needs the measured values", where, "state it in unit '1'")
    return Block(number[members], matrix * sizes[:, :, None] * sizes[:, None, :])


def with_noise(file: ProblemFile, problem: Problem, source: str) -> tuple[Problem, NoiseLevels | None]:
    """Return the problem with its noise found from the data, where the file leaves it to them."""
    if all(section.sigma != ESTIMATE for section in file.measurements):
        return problem, None
    place = join(source, "key 'sigma'")
    if any(section.sigma != ESTIMATE for section in file.measurements):
        what = "the noise of some measurements is stated and that of others is to be estimated"
        raise InvalidProblem(what, place, f'state all, or give sigma = "{ESTIMATE}" to all')
    if not np.isfinite(problem.z[problem.weight > 0.0]).all():
        raise InvalidProblem("without measured values there is no noise to estimate", place, "state a sigma")
    try:
        return with_estimated_noise(problem)
    except InvalidProblem as error:
        raise InvalidProblem(error.what, place, error.advice) from None


def _check(problem: Problem, source: str, medium: Medium | None = None) -> Problem:
    try:
        return checked(problem if medium is None else problem.in_medium(medium))
    # A complaint of the problem gets the name of the file in front.
    except InvalidProblem as error:
        raise InvalidProblem(error.what, join(source, error.where), error.advice) from None


def _follows(problem: Problem) -> bool:
    return any(motion.known is not None and len(motion.known) > 1 for motion in problem.motions)


# Problems from data frames: the long table that an analysis already has.


def from_table(
    table: pd.DataFrame | Mapping[str, ArrayLike],
    stations: pd.DataFrame | Mapping[str, ArrayLike] | Stations,
    *,
    kind: str | None = None,
    unit: str | Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
    sigma: float | str | None = None,
    motion: str | None = None,
    frame: str | Mapping[str, object] = "cartesian",
    window: str | None = None,
    propagation_speed: float | None = None,
    station_options: Mapping[str, object] | None = None,
    constraints: Sequence[Mapping[str, object]] = (),
    values: bool = True,
    **options: object,
) -> Problem:
    """Return the problem of a long table with one row for each measurement.

    Parameters
    ----------
    table : pandas.DataFrame, or mapping of str to array (m,)
        Columns ``kind, a, b, z`` and, where wanted, ``epoch`` or ``time``, ``sigma``, ``target``, ``weight``,
        ``correction``.
    stations : pandas.DataFrame, mapping of str to array (s,), mapping of name to coordinates (d,), or Stations
        A table with the columns ``name, x, y, z`` or ``name, lat_deg, lon_deg, height``; or positions by name.
    kind : str, optional
        Kind of all rows, where there is no column ``kind``.
    unit : str or mapping of kind to str, optional
        Unit of ``z``; SI by default.
    columns : mapping of str to str, optional
        What the table calls its columns: ``{"z": "tdoa_ns"}``.
    sigma : float or str, optional
        Standard deviation of every row, in `unit` or as text with its own: ``"30 ns"``.
    motion : "static", "free", "free_velocity", "constant_velocity" or "constant_acceleration", optional
        How the target moves; static with one epoch, free with several by default.
    frame : str or mapping
        ``"cartesian"``, ``"ecef"``, ``"geodetic"``, or the table ``[frame]`` of a problem file.
    window : str, optional
        Length of an epoch, such as ``"0.1 s"``.
    propagation_speed : float, optional
        Metres per second; light in vacuum by default.
    station_options : mapping, optional
        Further keys of the table ``[stations]`` of a problem file, for instance ``{"unit": "km"}``.
    constraints : sequence of mapping
        Tables ``[[constraints]]`` of a problem file, for instance ``{"kind": "height", "exactly": "500 m"}``.
    values : bool
        Whether measured values are needed; False to simulate them.
    **options
        Further keys of a table ``[[measurements]]``: ``arrival_sigma``, ``azimuth``, ``positive`` and so on.

    Returns
    -------
    Problem
        In SI units.

    Raises
    ------
    InvalidProblem
        Naming the row and column.
    """
    names = dict(columns or {})
    own: Any = station_options or {}
    place: dict[str, Any] = {"kind": frame} if isinstance(frame, str) else dict(frame)
    places = station_table(stations, "stations", names=own.get("columns"))
    measured = {"kind": kind, "unit": dict(unit) if isinstance(unit, Mapping) else unit, "sigma": sigma, **options}
    # The arguments as a problem file: one reader serves both, and complaints name "arguments".
    settings = {
        "format": 1,  # of arguments: azimuths are counted as they always were
        "propagation_speed": propagation_speed,
        "frame": place,
        "stations": dict(own),
        "measurements": [{key: value for key, value in measured.items() if value is not None}],
        "epochs": {"window": window},
        "target": {"motion": motion},
        "constraints": [dict(constraint) for constraint in constraints],
    }
    file = validate(settings, "arguments")
    return assemble(file, places, [of_frame(table, "table", names)], "arguments", values=values).loaded.problem
