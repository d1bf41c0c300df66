"""A solution that grows with its run: new epochs are added to sums.

Old epochs are linearised again only if the estimate has moved too far. The sums are normal equations.

Letters: N runs, n shared unknowns, k epochs, q numbers of epochs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optloc.base import linalg
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Status
from optloc.kernels.least_squares import refine
from optloc.kernels.sums import summed
from optloc.linear.normal import Normal, covariance, eliminated, with_priors
from optloc.linear.vectors import complete
from optloc.linear.walks import walks
from optloc.problem.epochs import cut, has_correlated_epochs, joined, window
from optloc.problem.fix import Fix
from optloc.problem.layout import Layout
from optloc.problem.problem import Problem
from optloc.solvers.pool import begin
from optloc.solvers.stages import lsr
from optloc.solvers.verdict.judge import verdict

# One standard deviation: the error of the sums is then thousandths of a standard deviation.
_TOLERANCE = 1.0
# Most steps of a new linearisation: it begins a few standard deviations from its end, where two or three are enough.
_STEPS = 20
# Most estimates of a growing run: a picture cannot show more.
_POINTS = 60


@dataclass(frozen=True, slots=True)
class Running:
    """The maximum-likelihood solution of a run so far, to which more epochs can be added.

    Parameters
    ----------
    problem : Problem
        Flat batch of N runs, all epochs so far.
    x : array (N, n)
        Estimates of the shared unknowns: targets, biases, station offsets of the run.
    cov : array (N, n, n)
        Their covariance; NaN where singular.
    at : array (N, n)
        Point of linearisation of the sums.
    sums : Normal
        Information of the measurements about the shared unknowns; unknowns of single epochs are eliminated.
    linearised : int
        Number of linearisations of all epochs.
    tolerance : float
        Steps longer than this many standard deviations of the estimate lead to a new linearisation.
    """

    problem: Problem
    x: Array
    cov: Array
    at: Array
    sums: Normal
    linearised: int
    tolerance: float = _TOLERANCE

    @classmethod
    def begin(cls, problem: Problem, fix: Fix, *, tolerance: float = _TOLERANCE) -> Running:
        """Return the running solution of a run from its fix.

        Parameters
        ----------
        problem : Problem
            Batch (...) of runs. Targets last the run.
        fix : Fix
            Its fix, of `optloc.solve`; if the fix is ambiguous, the best answer is used.
        tolerance : float
            Steps longer than this many standard deviations of the estimate lead to a new linearisation.

        Raises
        ------
        InvalidProblem
            If targets have separate states at each epoch, a bias walks, or the fix has no answer.
        """
        if any(motion.span == "epoch" and motion.known is None for motion in problem.motions):
            raise InvalidProblem("targets that are free at each epoch share no unknown", "begin", "solve their epochs")
        if walks(problem):
            message = (
                f"the walk {walks(problem)[0].name!r} links each epoch to the next, so that epochs cannot be added"
            )
            raise InvalidProblem(message, "begin", "solve the whole run")
        if not np.isfinite(fix.x).all():
            raise InvalidProblem("the fix has no answer to start from", "fix", "wait for more epochs; see fix.status")
        flat = problem.flat()
        # the first numbers of a vector are the shared unknowns
        at = fix.x[..., : problem.layout.n_shared].reshape(-1, problem.layout.n_shared)
        return _linearise(flat, at, 0, tolerance)

    def update(self, more: Problem) -> Running:
        """Return the solution with the epochs of another problem added.

        The new epochs are linearised at the point of the old ones and added to the sums. All epochs are linearised
        again only if the step is longer than the tolerance.

        Parameters
        ----------
        more : Problem
            Later epochs of the same stations, targets and biases, with the same batch axes.

        Raises
        ------
        InvalidProblem
            It names the difference, or the epoch that is not later than the last.
        """
        joint = joined(self.problem, more.flat())
        fresh = window(joint, self.problem.epochs, joint.epochs)
        # sums add only if they have the same point of linearisation
        sums = self.sums + _information(fresh, self.at)
        x, cov, length = _step(joint, sums, self.at)
        # the sums of the batch are one array, so the whole batch is linearised together
        if np.any(length > self.tolerance):
            start = complete(joint, x[:, None])[:, 0]
            done = refine(joint, start, limit=_STEPS)
            return _linearise(joint, done.x[:, : x.shape[1]], self.linearised, self.tolerance)
        return replace(self, problem=joint, x=x, cov=cov, sums=sums)

    def fix(self) -> Fix:
        """Return the fix of all epochs, (N,), refined from the running solution and judged."""
        start = begin(self.problem, complete(self.problem, self.x[:, None]))
        return verdict(self.problem, lsr(self.problem, start))


def _linearise(problem: Problem, at: Array, before: int, tolerance: float) -> Running:
    """Return the running solution after a linearisation of all epochs at vectors `at` (N, n).

    `before` is the number of earlier linearisations, and `tolerance` the length of a step in standard deviations.
    """
    sums = _information(problem, at)
    x, cov, _ = _step(problem, sums, at)
    return Running(problem, x, cov, at, sums, before + 1, tolerance)


def _information(problem: Problem, at: Array) -> Normal:
    """Return the information of the measurements about the shared unknowns, linearised at vectors `at` (N, n).

    Unknowns of single epochs are eliminated, with their priors. Priors of shared unknowns are not included.
    """
    x = complete(problem, at[:, None])[:, 0]
    # Priors of local unknowns are added here and eliminated. Priors of shared unknowns would count again with every
    # update.
    return eliminated(with_priors(problem, x, summed(problem, x), shared=False))


def _step(problem: Problem, sums: Normal, at: Array) -> tuple[Array, Array, Array]:
    """Return estimates (N, n), their covariance (N, n, n), and the length (N,) of the step in standard deviations.

    `at` (N, n) is the point of linearisation of `sums`. If the sums are singular, the estimate is NaN and the length
    infinite.
    """
    x = np.zeros((len(at), problem.layout.size))
    x[:, : at.shape[1]] = at
    total = with_priors(problem, x, sums, local=False)
    step, ok = linalg.solve(total.shared, total.shared_vector[..., None])
    cov, _ = linalg.inverse(total.shared)
    # step' information step: the squared step in standard deviations
    length = np.sqrt(np.maximum((step[..., 0] * total.shared_vector).sum(-1), 0.0))
    return np.where(ok[:, None], at + step[..., 0], np.nan), cov, np.where(ok, length, np.inf)


# The estimate as a function of the number of epochs.


@dataclass(frozen=True, slots=True)
class GrowingRun:
    """Estimates after the first epochs of a run.

    Parameters
    ----------
    counts : int array (q,)
        Numbers of epochs used.
    times : array (q,)
        Time of the last epoch used, seconds.
    x : array (q, n)
        Estimates of the shared unknowns; NaN where the epochs do not determine them.
    cov : array (q, n, n)
        Their covariance; NaN likewise.
    layout : Layout
        Names and units of the entries.
    dated : bool
        Whether the times are since 1970, UTC.
    """

    counts: Array
    times: Array
    x: Array
    cov: Array
    layout: Layout
    dated: bool = False

    def take(self, name: str) -> tuple[Array, Array]:
        """Return estimates and standard deviations, both (q, size), of a named unknown, in its unit."""
        slot, _ = self.layout.find(name)
        part = slice(slot.start, slot.start + slot.size)
        return self.x[:, part], np.sqrt(np.diagonal(self.cov, axis1=-2, axis2=-1)[:, part])


def growing(problem: Problem, fix: Fix, counts: Sequence[int] | Array | None = None) -> GrowingRun:
    """Return the maximum-likelihood estimates after the first epochs of a run, refined from the fix of the whole run.

    Parameters
    ----------
    problem : Problem
        A single run whose epochs share unknowns.
    fix : Fix
        Its fix.
    counts : sequence of int, optional
        Numbers of epochs, 1 to k; by default at most sixty numbers, denser at the start.

    Raises
    ------
    InvalidProblem
        If the epochs share nothing, noise correlates them, a count is out of range, or the fix has no answer.
    """
    k, n = problem.epochs, problem.layout.n_shared
    if k == 1 or not n or problem.batch_shape or has_correlated_epochs(problem):
        advice = "give a single run of epochs that have biases or a motion in common"
        raise InvalidProblem("the estimate does not grow with the epochs", "problem", advice)
    if fix.shape or not np.isfinite(fix.x).all():
        raise InvalidProblem("the run has no answer to start from", "fix", "see its status for the reason")
    chosen = _space_counts(k) if counts is None else np.asarray(counts, dtype=np.int64)
    if not len(chosen) or chosen.min() < 1 or chosen.max() > k:
        raise InvalidProblem(f"the counts are not among 1 to {k}", "counts", "give numbers of epochs")
    x, cov = np.full((len(chosen), n), np.nan), np.full((len(chosen), n, n), np.nan)
    for i, count in enumerate(chosen):
        part = cut(problem, 0, int(count)).flat()
        # the start is the answer of the whole run, so that the estimate follows its minimum even if the first epochs
        # have others
        done = refine(part, fix.x[None, : part.layout.size])
        spread, ok = covariance(done.equations)
        if ok[0] and done.status[0] == Status.OK:
            x[i], cov[i] = done.x[0, :n], spread[0]
    return GrowingRun(chosen, problem.times[chosen - 1], x, cov, problem.layout, problem.dated)


def _space_counts(epochs: int) -> Array:
    """Return at most sixty numbers of epochs, from 1 to `epochs`, denser at the start."""
    if epochs <= _POINTS:
        return np.arange(1, epochs + 1)
    # geometric spacing: an estimate changes most while its epochs are few
    return np.unique(np.geomspace(1, epochs, _POINTS).round().astype(np.int64))
