"""A solution that grows with its run: new epochs add to the sums, and nothing old is looked at without need."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc import linalg
from optloc.equations import summed
from optloc.errors import InvalidProblem
from optloc.fix import Fix
from optloc.normal import Normal, eliminated
from optloc.priors import with_priors
from optloc.problem import Problem
from optloc.solve.refine import refine
from optloc.solve.stages import given, lsr
from optloc.solve.start import completed
from optloc.types import Array
from optloc.windows import joined, window

# One standard deviation: the sums then err by thousandths of it.
_TOLERANCE = 1.0


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
            Where targets have states of their own at each epoch, or the fix has no answer.
        """
        if any(motion.span == "epoch" and motion.known is None for motion in problem.motions):
            raise InvalidProblem("targets that are free at each epoch share nothing", "begin", "solve their epochs")
        if not np.isfinite(fix.x).all():
            raise InvalidProblem("the fix has no answer to begin from", "fix", "wait for more epochs; see fix.status")
        flat = problem.flat()
        at = fix.x[..., : problem.layout.n_shared].reshape(-1, problem.layout.n_shared)
        return _linearised(flat, at, 0, tolerance)

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
        sums = self.sums + _information(fresh, self.at)
        x, cov, length = _stepped(joint, sums, self.at)
        if np.any(length > self.tolerance):
            start = completed(joint, x[:, None])[:, 0]
            done = refine(joint, start, limit=20)
            return _linearised(joint, done.x[:, : x.shape[1]], self.linearised, self.tolerance)
        return replace(self, problem=joint, x=x, cov=cov, sums=sums)

    def fix(self) -> Fix:
        """Return the fix of all epochs, (N,), refined from the running solution and judged."""
        return lsr(self.problem, given(self.problem, completed(self.problem, self.x[:, None])))


def _linearised(problem: Problem, at: Array, before: int, tolerance: float) -> Running:
    sums = _information(problem, at)
    x, cov, _ = _stepped(problem, sums, at)
    return Running(problem, x, cov, at, sums, before + 1, tolerance)


def _information(problem: Problem, at: Array) -> Normal:
    """Return the information of the measurements about the shared unknowns, linearised at vectors (N, n)."""
    x = completed(problem, at[:, None])[:, 0]
    return eliminated(with_priors(problem, x, summed(problem, x), shared=False))


def _stepped(problem: Problem, sums: Normal, at: Array) -> tuple[Array, Array, Array]:
    """Return estimates (N, n), their covariance and the length (N,) of the step in its own standard deviations."""
    x = np.zeros((len(at), problem.layout.size))
    x[:, : at.shape[1]] = at
    total = with_priors(problem, x, sums, local=False)
    step, ok = linalg.solve(total.shared, total.shared_vector[..., None])
    cov, _ = linalg.inverse(total.shared)
    length = np.sqrt(np.maximum((step[..., 0] * total.shared_vector).sum(-1), 0.0))
    return np.where(ok[:, None], at + step[..., 0], np.nan), cov, np.where(ok, length, np.inf)
