"""The Cramer-Rao bound: the least covariance of an unbiased estimate.

Letters: n shared unknowns, k epochs, q counts of epochs, p free directions, `size` numbers of a parameter vector. The
information of an unknown has one over its squared SI unit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from optloc.base import linalg
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.kernels.sums import equations_at, summed
from optloc.linear.constraints import exact, levels, tangent_at
from optloc.linear.fences import fence_information
from optloc.linear.normal import Linear, Normal, covariance, linearise, marginal, normal, prior_parts, with_priors
from optloc.linear.walks import walks
from optloc.problem.epochs import cut, has_correlated_epochs, windows
from optloc.problem.layout import Layout
from optloc.problem.problem import Problem

# Rounding errors of a sum of squares are 1e-16 of the whole; sums over long runs lose up to four more digits.
OPEN = 1e-12
"""Share of its information, scaled to one, below which a combination of unknowns counts as undetermined."""


def crlb(problem: Problem, truth: Array) -> Array:
    """Return the Cramer-Rao lower bound of the shared unknowns.

    It is the inverse of the normal matrix at the truth. Unknowns that are local to an epoch are eliminated, and priors
    count as information. Equalities such as an exact height limit the bound to their tangent space.

    Parameters
    ----------
    problem : Problem
        Stations, rows and noise; its measurements do not matter.
    truth : array (..., size)
        True parameter vectors.

    Returns
    -------
    array (..., n, n)
        Covariance bound in SI units; NaN if the geometry is singular.

    Raises
    ------
    InvalidProblem
        If nothing is unknown.

    References
    ----------
    S. M. Kay, "Fundamentals of Statistical Signal Processing: Estimation Theory" (1993), eq. 3.31.
    J. D. Gorman and A. O. Hero, "Lower bounds for parametric estimation with constraints" (1990), theorem 1.
    """
    x, equalities = np.asarray(truth, dtype=float), exact(problem)
    equations = equations_at(problem, x)
    if not equalities:
        return covariance(equations)[0]
    information, _, ok = marginal(equations)
    vectors = np.broadcast_to(x, (*ok.shape, x.shape[-1])).reshape(-1, x.shape[-1])
    along = tangent_at(problem.flat(), equalities, vectors)
    bound, good = linalg.inverse_within(information.reshape(-1, *information.shape[-2:]), along)
    return np.where((ok.ravel() & good)[:, None, None], bound, np.nan).reshape(information.shape)


@dataclass(frozen=True, slots=True)
class Course:
    """The bound after the first epochs of a run.

    Parameters
    ----------
    counts : int array (q,)
        Numbers of epochs used.
    times : array (q,)
        Time of the last epoch used, seconds.
    covariance : array (q, n, n)
        Bound of the shared unknowns in SI units; NaN where they are not determined yet.
    layout : Layout
        Names and units of the entries.
    dated : bool
        Whether the times are since 1970, UTC.
    """

    counts: Array
    times: Array
    covariance: Array
    layout: Layout
    dated: bool = False

    def sigma(self, name: str) -> Array:
        """Return the bound (q, size) of the standard deviations of a named unknown, in its SI unit."""
        slot, _ = self.layout.find(name)
        variance = np.diagonal(self.covariance, axis1=-2, axis2=-1)[:, slot.start : slot.start + slot.size]
        return np.asarray(np.sqrt(variance))

    def total(self, name: str) -> Array:
        """Return the root of the sum of variances (q,) of a named unknown: for a position, its error in space."""
        return np.asarray(np.linalg.norm(self.sigma(name), axis=-1))


def crlb_course(
    problem: Problem, truth: Array, counts: Sequence[int] | Array | None = None, *, known: Sequence[str] = ()
) -> Course:
    """Return the Cramer-Rao bound after the first 1, 2, ... epochs of a run.

    The information of each epoch about the shared unknowns adds up, after its local unknowns are eliminated; the prior
    counts once. Time is proportional to the number of epochs, and memory beyond the answer does not depend on it. With
    biases that walk, time is proportional to the sum of the counts.

    Parameters
    ----------
    problem : Problem
        A single problem whose epochs share unknowns; its measurements do not matter.
    truth : array (size,)
        True parameter vector.
    counts : sequence of int, optional
        Numbers of epochs, 1 to k; all by default.
    known : sequence of str
        Names of shared unknowns that count as known; their bound is zero.

    Raises
    ------
    InvalidProblem
        If noise correlates the epochs, a count is out of range, or a name is unknown.

    References
    ----------
    S. M. Kay, "Fundamentals of Statistical Signal Processing: Estimation Theory" (1993), sections 3.7 and 8.4.
    """
    x, layout, k = np.asarray(truth, dtype=float), problem.layout, problem.epochs
    if has_correlated_epochs(problem):
        advice = "compute the bound of the whole run"
        raise InvalidProblem(
            "the noise correlates the epochs, so that their information does not add up", "noise", advice
        )
    chosen = np.arange(1, k + 1) if counts is None else np.asarray(counts, dtype=np.int64)
    if chosen.ndim != 1 or not len(chosen) or chosen.min() < 1 or chosen.max() > k:
        raise InvalidProblem(f"the counts are not among 1 to {k}", "counts", "give numbers of epochs")
    # walks link each epoch to the next, so each count needs a separate sum
    total, size = (_totals_of_walks if walks(problem) else _totals)(problem, x, chosen)
    prior = shared_priors(problem) + fence_information(problem, x)
    bound = _inverse(total + prior, size + np.diagonal(prior), free_directions(problem, x, known))
    return Course(chosen, problem.times[chosen - 1], bound, layout, problem.dated)


def free_directions(problem: Problem, x: Array, known: Sequence[str] = ()) -> Array:
    """Return a basis (n, p) of the directions of the shared unknowns that nothing fixes.

    Equalities, linearised at a vector x (size,), and unknowns with names in `known` fix the other directions.
    """
    layout, equalities = problem.layout, exact(problem)
    fixed = np.zeros(layout.n_shared, dtype=bool)
    for slot in (layout.find(name)[0] for name in known):
        fixed[slot.start : slot.start + slot.size] = True
    eye = np.eye(layout.n_shared)
    if not equalities:
        return eye[:, ~fixed]
    # known names are equalities too: the tangent space of both
    gradients = levels(problem.flat(), equalities, x[None])[1]
    across = np.concatenate([gradients, eye[None, fixed]], axis=1)
    return np.asarray(linalg.tangent(across, np.ones((1, len(eye)))).along[0])


def _totals(problem: Problem, x: Array, counts: Array) -> tuple[Array, Array]:
    """Return the information of the first epochs (q, n, n), and its diagonal (q, n) before elimination.

    `counts` (q,) are the numbers of epochs, and x (size,) is the point of linearisation. Local unknowns are eliminated.
    """
    n = problem.layout.n_shared
    total, size = np.zeros((len(counts), n, n)), np.zeros((len(counts), n))
    so_far, size_so_far = np.zeros((n, n)), np.zeros(n)
    for first, each, known in _each_epoch(problem, x):
        # sums within a part of the run, carried over to the next part, so that memory does not grow with the run
        sums, sizes = so_far + np.cumsum(each, axis=0), size_so_far + np.cumsum(known, axis=0)
        inside = np.flatnonzero((counts > first) & (counts <= first + len(each)))
        total[inside], size[inside] = sums[counts[inside] - first - 1], sizes[counts[inside] - first - 1]
        so_far, size_so_far = sums[-1], sizes[-1]
    return total, size


def _totals_of_walks(problem: Problem, x: Array, counts: Array) -> tuple[Array, Array]:
    """Return the result of `_totals` for a run with biases that walk; time grows with each count.

    Walks link the epochs, so the information of the epochs does not add up.
    """
    n, length = problem.layout.n_shared, problem.layout.n_local
    total, size = np.zeros((len(counts), n, n)), np.zeros((len(counts), n))
    for i, count in enumerate(counts.tolist()):
        part, x_part = cut(problem, 0, count), x[: n + count * length]
        equations = with_priors(part, x_part, summed(part, x_part), shared=False)
        total[i], size[i] = marginal(equations)[0], np.diagonal(equations.shared)
    return total, size


def _each_epoch(problem: Problem, x: Array) -> Iterator[tuple[int, Array, Array]]:
    """Yield for each part of a run: its first epoch, the information (k, n, n) of its k epochs, and a size (k, n).

    The information is about the shared unknowns. The size is its diagonal before the local unknowns are eliminated.
    """
    n = problem.layout.n_shared
    for first, last, part in windows(problem):
        linear = linearise(part, x)
        # all unknowns count as local to each epoch, so that the local blocks are the information of the epochs
        both = np.concatenate([linear.shared, linear.local], axis=-1)
        as_local = Linear(linear.residual, linear.shared[..., :0], both, linear.epoch - first, linear.noise)
        gram = normal(as_local, last - first).local
        zeros, grams = np.zeros(len(gram)), gram[:, None]
        equations = Normal(
            gram[:, :n, :n], grams[..., n:, n:], grams[..., :n, n:], zeros[:, None], zeros[:, None, None], zeros
        )
        yield first, shared_information(with_local_priors(problem, equations)), np.diagonal(gram[:, :n, :n], 0, -2, -1)


@np.errstate(over="ignore", invalid="ignore")  # an overflow becomes NaN
def _inverse(information: Array, size: Array, basis: Array) -> Array:
    """Return inverses (q, n, n) of information (q, n, n) on a basis (n, p); NaN if a combination is undetermined.

    `size` (q, n), the diagonal before elimination, sets the rounding error of zero.
    """
    # scaled by the diagonal before elimination: a small remainder is rounding, not information
    inner, size = basis.T @ information @ basis, size @ basis**2
    inverse, _ = linalg.inverse(inner)
    scale = 1.0 / np.sqrt(np.where(size > 0.0, size, 1.0))
    scaled = inner * scale[..., :, None] * scale[..., None, :]
    finite = np.asarray(np.isfinite(scaled).all((-1, -2)))  # an overflow counts as undetermined
    weakest = np.linalg.eigvalsh(np.where(finite[..., None, None], scaled, 0.0)).min(-1, initial=1.0)
    return np.where((finite & (weakest > OPEN))[..., None, None], basis @ inverse @ basis.T, np.nan)


def with_local_priors(problem: Problem, equations: Normal) -> Normal:
    """Return equations of the data plus the priors of local unknowns, such as station errors of one epoch.

    They count with the measurements, since local unknowns are eliminated.
    """
    local = equations.local.copy()
    for name, _, precision in prior_parts(problem):
        slot, shared = problem.layout.find(name)
        if not shared:
            part = slice(slot.start, slot.start + slot.size)
            local[..., part, part] += precision
    return replace(equations, local=local)


def shared_priors(problem: Problem) -> Array:
    """Return the precision (n, n) of the priors of shared unknowns."""
    layout = problem.layout
    precision = np.zeros((layout.n_shared, layout.n_shared))
    for name, _, part in prior_parts(problem):
        slot, shared = layout.find(name)
        if shared:
            where = slice(slot.start, slot.start + slot.size)
            precision[where, where] += part
    return precision


def shared_information(equations: Normal) -> Array:
    """Return the information (..., n, n) of the shared unknowns, after elimination of the local unknowns.

    An epoch with undetermined local unknowns counts too. If all local blocks are regular, the result equals the
    information of `optloc.linear.normal.marginal`.
    """
    # root of the pseudo-inverse: directions of local unknowns that no row measures remove no information
    root, _ = linalg.root(equations.local)
    projected = equations.cross @ root
    return np.asarray(equations.shared - (projected @ np.swapaxes(projected, -1, -2)).sum(-3))
