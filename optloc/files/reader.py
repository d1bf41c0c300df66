"""From a problem file to a problem: tables are read, epochs found, everything converted to SI and checked."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from optloc.check import checked
from optloc.errors import InvalidProblem
from optloc.files.chunk import Chunk
from optloc.files.constraints import constraints_of
from optloc.files.document import read_document
from optloc.files.epochs import Epochs, Keys, epochs_of, need_clock
from optloc.files.known import known_of, places_of
from optloc.files.loaded import Draft, Loaded
from optloc.files.measurements import chunks_of, with_baseline
from optloc.files.noise import noise_of, per_epoch, with_noise
from optloc.files.repeats import check_repeats
from optloc.files.schema import ConstraintTable, ProblemFile
from optloc.files.sigmas import square
from optloc.files.sources import table_of
from optloc.files.stations import over_epochs, survey
from optloc.files.table import Table
from optloc.files.unknowns import bias_of, motions_of, needs_clock, prior_of
from optloc.files.words import Units, join
from optloc.frames import Frame
from optloc.noise import Noise
from optloc.problem import Problem
from optloc.types import Array, Rows, Stations
from optloc.units import SPEED_OF_LIGHT

LOG = logging.getLogger("optloc.read")


def load(path: str | Path) -> Problem:
    """Return the problem of a file.

    Parameters
    ----------
    path : str or Path
        A TOML file with ``format = 1``.

    Raises
    ------
    InvalidProblem
        One sentence that names the file, the row and the column or key, and says what to do.
    """
    return read(path).problem


def read(path: str | Path, *, values: bool = True, more: Mapping[str, ConstraintTable] | None = None) -> Loaded:
    """Return the problem of a file with the names that results need.

    Parameters
    ----------
    path : str or Path
        A TOML file with ``format = 1``.
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
    file = read_document(path)
    known = places_of(file, path.parent, path.name)
    stations = table_of(file.stations, path.parent, join(path.name, "[stations]"))
    places = [join(path.name, f"[[measurements]] {i + 1}") for i in range(len(file.measurements))]
    tables = [table_of(m, path.parent, place) for m, place in zip(file.measurements, places, strict=True)]
    return assemble(file, stations, tables, path.name, values=values, known=known, more=more)


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
    speed = file.propagation_speed or SPEED_OF_LIGHT
    found, frame = survey(file.stations, station_table, file.frame, source)
    chunks = []
    for i, (section, table) in enumerate(zip(file.measurements, tables, strict=True)):
        place = join(source, f"[[measurements]] {i + 1}")
        chunks += chunks_of(section, table, found.names, place, speed, values=values)
    epochs = _epochs(file, chunks, source)
    cuts = np.cumsum([len(chunk.z) for chunk in chunks])[:-1]
    index, target = np.split(epochs.index, cuts), np.split(epochs.target, cuts)
    check_repeats(chunks, index, target, found.names, epochs)
    stations = over_epochs(found, file.stations, epochs, [_used(c, i) for c, i in zip(chunks, index, strict=True)])
    chunks = [_completed(chunk, i, stations) for chunk, i in zip(chunks, index, strict=True)]
    rows, numbers = _rows(chunks, index, target)
    noise = _noise(file, chunks, numbers, index, target, source)
    problem = _problem(file, epochs, stations, rows, noise, frame, source, known or {}, more or {})
    problem, levels = with_noise(file, problem, source)
    title = file.title or source
    loaded = Loaded(problem, source, title, epochs.labels, epochs.times, epochs.targets, epochs.own, levels)
    return Draft(loaded, file, tuple(tables), tuple(chunks), tuple(numbers), found.moving or _led(problem))


def _problem(
    file: ProblemFile,
    epochs: Epochs,
    stations: Stations,
    rows: tuple[Rows, ...],
    noise: Noise,
    frame: Frame,
    source: str,
    known: Mapping[str | None, Table],
    more: Mapping[str, ConstraintTable],
) -> Problem:
    speed = file.propagation_speed or SPEED_OF_LIGHT
    motions = motions_of(file, epochs, known_of(file, known, epochs, frame, stations.dimension), source)
    why = needs_clock(motions, file.biases)
    times = epochs.clock if why is None else need_clock(epochs, why, source)
    biases = tuple(bias_of(b, rows, stations.names, stations.dimension, speed, source) for b in file.biases)
    priors = tuple(prior_of(p, stations.dimension, source) for p in file.priors)
    demands = {join(source, f"[[constraints]] {i + 1}"): table for i, table in enumerate(file.constraints)}
    constraints = constraints_of({**demands, **more}, stations, frame, motions, epochs.targets, speed)
    made = Problem(stations, rows, noise, times, motions, biases, priors, frame, constraints)
    return _checked(made, source)


def _led(problem: Problem) -> bool:
    return any(motion.known is not None and len(motion.known) > 1 for motion in problem.motions)


def _checked(problem: Problem, source: str) -> Problem:
    try:
        return checked(problem)
    except InvalidProblem as error:
        raise InvalidProblem(error.what, join(source, error.where), error.advice) from None


def _epochs(file: ProblemFile, chunks: Sequence[Chunk], source: str) -> Epochs:
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
    motion = {table.moves for table in (file.target, *file.targets.values())} - {None}
    free = None if not motion else motion == {"free"}
    keys = Keys(columns["label"], columns["time"], columns["written"], columns["target"])
    return epochs_of(keys, sum(len(chunk.z) for chunk in chunks), window, free, source)


def _used(chunk: Chunk, epoch: Array) -> Array:
    pairs = [np.stack([epoch, station], axis=-1)[(station >= 0) & (chunk.weight > 0)] for station in (chunk.a, chunk.b)]
    return np.concatenate(pairs)


def _completed(chunk: Chunk, epoch: Array, stations: Stations) -> Chunk:
    if not chunk.excess:
        return chunk
    place = stations.position[epoch if len(stations.position) > 1 else np.zeros_like(epoch)]
    rows = np.arange(len(epoch))
    return with_baseline(chunk, np.linalg.norm(place[rows, chunk.a] - place[rows, chunk.b], axis=-1))


def _rows(
    chunks: Sequence[Chunk], index: Sequence[Array], target: Sequence[Array]
) -> tuple[tuple[Rows, ...], list[Array]]:
    """Return the rows of each kind, and the global number of each row of each chunk."""
    kinds = dict.fromkeys(chunk.kind for chunk in chunks)
    rows, numbers, start = [], [np.zeros(0, dtype=np.int64)] * len(chunks), 0
    for kind in kinds:
        same = [i for i, chunk in enumerate(chunks) if chunk.kind == kind]
        columns = {
            name: np.concatenate([getattr(chunks[i], name) for i in same])
            for name in ("z", "a", "b", "weight", "correction")
        }
        joined = {
            "epoch": np.concatenate([index[i] for i in same]),
            "target": np.concatenate([target[i] for i in same]),
        }
        rows.append(Rows(kind, **columns, **joined))
        for i in same:
            numbers[i] = start + np.arange(len(chunks[i].z))
            start += len(chunks[i].z)
    return tuple(rows), numbers


def _noise(
    file: ProblemFile,
    chunks: Sequence[Chunk],
    numbers: Sequence[Array],
    index: Sequence[Array],
    target: Sequence[Array],
    source: str,
) -> Noise:
    if file.covariance is None:
        return noise_of(chunks, numbers, index, target)
    place = join(source, "key 'covariance'")
    if any(c.sigma is not None or c.arrival is not None or c.covariance is not None for c in chunks):
        raise InvalidProblem("the noise is given more than once", place, "leave out that of the single measurements")
    matrix = square(file.covariance, place)
    slope = np.concatenate([chunk.slope for chunk in chunks])
    return Noise((per_epoch(np.concatenate(list(numbers)), np.concatenate(list(index)), slope, matrix, place),))
