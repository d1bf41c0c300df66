"""Unlabelled measurements: for each channel of each scan, the values one of which may be a target's."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from optloc import noise as noises
from optloc.errors import InvalidProblem
from optloc.problem import Problem
from optloc.track.track import scans
from optloc.types import Array, Rows


@dataclass(frozen=True, slots=True)
class Candidates:
    """What may belong to one of several targets.

    Parameters
    ----------
    channels : Problem
        A run of one target with one row for each channel (kind and stations) and epoch; its measurements do not
        matter, and it has no batch axes.
    z : array (..., m, c)
        Values measured in the channel of each row, SI units or radians; NaN where there are fewer than c.
    """

    channels: Problem
    z: Array

    def scans(self, order: int) -> Iterator[tuple[float, Problem, Array]]:
        """Yield time, channels and candidates (..., m, c) of each scan; the unknown is a state of an order."""
        for k, (time, scan) in enumerate(scans(self.channels, order)):
            yield time, scan, self.z[..., self.channels.epoch == k, :]


def candidates(problem: Problem) -> Candidates:
    """Return the rows of a run as candidates: rows of one kind, epoch and pair of stations are one channel.

    Known corrections are taken off.

    Parameters
    ----------
    problem : Problem
        A single run, or a batch (...) with common stations and noise. The targets of its rows, usually -1, do not
        matter; a channel has the noise of its first row.

    Raises
    ------
    InvalidProblem
        Where stations or noise differ between the runs of a batch.
    """
    first, members = channels_of(problem)
    rows, values = [], []
    width = max((len(found) for found in members), default=0)
    z = np.where(problem.weight > 0.0, problem.observed, np.nan)
    for found in members:
        column = z[..., found]
        gap = np.full((*column.shape[:-1], width - len(found)), np.nan)
        values.append(np.concatenate([column, gap], axis=-1))
    start = 0
    for block in problem.rows:
        kept = first[(first >= start) & (first < start + block.count)] - start
        rows.append(_row(block, kept))
        start += block.count
    made = replace(problem, rows=tuple(rows), motions=problem.motions[:1])
    return checked(Candidates(_with_noise(problem, made, first), np.stack(values, axis=-2)))


def checked(given: Candidates) -> Candidates:
    """Return candidates that fit their channels, known corrections taken off; raise InvalidProblem for others."""
    if given.channels.batch_shape != ():
        advice = "track runs with stations or noise of their own one by one"
        raise InvalidProblem("the channels have batch axes", "candidates", advice)
    if given.z.ndim < 2 or given.z.shape[-2] != given.channels.count or not given.z.shape[-1]:
        what = f"candidates of shape {given.z.shape} for {given.channels.count} channels"
        raise InvalidProblem(what, "candidates", "give (..., m, c), c at least 1")
    correction = np.concatenate([block.correction for block in given.channels.rows])
    if not correction.any():
        return given
    rows = tuple(replace(block, correction=np.zeros(block.count)) for block in given.channels.rows)
    return Candidates(replace(given.channels, rows=rows), given.z - correction[:, None])


def channels_of(problem: Problem) -> tuple[Array, list[Array]]:
    """Return the first row of each channel, ascending, and all rows of each."""
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


def _row(block: Rows, kept: Array) -> Rows:
    nan, none = np.full(len(kept), np.nan), np.zeros(len(kept), dtype=np.int64)
    sure = np.ones(len(kept))
    return Rows(block.kind, nan, block.a[kept], block.b[kept], block.epoch[kept], none, sure, np.zeros(len(kept)))


def _with_noise(problem: Problem, made: Problem, first: Array) -> Problem:
    """Return the channels with the covariance of their first rows, epoch by epoch."""
    blocks = [
        noises.Block(members, noises.gathered(problem.noise, first[members])) for members in noises.together(made.epoch)
    ]
    return replace(made, noise=noises.Noise(tuple(blocks)))
