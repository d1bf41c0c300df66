"""Tracks of several targets from rows without labels, and runs of single targets from labelled rows.

Letters: t targets, m channels of a scan (rows of a run), c candidates of a channel, n numbers of a state,
k scans.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Motion, Rows, Status
from optloc.linear.constraints import for_target, is_of_one_target
from optloc.linear.evaluate import predict
from optloc.problem import noise as noises
from optloc.problem.noise import Block, Noise
from optloc.problem.problem import Problem
from optloc.tracking.associate import Associate
from optloc.tracking.dynamics import Dynamics
from optloc.tracking.scan_rows import Scans
from optloc.tracking.several_models import spread
from optloc.tracking.track import State, Track, check_state, collect, predicted, scans, step
from optloc.tracking.updates import Update, filter_of

Missing = Literal["drop", "expect"]
"""Treatment of a channel without a row; see `associated`."""


@dataclass(frozen=True, slots=True)
class Associated:
    """Tracks of several targets, and the rows of each target.

    - track: a track of t targets, with leading axes (..., t).
    - picks: for each scan of the track, the candidate (..., t, m) of each target in each of its m channels;
    -1 for none.
    """

    track: Track
    picks: tuple[Array, ...]


def associated(
    given: RowCandidates,
    start: State,
    dynamics: Dynamics,
    rule: Associate,
    update: Update | str = "iekf",
    *,
    missing: Missing = "drop",
) -> Associated:
    """Return the tracks of several targets from unlabelled rows.

    Parameters
    ----------
    given : RowCandidates
        Measurements; scans at or before the start are ignored.
    start : State
        States of all targets (..., t).
    dynamics : Dynamics
        Model of motion.
    rule : callable
        For instance `nearest`, `joint` or `assigned` of `optloc.tracking.associate`.
    update : callable or str
        A filter, or its name in `UPDATES`.
    missing : "drop" or "expect"
        Treatment of a channel without a row. "drop" ignores it. "expect" uses the prediction as a measurement, so
        that the covariance is too small. It is for comparison with a paper only
        (doi:10.7654/j.issn.2097-1974.20240501).

    Raises
    ------
    InvalidProblem
        If the filter is unknown, the state does not fit the dynamics, or the state has no axis of targets.
    """
    given, filtering = _checked(given), filter_of(update)
    d = given.channels.dimension
    check_state(start, (dynamics.order + 1) * d)
    if start.mean.ndim < 2:
        raise InvalidProblem("the state has no axis of targets", "start", "give means (..., t, n)")
    # The start gets the leading axes of the candidates, with its axis of targets behind them.
    state, steps, times, picks = spread(start, (*given.z.shape[:-2], 1)), [], [], []
    runs = Scans.of(given.channels, dynamics.order)
    for k, (time, scan, z) in enumerate(given.scans(dynamics.order)):
        if time <= start.time:
            continue
        ahead = predicted(state, dynamics, time, d)
        pick = rule(scan, ahead, z) if scan.rows else np.zeros((*ahead.mean.shape[:-1], 0), dtype=np.int64)
        more = None
        if scan.rows:
            found = np.take_along_axis(z[..., None, :, :], np.maximum(pick, 0)[..., None], axis=-1)[..., 0]
            expected = predict(scan, ahead.mean)
            # With "expect", the prediction is the row of the channel: an innovation of zero shrinks the covariance.
            weight = (pick >= 0).astype(float) if missing == "drop" else np.ones(pick.shape)
            more = np.where(pick >= 0, found, expected), weight
        done, code = step(runs, k, ahead, dynamics, filtering, more)
        # If rows were present but no target took one, the status is rejected and not too few rows.
        seen = np.asarray(np.isfinite(z).any((-1, -2)))[..., None]
        code = np.where((code == Status.TOO_FEW_ROWS) & seen, Status.REJECTED, code).astype(np.int8)
        state = State(time, done.mean, done.cov)
        steps.append((done, code))
        times.append(time)
        picks.append(pick)
    return Associated(collect(np.array(times), steps, d, dated=given.channels.dated), tuple(picks))


# Unlabelled measurements: the candidate values of each channel of each scan.


@dataclass(frozen=True, slots=True)
class RowCandidates:
    """Measurements that may belong to one of several targets.

    Parameters
    ----------
    channels : Problem
        A run of one target with one row for each channel (kind and stations) and epoch. Its measurements are ignored,
        and it has no batch axes.
    z : array (..., m, c)
        Values measured in the channel of each row, SI units or radians; NaN if there are fewer than c values.
    """

    channels: Problem
    z: Array

    def scans(self, order: int) -> Iterator[tuple[float, Problem, Array]]:
        """Yield time, channels and candidates (..., m, c) of each scan; the unknown is a state of the given order."""
        for k, (time, scan) in enumerate(scans(self.channels, order)):
            yield time, scan, self.z[..., self.channels.epoch == k, :]


def candidates(problem: Problem) -> RowCandidates:
    """Return the rows of a run as candidates: rows of one kind, epoch and pair of stations are one channel.

    Known corrections are subtracted.

    Parameters
    ----------
    problem : Problem
        A single run, or a batch (...) with common stations and noise. The target numbers of its rows, usually -1, are
        ignored; a channel has the noise of its first row.

    Raises
    ------
    InvalidProblem
        If stations or noise differ between the runs of a batch.
    """
    first, members = channels_of(problem)
    rows, values = [], []
    width = max((len(found) for found in members), default=0)
    # Absent rows are not candidates.
    z = np.where(problem.weight > 0.0, problem.observed, np.nan)
    for found in members:
        column = z[..., found]
        # All channels have the length of the longest one; the rest is NaN.
        gap = np.full((*column.shape[:-1], width - len(found)), np.nan)
        values.append(np.concatenate([column, gap], axis=-1))
    start = 0
    for block in problem.rows:
        kept = first[(first >= start) & (first < start + block.count)] - start
        rows.append(_as_channels(block, kept))
        start += block.count
    made = replace(problem, rows=tuple(rows), motions=problem.motions[:1])
    return _checked(RowCandidates(_with_noise(problem, made, first), np.stack(values, axis=-2)))


def _checked(given: RowCandidates) -> RowCandidates:
    """Return candidates without corrections: known corrections are subtracted from the values.

    Candidates that do not fit their channels raise InvalidProblem.
    """
    if given.channels.batch_shape != ():
        advice = "track runs with different stations or noise separately"
        raise InvalidProblem("the channels have batch axes", "candidates", advice)
    if given.z.ndim < 2 or given.z.shape[-2] != given.channels.count or not given.z.shape[-1]:
        what = f"the candidates have shape {given.z.shape}, but there are {given.channels.count} channels"
        raise InvalidProblem(what, "candidates", "give shape (..., m, c) with c at least 1")
    correction = np.concatenate([block.correction for block in given.channels.rows])
    if not correction.any():
        return given
    rows = tuple(replace(block, correction=np.zeros(block.count)) for block in given.channels.rows)
    return RowCandidates(replace(given.channels, rows=rows), given.z - correction[:, None])


def channels_of(problem: Problem) -> tuple[Array, list[Array]]:
    """Return the first row of each channel, and all rows of each channel.

    Rows are indices. Channels are in the order of their first rows.
    """
    # A channel is a kind at its stations in one epoch; a row of b against a is a different channel from a against b.
    keys = [
        (kind, int(epoch), int(a), int(b))
        for kind, block in enumerate(problem.rows)
        for epoch, a, b in zip(block.epoch, block.a, block.b, strict=True)
    ]
    found: dict[tuple[int, ...], list[int]] = {}
    for i, key in enumerate(keys):
        found.setdefault(key, []).append(i)
    members = [np.array(rows) for rows in found.values()]
    return np.array([rows[0] for rows in members]), members


def _as_channels(block: Rows, kept: Array) -> Rows:
    """Return rows of a block, with the indices `kept` (k,), as channels without measurements."""
    nan, none = np.full(len(kept), np.nan), np.zeros(len(kept), dtype=np.int64)
    sure = np.ones(len(kept))
    return Rows(block.kind, nan, block.a[kept], block.b[kept], block.epoch[kept], none, sure, np.zeros(len(kept)))


def _with_noise(problem: Problem, made: Problem, first: Array) -> Problem:
    """Return the channels `made` with the covariance of their first rows `first` (m,) in `problem`, epoch by epoch."""
    blocks = [
        noises.Block(members, noises.gathered(problem.noise, first[members]))
        for members in noises.group_members(made.epoch)
    ]
    return replace(made, noise=noises.Noise(tuple(blocks)))


# One of several targets: its rows and scans as a run.


def alone(problem: Problem, kept: Array, times: Array | None = None) -> Problem:
    """Return the run of one target: some rows of a problem, and the epochs of these rows.

    Parameters
    ----------
    problem : Problem
        Any run; its models of motion, and constraints of other targets, are removed.
    kept : bool array (m,)
        Rows of the target, over all kinds.
    times : array (k,), optional
        Times in seconds that replace the times of the epochs of `problem`.

    Returns
    -------
    Problem
        Run of one target with a free position at each epoch, for `tracked`.

    Raises
    ------
    InvalidProblem
        If no row is kept.
    """
    if not kept.any():
        raise InvalidProblem("the target has no rows", "track", "select a target with measurements")
    epochs = np.unique(problem.epoch[kept])
    number = np.full(problem.epochs, -1)
    number[epochs] = np.arange(len(epochs))
    parts = np.split(kept, np.cumsum([rows.count for rows in problem.rows])[:-1])
    rows = tuple(
        _rows_of_target(block, own, number) for block, own in zip(problem.rows, parts, strict=True) if own.any()
    )
    target = np.unique(np.concatenate([b.target[own] for b, own in zip(problem.rows, parts, strict=True)]))
    s = problem.stations

    def at(values: Array | None, core: int) -> Array | None:
        """Return station values at the epochs of the target; the axis of epochs is `core` axes from the end."""
        return values if values is None or values.shape[-core] == 1 else np.take(values, epochs, axis=-core)

    position = at(s.position, 3)
    assert position is not None
    return replace(
        problem,
        stations=replace(s, position=position, velocity=at(s.velocity, 3), axes=at(s.axes, 4)),
        rows=rows,
        noise=Noise(tuple(_noise_of_rows(problem.noise, kept))),
        times=(problem.times if times is None else times)[epochs],
        motions=(Motion(span="epoch"),),
        constraints=tuple(for_target(c, 0) for c in problem.constraints if c.target in target and is_of_one_target(c)),
        fences=tuple(replace(c, target=0) for c in problem.fences if c.target in target),
    )


def _rows_of_target(block: Rows, own: Array, number: Array) -> Rows:
    """Return the rows of one target from a block: the mask `own` selects them, and `number` maps old to new epochs."""
    picked = {name: getattr(block, name)[..., own] for name in ("z", "weight", "correction")}
    a, b = block.a[own], block.b[own]
    return replace(block, **picked, a=a, b=b, epoch=number[block.epoch[own]], target=np.zeros_like(a))


def _noise_of_rows(noise: Noise, kept: Array) -> list[Block]:
    """Return the noise of the rows in the mask `kept` (m,), with new row numbers.

    A group that loses rows keeps the covariance of its other rows.
    """
    place, found = np.cumsum(kept) - 1, []
    for block in noise.blocks:
        inside = kept[block.row]
        # Groups that lose the same rows stay in one block.
        for pattern in np.unique(inside, axis=0):
            if not pattern.any():
                continue
            groups = (inside == pattern).all(1)
            one = block.covariance.shape[-3] == 1
            covariance = block.covariance if one else block.covariance[..., groups, :, :]
            found.append(Block(place[block.row[groups][:, pattern]], covariance[..., pattern, :][..., pattern]))
    return found
