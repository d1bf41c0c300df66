"""The fixes of a file: one problem or its epochs in batches, as a long table, as JSON, and for every format."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from optloc.base.types import Status
from optloc.bounds.observability import Observability, observability
from optloc.cli.output import bar
from optloc.files import Loaded
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.fix import Fix
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem
from optloc.report import columns as told
from optloc.report.columns import Columns, fix_detail, join_tables, level_covariance, records
from optloc.report.formats.marks import Results

LOG = logging.getLogger("optloc.problem.fix")

CHUNK = 1024
"""Epochs that are solved at once: large enough for batched kernels, small enough for a bar that moves."""


@dataclass(frozen=True, slots=True)
class FileFixes:
    """All fixes of a file.

    Parameters
    ----------
    loaded : Loaded
        The file.
    fixes : tuple of Fix
        Batches of epochs in order; one fix without batch axes where the epochs share unknowns.
    columns : dict of str to array
        The long table.
    reweighted : bool
        Whether the method gave rows other weights than the file states.
    seen : Observability, optional
        What the data of a run show of its biases.
    """

    loaded: Loaded
    fixes: tuple[Fix, ...]
    columns: Columns
    reweighted: bool
    seen: Observability | None = None

    def passes(self, allow: Sequence[Status] = ()) -> bool:
        """Return whether every status is ok, or among those that are allowed."""
        return all(bool(np.isin(fix.code, [Status.OK, *allow]).all()) for fix in self.fixes)

    @property
    def problem(self) -> Problem:
        """Return what was solved: a batch of epochs where they share nothing, else the run."""
        return by_epoch(self.loaded.problem) if separable(self.loaded.problem) else self.loaded.problem

    @property
    def singles(self) -> Iterator[Fix]:
        """Yield the fixes one by one."""
        for fix in self.fixes:
            flat = fix if fix.shape else fix.flat()
            yield from (flat[i] for i in range(len(flat)))


def fix_file(loaded: Loaded, method: str, quiet: bool) -> FileFixes:
    """Return the fixes of a file; a bar moves on a terminal's standard error."""
    from optloc.solvers import solve

    apart = separable(loaded.problem)
    # Epochs that share nothing are a batch of problems; else the whole run is one.
    problem = by_epoch(loaded.problem) if apart else loaded.problem
    fixes, tables, reweighted = [], [], False
    with bar(loaded.title, loaded.problem.epochs if apart else 1, quiet) as advance:
        for first, part in _chunks(problem, loaded.problem.epochs) if apart else [(None, problem)]:
            fix = solve(part, method=method)
            _log_stages(fix)
            fixes.append(fix)
            tables.append(fix_columns(loaded, fix, first))
            # A loss or a search for suspects shows in the weights, whatever the method is called.
            reweighted |= bool((fix.weights != part.weight)[fix.answered].any())
            advance(len(fix) if apart else 1)
    seen = None if apart else _observe(problem, fixes[0])
    return FileFixes(loaded, tuple(fixes), join_tables(tables), reweighted, seen)


def _chunks(batch: Problem, count: int) -> Iterator[tuple[int, Problem]]:
    for first in range(0, count, CHUNK):
        yield first, batch.take(np.arange(first, min(first + CHUNK, count)))


def _log_stages(fix: Fix) -> None:
    for stage in fix.stages:
        LOG.info("%s: %.3g ms%s", stage.name, 1e3 * stage.seconds, f", {stage.detail}" if stage.detail else "")


def _observe(problem: Problem, fix: Fix) -> Observability | None:
    """Return what the data show of biases, at the fix or else at an alternative; None without either, or a bias."""
    points = [x for x in (fix.x, *fix.alternatives.x) if np.isfinite(x).all()]
    biased = any(slot.members for slot in fix.layout.shared)
    return observability(problem, points[0]) if biased and points else None


def fix_columns(loaded: Loaded, fix: Fix, first: int | None) -> Columns:
    """Return the table of fixes.

    Parameters
    ----------
    loaded : Loaded
        Names of epochs and targets.
    fix : Fix
        A batch (n,) of single epochs, or the fix of a whole run, without batch axes.
    first : int or None
        Epoch of the first fix of a batch; None: the fix belongs to the whole run.

    Returns
    -------
    dict of str to array (rows,)
        Metres, seconds and degrees; NaN where there is no number.
    """
    motions, n = loaded.problem.motions, 1 if first is None else len(fix)
    # A file of known targets alone (a calibration) has a row for each of them all the same.
    shown = [i for i, m in enumerate(motions) if m.known is None] or range(len(motions))
    return told.fix_columns(
        fix,
        targets=[(i, state_names(i, len(motions), motions[i].order)) for i in shown],
        labels=lambda target, spread: _labels(loaded, n, first, target, spread),
        dimension=loaded.problem.dimension,
        constrained=bool(loaded.problem.constraints),
    )


def _labels(loaded: Loaded, n: int, first: int | None, target: int, spread: bool) -> Columns:
    """Return epoch, time and target of every row."""
    k = loaded.problem.epochs
    part = slice(0, k) if first is None else slice(first, first + n)
    if first is None and not spread:
        motion = loaded.problem.motions[target]
        time = loaded.times[0] if motion.reference is None else motion.reference
        epochs, times = [loaded.epochs[0] if k == 1 else "run"], np.array([time])
    else:
        epochs, times = list(loaded.epochs[part]), loaded.times[part]
    names = list(loaded.targets[part]) if loaded.own_epochs else [loaded.targets[target]] * len(epochs)
    return {"epoch": np.array(epochs, dtype=object), "time": times, "target": np.array(names, dtype=object)}


# All of it for machines.


def table_json(loaded: Loaded) -> dict[str, Any]:
    """Return how a foreign table was read, as a part of a JSON value; nothing of a problem file."""
    return {"table": dict(loaded.table)} if loaded.table else {}


def fixes_json(found: FileFixes) -> dict[str, Any]:
    """Return all fixes of a file as one JSON value; lengths in metres, angles in degrees."""
    from optloc.uncertainty.radii import accuracy

    frame, rows = found.loaded.problem.frame, records(found.columns)
    per_fix = [
        fix_detail(fix, found.seen, reweighted=found.reweighted) | _unnoticed(fix, found, i)
        for i, fix in enumerate(found.singles)
    ]
    # One row a fix wherever it has one target and one epoch; else what belongs to the fix stands with the run.
    single = len(rows) == len(per_fix)
    if len(rows) == 1 == len(per_fix):  # tables of many have their covariances
        per_fix[0]["accuracy"] = asdict(accuracy(level_covariance(found.columns, 0)))
    stages = {stage.name: stage for fix in found.fixes for stage in fix.stages}
    origin = None if frame.origin is None else [*np.degrees(frame.origin[:2]).tolist(), frame.origin[2]]
    return {
        "file": found.loaded.source,
        "title": found.loaded.title,
        **table_json(found.loaded),
        "frame": {"kind": frame.kind, "origin_deg": origin},
        "fixes": [row | detail for row, detail in zip(rows, per_fix, strict=True)] if single else rows,
        "runs": [] if single else per_fix,
        "stages": [{"name": s.name, "detail": s.detail} for s in stages.values()],
    }


def _unnoticed(fix: Fix, found: FileFixes, item: int) -> dict[str, Any]:
    """Return which errors of the stations a search for suspects would not have noticed; nothing where nobody asked."""
    if fix.explanations is None or not fix.answered:
        return {}
    from optloc.cli.crlb import reliability_json, reliability_of

    problem = found.problem
    one = problem.flat().take(np.array([item])) if problem.batch_shape else problem
    return {"unnoticed": reliability_json(reliability_of(one, fix.x, fix.suspects))}


def results_of(found: FileFixes) -> Results:
    """Return the fixes as formats take them."""
    problem = found.loaded.problem
    return Results(found.columns, problem.frame, found.fixes, problem, found.loaded.title)
