"""Other states of an ambiguous start, which are followed with the track until the scans refute them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optloc.base import linalg
from optloc.solvers.policy import AMBIGUOUS_GAP
from optloc.tracking.entry import Entry
from optloc.tracking.track import State

# Gap from which a rival is refuted: five standard deviations. Errors that last count again in every scan, so that the
# gap of a fix, three of them, would come too early.
_REFUTED = 25.0
# Squared distance of two states, in both covariances together, below which they are one.
_SAME = 1.0


@dataclass(frozen=True, slots=True)
class Rival:
    """A state that may be the right one in the place of a track's.

    Parameters
    ----------
    state : State
        After the last scan.
    gap : float
        Twice the logarithm of its likelihood ratio to the track: of the rows of the start and of all scans since.
    """

    state: State
    gap: float

    @property
    def leads(self) -> bool:
        """Return whether the scans prefer it to the track."""
        return self.gap < -AMBIGUOUS_GAP


def remaining(rivals: Sequence[Rival], entry: Entry, others: Sequence[Entry | None], most: float) -> tuple[Rival, ...]:
    """Return the rivals that a scan neither refutes nor merges with the track.

    Parameters
    ----------
    rivals : sequence of Rival
        Before the scan.
    entry : Entry
        The track after the scan.
    others : sequence of Entry or None
        Each rival after the scan; None where it cannot be followed.
    most : float
        Squared innovation of a row that was left out.
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
    """Return twice the negative logarithm of the likelihood of a scan, each row that was left out at the gate."""
    return -2.0 * float(entry.updated.loglikelihood) + most * entry.rejected


def _distance(one: Entry, other: Entry) -> float:
    """Return the squared distance of two states in both covariances together."""
    apart = one.updated.mean - other.updated.mean
    solved, _ = linalg.solve(one.updated.cov + other.updated.cov, apart[:, None])
    return float(np.sum(apart * solved[:, 0]))
