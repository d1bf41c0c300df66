"""Several targets at once from rows without labels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from optloc.errors import InvalidProblem
from optloc.evaluate import predict
from optloc.status import Status
from optloc.track.associate import Associate
from optloc.track.candidates import Candidates, checked
from optloc.track.dynamics import Dynamics
from optloc.track.parallel import spread
from optloc.track.track import State, Track, check_state, filter_of, gathered, predicted, taken
from optloc.track.updates import Update
from optloc.types import Array

Missing = Literal["drop", "expect"]
"""What a channel without a row does; see `associated`."""


@dataclass(frozen=True, slots=True)
class Associated:
    """Tracks of several targets, and the rows that each took.

    Parameters
    ----------
    track : Track
        With leading axes (..., t).
    picks : tuple of int array (..., t, m)
        For each scan of the track, which candidate of each of its m channels a target took; -1 for none.
    """

    track: Track
    picks: tuple[Array, ...]


def associated(
    given: Candidates,
    start: State,
    dynamics: Dynamics,
    rule: Associate,
    update: Update | str = "iekf",
    *,
    missing: Missing = "drop",
) -> Associated:
    """Return the tracks of several targets from rows that do not say whose they are.

    Parameters
    ----------
    given : Candidates
        Measurements; scans not later than the start are left out.
    start : State
        All targets (..., t).
    dynamics : Dynamics
        Model of motion.
    rule : callable
        For instance `nearest`, `joint` or `assigned` of `optloc.track.associate`.
    update : callable or str
        A filter, or its name in `UPDATES`.
    missing : "drop" or "expect"
        What a channel without a row does: nothing; or, as one paper has it, it repeats the prediction and so makes
        the filter believe in it. "expect" is for comparison only.

    Raises
    ------
    InvalidProblem
        For an unknown filter, a state that does not fit the dynamics or has no axis of targets.
    """
    given, step = checked(given), filter_of(update)
    d = given.channels.dimension
    check_state(start, (dynamics.order + 1) * d)
    if start.mean.ndim < 2:
        raise InvalidProblem("the state has no axis of targets", "start", "give means (..., t, n)")
    state, steps, times, picks = spread(start, (*given.z.shape[:-2], 1)), [], [], []
    for time, scan, z in given.scans(dynamics.order):
        if time <= start.time:
            continue
        ahead = predicted(state, dynamics, time, d)
        pick = rule(scan, ahead, z) if scan.rows else np.zeros((*ahead.mean.shape[:-1], 0), dtype=np.int64)
        if scan.rows:
            found = np.take_along_axis(z[..., None, :, :], np.maximum(pick, 0)[..., None], axis=-1)[..., 0]
            expected = predict(scan, ahead.mean)
            weight = (pick >= 0).astype(float) if missing == "drop" else np.ones(pick.shape)
            scan = scan.with_rows(z=np.where(pick >= 0, found, expected), weight=weight)  # noqa: PLW2901
        done, code = taken(scan, ahead, step)
        seen = np.asarray(np.isfinite(z).any((-1, -2)))[..., None]
        code = np.where((code == Status.TOO_FEW_ROWS) & seen, Status.REJECTED, code).astype(np.int8)
        state = State(time, done.mean, done.cov)
        steps.append((done, code))
        times.append(time)
        picks.append(pick)
    return Associated(gathered(np.array(times), steps, d), tuple(picks))
