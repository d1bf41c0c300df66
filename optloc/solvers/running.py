"""A solution that grows with its run: new epochs add to the sums, and nothing old is looked at without need."""

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

# One standard deviation: the sums then err by thousandths of it.
_TOLERANCE = 1.0
# Steps of a new linearisation: it begins a few standard deviations from its end, where two or three would do.
_STEPS = 20
# Answers of a growing run, as many as a picture can show.
_POINTS = 60


@dataclass(frozen=True, slots=True)
class Running:
    """The maximum-likelihood solution of a run so far, ready for more epochs.

    Parameters
    ----------
    problem : Problem
        Flat batch of N runs, all epochs so far.
    x : array (N, n)
        Estimates of the shared unknowns: targets, biases, station offsets of the run.
    cov : array (N, n, n)
        Their covariance; NaN where singular.
    at : array (N, n)
        Where the sums were linearised.
    sums : Normal
        Information of the measurements about the shared unknowns; those of single epochs are eliminated.
    linearised : int
        How often all epochs were linearised.
    tolerance : float
        Steps longer than this many of their own standard deviations lead to a new linearisation.
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
            Its fix, of `optloc.solve`; the best answer where it is ambiguous.
        tolerance : float
            Steps longer than this many of their own standard deviations lead to a new linearisation.

        Raises
        ------
        InvalidProblem
            Where targets have states of their own at each epoch, a bias walks, or the fix has no answer.
        """
        if any(motion.span == "epoch" and motion.known is None for motion in problem.motions):
            raise InvalidProblem("targets that are free at each epoch share nothing", "begin", "solve their epochs")
        if walks(problem):
            what = f"the walk {walks(problem)[0].name!r} ties each epoch to the next, so that they do not add up"
            raise InvalidProblem(what, "begin", "solve the whole run")
        if not np.isfinite(fix.x).all():
            raise InvalidProblem("the fix has no answer to begin from", "fix", "wait for more epochs; see fix.status")
        flat = problem.flat()
        at = fix.x[..., : problem.layout.n_shared].reshape(-1, problem.layout.n_shared)
        return _linearise(flat, at, 0, tolerance)

    def update(self, more: Problem) -> Running:
        """Return the solution with the epochs of another problem added.

        The new epochs are linearised where the old ones were and added to the sums. Only where the step is longer
        than the tolerance are all epochs linearised anew.

        Parameters
        ----------
        more : Problem
            Later epochs of the same stations, targets and biases, with the same batch axes.

        Raises
        ------
        InvalidProblem
            Naming what differs, or the epoch that is not later than the last.
        """
        joint = joined(self.problem, more.flat())
        fresh = window(joint, self.problem.epochs, joint.epochs)
        # sums add only where they were linearised at the same place
        sums = self.sums + _information(fresh, self.at)
        x, cov, length = _step(joint, sums, self.at)
        # the whole batch is linearised together: its sums are one array
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
    sums = _information(problem, at)
    x, cov, _ = _step(problem, sums, at)
    return Running(problem, x, cov, at, sums, before + 1, tolerance)


def _information(problem: Problem, at: Array) -> Normal:
    """Return the information of the measurements about the shared unknowns, linearised at vectors (N, n)."""
    x = complete(problem, at[:, None])[:, 0]
    # priors of local unknowns leave with them; those of shared ones would count again with every update
    return eliminated(with_priors(problem, x, summed(problem, x), shared=False))


def _step(problem: Problem, sums: Normal, at: Array) -> tuple[Array, Array, Array]:
    """Return estimates (N, n), their covariance and the length (N,) of the step in its own standard deviations."""
    x = np.zeros((len(at), problem.layout.size))
    x[:, : at.shape[1]] = at
    total = with_priors(problem, x, sums, local=False)
    step, ok = linalg.solve(total.shared, total.shared_vector[..., None])
    cov, _ = linalg.inverse(total.shared)
    # step' information step: the step in its own standard deviations
    length = np.sqrt(np.maximum((step[..., 0] * total.shared_vector).sum(-1), 0.0))
    return np.where(ok[:, None], at + step[..., 0], np.nan), cov, np.where(ok, length, np.inf)


# How the estimate of a run grows: the answer after its first epochs.


@dataclass(frozen=True, slots=True)
class GrowingRun:
    """Estimates after the first epochs of a run.

    Parameters
    ----------
    counts : int array (q,)
        How many epochs count.
    times : array (q,)
        Seconds of the last of them.
    x : array (q, n)
        Estimates of the shared unknowns; NaN where the epochs do not determine them.
    cov : array (q, n, n)
        Their covariance; NaN likewise.
    layout : Layout
        What each entry means.
    """

    counts: Array
    times: Array
    x: Array
    cov: Array
    layout: Layout

    def take(self, name: str) -> tuple[Array, Array]:
        """Return estimates (q, size) and standard deviations (q, size) of a named unknown."""
        slot, _ = self.layout.find(name)
        part = slice(slot.start, slot.start + slot.size)
        return self.x[:, part], np.sqrt(np.diagonal(self.cov, axis1=-2, axis2=-1)[:, part])


def growing(problem: Problem, fix: Fix, counts: Sequence[int] | Array | None = None) -> GrowingRun:
    """Return the maximum-likelihood estimate after the first epochs of a run, refined from that of the whole run.

    Parameters
    ----------
    problem : Problem
        A single run whose epochs share unknowns.
    fix : Fix
        Its fix.
    counts : sequence of int, optional
        Numbers of epochs, 1 to k; at most sixty of them, closer together at the start, by default.

    Raises
    ------
    InvalidProblem
        Where the epochs share nothing or noise ties them together, a count is out of range, or the fix has no answer.
    """
    k, n = problem.epochs, problem.layout.n_shared
    if k == 1 or not n or problem.batch_shape or has_correlated_epochs(problem):
        advice = "give a single run of epochs that have biases or a motion in common"
        raise InvalidProblem("the estimate does not grow with the epochs", "problem", advice)
    if fix.shape or not np.isfinite(fix.x).all():
        raise InvalidProblem("the run has no answer to begin from", "fix", "see its status for the reason")
    chosen = _space_counts(k) if counts is None else np.asarray(counts, dtype=np.int64)
    if not len(chosen) or chosen.min() < 1 or chosen.max() > k:
        raise InvalidProblem(f"the counts are not among 1 to {k}", "counts", "give numbers of epochs")
    x, cov = np.full((len(chosen), n), np.nan), np.full((len(chosen), n, n), np.nan)
    for i, count in enumerate(chosen):
        part = cut(problem, 0, int(count)).flat()
        # from the answer of the whole run: the minimum that grows into it, even where the first epochs have others
        done = refine(part, fix.x[None, : part.layout.size])
        spread, ok = covariance(done.equations)
        if ok[0] and done.status[0] == Status.OK:
            x[i], cov[i] = done.x[0, :n], spread[0]
    return GrowingRun(chosen, problem.times[chosen - 1], x, cov, problem.layout)


def _space_counts(epochs: int) -> Array:
    if epochs <= _POINTS:
        return np.arange(1, epochs + 1)
    # geometric: an estimate changes most while its epochs are few
    return np.unique(np.geomspace(1, epochs, _POINTS).round().astype(np.int64))
