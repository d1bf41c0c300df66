"""A data set of readings and the folder of its fixes: partitions, their journal, and a lock.

A partition is one Parquet file. Its fixes have the same name in the output folder. The journal has one line for each
finished partition, with checksums, so that a stopped run continues and an incomplete file never counts.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from optloc.base.errors import InvalidProblem
from optloc.base.inputs import read_bytes
from optloc.base.locked_folder import locked_folder, unwritable_folder
from optloc.base.outputs import refuse_address

JOURNAL = "_optloc.jsonl"
"""Name of the journal. Other programs leave out files of a data set that begin with an underscore."""
_LOCK, _ENDINGS = "_optloc.lock", (".parquet", ".pq")
# The format of the journal; folders with another format are refused.
_FORMAT = 1
KEPT = "finished partitions are kept, and the same command continues"
"""Next step if the folder of the fixes cannot be written."""


@dataclass(frozen=True, slots=True)
class FinishedPartition:
    """A finished partition.

    Parameters
    ----------
    name : str
        Path of the file relative to the data set, with slashes.
    source, fixes : str
        Checksums of the readings and of the fixes.
    labelled : bool
        Whether columns name the events.
    counts : dict of str to int
        Number of fixes by status.
    """

    name: str
    source: str
    fixes: str
    labelled: bool
    counts: dict[str, int]


def partition_names(folder: Path) -> list[str]:
    """Return the paths of the partitions of a data set, relative to its folder and sorted.

    Files and folders whose names begin with "_" or "." are left out, as other programs do.

    Raises
    ------
    InvalidProblem
        If there is no such folder, or it has no Parquet file.
    """
    refuse_address(folder)
    if not folder.is_dir():
        raise InvalidProblem("there is no such folder", str(folder), "name the folder of a Parquet data set")
    names = [path.relative_to(folder) for path in folder.rglob("*") if path.suffix.lower() in _ENDINGS]
    shown = sorted(name.as_posix() for name in names if not any(part.startswith(("_", ".")) for part in name.parts))
    if not shown:
        raise InvalidProblem("the folder has no Parquet file", str(folder), "name a folder with files *.parquet")
    return shown


def folder_keys(name: str) -> dict[str, str]:
    """Return the keys and values of the folders of a partition, such as ``{"day": "2026-06-01"}``.

    Hive writes a data set as ``day=2026-06-01/part-0.parquet``.
    """
    pairs = (part.partition("=") for part in Path(name).parent.parts)
    return {key: value for key, sign, value in pairs if sign}


def digest_of(path: Path) -> str:
    """Return the checksum of a file, 32 hexadecimal digits; raise InvalidProblem if it cannot be read."""
    return hashlib.blake2b(read_bytes(path), digest_size=16).hexdigest()


@contextmanager
def locked_output(folder: Path, data_set: Path) -> Iterator[None]:
    """Create the folder of the fixes, and lock it against other runs; the lock ends with the process.

    Raises
    ------
    InvalidProblem
        If another run has the lock, or the folder cannot be written. Also if it has other files, or overlaps with the
        data set `data_set`.
    """
    refuse_address(folder)
    here, there = folder.resolve(), data_set.resolve()
    if here.is_relative_to(there) or there.is_relative_to(here):
        raise InvalidProblem("the fixes would be inside the data set", str(folder), "name another folder after --out")
    with locked_folder(folder, _LOCK, JOURNAL, "the folder has other files", KEPT):
        yield


class Journal:
    """The journal of a folder of fixes: its options, and the finished partitions by name.

    Parameters
    ----------
    folder : Path
        The folder of the fixes, locked by this process.
    options : mapping
        Everything on which the fixes depend, as a JSON value.

    Raises
    ------
    InvalidProblem
        If the folder has fixes with other options, the journal is damaged, or it cannot be written.
    """

    def __init__(self, folder: Path, options: Mapping[str, Any]) -> None:
        self.path = folder / JOURNAL
        self.finished: dict[str, FinishedPartition] = {}
        header = json.loads(json.dumps({"format": _FORMAT, **options}))
        try:
            lines = _complete_lines(self.path)
            for scratch in folder.rglob(".optloc-*"):
                scratch.unlink(missing_ok=True)
        except OSError as error:
            raise unwritable_folder(folder, error, KEPT) from None
        if not lines:
            self._append(header)
            return
        try:
            found, *records = (json.loads(line) for line in lines)
            self.finished = {one.name: one for one in (FinishedPartition(**record) for record in records)}
        except (ValueError, TypeError):
            raise InvalidProblem("the journal is damaged", str(self.path), "name another folder after --out") from None
        if found != header:
            names = sorted(key for key in {*found, *header} if found.get(key) != header.get(key))
            what = f"the folder has fixes with another {names[0]}"
            raise InvalidProblem(what, str(folder), "name another folder after --out, or use the same options")

    def add(self, one: FinishedPartition) -> None:
        """Add a finished partition, whose file is complete."""
        self._append(asdict(one))
        self.finished[one.name] = one

    def _append(self, record: Mapping[str, Any]) -> None:
        """Append a line, and wait until the disk has it; raise InvalidProblem if this fails."""
        try:
            with self.path.open("ab") as file:
                file.write(json.dumps(record).encode() + b"\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise unwritable_folder(self.path.parent, error, KEPT) from None

    def is_done(self, name: str, data_set: Path) -> bool:
        """Return whether a partition is finished: its readings and its fixes have the checksums of the journal."""
        one = self.finished.get(name)
        if one is None:
            return False
        fixes = self.path.parent / name
        try:
            return fixes.is_file() and digest_of(fixes) == one.fixes and digest_of(data_set / name) == one.source
        except InvalidProblem:
            return False


def _complete_lines(path: Path) -> list[bytes]:
    """Return the complete lines of a journal, and remove the part of a line that a killed run has left at the end."""
    lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
    complete = [line for line in lines if line.endswith(b"\n")]
    if complete != lines:
        with path.open("r+b") as file:
            file.truncate(sum(map(len, complete)))
    return complete
