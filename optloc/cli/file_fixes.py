"""The fixes of a problem file: solved epoch by epoch in batches or as one run, as a table, JSON or export format."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from optloc.base.types import Status
from optloc.bounds.rank import Observability, observability
from optloc.cli.output import bar
from optloc.files.propagation import NOT_STATED
from optloc.files.reader import Loaded
from optloc.model_checks.cause import Advice
from optloc.partitions.epoch_fixes import (
    fix_columns,
    fix_epochs,
    in_unit_of_stations,
    is_reweighted,
    log_stages,
    solve_floors,
)
from optloc.problem.epoch_groups import EpochGroup, epoch_groups, problem_of
from optloc.problem.epochs import separable
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.show.answer_sheets import MOST_ROWS
from optloc.show.columns import Columns, fix_detail, json_rows, level_covariance
from optloc.show.describe_fix import answer_of
from optloc.show.fix_answer import FixAnswer
from optloc.show.formats.marks import Results


@dataclass(frozen=True, slots=True)
class FileFixes:
    """All fixes of a file.

    Parameters
    ----------
    loaded : Loaded
        The file.
    fix : Fix
        A batch of the epochs in order; one fix without batch axes if the epochs share unknowns.
    columns : dict of str to array
        Table with one row for each epoch and target; metres, seconds and degrees.
    reweighted : bool
        Whether the method changed the weights of rows.
    seen : Observability, optional
        Observability of the biases of a run.
    """

    loaded: Loaded
    fix: Fix
    columns: Columns
    reweighted: bool
    seen: Observability | None = None

    def passes(self, allow: Sequence[Status] = ()) -> bool:
        """Return whether each status is ok or allowed."""
        return bool(np.isin(self.fix.code, [Status.OK, *allow]).all())

    @property
    def apart(self) -> bool:
        """Return whether each epoch is fixed separately."""
        return bool(self.fix.shape)

    @property
    def singles(self) -> Iterator[Fix]:
        """Yield the single fixes."""
        flat = self.fix if self.apart else self.fix.flat()
        yield from (flat[i] for i in range(len(flat)))


def fix_file(loaded: Loaded, method: str, quiet: bool) -> FileFixes:
    """Return the fixes of a file; on a terminal, a progress bar is drawn on standard error."""
    if separable(loaded.problem):
        with bar(loaded.title, loaded.problem.epochs, quiet) as advance:
            fix, reweighted = fix_epochs(loaded, method, advance)
        return FileFixes(loaded, fix, fix_columns(loaded, fix, 0), reweighted)
    fix = solve_floors(loaded.problem, method, loaded.floors)
    log_stages(fix)
    reweighted = is_reweighted(fix, loaded.problem)
    return FileFixes(loaded, fix, fix_columns(loaded, fix, None), reweighted, _observe(loaded.problem, fix))


def _observe(problem: Problem, fix: Fix) -> Observability | None:
    """Return the observability of biases at the fix or, without a fix, at an alternative; else None."""
    points = [x for x in (fix.x, *fix.alternatives.x) if np.isfinite(x).all()]
    biased = any(slot.members for slot in fix.layout.shared)
    return observability(problem, points[0]) if biased and points else None


# JSON output.


def table_json(loaded: Loaded) -> dict[str, Any]:
    """Return the interpretation of a measurement table as a JSON part; empty for a problem file."""
    return {"table": dict(loaded.table)} if loaded.table else {}


def fixes_json(found: FileFixes) -> dict[str, Any]:
    """Return all fixes of a file as one JSON value; lengths in metres, angles in degrees.

    The entries of "fixes" are the rows of the table `found.columns`, one for each epoch and target.
    """
    from optloc.uncertainty.radii import accuracy

    frame, rows = found.loaded.problem.frame, json_rows(found.columns)
    searched = found.apart and found.fix.explanations is not None
    groups = epoch_groups(found.loaded.problem) if searched else ()
    per_fix = [
        fix_detail(fix, found.seen, reweighted=found.reweighted) | _unnoticed_errors(fix, found, groups, i)
        for i, fix in enumerate(found.singles)
    ]
    # With one target and one epoch for each fix, row and fix are merged; otherwise "runs" has the data of the fixes.
    single = len(rows) == len(per_fix)
    if len(rows) == 1 == len(per_fix):  # for long tables the covariances suffice
        per_fix[0]["accuracy"] = asdict(accuracy(level_covariance(found.columns, 0)))
    origin = None if frame.origin is None else [*np.degrees(frame.origin[:2]).tolist(), frame.origin[2]]
    return {
        "file": found.loaded.source,
        "title": found.loaded.title,
        **table_json(found.loaded),
        **({"warnings": list(found.loaded.warnings)} if found.loaded.warnings else {}),
        "frame": {"kind": frame.kind, "origin_deg": origin},
        "fixes": [row | detail for row, detail in zip(rows, per_fix, strict=True)] if single else rows,
        "runs": [] if single else per_fix,
        "stages": [{"name": s.name, "detail": s.detail} for s in found.fix.stages],
    }


def _unnoticed_errors(fix: Fix, found: FileFixes, groups: Sequence[EpochGroup], item: int) -> dict[str, Any]:
    """Return the station errors that the search for suspects would not detect; empty without a search.

    `groups` are the epochs by structure, and `item` is the number of the fix.
    """
    if fix.explanations is None or not fix.answered:
        return {}
    from optloc.cli.crlb import reliability_json, reliability_of

    problem = problem_of(groups, item) if found.apart else found.loaded.problem
    return {"unnoticed": reliability_json(reliability_of(problem, fix.x, fix.suspects))}


def answer_of_file(found: FileFixes, advice: Sequence[Advice] = (), most: int = MOST_ROWS) -> FixAnswer:
    """Return the answer of the fixes of a file, with its names of epochs and targets.

    `advice` is the advice on the data, and `most` the number of fixes that tables show completely.
    """
    loaded, columns = found.loaded, found.columns
    fix = found.fix[0] if found.apart and len(columns["x"]) == 1 else found.fix
    details = [("azimuths", loaded.azimuths)] if loaded.azimuths else []
    details += [("wave speed", loaded.speed)] if loaded.speed not in ("", NOT_STATED) else []
    where = []
    converted = in_unit_of_stations(loaded, columns)
    if converted and len(columns["x"]) == 1 and np.isfinite(columns["x"]).all():
        parts = [(*name.split("_", 1), float(values[0])) for name, values in converted.items()]
        text = ", ".join(f"{axis} = {value:.6g} {unit}" for axis, unit, value in parts)
        where.append((f"in {loaded.table['unit']}", text))
    return answer_of(
        fix,
        columns,
        loaded.title,
        seen=found.seen,
        unit_of=loaded.bias_unit,
        where=where,
        details=details,
        advice=advice,
        most=most,
    )


def results_of(found: FileFixes) -> Results:
    """Return the fixes in the form that the export formats need."""
    problem = found.loaded.problem
    return Results(found.columns, problem.frame, (found.fix,), problem, found.loaded.title, found.loaded.dated)
