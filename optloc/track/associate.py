"""Which measurement is whose: unlabelled rows and several targets that are predicted."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from optloc.problem import Problem
from optloc.track.gate import check_width
from optloc.track.sets import Clutter, Sets, distances, offsets, scored
from optloc.track.track import State
from optloc.types import Array

__all__ = ["Associate", "Clutter", "assigned", "joint", "nearest"]

Associate = Callable[[Problem, State, Array], Array]
"""Maps a scan of one row a channel, predicted targets (..., t) and candidates (..., m, c) to picks, ints (..., t, m).

A pick is the index of the candidate that is taken for a target in a channel, or -1 for none.
"""

# Best sets of a target among which an assignment chooses.
_RIVALS = 200


def nearest(width: float = 5.0) -> Associate:
    """Return the rule that takes, for each target and channel, the candidate nearest to the prediction.

    Channels do not know of each other, nor targets: two targets may take the same row.

    Parameters
    ----------
    width : float
        Half width of the gate in standard deviations of the innovation, prediction included.
    """
    check_width(width)

    def rule(scan: Problem, ahead: State, z: Array) -> Array:
        apart, S = offsets(scan, ahead, z)
        distance = distances(apart, S, width)
        return np.where(np.isfinite(distance).any(-1), distance.argmin(-1), -1)

    return rule


def joint(clutter: Clutter) -> Associate:
    """Return the rule that scores whole sets of rows, one or none of each channel, and takes each target's best.

    The score of a set of n rows of m channels is chi-square + ln|2 pi S| - 2 n ln(pd / density) - 2 (m - n) ln(1 - pd)
    with the joint covariance S of its innovations: twice the negative logarithm of its likelihood against false rows.
    Targets do not know of each other.

    Parameters
    ----------
    clutter : Clutter
        Detection and false rows.

    References
    ----------
    Y. Bar-Shalom, T. E. Fortmann, "Tracking and Data Association" (1988), section 9.3.
    """

    def rule(scan: Problem, ahead: State, z: Array) -> Array:
        sets = scored(scan, ahead, z, clutter)
        return sets.chosen(sets.score.argmin(-1))

    return rule


def assigned(clutter: Clutter) -> Associate:
    """Return the rule that takes the best sets of all targets together, no row for more than one of them.

    The sum of the scores of `joint` is least, exactly: an assignment in several dimensions, solved as an integer
    programme where targets compete for a row.

    Parameters
    ----------
    clutter : Clutter
        Detection and false rows.

    References
    ----------
    C. L. Morefield, "Application of 0-1 integer programming to multitarget tracking problems", IEEE Trans. Autom.
    Control 22 (1977).
    """

    def rule(scan: Problem, ahead: State, z: Array) -> Array:
        sets = scored(scan, ahead, z, clutter)
        pick = sets.chosen(sets.score.argmin(-1))
        for index in np.ndindex(pick.shape[:-2]):
            if _shared(pick[index]):
                own = Sets(sets.score[index], sets.picks[index])
                pick[index] = own.chosen(_without_rivals(own))
        return pick

    return rule


def _shared(pick: Array) -> bool:
    """Return whether any two targets take the same candidate, picks (t, m)."""
    same = (pick[:, None] == pick[None]) & (pick[:, None] >= 0)
    return bool(same.any(-1).sum() > (pick >= 0).any(-1).sum())


def _without_rivals(sets: Sets) -> Array:
    """Return the numbers (t,) of the sets with the least sum of scores, one for a target, that share no candidate."""
    from scipy.optimize import Bounds, LinearConstraint, milp
    from scipy.sparse import csr_array

    owner, number, wanted = [], [], []
    for target, own in enumerate(sets.score):
        # The empty set is the first, and never in anybody's way: a set that is worse need not be looked at.
        better = np.flatnonzero(own < own[0])
        better = better[np.argsort(own[better], kind="stable")][:_RIVALS]
        numbers = np.concatenate([[0], better])
        owner.append(np.full(len(numbers), target))
        number.append(numbers)
        wanted.append(sets.picks[target, numbers])
    who, which, pick = np.concatenate(owner), np.concatenate(number), np.concatenate(wanted)
    column, channel = np.nonzero(pick >= 0)
    _, row = np.unique(np.stack([channel, pick[column, channel]]), axis=1, return_inverse=True)
    everyone = csr_array((np.ones(len(who)), (who, np.arange(len(who)))))
    once = csr_array((np.ones(len(row)), (row, column)), shape=(int(row.max()) + 1, len(who)))
    solved = milp(
        sets.score[who, which],
        integrality=np.ones(len(who), dtype=np.int64),
        bounds=Bounds(0.0, 1.0),
        constraints=[LinearConstraint(everyone, 1.0, 1.0), LinearConstraint(once, -np.inf, 1.0)],
    )
    assert solved.x is not None  # all targets with nothing is always allowed
    taken = np.flatnonzero(solved.x > 0.5)
    return np.asarray(which[taken[np.argsort(who[taken])]])
