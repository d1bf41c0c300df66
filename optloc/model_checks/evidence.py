"""How much the data speak against each group: the drop of the cost without it, to first order, and its error.

A group g in error shifts its rows by an unknown e_g. With residuals y, weights P = R^-1 and Jacobian J of the full
fit, Q = P - P J (J'P J)^-1 J'P; leaving the group out lowers the cost by u'Q_gg^-1 u with u = (Q y)_g, and its error is
Q_gg^-1 u with covariance Q_gg^-1 (Baarda 1968, "A testing procedure for use in geodetic networks"; Teunissen 2006,
"Testing theory", eqs. 3.21 and 4.23). Priors are rows too.
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

# A component of an error is known where Q Q^+ has a one on its diagonal: what is less by more than rounding is open.
_OPEN = 1e-6
# Eigenvalue of Q, in units of the weights, below which the other rows say nothing: above what rounding leaves of a
# zero.
_NOTHING = 1e-9
# Rows and priors up to which P is a plain array: the square takes less time there than a sparse array.
_DENSE = 128
# Where the tail of a chi-square leaves the range of floating-point numbers, with room for what is computed from it.
_TINY = 1e-290


@dataclass(frozen=True, slots=True)
class Influence:
    """The matrix Q of one problem and Q y, in parts: Q = P - S S' - T T' within each epoch.

    Parameters
    ----------
    pull : array (q,)
        Q y, of the rows and then of the means of the priors.
    precision : array (q, q), sparse for many rows
        P.
    shared : array (q, n)
        S, of the shared unknowns.
    local : array (q, l)
        T, of the unknowns of each epoch.
    epoch : int array (q,)
        Epoch of each row; -1 of priors.
    prior : dict of int to array
        Rows of each prior by its number.
    deviation : array (n, n)
        Its product with its transpose is the covariance of the shared unknowns.
    """

    pull: Array
    precision: Any
    shared: Array
    local: Array
    epoch: Array
    prior: dict[int, Array]
    deviation: Array

    def rows(self, group: Group) -> Array:
        """Return the rows of a group, (q,)."""
        return np.array(group.rows) if group.prior < 0 else self.prior[group.prior]

    def block(self, rows: Array) -> Array:
        """Return Q (..., r, r) of sets of rows (..., r)."""
        i, j = np.broadcast_arrays(rows[..., :, None], rows[..., None, :])
        precision = np.asarray(self.precision[i.ravel(), j.ravel()]).reshape(i.shape)
        shared, local = self.shared[rows], self.local[rows]
        # priors are of epoch -1: their rows have no local unknowns, so that their product is zero
        same = self.epoch[i] == self.epoch[j]
        lost = shared @ np.swapaxes(shared, -1, -2) + same * (local @ np.swapaxes(local, -1, -2))
        return np.asarray(precision - lost)

    def root(self, rows: Array) -> Array:
        """Return A with A A' the pseudo-inverse of Q (..., r, r) of sets of rows; zero columns where nothing tells."""
        weight = np.asarray(self.precision.diagonal())[rows]
        scale = 1.0 / np.sqrt(np.where(weight > 0.0, weight, 1.0))
        values, vectors = np.linalg.eigh(self.block(rows) * scale[..., :, None] * scale[..., None, :])
        kept = values > _NOTHING
        lengths = np.where(kept, 1.0 / np.sqrt(np.where(kept, values, 1.0)), 0.0)
        return np.asarray(scale[..., :, None] * vectors * lengths[..., None, :])


@dataclass(frozen=True, slots=True)
class Error:
    """The estimated error of a group.

    Parameters
    ----------
    value, sigma : array (q,)
        Of each of its rows, measured less true, and standard deviations; infinite where nothing else tells.
    statistic : float
        Its squared length in its own standard deviations: what the cost rises by, to first order, with the group back.
    dof : int
        How many of its components the other rows tell.
    """

    value: Array
    sigma: Array
    statistic: float
    dof: int

    @property
    def log_tail(self) -> float:
        """Return the logarithm of the probability of an estimate at least this far from zero if there is no error."""
        return float(log_tail(np.array(self.statistic), np.array(self.dof)))


def influence(problem: Problem, x: Array, dropped: frozenset[int] = frozenset()) -> Influence:
    """Return the influence of the rows and priors of a flat batch of one problem at a vector (size,).

    See `influences`, also for what it raises.
    """
    return influences(problem, x[None], dropped)[0]


def influences(problem: Problem, x: Array, dropped: frozenset[int] = frozenset()) -> list[Influence]:
    """Return the influence of the rows and priors of each problem of a batch.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems, whose noise ties no epochs.
    x : array (N, size)
        Where they are linearised; these need not be minima.
    dropped : frozenset of int
        Priors to do without.

    Raises
    ------
    InvalidProblem
        Where a bias walks: rows of one epoch then say something of the next.
    """
    if walks(problem):
        what = f"the walk {walks(problem)[0].name!r} ties each epoch to the next, and errors are weighed epoch by epoch"
        raise InvalidProblem(what, "biases", "fix with a loss such as 'huber', or let the bias be a spline")
    layout, size = problem.layout, len(x)
    numbers = [j for j, p in enumerate(problem.priors) if j not in dropped and layout.find(p.name)[1]]
    problem = replace(problem, priors=tuple(p for j, p in enumerate(problem.priors) if j not in dropped))
    # whitened in neither: Q needs P and J apart
    linear, equations = linearise(problem, x), equations_at(problem, x)
    picks, means, inner = _prior_rows(problem)
    cuts = np.cumsum([problem.count, *(len(pick) for pick in picks)])
    more = int(cuts[-1]) - problem.count
    present = np.broadcast_to(problem.weight > 0.0, linear.residual.shape)
    n = layout.n_shared
    left = [mean - x[:, :n] @ pick.T for mean, pick in zip(means, picks, strict=True)]
    residual = np.concatenate([np.where(present, linear.residual, 0.0), *left], axis=1)
    picked = (np.broadcast_to(pick, (size, *pick.shape)) for pick in picks)
    A = np.concatenate([linear.shared, *picked], axis=1)
    B = np.concatenate([linear.local, np.zeros((size, more, layout.n_local))], axis=1)
    epoch = np.concatenate([problem.epoch, np.full(more, -1)])
    root, shared, local = _roots(equations, A, B, epoch)
    # x need not be a minimum: Q y is the residual after one more step
    move, _ = step(equations, np.zeros(size))
    by_run, by_epoch = layout.split(move)
    fitted = (A @ by_run[..., None])[..., 0] + (B * by_epoch[:, epoch]).sum(-1)
    prior = {j: np.arange(a, b) for j, a, b in zip(numbers, cuts, cuts[1:], strict=False)}
    return [
        Influence(own @ rest, own, own @ by_shared, own @ by_local, epoch, prior, deviation)
        for own, rest, by_shared, by_local, deviation in zip(
            _precisions(linear, problem.count, inner, size), residual - fitted, shared, local, root, strict=True
        )
    ]


def _prior_rows(problem: Problem) -> tuple[list[Array], list[Array], list[Array]]:
    """Return the picked unknowns (p, n), means (N or 1, p) and precisions (p, p) of the priors on shared unknowns."""
    layout = problem.layout
    picks, means, inner = [], [], []
    for prior in problem.priors:
        slot, shared = layout.find(prior.name)
        if shared:
            picks.append(np.eye(layout.n_shared)[slot.start : slot.start + slot.size])
            means.append(prior.mean.reshape(-1, slot.size))
            inner.append(linalg.inverse(prior.covariance.reshape(slot.size, slot.size))[0])
    return picks, means, inner


def _precisions(linear: Linear, count: int, inner: Sequence[Array], size: int) -> list[Any]:
    """Return the inverse covariances (q, q) of the rows and priors of each problem; absent rows are zero.

    Arrays for few rows, sparse arrays for many.
    """
    parts = []
    for whitener in linear.noise:
        own = np.swapaxes(whitener.matrix, -1, -2) @ whitener.matrix
        g, r = whitener.row.shape
        own = np.broadcast_to(own, (size, g, r, r)).reshape(size, -1)
        i, j = np.broadcast_arrays(whitener.row[:, :, None], whitener.row[:, None, :])
        parts.append((own, i.ravel(), j.ravel()))
    for block in inner:
        i, j = (index.ravel() + count for index in np.indices(block.shape))
        parts.append((np.broadcast_to(block.ravel(), (size, block.size)), i, j))
        count += len(block)
    values, i, j = (np.concatenate(part, axis=-1) for part in zip(*parts, strict=True))
    if count <= _DENSE:
        dense = np.zeros((size, count, count))
        dense[:, i, j] = values
        return list(dense)
    from scipy.sparse import coo_array

    return [coo_array((own, (i, j)), shape=(count, count)).tocsr() for own in values]


def _roots(equations: Normal, A: Array, B: Array, epoch: Array) -> tuple[Array, Array, Array]:
    """Return roots (N, n, n) of (J'P J)^-1, and factors (N, q, n), (N, q, l) of J (J'P J)^-1 J', locals eliminated."""
    information, _, _ = marginal(equations)
    root, _ = linalg.root(information)
    if not B.shape[-1]:
        return root, A @ root, B
    inner, _ = linalg.root(equations.local)
    gain = inner @ np.swapaxes(inner, -1, -2) @ np.swapaxes(equations.cross, -1, -2)
    # J without what the unknowns of its own epoch explain: Schur's complement, row by row
    left = A - (B[..., None, :] @ gain[:, epoch])[..., 0, :]
    return root, left @ root, (B[..., None, :] @ inner[:, epoch])[..., 0, :]


def log_tail(statistic: Array, dof: Array) -> Array:
    """Return the logarithm of the probability of a chi-square at least this large, also where it is tiny.

    Beyond the range of floating-point numbers by the leading term of its asymptotic series (Abramowitz, Stegun 1964,
    eq. 6.5.32).
    """
    from scipy.special import gammaincc, gammaln

    half, k = np.maximum(np.asarray(statistic, dtype=float), 0.0) / 2, np.maximum(dof, 1) / 2
    tail = gammaincc(k, half)
    large = -half + (k - 1.0) * np.log(np.maximum(half, 1.0)) - gammaln(k)
    return np.where(np.asarray(dof) > 0, np.where(tail > _TINY, np.log(np.maximum(tail, _TINY)), large), 0.0)


def significance(at: Influence, groups: Sequence[Group]) -> Array:
    """Return the logarithms (G,) of the probabilities of the drop of the cost without each group."""
    return log_tail(*drops(at, [at.rows(group) for group in groups]))


def drops(at: Influence, rows: Sequence[Array]) -> tuple[Array, Array]:
    """Return the drop of the cost without each of G sets of rows, to first order, and its degrees of freedom, (G,)."""
    drop, dof = np.zeros(len(rows)), np.zeros(len(rows), dtype=np.int64)
    # sets of one size at a time: thousands of small eigenvalue problems as one batch
    sizes = np.array([len(own) for own in rows])
    for size in np.unique(sizes):
        members = np.flatnonzero(sizes == size)
        index = np.stack([rows[i] for i in members.tolist()])
        root = at.root(index)
        drop[members] = ((np.swapaxes(root, -1, -2) @ at.pull[index][..., None])[..., 0] ** 2).sum(-1)
        dof[members] = (root != 0.0).any(-2).sum(-1)
    return drop, dof


def errors(at: Influence, groups: Sequence[Group]) -> list[Error]:
    """Return the estimated error of each of some groups that are all in error."""
    rows = [at.rows(group) for group in groups]
    index = np.concatenate(rows)
    block, root = at.block(index), at.root(index)
    covariance = root @ root.T
    known = np.abs(np.diagonal(covariance @ block) - 1.0) < _OPEN
    value, sigma = covariance @ at.pull[index], np.where(known, np.sqrt(np.diagonal(covariance)), np.inf)
    out = []
    for own in np.split(np.arange(len(index)), np.cumsum([len(one) for one in rows])[:-1]):
        # a group's statistic is that of its known components, in their own covariance
        inside = own[known[own]]
        information, _ = linalg.root(covariance[np.ix_(inside, inside)]) if len(inside) else (np.zeros((0, 0)), None)
        squared = ((information.T @ value[inside]) ** 2).sum()
        out.append(Error(value[own], sigma[own], float(squared), len(inside)))
    return out


# Reliability: what the test does not see.

NOTICEABLE = 7.0**0.5 + 1.645
"""Standard deviations of an error that goes unnoticed in one case of twenty: a search for suspects notices what
lowers the cost by 7 (the price of a row, 16, less the gap of 9 of what is listed); 1.645 is for the noise."""


@dataclass(frozen=True, slots=True)
class Reliability:
    """The errors of single stations that go unnoticed, and what they do to the position.

    Parameters
    ----------
    names : tuple of G str
        Station and kind.
    least : array (G,)
        Error of all its rows of the kind that is noticed in 95 % of all cases, metres, radians or ratios; infinite
        where the others cannot check it at all.
    shift : array (G,)
        How far such an error moves the position, metres; infinite where any size goes unnoticed and moves it.
    """

    names: tuple[str, ...]
    least: Array
    shift: Array


def reliability(problem: Problem, x: Array, suspects: Sequence[Suspect] = ()) -> Reliability:
    """Return the least error of each station that a search for suspects notices, and what an unseen one does.

    An error e of rows c shifts the cost by the noncentrality e^2 c'Q c; it is noticed where the cost falls without it
    by more than the price of one exclusion less the gap to which explanations are listed.

    Parameters
    ----------
    problem : Problem
        A single problem.
    x : array (size,)
        Where it is linearised: a fix, or a truth.
    suspects : sequence of Suspect
        What the fix left out, `fix.suspects`: of the rest then.

    Returns
    -------
    Reliability
        For each station that is heard, and each kind it measures; differences whose noise is that of arrival times
        count as these.

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
        work = work.with_rows(weight=np.where(_touched(work, origin, one), 0.0, work.weight))
    at = influence(work, embed(flat.layout, work.layout, np.asarray(x, dtype=float)))
    channels = _channels(work)
    seen = np.array([at.block(rows).sum() for _, rows in channels])
    told = np.array([at.block(rows).sum() > _NOTHING * at.precision[rows][:, rows].sum() for _, rows in channels])
    least = np.where(told, NOTICEABLE / np.sqrt(np.where(told, seen, 1.0)), np.inf)
    moved = np.stack([at.deviation @ at.shared[rows].sum(0) for _, rows in channels])
    places = [slot.start + i for slot in work.layout.shared if slot.name == "position" for i in range(slot.size)]
    pull = np.linalg.norm(moved[:, places], axis=-1)
    # what moves nothing may be of any size
    shift = np.where(pull > 0.0, least * np.where(pull > 0.0, pull, 1.0), 0.0)
    return Reliability(tuple(name for name, _ in channels), least, shift)


def _touched(work: Problem, origin: Sequence[Array], suspect: Suspect) -> Array:
    """Return which rows (m,) of a problem, perhaps with arrivals for differences, a suspect is."""
    if suspect.group == "station":
        a, b = (np.concatenate([getattr(rows, end) for rows in work.rows]) for end in "ab")
        number = work.stations.names.index(suspect.name.removeprefix("station "))
        return np.asarray((a == number) | (b == number))
    # a single arrival is its station; all others come from one row
    return np.array([len(own) == 1 and int(own[0]) in suspect.rows for own in origin])


def embed(layout: Layout, other: Layout, x: Array) -> Array:
    """Return a vector (size,) in the order of a layout with more unknowns, which are zero: rows are linear in them."""
    out, (shared, local) = np.zeros(other.size), layout.split(x)
    out[shared_places(layout, other)] = shared
    by_epoch = other.split(out)[1]
    for slot in layout.local:
        start = other.find(slot.name)[0].start
        by_epoch[:, start : start + slot.size] = local[:, slot.start : slot.start + slot.size]
    out[other.n_shared :] = by_epoch.ravel()
    return out


def _channels(problem: Problem) -> list[tuple[str, Array]]:
    """Return the rows that are present of every station and kind, and their name; those of no station are none."""
    present, out = problem.weight.reshape(-1)[: problem.count] > 0.0, []
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        own = present[start : start + rows.count] & (rows.a >= 0)
        names = ((i, f"{rows.kind} of {problem.stations.names[i]}") for i in np.unique(rows.a[own]))
        out += [(name, start + np.flatnonzero(own & (rows.a == i))) for i, name in names]
    return out
