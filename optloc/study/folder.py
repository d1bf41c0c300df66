"""The output folder of a study: a manifest and part files that appear whole or not at all."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.study.draws import draw
from optloc.study.methods import version_of
from optloc.study.plan import Plan
from optloc.study.trial import COLUMNS, GAP, Part, arrow_schema, machine, versions

if TYPE_CHECKING:
    import pandas as pd


# Another format is refused; other columns or another version of optloc are too, whatever the format.
MANIFEST = "manifest.json"
FORMAT = 1


@dataclass(frozen=True, slots=True)
class Manifest:
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
        Of the plan.
    version : str
        Version of optloc that computes it.
    columns : tuple of str
        Columns of its parts.
    chunks : dict of str to int
        Keys of the chunks of the plan and their rows.
    created : str
        When it was begun, UTC.
    machine, versions : str
        Where it was begun and with what.
    folder : str
        Where its problem files are; empty where that is not known.
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

    @property
    def rows(self) -> int:
        """Return the number of rows of the finished table."""
        return sum(self.chunks.values())


def manifest_of(plan: Plan) -> Manifest:
    """Return the manifest of a plan that is about to begin."""
    study = plan.study
    return Manifest(
        study.name,
        study.title or "",
        study.note or "",
        plan.text,
        study.seed,
        plan.fingerprint,
        version_of("optloc"),
        tuple(column.name for column in COLUMNS),
        {chunk.key: chunk.count for chunk in plan.chunks},
        f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}",
        machine(),
        versions(),
        plan.folder,
    )


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of an output folder; raise InvalidProblem where it is none."""
    path = folder / MANIFEST
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        what = "the folder holds no study" if folder.is_dir() else "there is no such folder"
        raise InvalidProblem(what, str(folder), "name the folder that 'optloc study run' wrote") from None
    except (OSError, ValueError) as error:
        raise InvalidProblem(f"the manifest cannot be read ({error})", str(path), "run the study again") from None
    if not isinstance(data, dict) or data.pop("format", None) != FORMAT:
        raise InvalidProblem("the manifest is of another format", str(path), "write to another folder")
    try:
        return Manifest(**{**data, "columns": tuple(data["columns"])})
    except (KeyError, TypeError):
        raise InvalidProblem("the manifest is incomplete", str(path), "write to another folder") from None


def begin(plan: Plan, folder: Path) -> Manifest:
    """Return the manifest of a folder for a plan, written where there is none.

    Raises
    ------
    InvalidProblem
        Where the folder cannot be written, or belongs to another study or another version of optloc.
    """
    wanted = manifest_of(plan)
    if (folder / MANIFEST).exists():
        found = read_manifest(folder)
        if found.fingerprint != wanted.fingerprint:
            what = f"the folder holds another study ({found.name!r}, or other trials, seed or settings)"
            raise InvalidProblem(what, str(folder), "choose another folder with --out")
        if (found.version, found.columns) != (wanted.version, wanted.columns):
            what = f"the folder was written by optloc {found.version}, and this is {wanted.version}"
            raise InvalidProblem(what, str(folder), "choose another folder with --out")
        _clean(folder)
        return found
    if folder.is_dir() and any(folder.iterdir()):
        raise InvalidProblem("the folder is not empty, and holds no study", str(folder), "choose another with --out")
    try:
        (folder / "parts").mkdir(parents=True, exist_ok=True)
        data = {"format": FORMAT, **{name: getattr(wanted, name) for name in Manifest.__slots__}}
        _replaced(folder / MANIFEST, lambda path: path.write_text(json.dumps(data, indent=1), encoding="utf-8"))
    except OSError as error:
        raise unwritable(folder, error) from None
    return wanted


def unwritable(path: Path, error: OSError) -> InvalidProblem:
    """Return the sentence for a place that cannot be written."""
    advice = "make room or choose another place; what is finished is kept, and the same command goes on from there"
    return InvalidProblem(f"the place cannot be written ({error.strerror or error})", str(path), advice)


def _replaced(path: Path, write: Any) -> None:
    """Write a file under another name and move it to its place, whole or not at all."""
    # The dot hides it from what lists parts, the process number keeps two writers apart.
    scratch = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        write(scratch)
        # On one file system this is one step: a reader sees the old file, the new one or none.
        os.replace(scratch, path)  # noqa: PTH105  (the same, and easier to replace in tests)
    except BaseException:
        scratch.unlink(missing_ok=True)
        raise


def _clean(folder: Path) -> None:
    """Remove what a run that was killed left half written."""
    for scratch in (folder / "parts").glob(".*"):
        scratch.unlink(missing_ok=True)


def store(folder: Path, part: Part) -> None:
    """Write a part; raise InvalidProblem where that fails."""
    from pyarrow import parquet

    path = folder / "parts" / f"{part.key}.parquet"
    try:
        _replaced(path, lambda scratch: parquet.write_table(part.table, scratch, compression="zstd"))
    except OSError as error:
        raise unwritable(path, error) from None


def part_files(folder: Path) -> list[Path]:
    """Return the part files of a study that are there, in the order of their names."""
    known = read_manifest(folder).chunks
    return [path for path in sorted((folder / "parts").glob("*.parquet")) if path.stem in known]


def finished_chunks(folder: Path, manifest: Manifest) -> set[str]:
    """Return the keys of the chunks whose parts are whole; one that was damaged is removed."""
    from pyarrow import ArrowException, parquet

    done = set()
    for path in (folder / "parts").glob("*.parquet"):
        if path.stem not in manifest.chunks:
            continue
        try:
            # The end of a Parquet file holds its size: a file cut short has none, and no row need be read.
            rows = parquet.read_metadata(path).num_rows
        except (ArrowException, OSError):
            rows = -1
        if rows == manifest.chunks[path.stem]:
            done.add(path.stem)
        else:
            path.unlink(missing_ok=True)
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
    found = table.select(["seed", "data"]).group_by(["seed", "data"]).aggregate([([], "count_all")]).to_pylist()
    for row in found:
        if known.setdefault(row["seed"], row["data"]) != row["data"]:
            what = f"parts of the study hold different data for the same trials (those of the seed {row['seed']})"
            advice = "choose another folder with --out, and compute all of it with one version of optloc and numpy"
            raise InvalidProblem(what, str(folder), advice)


def known_data(plan: Plan, folder: Path, done: set[str]) -> dict[str, str]:
    """Return the digests of the blocks of finished chunks by their seeds.

    Raises
    ------
    InvalidProblem
        Where they contradict each other, or what is drawn here for the first finished trial of a case.
    """
    from pyarrow import parquet

    known: dict[str, str] = {}
    first = {chunk.cell.case.key: chunk for chunk in reversed(list(plan.chunks)) if chunk.key in done}
    for key in sorted(done):
        note_data(known, parquet.read_table(folder / "parts" / f"{key}.parquet", columns=["seed", "data"]), folder)
    for chunk in first.values():
        drawn = draw(chunk.cell.case, chunk.first, 1)
        if known.get(drawn.seed[0]) != drawn.digest[0]:
            what = f"its finished trials of {chunk.cell.case.where} hold other data than are drawn here"
            advice = "choose another folder with --out, or go on with the versions that the manifest names"
            raise InvalidProblem(what, str(folder), advice)
    return known


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder, so that two runs do not write to it; the lock goes with the process, however it ends."""
    try:
        import fcntl
    except ImportError:  # there is none on this system
        yield
        return
    # The manifest is there before any part and is never written again: what could be locked better?
    with (folder / MANIFEST).open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InvalidProblem("another run writes to this folder", str(folder), "wait until it ends") from None
        except OSError:  # a file system without locks
            pass
        yield


# How far a study is.


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a study is.

    Parameters
    ----------
    manifest : Manifest
        Of its folder.
    done, chunks : int
        Finished chunks, and those of the plan.
    rows : int
        Finished rows.
    counts : dict of str to int
        How many of them have which status.
    methods : dict of (str, str) to int
        How many rows of which method have which status.
    """

    manifest: Manifest
    done: int
    chunks: int
    rows: int
    counts: dict[str, int]
    methods: dict[tuple[str, str], int]

    @property
    def complete(self) -> bool:
        """Return whether nothing is left to do."""
        return self.done == self.chunks


def progress(folder: Path) -> Progress:
    """Return how far the study of a folder is; raise InvalidProblem where it holds none."""
    from pyarrow import parquet

    manifest = read_manifest(folder)
    files = part_files(folder)
    methods: Counter[tuple[str, str]] = Counter()
    for path in files:
        # Two columns of fifty, so that looking does not slow down a run of millions of rows.
        table = parquet.read_table(path, columns=["method", "status"])
        found = table.group_by(["method", "status"]).aggregate([([], "count_all")]).to_pylist()
        methods.update({(str(row["method"]), str(row["status"])): int(row["count_all"]) for row in found})
    counts: Counter[str] = Counter()
    for (_, status), count in methods.items():
        counts[status] += count
    return Progress(manifest, len(files), len(manifest.chunks), counts.total(), dict(counts), dict(methods))


# Read the parts of a study as one table; the columns are described in `optloc.study.trial`.

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
        Where the folder holds no study.
    """
    import pyarrow as pa
    import pyarrow.compute as pc
    from pyarrow import parquet

    schema = arrow_schema()
    wanted = [c.name for c in COLUMNS] if columns is None else [c.name for c in COLUMNS if c.name in set(columns)]
    # What sorts must be read, though it may not be wanted.
    read = list(dict.fromkeys([*wanted, *SORTED]))
    parts = [parquet.read_table(path, columns=read) for path in part_files(folder)]
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
