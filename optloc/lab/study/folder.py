"""Output folder of a study: a manifest and part files, each with a digest of its content in its name.

Each part file is written completely or not at all. A stopped study continues from the parts in its folder.
"""

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

from optloc.files import json_of, locked_folder, read_bytes, unwritable_folder, within, written
from optloc.lab.study.baselines import BASELINES
from optloc.lab.study.design import StudyDesign, machine, versions
from optloc.lab.study.methods import version_of
from optloc.lab.study.trial import COLUMNS, FAILED, GAP, TrialPart, arrow_schema
from optloc.problem import HasShortForm, InvalidProblem, Status

if TYPE_CHECKING:
    import pandas as pd


# Folders of another format are rejected, and so are other columns or another version of optloc.
MANIFEST = "manifest.json"
FORMAT = 2
_LOCK = ".lock"


# Statuses without a position whose reasons are shown, because solvers and methods cause them.
EXPLAINED = (*FAILED, Status.NUMERICAL.label, Status.UNAVAILABLE.label)


@dataclass(frozen=True, slots=True, repr=False)
class StudyManifest(HasShortForm):
    """Description of an output folder.

    Parameters
    ----------
    name, title, note : str
        From the study file.
    text : str
        Text of the study file.
    seed : int
        Seed of the study.
    fingerprint : str
        Digest of the design.
    version : str
        Version of optloc that computes the parts.
    columns : tuple of str
        Columns of the parts.
    chunks : dict of str to int
        Keys of the chunks of the design and their numbers of rows.
    created : str
        Time of the first run, UTC.
    machine, versions : str
        Machine of the first run, and versions of libraries.
    folder : str
        Folder of the problem files; empty if unknown.
    data : str
        Digest of the data of all methods; empty if unknown.
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
    """Return the manifest of a new design."""
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


def joined(existing: StudyManifest, wanted: StudyManifest) -> StudyManifest | None:
    """Return the manifest of a folder with the methods of another design added; None if the data differ.

    `existing` is the manifest of the folder, and `wanted` is the manifest of the other design. Existing parts are kept.
    But if the new design has a method of the same name, its parts replace the old parts.
    """
    if not existing.data or existing.data != wanted.data:
        return None
    names = set(wanted.methods.values())
    kept = {key: name for key, name in existing.methods.items() if name not in names}
    # The key of a chunk begins with the key of its cell.
    chunks = {key: count for key, count in existing.chunks.items() if key.partition("-")[0] in kept}
    return replace(existing, chunks=chunks | wanted.chunks, methods=kept | wanted.methods)


def read_manifest(folder: Path) -> StudyManifest:
    """Return the manifest of an output folder; raise InvalidProblem if there is no valid one."""
    from pydantic import TypeAdapter, ValidationError

    path = within(folder, MANIFEST, str(folder / MANIFEST))
    if not path.exists():
        what = "the folder contains no study" if folder.is_dir() else "there is no such folder"
        raise InvalidProblem(what, str(folder), "name the folder that 'optloc study run' wrote")
    try:
        # Read without the limits of a document: a study may have a million chunks.
        data = json_of(read_bytes(path).decode(), str(path))
    except (InvalidProblem, ValueError) as error:
        raise InvalidProblem(f"the manifest cannot be read ({error})", str(path), "run the study again") from None
    if not isinstance(data, dict) or data.pop("format", None) != FORMAT:
        raise InvalidProblem("the manifest has another format", str(path), "write to another folder")
    try:
        return TypeAdapter(StudyManifest).validate_python(data)
    except ValidationError:
        raise InvalidProblem("the manifest is incomplete", str(path), "write to another folder") from None


def references(design: StudyDesign | None) -> set[str]:
    """Return the names of the methods that start at the truth; they are not ranked."""
    # A baseline that was added to the folder keeps its name, but the design of the manifest does not contain it.
    known = {name for name, baseline in BASELINES.items() if baseline.reference}
    return known | ({cell.method.name for cell in design.cells if cell.method.reference} if design else set())


def begin(design: StudyDesign, folder: Path) -> StudyManifest:
    """Return the manifest of a folder for a design, and write it if it is new or has new methods.

    Call this function while the folder is `locked`. If the folder has the same data with other methods, the methods of
    the design are added, see `joined`.

    Raises
    ------
    InvalidProblem
        If the folder cannot be written, or belongs to another study or another version of optloc.
    """
    wanted = manifest_of(design)
    before, manifest = None, wanted
    if (folder / MANIFEST).exists():
        before = read_manifest(folder)
        same = before.fingerprint == wanted.fingerprint and wanted.chunks.keys() <= before.chunks.keys()
        # `joined` returns None if the data differ. Then the manifest is `wanted` itself, which is an error here.
        manifest = before if same else joined(before, wanted) or wanted
        if manifest is wanted:
            what = f"the folder contains another study ({before.name!r}, or other trials, seed or settings)"
            raise InvalidProblem(what, str(folder), "choose another folder with --out")
        if (manifest.version, manifest.columns) != (wanted.version, wanted.columns):
            what = f"the folder was written by optloc {manifest.version}, and this is {wanted.version}"
            raise InvalidProblem(what, str(folder), "choose another folder with --out")
    try:
        (folder / "parts").mkdir(parents=True, exist_ok=True)
        _clean(folder)
    except OSError as error:
        raise unwritable_folder(folder, error, _ADVICE) from None
    if manifest != before:
        data = {"format": FORMAT, **{name: getattr(manifest, name) for name in StudyManifest.__slots__}}
        content = json.dumps(data, indent=1).encode()
        if before is None:
            _write(folder / MANIFEST, content)
        else:
            _renew(folder / MANIFEST, content)
    return manifest


_ADVICE = "free space or choose another folder; finished parts are kept, and the same command continues"


def _write(path: Path, content: bytes) -> None:
    """Write a file completely or not at all; raise InvalidProblem if this fails."""
    try:
        with written(path) as scratch:
            scratch.write_bytes(content)
    except InvalidProblem as error:
        raise InvalidProblem(error.what, error.where, _ADVICE) from None


def _renew(path: Path, content: bytes) -> None:
    """Replace a file that optloc wrote to the folder, completely or not at all.

    The function `written` would need the option --force to replace a file.
    """
    scratch = path.with_name(f".optloc-{path.name}")
    _write(scratch, content)
    try:
        scratch.replace(path)
    except OSError as error:
        raise unwritable_folder(path, error, _ADVICE) from None


def _clean(folder: Path) -> None:
    """Remove incomplete files of a killed run."""
    for scratch in [*folder.glob(".optloc-*"), *(folder / "parts").glob(".*")]:
        scratch.unlink(missing_ok=True)


def store(folder: Path, part: TrialPart) -> None:
    """Write the part file of a finished chunk; raise InvalidProblem if this fails."""
    import pyarrow as pa
    from pyarrow import parquet

    sink = pa.BufferOutputStream()
    parquet.write_table(part.table, sink, compression="zstd")
    content = sink.getvalue().to_pybytes()
    _write(folder / "parts" / f"{part.key}.{_digest(content)}.parquet", content)


def _digest(content: bytes) -> str:
    """Return 16 hexadecimal digits of a file's content; in the file name, they reveal damage without a second file."""
    return hashlib.blake2b(content, digest_size=8).hexdigest()


def part_files(folder: Path) -> dict[str, Path]:
    """Return the existing part files of a study by the keys of their chunks, sorted by name."""
    known = read_manifest(folder).chunks
    found = {path.name.partition(".")[0]: path for path in sorted((folder / "parts").glob("[!.]*.parquet"))}
    # A folder of other people may contain links to other places.
    return {key: within(folder, f"parts/{path.name}", str(path)) for key, path in found.items() if key in known}


def read_part(path: Path, columns: Sequence[str] | None = None) -> Any:
    """Return the Arrow table of a part file with the given columns (all for None).

    Raise InvalidProblem if the content differs from the digest in the file name, or if a column is missing.
    """
    from pyarrow import ArrowException, parquet

    try:
        if path.name.split(".")[1:-1] == [_digest(read_bytes(path))] and _has_columns(
            parquet.read_schema(path), columns
        ):
            # Not from bytes of Python: the process aborts if threads of Arrow free such bytes while the interpreter
            # ends.
            return parquet.read_table(path, columns=columns, partitioning=None)
    except (InvalidProblem, OSError, ArrowException):
        pass
    raise InvalidProblem("the part is damaged", str(path), "run the study again to replace it")


def _is_complete(path: Path, rows: int) -> bool:
    """Return whether a part file is undamaged, and has all columns and `rows` rows."""
    from pyarrow import parquet

    try:
        return bool(read_part(path, ["status"]).num_rows == rows and _has_columns(parquet.read_schema(path), None))
    except InvalidProblem:
        return False


def _has_columns(schema: Any, columns: Sequence[str] | None) -> bool:
    """Return whether an Arrow schema has these columns of a part (all for None), with their types."""
    expected = arrow_schema()
    names = expected.names if columns is None else columns
    return all(
        schema.get_field_index(name) >= 0 and schema.field(name).type == expected.field(name).type for name in names
    )


def finished_parts(folder: Path, manifest: StudyManifest, say: Callable[[str], None]) -> dict[str, Path]:
    """Return the part files of finished chunks by key, and remove damaged ones.

    `say` is called with a sentence for each damaged part. Raise InvalidProblem if a damaged part cannot be removed.
    """
    done = part_files(folder)
    for key, path in list(done.items()):
        if not _is_complete(path, manifest.chunks[key]):
            del done[key]
            say(f"{path}: the part is damaged, and is computed again")
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                raise unwritable_folder(path, error, _ADVICE) from None
    return done


def note_data(known: dict[str, str], table: Any, folder: Path) -> None:
    """Add the digests of the blocks of trials in a table to the known ones.

    Parameters
    ----------
    known : dict of str to str
        Digests of blocks of data by their seeds; the function adds to it.
    table : pyarrow.Table
        Rows with the columns `seed` and `data`.
    folder : Path
        Output folder of the study, for messages.

    Raises
    ------
    InvalidProblem
        If a block has two different digests: methods would be compared on different measurements.
    """
    found = (
        table.select(["seed", "data"])
        .group_by(["seed", "data"], use_threads=False)
        .aggregate([([], "count_all")])
        .to_pylist()
    )
    for row in found:
        if known.setdefault(row["seed"], row["data"]) != row["data"]:
            what = f"parts of the study contain different data for the same trials (seed {row['seed']})"
            advice = "choose another folder with --out, and use one version of optloc and numpy for all parts"
            raise InvalidProblem(what, str(folder), advice)


def known_data(design: StudyDesign, folder: Path, done: dict[str, Path]) -> dict[str, str]:
    """Return the digests of the blocks of finished chunks by their seeds; `done` are their part files by chunk key.

    New parts must agree with these digests, so that all methods solve the same measurements.

    Raises
    ------
    InvalidProblem
        If parts contradict each other, or a new simulation of the first finished trial of a case gives other data.
    """
    known: dict[str, str] = {}
    first = {chunk.cell.case.key: chunk for chunk in reversed(list(design.chunks)) if chunk.key in done}
    for path in done.values():
        note_data(known, read_part(path, ["seed", "data"]), folder)
    for chunk in first.values():
        drawn = chunk.cell.case.draw(chunk.first, 1)
        if known.get(drawn.seed[0]) != drawn.digest[0]:
            what = f"its finished trials of {chunk.cell.case.where} differ from a new simulation"
            advice = "choose another folder with --out, or use the versions that the manifest names"
            raise InvalidProblem(what, str(folder), advice)
    return known


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Create a folder and lock it against other runs; the lock ends with the process.

    Raises
    ------
    InvalidProblem
        If another run has the lock, the folder cannot be written, or it contains other files than a study.
    """
    with locked_folder(folder, _LOCK, MANIFEST, "the folder is not empty, and contains no study", _ADVICE):
        yield


# Progress of a study.


@dataclass(frozen=True, slots=True, repr=False)
class Progress(HasShortForm):
    """Progress of a study.

    Parameters
    ----------
    manifest : StudyManifest
        Manifest of its folder.
    done, chunks : int
        Numbers of finished chunks and of all chunks.
    rows : int
        Number of finished rows.
    counts : dict of str to int
        Number of rows by status.
    methods : dict of (str, str) to int
        Number of rows by method and status.
    failures : dict of (str, str) to str
        Reason of the first trial without a fix, by method and status, for the statuses `EXPLAINED`.
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
        """Return whether all chunks are finished."""
        return self.done == self.chunks


def progress(folder: Path) -> Progress:
    """Return the progress of the study in a folder; raise InvalidProblem if the folder has no study."""
    import pyarrow.compute as pc

    manifest = read_manifest(folder)
    files = part_files(folder)
    methods: Counter[tuple[str, str]] = Counter()
    failures: dict[tuple[str, str], str] = {}
    for path in files.values():
        # Three columns of fifty, so that this does not slow down a run of millions of rows.
        table = read_part(path, ["method", "status", "reason"])
        for row in table.group_by(["method", "status"], use_threads=False).aggregate([([], "count_all")]).to_pylist():
            method, status = str(row["method"]), str(row["status"])
            methods[method, status] += int(row["count_all"])
            if status in EXPLAINED and (method, status) not in failures:
                selected = pc.and_(pc.equal(table["method"], method), pc.equal(table["status"], status))
                failures[method, status] = str(table["reason"].filter(selected)[0])
    counts: Counter[str] = Counter()
    for (_, status), count in methods.items():
        counts[status] += count
    return Progress(manifest, len(files), len(manifest.chunks), counts.total(), dict(counts), dict(methods), failures)


# Tables of all parts of a study; `optloc.lab.study.trial` describes the columns.

SORTED = ("scenario", "sweep", "noise", "method", "key", "trial")


def read_arrow(folder: Path, columns: Sequence[str] | None = None) -> Any:
    """Return the Arrow table of all parts of a study, sorted, so that it does not depend on the order of parts.

    Parameters
    ----------
    folder : Path
        Output folder of a study.
    columns : sequence of str, optional
        Columns to read; all by default. The column `gap` is added if cost, data and trial are among them.

    Raises
    ------
    InvalidProblem
        If the folder has no study, or a part is damaged.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    schema = arrow_schema()
    wanted = [c.name for c in COLUMNS] if columns is None else [c.name for c in COLUMNS if c.name in set(columns)]
    # Read the columns of the sort key even if they are not wanted.
    read = list(dict.fromkeys([*wanted, *SORTED]))
    parts = [read_part(path, read) for path in part_files(folder).values()]
    empty = pa.schema([schema.field(name) for name in read]).empty_table()
    table = pa.concat_tables([empty, *(part.cast(empty.schema) for part in parts)]).unify_dictionaries()
    # Sort by text, because its numbers in the dictionary depend on the order of parts.
    plain = {name: pc.cast(table[name], pa.string()) if _is_text(table, name) else table[name] for name in SORTED}
    table = table.take(pc.sort_indices(pa.table(plain), [(name, "ascending") for name in SORTED]))
    table = table.select(wanted).combine_chunks()
    return with_gap(table) if {"data", "trial", "cost"} <= set(wanted) else table


def _is_text(table: Any, name: str) -> bool:
    """Return whether a column of an Arrow table contains text."""
    import pyarrow as pa

    return bool(pa.types.is_dictionary(table.schema.field(name).type))


def with_gap(table: Any) -> Any:
    """Return a table with the column `gap`: the cost less the lowest cost of the same trial over all methods.

    The gap is NaN for rows without a cost.
    """
    import pyarrow as pa

    # A trial has the same digest `data` and number `trial` in the rows of all methods.
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
    """Return a frame with one more column for each swept parameter, from the column `sweep`.

    A value is None where a row lacks the parameter. The columns have the names of the study file.
    """
    values_by_text: dict[str, dict[str, Any]] = {text: json.loads(text) for text in frame["sweep"].unique()}
    parameters = dict.fromkeys(name for values in values_by_text.values() for name in values)
    return frame.assign(
        **{name: frame["sweep"].astype(object).map(lambda t, n=name: values_by_text[t].get(n)) for name in parameters}
    )
