"""The output folder of a study: a manifest and part files that appear whole or not at all, named by what they hold."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.files import json_of, read_bytes, written
from optloc.lab.study.baselines import BASELINES
from optloc.lab.study.design import StudyDesign, design_of_text
from optloc.lab.study.methods import version_of
from optloc.lab.study.trial import COLUMNS, FAILED, GAP, TrialPart, arrow_schema, machine, versions
from optloc.problem import InvalidProblem, Status

if TYPE_CHECKING:
    import pandas as pd


# Another format is refused; other columns or another version of optloc are too, whatever the format.
MANIFEST = "manifest.json"
FORMAT = 2
_LOCK = ".lock"


# Statuses of trials without a position whose reasons are shown: back ends and methods are their cause.
EXPLAINED = (*FAILED, Status.NUMERICAL.label, Status.UNAVAILABLE.label)


@dataclass(frozen=True, slots=True)
class StudyManifest:
    """What an output folder holds.

    Parameters
    ----------
    name, title, note : str
        Of the study.
    text : str
        Its file.
    seed : int
        Of the study.
    fingerprint : str
        Of the design.
    version : str
        Version of optloc that computes it.
    columns : tuple of str
        Columns of its parts.
    chunks : dict of str to int
        Keys of the chunks of the design and their rows.
    created : str
        When it was begun, UTC.
    machine, versions : str
        Where it was begun and with what.
    folder : str
        Where its problem files are; empty where that is not known.
    data : str
        Of the data that all its methods see; empty where that is not known.
    methods : dict of str to str
        Names of the methods by the keys of their cells.
    """

    name: str
    title: str
    note: str
    text: str
    seed: int
    fingerprint: str
    version: str
    columns: tuple[str, ...]
    chunks: dict[str, int]
    created: str
    machine: str
    versions: str
    folder: str = ""
    data: str = ""
    methods: dict[str, str] = field(default_factory=dict)

    @property
    def rows(self) -> int:
        """Return the number of rows of the finished table."""
        return sum(self.chunks.values())


def manifest_of(design: StudyDesign) -> StudyManifest:
    """Return the manifest of a design that is about to begin."""
    study = design.study
    return StudyManifest(
        study.name,
        study.title or "",
        study.note or "",
        design.text,
        study.seed,
        design.fingerprint,
        version_of("optloc"),
        tuple(column.name for column in COLUMNS),
        {chunk.key: chunk.count for chunk in design.chunks},
        f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}",
        machine(),
        versions(),
        design.folder,
        design.data,
        {cell.key: cell.method.name for cell in design.cells},
    )


def joined(found: StudyManifest, wanted: StudyManifest) -> StudyManifest | None:
    """Return the manifest of a folder that gets the methods of a design, too; None where the data are others.

    What was computed stays, but for methods that the design has by the same name: those are as the design says now.
    """
    if not found.data or found.data != wanted.data:
        return None
    names = set(wanted.methods.values())
    kept = {key: name for key, name in found.methods.items() if name not in names}
    chunks = {key: count for key, count in found.chunks.items() if key.partition("-")[0] in kept}
    return replace(found, chunks=chunks | wanted.chunks, methods=kept | wanted.methods)


def read_manifest(folder: Path) -> StudyManifest:
    """Return the manifest of an output folder; raise InvalidProblem where it is none."""
    from pydantic import TypeAdapter, ValidationError

    path = folder / MANIFEST
    if not path.exists():
        what = "the folder holds no study" if folder.is_dir() else "there is no such folder"
        raise InvalidProblem(what, str(folder), "name the folder that 'optloc study run' wrote")
    try:
        # Not as a document, whose budget is smaller: a study may have a million chunks.
        data = json_of(read_bytes(path).decode(), str(path))
    except (InvalidProblem, ValueError) as error:
        raise InvalidProblem(f"the manifest cannot be read ({error})", str(path), "run the study again") from None
    if not isinstance(data, dict) or data.pop("format", None) != FORMAT:
        raise InvalidProblem("the manifest is of another format", str(path), "write to another folder")
    try:
        return TypeAdapter(StudyManifest).validate_python(data)
    except ValidationError:
        raise InvalidProblem("the manifest is incomplete", str(path), "write to another folder") from None


def design_of_manifest(manifest: StudyManifest) -> StudyDesign | None:
    """Return the design of a study from its manifest, None where a problem file cannot be read any more."""
    try:
        return design_of_text(manifest.text, manifest.name, Path(manifest.folder or "."), seed=manifest.seed)
    except InvalidProblem:
        return None


def references(design: StudyDesign | None) -> set[str]:
    """Return the names of the methods that begin at the truth, with which nobody competes."""
    # A method that was added to the folder has the name of its baseline, and is in no design.
    known = {name for name, baseline in BASELINES.items() if baseline.reference}
    return known | ({cell.method.name for cell in design.cells if cell.method.reference} if design else set())


def begin(design: StudyDesign, folder: Path) -> StudyManifest:
    """Return the manifest of a folder for a design, written where it is new; call it while the folder is `locked`.

    A folder of the same data by other methods gets those of the design, too: see `joined`.

    Raises
    ------
    InvalidProblem
        Where the folder cannot be written, or belongs to another study or another version of optloc.
    """
    wanted = manifest_of(design)
    before, found = None, wanted
    if (folder / MANIFEST).exists():
        before = read_manifest(folder)
        same = before.fingerprint == wanted.fingerprint and wanted.chunks.keys() <= before.chunks.keys()
        found = before if same else joined(before, wanted) or wanted
        if found is wanted:
            what = f"the folder holds another study ({before.name!r}, or other trials, seed or settings)"
            raise InvalidProblem(what, str(folder), "choose another folder with --out")
        if (found.version, found.columns) != (wanted.version, wanted.columns):
            what = f"the folder was written by optloc {found.version}, and this is {wanted.version}"
            raise InvalidProblem(what, str(folder), "choose another folder with --out")
    try:
        (folder / "parts").mkdir(parents=True, exist_ok=True)
        _clean(folder)
    except OSError as error:
        raise _unwritable(folder, error) from None
    if found != before:
        data = {"format": FORMAT, **{name: getattr(found, name) for name in StudyManifest.__slots__}}
        content = json.dumps(data, indent=1).encode()
        if before is None:
            _write(folder / MANIFEST, content)
        else:
            _renew(folder / MANIFEST, content)
    return found


_KEPT = "make room or choose another place; what is finished is kept, and the same command goes on from there"


def _unwritable(path: Path, error: OSError) -> InvalidProblem:
    return InvalidProblem(f"the place cannot be written ({error.strerror or error})", str(path), _KEPT)


def _write(path: Path, content: bytes) -> None:
    """Write a file, whole or not at all; raise InvalidProblem where that fails."""
    try:
        with written(path) as place:
            place.write_bytes(content)
    except InvalidProblem as error:
        raise InvalidProblem(error.what, error.where, _KEPT) from None


def _renew(path: Path, content: bytes) -> None:
    """Replace a file of the folder's own: it was read here, and nobody needs to force that."""
    scratch = path.with_name(f".optloc-{path.name}")
    _write(scratch, content)
    try:
        scratch.replace(path)
    except OSError as error:
        raise _unwritable(path, error) from None


def _clean(folder: Path) -> None:
    """Remove what a run that was killed left half written."""
    for scratch in [*folder.glob(".optloc-*"), *(folder / "parts").glob(".*")]:
        scratch.unlink(missing_ok=True)


def store(folder: Path, part: TrialPart) -> None:
    """Write a part; raise InvalidProblem where that fails."""
    import pyarrow as pa
    from pyarrow import parquet

    sink = pa.BufferOutputStream()
    parquet.write_table(part.table, sink, compression="zstd")
    content = sink.getvalue().to_pybytes()
    _write(folder / "parts" / f"{part.key}.{_digest(content)}.parquet", content)


def _digest(content: bytes) -> str:
    """Return 16 hexadecimal digits of a file's content: a name tells damage, and needs no second file to do so."""
    return hashlib.blake2b(content, digest_size=8).hexdigest()


def part_files(folder: Path) -> dict[str, Path]:
    """Return the part files of a study that are there by their chunks, in the order of their names."""
    known = read_manifest(folder).chunks
    found = {path.name.partition(".")[0]: path for path in sorted((folder / "parts").glob("[!.]*.parquet"))}
    return {key: path for key, path in found.items() if key in known}


def read_part(path: Path, columns: Sequence[str] | None = None) -> Any:
    """Return the Arrow table of a part file; raise InvalidProblem where it is not what was written."""
    from pyarrow import ArrowException, parquet

    try:
        if path.name.split(".")[1:-1] == [_digest(read_bytes(path))] and _is_part(parquet.read_schema(path), columns):
            # Not from bytes of Python: threads of Arrow that free such while the interpreter ends abort the process.
            return parquet.read_table(path, columns=columns, partitioning=None)
    except (InvalidProblem, OSError, ArrowException):
        pass
    raise InvalidProblem("the part is damaged", str(path), "run the study again, and it is made again")


def _is_whole(path: Path, rows: int) -> bool:
    """Return whether a part file has all its columns and so many rows."""
    from pyarrow import parquet

    try:
        return bool(read_part(path, ["status"]).num_rows == rows and _is_part(parquet.read_schema(path), None))
    except InvalidProblem:
        return False


def _is_part(found: Any, columns: Sequence[str] | None) -> bool:
    """Return whether a file has the columns of a part, or some of them, with their types."""
    wanted = arrow_schema()
    names = wanted.names if columns is None else columns
    return all(found.get_field_index(name) >= 0 and found.field(name).type == wanted.field(name).type for name in names)


def finished_parts(folder: Path, manifest: StudyManifest, say: Callable[[str], None]) -> dict[str, Path]:
    """Return the part files of finished chunks.

    Parameters
    ----------
    folder : Path
        Of the study.
    manifest : StudyManifest
        Of the folder.
    say : callable
        Hears a sentence about every part that was damaged; it is removed.

    Raises
    ------
    InvalidProblem
        Where a damaged part cannot be removed.
    """
    done = part_files(folder)
    for key, path in list(done.items()):
        if not _is_whole(path, manifest.chunks[key]):
            del done[key]
            say(f"{path}: the part is damaged, and is made again")
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                raise _unwritable(path, error) from None
    return done


def note_data(known: dict[str, str], table: Any, folder: Path) -> None:
    """Add the data of the blocks of trials in a table to those that are known.

    Parameters
    ----------
    known : dict of str to str
        Digests of blocks of data by their seeds.
    table : pyarrow.Table
        Rows with the columns `seed` and `data`.
    folder : Path
        Of the study.

    Raises
    ------
    InvalidProblem
        Where a block has other data than are known of it: methods would be compared on different measurements.
    """
    found = (
        table.select(["seed", "data"])
        .group_by(["seed", "data"], use_threads=False)
        .aggregate([([], "count_all")])
        .to_pylist()
    )
    for row in found:
        if known.setdefault(row["seed"], row["data"]) != row["data"]:
            what = f"parts of the study hold different data for the same trials (those of the seed {row['seed']})"
            advice = "choose another folder with --out, and compute all of it with one version of optloc and numpy"
            raise InvalidProblem(what, str(folder), advice)


def known_data(design: StudyDesign, folder: Path, done: dict[str, Path]) -> dict[str, str]:
    """Return the digests of the blocks of finished chunks, whose part files are given, by their seeds.

    Raises
    ------
    InvalidProblem
        Where they contradict each other, or what is drawn here for the first finished trial of a case.
    """
    known: dict[str, str] = {}
    first = {chunk.cell.case.key: chunk for chunk in reversed(list(design.chunks)) if chunk.key in done}
    for path in done.values():
        note_data(known, read_part(path, ["seed", "data"]), folder)
    for chunk in first.values():
        drawn = chunk.cell.case.draw(chunk.first, 1)
        if known.get(drawn.seed[0]) != drawn.digest[0]:
            what = f"its finished trials of {chunk.cell.case.where} hold other data than are drawn here"
            advice = "choose another folder with --out, or go on with the versions that the manifest names"
            raise InvalidProblem(what, str(folder), advice)
    return known


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Make and hold a folder, so that two runs do not write to it; the lock goes with the process, however it ends.

    Raises
    ------
    InvalidProblem
        Where another run holds it, it cannot be written, or it holds something else than a study.
    """
    try:
        # A folder of somebody else is left as it is.
        if folder.is_dir() and not {MANIFEST, _LOCK} & (names := {path.name for path in folder.iterdir()}) and names:
            advice = "choose another with --out"
            raise InvalidProblem("the folder is not empty, and holds no study", str(folder), advice)
        folder.mkdir(parents=True, exist_ok=True)
        # Opened for writing: file systems of a network lock nothing else.
        file = (folder / _LOCK).open("ab")
    except OSError as error:
        raise _unwritable(folder, error) from None
    with file:
        try:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InvalidProblem("another run writes to this folder", str(folder), "wait until it ends") from None
        except (ImportError, OSError):  # a system or a file system without locks
            pass
        yield


# How far a study is.


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a study is.

    Parameters
    ----------
    manifest : StudyManifest
        Of its folder.
    done, chunks : int
        Finished chunks, and those of the design.
    rows : int
        Finished rows.
    counts : dict of str to int
        How many of them have which status.
    methods : dict of (str, str) to int
        How many rows of which method have which status.
    failures : dict of (str, str) to str
        Why a trial of a method has no fix, by statuses whose reason says it: of the study, of a back end that failed,
        of a method that does not start such rows.
    """

    manifest: StudyManifest
    done: int
    chunks: int
    rows: int
    counts: dict[str, int]
    methods: dict[tuple[str, str], int]
    failures: dict[tuple[str, str], str]

    @property
    def complete(self) -> bool:
        """Return whether nothing is left to do."""
        return self.done == self.chunks


def progress(folder: Path) -> Progress:
    """Return how far the study of a folder is; raise InvalidProblem where it holds none."""
    import pyarrow.compute as pc

    manifest = read_manifest(folder)
    files = part_files(folder)
    methods: Counter[tuple[str, str]] = Counter()
    failures: dict[tuple[str, str], str] = {}
    for path in files.values():
        # Three columns of fifty, so that looking does not slow down a run of millions of rows.
        table = read_part(path, ["method", "status", "reason"])
        for row in table.group_by(["method", "status"], use_threads=False).aggregate([([], "count_all")]).to_pylist():
            method, status = str(row["method"]), str(row["status"])
            methods[method, status] += int(row["count_all"])
            if status in EXPLAINED and (method, status) not in failures:
                own = pc.and_(pc.equal(table["method"], method), pc.equal(table["status"], status))
                failures[method, status] = str(table["reason"].filter(own)[0])
    counts: Counter[str] = Counter()
    for (_, status), count in methods.items():
        counts[status] += count
    return Progress(manifest, len(files), len(manifest.chunks), counts.total(), dict(counts), dict(methods), failures)


# Read the parts of a study as one table; the columns are described in `optloc.lab.study.trial`.

SORTED = ("scenario", "sweep", "noise", "method", "key", "trial")


def read_arrow(folder: Path, columns: Sequence[str] | None = None) -> Any:
    """Return the Arrow table of all parts of a study, sorted, so that it does not depend on their order.

    Parameters
    ----------
    folder : Path
        Output folder of a study.
    columns : sequence of str, optional
        Columns to read; all by default. The column `gap` is added where cost, data and trial are among them.

    Raises
    ------
    InvalidProblem
        Where the folder holds no study, or a part is damaged.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    schema = arrow_schema()
    wanted = [c.name for c in COLUMNS] if columns is None else [c.name for c in COLUMNS if c.name in set(columns)]
    # What sorts must be read, though it may not be wanted.
    read = list(dict.fromkeys([*wanted, *SORTED]))
    parts = [read_part(path, read) for path in part_files(folder).values()]
    empty = pa.schema([schema.field(name) for name in read]).empty_table()
    table = pa.concat_tables([empty, *(part.cast(empty.schema) for part in parts)]).unify_dictionaries()
    # Texts sort by themselves, not by their numbers in the dictionary, which depend on the order of parts.
    plain = {name: pc.cast(table[name], pa.string()) if _text(table, name) else table[name] for name in SORTED}
    table = table.take(pc.sort_indices(pa.table(plain), [(name, "ascending") for name in SORTED]))
    table = table.select(wanted).combine_chunks()
    return with_gap(table) if {"data", "trial", "cost"} <= set(wanted) else table


def _text(table: Any, name: str) -> bool:
    import pyarrow as pa

    return bool(pa.types.is_dictionary(table.schema.field(name).type))


def with_gap(table: Any) -> Any:
    """Return a table with the column `gap`: the cost less the lowest cost of the same data over all methods."""
    import pyarrow as pa

    cells = table["data"].combine_chunks()
    data = np.asarray(cells.indices) if len(table) else np.zeros(0, dtype=np.int64)
    trial, cost = np.asarray(table["trial"]), np.asarray(table["cost"], dtype=float)
    _, inverse = np.unique(np.stack([data.astype(np.int64), trial], axis=1), axis=0, return_inverse=True)
    best = np.full(inverse.max(initial=-1) + 1, np.inf)
    np.minimum.at(best, inverse, np.where(np.isfinite(cost), cost, np.inf))
    with np.errstate(invalid="ignore"):
        gap = cost - best[inverse]
    field = pa.field(GAP.name, pa.float64(), metadata={"unit": GAP.unit, "meaning": GAP.meaning})
    return table.append_column(field, pa.array(gap))


def read_frame(folder: Path, columns: Sequence[str] | None = None) -> pd.DataFrame:
    """Return all rows of a study as a pandas frame (categories for text); arguments and errors as `read_arrow`."""
    frame: pd.DataFrame = read_arrow(folder, columns).to_pandas()
    return frame


def swept(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a frame with one column for each swept parameter, named as in the study file, from the column `sweep`."""
    found: dict[str, dict[str, Any]] = {text: json.loads(text) for text in frame["sweep"].unique()}
    names = dict.fromkeys(name for values in found.values() for name in values)
    return frame.assign(
        **{name: frame["sweep"].astype(object).map(lambda t, n=name: found[t].get(n)) for name in names}
    )
