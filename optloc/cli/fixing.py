"""Fix what a file holds: one problem, or its epochs in batches while a bar moves."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.cli.columns import Columns, fix_columns, joined
from optloc.epochs import by_epoch, separable
from optloc.files import Loaded
from optloc.fix import Fix
from optloc.observe import Observability, observability
from optloc.problem import Problem

CHUNK = 1024
LOG = logging.getLogger("optloc.fix")


@dataclass(frozen=True, slots=True)
class Fixed:
    """All fixes of a file.

    Parameters
    ----------
    loaded : Loaded
        The file.
    fixes : tuple of Fix
        Batches of epochs in order; one fix without batch axes where the epochs share unknowns.
    columns : dict of str to array
        The long table.
    seen : Observability, optional
        What the data of a run show of its biases.
    """

    loaded: Loaded
    fixes: tuple[Fix, ...]
    columns: Columns
    seen: Observability | None = None

    @property
    def clean(self) -> bool:
        """Return whether every status is ok."""
        return all(bool((fix.code == 0).all()) for fix in self.fixes)

    @property
    def singles(self) -> Iterator[Fix]:
        """Yield the fixes one by one."""
        for fix in self.fixes:
            flat = fix if fix.shape else fix.flat()
            yield from (flat[i] for i in range(len(flat)))


def fix_file(loaded: Loaded, method: str, quiet: bool) -> Fixed:
    """Return the fixes of a file; a bar moves on a terminal's standard error."""
    from optloc.solve import solve

    if not separable(loaded.problem):
        with bar(loaded.title, 1, quiet) as advance:
            fix = solve(loaded.problem, method=method)
            note(fix)
            advance(1)
        return Fixed(loaded, (fix,), fix_columns(loaded, fix, None), _seen(loaded.problem, fix))
    fixes, tables = [], []
    batch = by_epoch(loaded.problem)
    with bar(loaded.title, loaded.problem.epochs, quiet) as advance:
        for first, part in _parts(batch, loaded.problem.epochs):
            fix = solve(part, method=method)
            note(fix)
            fixes.append(fix)
            tables.append(fix_columns(loaded, fix, first))
            advance(len(fix))
    return Fixed(loaded, tuple(fixes), joined(tables))


def note(fix: Fix) -> None:
    """Log the stages of a fix or of a batch of fixes."""
    for stage in fix.stages:
        LOG.info("%s: %.3g ms%s", stage.name, 1e3 * stage.seconds, f", {stage.detail}" if stage.detail else "")


def _seen(problem: Problem, fix: Fix) -> Observability | None:
    """Return what the data show of biases, at the fix or else at an alternative; None without either, or a bias."""
    points = [x for x in (fix.x, *fix.alternatives.x) if np.isfinite(x).all()]
    biased = any(slot.members for slot in fix.layout.shared)
    return observability(problem, points[0]) if biased and points else None


def _parts(batch: Problem, count: int) -> Iterator[tuple[int, Problem]]:
    for first in range(0, count, CHUNK):
        yield first, batch.take(np.arange(first, min(first + CHUNK, count)))


@contextmanager
def bar(title: str, total: int, quiet: bool) -> Iterator[Any]:
    """Yield a function that moves a progress bar on standard error; it is drawn on terminals only."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    shown = console.is_terminal and not quiet and total > 1
    parts = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*parts, console=console, disable=not shown, transient=True) as progress:
        task = progress.add_task(title, total=total)
        yield lambda n: progress.update(task, advance=n)
