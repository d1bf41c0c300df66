"""From a study file to its plan: cells, and the chunks of trials that are computed and stored as one."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import as_file, files
from importlib.resources.abc import Traversable
from pathlib import Path

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.files.schema import fitted, parsed, read_text
from optloc.study.cases import Case, cases_of
from optloc.study.document import StudyFile
from optloc.study.methods import Method, methods_of

_FAST, _SLOW, _LEAST = 10_000, 250, 10
_NUMBERS = 100_000
_SHARES = 8


@dataclass(frozen=True)
class Cell:
    """A case with a method.

    Parameters
    ----------
    case : Case
        Geometry, truth, noise.
    method : Method
        What solves it.
    """

    case: Case
    method: Method

    @property
    def key(self) -> str:
        """Return 16 hexadecimal digits that name it."""
        return hashlib.blake2b(f"{self.case.key} {self.method.identity}".encode(), digest_size=8).hexdigest()

    @property
    def stretch(self) -> int:
        """Return how many trials make a chunk: as many as take seconds, but so few that several workers get some."""
        method = self.method
        if method.chunk is not None:
            return method.chunk
        slow = method.slow
        most = max(_LEAST, min(_SLOW if slow else _FAST, _NUMBERS // (20 if slow else 1) // self.case.template.count))
        return int(np.clip(-(-self.case.trials // _SHARES), _LEAST if slow else min(500, most), most))


@dataclass(frozen=True)
class Chunk:
    """Some trials of a cell: what one task computes, and one part file holds.

    Parameters
    ----------
    cell : Cell
        Their cell.
    first, count : int
        Numbers of the trials.
    """

    cell: Cell
    first: int
    count: int

    @property
    def key(self) -> str:
        """Return the name of its part file, without ending."""
        return f"{self.cell.key}-{self.first:09d}-{self.count}"


@dataclass(frozen=True)
class Plan:
    """A study that is ready to run.

    Parameters
    ----------
    study : StudyFile
        Its file.
    text : str
        The text of the file.
    cells : tuple of Cell
        In the order of the file.
    folder : str
        Where its problem files are.
    """

    study: StudyFile
    text: str
    cells: tuple[Cell, ...]
    folder: str = ""

    @property
    def chunks(self) -> Iterator[Chunk]:
        """Yield the chunks: the first of every cell, then the second of every cell, and so on."""
        cut = [
            [Chunk(cell, first, min(n, cell.case.trials - first)) for first in range(0, cell.case.trials, n)]
            for cell, n in ((cell, cell.stretch) for cell in self.cells)
        ]
        for turn in range(max(len(chunks) for chunks in cut)):
            yield from (chunks[turn] for chunks in cut if turn < len(chunks))

    @property
    def rows(self) -> int:
        """Return the number of rows of the table."""
        return sum(cell.case.trials for cell in self.cells)

    @property
    def fingerprint(self) -> str:
        """Return hexadecimal digits that are equal for equal data and methods, whatever the remarks of the file."""
        text = " ".join(f"{cell.key}:{cell.case.trials}:{cell.stretch}" for cell in self.cells)
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def shipped() -> dict[str, Traversable]:
    """Return the shipped study files by name."""
    folder = files("optloc") / "studies"
    if not folder.is_dir():
        return {}
    found = {entry.name.removesuffix(".toml"): entry for entry in folder.iterdir() if entry.name.endswith(".toml")}
    return dict(sorted(found.items()))


def plan_of(file: Path, *, trials: int | None = None, seed: int | None = None) -> Plan:
    """Return the plan of a study file, or of a shipped study by its name.

    Parameters
    ----------
    file : Path
        A TOML file with ``format = 1``.
    trials, seed : int, optional
        In the place of those of the file; `trials` also in that of single scenarios.

    Raises
    ------
    InvalidProblem
        Naming the file, the scenario or the method, and what cannot be right.
    """
    if file.suffix == "" and not file.exists():
        known = shipped()
        if str(file) not in known:
            advice = f"{nearest(str(file), known)}, or give the path of a study file"
            raise InvalidProblem(f"there is no study {str(file)!r}", "study", advice)
        with as_file(known[str(file)]) as path:
            return planned(read_text(path), path.name, path.parent, trials=trials, seed=seed)
    return planned(read_text(file), file.name, file.parent, trials=trials, seed=seed)


def planned(text: str, source: str, folder: Path, *, trials: int | None = None, seed: int | None = None) -> Plan:
    """Return the plan of the text of a study file; `folder` is where its problem files are."""
    study = fitted(StudyFile, parsed(text, source), source)
    new = {key: value for key, value in (("trials", trials), ("seed", seed)) if value is not None}
    study = study.model_copy(update=new)
    try:
        methods = [method for i, table in enumerate(study.method) for method in methods_of(table, i + 1)]
        cases = []
        for table in study.scenario:
            own = table if trials is None else table.model_copy(update={"trials": None})
            cases += list(cases_of(own, folder, study.seed, study.trials))
    except InvalidProblem as error:
        where = ", ".join(part for part in (source, error.where) if part)
        raise InvalidProblem(error.what, where, error.advice) from None
    _distinct([method.name for method in methods], source, "method")
    _distinct([table.name for table in study.scenario], source, "scenario")
    return Plan(study, text, tuple(Cell(case, method) for case in cases for method in methods), str(folder.resolve()))


def _distinct(names: list[str], source: str, what: str) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InvalidProblem(f"there are two {what}s {twice[0]!r}", source, f"give each {what} a name of its own")


def workers() -> int:
    """Return how many processes this machine can run at a time."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
