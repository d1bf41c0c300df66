"""Evidence against each group of rows: the decrease of the cost without the group, to first order, and its error.

A group g with an error shifts its rows by an unknown e_g. With residuals y, weights P = R^-1 and Jacobian J of the full
fit, Q = P - P J (J'P J)^-1 J'P. Exclusion of the group lowers the cost by u'Q_gg^-1 u with u = (Q y)_g. The estimated
error is Q_gg^-1 u with the covariance Q_gg^-1. Priors are rows too.

Arrays have q rows, including the rows of priors, n shared unknowns, and l local unknowns of each epoch.

W. Baarda, "A testing procedure for use in geodetic networks" (1968); P. J. G. Teunissen, "Testing theory" (2006), eqs.
3.21 and 4.23.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optloc.base import linalg
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.kernels.sums import equations_at
from optloc.linear.normal import Linear, Normal, linearise, marginal, step
from optloc.linear.walks import walks
from optloc.model_checks.groups import Group
from optloc.problem.arrival_times import as_arrivals, shared_places
from optloc.problem.explanations import Suspect
from optloc.problem.layout import Layout
from optloc.problem.problem import Problem

# A component of an error is determined if the diagonal of Q Q^+ is one there; a larger difference than this is not
# rounding.
_UNDETERMINED = 1e-6
# Eigenvalue of Q, in units of the weights, below which the other rows have no information; it exceeds the rounding of
# zero.
_ROUNDING = 1e-9
# Largest number of rows and priors for a dense P: a sparse array takes more time there.
_DENSE = 128
# Probability of a chi-square tail near the underflow of floating-point numbers, with a margin for later operations.
_TINY = 1e-290


@dataclass(frozen=True, slots=True)
class Influence:
    """Matrix Q of one problem and the vector Q y, in factors: Q = P - S S' - T T', with T T' only within each epoch.

    - pull (q,): Q y of the rows, then of the means of the priors.
    - precision (q, q): P; sparse for many rows.
    - shared (q, n): S of the shared unknowns.
    - local (q, l): T of the unknowns of each epoch.
    - epoch (q,): epoch of each row; -1 for priors.
    - prior: for the number of each prior, the numbers of the rows that it adds.
    - deviation (n, n): a square root of the covariance of the shared unknowns.
    """

    pull: Array
    precision: Any
    shared: Array
    local: Array
    epoch: Array
    prior: dict[int, Array]
    deviation: Array

    def rows(self, group: Group) -> Array:
        """Return the row numbers of a group; for a prior, the numbers of the rows that it adds."""
        return np.array(group.rows) if group.prior < 0 else self.prior[group.prior]

    def block(self, rows: Array) -> Array:
        """Return the blocks of Q (..., r, r) of sets of rows (..., r)."""
        i, j = np.broadcast_arrays(rows[..., :, None], rows[..., None, :])
        precision = np.asarray(self.precision[i.ravel(), j.ravel()]).reshape(i.shape)
        shared, local = self.shared[rows], self.local[rows]
        # priors have epoch -1 and no local unknowns, so their product is zero
        same = self.epoch[i] == self.epoch[j]
        lost = shared @ np.swapaxes(shared, -1, -2) + same * (local @ np.swapaxes(local, -1, -2))
        return np.asarray(precision - lost)

    def root(self, rows: Array) -> Array:
        """Return a matrix A (..., r, r) with A A' the pseudo-inverse of Q for sets of rows (..., r).

        A column of A is zero if the other rows have no information about this combination of rows.
        """
        weight = np.asarray(self.precision.diagonal())[rows]
        scale = 1.0 / np.sqrt(np.where(weight > 0.0, weight, 1.0))
        values, vectors = np.linalg.eigh(self.block(rows) * scale[..., :, None] * scale[..., None, :])
        kept = values > _ROUNDING
        lengths = np.where(kept, 1.0 / np.sqrt(np.where(kept, values, 1.0)), 0.0)
        return np.asarray(scale[..., :, None] * vectors * lengths[..., None, :])


@dataclass(frozen=True, slots=True)
class Error:
    """Estimated error of a group.

    - value, sigma (q,): error of each row of the group (measured minus true) and its standard deviation; infinite if
      the other rows do not determine the error.
    - statistic: squared length of the error in its standard deviations. To first order, the cost rises by this value if
      the group is included again.
    - dof: number of components that the other rows determine.
    """

    value: Array
    sigma: Array
    statistic: float
    dof: int

    @property
    def log_tail(self) -> float:
        """Return the logarithm of the p-value of the estimate: far below 0 for a clear error, 0 if `dof` is 0."""
        return float(log_tail(np.array(self.statistic), np.array(self.dof)))


def influence(problem: Problem, x: Array, dropped: frozenset[int] = frozenset()) -> Influence:
    """Return the influence of the rows and priors of a flat batch of one problem at a vector (size,).

    See `influences` for arguments and exceptions.
    """
    return influences(problem, x[None], dropped)[0]


def influences(problem: Problem, x: Array, dropped: frozenset[int] = frozenset()) -> list[Influence]:
    """Return the influence of the rows and priors of each problem of a batch of N problems.

    The problems are linearised at `x` (N, size), which need not be minima. The noise must not correlate epochs.
    `dropped` are the numbers of priors to exclude.

    Raises
    ------
    InvalidProblem
        If a bias is a random walk: rows of one epoch then have information about the next epoch.
    """
    if walks(problem):
        what = f"the walk {walks(problem)[0].name!r} correlates epochs, but errors are estimated epoch by epoch"
        raise InvalidProblem(what, "biases", "use a loss such as 'huber', or make the bias a spline")
    layout, size = problem.layout, len(x)
    numbers = [j for j, p in enumerate(problem.priors) if j not in dropped and layout.find(p.name)[1]]
    problem = replace(problem, priors=tuple(p for j, p in enumerate(problem.priors) if j not in dropped))
    # whitening is applied to neither: Q needs P and J separately
    linear, equations = linearise(problem, x), equations_at(problem, x)
    selections, means, prior_precisions = _prior_rows(problem)
    # first row number of each prior: priors come after the m rows
    cuts = np.cumsum([problem.count, *(len(pick) for pick in selections)])
    prior_count = int(cuts[-1]) - problem.count
    present = np.broadcast_to(problem.weight > 0.0, linear.residual.shape)
    n = layout.n_shared
    prior_residuals = [mean - x[:, :n] @ pick.T for mean, pick in zip(means, selections, strict=True)]
    residual = np.concatenate([np.where(present, linear.residual, 0.0), *prior_residuals], axis=1)
    picked = (np.broadcast_to(pick, (size, *pick.shape)) for pick in selections)
    # derivatives of all rows by the shared unknowns (A) and by the local unknowns of their epoch (B)
    A = np.concatenate([linear.shared, *picked], axis=1)
    B = np.concatenate([linear.local, np.zeros((size, prior_count, layout.n_local))], axis=1)
    epoch = np.concatenate([problem.epoch, np.full(prior_count, -1)])
    root, shared, local = _roots(equations, A, B, epoch)
    # x need not be a minimum: Q y is the residual after one more step
    move, _ = step(equations, np.zeros(size))
    by_run, by_epoch = layout.split(move)
    fitted = (A @ by_run[..., None])[..., 0] + (B * by_epoch[:, epoch]).sum(-1)
    prior = {j: np.arange(a, b) for j, a, b in zip(numbers, cuts, cuts[1:], strict=False)}
    return [
        Influence(own @ rest, own, own @ by_shared, own @ by_local, epoch, prior, deviation)
        for own, rest, by_shared, by_local, deviation in zip(
            _precisions(linear, problem.count, prior_precisions, size),
            residual - fitted,
            shared,
            local,
            root,
            strict=True,
        )
    ]


def _prior_rows(problem: Problem) -> tuple[list[Array], list[Array], list[Array]]:
    """Return selection matrices (p, n), means (N or 1, p) and precisions (p, p) of the priors on shared unknowns.

    Each prior refers to p of the n shared unknowns.
    """
    layout = problem.layout
    selections, means, precisions = [], [], []
    for prior in problem.priors:
        slot, shared = layout.find(prior.name)
        if shared:
            selections.append(np.eye(layout.n_shared)[slot.start : slot.start + slot.size])
            means.append(prior.mean.reshape(-1, slot.size))
            precisions.append(linalg.inverse(prior.covariance.reshape(slot.size, slot.size))[0])
    return selections, means, precisions


def _precisions(linear: Linear, count: int, prior_precisions: Sequence[Array], size: int) -> list[Any]:
    """Return the inverse covariances (q, q) of the rows and priors of each problem; absent rows are zero.

    `count` is the number of rows without priors, `prior_precisions` the precisions of the priors, and `size` the number
    of problems. The result is dense for few rows and sparse for many rows. `linear` are the linearised rows with their
    whitening matrices.
    """
    parts = []
    for whitener in linear.noise:
        # with a whitening matrix W, the inverse covariance is W'W
        weights = np.swapaxes(whitener.matrix, -1, -2) @ whitener.matrix
        g, r = whitener.row.shape
        weights = np.broadcast_to(weights, (size, g, r, r)).reshape(size, -1)
        i, j = np.broadcast_arrays(whitener.row[:, :, None], whitener.row[:, None, :])
        parts.append((weights, i.ravel(), j.ravel()))
    for block in prior_precisions:
        i, j = (index.ravel() + count for index in np.indices(block.shape))
        parts.append((np.broadcast_to(block.ravel(), (size, block.size)), i, j))
        count += len(block)
    values, i, j = (np.concatenate(part, axis=-1) for part in zip(*parts, strict=True))
    if count <= _DENSE:
        dense = np.zeros((size, count, count))
        dense[:, i, j] = values
        return list(dense)
    from scipy.sparse import coo_array

    return [coo_array((weights, (i, j)), shape=(count, count)).tocsr() for weights in values]


def _roots(equations: Normal, A: Array, B: Array, epoch: Array) -> tuple[Array, Array, Array]:
    """Return roots (N, n, n) of the covariance of the shared unknowns, and factors (N, q, n) and (N, q, l).

    The products of the factors with their transposes sum to J (J'P J)^-1 J', the second only within each epoch. `A` (N,
    q, n) and `B` (N, q, l) are the derivatives by shared and local unknowns, and `epoch` (q,) is -1 for priors.
    `equations` are the normal equations of the problems.
    """
    information, _, _ = marginal(equations)
    root, _ = linalg.root(information)
    if not B.shape[-1]:
        return root, A @ root, B
    inner, _ = linalg.root(equations.local)
    gain = inner @ np.swapaxes(inner, -1, -2) @ np.swapaxes(equations.cross, -1, -2)
    # J minus the part that the local unknowns of the epoch explain: Schur complement, row by row
    eliminated = A - (B[..., None, :] @ gain[:, epoch])[..., 0, :]
    return root, eliminated @ root, (B[..., None, :] @ inner[:, epoch])[..., 0, :]


def log_tail(statistic: Array, dof: Array) -> Array:
    """Return the logarithm of the tail probability of a chi-square, also for small probabilities.

    `statistic` is the chi-square, and `dof` its degrees of freedom. Below the range of floating-point numbers, the
    leading term of the asymptotic series is used (Abramowitz, Stegun 1964, eq. 6.5.32). With `dof` of zero, the result
    is 0, a probability of one.
    """
    from scipy.special import gammaincc, gammaln

    half, k = np.maximum(np.asarray(statistic, dtype=float), 0.0) / 2, np.maximum(dof, 1) / 2
    tail = gammaincc(k, half)
    large = -half + (k - 1.0) * np.log(np.maximum(half, 1.0)) - gammaln(k)
    return np.where(np.asarray(dof) > 0, np.where(tail > _TINY, np.log(np.maximum(tail, _TINY)), large), 0.0)


def significance(at: Influence, groups: Sequence[Group]) -> Array:
    """Return the logarithms (G,) of the p-values of the decrease of the cost without each of G groups.

    The p-value of a group is small if its exclusion lowers the cost much.
    """
    return log_tail(*drops(at, [at.rows(group) for group in groups]))


def drops(at: Influence, rows: Sequence[Array]) -> tuple[Array, Array]:
    """Return the first-order decrease of the cost without each of G sets of rows, and its degrees of freedom, (G,).

    `at` is the influence of all rows, and `rows` are the row numbers of each set.
    """
    drop, dof = np.zeros(len(rows)), np.zeros(len(rows), dtype=np.int64)
    # handle sets of one size together: thousands of small eigenvalue problems are one batch
    sizes = np.array([len(own) for own in rows])
    for size in np.unique(sizes):
        members = np.flatnonzero(sizes == size)
        index = np.stack([rows[i] for i in members.tolist()])
        root = at.root(index)
        drop[members] = ((np.swapaxes(root, -1, -2) @ at.pull[index][..., None])[..., 0] ** 2).sum(-1)
        dof[members] = (root != 0.0).any(-2).sum(-1)
    return drop, dof


def errors(at: Influence, groups: Sequence[Group]) -> list[Error]:
    """Return the estimated error of each of some groups, if all of them have errors at once.

    A component that the other rows do not determine has an infinite sigma.
    """
    rows = [at.rows(group) for group in groups]
    index = np.concatenate(rows)
    block, root = at.block(index), at.root(index)
    covariance = root @ root.T
    known = np.abs(np.diagonal(covariance @ block) - 1.0) < _UNDETERMINED
    value, sigma = covariance @ at.pull[index], np.where(known, np.sqrt(np.diagonal(covariance)), np.inf)
    out = []
    for numbers in np.split(np.arange(len(index)), np.cumsum([len(one) for one in rows])[:-1]):
        # the statistic of a group uses only its determined components and their covariance
        inside = numbers[known[numbers]]
        information, _ = linalg.root(covariance[np.ix_(inside, inside)]) if len(inside) else (np.zeros((0, 0)), None)
        squared = ((information.T @ value[inside]) ** 2).sum()
        out.append(Error(value[numbers], sigma[numbers], float(squared), len(inside)))
    return out


# Reliability: errors that the test does not detect.

NOTICEABLE = 7.0**0.5 + 1.645
"""Size of an error, in standard deviations, that remains undetected in one of twenty cases.

A search for suspects detects an error that changes the cost by 7: the penalty of a row, 16, minus the gap of 9 of
listed explanations. The noise adds 1.645."""


@dataclass(frozen=True, slots=True)
class Reliability:
    """Smallest detectable errors of single stations, and the effect of undetected errors on the position.

    Parameters
    ----------
    names : tuple of G str
        Station and kind.
    least : array (G,)
        Error of all rows of the station and kind that is detected in 95 % of all cases, metres, radians or ratios;
        infinite if the other rows cannot check it.
    shift : array (G,)
        Shift of the position by this error, metres; infinite if an undetected error of any size shifts the position.
    """

    names: tuple[str, ...]
    least: Array
    shift: Array


def reliability(problem: Problem, x: Array, suspects: Sequence[Suspect] = ()) -> Reliability:
    """Return the smallest detectable error of each station, and the shift of the position by an undetected error.

    An error e of rows c changes the cost by the noncentrality e^2 c'Q c. The error is detected if the cost without
    these rows decreases by more than a threshold. The threshold is the penalty of one exclusion minus the gap of listed
    explanations.

    Parameters
    ----------
    problem : Problem
        A single problem.
    x : array (size,)
        Parameters for the linearisation: a fix or a true value.
    suspects : sequence of Suspect
        Suspects that the fix excluded, `fix.suspects`; the result is for the remaining rows.

    Returns
    -------
    Reliability
        For each station with rows, and each kind that it measures. Differences whose noise comes from arrival times
        count as arrival times.

    References
    ----------
    W. Baarda, "A testing procedure for use in geodetic networks" (1968), sections 4 and 5: internal and external
    reliability.
    """
    flat = problem.flat()
    made = as_arrivals(flat)
    work = flat if made is None else made.problem
    origin = tuple(np.arange(flat.count)[:, None]) if made is None else made.origin
    for one in suspects:
        work = work.with_rows(weight=np.where(_rows_of_suspect(work, origin, one), 0.0, work.weight))
    at = influence(work, embed(flat.layout, work.layout, np.asarray(x, dtype=float)))
    channels = _channels(work)
    # c'Q c of each channel, for an error of one unit in all its rows
    seen = np.array([at.block(rows).sum() for _, rows in channels])
    determined = np.array(
        [at.block(rows).sum() > _ROUNDING * at.precision[rows][:, rows].sum() for _, rows in channels]
    )
    least = np.where(determined, NOTICEABLE / np.sqrt(np.where(determined, seen, 1.0)), np.inf)
    # shift of the shared unknowns by such an error
    moved = np.stack([at.deviation @ at.shared[rows].sum(0) for _, rows in channels])
    places = [slot.start + i for slot in work.layout.shared if slot.name == "position" for i in range(slot.size)]
    pull = np.linalg.norm(moved[:, places], axis=-1)
    # an error that does not shift the position may have any size
    shift = np.where(pull > 0.0, least * np.where(pull > 0.0, pull, 1.0), 0.0)
    return Reliability(tuple(name for name, _ in channels), least, shift)


def _rows_of_suspect(work: Problem, origin: Sequence[Array], suspect: Suspect) -> Array:
    """Return a mask (m,) of the rows of a suspect; the problem may have arrival times instead of differences.

    `origin` has the numbers of the original rows from which each row comes. `work` is the problem with m rows.
    """
    if suspect.group == "station":
        a, b = (np.concatenate([getattr(rows, end) for rows in work.rows]) for end in "ab")
        number = work.stations.names.index(suspect.name.removeprefix("station "))
        return np.asarray((a == number) | (b == number))
    # for a suspect row, mark the rows that come from it alone; an arrival comes from several rows
    return np.array([len(own) == 1 and int(own[0]) in suspect.rows for own in origin])


def embed(layout: Layout, other: Layout, x: Array) -> Array:
    """Return the vector `x` (size,) of `layout` in the order of `other`, a layout with more unknowns.

    The additional unknowns are zero: the rows are linear in them.
    """
    out, (shared, local) = np.zeros(other.size), layout.split(x)
    out[shared_places(layout, other)] = shared
    by_epoch = other.split(out)[1]
    for slot in layout.local:
        start = other.find(slot.name)[0].start
        by_epoch[:, start : start + slot.size] = local[:, slot.start : slot.start + slot.size]
    out[other.n_shared :] = by_epoch.ravel()
    return out


def _channels(problem: Problem) -> list[tuple[str, Array]]:
    """Return the name and the row numbers of each channel, a station together with a kind of rows.

    Rows without a station and rows with weight zero belong to no channel. A difference belongs to its first station.
    """
    present, out = problem.weight.reshape(-1)[: problem.count] > 0.0, []
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        inside = present[start : start + rows.count] & (rows.a >= 0)
        names = ((i, f"{rows.kind} of {problem.stations.names[i]}") for i in np.unique(rows.a[inside]))
        out += [(name, start + np.flatnonzero(inside & (rows.a == i))) for i, name in names]
    return out
