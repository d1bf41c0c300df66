"""Fix what a file holds: one problem, or its epochs in batches while a bar moves."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.base.frames import Frame
from optloc.base.linalg import error_ellipse
from optloc.base.status import Status
from optloc.base.types import Array
from optloc.bounds.observability import Observability, observability
from optloc.files import Loaded
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.fix import Explanation, Fix
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem

# The long table of fixes: one row for each target and epoch, one column for each number.

Columns = dict[str, Array]
_RATES = {"velocity": "v", "acceleration": "a"}


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
    motions = loaded.problem.motions
    flat = fix if first is not None else fix.flat()
    shown = [i for i, m in enumerate(motions) if m.known is None] or range(len(motions))
    return joined([_of_target(loaded, flat, first, i, state_names(i, len(motions), motions[i].order)) for i in shown])


def joined(parts: Sequence[Columns]) -> Columns:
    """Return tables below each other; a column that one lacks is NaN there."""
    names = dict.fromkeys(name for part in parts for name in part)
    sizes = [len(next(iter(part.values()))) for part in parts]
    return {
        name: np.concatenate([part.get(name, np.full(size, np.nan)) for part, size in zip(parts, sizes, strict=True)])
        for name in names
    }


def _of_target(loaded: Loaded, fix: Fix, first: int | None, target: int, names: Sequence[str]) -> Columns:
    position = (
        fix.take(names[0]) if _estimated(fix, names[0]) else np.full((len(fix), loaded.problem.dimension), np.nan)
    )
    n, d = len(fix), position.shape[-1]
    spread = position.ndim == 3
    count = position.shape[1] if spread else 1
    columns = _labels(loaded, n, first, target, spread)
    position = position.reshape(n * count, d)
    covariance = np.full((n * count, d, d), np.nan)
    if _estimated(fix, names[0]) and (not spread or fix.local is not None):
        covariance = fix.covariance(names[0]).reshape(n * count, d, d)

    def repeated(values: Array) -> Array:
        return np.repeat(values, count)

    columns["status"] = repeated(np.array([Status(int(code)).label for code in fix.code], dtype=object))
    columns["reason"] = repeated(fix.reason.astype(object))
    columns |= _state(position, covariance)
    for name in names[1:] if _estimated(fix, names[0]) else ():
        letter = _RATES[name.partition("[")[0]]
        kept = not spread or fix.local is not None
        sigma = fix.sigma(name).reshape(n * count, d) if kept else np.full((n * count, d), np.nan)
        for values, prefix in ((fix.take(name).reshape(n * count, d), letter), (sigma, f"sigma_{letter}")):
            columns |= {f"{prefix}{axis}": v for axis, v in zip("xyz", values.T, strict=False)}
    columns |= geodetic_columns(loaded.problem.frame, position, covariance)
    semi_axes, _ = error_ellipse(covariance)
    columns |= {f"ellipse95_{i + 1}": semi_axes[:, d - 1 - i] for i in range(d)}
    columns |= {"cost": repeated(fix.cost), "dof": repeated(fix.dof), "p_value": repeated(np.asarray(fix.p_value))}
    columns["alternatives"] = repeated(np.isfinite(fix.alternatives.gap).sum(-1))
    columns["proof"] = repeated(np.array([getattr(c, "proof", "unknown") for c in fix.certificate], dtype=object))
    if loaded.problem.constraints:
        columns |= {name: repeated(values) for name, values in _held(fix).items()}
    if fix.explanations is not None:
        columns["suspects"] = repeated(np.array([suspects_of(each) for each in fix.explanations], dtype=object))
    return columns


def _held(fix: Fix) -> Columns:
    """Return the names and the multipliers of the constraints that hold each fix, as text."""
    held = [()] * len(fix) if fix.active is None else fix.active
    names, multipliers = np.empty(len(fix), dtype=object), np.empty(len(fix), dtype=object)
    names[:] = ["; ".join(active.name for active in each) for each in held]
    multipliers[:] = ["; ".join(f"{active.multiplier:.6g}" for active in each) for each in held]
    return {"active": names, "multipliers": multipliers}


def suspects_of(explanations: Sequence[Explanation]) -> str:
    """Return the suspects of each explanation as text: "A; B" are suspected together, "A | B" instead of each other."""
    return " | ".join("; ".join(explanation.names) for explanation in explanations)


def _estimated(fix: Fix, name: str) -> bool:
    return name in {slot.name for slot in (*fix.layout.shared, *fix.layout.local)}


def _labels(loaded: Loaded, n: int, first: int | None, target: int, spread: bool) -> Columns:
    """Return epoch, time and target of every row."""
    k = loaded.problem.epochs
    if first is None and not spread:
        motion = loaded.problem.motions[target]
        label = loaded.epochs[0] if k == 1 else "run"
        time = loaded.times[0] if motion.reference is None else motion.reference
        epochs, times = [label], np.array([time])
    else:
        part = slice(0, k) if first is None else slice(first, first + n)
        epochs, times = list(loaded.epochs[part]), loaded.times[part]
    names = [loaded.targets[target]] * len(epochs)
    if loaded.own_epochs:
        names = list(loaded.targets[slice(0, k) if first is None else slice(first, first + n)])
    return {"epoch": np.array(epochs, dtype=object), "time": times, "target": np.array(names, dtype=object)}


def _state(position: Array, covariance: Array) -> Columns:
    d = position.shape[-1]
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    columns = {axis: position[:, i] for i, axis in enumerate("xyz"[:d])}
    columns |= {f"sigma_{axis}": sigma[:, i] for i, axis in enumerate("xyz"[:d])}
    return columns | _triangle(covariance, "xyz")


def _triangle(covariance: Array, axes: str) -> Columns:
    d = covariance.shape[-1]
    return {f"cov_{axes[i]}{axes[j]}": covariance[:, i, j] for i in range(d) for j in range(i, d)}


def geodetic_columns(frame: Frame, position: Array, covariance: Array) -> Columns:
    """Return latitude and longitude (degrees), height (metres) and covariance along east, north, up."""
    if not frame.geodetic:
        return {}
    with np.errstate(invalid="ignore"):
        lat, lon, height = frame.to_geodetic(position)
        axes = frame.enu_axes(position)
    local = axes @ covariance @ np.swapaxes(axes, -1, -2)
    return {"lat_deg": np.degrees(lat), "lon_deg": np.degrees(lon), "height": height} | _triangle(local, "enu")


CHUNK = 1024
LOG = logging.getLogger("optloc.problem.fix")


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
    from optloc.solvers import solve

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
