"""Run a study into its folder, go on where it stopped, and say how far it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from optloc.study.execute import Executor, computed
from optloc.study.folder import Manifest, begin, finished, locked, part_files, read_manifest, store
from optloc.study.plan import Plan

Tell = Callable[[int, dict[str, int]], None]
"""Called with the number of new rows and their statuses after each part."""


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


def run_plan(plan: Plan, folder: Path, by: Executor, tell: Tell | None = None) -> Progress:
    """Compute what is missing of a study, and return how far it is.

    Parameters
    ----------
    plan : Plan
        The study.
    folder : Path
        Its output folder: new, or begun by the same study and the same version.
    by : Executor
        Who computes.
    tell : callable, optional
        Hears of every part, and first of those that were there.

    Raises
    ------
    InvalidProblem
        Where the folder belongs to another study or cannot be written; finished parts are kept.
    """
    manifest = begin(plan, folder)
    with locked(folder):
        done = finished(folder, manifest)
        if tell is not None and done:
            had = progress(folder)
            tell(had.rows, had.counts)
        left = [chunk for chunk in plan.chunks if chunk.key not in done]
        with closing(computed(left, by)) as parts:
            for part in parts:
                store(folder, part)
                if tell is not None:
                    tell(sum(part.counts.values()), part.counts)
    return progress(folder)


def progress(folder: Path) -> Progress:
    """Return how far the study of a folder is; raise InvalidProblem where it holds none."""
    from pyarrow import parquet

    manifest = read_manifest(folder)
    files = part_files(folder)
    methods: Counter[tuple[str, str]] = Counter()
    for path in files:
        table = parquet.read_table(path, columns=["method", "status"])
        found = table.group_by(["method", "status"]).aggregate([([], "count_all")]).to_pylist()
        methods.update({(str(row["method"]), str(row["status"])): int(row["count_all"]) for row in found})
    counts: Counter[str] = Counter()
    for (_, status), count in methods.items():
        counts[status] += count
    return Progress(manifest, len(files), len(manifest.chunks), counts.total(), dict(counts), dict(methods))
