"""Tracks of a target that stays on one of several heights, such as the floors of a building: one track for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.types import Status
from optloc.problem.problem import Problem
from optloc.solvers.floors import height_of, on_floors
from optloc.solvers.policy import AMBIGUOUS_GAP
from optloc.tracking.dynamics import Dynamics
from optloc.tracking.entry import Entry, Rules
from optloc.tracking.run import tracked
from optloc.tracking.track import State
from optloc.tracking.updates import Update

UNDECIDED = "another of the stated heights fits the track about as well"
"""Reason of an ambiguous scan if two floors fit about as well."""


@dataclass(frozen=True, slots=True)
class FloorTrack:
    """The track on the floor that fits best.

    Parameters
    ----------
    problem : Problem
        The run with the exact height of this floor.
    entries : tuple of Entry
        Results of the scans.
    height : float
        The height of the floor, metres.
    margin : float
        Cost of the next best floor minus the cost of this floor; infinite for one floor.
    """

    problem: Problem
    entries: tuple[Entry, ...]
    height: float
    margin: float


def track_on_floors(
    problem: Problem,
    floors: Sequence[float],
    dynamics: Dynamics,
    update: Update | str = "iekf",
    *,
    start: State | None = None,
    rules: Rules | None = None,
) -> FloorTrack:
    """Return the track of a target that stays on one floor, on the floor with the least cost.

    The cost of a track is the sum of the NIS of its updates. A row that no update used costs the squared gate. If
    another floor costs at most `AMBIGUOUS_GAP` more, the scans that are ok become ambiguous.

    Parameters
    ----------
    problem : Problem
        A single run of one target with a band of heights.
    floors : sequence of float
        Heights, metres.
    dynamics, update, start, rules
        As for `tracked`.
    """
    rules = rules or Rules()
    runs = on_floors(problem, floors)
    tracks = [tuple(tracked(run, dynamics, update, start=start, rules=rules)) for run in runs]
    cost = np.array([_cost(run, track, rules.most) for run, track in zip(runs, tracks, strict=True)])
    best = int(cost.argmin())
    margin = float(np.delete(cost, best).min(initial=np.inf)) - float(cost[best])
    entries = tracks[best]
    if margin <= AMBIGUOUS_GAP:
        entries = tuple(
            replace(entry, code=Status.AMBIGUOUS, reason=UNDECIDED) if entry.code == Status.OK else entry
            for entry in entries
        )
    return FloorTrack(runs[best], entries, height_of(runs[best]), margin)


def _cost(problem: Problem, entries: Sequence[Entry], unused: float) -> float:
    """Return the cost of a track: the NIS of its updates, and `unused` for each row that no update used."""
    nis = np.array([float(entry.updated.nis) for entry in entries])
    count = np.array([int(entry.updated.count) for entry in entries])
    tested = np.isfinite(nis)
    rows = int((problem.weight > 0.0).sum()) - int(count[tested].sum())
    return float(nis[tested].sum()) + unused * rows
