"""Fixes of a Parquet data set, partition by partition, with an account of their statuses."""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.inputs import Budget, access
from optloc.base.locked_folder import unwritable_folder
from optloc.base.registry import load_plugin, plugins
from optloc.base.types import Array
from optloc.files.csv_formats import read_table
from optloc.files.table import Table
from optloc.partitions.event_index import EventIndex, event_hashes
from optloc.partitions.executors import TaskExecutor
from optloc.partitions.fix_options import FixOptions, check_shared, identity_of
from optloc.partitions.fixed_columns import arrow_of
from optloc.partitions.journal import (
    KEPT,
    FinishedPartition,
    Journal,
    digest_of,
    folder_keys,
    locked_output,
    partition_names,
)
from optloc.partitions.one_partition import fix_rows_labelled


@dataclass(frozen=True, slots=True)
class PartitionTask:
    """The work on one partition, for any process that has the same files.

    `folder` is the data set, `out` the folder of the fixes, and `name` the partition. `plugins` are the plugins of the
    main process.
    """

    folder: Path
    out: Path
    name: str
    options: FixOptions
    budget: Budget
    plugins: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PartitionResult:
    """The finished partition, and the hashes of its events (n,)."""

    finished: FinishedPartition
    events: Array


@dataclass(frozen=True, slots=True)
class Refused:
    """A partition that cannot be read or written, with the sentence of the error."""

    sentence: str


@dataclass(frozen=True, slots=True)
class FixAccount:
    """The account of a data set: every partition is finished or has failed.

    Parameters
    ----------
    finished : tuple of FinishedPartition
        Finished partitions, sorted by name.
    failed : mapping of str to str
        Sentence on each partition without fixes.
    kept : int
        Number of partitions that an earlier run had finished.
    """

    finished: tuple[FinishedPartition, ...]
    failed: Mapping[str, str]
    kept: int

    @property
    def counts(self) -> dict[str, int]:
        """Return the number of fixes of all partitions by status, the most frequent first."""
        total: Counter[str] = Counter()
        for one in self.finished:
            total.update(one.counts)
        return dict(total.most_common())


def fix_data_set(
    folder: Path,
    out: Path,
    options: FixOptions,
    by: TaskExecutor,
    advance: Callable[[int, int], object] = lambda done, total: None,
) -> FixAccount:
    """Fix all partitions of a data set that are not finished yet, and return the account.

    Parameters
    ----------
    folder : Path
        Folder of Parquet files, also of Hive partitions. All readings of an event are in one file.
    out : Path
        Folder of the fixes: new, or from an earlier run with the same options.
    options : FixOptions
        Options of all partitions.
    by : TaskExecutor
        Executor of the partitions.
    advance : callable, optional
        Called with the numbers of finished and of all partitions.

    Raises
    ------
    InvalidProblem
        If an event is in two partitions, the folders cannot be used, or the scheduler has ended. Finished partitions
        are kept.
    """
    check_shared(options.hints)
    names = partition_names(folder)
    with locked_output(out, folder), access() as allowed:
        journal = Journal(out, identity_of(options))
        done = [name for name in names if journal.is_done(name, folder)]
        index, failed = EventIndex(), dict[str, str]()
        for name in done:
            _check_events(index, journal.finished[name], _stored_events(out, journal.finished[name]), out)
        task = PartitionTask(folder.resolve(), out.resolve(), "", options, allowed.budget, plugins())
        tasks = [replace(task, name=name) for name in names if name not in set(done)]
        advance(len(done), len(names))
        with closing(by.run(fix_partition, tasks)) as results:
            for count, (one, result) in enumerate(results):
                if isinstance(result, PartitionResult):
                    _check_events(index, result.finished, result.events, out)
                    journal.add(result.finished)
                else:
                    reason = result.sentence if isinstance(result, Refused) else f"{one.name}: {result.reason}"
                    failed[one.name] = reason
                advance(len(done) + count + 1, len(names))
    finished = tuple(journal.finished[name] for name in names if name not in failed)
    return FixAccount(finished, dict(sorted(failed.items())), len(done))


def fix_partition(task: PartitionTask) -> PartitionResult | Refused:
    """Write the fixes of one partition, and return its record; a partition that is refused leaves no file."""
    try:
        with access(budget=task.budget, anew=True):
            for name in task.plugins:
                load_plugin(name)
            path = task.folder / task.name
            table = _with_folder_keys(read_table(path), task)
            frame, labelled = fix_rows_labelled(table, Path(task.name), task.options)
            digest = _write(task.out / task.name, frame)
            counts = {str(status): int(n) for status, n in frame["status"].value_counts(sort=False).items()}
            events = event_hashes(frame["epoch"], frame["target"]) if labelled else np.zeros(0, dtype=np.uint64)
            return PartitionResult(FinishedPartition(task.name, digest_of(path), digest, labelled, counts), events)
    except InvalidProblem as error:
        place = error.where or ""
        where = place if task.name in place else ", ".join(part for part in (task.name, place) if part)
        return Refused(str(InvalidProblem(error.what, where, error.advice)))


def _with_folder_keys(table: Table, task: PartitionTask) -> Table:
    """Return a table with the keys of its folders as columns, if an option names them."""
    wanted = {part for name in task.options.hints.columns.values() for part in name.split("+")}
    keys = {key: value for key, value in folder_keys(task.name).items() if key in wanted and key not in table.columns}
    more = {key: np.full(table.count, value, dtype=object) for key, value in keys.items()}
    return replace(table, columns={**table.columns, **more}) if more else table


def _write(path: Path, frame: Any) -> str:
    """Write fixes as a Parquet file, completely or not at all, and return its checksum."""
    from pyarrow import parquet

    scratch = path.with_name(f".optloc-{secrets.token_hex(8)}.parquet")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(arrow_of(frame), scratch, compression="zstd")
        digest = digest_of(scratch)
        scratch.replace(path)
    except OSError as error:
        scratch.unlink(missing_ok=True)
        raise unwritable_folder(path.parent, error, KEPT) from None
    return digest


def _stored_events(out: Path, one: FinishedPartition) -> Array:
    """Return the hashes of the events of a finished partition."""
    pairs = _events(out, one.name) if one.labelled else []
    return event_hashes([epoch for epoch, _ in pairs], [target for _, target in pairs])


def _events(out: Path, name: str) -> list[tuple[str, str]]:
    """Return the epoch and the target of each fix of a partition."""
    from pyarrow import parquet

    read = parquet.read_table(out / name, columns=["epoch", "target"], partitioning=None)
    return list(zip(read["epoch"].to_pylist(), read["target"].to_pylist(), strict=True))


def _check_events(index: EventIndex, one: FinishedPartition, events: Array, out: Path) -> None:
    """Raise InvalidProblem if an event of a partition is in an earlier partition of the index, and add its events."""
    if not one.labelled:
        return
    for other in index.add(one.name, events):
        common = sorted(set(_events(out, one.name)) & set(_events(out, other)))
        if common:
            first, second = sorted((one.name, other))
            what = f"the event {common[0][0]!r} is in both partitions"
            advice = "write all readings of an event to one file, or join columns: --column message=day+id"
            raise InvalidProblem(what, f"{first} and {second}", advice)
