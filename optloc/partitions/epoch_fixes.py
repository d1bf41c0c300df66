"""Fixes of the separate epochs of a file or partition, in batches of equal structure, and their table."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from ctypes import CDLL
from dataclasses import replace

import numpy as np

from optloc.base.records import join
from optloc.base.units import UNITS
from optloc.files.reader import Loaded
from optloc.problem.epoch_groups import epoch_groups
from optloc.problem.fix import Fix
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem
from optloc.show import columns as tables
from optloc.show.columns import Columns
from optloc.show.origin_time import origin_columns

LOG = logging.getLogger("optloc.problem.fix")

# Epochs per batch: large enough for batched kernels, small enough for a smooth progress bar.
_CHUNK = 1024
# Epochs per batch for methods with an engine plan: about one second of `auto`. `gtrs+lsr` with 1024 epochs at a time
# took 2.4 times as long.
_QUICK_CHUNK = 8192


def solve_floors(problem: Problem, method: str, floors: Sequence[float]) -> Fix:
    """Return the fix of a problem; with `floors`, m, the best of the fixes at these heights."""
    from optloc.solvers.floors import on_floors, solve_on_floors
    from optloc.solvers.solution import solve

    if not floors:
        return solve(problem, method=method)
    return solve_on_floors(on_floors(problem, floors), method)


def fix_epochs(loaded: Loaded, method: str, advance: Callable[[int], object] = lambda _: None) -> tuple[Fix, bool]:
    """Return the fixes of separate epochs in the order of the epochs, and whether weights of rows changed.

    `method` is the method as in `optloc.solve`. `advance` is called with the number of fixes of each batch.
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
            fix = solve_floors(problem, method, loaded.floors)
            log_stages(fix)
            order.append(part.epochs)
            stages.update({stage.name: stage for stage in fix.stages})
            reweighted |= is_reweighted(fix, problem)
            advance(len(fix))
            yield part.name(fix)

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


def is_reweighted(fix: Fix, problem: Problem) -> bool:
    """Return whether a loss or a search for suspects changed weights, independent of the name of the method."""
    return bool((fix.weights != problem.weight)[fix.answered].any())


def log_stages(fix: Fix) -> None:
    """Log the time of each stage of a method."""
    for stage in fix.stages:
        LOG.info("%s: %.3g ms%s", stage.name, 1e3 * stage.seconds, f", {stage.detail}" if stage.detail else "")


# The table of fixes.


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
