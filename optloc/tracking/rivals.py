"""Other states of an ambiguous start: they are tracked too, until the scans refute them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optloc.base import linalg
from optloc.solvers.policy import AMBIGUOUS_GAP
from optloc.tracking.entry import Entry
from optloc.tracking.track import State

# Gap above which a rival is refuted: five standard deviations. Lasting errors count again in every scan, so the gap of
# a fix (three standard deviations) would refute rivals too early.
_REFUTED = 25.0
# Squared distance of two states, normalised by the sum of their covariances, below which the states are equal.
_SAME = 1.0


@dataclass(frozen=True, slots=True)
class Rival:
    """A state that may be right instead of the state of the track.

    - state: the state after the last scan.
    - gap: twice the logarithm of the likelihood ratio of the track to this state, over the rows of the start and all
      later scans; negative if the scans prefer this state.
    """

    state: State
    gap: float

    @property
    def leads(self) -> bool:
        """Return whether the scans prefer this state to the track."""
        return self.gap < -AMBIGUOUS_GAP


def remaining(rivals: Sequence[Rival], entry: Entry, others: Sequence[Entry | None], most: float) -> tuple[Rival, ...]:
    """Return the rivals that a scan does not refute and that do not merge with the track.

    `entry` is the track after the scan, and `others` are the rivals after it; None for a rival that cannot be followed.
    `most` is the squared innovation that a rejected row counts with.
    """
    found = []
    for rival, other in zip(rivals, others, strict=True):
        if other is None:
            continue
        gap = rival.gap + _cost(other, most) - _cost(entry, most)
        if gap < _REFUTED and _distance(entry, other) > _SAME:
            found.append(Rival(State(other.time, other.updated.mean, other.updated.cov), gap))
    return tuple(found)


def _cost(entry: Entry, most: float) -> float:
    """Return twice the negative log-likelihood of a scan; each rejected row counts as `most`, a squared innovation."""
    return -2.0 * float(entry.updated.loglikelihood) + most * entry.rejected


def _distance(one: Entry, other: Entry) -> float:
    """Return the squared distance of two states, normalised by the sum of their covariances."""
    apart = one.updated.mean - other.updated.mean
    solved, _ = linalg.solve(one.updated.cov + other.updated.cov, apart[:, None])
    return float(np.sum(apart * solved[:, 0]))
