"""The fixes of a problem file: solved epoch by epoch in batches or as one run, as a table, JSON or export format."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import suppress
from ctypes import CDLL
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from optloc.base.records import join
from optloc.base.types import Status
from optloc.base.units import UNITS
from optloc.bounds.rank import Observability, observability
from optloc.cli.output import bar
from optloc.files.propagation import NOT_STATED
from optloc.files.reader import Loaded
from optloc.model_checks.cause import Advice
from optloc.problem.epoch_groups import EpochGroup, epoch_groups, problem_of
from optloc.problem.epochs import separable
from optloc.problem.fix import Fix
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem
from optloc.show import columns as tables
from optloc.show.answer_sheets import MOST_ROWS
from optloc.show.columns import Columns, fix_detail, level_covariance, records
from optloc.show.describe_fix import answer_of
from optloc.show.fix_answer import FixAnswer
from optloc.show.formats.marks import Results
from optloc.show.origin_time import origin_columns

LOG = logging.getLogger("optloc.problem.fix")

# Epochs per batch: large enough for batched kernels, small enough for a smooth progress bar.
_CHUNK = 1024
# Epochs per batch for methods with an engine plan: about one second of `auto`. `gtrs+lsr` with 1024 epochs at a time
# took 2.4 times as long.
_QUICK_CHUNK = 8192


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


def _solve(problem: Problem, method: str, floors: Sequence[float]) -> Fix:
    """Return the fix of a problem; with `floors`, m, the best of the fixes at these heights."""
    from optloc.solvers.floors import on_floors, solve_on_floors
    from optloc.solvers.solution import solve

    if not floors:
        return solve(problem, method=method)
    return solve_on_floors(on_floors(problem, floors), method)


def fix_file(loaded: Loaded, method: str, quiet: bool) -> FileFixes:
    """Return the fixes of a file; on a terminal, a progress bar is drawn on standard error."""
    if separable(loaded.problem):
        fix, reweighted = fix_epochs(loaded, method, quiet)
        return FileFixes(loaded, fix, fix_columns(loaded, fix, 0), reweighted)
    fix = _solve(loaded.problem, method, loaded.floors)
    _log_stages(fix)
    reweighted = _is_reweighted(fix, loaded.problem)
    return FileFixes(loaded, fix, fix_columns(loaded, fix, None), reweighted, _observe(loaded.problem, fix))


def fix_epochs(loaded: Loaded, method: str, quiet: bool) -> tuple[Fix, bool]:
    """Return the fixes of separate epochs in the order of the epochs, and whether weights of rows changed.

    `method` is the method as in `optloc.solve`. `quiet` hides the progress bar.
    """
    from optloc.solvers.methods import is_quick

    reweighted, order, stages = False, [], {}  # `order` has the epoch numbers of the fixes, in the order of the fixes

    def parts() -> Iterator[Fix]:
        """Yield the fixes of batches of epochs with equal structure, with their labels."""
        nonlocal reweighted
        groups = epoch_groups(loaded.problem)
        _release_memory()
        sizes = [_QUICK_CHUNK if is_quick(group.take(slice(_CHUNK)).problem, method) else _CHUNK for group in groups]
        for part in (part for group, size in zip(groups, sizes, strict=True) for part in group.parts(size)):
            problem = part.problem
            fix = _solve(problem, method, loaded.floors)
            _log_stages(fix)
            order.append(part.epochs)
            stages.update({stage.name: stage for stage in fix.stages})
            reweighted |= _is_reweighted(fix, problem)
            advance(len(fix))
            yield part.name(fix)

    with bar(loaded.title, loaded.problem.epochs, quiet) as advance:
        fix = join(parts(), loaded.problem.epochs)
    # Epochs are solved by groups of equal structure; the table is sorted by time.
    epochs = np.concatenate(order)
    fix = fix if (np.diff(epochs) > 0).all() else fix[np.argsort(epochs)]
    _release_memory()
    return replace(fix, stages=tuple(stages.values())), reweighted


def _release_memory() -> None:
    """Return free memory to the system: after a long table, glibc would keep a fifth of all memory."""
    import pyarrow as pa

    pa.default_memory_pool().release_unused()
    with suppress(OSError, AttributeError, TypeError):  # other systems have no such function
        CDLL(None).malloc_trim(0)


def _is_reweighted(fix: Fix, problem: Problem) -> bool:
    """Return whether a loss or a search for suspects changed weights, independent of the name of the method."""
    return bool((fix.weights != problem.weight)[fix.answered].any())


def _log_stages(fix: Fix) -> None:
    """Log the time of each stage of a method."""
    for stage in fix.stages:
        LOG.info("%s: %.3g ms%s", stage.name, 1e3 * stage.seconds, f", {stage.detail}" if stage.detail else "")


def _observe(problem: Problem, fix: Fix) -> Observability | None:
    """Return the observability of biases at the fix or, without a fix, at an alternative; else None."""
    points = [x for x in (fix.x, *fix.alternatives.x) if np.isfinite(x).all()]
    biased = any(slot.members for slot in fix.layout.shared)
    return observability(problem, points[0]) if biased and points else None


def fix_columns(loaded: Loaded, fix: Fix, first: int | None) -> Columns:
    """Return the table of fixes: metres, seconds and degrees; NaN for missing numbers.

    `loaded` has the names of epochs and targets. `fix` is a batch (n,) of single epochs, or one fix of a whole run.
    `first` is the epoch of the first fix of a batch; None for a whole run.
    """
    motions, n = loaded.problem.motions, 1 if first is None else len(fix)
    # A file with known targets only (a calibration) has one row for each target.
    shown = [i for i, m in enumerate(motions) if m.known is None] or range(len(motions))
    found = tables.fix_columns(
        fix,
        targets=[(i, state_names(i, len(motions), motions[i].order)) for i in shown],
        labels=lambda target, spread: _labels(loaded, n, first, target, spread),
        dimension=loaded.problem.dimension,
        constrained=bool(loaded.problem.constraints),
    )
    found |= _origin_times(loaded, fix, first, len(found["x"]))
    return found | in_unit_of_stations(loaded, found)


def _origin_times(loaded: Loaded, fix: Fix, first: int | None, rows: int) -> Columns:
    """Return the columns of emission times for a table with one row for each fix; empty for other tables.

    `first` is as for `fix_columns`, and `rows` is the number of rows.
    """
    clock, problem = loaded.emission, loaded.problem
    fixes = 1 if first is None else len(fix)
    if clock is None or rows != fixes or len(problem.motions) > 1 or (first is None and problem.epochs > 1):
        return {}
    from optloc.uncertainty.emission import emissions

    metres, epoch = np.full((2, fixes, 1), np.nan), np.arange(fixes) + (first or 0)
    if first is None:
        metres[:] = emissions(problem, fix)
    else:
        for part in (part for group in epoch_groups(problem) for part in group.parts(_QUICK_CHUNK)):
            own = np.flatnonzero((part.epochs >= first) & (part.epochs < first + fixes))
            if len(own):
                chosen = part.epochs[own] - first
                metres[:, chosen] = emissions(part.problem.take(own), fix[chosen])
    seconds, sigma = clock.seconds(metres[0, :, 0], metres[1, :, 0], epoch)
    return origin_columns(seconds, sigma, clock.dated)


def in_unit_of_stations(loaded: Loaded, columns: Columns) -> Columns:
    """Return the coordinates in the unit of the stations, such as `x_cm`; empty for metres and for problem files."""
    unit = loaded.table.get("unit")
    if unit is None:
        return {}
    size = UNITS["length"][unit]
    return {f"{axis}_{unit}": np.asarray(columns[axis], dtype=float) / size for axis in "xyz" if axis in columns}


def _labels(loaded: Loaded, n: int, first: int | None, target: int, spread: bool) -> Columns:
    """Return the columns epoch, time and target of the rows of one target.

    `n` is the number of fixes, and `first` the epoch of the first fix; None for a whole run. `spread` is whether a run
    has one row for each epoch.
    """
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


# JSON output.


def table_json(loaded: Loaded) -> dict[str, Any]:
    """Return the interpretation of a measurement table as a JSON part; empty for a problem file."""
    return {"table": dict(loaded.table)} if loaded.table else {}


def fixes_json(found: FileFixes) -> dict[str, Any]:
    """Return all fixes of a file as one JSON value; lengths in metres, angles in degrees.

    The entries of "fixes" are the rows of the table `found.columns`, one for each epoch and target.
    """
    from optloc.uncertainty.radii import accuracy

    frame, rows = found.loaded.problem.frame, records(found.columns)
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
    return Results(found.columns, problem.frame, (found.fix,), problem, found.loaded.title)
