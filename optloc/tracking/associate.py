"""Which measurement is whose: unlabelled rows and several targets that are predicted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.linear.evaluate import predict
from optloc.models import MODELS
from optloc.models.primitives import wrap
from optloc.problem.problem import Problem
from optloc.tracking.track import State
from optloc.tracking.updates import check_width, innovation

Associate = Callable[[Problem, State, Array], Array]
"""Maps a scan of one row a channel, predicted targets (..., t) and candidates (..., m, c) to picks, ints (..., t, m).

A pick is the index of the candidate that is taken for a target in a channel, or -1 for none.
"""

# Sets of a target and scan that are followed at once: with m channels of c candidates in the gate there are (c + 1)^m,
# and the best is lost only where a thousand beginnings of it score better.
_SETS = 1000
# Best sets of a target among which an assignment chooses: rivals share few rows, so that one of the next sets is free.
_RIVALS = 200
# What is left of a variance, as a share, where station pairs close a loop: rounding, which a quotient must not blow up.
_LEFT = 1e-12


# Five sigmas, here and in all gates: of true rows one in two million is lost, and a false one is wrong by more.
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
        # argmin of a row without a candidate is 0: it is told from a real 0 by the infinite distance.
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
        # Most scans need no programme: each target's own best set, where no row is wanted twice, is the least sum.
        sets = scored(scan, ahead, z, clutter)
        pick = sets.chosen(sets.score.argmin(-1))
        for index in np.ndindex(pick.shape[:-2]):
            if _compete(pick[index]):
                own = Sets(sets.score[index], sets.picks[index])
                pick[index] = own.chosen(_assign(own))
        return pick

    return rule


def _compete(pick: Array) -> bool:
    """Return whether any two targets take the same candidate, picks (t, m)."""
    same = (pick[:, None] == pick[None]) & (pick[:, None] >= 0)
    return bool(same.any(-1).sum() > (pick >= 0).any(-1).sum())


def _assign(sets: Sets) -> Array:
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
    # One set for every target, the empty one among them; no row in two of the sets taken.
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


# Whole sets of rows, one or none of each channel, scored against predicted targets.


@dataclass(frozen=True, slots=True)
class Clutter:
    """What is known of detections.

    Parameters
    ----------
    detection : float
        Probability that a target is seen in a channel, between 0 and 1, both excluded.
    density : float or mapping of str to float
        Mean number of false rows of a channel and scan per unit of what is measured (SI units or radians), for all
        kinds or by kind.
    width : float
        Half width of the gate of single rows, in standard deviations of the innovation.
    """

    detection: float
    density: float | Mapping[str, float]
    width: float = 5.0

    def __post_init__(self) -> None:
        if not 0.0 < self.detection < 1.0:
            what = f"a probability of detection of {self.detection}"
            raise InvalidProblem(what, "detection", "give a number between 0 and 1")
        densities = self.density.values() if isinstance(self.density, Mapping) else (self.density,)
        if not all(np.isfinite(value) and value > 0.0 for value in densities):
            advice = "give the mean number of false rows of a channel and scan for each metre or radian, above 0"
            raise InvalidProblem(f"a density of false rows of {self.density}", "density", advice)
        check_width(self.width)

    def of(self, scan: Problem) -> Array:
        """Return the density of false rows in each channel of a scan, (m,); raise InvalidProblem for unknown kinds."""
        values = []
        for block in scan.rows:
            density = self.density.get(block.kind) if isinstance(self.density, Mapping) else self.density
            if density is None:
                raise InvalidProblem(f"no density of false {block.kind} rows is given", "density", "give one")
            values.append(np.full(block.count, float(density)))
        return np.concatenate(values)


@dataclass(frozen=True, slots=True)
class Sets:
    """Sets of candidates and how well they explain each target; the first one is empty.

    Parameters
    ----------
    score : array (..., t, q)
        Twice the negative log-likelihood ratio; infinite for sets that a target cannot have.
    picks : int array (..., t, q, m)
        For each set and channel, which candidate it holds, or -1.
    """

    score: Array
    picks: Array

    def chosen(self, number: Array) -> Array:
        """Return the picks (..., t, m) of the sets of given numbers (..., t)."""
        return np.asarray(np.take_along_axis(self.picks, number[..., None, None], axis=-2)[..., 0, :])


def scored(scan: Problem, ahead: State, z: Array, clutter: Clutter) -> Sets:
    """Return the scores of all sets of candidates within their gates; see `optloc.tracking.associate.joint`.

    Sets grow channel by channel: the density of the rows of a set is the product of those of each row given the rows
    before it. Where there are too many, the best beginnings are followed.

    Parameters
    ----------
    scan : Problem
        One row for each channel.
    ahead : State
        Predicted targets (..., t).
    z : array (..., m, c)
        Candidates.
    clutter : Clutter
        Detection and false rows.
    """
    apart, S = offsets(scan, ahead, z)
    distance = distances(apart, S, clutter.width)
    # Candidates in the gate first: channels are cut to as many as the fullest one has.
    kept = max(1, int(np.isfinite(distance).sum(-1).max(initial=0)))
    order = np.argsort(distance, axis=-1, kind="stable")[..., :kept]
    near = np.take_along_axis(np.where(np.isfinite(distance), apart, np.nan), order, axis=-1)
    gain, missed = 2.0 * np.log(clutter.detection / clutter.of(scan)), -2.0 * np.log1p(-clutter.detection)
    shape, m = near.shape[:-2], near.shape[-2]
    score, picks = np.zeros((*shape, 1)), np.zeros((*shape, 1, 0), dtype=np.int64)
    mean = np.zeros((*shape, 1, m))
    # mean and V: of the rows that are still to come, given those that a set already holds; every set has its own.
    V = np.broadcast_to(S, (*shape, m, m))[..., None, :, :]
    for i in range(m):
        s = np.maximum(V[..., i, i], _LEFT * S[..., None, i, i])
        away = near[..., None, i, :] - mean[..., i, None]
        seen = (score + np.log(2.0 * np.pi * s) - gain[i])[..., None] + away**2 / s[..., None]
        # Option 0 of a channel is to miss it, option j + 1 its j-th nearest candidate.
        both = np.concatenate([(score + missed)[..., None], np.where(np.isnan(seen), np.inf, seen)], axis=-1)
        number = _keep_best(both.reshape(*shape, -1))
        parent, option = np.divmod(number, kept + 1)
        score = np.take_along_axis(both.reshape(*shape, -1), number, axis=-1)
        picks, mean = (np.take_along_axis(part, parent[..., None], axis=-2) for part in (picks, mean))
        V = np.take_along_axis(V, parent[..., None, None], axis=-3)
        column = np.take_along_axis(order[..., i, :], np.maximum(option - 1, 0), axis=-1)
        picks = np.concatenate([picks, np.where(option > 0, column, -1)[..., None]], axis=-1)
        value = np.take_along_axis(near[..., i, :], np.maximum(option - 1, 0), axis=-1)
        used = (option > 0) & np.isfinite(score)
        across, s = V[..., :, i], np.take_along_axis(s, parent, axis=-1)
        # A set that took a row conditions the rest on it; one that missed the channel learns nothing.
        share = np.where(used[..., None], across / s[..., None], 0.0)
        mean = mean + share * np.where(used, value - mean[..., i], 0.0)[..., None]
        V = V - share[..., :, None] * across[..., None, :]
    return Sets(score, picks)


def _keep_best(score: Array) -> Array:
    """Return which of the sets (..., q) are kept, (..., p): the empty one first, and no more than can be followed."""
    possible = np.flatnonzero(np.isfinite(score).any(tuple(range(score.ndim - 1))))
    if len(possible) <= _SETS:
        return np.broadcast_to(possible, (*score.shape[:-1], len(possible)))
    # The empty set stays first: it is what every target can always have.
    key = score.copy()
    key[..., 0] = -np.inf
    return np.argsort(key, axis=-1, kind="stable")[..., :_SETS]


# Candidates against what is expected of a target.


def offsets(scan: Problem, ahead: State, z: Array) -> tuple[Array, Array]:
    """Return candidates less what is expected of each target (..., t, m, c), and S (..., t, m, m).

    Parameters
    ----------
    scan : Problem
        One row for each channel.
    ahead : State
        Predicted targets (..., t).
    z : array (..., m, c)
        Candidates.
    """
    expected = predict(scan, ahead.mean)
    apart = misfits(scan, z, expected)
    S = innovation(scan.with_rows(z=expected), ahead.mean, ahead.cov).covariance
    return apart, S


def misfits(scan: Problem, z: Array, expected: Array) -> Array:
    """Return candidates (..., m, c) less values expected of each target (..., t, m), angles wrapped: (..., t, m, c)."""
    apart = z[..., None, :, :] - expected[..., None]
    for block, start in zip(scan.rows, scan.starts, strict=True):
        if MODELS[block.kind].period is not None:
            part = slice(start, start + block.count)
            apart[..., part, :] = wrap(apart[..., part, :])
    return np.asarray(apart)


def distances(apart: Array, S: Array, width: float) -> Array:
    """Return normalised distances (..., t, m, c), infinite outside the gate and where there is no candidate.

    Parameters
    ----------
    apart, S : array
        See `offsets`.
    width : float
        Half width of the gate in standard deviations of the innovation.
    """
    distance = np.abs(apart) / np.sqrt(np.diagonal(S, axis1=-2, axis2=-1))[..., None]
    return np.where(distance <= width, distance, np.inf)
