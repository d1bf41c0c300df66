"""From the best assignment to the emitters: fixes, ghosts, and how sure their number is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optloc.fix import Fix
from optloc.problem import Problem
from optloc.several.answer import Emitters, Ghost
from optloc.several.master import chosen
from optloc.several.scene import Scene
from optloc.several.tuples import of_picks
from optloc.solve import solve
from optloc.solve.reasons import AMBIGUOUS_GAP
from optloc.solve.verdict import LISTED_GAP
from optloc.status import Status
from optloc.types import Array

if TYPE_CHECKING:
    from optloc.several.assign import Solved

# Ghosts that are listed at most; squared distance in sigmas from which a place is another one.
_LISTED, _APART = 12, 16.0
# Cost above its bound from which an assignment is not called proven.
_PROVEN = 2.0


def reported(problem: Problem, scene: Scene, solved: Solved, count: int | None) -> Emitters:
    """Return the emitters of an assignment of one epoch."""
    taken = solved.taken[np.argsort(solved.tuples.cost[solved.taken], kind="stable")]
    best, width = solved.tuples.take(taken), scene.z.shape[1]
    fixes = fixed(scene, best.picks)
    assignment = np.full(problem.count, -1)
    for number, picks in enumerate(best.picks):
        used = np.flatnonzero(picks >= 0)
        assignment[scene.row[used, picks[used]]] = number
    costs = np.array([chosen(solved.tuples, width, k)[1] for k in range(len(taken) + 2)])
    ghosts = _ghosts(scene, solved, fixes, width, count)
    numbers = [] if count is not None else [costs[k] - solved.cost for k in (len(taken) - 1, len(taken) + 1) if k >= 0]
    margin = float(min([*numbers, *(ghost.gap for ghost in ghosts)], default=np.inf))
    status, reason = _verdict(scene, solved, fixes, ghosts, costs, count)
    return Emitters(fixes, assignment, solved.cost, solved.bound, costs, margin, ghosts, status, reason, solved.boxes)


def fixed(scene: Scene, picks: Array) -> tuple[Fix, ...]:
    """Return the fixes of sets of rows (n, m)."""
    if not len(picks):
        return ()
    fix = solve(scene.scan.with_rows(z=of_picks(scene.z, picks), weight=(picks >= 0).astype(float)))
    return tuple(fix[i] for i in range(len(picks)))


def _ghosts(scene: Scene, solved: Solved, fixes: tuple[Fix, ...], width: int, count: int | None) -> tuple[Ghost, ...]:
    """Return the places of other sets that an assignment of nearly the least cost takes."""
    tuples, found = solved.tuples, list[Ghost]()
    known = [(fix.position, _information(fix.covariance())) for fix in fixes]
    # A reduced cost is a lower bound of what it costs to take a set.
    lowest = solved.prices.reduced(tuples)
    for i in np.argsort(lowest, kind="stable"):
        if len(found) == _LISTED or lowest[i] >= LISTED_GAP:
            break
        if any((tuples.x[i] - at) @ weight @ (tuples.x[i] - at) < _APART for at, weight in known):
            continue
        gap = chosen(tuples, width, count, forced=int(i))[1] - solved.cost
        if not gap < LISTED_GAP:
            continue
        used = np.flatnonzero(tuples.picks[i] >= 0)
        found.append(Ghost(tuples.x[i], scene.row[used, tuples.picks[i][used]], float(gap)))
        own = fixed(scene, tuples.picks[i : i + 1])[0]
        known.append((tuples.x[i], _information(own.covariance())))
    return tuple(sorted(found, key=lambda ghost: ghost.gap))


def _information(cov: Array) -> Array:
    """Return the inverse of a covariance, zero where there is none: everything is then near."""
    return np.linalg.pinv(cov) if np.isfinite(cov).all() else np.zeros_like(cov)


def _verdict(
    scene: Scene, solved: Solved, fixes: tuple[Fix, ...], ghosts: tuple[Ghost, ...], costs: Array, count: int | None
) -> tuple[Status, str]:
    """Return status and reason."""
    rows, n = int(np.isfinite(scene.z).sum()), len(fixes)
    present = int(np.isfinite(scene.z).any(1).sum())
    if count is not None and not np.isfinite(solved.cost):
        return Status.INFEASIBLE, f"no {count} emitters were found that share no row"
    if n == 0 and present < scene.least:
        what = "none can" if scene.least > len(scene.z) else f"an emitter takes {scene.least}"
        return Status.TOO_FEW_ROWS, f"rows in {present} channels cannot tell an emitter from false rows: {what}"
    doubts = [
        f"{_counted(k)} would cost only {costs[k] - solved.cost:.1f} more"
        for k in (n - 1, n + 1)
        if count is None and k >= 0 and costs[k] - solved.cost < AMBIGUOUS_GAP
    ]
    near = [ghost for ghost in ghosts if ghost.gap < AMBIGUOUS_GAP]
    if near:
        doubts.append(f"another place costs only {near[0].gap:.1f} more, {len(near)} such in all")
    doubts += [f"emitter {i}: {fix.status.label}" for i, fix in enumerate(fixes) if fix.status != Status.OK]
    open_ = solved.cost - solved.bound > _PROVEN
    unproven = [f"not proven: another assignment may cost {solved.cost - solved.bound:.1f} less"] if open_ else []
    if doubts or unproven:
        return Status.AMBIGUOUS if doubts else Status.SEARCHED, "; ".join([*doubts, *unproven])
    return Status.OK, f"{_counted(n)}; false rows: {rows - int((solved.tuples.picks[solved.taken] >= 0).sum())}"


def _counted(emitters: int) -> str:
    return {0: "no emitter", 1: "one emitter"}.get(emitters, f"{emitters} emitters")
