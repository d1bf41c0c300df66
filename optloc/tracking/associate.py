"""Data association: assignment of unlabelled rows to several predicted targets.

A channel is a kind of measurement at its stations. In one scan, each channel has candidates: measured
values that come from a target or are false.

Letters: t targets, m channels, c candidates of a channel, n numbers of a state. S is the covariance of
the innovations of a target. (...) are the axes of a batch of runs.
"""

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
"""Function of a scan with one row per channel, predicted targets (..., t) and candidates (..., m, c).

It returns picks, ints (..., t, m). A pick is the index of the candidate of a target in a channel, or -1 for none."""

# Largest number of sets of a target and scan that are kept. With m channels of c candidates in the gate there are (c +
# 1)^m sets. The best set is lost only if a thousand partial sets have a better score.
_SETS = 1000
# Number of best sets of a target for an assignment: competing targets share few rows, so one of the next sets is free.
_RIVALS = 200
# Smallest conditional variance as a share of the variance. If station pairs form a loop, the variance is only rounding,
# and a division by it must stay finite.
_LEFT = 1e-12


# Five sigmas, here and in all gates: one of two million true rows is lost, and a false row has a larger error.
def nearest(width: float = 5.0) -> Associate:
    """Return the rule that takes, for each target and channel, the candidate nearest to the prediction.

    Channels and targets are independent: two targets may take the same row.

    Parameters
    ----------
    width : float
        Half width of the gate in standard deviations of the innovation, prediction included.
    """
    check_width(width)

    def rule(scan: Problem, ahead: State, z: Array) -> Array:
        """Return the picks (..., t, m) of the nearest candidates in the gate."""
        apart, S = offsets(scan, ahead, z)
        # argmin is also 0 for a row without a candidate; the infinite distance distinguishes this case.
        distance = distances(apart, S, width)
        return np.where(np.isfinite(distance).any(-1), distance.argmin(-1), -1)

    return rule


def joint(clutter: Clutter) -> Associate:
    """Return the rule that scores sets of rows, at most one row of each channel, and takes the best set of each target.

    The score of a set of n rows of m channels is chi-square + ln|2 pi S| - 2 n ln(pd / density) - 2 (m - n) ln(1 - pd).
    Here S is the joint covariance of its innovations. The score is twice the negative logarithm of the likelihood ratio
    to false rows. Targets are independent: two targets may take the same row.

    Parameters
    ----------
    clutter : Clutter
        Detection and false rows.

    References
    ----------
    Y. Bar-Shalom, T. E. Fortmann, "Tracking and Data Association" (1988), section 9.3.
    """

    def rule(scan: Problem, ahead: State, z: Array) -> Array:
        """Return the picks (..., t, m) of the best set of each target."""
        sets = scored(scan, ahead, z, clutter)
        return sets.chosen(sets.score.argmin(-1))

    return rule


def assigned(clutter: Clutter) -> Associate:
    """Return the rule that takes the best sets of all targets together; no row belongs to more than one target.

    The sum of the scores of `joint` is the exact minimum: an assignment in several dimensions. If targets compete for a
    row, an integer programme solves it.

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
        """Return the picks (..., t, m) of the best sets of all targets together."""
        # Most scans need no integer programme: if the best sets of all targets share no row, their sum is the minimum.
        sets = scored(scan, ahead, z, clutter)
        pick = sets.chosen(sets.score.argmin(-1))
        for index in np.ndindex(pick.shape[:-2]):
            if _compete(pick[index]):
                own = Sets(sets.score[index], sets.picks[index])
                pick[index] = own.chosen(_assign(own))
        return pick

    return rule


def _compete(pick: Array) -> bool:
    """Return whether any two targets take the same candidate, from picks (t, m): a candidate number, or -1."""
    same = (pick[:, None] == pick[None]) & (pick[:, None] >= 0)
    return bool(same.any(-1).sum() > (pick >= 0).any(-1).sum())


def _assign(sets: Sets) -> Array:
    """Return the numbers (t,) of one set per target with the lowest sum of scores, without common candidates.

    An integer programme finds the sets. `sets` contains score (t, q) and picks (t, q, m) of q sets for each
    target.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp
    from scipy.sparse import csr_array

    owners, number, wanted = [], [], []
    for target, scores in enumerate(sets.score):
        # The empty set is the first set and conflicts with no set: sets with a higher score are not needed.
        better = np.flatnonzero(scores < scores[0])
        better = better[np.argsort(scores[better], kind="stable")][:_RIVALS]
        numbers = np.concatenate([[0], better])
        owners.append(np.full(len(numbers), target))
        number.append(numbers)
        wanted.append(sets.picks[target, numbers])
    owner_of_set, which, pick = np.concatenate(owners), np.concatenate(number), np.concatenate(wanted)
    # `column` is a set, and `row` numbers each distinct candidate (channel and index) that a set takes.
    column, channel = np.nonzero(pick >= 0)
    _, row = np.unique(np.stack([channel, pick[column, channel]]), axis=1, return_inverse=True)
    # Constraints: one set for every target, possibly the empty set; no row in two chosen sets.
    everyone = csr_array((np.ones(len(owner_of_set)), (owner_of_set, np.arange(len(owner_of_set)))))
    once = csr_array((np.ones(len(row)), (row, column)), shape=(int(row.max()) + 1, len(owner_of_set)))
    solved = milp(
        sets.score[owner_of_set, which],
        integrality=np.ones(len(owner_of_set), dtype=np.int64),
        bounds=Bounds(0.0, 1.0),
        constraints=[LinearConstraint(everyone, 1.0, 1.0), LinearConstraint(once, -np.inf, 1.0)],
    )
    assert solved.x is not None  # the empty sets of all targets are always feasible
    # The solver may round 0 and 1. The chosen sets are sorted by target, because the result has one per target.
    taken = np.flatnonzero(solved.x > 0.5)
    return np.asarray(which[taken[np.argsort(owner_of_set[taken])]])


# Scores of sets of rows, at most one row of each channel, for predicted targets.


@dataclass(frozen=True, slots=True)
class Clutter:
    """Detection probability and density of false rows.

    Parameters
    ----------
    detection : float
        Probability that a target is detected in a channel, between 0 and 1, both excluded.
    density : float or mapping of str to float
        Mean number of false rows of a channel and scan per unit of the measurement (SI units or radians), for all kinds
        or by kind.
    width : float
        Half width of the gate of single rows, in standard deviations of the innovation.
    """

    detection: float
    density: float | Mapping[str, float]
    width: float = 5.0

    def __post_init__(self) -> None:
        """Raise InvalidProblem for a probability, density or width out of range."""
        if not 0.0 < self.detection < 1.0:
            what = f"the probability of detection is {self.detection}"
            raise InvalidProblem(what, "detection", "give a number between 0 and 1")
        densities = self.density.values() if isinstance(self.density, Mapping) else (self.density,)
        if not all(np.isfinite(value) and value > 0.0 for value in densities):
            advice = "give the mean number of false rows of a channel and scan for each metre or radian, above 0"
            raise InvalidProblem(f"the density of false rows is {self.density}", "density", advice)
        check_width(self.width)

    def of(self, scan: Problem) -> Array:
        """Return the density of false rows in each channel of a scan, (m,), per metre or radian.

        A kind without a density raises InvalidProblem.
        """
        values = []
        for block in scan.rows:
            density = self.density.get(block.kind) if isinstance(self.density, Mapping) else self.density
            if density is None:
                raise InvalidProblem(
                    f"no density of false {block.kind} rows is given", "density", "add the kind to the mapping"
                )
            values.append(np.full(block.count, float(density)))
        return np.concatenate(values)


@dataclass(frozen=True, slots=True)
class Sets:
    """Sets of candidates with their scores for each target; the first set is empty.

    - score (..., t, q): twice the negative log-likelihood ratio; infinite for impossible sets of a target.
    - picks (..., t, q, m): candidate of each set and channel, or -1.
    """

    score: Array
    picks: Array

    def chosen(self, number: Array) -> Array:
        """Return the picks (..., t, m) of the sets with given numbers (..., t)."""
        return np.asarray(np.take_along_axis(self.picks, number[..., None, None], axis=-2)[..., 0, :])


def scored(scan: Problem, ahead: State, z: Array, clutter: Clutter) -> Sets:
    """Return the scores of all sets of candidates within their gates; see `optloc.tracking.associate.joint`.

    `scan` has one row for each channel. `ahead` contains the predicted targets (..., t), and `z` (..., m, c)
    the candidates. `clutter` gives detection probability and false rows.

    Sets grow channel by channel: the density of a set is the product of the densities of each row given the
    rows before it. If there are too many sets, only the best partial sets are kept.
    """
    apart, S = offsets(scan, ahead, z)
    distance = distances(apart, S, clutter.width)
    # Candidates in the gate come first; then channels are cut to the largest number of candidates in a gate.
    kept = max(1, int(np.isfinite(distance).sum(-1).max(initial=0)))
    order = np.argsort(distance, axis=-1, kind="stable")[..., :kept]
    near = np.take_along_axis(np.where(np.isfinite(distance), apart, np.nan), order, axis=-1)
    gain, missed = 2.0 * np.log(clutter.detection / clutter.of(scan)), -2.0 * np.log1p(-clutter.detection)
    shape, m = near.shape[:-2], near.shape[-2]
    score, picks = np.zeros((*shape, 1)), np.zeros((*shape, 1, 0), dtype=np.int64)
    mean = np.zeros((*shape, 1, m))
    # mean and V belong to the rows of the next channels, given the rows of a set; every set has separate values.
    V = np.broadcast_to(S, (*shape, m, m))[..., None, :, :]
    for i in range(m):
        # s is the variance of channel i given the rows of a set; `away` are the candidates minus their mean.
        s = np.maximum(V[..., i, i], _LEFT * S[..., None, i, i])
        away = near[..., None, i, :] - mean[..., i, None]
        seen = (score + np.log(2.0 * np.pi * s) - gain[i])[..., None] + away**2 / s[..., None]
        # Option 0 of a channel is a missed detection, option j + 1 its j-th nearest candidate.
        both = np.concatenate([(score + missed)[..., None], np.where(np.isnan(seen), np.inf, seen)], axis=-1)
        number = _keep_best(both.reshape(*shape, -1))
        # `parent` is the set that is extended, and `option` is its choice in channel i.
        parent, option = np.divmod(number, kept + 1)
        score = np.take_along_axis(both.reshape(*shape, -1), number, axis=-1)
        picks, mean = (np.take_along_axis(part, parent[..., None], axis=-2) for part in (picks, mean))
        V = np.take_along_axis(V, parent[..., None, None], axis=-3)
        column = np.take_along_axis(order[..., i, :], np.maximum(option - 1, 0), axis=-1)
        picks = np.concatenate([picks, np.where(option > 0, column, -1)[..., None]], axis=-1)
        value = np.take_along_axis(near[..., i, :], np.maximum(option - 1, 0), axis=-1)
        used = (option > 0) & np.isfinite(score)
        across, s = V[..., :, i], np.take_along_axis(s, parent, axis=-1)
        # A set with a row conditions the remaining channels on it; a missed detection has no information.
        share = np.where(used[..., None], across / s[..., None], 0.0)
        mean = mean + share * np.where(used, value - mean[..., i], 0.0)[..., None]
        V = V - share[..., :, None] * across[..., None, :]
    return Sets(score, picks)


def _keep_best(score: Array) -> Array:
    """Return the numbers (..., p) of the best p of q sets: the empty set first, at most `_SETS` sets.

    `score` (..., q) is small for likely sets; sets that are impossible for all targets are omitted.
    """
    possible = np.flatnonzero(np.isfinite(score).any(tuple(range(score.ndim - 1))))
    if len(possible) <= _SETS:
        return np.broadcast_to(possible, (*score.shape[:-1], len(possible)))
    # The empty set stays first, because it is possible for every target.
    key = score.copy()
    key[..., 0] = -np.inf
    return np.argsort(key, axis=-1, kind="stable")[..., :_SETS]


# Differences between candidates and predicted measurements.


def offsets(scan: Problem, ahead: State, z: Array) -> tuple[Array, Array]:
    """Return candidates minus predicted measurements of each target (..., t, m, c), and S (..., t, m, m).

    `scan` has one row for each channel. `ahead` contains the predicted targets (..., t), and `z` (..., m, c)
    the candidates. The units are metres, radians, m/s or ratios, as in `z`.
    """
    expected = predict(scan, ahead.mean)
    apart = misfits(scan, z, expected)
    S = innovation(scan.with_rows(z=expected), ahead.mean, ahead.cov).covariance
    return apart, S


def misfits(scan: Problem, z: Array, expected: Array) -> Array:
    """Return candidates (..., m, c) minus predicted values (..., t, m) as (..., t, m, c), with angles wrapped.

    `z` are the candidates of a scan, and `expected` are the predicted values of each target.
    """
    apart = z[..., None, :, :] - expected[..., None]
    for block, start in zip(scan.rows, scan.starts, strict=True):
        if MODELS[block.kind].period is not None:
            part = slice(start, start + block.count)
            apart[..., part, :] = wrap(apart[..., part, :])
    return np.asarray(apart)


def distances(apart: Array, S: Array, width: float) -> Array:
    """Return normalised distances (..., t, m, c) in sigmas; infinite outside the gate and without a candidate.

    `apart` and `S` are the results of `offsets`. `width` is the half width of the gate in sigmas.
    """
    distance = np.abs(apart) / np.sqrt(np.diagonal(S, axis1=-2, axis2=-1))[..., None]
    return np.where(distance <= width, distance, np.inf)
